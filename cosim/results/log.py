"""Log: what happened in an episode, tick by tick, as arrays: `trajectory.npz`."""

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
from cosim.core.geometry import Floats
from cosim.core.npz import names_in_npz, read_npz
from cosim.core.state import RobotState
from cosim.episode.loop import Step
from cosim.results.nearness import Nearness, nearness
from cosim.results.referee import Verdict
from cosim.results.traffic import OnRoad

_OF_PLANS = {"plan_sizes", "plan_points", "plan_index"}
_LATER = {"answers"} | _OF_PLANS
"""Arrays that older files do not have."""
_OF_PEOPLE = {"people_tick": 0, "people_xy": 2, "people_kind": 0, "people_age": 0}
"""How many columns each array with a row for each person has, 0 for one without columns."""


@dataclass(frozen=True)
class Tick:
    """A tick that is recorded. footprint_m: length and width of the robot."""

    step: Step
    verdict: Verdict
    footprint_m: tuple[float, float]
    road: OnRoad

    @property
    def robot(self) -> RobotState:
        """The robot at the end of the tick."""
        return self.step.motion.robot

    @cached_property
    def near(self) -> Nearness:
        """How near people are at the end of the tick."""
        return nearness(self.robot, self.step.street_after.people, self.footprint_m)

    @property
    def travelled_m(self) -> float:
        """Length of the way of this tick, in metres."""
        track = np.concatenate([[self.step.robot.pose[:2]], self.step.motion.trace[:, :2]])
        way = track[1:] - track[:-1]
        return float(np.hypot(way[:, 0], way[:, 1]).sum())


class Column(NamedTuple):
    """A recorded column: an array of `Log` with a row for each tick.

    read: takes the value from a tick.
    width: how many columns the array has, 0 for one without columns.
    dtype: the array's type.
    replayed: whether a replay measures it too; what is measured of the roads is not.
    """

    read: Callable[[Tick], float | Sequence[float]]
    width: int = 0
    dtype: type = float
    replayed: bool = True

    def array(self, values: Sequence[float | Sequence[float]]) -> NDArray[Any]:
        """Return the column of these values, one for each tick."""
        return np.array(values, self.dtype).reshape(
            (len(values), self.width) if self.width else len(values)
        )


def _column(
    read: Callable[[Tick], float | Sequence[float]], width: int = 0, **more: Any
) -> dict[str, Column]:
    return {"column": Column(read, width, **more)}


def holds_waypoints(path: Path) -> bool:
    """Return whether a trajectory.npz has answers that were waypoints; False for a file that cannot
    be read."""
    try:
        return "plan_points" in names_in_npz(path)
    except (OSError, ValueError):
        return False


@dataclass(frozen=True)
class Log:
    """An episode tick by tick: T ticks, values at the end of each.

    pose (T, 3): x m, y m, heading rad. speed (T, 2): v m/s, w rad/s. command (T, 2): v m/s, w
    rad/s. route_s_m (T,): arc length on the route. travelled_m (T,): length of the way of this
    tick. person_m (T,): centre distance to the nearest person, inf without one. clearance_m (T,):
    least gap between the robot's outline and a person's disk, not below 0, inf without a person.
    collision_in_s (T,): least time until robot and a person would meet at their velocities, inf if
    they would not. reset_s_m (T,): arc length that the robot was reset to after the tick, NaN
    without reset. waits_at_red (T,) bool: whether the robot waits at a red light. on_carriageway
    (T,) bool, vehicles_braked (T,): see `cosim.results.traffic`.

    people_tick (P,), people_xy (P, 2), people_kind, people_age (P,) of `PersonKind` and `Age`:
    persons within 30 m, once a second, for pictures.

    event_tracks (E, 5): tick, event, person of it, x m, y m, from each event's trigger on.

    answers (A, 4): the tick of an observation, the ticks until the policy's answer took effect, and
    the command that it was, v m/s and w rad/s. Answers that were delayed when the robot was put
    elsewhere never took effect (`cosim.episode.command_delay`). Empty in older files.

    plan_sizes (A,): how many waypoints each answer was, 0 for a command. plan_points (W, 2)
    float32: the waypoints of one answer after another, x ahead and y left of the robot at its
    observation, metres; (W, 4) with cosine and sine of the heading there, NaN where an answer had
    none. plan_index: which waypoint of an answer is followed, from 0. Without waypoints plan_sizes
    and plan_points are empty, and no part of the file.

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

    def same(self, tick: Tick) -> bool:
        """Return whether a tick of a replay is the recorded one, to the bit."""
        at = tick.step.tick
        return all(
            np.array_equal(
                getattr(self, name)[at], np.array(column.read(tick), column.dtype), equal_nan=True
            )
            for name, column in COLUMNS.items()
            if column.replayed
        )

    def encoded(self) -> bytes:
        """The compressed .npz that is the file."""
        file = io.BytesIO()
        names = [f.name for f in fields(self) if len(self.plan_points) or f.name not in _OF_PLANS]
        arrays = {name: np.asarray(getattr(self, name)) for name in names}
        np.savez_compressed(file, allow_pickle=False, **arrays)
        return file.getvalue()

    @classmethod
    def load(cls, path: Path) -> Log:
        """Read a saved log. Raises RunError naming the file."""
        try:
            held = read_npz(path)
            values: dict[str, Any] = {
                f.name: held[f.name] for f in fields(cls) if f.name in held or f.name not in _LATER
            }
            if values.keys() & _OF_PLANS:
                counts = len(held["plan_sizes"]), held["plan_sizes"].sum()
                if counts != (len(held["answers"]), len(held["plan_points"])):
                    raise ValueError("plan_sizes, plan_points and answers are not of each other")
                values["plan_index"] = int(held["plan_index"])
            values["tick_s"] = float(values["tick_s"])
            _check_shapes(values)
        except KeyError as error:
            raise RunError(f"{path}: not a trajectory: has no array {error}") from error
        except (OSError, TypeError, ValueError) as error:
            raise RunError(f"{path}: not a trajectory: {error}") from error
        return cls(**values)


COLUMNS: Final[Mapping[str, Column]] = MappingProxyType(
    {one.name: one.metadata["column"] for one in fields(Log) if "column" in one.metadata}
)
"""The columns with a row for each tick, by name, in the file's order."""


def _check_shapes(held: Mapping[str, Any]) -> None:
    """Raises ValueError for an array that holds no numbers, has other columns, or not as many rows
    as it should."""
    widths = {name: column.width for name, column in COLUMNS.items()}
    tables = [
        (widths, len(np.atleast_1d(held["pose"]))),
        (_OF_PEOPLE, len(np.atleast_1d(held["people_tick"]))),
    ]
    for columns, rows in (*tables, ({"event_tracks": 5}, len(np.atleast_1d(held["event_tracks"])))):
        for name, width in columns.items():
            array = held[name]
            shape = (rows, width) if width else (rows,)
            if array.dtype.kind not in "biuf" or array.shape != shape:
                raise ValueError(
                    f"'{name}' is {array.dtype.name} {array.shape}; wanted are numbers {shape}"
                )
