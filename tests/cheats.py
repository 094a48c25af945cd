"""Policies that look at nothing and try to score all the same: what no rule may reward. Policies only."""

from __future__ import annotations

from cosim.core.state import STILL, Command
from cosim.episode.ports import Manifest, Observation

BLIND_MPS = (0.3, 0.4, 0.8, 1.2, 1.5, 2.0, 2.5)
"""The speeds of blind crawls."""


class Crawl:
    """Drives straight ahead at one speed."""

    def __init__(self, v_mps: float = 0.4) -> None:
        self.manifest = Manifest(f"crawl-{v_mps:g}", rate_hz=10.0)
        self._command = Command(v_mps, 0.0)

    def reset(self, episode_id: str, seed: int) -> None:
        """Nothing to forget."""

    def act(self, observation: Observation) -> Command:
        return self._command


class Stander(Crawl):
    """Drives straight ahead for a while and then stands for good."""

    def __init__(self, v_mps: float = 1.0, after_s: float = 2.0) -> None:
        super().__init__(v_mps)
        self.manifest = Manifest(f"stander-{after_s:g}", rate_hz=10.0)
        self._after_s = after_s

    def act(self, observation: Observation) -> Command:
        return self._command if observation.time_s < self._after_s else STILL


class StopAndGo(Crawl):
    """Drives for a while, stands for a while, and so on."""

    def __init__(self, v_mps: float = 1.2, goes_s: float = 1.2, stands_s: float = 1.2) -> None:
        super().__init__(v_mps)
        self.manifest = Manifest(f"stop-and-go-{v_mps:g}", rate_hz=10.0)
        self._goes_s, self._period_s = goes_s, goes_s + stands_s

    def act(self, observation: Observation) -> Command:
        return self._command if observation.time_s % self._period_s < self._goes_s else STILL


class EdgeDriver(Crawl):
    """Turns aside first, to one side (left is 1), by about v w t^2 metres, and then drives along there.

    It skids less as it turns than as it turns back, which takes two answers more."""

    ASIDE_M = 0.8
    TURN_RADPS = 0.5

    def __init__(self, v_mps: float = 1.0, side: int = 1) -> None:
        super().__init__(v_mps)
        self.manifest = Manifest(f"edge-{v_mps:g}", rate_hz=10.0)
        self._w_radps = side * self.TURN_RADPS
        self._turns = round(10.0 * (self.ASIDE_M / (v_mps * self.TURN_RADPS)) ** 0.5)

    def act(self, observation: Observation) -> Command:
        answers = round(10.0 * observation.time_s)
        turns = (answers < self._turns) - (self._turns <= answers < 2 * self._turns + 2)
        return Command(self._command.v_mps, turns * self._w_radps)
