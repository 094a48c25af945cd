"""Which way to drive on ground with things on it: of many arcs one that stays clear, in the middle, and leads on."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from cosim.core.geometry import Floats
from cosim.core.state import STILL, Command
from cosim.policies.follow.ground import GROUND_ASIDE_M, GROUND_CELL_M
from cosim.spec.robot import Robot

LOOKS_M: Final = 5.0
"""How far an arc is followed."""
_PERSON_M: Final = 0.45
"""What is kept from the middle of a person, beside the robot's own clearance."""
_CLEAR_M: Final = 0.10
"""Between the robot's side and what is not walkable."""
_ROOM_M: Final = 1.2
"""More room to either side than this is worth nothing."""
_STOPS_M: Final = 0.9
_SLOWS_M: Final = 1.5
"""It stands where its arc is free for less than the first, and is at its pace where it is for both."""
_TURNS_RAD: Final = math.radians(70.0)
"""Arcs end where they have turned so much: beyond that the camera does not see where they lead."""
_PACE: Final = 0.8
"""Of the robot's cruise."""
_ARCS: Final = 41
_STEPS_M: Final = np.arange(0.3, LOOKS_M, GROUND_CELL_M)
_ROOM, _GOAL, _STRAIGHT, _STEADY = 0.8, 0.5, 0.1, 0.05
"""What a metre of room, and a radian aside from the goal, from ahead, and from the arc before are worth, against the
length that is free, of 1 in all."""


@dataclass(frozen=True)
class Arc:
    """curvature: 1 / m, to the left; free_m: how far it is free."""

    curvature: float
    free_m: float


def best_arc(
    free: NDArray[np.bool_], people: Floats, robot: Robot, towards_rad: float | None, last: float = 0.0
) -> Arc:
    """The best arc on cells as `Ground.free` gives them.

    people: (N, 2), where they stand; towards_rad: the bearing of the goal, None without one; last: the curvature of the
    arc before.
    """
    room_m = _room(free, people)
    curvatures = np.linspace(-1.0, 1.0, _ARCS) * robot.w_max_radps / (_PACE * robot.cruise_mps)
    x, y = _points(curvatures)
    rows = np.clip((x / GROUND_CELL_M).astype(int), 0, free.shape[0] - 1)
    columns = np.clip(((y + GROUND_ASIDE_M) / GROUND_CELL_M).astype(int), 0, free.shape[1] - 1)
    rooms = room_m[rows, columns]
    blocked = (rooms < 0.5 * robot.width_m + _CLEAR_M) | (np.abs(curvatures[:, None] * _STEPS_M) > _TURNS_RAD)
    first = np.where(blocked.any(axis=1), blocked.argmax(axis=1), len(_STEPS_M))
    free_m = np.where(first < len(_STEPS_M), _STEPS_M[np.minimum(first, len(_STEPS_M) - 1)], LOOKS_M)
    on_the_way = np.arange(len(_STEPS_M)) < np.maximum(first, 1)[:, None]
    mean_room = (np.minimum(rooms, _ROOM_M) * on_the_way).sum(axis=1) / on_the_way.sum(axis=1)
    end = np.arctan2(y[:, -1], x[:, -1])
    worth = free_m / LOOKS_M + _ROOM * mean_room / _ROOM_M
    worth -= _STRAIGHT * np.abs(end) if towards_rad is None else _GOAL * np.abs(end - np.clip(towards_rad, -1.2, 1.2))
    worth -= _STEADY * np.abs(curvatures - last)
    best = int(worth.argmax())
    return Arc(float(curvatures[best]), float(free_m[best]))


def command_along(arc: Arc, robot: Robot) -> Command:
    """Along an arc as fast as what is free of it allows; STILL where that is too little."""
    share = min((arc.free_m - _STOPS_M) / _SLOWS_M, 1.0)
    if share < 0.05:
        return STILL
    v_mps = _PACE * robot.cruise_mps * share
    return Command(v_mps, arc.curvature * v_mps)


def turn_aside(free: NDArray[np.bool_], robot: Robot) -> Command:
    """On the spot, to the side where more is free."""
    half = free.shape[1] // 2
    left, right = free[:, half:].sum(), free[:, :half].sum()
    return Command(0.0, math.copysign(0.8 * robot.w_max_radps, float(left) - float(right)))


def _room(free: NDArray[np.bool_], people: Floats) -> NDArray[np.float32]:
    """Metres from each cell to the nearest that is not free, or to what is kept from a person."""
    cells = free.astype(np.uint8)
    for x, y in people:
        middle = int((y + GROUND_ASIDE_M) / GROUND_CELL_M), int(x / GROUND_CELL_M)
        cv2.circle(cells, middle, round(_PERSON_M / GROUND_CELL_M), 0, thickness=-1)
    return np.asarray(cv2.distanceTransform(cells, cv2.DIST_L2, 5) * np.float32(GROUND_CELL_M), np.float32)


def _points(curvatures: Floats) -> tuple[Floats, Floats]:
    """(arcs, steps): x and y of points along arcs from the origin, `_STEPS_M` along each."""
    turned = curvatures[:, None] * _STEPS_M
    bent = np.where(np.abs(turned) < 1e-6, 1e-6, turned)
    return _STEPS_M * np.sin(bent) / bent, _STEPS_M * (1.0 - np.cos(bent)) / bent
