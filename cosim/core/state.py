"""Frozen snapshots of the simulation that engines exchange.

Arrays are write-protected. Positions are metres in the world frame, headings radians
counter-clockwise from +x, speeds m/s.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from enum import IntEnum
from types import MappingProxyType
from typing import Any, Final, Literal

import numpy as np
from numpy.typing import NDArray

from cosim.core.geometry import Floats, Pose

PERSON_RADIUS_M = 0.3
"""Radius of every pedestrian's collision cylinder, in metres."""

Doing = Literal[
    "walk",
    "stand",
    "look",
    "talk",
    "queue",
    "stop",
    "phone",
    "sit",
    "wave",
    "call",
    "point",
    "scratch",
]
"""Activity that a pedestrian's body shows. "stop" holds out a hand; "sit" uses a seat behind the
person's position; "phone" looks at a telephone, "call" holds one to the ear; "point" points to the
side, "scratch" scratches the head."""


class PersonKind(IntEnum):
    """Origin of a person: background crowd, event, resident (`CrowdSpec.residents`) or injected."""

    CROWD = 0
    EVENT = 1
    RESIDENT = 2
    INJECTED = 3


DIRECTED: Final = (PersonKind.EVENT, PersonKind.INJECTED)
"""Kinds of people that the event director moves."""


class Age(IntEnum):
    """Age group of a person, for the looks and, in the crowd, the walking speed."""

    ADULT = 0
    CHILD = 1
    ELDERLY = 2


def write_protected_copy(
    array: Any, dtype: Any = np.float64, shape: tuple[int, ...] | None = None
) -> NDArray[Any]:
    """Return a write-protected copy of an array."""
    copy = np.array(array, dtype=dtype)
    if shape is not None:
        copy = copy.reshape(shape)
    return write_protect(copy)


def write_protect(array: NDArray[Any]) -> NDArray[Any]:
    """Write-protect an array in place and return it."""
    array.flags.writeable = False
    return array


def write_protected_float32(array: NDArray[np.floating[Any]]) -> NDArray[np.float32]:
    """Return an array as write-protected contiguous float32: in place if it is one already."""
    return write_protect(np.ascontiguousarray(array, dtype=np.float32))


@dataclass(frozen=True, slots=True)
class LegState:
    """Attitude and joints of a robot with legs.

    roll_rad, pitch_rad: of the trunk, applied before the heading; pitch is positive downwards.
    angles_rad: joint angles, in the order of `cosim.spec.robot.Legs.joints`.
    """

    roll_rad: float
    pitch_rad: float
    angles_rad: tuple[float, ...]


@dataclass(frozen=True, slots=True)
class Trunk:
    """Attitude and motion of a robot's base link in the world frame.

    rotation: rows of the matrix whose columns are the link's axes.
    velocity_mps: of the link's centre of mass.
    turn_radps: angular velocity.
    """

    rotation: tuple[
        tuple[float, float, float], tuple[float, float, float], tuple[float, float, float]
    ]
    velocity_mps: tuple[float, float, float]
    turn_radps: tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class RobotState:
    """State of the robot: pose of the base centre on the ground plane and motion of the base.

    v_mps: speed along the heading.
    w_radps: yaw rate, counter-clockwise.
    z_m: height of the base frame.
    tilt_rad: angle between the base's up axis and the vertical.
    legs: attitude and joints of a robot with legs; None for wheels.
    trunk: attitude and motion of the base link, from a physics engine; not compared.

    The speeds of a robot with legs are means over its last gait cycle.
    """

    pose: Pose
    v_mps: float = 0.0
    w_radps: float = 0.0
    z_m: float = 0.0
    tilt_rad: float = 0.0
    legs: LegState | None = None
    trunk: Trunk | None = field(default=None, compare=False, repr=False)


