"""The generated cities that ship with the benchmark, as seeds: made on demand, then kept in the cache."""

from __future__ import annotations

from cosim.spec.scenario import City

VAL_SEEDS = tuple(range(1, 81))
TEST_SEEDS = tuple(range(7001, 7021))
"""Cities that nothing was tuned on: no test, measurement or example names them."""
SEEDS = (*VAL_SEEDS, *TEST_SEEDS)


def shipped_cities(count: int = len(SEEDS), size_m: float = 2000.0, style: str = "mixed") -> tuple[City, ...]:
    """The first `count` of the shipped cities."""
    return tuple(City(seed=seed, size_m=size_m, style=style) for seed in SEEDS[:count])
