"""Scenarios on signalised crossings, with the real engines."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

import msgspec
import numpy as np
import pytest

from cosim.core.errors import MapError
from cosim.core.geometry import Polyline, boxes_overlap
from cosim.core.state import Command, PersonKind, RobotState
from cosim.episode.interfaces import Observation
from cosim.episode.loop import Step
from cosim.place.walk_graph import WalkGraph
from cosim.policies.privileged.route import bearing_to
from cosim.results.referee import Verdict
from cosim.results.traffic import vehicles_braking_for
from cosim.spec.events import Actor, EventReply
from cosim.spec.manifest import Manifest
from cosim.spec.scenario import City, CrowdSpec
from scenarios.episodes.run_episode import run_episode
from scenarios.places.nets import place
from scenarios.suites.crossings import AFTER_M, START_BEFORE_CROSSING_M, build_all
from sumo_nets.crowd.crowd import SumoCrowd
from tests.conftest import Cosim

pytestmark = pytest.mark.engine

SMALL = City(seed=5, size_m=500.0)


def test_a_crossing_scenario_is_a_short_way_over_one_signalised_crossing() -> None:
    """Four different crossings, with 10 m of sidewalk before and 8 m after each, are drawn the same
    every time."""
    _, street_map = place(SMALL)
    graph = WalkGraph(street_map)
    drawn = build_all(SMALL, street_map, graph, 3, 4)
    assert drawn == build_all(SMALL, street_map, graph, 3, 4)
    assert len({scenario.crossings[0].id for scenario in drawn}) == 4
    for scenario in drawn:
        (crossing,) = scenario.crossings
        assert crossing.signalised and street_map.strips[crossing.id].signalised
        assert crossing.enter_s_m == pytest.approx(START_BEFORE_CROSSING_M, abs=0.3)
        assert scenario.route_line.length_m - crossing.leave_s_m == pytest.approx(AFTER_M, abs=0.5)
        ends = scenario.start[:2], scenario.goal
        assert all(street_map.locate(*end, 0.0).kind == "walk" for end in ends)


def test_too_many_crossings_are_refused() -> None:
    """The message has the number of crossings of the city."""
    _, street_map = place(SMALL)
    with pytest.raises(MapError, match=r"has \d+ signalised crossings to drive over, not 10000"):
        build_all(SMALL, street_map, WalkGraph(street_map), 3, 10_000)


@pytest.fixture
def bench(cosim: Cosim, monkeypatch: pytest.MonkeyPatch) -> Callable[..., str]:
    """Return the output of `cosim bench crossings`, in small cities."""
    monkeypatch.setattr("scenarios.tools.bench.crossings._SIZE_M", 600.0)

    def run(*words: str, cwd: Path | None = None) -> str:
        done = cosim("bench", "crossings", *words, cwd=cwd)
        assert done.returncode == 0, done.stderr
        return done.stdout

    return run


def test_the_bench_counts_entries_at_red(
    bench: Callable[..., str],
) -> None:
    """On one crossing the robot arrives without entering at red, and people and vehicles are
    counted."""
    output = bench("--crossings", "1", "--policy", "orca")
    rows = dict(re.findall(r"^ ([a-z ,]+?)  +([\d.]+)", output, re.MULTILINE))
    assert (rows["reached the goal"], rows["entered at red"], rows["crashed"]) == ("1", "0", "0")
    assert rows["waited at red"] == "1"
    assert int(re.findall(r"(\d+) vehicles passed stop lines", output)[0]) > 0


DIES = """
import os
from cosim.spec.manifest import Manifest

class Dies:
    manifest = Manifest("dies", rate_hz=10.0, camera=None, privileged=True)
    before = []

    def __init__(self):
        self.raised = False

    def reset(self, scenario_id, seed):
        self.before.append(scenario_id)

    def act(self, observation):
        if len(self.before) == 2 and not self.raised:
            os._exit(3)
        self.raised = True
        raise ValueError("no idea")
