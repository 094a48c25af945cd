"""Routes drawn on maps leave people and the robot room to pass each other."""

from __future__ import annotations

import msgspec
import pytest

from cosim.core.errors import SpecError
from cosim.core.geometry import Polyline
from cosim.place.walk_graph import WalkGraph
from cosim.spec.robot import COURIER, ROBOTS
from cosim.spec.scenario import City, CrowdSpec
from scenarios.places.nets import place
from scenarios.suites.drawing import (
    BESIDE_PERSON_M,
    bare_scenario,
    passable,
    passing_width_m,
)
from scenarios.suites.long_horizon import build_long_horizon
from scenarios.suites.obstacles import prove_gap, with_obstacles
from scenarios.suites.sample import suite_on_map
from sumo_nets.maps.place_names import resolve_place
from tests.scenarios.test_scenarios import cross_map


def test_a_drawn_crowd_fits_beside_the_robot() -> None:
    """Fewer people walk on narrower sidewalks, and none where nobody can pass the robot."""
    for width_m, density, groups in ((3.2, 22.0, 0.3), (2.0, 15.0, 0.0), (1.5, 0.0, 0.0)):
        street_map = cross_map(width_m)
        route = Polyline([(-30, 0), (30, 0)])
        city = City(seed=1)
        bare = bare_scenario(
            route, (), city, street_map, suite="s", seed=1, scenario_id="s", time_limit_s=60.0
        )
        drawn = msgspec.structs.replace(bare, crowd=CrowdSpec(density=22.0, groups=0.3))
        crowd = passable(drawn, street_map, COURIER).crowd
        assert crowd.groups == groups and crowd.density == pytest.approx(density, abs=1.0)


def test_people_need_a_stripe_beside_the_robot() -> None:
    """The courier covers two stripes of 0.64 m with its gaps, and the narrower scout covers one."""
    assert passing_width_m(COURIER) == pytest.approx(3 * 0.64)
    assert passing_width_m(ROBOTS["scout"]) == pytest.approx(2 * 0.64)


@pytest.mark.engine
def test_routes_on_maps_keep_to_wide_sidewalks() -> None:
    """On a net with mostly sidewalks below 1.9 m, routes use the wider ones, and people walk
    there."""
    suite = suite_on_map("long-horizon", "sumo-fokr-bs-demo", 0, 3)
    _, street_map = place(suite.scenarios[0].place)
    for scenario in suite.scenarios:
        route = scenario.route_line
        points = route.resampled(2.0).points.tolist()
        strips = [street_map.strips.get(street_map.locate(x, y, 0.05).edge) for x, y in points]
        widths = [
            strip.width_m for strip in strips if strip is not None and strip.kind == "sidewalk"
        ]
        assert min(widths) >= passing_width_m(COURIER) and (scenario.crowd.density or 0.0) > 0.0


@pytest.mark.engine
def test_obstacles_on_maps_leave_room_for_a_person_beside_the_robot() -> None:
    """Obstacles drawn for maps leave this gap; those of the suites only leave the robot's."""
    where = resolve_place("sumo-fkk-in", 0.0)
    _, street_map = place(where)
    suites, maps = (
        build_long_horizon(where, street_map, WalkGraph(street_map), 0, "one", roomy=roomy)
        for roomy in (False, True)
    )
    assert suites.route == maps.route and suites.obstacles and suites.obstacles != maps.obstacles
    with pytest.raises(SpecError, match="leave no gap"):
        prove_gap(suites, street_map, BESIDE_PERSON_M)
    if maps.obstacles:
        prove_gap(maps, street_map, BESIDE_PERSON_M)
    bare = msgspec.structs.replace(suites, obstacles=())
    assert with_obstacles(bare, street_map).obstacles == suites.obstacles


@pytest.mark.engine
def test_suites_drawn_on_narrow_maps_have_no_groups() -> None:
    """A long route on a net with sidewalks of 2 m gets a crowd without groups."""
    (scenario,) = suite_on_map("long-horizon", "sumo-fkk-in", 1, 1).scenarios
    assert scenario.crowd.density and scenario.crowd.groups == 0.0
