"""Nobody walks into the robot: how a shown person steps round it.

SUMO's walkers see the robot as stripes, and at the edge of a crossing or corner they sometimes walk through it. The
shown person goes where SUMO has it, but slides round the robot's outline instead of entering it. Only the person's
own motion is changed: a robot that drives at somebody still hits them.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from cosim.geometry import Floats, Pose
from cosim.state import PERSON_RADIUS_M

KEEP_M = 0.12
"""Gap between a person's disk and the robot's outline at which the person begins to step round."""


class Body(NamedTuple):
    """The robot as people see it: its pose, and half its length and width in metres."""

    pose: Pose
    half_m: tuple[float, float]


def stepped_round(before: Floats, wanted: Floats, robot: Pose, half_m: tuple[float, float]) -> Floats:
    """Where people go who want to go from `before` to `wanted`, (N, 2) metres each, near a robot.

    half_m: half length and half width of the robot. A step towards the robot from nearer than KEEP_M loses its
    inward part; its length goes into the way round: to the side on which the step would pass the robot's centre.
    That choice strengthens itself, so nobody dithers.
    """
    c, s = np.cos(robot.heading_rad), np.sin(robot.heading_rad)
    turn = np.array([[c, -s], [s, c]])
    limit = np.array(half_m)
    near = (wanted - robot.xy) @ turn
    gap = np.hypot(*np.maximum(np.abs(near) - limit, 0.0).T) - PERSON_RADIUS_M
    if not (gap < KEEP_M).any():
        return wanted
    local = (before - robot.xy) @ turn
    out = local - np.clip(local, -limit, limit)
    far = np.hypot(out[:, 0], out[:, 1])
    normal = out / np.maximum(far, 1e-9)[:, None]
    step = near - local
    inward = -(step * normal).sum(axis=1)
    tangent = np.column_stack([-normal[:, 1], normal[:, 0]])
    about = local[:, 0] * step[:, 1] - local[:, 1] * step[:, 0]
    side = np.where(about >= 0.0, 1.0, -1.0)
    around = tangent * (side * np.hypot(step[:, 0], step[:, 1]))[:, None]
    slides = (gap < KEEP_M) & (inward > 0.0) & (far > 1e-6)
    moved = np.where(slides[:, None], local + around, near)
    rounded: Floats = moved @ turn.T + robot.xy
    return rounded
