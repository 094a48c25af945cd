"""PoseFilter: the poses shown of people whose simulated positions sometimes jump.

SUMO's striping model moves a person by up to metres in one step where strips and corners meet, and flips its angle
on a sidestep. The shown person walks to where SUMO has it, no faster than a brisk walk, and turns like a body; on
the way it keeps out of others and of the robot.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from cosim.geometry import Floats, wrap_angles
from cosim.giveway import Body, stepped_round
from sumo_nets.apart import kept_apart

MAX_SPEED_MPS = 2.2
"""The fastest a shown person moves: above every walking speed, so that it catches up."""

MAX_TURN_RADPS = math.pi
"""The fastest a shown person turns."""

LOOK_AHEAD_S = 0.3
"""Time constant of the motion that the heading follows: a sidestep is over before the body has turned."""

TURNING_SPEED_MPS = 0.3
"""Below this the motion says nothing about where somebody faces."""

NOBODY_ELSE: Floats = np.zeros((0, 2))


@dataclass(slots=True)
class PoseFilter:
    """Remembers the shown poses of everybody; `update` moves them one period of `period_s` on."""

    period_s: float
    _index: dict[str, int] = field(default_factory=dict)
    _xy: Floats = field(default_factory=lambda: np.zeros((1, 2)))
    _heading: Floats = field(default_factory=lambda: np.zeros(1))
    _motion: Floats = field(default_factory=lambda: np.zeros((1, 2)))

    def update(
        self,
        ids: tuple[str, ...],
        xy: Floats,
        heading: Floats,
        speed: Floats,
        body: Body | None = None,
        others: Floats = NOBODY_ELSE,
    ) -> tuple[Floats, Floats, Floats]:
        """The shown positions (N, 2) m, headings (N,) rad and speeds (N,) m/s, given the simulated ones.

        Who is new is shown as simulated; who is missing is forgotten. body: the robot, round which people step.
        others (K, 2) m: people who are moved by somebody else.
        """
        row = np.array([self._index.get(name, -1) for name in ids], dtype=np.intp)
        known = row >= 0
        simulated = speed[:, None] * np.column_stack([np.cos(heading), np.sin(heading)])
        before = np.where(known[:, None], self._xy[row], xy)
        facing = np.where(known, self._heading[row], heading)
        motion = np.where(known[:, None], self._motion[row], simulated)

        gap = xy - before
        distance = np.hypot(gap[:, 0], gap[:, 1])
        reach_m = MAX_SPEED_MPS * self.period_s
        shown = before + gap * (reach_m / np.maximum(distance, reach_m))[:, None]
        shown = self._apart(before, shown, others)
        if body is not None:
            shown = stepped_round(before, shown, body)
        velocity = np.where(known[:, None], (shown - before) / self.period_s, simulated)
        motion = motion + (velocity - motion) * min(self.period_s / LOOK_AHEAD_S, 1.0)

        moving = np.hypot(motion[:, 0], motion[:, 1]) > TURNING_SPEED_MPS
        aim = np.where(moving, np.arctan2(motion[:, 1], motion[:, 0]), facing)
        turn_rad = MAX_TURN_RADPS * self.period_s
        facing = wrap_angles(facing + np.clip(wrap_angles(aim - facing), -turn_rad, turn_rad))

        if ids:
            self._xy, self._heading, self._motion = shown, facing, motion
        self._index = {name: i for i, name in enumerate(ids)}
        return shown, facing, np.hypot(velocity[:, 0], velocity[:, 1])

    def _apart(self, before: Floats, shown: Floats, others: Floats) -> Floats:
        firm = np.arange(len(shown) + len(others)) >= len(shown)
        before, wanted = np.concatenate([before, others]), np.concatenate([shown, others])
        return kept_apart(before, wanted, firm, MAX_SPEED_MPS * self.period_s)[: len(shown)]
