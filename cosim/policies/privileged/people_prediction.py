"""Prediction of people near the robot: gaps of plans, and yielding.

People are predicted at constant velocity. In addition, people nearby may stop, and people walking
in the robot's direction may slow down. For a person who walks straight at the robot, or crosses on
a collision course, the robot stops until they have passed.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np
from numpy.typing import NDArray

from cosim.core.geometry import Floats, wrap_angles
from cosim.core.state import DIRECTED, PERSON_RADIUS_M, People
from cosim.episode.interfaces import Privileged
from cosim.policies.body_disks import BodyDisks
from cosim.policies.privileged.rollout import STEP_TIMES_S, Rollout
from cosim.policies.privileged.standing_groups import distances, is_standing
from cosim.spec.robot import Robot

_FOLLOWED: Final = 0.6
"""Predicted fraction of the speed of people walking ahead in the robot's direction."""
_LATER_M_PER_S: Final = 0.04
"""Reduction of the required gap per second of prediction, because predictions are uncertain."""
_REACH_M: Final = 0.3
"""Margin in metres of the distance at which people are considered."""
_NEAR_M: Final = 1.5
"""Metres within which people are also predicted to stand still or step aside."""
_SOON: Final = 4
"""Number of steps for which that prediction is used."""
_DARTS_M: Final = 0.15
"""Length in metres of the step aside."""
_COMES_M: Final = 3.3
"""Metres within which the robot yields to people of events who walk at it. Stopping farther away
gains nothing: they wait, too. The crowd would wait anyway."""
_CROSSES_M: Final = 2.0
"""Metres ahead within which it yields to people of events who cross."""
_PASSES_M: Final = 4.5
"""Metres within which it keeps waiting for them to pass."""
_MET_STANDING_M: Final = 2.4
"""Metres beyond which people who stand wait for the robot to come nearer."""
_STAND_S: Final = 4.6
"""Seconds that a person stands before the robot stops waiting: longer than people's patience."""
_COMES_RAD: Final = 0.12
"""Heading error in radians below which a person walks straight at the robot."""
_SIDEWAYS: Final = 0.7
"""Lateral fraction of the speed above which a person crosses."""
_MET_M: Final = 0.6
"""Smallest passing distance in metres below which a crossing person is on a collision course."""
_LEAVES_RAD: Final = 1.7
"""Heading error in radians above which a person walks away."""
_PAST_M: Final = 1.4
"""Distance in metres up to which a person that walks away may still turn back to the robot."""
_WAITS_S: Final = 10.0
"""Longest wait in seconds in one place."""
_SAME_PLACE_M: Final = 0.5
"""Metres within which the robot is in the same place."""


def predicted_velocities(people: People) -> Floats:
    """Return (N, 2) velocities in m/s; zero for standing people."""
    speed = np.where(is_standing(people), 0.0, people.speed)
    velocity: Floats = speed[:, None] * np.column_stack(
        [np.cos(people.heading), np.sin(people.heading)]
    )
    return velocity


def _followed(known: Privileged, people: People) -> Floats:
    """Return `predicted_velocities` with people slowed that walk ahead in the robot's direction."""
    pose = known.robot.pose
    velocity = predicted_velocities(people)
    forward = np.array([math.cos(pose.heading_rad), math.sin(pose.heading_rad)])
    same = ((people.xy - pose.xy) @ forward > 0.3) & (velocity @ forward > 0.7 * people.speed)
    slower: Floats = np.where(same[:, None], _FOLLOWED * velocity, velocity)
    return slower


def gaps_to_people(
    known: Privileged, robot: Robot, ahead: Rollout, people: People, ends: Floats
) -> Floats:
    """Return (K,) in metres: the smallest gap of each plan between the body and people.

    ends: (M, 2, 2) lines of standing people.
    """
    here = known.robot.pose.xy
    disks = BodyDisks.of(robot)
    moving = ~is_standing(people)
    xy = people.xy[moving] + STEP_TIMES_S[:, None, None] * _followed(known, people)[moving]
    reach_m = disks.around_m + PERSON_RADIUS_M + _REACH_M + robot.cruise_mps * STEP_TIMES_S
    xy = xy[:, (np.linalg.norm(xy - here, axis=-1) < reach_m[:, None]).any(axis=0)]
    near = people.xy[moving & (np.hypot(*(people.xy - here).T) < _NEAR_M)]
    ends = ends[distances(here, ends) < reach_m[-1]]
    squared = np.full(ahead.s_m.shape, np.inf)
    for x, y in bodies(ahead, disks):
        if xy.shape[1]:
            squared = np.minimum(squared, _squared(xy[:, None], x, y))
        if len(near):
            beside = np.maximum(np.sqrt(_squared(near, x[:_SOON], y[:_SOON])) - _DARTS_M, 0.0)
            squared[:_SOON] = np.minimum(squared[:_SOON], beside**2)
        if len(ends):
            squared = np.minimum(
                squared, distances(np.stack([x, y], axis=-1), ends).min(axis=-1) ** 2
            )
    gaps: Floats = np.sqrt(squared) - PERSON_RADIUS_M - disks.radius_m
    least: Floats = (gaps + _LATER_M_PER_S * STEP_TIMES_S[:, None]).min(axis=0)
    return least


