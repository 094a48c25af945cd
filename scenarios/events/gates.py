"""Gates: how wide the way may be at an event whose people leave only one side free.

The conditions hold for a robot of `COURIER`'s width unless another width is given.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Final

from cosim.spec.events import Event, EventKind
from cosim.spec.robot import COURIER

OPEN_ROOM_M: Final = 0.5
"""Least width in metres of the free side beyond that of the robot."""
CLOSED_LESS_M: Final = 0.1
"""Metres by which the closed side is narrower than the robot, at least."""
_MARGIN_M: Final = 0.02
"""Distance in metres of the ranges from the limits of the conditions."""


def gate_half_m(blocks_m: Sequence[float]) -> tuple[float, float]:
    """Return the least and largest half width in metres of the way.

    blocks_m: widths in metres from the closed side's edge to the people's free side, all of which
        the range allows.
    """
    low_m = 0.5 * (max(blocks_m) + COURIER.width_m + OPEN_ROOM_M)
    high_m = min(blocks_m) + 0.5 * COURIER.width_m
    return round(low_m + _MARGIN_M, 3), round(high_m - _MARGIN_M, 3)


def open_interval_m(kind: EventKind, event: Event) -> tuple[float, float]:
    """Return the lateral interval (right, left) in metres between the people and the free edge."""
    right_m, left_m = _blocked_m(kind, event)
    if event.free_side > 0:
        return left_m, event.half_width_m
    return -event.half_width_m, right_m


def closed_m(kind: EventKind, event: Event) -> float:
    """Return the width in metres between the people and the edge of the closed side."""
    right_m, left_m = _blocked_m(kind, event)
    return event.half_width_m + right_m if event.free_side > 0 else event.half_width_m - left_m


def gate_faults(
    kind: EventKind, event: Event, robot_width_m: float = COURIER.width_m
) -> Iterator[str]:
    """Yield why a robot can pass an event and its mirror on one line, or cannot pass the event.

    Events whose people block no side have no faults.
    """
    if kind.blocked is None or event.free_side == 0:
        return
    right_m, left_m = open_interval_m(kind, event)
    mirrored = open_interval_m(kind, kind.decoy_of(event))
    if left_m - right_m < robot_width_m + OPEN_ROOM_M:
        yield f"{event.prefix}the free side is only {left_m - right_m:.2f} m wide"
    if closed_m(kind, event) > robot_width_m - CLOSED_LESS_M:
        yield f"{event.prefix}the closed side is {closed_m(kind, event):.2f} m wide"
    common_m = min(left_m, mirrored[1]) - max(right_m, mirrored[0])
    if common_m >= robot_width_m:
        yield f"{event.prefix}{common_m:.2f} m are free in the event and in its mirror"


def _blocked_m(kind: EventKind, event: Event) -> tuple[float, float]:
    if kind.blocked is None or event.free_side == 0:
        raise ValueError(f"{event.prefix}has no free side")
    return kind.blocked(event)
