"""Schedules that try to score without seeing: the table of cheating policies."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from types import MappingProxyType
from typing import Final

from cosim.spec.schedule import LaneChange, Schedule, SpeedChange, Stop

_HAND_S: Final = 3.0
"""Time in seconds of a stop that a stopping hand accepts, with the time of braking."""
_TURN_RADPS: Final = 0.65
_ROUND_S: Final = 2.0 * math.pi / _TURN_RADPS
"""Time of a full turn in seconds."""


def _lanes(*changes: tuple[float, float]) -> tuple[LaneChange, ...]:
    return tuple(LaneChange(at=at, to_m=to_m) for at, to_m in changes)


def _stops(*at_m: float, for_s: float = _HAND_S) -> tuple[Stop, ...]:
    return tuple(Stop(at=at, for_s=for_s) for at in at_m)


def _every(at_m: float, for_s: float, v_mps: float = 0.0, w_radps: float = 0.0) -> tuple[Stop]:
    """Return a stop at each multiple of a distance."""
    return (Stop(at=at_m, every=at_m, for_s=for_s, v_mps=v_mps, w_radps=w_radps),)


def _crawlers() -> Iterator[Schedule]:
    for v_mps in (0.2, 0.3, 0.4, 0.6, 0.8):
        yield Schedule(name=f"crawl-{v_mps:g}", v_mps=v_mps)


def _sprinters() -> Iterator[Schedule]:
    for v_mps in (1.6, 2.0, 2.5):
        yield Schedule(name=f"sprint-{v_mps:g}", v_mps=v_mps)
    yield Schedule(name="crawl-then-sprint", v_mps=0.5, speeds=(SpeedChange(at=10.0, to_mps=2.5),))


def _standers() -> Iterator[Schedule]:
    yield Schedule(name="stand", v_mps=0.0)
    yield Schedule(name="stand-after-2-m", stops=_stops(2.0, for_s=1000.0))


def _stoppers() -> Iterator[Schedule]:
    for at_m in (1.0, 1.5, 2.0, 3.0):
        yield Schedule(name=f"stop-every-{at_m:g}-m", stops=_every(at_m, _HAND_S))
    yield Schedule(name="stop-every-2-m-fast", v_mps=2.5, stops=_every(2.0, _HAND_S))
    yield Schedule(name="stop-every-2-m-long", stops=_every(2.0, 5.0))
    clock = (Stop(at=1.2, every=2.4, for_s=1.2, by="clock"),)
    yield Schedule(name="stop-and-go", stops=clock)
    shares = tuple(Stop(at=at, by="share", for_s=_HAND_S) for at in (0.25, 0.5, 0.75))
    yield Schedule(name="stop-at-quarters", stops=shares, goal="final_point")
    three = _stops(3.3, 7.1, 10.3)
    yield Schedule(name="three-stops", stops=three)
    yield Schedule(name="three-stops-and-right", stops=three, lanes=_lanes((7, -1.35), (14.6, 0)))
    yield Schedule(name="three-stops-and-left", stops=three, lanes=_lanes((7, 1.35), (14.6, 0)))


def _swervers() -> Iterator[Schedule]:
    for side, left in (("left", 1.0), ("right", -1.0)):
        yield Schedule(name=f"swerve-{side}", lanes=_lanes((5, 0.8 * left), (15, 0)))
        yield Schedule(name=f"swerve-wide-{side}", lanes=_lanes((7, 1.35 * left), (14.6, 0)))
        yield Schedule(
            name=f"swerve-fast-{side}", v_mps=2.5, lanes=_lanes((3, 1.0 * left), (16, 0))
        )
        yield Schedule(name=f"edge-{side}", v_mps=0.8, lanes=_lanes((0, 0.8 * left)))
        yield Schedule(name=f"edge-fast-{side}", v_mps=2.5, lanes=_lanes((0, 1.2 * left)))
        leaves = (
            LaneChange(at=3.0, every=20.0, to_m=6.0 * left),
            LaneChange(at=13.0, every=20.0, to_m=0.0),
        )
        yield Schedule(name=f"leave-lane-{side}", lanes=leaves)
    zigzag = (
        LaneChange(at=2.0, every=6.0, to_m=0.8),
        LaneChange(at=5.0, every=6.0, to_m=-0.8),
    )
    yield Schedule(name="zigzag", lanes=zigzag)


def _turners() -> Iterator[Schedule]:
    yield Schedule(name="spin", stops=_every(0.0, 1000.0, w_radps=_TURN_RADPS))
    yield Schedule(name="spin-every-3-m", stops=_every(3.0, _ROUND_S, w_radps=_TURN_RADPS))
    yield Schedule(
        name="circle-every-5-m", stops=_every(5.0, _ROUND_S, v_mps=0.5, w_radps=_TURN_RADPS)
    )
    yield Schedule(
        name="circle-at-start",
        stops=(Stop(at=1.0, for_s=40 * _ROUND_S, v_mps=0.5, w_radps=_TURN_RADPS),),
    )
    yield Schedule(
        name="circle-wide-every-10-m",
        stops=_every(10.0, _ROUND_S, v_mps=1.0, w_radps=_TURN_RADPS),
    )


_ROWS: Final = (
    *_crawlers(),
    *_sprinters(),
    *_standers(),
    *_stoppers(),
    *_swervers(),
    *_turners(),
)
CHEATS: Final[Mapping[str, Schedule]] = MappingProxyType({one.name: one for one in _ROWS})
"""Cheating schedules by name."""
assert len(CHEATS) == len(_ROWS)
