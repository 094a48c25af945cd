"""What the events of an episode did, measured from its recorded tracks: to be held against their
definitions.

Everything here comes from `trajectory.npz` and the spec; nothing from what a director says of
itself.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Final

import numpy as np
import pandas as pd

from cosim.core.geometry import Floats, wrap_angles
from cosim.results.log import Log
from cosim.results.record import Record
from cosim.results.run_folder import read_records
from cosim.spec.events import Event, EventKinds
from cosim.spec.scenario import Scenario, read_suite
from scenarios.events import EVENT_KINDS

STILL_M: Final = 1e-6
LATE_M: Final = 0.005
"""Arc length along a bend and metres driven differ by less than this in a tick."""
COLUMNS: Final = (
    "scenario",
    "kind",
    "trigger_m",
    "error_m",
    "period_m",
    "speed_mps",
    "stated_mps",
    "left_m",
    "angle_deg",
    "least_m",
)


def sheet_of_run(folder: Path, kinds: EventKinds = EVENT_KINDS) -> pd.DataFrame:
    """One row per person of each triggered event of a run, `COLUMNS`. Raises what reading a run
    raises."""
    scenarios = {s.id: s for s in read_suite(folder / "scenarios.json", kinds).scenarios}
    rows = []
    for record in sorted(read_records(folder), key=lambda r: r.scenario.id):
        path = folder / "episodes" / record.scenario.id / "trajectory.npz"
        if record.ended is not None and path.exists():
            rows += rows_of(scenarios[record.scenario.id], record, Log.load(path), kinds)
    return pd.DataFrame(rows, columns=list(COLUMNS))


def rows_of(
    scenario: Scenario, record: Record, log: Log, kinds: EventKinds = EVENT_KINDS
) -> list[tuple[object, ...]]:
    """The rows of an episode.

    trigger_m: metres along the route from the robot to the event's place at the trigger. error_m:
    how far that is from what is stated. period_m: what the robot drove then in a tick, or came
    forward on its route (it may cut a bend of it), the most that the error may be. speed_mps:
    median while walking (absent for who never walks); stated_mps: of the spec. left_m: how far left
    of the way's middle it stood or walked, most of the time. angle_deg: of its walk to the robot's
    heading at the trigger, -180 to 180. least_m: least distance of its centre from the robot's.
    """
    rows: list[tuple[object, ...]] = []
    for number, event in enumerate(scenario.events):
        tracks = log.event_tracks[log.event_tracks[:, 1] == number]
        if not len(tracks):
            continue
        first = int(tracks[0, 0])
        before = max(first - 1, 0)
        trigger_m = event.route_s_m - float(log.route_s_m[before] if first else 0.0)
        stated_m = kinds[event.kind].trigger_m
        if stated_m is None:
            stated_m = event.half_length_m
        came_m = float(log.route_s_m[before] - log.route_s_m[before - 1]) if before else 0.0
        period_m = max(float(log.travelled_m[before]), came_m)
        for person in range(event.people):
            track = tracks[tracks[:, 2] == person]
            name = scenario.id if event.people == 1 else f"{scenario.id} {person + 1}"
            told = (trigger_m, abs(stated_m - trigger_m), period_m, *walked(event, track, log))
            rows.append((name, event.kind, *told[:4], event.speed_mps, *told[4:]))
    return rows


def walked(event: Event, track: Floats, log: Log) -> tuple[float, float, float, float]:
    """(speed_mps, left_m, angle_deg, least_m) of one person's track (T, 5); see `rows_of`."""
    xy = track[:, 3:5]
    steps = np.diff(xy, axis=0)
    far_m = np.hypot(steps[:, 0], steps[:, 1])
    moves = far_m > STILL_M
    cos, sin = math.cos(event.heading_rad), math.sin(event.heading_rad)
    left_m = (xy[:, 1] - event.y_m) * cos - (xy[:, 0] - event.x_m) * sin
    robot = log.pose[track[:, 0].astype(int), :2]
    least_m = float(np.hypot(*(xy - robot).T).min())
    if not moves.any():
        return math.nan, float(np.median(left_m)), math.nan, least_m
    stands = np.append(~moves, False)
    way_rad = log.pose[max(int(track[0, 0]) - 1, 0), 2]
    first = steps[moves][: max(round(1.0 / log.tick_s), 1)].sum(axis=0)
    angle = float(wrap_angles(math.atan2(first[1], first[0]) - way_rad))
    where_m = float(np.median(left_m[stands] if stands.sum() > moves.sum() else left_m))
    return float(np.median(far_m[moves]) / log.tick_s), where_m, math.degrees(angle), least_m


def summary(
    sheet: pd.DataFrame, kinds: EventKinds = EVENT_KINDS
) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Two tables with a row per kind of event: its triggers, and how its people walked and stood;
    ranges.

    off: triggers farther from what is stated than the robot's motion in a tick.
    """
    triggers = []
    walks = []
    for kind, part in sheet.groupby("kind", sort=False):
        stated_m = kinds[str(kind)].trigger_m
        triggers.append(
            {
                "event": kind,
                "n": part["scenario"].str.split().str[0].nunique(),
                "people": len(part),
                "stated": "entry" if stated_m is None else f"{stated_m:g}",
                "trigger m": _spread(part["trigger_m"]),
                "error m": _spread(part["error_m"]),
                "tick m": f"{part['period_m'].max():.3f}",
                "off": str(int((part["error_m"] > part["period_m"] + LATE_M).sum())),
            }
        )
        walks.append(
            {
                "event": kind,
                "m/s": _spread(part["speed_mps"]),
                "stated m/s": _spread(part["stated_mps"]),
                "left m": _spread(part["left_m"]),
                "|angle| deg": _spread(part["angle_deg"].abs(), 0),
                "least m": _spread(part["least_m"]),
            }
        )
    return pd.DataFrame(triggers), pd.DataFrame(walks)


def _spread(values: pd.Series[float] | Sequence[float], digits: int = 2) -> str:
    """Least and largest of what is there; "-" for nothing."""
    known = pd.Series(values).dropna()
    if not len(known):
        return "-"
    low, high = f"{known.min():.{digits}f}", f"{known.max():.{digits}f}"
    return low if low == high else f"{low}..{high}"
