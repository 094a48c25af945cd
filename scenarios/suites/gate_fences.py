"""Fences that narrow a sidewalk at an event to a gate, so that its people can close one side."""

from __future__ import annotations

import math
from typing import Final, NamedTuple

import numpy as np

from cosim.core.errors import SpecError
from cosim.core.geometry import Pose, wrap_angle
from cosim.spec.obstacle import OBSTACLE_FORMS, OBSTACLE_VARIANTS, Obstacle, obstacle_size_m
from cosim.spec.robot import Robot
from scenarios.suites.drawing import wider_m

_EDGE_M: Final = 0.03
"""Distance between a fence and the edge of the sidewalk, in metres."""
_MIN_M: Final = 0.52
"""Least width that a fence closes, in metres."""
_MAX_M: Final = 2.2
"""Largest width that a fence closes, in metres."""
_SPLITS: Final = 20


class Gate(NamedTuple):
    """Gate across a sidewalk.

    left_m: offset of its middle from the middle of the sidewalk, left positive.
    half_m: half its width.
    fences: one or none at either edge.
    """

    left_m: float
    half_m: float
    fences: tuple[Obstacle, ...] = ()


def drawn_gate(
    range_m: tuple[float, float],
    sidewalk_half_m: float,
    at: Pose,
    rng: np.random.Generator,
    robot: Robot,
) -> Gate:
    """Draw a gate at a pose on the middle of a sidewalk.

    range_m: least and largest half width of the gate for the default robot. A sidewalk that is
    narrow enough is the gate without fences.

    Raises SpecError if the sidewalk is too wide.
    """
    low_m, high_m = (bound + 0.5 * wider_m(robot) for bound in range_m)
    if sidewalk_half_m <= high_m:
        return Gate(0.0, sidewalk_half_m)
    high_m = min(high_m, sidewalk_half_m - 0.5 * _MIN_M)
    if high_m < low_m:
        raise SpecError("the sidewalk is a little too wide for a gate without fences")
    half_m = float(rng.uniform(low_m, high_m))
    closed_m = 2.0 * (sidewalk_half_m - half_m)
    for _ in range(_SPLITS):
        on_left_m = closed_m * float(rng.random())
        if on_left_m < _MIN_M:
            on_left_m = 0.0
        elif closed_m - on_left_m < _MIN_M:
            on_left_m = closed_m
        if max(on_left_m, closed_m - on_left_m) <= _MAX_M:
            break
    else:
        raise SpecError("the sidewalk is too wide for a gate")
    sides = ((1.0, on_left_m), (-1.0, closed_m - on_left_m))
    paint = int(rng.integers(OBSTACLE_FORMS // OBSTACLE_VARIANTS)) * OBSTACLE_VARIANTS
    fences = tuple(
        _fence(at, side, sidewalk_half_m, wide_m, paint) for side, wide_m in sides if wide_m
    )
    return Gate(0.5 * (closed_m - 2.0 * on_left_m), half_m, fences)


def _fence(at: Pose, side: float, sidewalk_half_m: float, wide_m: float, paint: int) -> Obstacle:
    """Return a fence that closes a width from one edge of a sidewalk.

    It is turned until it is as wide as needed. Its inner corner is beside the pose.
    """
    needed_m = wide_m - _EDGE_M
    variant = next(
        v for v in range(OBSTACLE_VARIANTS) if math.hypot(*_size_m(v)) >= needed_m + 1e-6
    )
    length_m, depth_m = _size_m(variant)
    turned_rad = math.asin(min(needed_m / math.hypot(length_m, depth_m), 1.0))
    turned_rad = max(turned_rad - math.atan2(depth_m, length_m), 0.0)
    sin, cos = math.sin(turned_rad), math.cos(turned_rad)
    ahead_m = 0.5 * (length_m * cos - depth_m * sin)
    left_m = side * (sidewalk_half_m - _EDGE_M - 0.5 * (length_m * sin + depth_m * cos))
    along_x, along_y = math.cos(at.heading_rad), math.sin(at.heading_rad)
    return Obstacle(
        kind="fence",
        x_m=round(at.x_m + ahead_m * along_x - left_m * along_y, 3),
        y_m=round(at.y_m + ahead_m * along_y + left_m * along_x, 3),
        heading_rad=round(wrap_angle(at.heading_rad + side * turned_rad), 4),
        form=paint + variant,
    )


def _size_m(variant: int) -> tuple[float, float]:
    length_m, depth_m, _ = obstacle_size_m("fence", variant)
    return length_m, depth_m
