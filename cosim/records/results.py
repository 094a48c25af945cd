"""From many records to tables: one row per episode, and summaries with intervals."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import msgspec
import numpy as np
import pandas as pd

from cosim.judge import metrics
from cosim.judge.metrics import COUNTERFACTUAL, METRICS
from cosim.records.record import Record

KEYS: tuple[str, ...] = (
    "scenario", "status", "ended", "reason", "suite", "suite_hash", "scenario_hash", "seed", "robot",
    "policy", "policy_version", "waypoints", "goal_protocol", "renderer", "ticks", "state_hash",
)  # fmt: skip
BOOTSTRAP = 2000
CONFIDENCE = 0.95
WORST: dict[str, float] = {"success": 0.0, "goal_reached": 0.0, "route_completion": 0.0, "spl": 0.0}
"""What a crashed episode counts as: it is scheduled, so it stays in these means. An invalid one has no measures."""


def table_row(record: Record) -> dict[str, Any]:
    """One flat row. A function of scenario, policy and versions alone: wall times are left out."""
    row: dict[str, Any] = {key: getattr(record, key) for key in KEYS}
    row["waypoints"] = record.waypoints.in_words
    row["metric_schema"] = metrics.SCHEMA
    row["versions"] = msgspec.json.encode(record.versions, order="deterministic").decode()
    counted: dict[str, Mapping[str, float | None]] = {"done": record.measures, "crashed": WORST, "invalid": {}}
    measures = counted[record.status]
    asked = {name: measures[name] for name in COUNTERFACTUAL if name in measures}
    return row | {name: measures.get(name) for name in METRICS} | asked


def table_of(records: Iterable[Record]) -> pd.DataFrame:
    """One row per episode, sorted by scenario id, whatever order they ended in."""
    rows = sorted((table_row(record) for record in records), key=lambda row: str(row["scenario"]))
    asked = [name for name in COUNTERFACTUAL if any(name in row for row in rows)]
    columns = [*KEYS, "metric_schema", "versions", *METRICS, *asked]
    return pd.DataFrame(rows, columns=columns)


def summary_of(table: pd.DataFrame, names: Sequence[str] = tuple(METRICS)) -> pd.DataFrame:
    """Mean over episodes per metric, its bootstrap interval, and n, the number of episodes that have a value.

    Columns: mean, low, high, n; index: metric. A metric that no episode has is absent (NaN, n = 0).
    """
    rows = []
    for name in names:
        values = pd.to_numeric(table[name], errors="coerce").dropna().to_numpy(dtype=float)
        low, high = interval_of(values)
        rows.append((values.mean() if len(values) else np.nan, low, high, len(values)))
    return pd.DataFrame(rows, index=pd.Index(names, name="metric"), columns=["mean", "low", "high", "n"])


def interval_of(values: np.ndarray) -> tuple[float, float]:
    """Percentile bootstrap interval of the mean at CONFIDENCE; NaN for no values. Always the same draws."""
    if not len(values):
        return float("nan"), float("nan")
    draws = np.random.default_rng(0).integers(len(values), size=(BOOTSTRAP, len(values)))
    tail = (1.0 - CONFIDENCE) / 2
    low, high = np.quantile(values[draws].mean(axis=1), [tail, 1.0 - tail])
    return float(low), float(high)
