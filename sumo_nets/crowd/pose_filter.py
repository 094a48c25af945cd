"""PoseFilter: the poses shown of people whose simulated positions sometimes jump.

SUMO's striping model moves a person by up to metres in one step where strips and corners meet, and
flips its angle on a sidestep. The shown person walks to where SUMO has it, no faster than a brisk
walk, and turns like a body; on the way it keeps out of others and of the robot.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from cosim.core.geometry import Floats, wrap_angles
from cosim.core.state import RowLookup
from cosim.people.yielding import RobotBody, Standing, comes_too_near, stepped_round
from sumo_nets.crowd.separation import NearPairs, kept_apart

MAX_SPEED_MPS = 2.2
"""The fastest a shown person moves: above every walking speed, so that it catches up."""

MAX_TURN_RADPS = math.pi
"""The fastest a shown person turns."""

LOOK_AHEAD_S = 0.3
"""Time constant of the motion that the heading follows: a sidestep is over before the body has
turned."""

TURNING_SPEED_MPS = 0.3
"""Below this the motion says nothing about where somebody faces."""

PERSON_STANDS_MPS = 0.1
"""Below this SUMO's person stands."""

NOBODY_ELSE: Floats = np.zeros((0, 2))


@dataclass(slots=True)
class PoseFilter:
    """Remembers the shown poses of everybody; `update` moves them one period of `period_s` on.
    standing: what people step round besides the robot."""

    period_s: float
    standing: Standing = field(default_factory=Standing)
    _rows: RowLookup = field(default_factory=RowLookup)
    _xy: Floats = field(default_factory=lambda: np.zeros((1, 2)))
    _heading: Floats = field(default_factory=lambda: np.zeros(1))
    _motion: Floats = field(default_factory=lambda: np.zeros((1, 2)))
    _near: NearPairs = field(default_factory=NearPairs)

    def update(
        self,
        ids: tuple[str, ...],
        xy: Floats,
        speed: Floats,
        facing_of: Callable[[str], float],
        body: RobotBody | None = None,
        others: Floats = NOBODY_ELSE,
    ) -> tuple[Floats, Floats, Floats]:
        """The shown positions (N, 2) m, headings (N,) rad and speeds (N,) m/s, given the simulated
        ones.

        Who is new is shown as simulated, facing as `facing_of` says; who is missing is forgotten.
        body: the robot, round which people step. others (K, 2) m: people who are moved by somebody
        else.
        """
        row, new = self._rows.of(ids)
        before, facing, motion = self._xy[row], self._heading[row], self._motion[row]
        if new:
            before[new] = xy[new]
            facing[new] = [facing_of(ids[i]) for i in new]
            motion[new] = speed[new, None] * np.column_stack(
                [np.cos(facing[new]), np.sin(facing[new])]
            )
        simulated = motion[new]

        gap = xy - before
        distance = np.hypot(gap[:, 0], gap[:, 1])
        reach_m = MAX_SPEED_MPS * self.period_s
        shown = before + gap * (reach_m / np.maximum(distance, reach_m))[:, None]
        stand = speed < PERSON_STANDS_MPS
        shown = self._apart(before, shown, others, stand)
        shown = self._round(before, shown, body, stand)
        velocity = (shown - before) / self.period_s
        velocity[new] = simulated
        motion = motion + (velocity - motion) * min(self.period_s / LOOK_AHEAD_S, 1.0)

        moving = np.hypot(motion[:, 0], motion[:, 1]) > TURNING_SPEED_MPS
        aim = np.where(moving, np.arctan2(motion[:, 1], motion[:, 0]), facing)
        turn_rad = MAX_TURN_RADPS * self.period_s
        turn = np.minimum(np.maximum(wrap_angles(aim - facing), -turn_rad), turn_rad)
        facing = wrap_angles(facing + turn)

        if ids:
            self._xy = shown
            self._heading = facing
            self._motion = motion
        return shown, facing, np.hypot(velocity[:, 0], velocity[:, 1])

    def _round(
        self, before: Floats, shown: Floats, body: RobotBody | None, stand: NDArray[np.bool_]
    ) -> Floats:
        """Round the robot and what stands; who would step round that into the robot stays where it
        is."""
        if body is None:
            return self.standing.stepped_round(before, shown, stand)
        past = stepped_round(before, shown, body, stand)
        round_both = self.standing.stepped_round(before, past, stand)
        stays = (round_both != past).any(axis=1) & comes_too_near(before, round_both, body)
        return np.where(stays[:, None], before, round_both)

    def _apart(
        self, before: Floats, shown: Floats, others: Floats, stand: NDArray[np.bool_]
    ) -> Floats:
        firm = np.arange(len(shown) + len(others)) >= len(shown)
        stand = np.concatenate([stand, np.zeros(len(others), dtype=bool)])
        before, wanted = np.concatenate([before, others]), np.concatenate([shown, others])
        return kept_apart(before, wanted, firm, MAX_SPEED_MPS * self.period_s, stand, self._near)[
            : len(shown)
        ]
