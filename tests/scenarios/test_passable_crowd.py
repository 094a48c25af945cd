"""Drawn crowds leave the robot room to pass."""

from __future__ import annotations

import msgspec
import pytest

from cosim.core.geometry import Polyline
from cosim.spec.robot import COURIER
from cosim.spec.scenario import City, CrowdSpec
from scenarios.suites.drawing import bare_scenario, passable, thinned
from scenarios.suites.sample import suite_on_map
from tests.scenarios.test_scenarios import cross_map


def test_nobody_walks_in_a_group_that_the_robot_cannot_pass() -> None:
    """Where three abreast fill a sidewalk of the route a drawn crowd has no groups; on narrow ones
    it is smaller."""
    for width_m, persons, groups in ((3.2, 10, 0.3), (2.0, 10, 0.0), (1.2, 3, 0.0)):
        street_map = cross_map(width_m)
        route = Polyline([(-30, 0), (30, 0)])
        place = City(seed=1)
        bare = bare_scenario(
            route, (), place, street_map, suite="s", seed=1, scenario_id="s", time_limit_s=60.0
        )
        drawn = msgspec.structs.replace(bare, crowd=CrowdSpec(persons=10, groups=0.3))
        crowd = passable(drawn, street_map, COURIER).crowd
        assert (crowd.persons, crowd.groups) == (persons, groups)
        assert thinned(drawn, street_map).crowd.groups == 0.3, (
            "the shipped places keep their groups"
        )


@pytest.mark.engine
def test_suites_drawn_on_narrow_maps_have_no_groups() -> None:
    """A long route on a net with sidewalks of 2 m gets a crowd without groups."""
    (scenario,) = suite_on_map("long-horizon", "sumo-fkk-in", 1, 1).scenarios
    assert scenario.crowd.persons and scenario.crowd.groups == 0.0
