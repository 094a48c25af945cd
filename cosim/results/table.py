"""Tables of many records: one row per episode, and summaries with intervals."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import msgspec
import numpy as np
import pandas as pd

from cosim.core.errors import listed
from cosim.core.geometry import Floats
from cosim.results.discerned import (
    DISCERNED,
    episode_pairs,
    has_decoys,
    is_decoy,
    with_discerned,
    without_decoys,
)
from cosim.results.intervals import (
    NO_ESTIMATE,
    Estimate,
    estimate_of_mean,
    estimate_of_rate,
    estimate_of_share,
)
from cosim.results.metrics import (
    COUNTERFACTUAL,
    METRICS,
    POOLED,
    RATE_NEEDS_M,
    UNKNOWN_WITH_CRASH,
    WORST,
)
from cosim.results.record import RECORD_FILE, Record

_ORDER = (
    "scenario",
    "status",
    "ended",
    "reason",
    "suite",
    "suite_hash",
    "scenario_hash",
    "seed",
    "split",
    "structure",
    "decoy_of",
    "crowd_added",
    "weather",
    "run_seed",
    "episode",
    "robot",
    "policy",
    "policy_version",
    "policy_runs",
    "track",
    "camera",
    "rate_hz",
    "waypoints",
    "nonstandard",
    "goal_protocol",
    "odometry",
    "lidar",
    "imu",
    "people",
    "privileged",
    "latency_ms",
    "answer_ms",
    "real_time",
    "renderer",
    "ticks",
    "state_hash",
    "metric_schema",
    "versions",
)
_RECORD_ONLY = {
    "policy_source",
    "cameras",
    "measures",
    "failures",
    "walked_into",
    "red_light_entries",
    "events",
    "injections",
    "scan",
    "schema",
    "clock",
}
"""Keys of record.json that are no column of results.csv."""
COLUMNS = (*_ORDER, *(key for key in RECORD_FILE.keys if key not in {*_ORDER, *_RECORD_ONLY}))
"""Columns of results.csv before the metrics: `answer_ms`, the sensor track, and keys of record.json
without `_RECORD_ONLY`."""
ORACLE = "orca"
"""Policy used to prove suites; it has privileged knowledge and does not compete."""
MAX_INVALID_SHARE = 0.02
"""Share of scheduled episodes; with more invalid ones, a run is inconclusive."""
INJECTED = "injected"
"""Column with the number of pedestrians injected into an episode; only in runs with injections."""


def table_row(record: Record) -> dict[str, Any]:
    """Return the row of a record.

    It depends only on scenario, policy and versions; in real time also on measured answer times.
    """
    flat = RECORD_FILE.flat(record) | {
        "answer_ms": record.answer_ms,
        "track": record.manifest.track,
    }
    row: dict[str, Any] = {key: flat[key] for key in COLUMNS}
    row["waypoints"] = record.manifest.waypoints.in_words
    cameras = {"": record.manifest.camera, **record.manifest.cameras}
    words = [
        f"{name}: {spec.in_words}" if name else spec.in_words
        for name, spec in cameras.items()
        if spec
    ]
    row["camera"] = "; ".join(words) or "none"
    row["lidar"] = "none" if record.manifest.scan is None else record.manifest.scan.in_words
    row["versions"] = msgspec.json.encode(record.setup.versions, order="deterministic").decode()
    counted: dict[str, Mapping[str, float | None]] = {
        "done": record.measures,
        "crashed": WORST,
        "invalid": {},
    }
    measures = counted[record.status]
    asked = {name: measures[name] for name in COUNTERFACTUAL if name in measures}
    return row | {name: measures.get(name) for name in METRICS} | asked


def table_of(records: Iterable[Record]) -> pd.DataFrame:
    """Build a table with one row per episode, sorted by scenario id.

    A run with injected pedestrians has the column `INJECTED`, their number in each episode.
    """
    records = sorted(records, key=lambda record: record.scenario.id)
    rows = [table_row(record) for record in records]
    asked = [name for name in COUNTERFACTUAL if any(name in row for row in rows)]
    columns = [*COLUMNS, *METRICS, *asked]
    if any(record.injections for record in records):
        columns.append(INJECTED)
        for row, record in zip(rows, records, strict=True):
            row[INJECTED] = len(record.injections)
    return pd.DataFrame(rows, columns=columns)


def policy_in_words(name: str, privileged: bool) -> str:
    """Return a policy's name as in tables, marked if the policy is privileged.

    >>> policy_in_words("orca", privileged=True)
    'orca (oracle, privileged)'
    """
    return f"{name} ({'oracle, ' * (name == ORACLE)}privileged)" if privileged else name


def summary_of(table: pd.DataFrame, names: Sequence[str] = ()) -> pd.DataFrame:
    """Summarize each metric over episodes: one row (`Estimate`) per metric, the index.

    names: metrics; `metrics_of` the table if empty
    """
    names = names or metrics_of(table)
    rows = [estimate_of(table, name) for name in names]
    return pd.DataFrame(rows, index=pd.Index(names, name="metric"), columns=list(Estimate._fields))


def metrics_of(table: pd.DataFrame) -> tuple[str, ...]:
    """Return the metrics of a table, `discerned` only if it has decoys."""
    return tuple(with_discerned(dict.fromkeys(METRICS, ""), has_decoys(table)))


def estimate_of(table: pd.DataFrame, name: str) -> Estimate:
    """Return the mean of a metric over the episodes of a table, with its interval.

    Rates are pooled (`cosim.results.metrics.POOLED`): all counts divided by all metres. A metric
    without values has n = 0, and so has one that a crash leaves unknown (`UNKNOWN_WITH_CRASH`).
    Decoys count in `discerned` alone, which is over pairs (`cosim.results.discerned`).
    """
    if name == DISCERNED:
        return estimate_of_share(episode_pairs(table).values)
    table = without_decoys(table)
    if name in UNKNOWN_WITH_CRASH and crashed_in(table):
        return NO_ESTIMATE
    if name not in POOLED:
        values = numeric_column(table, name)
        values = values[~np.isnan(values)]
        is_share = name in METRICS and METRICS[name].share
        return estimate_of_share(values) if is_share else estimate_of_mean(values)
    counted, metres = (numeric_column(table, column) for column in POOLED[name])
    known = ~(np.isnan(counted) | np.isnan(metres))
    if metres[known].sum() < RATE_NEEDS_M:
        return NO_ESTIMATE
    return estimate_of_rate(counted[known], metres[known])


def crashed_in(table: pd.DataFrame) -> int:
    """Return the number of scenarios whose policy crashed; decoys are not among them."""
    return _count_of(table, "crashed")


def invalid_in(table: pd.DataFrame) -> int:
    """Return the number of invalid scenarios; decoys are not among them."""
    return _count_of(table, "invalid")


def _count_of(table: pd.DataFrame, status: str) -> int:
    return int((without_decoys(table)["status"] == status).sum())


def numeric_column(table: pd.DataFrame, name: str) -> Floats:
    """Return a column as numbers; NaN if empty."""
    return np.asarray(pd.to_numeric(table[name], errors="coerce"), dtype=float)


def injections_in_words(table: pd.DataFrame) -> str:
    """Describe which episodes had injected pedestrians; "" if none had.

    >>> injections_in_words(pd.DataFrame({"scenario": ["a", "b"], "injected": [2, 0]}))
    'pedestrians were injected into 1 episode (a): its street is not the one of the suite'
    """
    if INJECTED not in table:
        return ""
    names = [str(name) for name in table.loc[table[INJECTED] > 0, "scenario"]]
    one = len(names) == 1
    return (
        f"pedestrians were injected into {len(names)} episode{'' if one else 's'} "
        f"({listed('', names)}): {'its street is' if one else 'their streets are'} not the "
        f"one of the suite"
    )


def why_inconclusive(table: pd.DataFrame, scheduled: int) -> str:
    """Return why the means of a run are inconclusive, in words; "" if they are not."""
    pairs = episode_pairs(table)
    scenarios = scheduled - int(is_decoy(table).sum())
    for count, of, things in (
        (invalid_in(table), scenarios, "scheduled episodes are invalid"),
        (pairs.invalid, len(pairs.solved), "pairs with a decoy have an invalid episode"),
    ):
        if count > MAX_INVALID_SHARE * of:
            return f"{count} of {of} {things}, more than {100 * MAX_INVALID_SHARE:.0f} %"
    missing = scheduled - len(table)
    return f"{missing} of {scheduled} scheduled episodes have not ended" if missing else ""
