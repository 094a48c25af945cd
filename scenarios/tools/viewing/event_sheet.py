"""Measurements of the events of an episode, to compare with their definitions.

They use only `trajectory.npz` and the spec, and no reports of an event director.
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
"""Largest difference between arc length along a bend and metres driven in a tick."""
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
    """Return one row per person of each triggered event of a run, with `COLUMNS`.

    Raises the errors of reading a run.
    """
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
    """Return the rows of an episode.

    trigger_m: metres along the route from the robot to the event's place at the trigger.
    error_m: difference between trigger_m and the stated distance.
    period_m: largest possible error: distance driven in a tick, or progress on the route, which may
    cut a bend.
    speed_mps: median while walking, absent for a person that never walks.
    stated_mps: of the spec.
    left_m: median offset to the left of the middle of the way, standing or walking, whichever is
    longer.
    angle_deg: of the walk to the heading of the robot at the trigger, -180 to 180.
    least_m: least distance of the person's centre from the robot's.
    """
    rows: list[tuple[object, ...]] = []
    for number, event in enumerate(scenario.events):
        tracks = log.event_tracks[log.event_tracks[:, 1] == number]
        if not len(tracks):
            continue
        first = int(tracks[0, 0])
        before = max(first - 1, 0)
        trigger_m = event.route_s_m - float(log.route_s_m[before] if first else 0.0)
        stated_m = event.trigger_m
        if stated_m is None:
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
    """Return (speed_mps, left_m, angle_deg, least_m) of a person's track (T, 5); see `rows_of`."""
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
    """Return two tables with a row per kind of event: its triggers, and the motion of its people.

    off: number of triggers whose error exceeds the motion of the robot in a tick.
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
    """Format the least and the largest value; "-" without values."""
    known = pd.Series(values).dropna()
    if not len(known):
        return "-"
    low, high = f"{known.min():.{digits}f}", f"{known.max():.{digits}f}"
    return low if low == high else f"{low}..{high}"
