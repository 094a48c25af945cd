"""Measurements of the events of an episode, to compare with their definitions.

They use `trajectory.npz`, the spec, and the time of each trigger in the record. Distances and
speeds are measured, not taken from the event director.
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
    "stated_m",
    "trigger_m",
    "error_m",
    "period_m",
    "speed_mps",
    "stated_mps",
    "left_m",
    "angle_deg",
    "least_m",
)


def sheet_of_run(folder: Path) -> pd.DataFrame:
    """Return one row per person of each triggered event of a run, with `COLUMNS`.

    Raises the errors of reading a run.
    """
    scenarios = {s.id: s for s in read_suite(folder / "scenarios.json", EVENT_KINDS).scenarios}
    rows = []
    for record in sorted(read_records(folder), key=lambda r: r.scenario.id):
        path = folder / "episodes" / record.scenario.id / "trajectory.npz"
        if record.ended is not None and path.exists():
            rows += rows_of(scenarios[record.scenario.id], record, Log.load(path))
    return pd.DataFrame(rows, columns=list(COLUMNS))


def rows_of(
    scenario: Scenario, record: Record, log: Log, kinds: EventKinds = EVENT_KINDS
) -> list[tuple[object, ...]]:
    """Return the rows of an episode.

    stated_m: trigger distance of the event, else of its kind; NaN if the crosswalk is the trigger.
    trigger_m: metres along the route from the robot to the event's place at the trigger.
    error_m: difference between trigger_m and stated_m, or half the crosswalk's length.
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
    triggered_s = {event.id: event.triggered_at_s for event in record.events}
    for number, event in enumerate(scenario.events):
        at_s = triggered_s.get(event.id)
        if at_s is None:
            continue
        tracks = log.event_tracks[log.event_tracks[:, 1] == number]
        first = log.tick_at(at_s)
        before = max(first - 1, 0)
        trigger_m = event.route_s_m - float(log.route_s_m[before] if first else 0.0)
        stated_m = event.trigger_m
        if stated_m is None:
            stated_m = kinds[event.kind].trigger_m
        error_m = abs((event.half_length_m if stated_m is None else stated_m) - trigger_m)
        came_m = float(log.route_s_m[before] - log.route_s_m[before - 1]) if before else 0.0
        period_m = max(float(log.travelled_m[before]), came_m)
        for person in range(event.people):
            track = tracks[tracks[:, 2] == person]
            name = scenario.id if event.people == 1 else f"{scenario.id} {person + 1}"
            speed_mps, *walk = walked(event, track, log, first)
            found = (
                math.nan if stated_m is None else stated_m,
                trigger_m,
                error_m,
                period_m,
                speed_mps,
            )
            rows.append((name, event.kind, *found, event.speed_mps, *walk))
    return rows


def walked(event: Event, track: Floats, log: Log, first: int) -> tuple[float, float, float, float]:
    """Return (speed_mps, left_m, angle_deg, least_m) of a person's track (T, 5); see `rows_of`.

    first: tick of the trigger. Without a track, all are NaN.
    """
    if not len(track):
        return math.nan, math.nan, math.nan, math.nan
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
    way_rad = log.pose[max(first - 1, 0), 2]
    begun = steps[moves][: max(round(1.0 / log.tick_s), 1)].sum(axis=0)
    angle = float(wrap_angles(math.atan2(begun[1], begun[0]) - way_rad))
    where_m = float(np.median(left_m[stands] if stands.sum() > moves.sum() else left_m))
    return float(np.median(far_m[moves]) / log.tick_s), where_m, math.degrees(angle), least_m


def summary(sheet: pd.DataFrame) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Return two tables with a row per kind of event: its triggers, and the motion of its people.

    off: number of triggers whose error exceeds the motion of the robot in a tick.
    """
    triggers = []
    walks = []
    for kind, part in sheet.groupby("kind", sort=False):
        triggers.append(
            {
                "event": kind,
                "n": part["scenario"].str.split().str[0].nunique(),
                "people": len(part),
                "stated": "entry" if part["stated_m"].isna().all() else _spread(part["stated_m"]),
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
