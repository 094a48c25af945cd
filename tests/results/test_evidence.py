"""What a trajectory tells by itself."""

from __future__ import annotations

import numpy as np
import pytest

from cosim.core.geometry import Polyline, Pose
from cosim.episode.loop import place_on_route
from cosim.results.rejudge import places_on_route


@pytest.mark.parametrize("spacing_m", [0.3, 1.0, 25.0])
def test_all_places_on_a_route_are_those_that_are_found_one_by_one(spacing_m: float) -> None:
    """To the bit: on a way that winds, comes back near itself and ends, from poses on it, off it
    and beyond it."""
    rng = np.random.default_rng(2)
    turns = np.cumsum(rng.normal(0.0, 0.4, 300))
    route = Polyline(np.cumsum(spacing_m * np.column_stack([np.cos(turns), np.sin(turns)]), axis=0))
    last_m = rng.uniform(-15.0, route.length_m + 15.0, 5000)
    at = np.array([route.at(s_m) for s_m in last_m.tolist()])
    pose = at + rng.normal(0.0, 1.0, at.shape) * rng.choice([0.0, 0.5, 8.0], len(at))[:, None]
    found = places_on_route(route, pose, last_m)
    one_by_one = [
        place_on_route(route, Pose(*p), s_m)
        for p, s_m in zip(pose.tolist(), last_m.tolist(), strict=True)
    ]
    assert found.tolist() == one_by_one
    assert places_on_route(route, pose[:0], last_m[:0]).shape == (0,)
