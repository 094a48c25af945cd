"""Hand-made logs."""

from __future__ import annotations

from typing import Any

import numpy as np

from cosim.results.log import COLUMNS, VARIES, Log


def log_with(ticks: int, **arrays: Any) -> Log:
    """Return a log of a number of ticks without people and events: the given arrays, and zeros in
    all other columns."""
    zeros = {
        name: column.array(
            np.zeros((ticks, 0 if column.width == VARIES else column.width or 1)).tolist()
        )
        for name, column in COLUMNS.items()
    }
    no_people = {
        "people_xy": np.zeros((0, 2)),
        "people_kind": np.zeros(0, np.int8),
        "people_age": np.zeros(0, np.int8),
    }
    rest = {"tick_s": 0.05, "people_tick": np.zeros(0, np.int64), "event_tracks": np.zeros((0, 5))}
    return Log(**{**zeros, **no_people, **rest, **arrays})
