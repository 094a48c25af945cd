"""Policies that try to score without driving well, which no rule may reward."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Mapping
from functools import cache

import numpy as np

from cosim.core.state import STILL, Command
from cosim.episode.interfaces import Observation
from cosim.spec.camera import CameraSpec
from cosim.spec.episode_id import episode_id_of
from cosim.spec.manifest import Manifest
from cosim.spec.robot import Mount
from cosim.spec.scenario import Scenario
from scenarios.suites.catalog import SUITES, load_suite

BLIND_MPS = (0.3, 0.4, 0.8, 1.2, 1.5, 2.0, 2.5)
"""The speeds of blind crawls."""


class Crawl:
    """Drives straight ahead at one speed."""

    def __init__(self, v_mps: float = 0.4) -> None:
        self.manifest = Manifest(f"crawl-{v_mps:g}", rate_hz=10.0, camera=None)
        self._command = Command(v_mps, 0.0)

    def reset(self, episode_id: str, seed: int) -> None:
        """Keeps no state."""

    def act(self, observation: Observation) -> Command:
        return self._command


class Stander(Crawl):
    """Drives straight ahead for a while and then stands forever."""

    def __init__(self, v_mps: float = 1.0, after_s: float = 2.0) -> None:
        super().__init__(v_mps)
        self.manifest = Manifest(f"stander-{after_s:g}", rate_hz=10.0, camera=None)
        self._after_s = after_s

    def act(self, observation: Observation) -> Command:
        return self._command if observation.time_s < self._after_s else STILL


class StopAndGo(Crawl):
    """Drives and stands in turns."""

    def __init__(self, v_mps: float = 1.2, goes_s: float = 1.2, stands_s: float = 1.2) -> None:
        super().__init__(v_mps)
        self.manifest = Manifest(f"stop-and-go-{v_mps:g}", rate_hz=10.0, camera=None)
        self._goes_s = goes_s
        self._period_s = goes_s + stands_s

    def act(self, observation: Observation) -> Command:
        return self._command if observation.time_s % self._period_s < self._goes_s else STILL


class EdgeDriver(Crawl):
    """Turns aside first, to one side (left is 1), by about v w t^2 metres, and then drives along
    there. It skids less as it turns than as it turns back, which takes two answers more."""

    ASIDE_M = 0.8
    TURN_RADPS = 0.5

    def __init__(self, v_mps: float = 1.0, side: int = 1) -> None:
        super().__init__(v_mps)
        self.manifest = Manifest(f"edge-{v_mps:g}", rate_hz=10.0, camera=None)
        self._w_radps = side * self.TURN_RADPS
        self._turns = round(10.0 * (self.ASIDE_M / (v_mps * self.TURN_RADPS)) ** 0.5)

    def act(self, observation: Observation) -> Command:
        answers = round(10.0 * observation.time_s)
        turns = (answers < self._turns) - (self._turns <= answers < 2 * self._turns + 2)
        return Command(self._command.v_mps, turns * self._w_radps)


class Spinner(Crawl):
    """Turns in place at full rate, and so looks at no person for long."""

    def __init__(self) -> None:
        super().__init__(0.0)
        self.manifest = Manifest("spinner", rate_hz=10.0, camera=None)
        self._command = Command(0.0, 0.65)


class WallHugger(EdgeDriver):
    """Drives along the left edge of the sidewalk."""

    def __init__(self) -> None:
        super().__init__(0.8)
        self.manifest = Manifest("wall-hugger", rate_hz=10.0, camera=None)


class EarlyLeaver(Crawl):
    """Uses privileged state, and leaves the sidewalk wherever people come near."""

    def __init__(self) -> None:
        super().__init__(1.0)
        self.manifest = Manifest("early-leaver", rate_hz=10.0, camera=None, privileged=True)

    def act(self, observation: Observation) -> Command:
        return Command(2.0, 0.65) if _person_within(observation, 14.0) else self._command


class Quitter(EarlyLeaver):
    """Uses privileged state, and ends its process before it would fail."""

    def __init__(self) -> None:
        super().__init__()
        self.manifest = Manifest("quitter", rate_hz=10.0, camera=None, privileged=True)

    def act(self, observation: Observation) -> Command:
        if _person_within(observation, 1.0):
            os._exit(0)
        return self._command


def _person_within(observation: Observation, far_m: float) -> bool:
    known = observation.privileged
    assert known is not None
    return (
        len(known.people) > 0
        and float(np.hypot(*(known.people.xy - known.robot.pose.xy).T).min()) < far_m
    )


def _crawls_at(v_mps: float) -> type[Crawl]:
    """Return a crawl that can be made by its name alone, as by `cosim run --policy
    tests.support.cheats:Crawl04`."""

    class CrawlHere(Crawl):
        def __init__(self) -> None:
            super().__init__(v_mps)

    return CrawlHere


Crawl03, Crawl04, Crawl08, Crawl12, Crawl15, Crawl20, Crawl25 = map(_crawls_at, BLIND_MPS)

CHEATS: Mapping[str, Callable[[], Crawl]] = {
    **{f"Crawl{10 * v_mps:02.0f}": _crawls_at(v_mps) for v_mps in BLIND_MPS},
    "Stander": Stander,
    "StopAndGo": StopAndGo,
    "Spinner": Spinner,
    "WallHugger": WallHugger,
    "EarlyLeaver": EarlyLeaver,
    "Quitter": Quitter,
}
"""By their names in `tests.support.cheats`."""

_SHORT_M = 2.0
"""Distance at which the name reader stands before an event's people."""
_PACE_MPS = 1.0


class NameReader:
    """A blind policy that looks up its episode's name in the shipped suites, also under names of
    runs with small seeds, and stands before a stopping hand."""

    manifest = Manifest("name-reader", camera=None)

    def reset(self, episode_id: str, seed: int) -> None:
        self.known = _names().get(episode_id)

    def act(self, observation: Observation) -> Command:
        events = () if self.known is None else self.known.events
        driven_m = _PACE_MPS * observation.time_s
        stands = any(
            event.kind == "gesturing" and driven_m > event.route_s_m - _SHORT_M for event in events
        )
        return STILL if stands else Command(_PACE_MPS, 0.0)


class Counter(NameReader):
    """A blind policy that counts its episodes, and takes the first for the first one of the
    event."""

    manifest = Manifest("counter", camera=None)

    def __init__(self) -> None:
        self.coming = iter(_of_event("gesturing"))

    def reset(self, episode_id: str, seed: int) -> None:
        self.known = next(self.coming)


class FarEye:
    """Has a camera 6 m ahead and 18 m above the ground, which no robot carries."""

    manifest = Manifest("far-eye", camera=CameraSpec(64, 64, mount=Mount((6.0, 0.0, 18.0), 80.0)))

    def reset(self, episode_id: str, seed: int) -> None:
        """Keeps no state."""

    def act(self, observation: Observation) -> Command:
        return Command(_PACE_MPS, 0.0)


@cache
def _names() -> dict[str, Scenario]:
    """Return the scenarios by all names that can be known before a run."""
    found: dict[str, Scenario] = {}
    for scenario in _shipped():
        found[scenario.id] = scenario
        found |= {episode_id_of(seed, scenario).episode: scenario for seed in range(100)}
    return found


@cache
def _of_event(kind: str) -> list[Scenario]:
    return [one for one in _shipped() if any(event.kind == kind for event in one.events)]


def _shipped() -> Iterable[Scenario]:
    return [scenario for name in SUITES for scenario in load_suite(name).scenarios]
