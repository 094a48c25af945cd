"""Goals of an episode: from the reference route and where the robot is to what its policy is told,
and no more.

What is drawn comes from a generator of the goals' own. Nothing here knows of people, events or the
street.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Final, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from cosim.core.geometry import Floats, Polyline, Pose, wrap_angle
from cosim.spec.goal import Goal, GoalProtocol, ImageGoal, Instruction, PointGoal, RoutePatch
from cosim.spec.scenario import RouteCrossing, Scenario

_NEAREST_M: Final = 5.0
_FARTHEST_M: Final = 20.0
_ASIDE_M: Final = 5.0
_REACHED_M: Final = 1.0
PATCH_PX: Final = 80
PATCH_M: Final = 0.5
"""Of one pixel; what lies as near to the route is on it."""
_SLACK_M: Final = 1e-6
_ARM_M: Final = 6.0
"""A turn is the angle between this much of the route before a place and this much behind it."""
_BEND_RAD: Final = math.radians(35.0)
_TURN_RAD: Final = math.radians(60.0)
_TOLD_M: Final = 20.0
"""How far ahead a turn is told, and how near it is told as due."""
_DUE_M: Final = 2.5

TakePicture = Callable[[Pose], NDArray[np.uint8]]
"""(H, W, 3) uint8: what the policy's camera would see at a pose, with nobody in the street."""


class Goals(Protocol):
    """What a policy is told, moment by moment."""

    def at(self, pose: Pose, route_s_m: float) -> Goal | None:
        """The goal for a robot at this pose, this far along the route."""

    def put_back(self) -> None:
        """The robot was put elsewhere."""


def goals_for(
    protocol: GoalProtocol,
    scenario: Scenario,
    draws: np.random.Generator,
    size: tuple[int, int] = (0, 0),
    look: TakePicture | None = None,
) -> Goals:
    """The goals of a scenario by a protocol. draws: what chance there is; size: width, height of
    the policy's pictures; look: needed by `image`."""
    route = scenario.route_line
    if protocol == "random_point":
        return _RandomPoints(draws)
    if protocol == "image":
        assert look is not None, "image goals need a camera"
        return _Images(route, look)
    if protocol == "random_image":
        noise = draws.integers(0, 256, (size[1], size[0], 3), np.uint8)
        return _Plain(lambda pose, s_m: ImageGoal(noise))
    if protocol == "route_point":
        subgoals = SubGoals(route.length_m)
        return _Plain(lambda pose, s_m: seen_from(pose, route.at(subgoals.after(s_m))))
    if protocol == "final_point":
        return _Plain(lambda pose, s_m: seen_from(pose, Pose(*scenario.goal, 0.0)))
    if protocol == "instruction":
        ways = manoeuvres(route, scenario.crossings)
        return _Plain(lambda pose, s_m: Instruction(told_at(s_m, ways)))
    if protocol == "route_patch":
        return _Plain(lambda pose, s_m: RoutePatch(patch_around(pose, route.points)))
    return _Plain(lambda pose, s_m: None)


def seen_from(pose: Pose, point: Pose) -> PointGoal:
    """A place in the frame of a robot at a pose."""
    dx, dy = point.x_m - pose.x_m, point.y_m - pose.y_m
    cos, sin = math.cos(pose.heading_rad), math.sin(pose.heading_rad)
    return PointGoal(cos * dx + sin * dy, -sin * dx + cos * dy)


class SubGoals:
    """Which place of the route is the next sub-goal: one 20 m along it, kept until no more than 5 m
    are left to it, or the robot was put back too far from it; the end of the route from 20 m before
    it.

    >>> subgoals = SubGoals(100.0)
    >>> [subgoals.after(s_m) for s_m in (0.0, 14.0, 16.0, 85.0)]
    [20.0, 20.0, 36.0, 100.0]
    """

    def __init__(self, length_m: float) -> None:
        self._length_m = length_m
        self._s_m = math.nan

    def after(self, route_s_m: float) -> float:
        """Its arc length, for a robot this far along the route."""
        if not _NEAREST_M - _SLACK_M <= self._s_m - route_s_m <= _FARTHEST_M + _SLACK_M:
            self._s_m = min(route_s_m + _FARTHEST_M, self._length_m)
        return self._s_m


class _Plain:
    """Goals that are a function of where the robot is."""

    def __init__(self, goal: Callable[[Pose, float], Goal | None]) -> None:
        self._goal = goal

    def at(self, pose: Pose, route_s_m: float) -> Goal | None:
        return self._goal(pose, route_s_m)

    def put_back(self) -> None:
        """Nothing to forget."""


class _RandomPoints:
    """Points of the paper: drawn in the robot's frame, then fixed in the street until reached, or
    no longer ahead."""

    def __init__(self, draws: np.random.Generator) -> None:
        self._draws = draws
        self._point: Pose | None = None

    def at(self, pose: Pose, route_s_m: float) -> PointGoal:
        goal = None if self._point is None else seen_from(pose, self._point)
        if goal is None or goal.distance_m <= _REACHED_M or goal.x_m <= 0.0:
            ahead, aside = self._draws.uniform(
                (_NEAREST_M, -_ASIDE_M), (_FARTHEST_M, _ASIDE_M)
            ).tolist()
            cos, sin = math.cos(pose.heading_rad), math.sin(pose.heading_rad)
            self._point = Pose(
                pose.x_m + cos * ahead - sin * aside, pose.y_m + sin * ahead + cos * aside, 0.0
            )
            goal = PointGoal(ahead, aside)
        return goal

    def put_back(self) -> None:
        self._point = None


