"""The robot on hilly streets: a net with elevations by netconvert, driving on it, and an
episode."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from pathlib import Path

import msgspec
import numpy as np
import pytest

from cosim.core.geometry import Polyline, Pose
from cosim.core.state import LABELS, NO_PEOPLE, Command, Street, Vehicles
from cosim.place.street_map import StreetMap
from cosim.policies.privileged.route import Route
from cosim.spec.camera import CameraSpec
from cosim.spec.scenario import CrowdSpec
from physics.cameras.bullet_camera import BulletCamera
from physics.dynamics.world import BulletWorld
from physics.street.street_surface import StreetSurface
from scenarios.episodes.run_episode import run_episode
from scenarios.suites.sample import suite_on_map
from sumo_nets.maps.map_store import checked_map, import_map
from sumo_nets.net.net_file import read_net
from sumo_nets.net.netconvert import netconvert

pytestmark = pytest.mark.engine

GRADE = 0.1


class BlindRoute(Route):
    """A route policy without pictures."""

    manifest = dataclasses.replace(Route.manifest, camera=None)


EMPTY = Street(0)


def hill_net(folder: Path) -> Path:
    """Build a hill of 10 %: three streets of 200 m up its side, joined by streets along it, from 0
    m to 13 m and level beyond."""
    nodes = []
    edges = []
    for i in range(3):
        for j, (y, z) in enumerate(((0, 0), (80, 6.4), (160, 12.8), (240, 12.8))):
            nodes.append(f'<node id="{i}{j}" x="{90 * i}" y="{y}" z="{z}"/>')
            joined = [(i + 1, j)] * (i < 2) + [(i, j + 1)] * (j < 3)
            edges += [
                f'<edge id="{i}{j}-{k}{m}" from="{i}{j}" to="{k}{m}" numLanes="1" speed="13"/>'
                for k, m in joined
            ]
            edges += [
                f'<edge id="{k}{m}-{i}{j}" from="{k}{m}" to="{i}{j}" numLanes="1" speed="13"/>'
                for k, m in joined
            ]
    (folder / "hill.nod.xml").write_text(f"<nodes>{''.join(nodes)}</nodes>")
    (folder / "hill.edg.xml").write_text(f"<edges>{''.join(edges)}</edges>")
    options = [
        "--sidewalks.guess",
        "--default.sidewalk-width=3",
        "--crossings.guess",
        "--walkingareas",
    ]
    inputs = ["-n", str(folder / "hill.nod.xml"), "-e", str(folder / "hill.edg.xml")]
    return netconvert([*inputs, *options], folder / "hill.net.xml")


@pytest.fixture(scope="module")
def hill(tmp_path_factory: pytest.TempPathFactory) -> StreetMap:
    return read_net(hill_net(tmp_path_factory.mktemp("hill")))


@pytest.fixture(scope="module")
def world(hill: StreetMap) -> Iterator[BulletWorld]:
    with BulletWorld(StreetSurface(hill, seed=2)) as world:
        yield world


def uphill(hill: StreetMap) -> Polyline:
    """Return the middle line of a sidewalk that rises from 0 m to 6.4 m."""
    return Polyline(hill.strips["10-11"].line)


def test_the_land_has_the_grade_of_the_net(hill: StreetMap) -> None:
    """The land under a sidewalk rises by a tenth along it and not across it, and every strip may be
    driven."""
    assert hill.terrain is not None and hill.elevation is not None
    line = uphill(hill)
    rise = hill.terrain.gradient(
        [line.at(float(s)).xy for s in np.arange(20.0, line.length_m - 20.0)]
    )
    assert rise[:, 1] == pytest.approx(GRADE, abs=0.015)
    assert np.abs(rise[:, 0]).max() < 0.01
    assert (hill.elevation.dropped, hill.elevation.steep, hill.elevation.closed) == ("", (), ())


@pytest.mark.parametrize("up", [True, False])
def test_the_robot_holds_its_speed_up_and_down(
    hill: StreetMap, world: BulletWorld, up: bool
) -> None:
    """At 1.5 m/s on 10 % it is within 5 % of the command, leans like the street, and keeps its
    wheels on it."""
    line = uphill(hill) if up else Polyline(uphill(hill).points[::-1])
    state = world.place(Pose(*line.at(12.0)))
    start_m = state.z_m
    states = []
    for _ in range(400):
        state = world.step(Command(1.5, 0.0), EMPTY, EMPTY, 10).robot
        states.append(state)
    driven = states[40:]
    assert np.mean([s.v_mps for s in driven]) == pytest.approx(1.5, rel=0.05)
    assert min(s.v_mps for s in driven) > 1.4
    assert max(s.tilt_rad for s in states) < 2.0 * GRADE
    over = [s.z_m - world.surface.heights([[s.pose.x_m, s.pose.y_m]])[0] for s in driven]
    assert max(map(abs, over)) < 0.02
    assert abs(state.z_m - start_m) == pytest.approx(GRADE * 29.5, rel=0.1)
    assert (state.z_m > start_m) == up


def test_vehicles_are_on_the_slope(hill: StreetMap, world: BulletWorld) -> None:
    """A car ahead on the rising road is seen and stops the robot, metres above the lowest point."""
    lane = next(
        lane for lane in hill.lanes.values() if lane.edge == "11-12" and lane.kind == "road"
    )
    line = Polyline(lane.line)
    car = line.at(30.0)
    street = Street(0, NO_PEOPLE, Vehicles.of(("car",), [car[:2]], [car[2]], [0.0], [[4.5, 1.8]]))
    robot = world.place(Pose(*line.at(20.0)))
    with BulletCamera(world, CameraSpec(width=160, height=120)) as camera:
        labels = camera.render(robot, street).labels
    assert labels is not None and (labels == LABELS["vehicle"]).mean() > 0.005
    contacts = set()
    for _ in range(120):
        motion = world.step(Command(1.5, 0.0), street, street, 10)
        contacts |= {(c.kind, c.other) for c in motion.contacts}
    assert contacts == {("vehicle", "car")}
    assert 7.0 < motion.robot.z_m < 14.0


def test_an_episode_on_the_hill_reaches_its_goal(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The import reports the elevation, and the expert reaches a goal uphill and downhill without a
    failure."""
    monkeypatch.setenv("COSIM_CACHE", str(tmp_path / "cache"))
    import_map(hill_net(tmp_path), "hill")
    street_map, check, _ = checked_map("hill")
    assert any(note.startswith("elevation 0 to 13 m is kept") for note in check.notes)
    assert street_map.terrain is not None
    (drawn,) = suite_on_map("long-horizon", "hill", 3, 1).scenarios
    way = drawn.route[:66]
    scenario = msgspec.structs.replace(
        drawn,
        route=way,
        goal=way[-1],
        events=(),
        obstacles=(),
        crowd=CrowdSpec(persons=6, vehicles=2),
    )
    heights = street_map.terrain.height(np.array(way))
    top = int(heights.argmax())
    assert heights[top] - heights[0] > 3.0 and heights[top] - heights[-1] > 1.5
    done = run_episode(scenario, BlindRoute())
    assert (done.record.ended, done.record.failures) == ("goal", ())
