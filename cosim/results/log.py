"""Per-tick log of an episode as arrays: `trajectory.npz`."""

from __future__ import annotations

import io
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields
from functools import cached_property
from pathlib import Path
from types import MappingProxyType
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from cosim.core.errors import RunError
from cosim.core.geometry import Floats, Pose, box_disk_gap
from cosim.core.npz import npz_names, read_npz
from cosim.core.state import PERSON_RADIUS_M, LegState, People, RobotState
from cosim.episode.loop import Step
from cosim.results.referee import Verdict
from cosim.results.traffic import RoadState
from cosim.spec.robot import Legs, robot_called

_PLAN_ARRAYS = {"plan_sizes", "plan_points", "plan_index"}
_OPTIONAL = {"answers", "legs"} | _PLAN_ARRAYS
"""Arrays that older files lack."""
_PEOPLE_WIDTHS = {"people_tick": 0, "people_xy": 2, "people_kind": 0, "people_age": 0}
"""Number of columns of each array with one row per person; 0 for a one-dimensional array."""
_SLOWEST_MPS: Final = 1e-9
_TRUNK_COLUMNS: Final = 4
"""Number of columns of `Log.legs` before the joint angles."""
VARIES: Final = -1
"""Width of a column whose number of values differs between robots."""


class Nearness(NamedTuple):
    """Least values over all people, inf without people.

    person_m: distance between centres
    clearance_m: gap between the robot's outline and a person's disk, at least 0
    collision_in_s: time to collision at constant velocities, inf without one
    """

    person_m: float = np.inf
    clearance_m: float = np.inf
    collision_in_s: float = np.inf


def nearness(robot: RobotState, people: People, footprint_m: tuple[float, float]) -> Nearness:
    """Return the proximity of people to a robot of this length and width, metres."""
    if not len(people):
        return Nearness()
    to = people.xy - robot.pose[:2]
    away_m = np.hypot(to[:, 0], to[:, 1])
    least_m = float(away_m.min())
    # A gap is at most the centre distance, and smaller by at most half the diagonal of the robot.
    close = people.xy[away_m <= least_m + 0.5 * np.hypot(*footprint_m)]
    half_length_m, half_width_m = 0.5 * footprint_m[0], 0.5 * footprint_m[1]
    gap_m = float(
        box_disk_gap(np.array([robot.pose]), half_length_m, half_width_m, close[None]).min()
    )
    heading = robot.pose.heading_rad
    v_mps = robot.v_mps
    closing = np.empty_like(to)
    closing[:, 0] = people.speed * np.cos(people.heading) - v_mps * np.cos(heading)
    closing[:, 1] = people.speed * np.sin(people.heading) - v_mps * np.sin(heading)
    in_s = time_to_collision_s(to, closing, half_length_m + PERSON_RADIUS_M)
    return Nearness(least_m, max(gap_m - PERSON_RADIUS_M, 0.0), float(in_s.min()))


def time_to_collision_s(offset: Floats, velocity: Floats, radius_m: float) -> Floats:
    """Return the time in seconds (N,) until points come within a radius of the origin.

    offset: positions (N, 2), metres
    velocity: velocities (N, 2), m/s

    A point already inside gets 0, a point that never comes inside inf.
    """
    x_m, y_m = offset.T
    vx_mps, vy_mps = velocity.T
    speed2 = vx_mps * vx_mps + vy_mps * vy_mps
    along = x_m * vx_mps + y_m * vy_mps
    outside = x_m * x_m + y_m * y_m - radius_m**2
    root2 = along * along - speed2 * outside
    meets = (along < -_SLOWEST_MPS) & (root2 >= 0.0)
    in_s = np.full(len(offset), np.inf)
    in_s[meets] = outside[meets] / (np.sqrt(root2[meets]) - along[meets])
    in_s[outside <= 0.0] = 0.0
    return in_s


