"""What a measurement gives: figures, each beside the time that is the engine's own, in the same
process."""

from __future__ import annotations

import statistics
import time
from collections import defaultdict
from collections.abc import Callable, Sequence
from typing import Any

import msgspec

LESS = "<="
MORE = ">="


class Figure(msgspec.Struct, frozen=True):
    """One figure of one round. limit: the same by the engine alone, where there is one; limit_is:
    what was timed for it. reach: what the figure should come to on a quiet machine of two cores, or
    the ratio to its limit where `reach_ratio`, which holds on any machine."""

    name: str
    value: float
    limit: float | None = None
    limit_is: str = ""
    reach: float | None = None
    better: str = LESS
    reach_ratio: bool = False

    @property
    def ratio(self) -> float | None:
        """The figure over its limit."""
        return None if self.limit is None else self.value / self.limit


class Spent(defaultdict[str, float]):
    """Seconds spent in each part."""

    def timed(self, part: str, work: Callable[..., Any]) -> Callable[..., Any]:
        """`work`, with its time added to `part`."""

        def run(*args: Any, **named: Any) -> Any:
            began = time.perf_counter()
            try:
                return work(*args, **named)
            finally:
                self[part] += time.perf_counter() - began

        return run


def spread(values: Sequence[float]) -> tuple[str, str]:
    """(median, "low to high") of a figure, for a table."""
    digits = 0 if statistics.median(values) >= 100 else 2
    return (
        f"{statistics.median(values):.{digits}f}",
        f"{min(values):.{digits}f} to {max(values):.{digits}f}",
    )