@dataclass(frozen=True, slots=True)
class People:
    """Pedestrians at one moment.

    ids: N unique names, independent of kind and age.
    xy: (N, 2) positions in metres.
    heading: (N,) radians.
    speed: (N,) m/s.
    strides: (N,) strides taken so far; the fraction is the phase of the gait. For pictures only.
    pace: (N,) m/s, speed that the body shows (`cosim.people.gait`). For pictures only.
    kind: (N,) int8 of `PersonKind`.
    age: (N,) int8 of `Age`.
    """

    ids: tuple[str, ...]
    xy: Floats
    heading: Floats
    speed: Floats
    doing: tuple[Doing, ...]
    strides: Floats
    pace: Floats
    kind: NDArray[np.int8]
    age: NDArray[np.int8]

    @classmethod
    def of(
        cls,
        ids: tuple[str, ...],
        xy: Any,
        heading: Any,
        speed: Any,
        doing: tuple[Doing, ...],
        strides: Any = None,
        pace: Any = None,
        kind: Any = PersonKind.CROWD,
        age: Any = Age.ADULT,
    ) -> People:
        """Return people from arrays, which are copied.

        strides: by default 0, the beginning of a stride.
        pace: by default the speed.
        kind, age: one value for all, or (N,).
        """
        n = len(ids)
        return cls(
            ids,
            write_protected_copy(xy, shape=(n, 2)),
            write_protected_copy(heading, shape=(n,)),
            write_protected_copy(speed, shape=(n,)),
            doing,
            write_protected_copy(np.zeros(n) if strides is None else strides, shape=(n,)),
            write_protected_copy(speed if pace is None else pace, shape=(n,)),
            write_protected_copy(np.broadcast_to(kind, n), np.int8),
            write_protected_copy(np.broadcast_to(age, n), np.int8),
        )

    def copied(self) -> People:
        """Return the same people with arrays of their own."""
        return People.of(*(getattr(self, column.name) for column in fields(self)))

    def are(self, kind: PersonKind, *more: PersonKind) -> NDArray[np.bool_]:
        """Return whether each person is of one of these kinds, as (N,) booleans."""
        found: NDArray[np.bool_] = self.kind == kind.value
        for other in more:
            found |= self.kind == other.value
        return found

    def only(self, rows: NDArray[np.intp]) -> People:
        """Return the people in these rows."""
        if len(rows) == len(self.ids) and (rows == np.arange(len(rows))).all():
            return self
        columns = (self.xy, self.heading, self.speed, self.strides, self.pace, self.kind, self.age)
        arrays: list[Any] = [column[rows] for column in columns]
        for array in arrays:
            array.flags.writeable = False
        xy, heading, speed, strides, pace, kind, age = arrays
        chosen = rows.tolist()
        ids, doing = tuple([self.ids[i] for i in chosen]), tuple([self.doing[i] for i in chosen])
        return People(ids, xy, heading, speed, doing, strides, pace, kind, age)

    def __len__(self) -> int:
        return len(self.ids)


@dataclass(frozen=True, slots=True)
class Vehicles:
    """Vehicles at one moment.

    xy: (N, 2) centres of the boxes in metres.
    size: (N, 2) length and width in metres.
    """

    ids: tuple[str, ...]
    xy: Floats
    heading: Floats
    speed: Floats
    size: Floats

    @classmethod
    def of(cls, ids: tuple[str, ...], xy: Any, heading: Any, speed: Any, size: Any) -> Vehicles:
        """Return vehicles from arrays, which are copied."""
        n = len(ids)
        return cls(
            ids,
            write_protected_copy(xy, shape=(n, 2)),
            write_protected_copy(heading, shape=(n,)),
            write_protected_copy(speed, shape=(n,)),
            write_protected_copy(size, shape=(n, 2)),
        )

    def __len__(self) -> int:
        return len(self.ids)


NO_PEOPLE = People.of((), [], [], [], ())
NO_VEHICLES = Vehicles.of((), [], [], [], [])


