"""Signalised crossings, one after another, with the real engines."""

from __future__ import annotations

import os
import re
import subprocess
import sys

import pytest

from cosim.errors import MapError
from cosim.scenario import City
from cosim.walks import WalkGraph
from scenarios.assemble import place
from scenarios.crossings import AFTER_M, BEFORE_M, build_all

pytestmark = pytest.mark.engine

SMALL = City(seed=5, size_m=500.0)


def test_a_crossing_scenario_is_a_short_way_over_one_signalised_crossing() -> None:
    """Four different crossings, 10 m of sidewalk before and 8 m after each, the same ones whenever they are drawn."""
    _, street_map = place(SMALL)
    graph = WalkGraph(street_map)
    drawn = build_all(SMALL, street_map, graph, 3, 4)
    assert drawn == build_all(SMALL, street_map, graph, 3, 4)
    assert len({scenario.crossings[0].id for scenario in drawn}) == 4
    for scenario in drawn:
        (crossing,) = scenario.crossings
        assert crossing.signalised and street_map.strips[crossing.id].signalised
        assert crossing.enter_s_m == pytest.approx(BEFORE_M, abs=0.3)
        assert scenario.route_line.length_m - crossing.leave_s_m == pytest.approx(AFTER_M, abs=0.5)
        ends = scenario.start[:2], scenario.goal
        assert all(street_map.locate(*end, 0.0).kind == "walk" for end in ends)


def test_a_city_has_only_so_many_crossings() -> None:
    """Who asks for more than there are is told how many there are."""
    _, street_map = place(SMALL)
    with pytest.raises(MapError, match=r"has \d+ signalised crossings to drive over, not 10000"):
        build_all(SMALL, street_map, WalkGraph(street_map), 3, 10_000)


def test_the_bench_drives_over_crossings_and_counts_what_goes_at_red() -> None:
    """One crossing from the command line: the robot arrives, nothing at red by it; people and vehicles are counted."""
    words = ["bench", "crossings", "--crossings", "1", "--policy", "orca"]
    done = subprocess.run(
        [sys.executable, "-m", "cosim", *words],
        capture_output=True,
        text=True,
        timeout=300.0,
        check=False,
        env=os.environ | {"COLUMNS": "160"},
    )
    assert done.returncode == 0, done.stderr
    rows = {name.strip(): count for name, count in re.findall(r"│ ([a-z ,]+?) +│ ([\d.]+)", done.stdout)}
    assert (rows["reached the goal"], rows["entered at red"], rows["crashed"]) == ("1", "0", "0")
    assert int(re.findall(r"(\d+) vehicles passed stop lines", done.stdout)[0]) > 0
