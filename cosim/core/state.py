"""Snapshots of a moment: frozen values that travel between the engines.

Arrays are write-protected; positions are world metres, headings radians counter-clockwise from +x,
speeds m/s.
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
"""Radius of every pedestrian's collision cylinder."""

Doing = Literal["walk", "stand", "look", "talk", "queue", "stop", "phone", "sit"]
"""What a pedestrian's body shows: walking, standing, looking around, talking, queueing, the
stopping hand, reading a phone, sitting on a seat behind the place where it is."""


class PersonKind(IntEnum):
    """Whose a person is: of the background crowd, of an event, a resident (`CrowdSpec.residents`),
    or injected."""

    CROWD = 0
    EVENT = 1
    RESIDENT = 2
    INJECTED = 3


DIRECTED: Final = (PersonKind.EVENT, PersonKind.INJECTED)
"""Whom the director of events moves."""


class Age(IntEnum):
    """How old a person looks, and in the crowd how fast it walks."""

    ADULT = 0
    CHILD = 1
    ELDERLY = 2


def write_protected(
    array: Any, dtype: Any = np.float64, shape: tuple[int, ...] | None = None
) -> NDArray[Any]:
    """A write-protected copy of `array`."""
    copy = np.array(array, dtype=dtype)
    if shape is not None:
        copy = copy.reshape(shape)
    return frozen(copy)


def frozen(array: NDArray[Any]) -> NDArray[Any]:
    """The array itself, write-protected from now on."""
    array.flags.writeable = False
    return array


@dataclass(frozen=True, slots=True)
class RobotState:
    """The robot: pose of the base centre on the ground plane, body speeds, height and tilt of the
    base.

    v_mps along the heading, w_radps counter-clockwise; z_m height of the base frame; tilt_rad angle
    between the base's up axis and the vertical.
    """

    pose: Pose
    v_mps: float = 0.0
    w_radps: float = 0.0
    z_m: float = 0.0
    tilt_rad: float = 0.0


@dataclass(frozen=True, slots=True)
class People:
    """Pedestrians of a moment. ids: N unique names; xy (N, 2) m; heading (N,) rad; speed (N,) m/s.
    A name says nothing of who has it: kind (N,) int8 of `PersonKind`, age (N,) int8 of `Age`.

    strides (N,): strides taken so far, whose fraction is the phase of the gait; pace (N,) m/s: the
    speed that the body shows, which follows the speed as one starts and stops
    (`cosim.people.gait`). Both are for pictures: nothing else reads them."""

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
        """Without strides and pace: people at the beginning of a stride, at the pace of their
        speed. kind, age: of all of them, or of each."""
        n = len(ids)
        return cls(
            ids,
            write_protected(xy, shape=(n, 2)),
            write_protected(heading, shape=(n,)),
            write_protected(speed, shape=(n,)),
            doing,
            write_protected(np.zeros(n) if strides is None else strides, shape=(n,)),
            write_protected(speed if pace is None else pace, shape=(n,)),
            write_protected(np.broadcast_to(kind, n), np.int8),
            write_protected(np.broadcast_to(age, n), np.int8),
        )

    def copied(self) -> People:
        """The same people in arrays of their own."""
        return People.of(*(getattr(self, column.name) for column in fields(self)))

    def are(self, kind: PersonKind, *more: PersonKind) -> NDArray[np.bool_]:
        """(N,) who is of one of these kinds."""
        found: NDArray[np.bool_] = self.kind == kind.value
        for other in more:
            found |= self.kind == other.value
        return found

    def only(self, rows: NDArray[np.intp]) -> People:
        """Those in these rows."""
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
    """Vehicles of a moment. xy (N, 2) m is the centre of the box; size (N, 2) m is length,
    width."""

    ids: tuple[str, ...]
    xy: Floats
    heading: Floats
    speed: Floats
    size: Floats

    @classmethod
    def of(cls, ids: tuple[str, ...], xy: Any, heading: Any, speed: Any, size: Any) -> Vehicles:
        n = len(ids)
        return cls(
            ids,
            write_protected(xy, shape=(n, 2)),
            write_protected(heading, shape=(n,)),
            write_protected(speed, shape=(n,)),
            write_protected(size, shape=(n, 2)),
        )

    def __len__(self) -> int:
        return len(self.ids)


NOBODY = People.of((), [], [], [], ())
NO_VEHICLES = Vehicles.of((), [], [], [], [])


@dataclass(frozen=True, slots=True)
class Signal:
    """A crosswalk signal: may one walk, and in how many seconds does that change (None: unknown or
    never)."""

    walk: bool
    changes_in_s: float | None = None


@dataclass(frozen=True, slots=True)
class Street:
    """Everything that moves or changes but the robot, at one tick.

    signals: crossing id -> Signal, for the signalised crossings near the robot; a crossing that is
    absent has no signal.
    """

    tick: int
    people: People = NOBODY
    vehicles: Vehicles = NO_VEHICLES
    signals: Mapping[str, Signal] = field(default_factory=lambda: MappingProxyType({}))


@dataclass(frozen=True, slots=True)
class Command:
    """What the robot is told: forward speed in m/s and yaw rate in rad/s, left positive.

    >>> Command(v_mps=1.0, w_radps=-0.2)
    Command(v_mps=1.0, w_radps=-0.2)
    """

    v_mps: float
    w_radps: float


@dataclass(frozen=True, slots=True, eq=False)
class Planned(Command):
    """The command that follows one of waypoints, with these.

    waypoints: (N, 2) float32, x ahead and y left of the robot at its observation, metres; (N, 4)
    with the cosine and the sine of the heading there. index: which one is followed.
    """

    waypoints: NDArray[np.float32]
    index: int


STILL = Command(0.0, 0.0)


@dataclass(frozen=True, slots=True)
class Contact:
    """The robot's body touched something. other: the thing's id; substep: of the tick, from 0."""

    kind: Literal["pedestrian", "vehicle", "wall", "object"]
    other: str
    substep: int


@dataclass(frozen=True, slots=True)
class Motion:
    """What one tick of physics did.

    trace: (substeps, 3) x, y, heading of the robot after each substep. contacts: in order of
    substeps, at most one for each (substep, other).
    """

    robot: RobotState
    trace: Floats
    contacts: tuple[Contact, ...] = ()


@dataclass(frozen=True, slots=True)
class Frame:
    """What a camera saw. rgb (H, W, 3) uint8; labels (H, W) uint8 semantic ids; depth (H, W)
    float32 metres."""

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
"""Semantic ids of a camera's label picture."""


_SAME = slice(None)


@dataclass(slots=True)
class RowLookup:
    """Remembers the names of the last moment. Mostly they are the same: then all rows of that
    moment are told."""

    _ids: tuple[str, ...] = ()

    def of(self, ids: tuple[str, ...]) -> tuple[NDArray[np.intp] | slice, list[int]]:
        """Which rows of the last moment's table are those of `ids`, the last row for who was not
        there; and the places in `ids` of those who were not. Where all were there and are, the rows
        are the whole table, not a copy."""
        if ids and ids == self._ids:
            return _SAME, []
        index = {name: i for i, name in enumerate(self._ids)}
        row = [index.get(name, -1) for name in ids]
        self._ids = ids
        return np.array(row, dtype=np.intp), [i for i, k in enumerate(row) if k < 0]