@dataclass(frozen=True, slots=True)
class Signal:
    """Crosswalk signal.

    walk: whether pedestrians may walk.
    changes_in_s: time to the next change in seconds; None if unknown or never.
    """

    walk: bool
    changes_in_s: float | None = None


@dataclass(frozen=True, slots=True)
class Street:
    """Everything at one tick that moves or changes, except the robot.

    signals: signal by crossing id, for signalised crossings near the robot. Other crossings have no
        signal.
    """

    tick: int
    people: People = NO_PEOPLE
    vehicles: Vehicles = NO_VEHICLES
    signals: Mapping[str, Signal] = field(default_factory=lambda: MappingProxyType({}))


@dataclass(frozen=True, slots=True)
class Command:
    """Command to the robot: forward speed in m/s and yaw rate in rad/s, left positive.

    >>> Command(v_mps=1.0, w_radps=-0.2)
    Command(v_mps=1.0, w_radps=-0.2)
    """

    v_mps: float
    w_radps: float


@dataclass(frozen=True, slots=True, eq=False)
class WaypointCommand(Command):
    """Command that follows one of a policy's waypoints.

    waypoints: (N, 2) float32, metres ahead and to the left of the robot at its observation; (N, 4)
        with cosine and sine of the heading there.
    index: number of the waypoint that is followed.
    """

    waypoints: NDArray[np.float32]
    index: int


STILL = Command(0.0, 0.0)
"""Command that stops the robot."""


@dataclass(frozen=True, slots=True)
class Contact:
    """Contact of the robot's body with another object.

    other: id of the object.
    substep: number of the substep in its tick, from 0.
    """

    kind: Literal["pedestrian", "vehicle", "wall", "object"]
    other: str
    substep: int


@dataclass(frozen=True, slots=True)
class Motion:
    """Result of one tick of physics.

    trace: (substeps, 3) x, y, heading of the robot after each substep.
    contacts: in order of substeps, at most one for each (substep, other).
    down: whether a robot with legs lies or is about to: its trunk touches the ground, leans by more
        than 60 degrees, or is below 0.45 of its height at rest.
    """

    robot: RobotState
    trace: Floats
    contacts: tuple[Contact, ...] = ()
    down: bool = False


@dataclass(frozen=True, slots=True)
class Frame:
    """Picture of a camera.

    rgb: (H, W, 3) uint8.
    labels: (H, W) uint8 semantic ids, see `LABELS`.
    depth: (H, W) float32 metres.
    """

    rgb: NDArray[np.uint8]
    labels: NDArray[np.uint8] | None = None
    depth: NDArray[np.float32] | None = None


LABELS: Mapping[str, int] = MappingProxyType(
    {
        "sky": 0,
        "road": 1,
        "sidewalk": 2,
        "crosswalk": 3,
        "curb": 4,
        "verge": 5,
        "ground": 6,
        "building": 7,
        "barrier": 8,
        "prop": 9,
        "person": 10,
        "vehicle": 11,
        "signal": 12,
        "robot": 13,
    }
)
"""Semantic ids of a label picture."""


@dataclass(slots=True)
class RowLookup:
    """Finds the rows of people in the previous tick's table by their ids.

    Mostly the ids are unchanged; then no search is needed.
    """

    _ids: tuple[str, ...] = ()

    def of(self, ids: tuple[str, ...]) -> tuple[NDArray[np.intp] | slice, list[int]]:
        """Return each person's row in the previous table, and the positions in `ids` of new people.

        The row of a new person is the last one of the table. If the ids are unchanged the rows are
        a slice, so that indexing makes no copy.
        """
        if ids and ids == self._ids:
            return slice(None), []
        index = {name: i for i, name in enumerate(self._ids)}
        row = [index.get(name, -1) for name in ids]
        self._ids = ids
        return np.array(row, dtype=np.intp), [i for i, k in enumerate(row) if k < 0]
