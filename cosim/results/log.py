"""Log: what happened in an episode, tick by tick, as arrays: `trajectory.npz`."""

from __future__ import annotations

import io
from collections.abc import Mapping
from dataclasses import dataclass, fields
from dataclasses import field as filled
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cosim.core.errors import RunError
from cosim.core.geometry import Floats
from cosim.core.npz import names_in_npz, read_npz

_OF_PLANS = {"plan_sizes", "plan_points", "plan_index"}
_LATER = {"answers"} | _OF_PLANS
"""What a file need not have."""
_COLUMNS = {
    "pose": 3,
    "speed": 2,
    "command": 2,
    "route_s_m": 0,
    "travelled_m": 0,
    "person_m": 0,
    "clearance_m": 0,
    "collision_in_s": 0,
    "reset_s_m": 0,
    "waits_at_red": 0,
    "on_carriageway": 0,
    "vehicles_braked": 0,
}
"""How many columns each array with a row for each tick has, 0 for one without columns."""
_OF_PEOPLE = {"people_tick": 0, "people_xy": 2, "people_kind": 0, "people_age": 0}


def holds_waypoints(path: Path) -> bool:
    """Return whether a trajectory.npz has answers that were waypoints; False for a file that cannot
    be read."""
    try:
        return "plan_points" in names_in_npz(path)
    except (OSError, ValueError):
        return False


@dataclass(frozen=True)
class Log:
    """An episode tick by tick, T rows; values at the end of each tick.

    pose (T, 3) x m, y m, heading rad; speed (T, 2) v m/s, w rad/s; command (T, 2) likewise;
    route_s_m (T,); travelled_m (T,) of this tick; person_m (T,) centre distance to the nearest
    person, inf without one; clearance_m (T,) least gap between the robot's outline and a person's
    disk, not below 0, inf without one; collision_in_s (T,) least time until robot and a person
    would meet if both kept their velocities, inf if they would not; reset_s_m (T,) arc length the
    robot was reset to after the tick, NaN without reset; waits_at_red (T,) bool. on_carriageway
    (T,) bool, vehicles_braked (T,) number of them: see `cosim.results.traffic`. people_tick (P,),
    people_xy (P, 2), people_kind, people_age (P,) of `PersonKind` and `Age`: persons within 30 m,
    once a second, for pictures. event_tracks (E, 5): tick, event, person of it, x m, y m, from each
    event's trigger on. answers (A, 4): the tick of an observation, the ticks until the policy's
    answer to it took effect, and the command that it was, v m/s and w rad/s; what was on its way
    when the robot was put elsewhere never did (`cosim.episode.command_delay`). Empty in a file that
    was written before there were any. plan_sizes (A,): how many waypoints each of the answers was,
    0 for a command; plan_points (W, 2) float32: these waypoints one answer after another, x ahead
    and y left of the robot at its observation, metres; (W, 4) with cosine and sine of the heading
    there, NaN where an answer told none; plan_index: which of an answer is followed, from 0.
    Without waypoints plan_sizes and plan_points are empty, and no part of the file.

    `Log.load` reads the trajectory.npz of a run folder and raises RunError naming the file.

    >>> Log.load(Path("runs/mine/episodes/lh-011-00/trajectory.npz"))
    Traceback (most recent call last):
    cosim.core.errors.RunError: runs/mine/episodes/lh-011-00/trajectory.npz: not a trajectory: ...
    """

    tick_s: float
    pose: Floats
    speed: Floats
    command: Floats
    route_s_m: Floats
    travelled_m: Floats
    person_m: Floats
    clearance_m: Floats
    collision_in_s: Floats
    reset_s_m: Floats
    waits_at_red: NDArray[np.bool_]
    on_carriageway: NDArray[np.bool_]
    vehicles_braked: NDArray[np.int64]
    people_tick: NDArray[np.int64]
    people_xy: Floats
    people_kind: NDArray[np.int8]
    people_age: NDArray[np.int8]
    event_tracks: Floats
    answers: Floats = filled(default_factory=lambda: np.empty((0, 4)))
    plan_sizes: NDArray[np.int32] = filled(default_factory=lambda: np.empty(0, np.int32))
    plan_points: NDArray[np.float32] = filled(default_factory=lambda: np.empty((0, 2), np.float32))
    plan_index: int = 0

    def __len__(self) -> int:
        return len(self.pose)

    def row(self, tick: int) -> Floats:
        """(16,) the values of a tick, in the order of `cosim.results.record.log_row`."""
        columns = (
            self.pose,
            self.speed,
            self.command,
            self.route_s_m,
            self.travelled_m,
            self.person_m,
        )
        more = (
            self.clearance_m,
            self.collision_in_s,
            self.reset_s_m,
            self.waits_at_red,
            self.on_carriageway,
            self.vehicles_braked,
        )
        return np.hstack([column[tick] for column in (*columns, *more)]).astype(float)

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


def _check_shapes(held: Mapping[str, Any]) -> None:
    """Raises ValueError for an array that holds no numbers, has other columns, or not as many rows
    as it should."""
    tables = [
        (_COLUMNS, len(np.atleast_1d(held["pose"]))),
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