@dataclass(frozen=True)
class Tick:
    """One recorded tick.

    footprint_m: length and width of the robot.
    """

    step: Step
    verdict: Verdict
    footprint_m: tuple[float, float]
    road: RoadState

    @property
    def robot(self) -> RobotState:
        """Robot at the end of the tick."""
        return self.step.motion.robot

    @cached_property
    def near(self) -> Nearness:
        """Proximity of people at the end of the tick."""
        return nearness(self.robot, self.step.street_after.people, self.footprint_m)

    @property
    def travelled_m(self) -> float:
        """Distance driven in this tick on wheels, metres."""
        track = np.concatenate([[self.step.robot.pose[:2]], self.step.motion.trace[:, :2]])
        way = track[1:] - track[:-1]
        return float(np.hypot(way[:, 0], way[:, 1]).sum())


class Column(NamedTuple):
    """Array of `Log` with one row per tick.

    read: extracts the value from a tick
    width: number of columns, 0 for a one-dimensional array, VARIES if the robot decides
    dtype: element type
    replayed: False for road measurements, which a replay cannot reproduce
    """

    read: Callable[[Tick], float | Sequence[float]]
    width: int = 0
    dtype: type = float
    replayed: bool = True

    def array(self, values: Sequence[float | Sequence[float]]) -> NDArray[Any]:
        """Return the column for one value per tick."""
        array: NDArray[Any] = np.array(values, self.dtype)
        if self.width == VARIES:
            return array.reshape(len(values), -1 if array.size else 0)
        return array.reshape((len(values), self.width) if self.width else len(values))


def _column(
    read: Callable[[Tick], float | Sequence[float]], width: int = 0, **more: Any
) -> dict[str, Column]:
    return {"column": Column(read, width, **more)}


def _legs_of(tick: Tick) -> Sequence[float]:
    """Return the row of `Log.legs` of a tick."""
    robot = tick.robot
    if robot.legs is None:
        return ()
    legs = robot.legs
    down = float(tick.step.motion.down)
    return (down, robot.z_m, legs.roll_rad, legs.pitch_rad, *legs.angles_rad)


def legs_width(robot: str) -> int:
    """Return the number of columns of `Log.legs` of the robot with a name; 0 on wheels."""
    drive = robot_called(robot).drive
    return _TRUNK_COLUMNS + len(drive.joints) if isinstance(drive, Legs) else 0


def holds_waypoints(path: Path) -> bool:
    """Return whether a trajectory.npz holds waypoints; False if it cannot be read."""
    try:
        return "plan_points" in npz_names(path)
    except (OSError, ValueError):
        return False


def _equal(recorded: Any, replayed: NDArray[Any]) -> bool:
    """Return whether a row of a column equals another one; NaN equals NaN.

    Equal bytes, the usual case, are found 20 times as fast as equal numbers.
    """
    return recorded.tobytes() == replayed.tobytes() or np.array_equal(
        recorded, replayed, equal_nan=True
    )


