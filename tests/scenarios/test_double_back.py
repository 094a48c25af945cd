"""A route that leads out and back along one strip: the robot may walk across, and has then reached
the goal."""

from __future__ import annotations

import math

import msgspec
import numpy as np
import pytest

from cosim.core.geometry import Polyline
from cosim.policies import POLICIES
from cosim.results.rejudge import contradictions
from cosim.spec.scenario import City, CrowdSpec, Scenario
from scenarios.episodes.run_episode import run_episode
from scenarios.places.nets import place
from scenarios.tools.verify.doctor import small_scenario

SMALL = City(seed=1, size_m=500.0)
OUT_M = 25.0
APART_M = 1.7


def there_and_back() -> Scenario:
    """25 m along a wide sidewalk of a small city and back again, 1.7 m beside; nobody is there."""
    _, street_map = place(SMALL)
    widest = max(
        (s for s in street_map.strips.values() if s.length_m > 60.0), key=lambda s: s.width_m
    )
    middle = Polyline(widest.line)
    there = [middle.at(20.0 + s_m) for s_m in np.arange(0.0, OUT_M)]
    left, right = (
        [
            (p.x_m - side * math.sin(p.heading_rad), p.y_m + side * math.cos(p.heading_rad))
            for p in there
        ]
        for side in (APART_M / 2, -APART_M / 2)
    )
    route = Polyline(np.round([*right, *left[::-1]], 3))
    return msgspec.structs.replace(
        small_scenario(),
        place=msgspec.structs.replace(SMALL, net_hash=street_map.net_hash),
        start=tuple(route.at(0.0)),
        goal=tuple(route.points[-1].tolist()),
        route=tuple((x, y) for x, y in route.points.tolist()),
        crossings=(),
        barriers=(),
        obstacles=(),
        events=(),
        crowd=CrowdSpec(persons=0, vehicles=0),
        time_limit_s=20.0,
    )


@pytest.mark.engine
def test_a_robot_that_skips_the_loop_of_a_route_is_at_its_goal() -> None:
    """The oracle takes the shortest way; the episode ends there, and what was recorded agrees with
    the trajectory."""
    scenario = there_and_back()
    result = run_episode(scenario, POLICIES["orca"]())
    assert result.record.ended == "goal" and result.record.measures["route_completion"] == 1.0
    assert result.log.route_s_m[-1] < OUT_M
    assert not list(contradictions(result.record, scenario, result.log))
