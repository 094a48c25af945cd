"""Displayed pedestrians: filtered poses of SUMO's crowd, and event pedestrians."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Final

import numpy as np
from numpy.typing import NDArray

from cosim.core.errors import EngineError
from cosim.core.geometry import Floats, wrap_angles
from cosim.core.state import (
    Age,
    Doing,
    People,
    PersonKind,
    RowLookup,
    write_protect,
    write_protected_copy,
)
from cosim.people.gait import Strides
from cosim.people.yielding import (
    ROBOT_STANDS_MPS,
    RobotBody,
    StandingObstacles,
    approaches_body,
    stepped_around,
)
from cosim.spec.events import Actor
from sumo_nets.crowd.separation import NearPairs, separated_positions

MAX_SPEED_MPS = 2.2
"""Largest displayed speed, m/s: above every walking speed, so that people catch up with SUMO."""

MAX_TURN_RADPS = math.pi
"""Largest displayed turn rate, rad/s."""

LOOK_AHEAD_S = 0.3
"""Time constant of the motion that the heading follows, seconds; short side steps do not turn
the body."""

TURNING_SPEED_MPS = 0.3
"""Below this speed the motion does not change the heading, m/s."""

PERSON_STANDS_MPS = 0.1
"""Below this speed a SUMO person is standing, m/s."""

_NO_POINTS: Final = np.zeros((0, 2))


@dataclass(slots=True)
class PoseFilter:
    """Filter of the displayed poses, updated every `period_s` seconds.

    SUMO's striping model moves a person by metres in one step where strips and corners meet, and
    flips its angle on side steps. The displayed person follows at a limited speed and turn rate,
    and avoids others and the robot.

    obstacles: obstacles, besides the robot, that people step around.
    """

    period_s: float
    obstacles: StandingObstacles = field(default_factory=StandingObstacles)
    _rows: RowLookup = field(default_factory=RowLookup)
    _xy: Floats = field(default_factory=lambda: np.zeros((1, 2)))
    _heading: Floats = field(default_factory=lambda: np.zeros(1))
    _motion: Floats = field(default_factory=lambda: np.zeros((1, 2)))
    _near: NearPairs = field(default_factory=NearPairs)
    _unyielding: NDArray[np.bool_] = field(default_factory=lambda: np.zeros(0, dtype=bool))
    _others: int = 0

    def update(
        self,
        ids: tuple[str, ...],
        xy: Floats,
        speed: Floats,
        facing_of: Callable[[str], float],
        body: RobotBody | None = None,
        others: Floats = _NO_POINTS,
    ) -> tuple[Floats, Floats, Floats]:
        """Return the displayed positions (N, 2) m, headings (N,) rad and speeds (N,) m/s.

        ids, xy, speed: the simulated people. New ones are displayed as simulated; missing ones are
            dropped.
        facing_of: initial heading of a new person, rad.
        body: the robot, which people step around.
        others: (K, 2) positions of people that are moved elsewhere, metres.
        """
        row, new = self._rows.of(ids)
        before, facing, motion = self._xy, self._heading, self._motion
        if not isinstance(row, slice):
            before, facing, motion = before[row], facing[row], motion[row]
        if new:
            before[new] = xy[new]
            facing[new] = [facing_of(ids[i]) for i in new]
            motion[new] = speed[new, None] * np.column_stack(
                [np.cos(facing[new]), np.sin(facing[new])]
            )

        gap = xy - before
        distance = np.hypot(gap[:, 0], gap[:, 1])
        reach_m = MAX_SPEED_MPS * self.period_s
        gap *= (reach_m / np.maximum(distance, reach_m))[:, None]
        shown = before + gap
        standing = speed < PERSON_STANDS_MPS
        shown = self._separated(before, shown, others, standing)
        shown = self._around_obstacles(before, shown, body, standing)
        velocity = shown - before
        velocity /= self.period_s
        if new:
            velocity[new] = motion[new]
        change = velocity - motion
        change *= min(self.period_s / LOOK_AHEAD_S, 1.0)
        motion = motion + change

        east, north = motion[:, 0], motion[:, 1]
        moving = np.hypot(east, north) > TURNING_SPEED_MPS
        aim = np.where(moving, np.arctan2(north, east), facing)
        turn_rad = MAX_TURN_RADPS * self.period_s
        turn = np.minimum(np.maximum(wrap_angles(aim - facing), -turn_rad), turn_rad)
        turn += facing
        facing = wrap_angles(turn)

        if ids:
            self._xy = shown
            self._heading = facing
            self._motion = motion
        return shown, facing, np.hypot(velocity[:, 0], velocity[:, 1])

    def _around_obstacles(
        self, before: Floats, shown: Floats, body: RobotBody | None, standing: NDArray[np.bool_]
    ) -> Floats:
        """Step around the robot and obstacles.

        People do not move if stepping around an obstacle leads into a robot that drives. A robot
        that stands without room beside an obstacle is passed on its other side.
        """
        if body is None:
            return self.obstacles.stepped_around(before, shown, standing)
        if abs(body.v_mps) < ROBOT_STANDS_MPS:
            past = self.obstacles.stepped_around(before, shown, standing)
            return stepped_around(before, past, self.obstacles.closing(body), standing)
        past = stepped_around(before, shown, body, standing)
        round_both = self.obstacles.stepped_around(before, past, standing)
        if round_both is past:
            return past
        nearer = approaches_body(before, round_both, body)
        if not nearer.any():
            return round_both
        stays = (round_both != past).any(axis=1) & nearer
        return np.where(stays[:, None], before, round_both)

    def _separated(
        self, before: Floats, shown: Floats, others: Floats, standing: NDArray[np.bool_]
    ) -> Floats:
        """Keep people apart.

        others: (K, 2) positions of people who do not give way, metres.
        """
        count = len(shown)
        if len(self._unyielding) != count + len(others) or len(others) != self._others:
            self._others = len(others)
            self._unyielding = np.arange(count + len(others)) >= count
        preferred = np.concatenate([shown, others]) if len(others) else shown
        pairs = self._near.of(preferred, self._unyielding)
        if not len(pairs[0]):
            return shown
        before = np.concatenate([before, others])
        standing = np.concatenate([standing, np.zeros(len(others), dtype=bool)])
        reach_m = MAX_SPEED_MPS * self.period_s
        return separated_positions(before, preferred, self._unyielding, reach_m, standing, pairs)[
            :count
        ]


_NO_VALUES: Final = np.zeros(0)


class ShownPeople:
    """Merges crowd and event pedestrians into one value per tick of `tick_s`, and counts their
    strides."""

    def __init__(self, tick_s: float) -> None:
        self._strides = Strides(tick_s)
        self._identities: tuple[tuple[str, ...], list[tuple[str, PersonKind, Age]]] | None = None
        self._walk = b""
        self._doing: tuple[Doing, ...] = ()

    def merged(
        self,
        actors: list[Actor],
        ages: Mapping[str, Age],
        names: tuple[str, ...] = (),
        xy: Floats = _NO_POINTS,
        heading: Floats = _NO_VALUES,
        speed: Floats = _NO_VALUES,
    ) -> People:
        """Return crowd and event pedestrians as one value.

        actors: the event pedestrians.
        ages: ages of the crowd.
        names, xy, heading, speed: the crowd's N members; (N, 2) metres, (N,) radians, (N,) m/s.
        """
        if (names, identities := [(a.id, a.kind, a.age) for a in actors]) != self._identities:
            self._identities = names, identities
            self._names = (*names, *(a.id for a in actors))
            kinds = [*[PersonKind.CROWD] * len(xy), *(a.kind for a in actors)]
            all_ages = [*(ages[name] for name in names), *(a.age for a in actors)]
            self._kind = write_protected_copy(kinds, np.int8)
            self._age = write_protected_copy(all_ages, np.int8)
        if (walk := (speed > PERSON_STANDS_MPS).tobytes()) != self._walk:
            self._walk = walk
            self._doing = tuple(map(_DOING.__getitem__, walk))
        doing, paces = self._doing, speed
        if actors:
            doing += tuple([a.doing for a in actors])
            added = np.array([_columns(a) for a in actors])
            xy = np.concatenate([xy, added[:, :2]])
            heading = np.concatenate([heading, added[:, 2]])
            paces = np.concatenate([speed, added[:, 4]])
            speed = np.concatenate([speed, added[:, 3]])
        strides, paces = self._strides.update(self._names, xy, paces, self._age)
        return People(
            self._names,
            write_protect(xy),
            write_protect(heading),
            write_protect(speed),
            doing,
            write_protect(strides),
            write_protect(paces),
            self._kind,
            self._age,
        )


_DOING: Final[tuple[Doing, Doing]] = ("stand", "walk")
"""Activity of a member of the crowd by whether it walks."""


def _columns(one: Actor) -> tuple[float, float, float, float, float]:
    """Return position, heading, speed and shown pace of an event pedestrian."""
    pace_mps = one.speed_mps if one.pace_mps is None else one.pace_mps
    return one.x_m, one.y_m, one.heading_rad, one.speed_mps, pace_mps


def sorted_actors(actors: tuple[Actor, ...], crowd: Mapping[str, Age]) -> list[Actor]:
    """Return actors sorted by id. Raises EngineError for duplicate ids, also with the crowd's."""
    ids = {actor.id for actor in actors}
    if len(ids) != len(actors) or not crowd.keys().isdisjoint(ids):
        raise EngineError(
            f"actors need unique ids, and none of the crowd's: {[a.id for a in actors]}"
        )
    return sorted(actors, key=lambda actor: actor.id)


def positions_of(actors: list[Actor]) -> Floats:
    """Return the positions of actors, (N, 2) metres."""
    return np.array([(a.x_m, a.y_m) for a in actors], dtype=float).reshape(-1, 2)