@dataclass(frozen=True)
class Log:
    """Episode tick by tick: T ticks, values at the end of each.

    pose (T, 3): x m, y m, heading rad
    speed (T, 2): v m/s, w rad/s
    command (T, 2): v m/s, w rad/s
    route_s_m (T,): arc length on the route
    travelled_m (T,): distance travelled in this tick: of wheels at the physics rate, of legs
        between positions averaged over a gait cycle (`cosim.results.walked`)
    person_m (T,): centre distance to the nearest person, inf without one
    clearance_m (T,): least gap between the robot's outline and a person's disk, at least 0, inf
        without people
    collision_in_s (T,): time to collision with a person at constant velocities, inf without one
    reset_s_m (T,): arc length that the robot was reset to after the tick, NaN without a reset
    waits_at_red (T,) bool: whether the robot waits at a red light
    on_carriageway (T,) bool, vehicles_braked (T,): see `cosim.results.traffic`
    legs (T, 4 + J) float32: of robots with legs: 1 if it is down (`Motion.down`), height of the
        base frame, roll and pitch of the trunk, J joint angles, metres and rad; (T, 0) for wheels
    people_tick (P,), people_xy (P, 2), people_kind (P,), people_age (P,): people within 30 m once a
        second, with `PersonKind` and `Age`, for pictures
    event_tracks (E, 5): tick, event, person in it, x m, y m, from each event's trigger on
    answers (A, 4): tick of the observation, ticks until the answer took effect, v m/s, w rad/s
    plan_sizes (A,): number of waypoints of each answer, 0 for a command
    plan_points (W, 2) float32: waypoints of all answers in order, x ahead and y left of the robot
        at its observation, metres; (W, 4) with cosine and sine of the heading, NaN where missing
    plan_index: index of the waypoint of an answer that is followed, from 0

    `Log.load` fills missing `legs` with (T, 0); for wheels the array is omitted from the file.
    Answers still delayed at a reset never took effect (`cosim.episode.command_delay`). `answers` is
    empty in older files. Without waypoints, plan_sizes and plan_points are empty and omitted from
    the file.

    `Log.load` reads the trajectory.npz of a run folder and raises RunError naming the file.

    >>> Log.load(Path("runs/mine/episodes/lh-011-00/trajectory.npz"))
    Traceback (most recent call last):
    cosim.core.errors.RunError: runs/mine/episodes/lh-011-00/trajectory.npz: not a trajectory: ...
    """

    tick_s: float
    pose: Floats = field(metadata=_column(lambda tick: tick.robot.pose, 3))
    speed: Floats = field(metadata=_column(lambda tick: (tick.robot.v_mps, tick.robot.w_radps), 2))
    command: Floats = field(
        metadata=_column(lambda tick: (tick.step.command.v_mps, tick.step.command.w_radps), 2)
    )
    route_s_m: Floats = field(metadata=_column(lambda tick: tick.step.route_s_after_m))
    travelled_m: Floats = field(metadata=_column(lambda tick: tick.travelled_m))
    person_m: Floats = field(metadata=_column(lambda tick: tick.near.person_m))
    clearance_m: Floats = field(metadata=_column(lambda tick: tick.near.clearance_m))
    collision_in_s: Floats = field(metadata=_column(lambda tick: tick.near.collision_in_s))
    reset_s_m: Floats = field(
        metadata=_column(
            lambda tick: np.nan if tick.verdict.reset is None else tick.verdict.reset.route_s_m
        )
    )
    waits_at_red: NDArray[np.bool_] = field(
        metadata=_column(lambda tick: tick.verdict.waits_at_red, dtype=bool)
    )
    on_carriageway: NDArray[np.bool_] = field(
        metadata=_column(lambda tick: tick.road.carriageway, dtype=bool, replayed=False)
    )
    vehicles_braked: NDArray[np.int64] = field(
        metadata=_column(lambda tick: tick.road.braked, dtype=np.int64, replayed=False)
    )
    legs: NDArray[np.float32] = field(
        default_factory=lambda: np.empty((0, 0), np.float32),
        metadata=_column(_legs_of, VARIES, dtype=np.float32),
        kw_only=True,
    )
    people_tick: NDArray[np.int64]
    people_xy: Floats
    people_kind: NDArray[np.int8]
    people_age: NDArray[np.int8]
    event_tracks: Floats
    answers: Floats = field(default_factory=lambda: np.empty((0, 4)))
    plan_sizes: NDArray[np.int32] = field(default_factory=lambda: np.empty(0, np.int32))
    plan_points: NDArray[np.float32] = field(default_factory=lambda: np.empty((0, 2), np.float32))
    plan_index: int = 0

    def __len__(self) -> int:
        return len(self.pose)

    @property
    def on_legs(self) -> bool:
        """Whether the robot has legs."""
        return self.legs.shape[1:] > (0,)

    def tick_at(self, seconds: float) -> int:
        """Return the tick nearest to a time of the episode."""
        return round(seconds / self.tick_s)

    def robot(self, tick: int) -> RobotState:
        """Return the robot's pose at the end of a tick, with attitude and joints if it has legs.

        Heights are recorded of robots with legs only.
        """
        pose = Pose(*self.pose[tick].tolist())
        if not self.on_legs:
            return RobotState(pose)
        _, z_m, roll, pitch, *angles = self.legs[tick].tolist()
        return RobotState(pose, z_m=z_m, legs=LegState(roll, pitch, tuple(angles)))

    def same(self, tick: Tick) -> bool:
        """Return whether a replayed tick has the recorded values; -0.0 equals 0.0, NaN equals NaN.

        With legs `travelled_m` is left out: it is a function of the poses of many ticks.
        """
        at = tick.step.tick
        apart = {"travelled_m"} if self.on_legs else set()
        return all(
            _equal(getattr(self, name)[at], np.array(column.read(tick), column.dtype))
            for name, column in COLUMNS.items()
            if column.replayed and name not in apart
        )

    def encoded(self) -> bytes:
        """Return the bytes of the compressed .npz file."""
        file = io.BytesIO()
        omitted = set() if len(self.plan_points) else set(_PLAN_ARRAYS)
        if not self.legs.size:
            omitted.add("legs")
        names = [f.name for f in fields(self) if f.name not in omitted]
        arrays = {name: np.asarray(getattr(self, name)) for name in names}
        np.savez_compressed(file, allow_pickle=False, **arrays)
        return file.getvalue()

    @classmethod
    def load(cls, path: Path) -> Log:
        """Load a log. Raises RunError naming the file."""
        try:
            arrays = read_npz(path)
            values: dict[str, Any] = {
                f.name: arrays[f.name]
                for f in fields(cls)
                if f.name in arrays or f.name not in _OPTIONAL
            }
            if values.keys() & _PLAN_ARRAYS:
                counts = len(arrays["plan_sizes"]), arrays["plan_sizes"].sum()
                if counts != (len(arrays["answers"]), len(arrays["plan_points"])):
                    raise ValueError("plan_sizes, plan_points and answers are not of each other")
                values["plan_index"] = int(arrays["plan_index"])
            values["tick_s"] = float(values["tick_s"])
            values.setdefault("legs", np.empty((len(np.atleast_1d(values["pose"])), 0), np.float32))
            _check_shapes(values)
        except KeyError as error:
            raise RunError(f"{path}: not a trajectory: has no array {error}") from error
        except (OSError, TypeError, ValueError) as error:
            raise RunError(f"{path}: not a trajectory: {error}") from error
        return cls(**values)


COLUMNS: Final[Mapping[str, Column]] = MappingProxyType(
    {one.name: one.metadata["column"] for one in fields(Log) if "column" in one.metadata}
)
"""Columns with one row per tick, by name, in file order."""


def _check_shapes(arrays: Mapping[str, Any]) -> None:
    """Raise ValueError for an array with a non-numeric type or a wrong shape."""
    widths = {name: column.width for name, column in COLUMNS.items()}
    tables = [
        (widths, len(np.atleast_1d(arrays["pose"]))),
        (_PEOPLE_WIDTHS, len(np.atleast_1d(arrays["people_tick"]))),
    ]
    for columns, rows in (
        *tables,
        ({"event_tracks": 5}, len(np.atleast_1d(arrays["event_tracks"]))),
    ):
        for name, width in columns.items():
            array = arrays[name]
            shape: tuple[int, ...] = (rows, width) if width else (rows,)
            if width == VARIES:
                shape = (rows, array.shape[1] if array.ndim > 1 else 0)
            if array.dtype.kind not in "biuf" or array.shape != shape:
                raise ValueError(
                    f"'{name}' is {array.dtype.name} {array.shape}; wanted are numbers {shape}"
                )