"""


def test_the_bench_reports_errors_and_dead_processes(
    tmp_path: Path, bench: Callable[..., str]
) -> None:
    """A policy that raises at its first crossing and ends its process at the second has a row for
    each."""
    (tmp_path / "dies.py").write_text(DIES)
    output = bench("--crossings", "2", "--cities", "1", "--policy", "dies:Dies", cwd=tmp_path)
    (crashed,) = re.findall(r"^ crashed +2  (.+?) *$", output, re.MULTILINE)
    assert re.fullmatch(r"crossing-001-00 .*no idea.*, crossing-001-01 the process died", crashed)


class IgnoresTraffic:
    """Follows its route at walking pace, whatever the signals and the traffic do."""

    manifest = Manifest("heedless", rate_hz=10.0, camera=None, privileged=True)

    def reset(self, scenario_id: str, seed: int) -> None: ...

    def act(self, observation: Observation) -> Command:
        assert observation.privileged is not None
        bearing_rad = bearing_to(observation.privileged, 0.0)
        return Command(
            0.5 * max(1.0 - abs(bearing_rad), 0.1), max(-0.65, min(0.65, 2.4 * bearing_rad))
        )


def test_a_car_brakes_for_a_robot_at_red() -> None:
    """At 0.5 m/s over a busy crossing at red, a car brakes once to a stop, and none touches the
    robot."""
    _, street_map = place(SMALL)
    drawn = build_all(SMALL, street_map, WalkGraph(street_map), 0, 1)[0]
    busy = msgspec.structs.replace(
        drawn, crowd=CrowdSpec(persons=0, vehicles=40), time_limit_s=45.0
    )
    slowest: dict[str, float] = {}

    def watch(step: Step, verdict: Verdict) -> None:
        braking = vehicles_braking_for(step.motion.robot.pose, step.street, step.street_after, 0.05)
        vehicles = step.street_after.vehicles
        for name, speed_mps in zip(vehicles.ids, vehicles.speed.tolist(), strict=True):
            if name in braking or name in slowest:
                slowest[name] = min(slowest.get(name, 99.0), speed_mps)

    measures = run_episode(busy, IgnoresTraffic(), watches=[watch]).record.measures
    assert measures["red_light_entries"] == 1
    assert measures["vehicles_braked"] == 1 and min(slowest.values()) < 0.1
    assert measures["collisions_vehicle"] == 0
    assert measures["carriageway_time_s"] is not None and measures["carriageway_time_s"] > 10.0


@pytest.mark.parametrize("present", ["nobody", "robot", "person"])
def test_vehicles_yield_on_a_crossing_without_signals(present: str) -> None:
    """Cars drive over the middle of a crossing, but not where a robot or a person stands for half a
    minute."""
    net, street_map = place(SMALL)
    crossing = Polyline(street_map.strips[":n1x2_c1"].line[:, :2])
    assert not street_map.strips[":n1x2_c1"].signalised
    middle = crossing.at(0.5 * crossing.length_m)
    half_size_m = np.array([0.35, 0.275])
    actor = Actor(
        id="e0",
        x_m=middle.x_m,
        y_m=middle.y_m,
        heading_rad=middle.heading_rad,
        speed_mps=0.0,
        doing="stand",
        kind=PersonKind.EVENT,
    )
    over: set[str] = set()
    with SumoCrowd(
        net, street_map, CrowdSpec(persons=0, vehicles=40), 7, frozenset(), middle[:2]
    ) as crowd:
        for tick in range(1200 if present == "nobody" else 600):
            if over:
                break
            reply = EventReply(
                episode="t", tick=tick, states=(), actors=(actor,) if present == "person" else ()
            )
            cars = crowd.step(RobotState(middle), reply, absent=present != "robot").vehicles
            boxes = np.column_stack([cars.xy, cars.heading])
            over |= {
                cars.ids[i]
                for i in np.flatnonzero(
                    boxes_overlap(np.array(middle), half_size_m, boxes, cars.size / 2)
                )
            }
    assert bool(over) is (present == "nobody")