def _squared(people: Floats, x: Floats, y: Floats) -> Floats:
    """Return (T, K) squared distances in m^2 from points (T, K) to the nearest of (..., N, 2)."""
    dx, dy = people[..., 0] - x[..., None], people[..., 1] - y[..., None]
    return np.asarray((dx * dx + dy * dy).min(axis=-1))


def bodies(ahead: Rollout, disks: BodyDisks) -> tuple[tuple[Floats, Floats], tuple[Floats, Floats]]:
    """Return x and y, (STEPS, K) each in metres, of the centres of both body disks."""
    x, y, heading = ahead.pose[:, 0], ahead.pose[:, 1], ahead.pose[:, 2]
    nose_x, nose_y = disks.nose_m * np.cos(heading), disks.nose_m * np.sin(heading)
    return (x + nose_x, y + nose_y), (x - nose_x, y - nose_y)


def _crosses(known: Privileged, offset: Floats) -> NDArray[np.bool_]:
    """Return (N,) whether a person crosses on a collision course at constant velocity."""
    pose = known.robot.pose
    people = known.people
    forward = np.array([math.cos(pose.heading_rad), math.sin(pose.heading_rad)])
    velocity = predicted_velocities(people)
    sideways = np.abs(velocity @ [-forward[1], forward[0]]) > _SIDEWAYS * people.speed
    closing = velocity - known.robot.v_mps * forward
    speed = np.maximum(np.hypot(closing[:, 0], closing[:, 1]), 1e-6)
    missed_m = np.abs(offset[:, 0] * closing[:, 1] - offset[:, 1] * closing[:, 0]) / speed
    met: NDArray[np.bool_] = sideways & ((offset * closing).sum(axis=1) < 0.0) & (missed_m < _MET_M)
    return met


class Yielding:
    """Tracks people the robot yields to, from their approach until they have passed.

    The robot waits at most _WAITS_S in one place.
    """

    def __init__(self) -> None:
        self._for: set[str] = set()
        self._stood_since: dict[str, float] = {}
        self._at = (math.inf, math.inf)
        self._since_s = 0.0

    def waits(self, known: Privileged, time_s: float) -> bool:
        """Return whether the robot has to wait now."""
        pose = known.robot.pose
        people = known.people
        offset = people.xy - pose.xy
        far = np.hypot(offset[:, 0], offset[:, 1])
        cos, sin = math.cos(pose.heading_rad), math.sin(pose.heading_rad)
        off = np.abs(wrap_angles(people.heading - np.arctan2(-offset[:, 1], -offset[:, 0])))
        ahead = offset @ [cos, sin]
        comes = (off < _COMES_RAD) & (far < _COMES_M)
        comes |= _crosses(known, offset) & (ahead < _CROSSES_M)
        comes &= people.are(*DIRECTED) & ~is_standing(people) & (ahead > 0.5 * far)
        passing = (far < _PASSES_M) & (ahead > -_PAST_M)
        passing &= (off < _LEAVES_RAD) | (far < _PAST_M)
        still = is_standing(people)
        self._stood_since = {
            people.ids[row]: self._stood_since.get(people.ids[row], time_s)
            for row in np.flatnonzero(still)
        }
        stays = np.array([time_s - self._stood_since.get(one, time_s) for one in people.ids])
        passing &= ~still | ((far < _MET_STANDING_M) & (stays < _STAND_S))
        if math.dist(self._at, pose[:2]) > _SAME_PLACE_M:
            self._at = pose[:2]
            self._since_s = time_s
        self._for.update(people.ids[row] for row in np.flatnonzero(comes))
        waits = any(people.ids[row] in self._for for row in np.flatnonzero(passing))
        return waits and time_s - self._since_s < _WAITS_S
