"""People and vehicles that move near the robot."""

from __future__ import annotations

import math

import numpy as np
import pytest

from cosim.core.geometry import wrap_angles
from cosim.core.state import People, Vehicles
from physics.dynamics.movers import movers_near

REACH_M = 6.0


def people(rng: np.random.Generator, ids: list[str], xy: np.ndarray) -> People:
    return People.of(
        tuple(ids), xy, rng.uniform(-4.0, 4.0, len(ids)), np.zeros(len(ids)), ("walk",) * len(ids)
    )


@pytest.mark.parametrize("people_change", [True, False], ids=["some come and go", "all stay"])
def test_movers_near_the_robot_are_near_at_either_end_of_the_tick(people_change: bool) -> None:
    """The result equals a search over all people; new or displaced ones are at the new place all
    the time."""
    rng = np.random.default_rng(3)
    seen = 0
    for _ in range(200):
        names = [f"p{k}" for k in range(40)]
        before = people(rng, names, rng.uniform(-15.0, 15.0, (40, 2)))
        remaining = list(rng.permutation(40)[:30]) if people_change else range(40)
        moved = before.xy[remaining] + rng.normal(0.0, 1.0, (len(remaining), 2)) * rng.choice(
            [0.1, 8.0], (len(remaining), 1)
        )
        new = rng.uniform(-15.0, 15.0, (5, 2)) if people_change else np.zeros((0, 2))
        ids = [names[k] for k in remaining] + [f"new{k}" for k in range(len(new))]
        after = people(rng, ids, np.concatenate([moved, new]))
        x, y = rng.uniform(-5.0, 5.0, 2).tolist()
        expected = {}
        for i, name in enumerate(ids):
            end = start = np.array([*after.xy[i], after.heading[i]])
            if name in names and math.dist(before.xy[names.index(name)], end[:2]) <= 5.0:
                start = np.array([*before.xy[names.index(name)], before.heading[names.index(name)]])
            if min(math.dist(start[:2], (x, y)), math.dist(end[:2], (x, y))) <= REACH_M:
                change = end - start
                expected[name] = (start, np.array([*change[:2], wrap_angles(change[2:])[0]]))
        found = movers_near(before, after, x, y, REACH_M)
        assert [mover.id for mover in found] == list(expected)
        for mover in found:
            start, change = expected[mover.id]
            paths = np.array(mover.poses(10))
            assert (paths == start + (np.arange(1, 11) / 10)[:, None] * change).all()
            nearest_m = np.hypot(*(paths[:, :2] - (x, y)).T).min() - 0.5 * math.hypot(*mover.size_m)
            assert mover.may_come_within(x, y, nearest_m + 1e-6)
            assert not mover.may_come_within(x, y, nearest_m - 2.0 * math.hypot(*change[:2]) - 1e-6)
        seen += len(found)
    assert seen > 500


def test_a_vehicle_has_its_own_size() -> None:
    """The size is that of its row in the later snapshot, in any order."""
    before = Vehicles.of(
        ("a", "b"), [[0.0, 0.0], [1.0, 0.0]], [0.0, 0.0], [0.0, 0.0], [[4.0, 1.8], [12.0, 2.5]]
    )
    after = Vehicles.of(
        ("b", "a"), [[1.0, 0.5], [0.0, 0.0]], [0.0, 0.0], [0.0, 0.0], [[12.0, 2.5], [4.0, 1.8]]
    )
    bus, car = movers_near(before, after, 0.0, 0.0, 10.0)
    assert (bus.id, bus.size_m, car.size_m) == ("b", (12.0, 2.5), (4.0, 1.8))
    assert bus.poses(2) == [(1.0, 0.25, 0.0), (1.0, 0.5, 0.0)]