class _Images:
    """Pictures at the sub-goals, taken when they become the next ones, looking along the route."""

    def __init__(self, route: Polyline, look: TakePicture) -> None:
        self._route = route
        self._look = look
        self._subgoals = SubGoals(route.length_m)
        self._taken_s_m = math.nan
        self._goal = ImageGoal(np.zeros((0, 0, 3), np.uint8))

    def at(self, pose: Pose, route_s_m: float) -> ImageGoal:
        s_m = self._subgoals.after(route_s_m)
        if s_m != self._taken_s_m:
            self._taken_s_m, self._goal = s_m, ImageGoal(self._look(self._route.at(s_m)))
        return self._goal

    def put_back(self) -> None:
        """The next sub-goal is looked for anew in any case."""


class Manoeuvre(NamedTuple):
    """Something to be told: from where to where on the route it is done."""

    s_m: float
    until_s_m: float
    words: str


def manoeuvres(route: Polyline, crossings: Sequence[RouteCrossing] = ()) -> tuple[Manoeuvre, ...]:
    """Turns and crosswalks of a route, in their order. A bend of less than 35 degrees within 12 m
    is none.

    >>> [(one.s_m, one.words) for one in manoeuvres(Polyline([(0, 0), (20, 0), (20, 20)]))]
    [(20.0, 'turn left')]
    """
    found = [
        Manoeuvre(one.enter_s_m, one.leave_s_m, "cross the street at the crosswalk")
        for one in crossings
    ]
    s_m = np.arange(1.0, route.length_m - 0.5)
    turns = np.array([_turn_at(route, s) for s in s_m.tolist()])
    bent = np.where(np.abs(turns) >= _BEND_RAD, np.sign(turns), 0.0)
    starts = np.flatnonzero(np.diff(bent, prepend=0.0))
    for first, last in zip(starts, [*starts, len(bent)][1:], strict=True):
        if bent[first]:
            peak = first + int(np.argmax(np.abs(turns[first:last])))
            how = "turn" if abs(turns[peak]) >= _TURN_RAD else "bear"
            side = "left" if turns[peak] > 0.0 else "right"
            found.append(Manoeuvre(float(s_m[peak]), float(s_m[peak]) + 1.0, f"{how} {side}"))
    return tuple(sorted(found))


def _turn_at(route: Polyline, s_m: float) -> float:
    """How far the route turns around a place, to the left, in radians."""
    before, here, behind = (route.at(s).xy for s in (s_m - _ARM_M, s_m, s_m + _ARM_M))
    (ax, ay) = (here - before).tolist()
    (bx, by) = (behind - here).tolist()
    return wrap_angle(math.atan2(by, bx) - math.atan2(ay, ax))


def told_at(route_s_m: float, ways: Sequence[Manoeuvre]) -> str:
    """The instruction at a place of a route: what is due there, and what comes next within 20 m, to
    5 m.

    >>> ways = manoeuvres(Polyline([(0, 0), (40, 0), (40, 20)]))
    >>> told_at(29.0, ways), told_at(39.0, ways)
    ('Follow the sidewalk. In 10 m, turn left.', 'Turn left.')
    """
    due = [one.words for one in ways if one.s_m - _DUE_M <= route_s_m < one.until_s_m]
    told = [f"{words.capitalize()}." for words in due] or ["Follow the sidewalk."]
    coming = [one for one in ways if _DUE_M < one.s_m - route_s_m <= _TOLD_M]
    if coming:
        far_m = max(5 * round((coming[0].s_m - route_s_m) / 5.0), 5)
        told.append(f"In {far_m} m, {coming[0].words}.")
    return " ".join(told)


def patch_around(pose: Pose, route: Floats) -> NDArray[np.uint8]:
    """(80, 80) uint8, as `RoutePatch` has it. route: (N, 2), its points."""
    cos, sin = math.cos(pose.heading_rad), math.sin(pose.heading_rad)
    offset = route - pose.xy
    ahead_left = offset @ np.array([[cos, -sin], [sin, cos]])
    at = (
        0.5 * (PATCH_PX - 1) - ahead_left / PATCH_M
    )  # rows and columns, whole numbers in the middle of pixels
    low = np.maximum(np.ceil(np.minimum(at[:-1], at[1:]) - 1.0), 0.0).astype(int)
    high = np.minimum(np.floor(np.maximum(at[:-1], at[1:]) + 1.0) + 1.0, PATCH_PX).astype(int)
    pixels = np.zeros((PATCH_PX, PATCH_PX), np.uint8)
    for i in np.flatnonzero((low < high).all(axis=1)).tolist():
        (top, left) = low[i]
        (bottom, right) = high[i]
        step = at[i + 1] - at[i]
        off = np.moveaxis(np.mgrid[top:bottom, left:right], 0, -1) - at[i]
        along = np.clip(off @ step / max(float(step @ step), 1e-12), 0.0, 1.0)
        off -= along[..., None] * step
        pixels[top:bottom, left:right][(off * off).sum(axis=-1) <= 1.0] = 255
    return pixels
