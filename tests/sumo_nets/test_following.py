"""Distances at which people follow each other."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from cosim.core.geometry import heading_to_sumo
from scenarios.tools.bench.people import FOLLOWED, follow, largest_share
from sumo_nets.crowd.following_gaps import CROWDED, FollowingGaps
from sumo_nets.engine import NearPersons


def walkers(*x_m: float, mps: float = 1.3) -> NearPersons:
    """Return people in a row along x."""
    names = tuple(f"c{k}" for k in range(len(x_m)))
    xy = np.column_stack([x_m, np.zeros(len(x_m))])
    return NearPersons(names, xy, np.full(len(x_m), mps), [""] * len(x_m))


def test_a_delayed_person_follows_closer_until_its_gap_is_free() -> None:
    """The gap is restored only when it is free, so the person never has to stop for it."""
    written_m: dict[str, float] = {}
    engine: Any = SimpleNamespace(
        person=SimpleNamespace(
            setMinGap=written_m.__setitem__, getAngle=lambda name: heading_to_sumo(0.0)
        )
    )
    gaps = FollowingGaps(engine)
    gaps.enter("c0", 1.2)
    gaps.enter("c1", 0.3)
    gaps.update(walkers(0.0, 3.0))
    assert written_m == {"c0": 1.2, "c1": 0.3}
    gaps.update(walkers(0.0, 1.0, mps=0.1))
    assert written_m == pytest.approx({"c0": 0.63, "c1": 0.27})
    gaps.update(walkers(0.0, 1.5))
    assert written_m == pytest.approx({"c0": 0.63, "c1": 0.3})
    gaps.update(walkers(0.0, 1.8))
    assert written_m == {"c0": 1.2, "c1": 0.3}
    gaps.update(walkers(0.0, 1.8, *(2.0 + 0.1 * k for k in range(CROWDED - 1))))
    assert written_m["c0"] == 0.25


@pytest.mark.engine
def test_people_follow_each_other_at_many_distances() -> None:
    """On one-way sidewalks the distances have no spike, a mean of 0.9 to 1.4 m, and a minimum above
    0.45 m."""
    near_m = follow(FOLLOWED, seconds=20.0, seed=0, settle_s=15.0)
    assert len(near_m) > 1000 and largest_share(near_m) < 0.15
    assert 0.9 < near_m.mean() < 1.4 and near_m.std() > 0.25 and near_m.min() > 0.45
