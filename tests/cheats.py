"""Policies that try to score by other means than driving well: what no rule may reward. Policies only."""

from __future__ import annotations

from collections.abc import Iterable
from functools import cache

from cosim.core.state import STILL, Command
from cosim.episode.ports import CameraSpec, Manifest, Observation
from cosim.spec.pseudonym import pseudonym_of
from cosim.spec.robot import Mount
from cosim.spec.scenario import Scenario
from scenarios.catalog import SUITES, load_suite

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


_SHORT_M = 2.0
"""So far before an event's people the name reader stands."""
_PACE_MPS = 1.0


class NameReader:
    """Blind. Looks up in the shipped suites what it is told that its episode is called, also as runs of small seeds
    would call it, and does what is right there: it stands before a stopping hand."""

    manifest = Manifest("name-reader", camera=None)

    def reset(self, episode_id: str, seed: int) -> None:
        self.known = _names().get(episode_id)

    def act(self, observation: Observation) -> Command:
        events = () if self.known is None else self.known.events
        driven_m = _PACE_MPS * observation.time_s
        stands = any(event.kind == "gesturing" and driven_m > event.route_s_m - _SHORT_M for event in events)
        return STILL if stands else Command(_PACE_MPS, 0.0)


class Counter(NameReader):
    """The same by counting: its first episode is the first one of the event."""

    manifest = Manifest("counter", camera=None)

    def __init__(self) -> None:
        self.coming = iter(_of_event("gesturing"))

    def reset(self, episode_id: str, seed: int) -> None:
        self.known = next(self.coming)


class FarEye:
    """Sees by a camera 6 m before it and 18 m above the ground, which no robot carries."""

    manifest = Manifest("far-eye", camera=CameraSpec(64, 64, mount=Mount((6.0, 0.0, 18.0), 80.0)))

    def reset(self, episode_id: str, seed: int) -> None:
        """Nothing to forget."""

    def act(self, observation: Observation) -> Command:
        return Command(_PACE_MPS, 0.0)


@cache
def _names() -> dict[str, Scenario]:
    """All that a shipped scenario may be told to be, as can be known before the run."""
    found: dict[str, Scenario] = {}
    for scenario in _shipped():
        found[scenario.id] = scenario
        found |= {pseudonym_of(seed, scenario).episode: scenario for seed in range(100)}
    return found


@cache
def _of_event(kind: str) -> list[Scenario]:
    return [one for one in _shipped() if any(event.kind == kind for event in one.events)]


def _shipped() -> Iterable[Scenario]:
    return [scenario for name in SUITES for scenario in load_suite(name).scenarios]
