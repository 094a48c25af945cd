"""A third robot, larger and slower than the shipped ones, defined here by a row and a URDF: every
part uses its row."""

from __future__ import annotations

import dataclasses
import itertools
import math
import re
from pathlib import Path

import msgspec
import numpy as np
import pytest
import shapely
from rich.console import Console
from shapely.geometry import LineString, box

from cosim.cli.suites import print_names
from cosim.core.errors import RunError, SpecError, UsageError
from cosim.core.geometry import Polyline, Pose
from cosim.core.progress import ignore
from cosim.core.state import NO_PEOPLE, NO_VEHICLES, Command, People, RobotState, Signal, Street
from cosim.episode.control import command_of
from cosim.episode.interfaces import Observation, Privileged
from cosim.episode.policy_caller import PolicyCaller
from cosim.place.barriers import without_barriers
from cosim.place.walk_graph import WalkGraph
from cosim.policies import POLICIES
from cosim.policies.body_disks import BodyDisks
from cosim.policies.privileged.orca import PathState, best_lane_past
from cosim.policies.privileged.rollout import SampledPath
from cosim.policies.privileged.route import best_lane, crossing_limit
from cosim.policies.privileged.route_planner import DistanceField
from cosim.policies.privileged.social_force import contact_distance_m
from cosim.policies.privileged.standing_groups import lines
from cosim.results.merge import merge_runs
from cosim.results.run_folder import RunFolder
from cosim.results.verified_run import read_verified_run
from cosim.spec import robot as table
from cosim.spec.camera import CameraSpec
from cosim.spec.manifest import Manifest, WaypointRule
from cosim.spec.options import EpisodeOptions
from cosim.spec.robot import COURIER, ROBOTS, SCOUT, Mount, Robot, Skid
from cosim.spec.scenario import Suite, content_hash
from physics.cameras.view import robot_shot
from physics.robots import robot_hash, urdf_path
from physics.street.street_surface import StreetSurface
from scenarios.episodes.replay import load_recorded, replay_mismatch
from scenarios.places.nets import place
from scenarios.runs.planning import run_spec
from scenarios.runs.run import run
from scenarios.suites.catalog import load_suite, with_robot
from scenarios.suites.fits import misfits
from scenarios.tools.verify.doctor import small_scenario
from tests.conftest import Cosim
from tests.run_specs import changed, spec_of
from tests.spec.test_fits import barrier, crossroads, from_west_to_east
from tests.support.driven_runs import run_of
from tests.support.tiny_street import tiny_map

BARROW = Robot(
    name="barrow",
    urdf="barrow.urdf",
    length_m=1.0,
    width_m=0.8,
    height_m=0.6,
    com_height_m=0.25,
    drive=Skid(0.15, (0.6, 0.66), 15.0, left=("fl", "rl"), right=("fr", "rr")),
    mounts={"front": Mount((0.45, 0.0, 0.9), 5.0), "rail": Mount((0.0, 0.0, 1.4), 20.0)},
    cruise_mps=0.8,
    v_max_mps=1.0,
    w_max_radps=0.4,
    acceleration_mps2=1.0,
    acceleration_radps2=1.5,
)
WHEEL = """
  <link name="{name}_wheel">
    <inertial><mass value="2"/><inertia ixx="0.013" iyy="0.0225" izz="0.013" ixy="0" ixz="0" iyz="0"/></inertial>
    <collision><origin rpy="1.5707963 0 0"/><geometry><cylinder radius="0.15" length="0.1"/></geometry></collision>
  </link>
  <joint name="{name}" type="continuous">
    <parent link="base"/><child link="{name}_wheel"/><origin xyz="{x} {y} 0.15"/><axis xyz="0 1 0"/>
  </joint>"""
URDF = """<robot name="barrow">
  <link name="base">
    <inertial><origin xyz="0 0 0.25"/><mass value="52"/>
      <inertia ixx="3.4" iyy="5.0" izz="6.9" ixy="0" ixz="0" iyz="0"/></inertial>
    <visual><origin xyz="0 0 0.46"/><geometry><box size="1.0 0.8 0.28"/></geometry></visual>
    <collision><origin xyz="0 0 0.46"/><geometry><box size="1.0 0.8 0.28"/></geometry></collision>
  </link>{wheels}
</robot>"""


@pytest.fixture
def barrow(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Robot:
    """Add the third robot: a row in the table and its URDF, without any other change."""
    spots = {"fl": (0.3, 0.33), "rl": (-0.3, 0.33), "fr": (0.3, -0.33), "rr": (-0.3, -0.33)}
    wheels = "".join(WHEEL.format(name=name, x=x, y=y) for name, (x, y) in spots.items())
    (tmp_path / "barrow.urdf").write_text(URDF.format(wheels=wheels))
    row = dataclasses.replace(BARROW, urdf=str(tmp_path / "barrow.urdf"))
    monkeypatch.setitem(table.ROBOTS, "barrow", row)  # type: ignore[arg-type]
    return row


class MastCamera:
    """A policy with a camera on a mast."""

    manifest = Manifest("seeing", camera=CameraSpec(mount="rail"))

    def reset(self, scenario_id: str, seed: int) -> None: ...

    def act(self, observation: Observation) -> Command:
        return Command(1.0, 0.0)


EVERY = pytest.mark.parametrize("robot", [*ROBOTS.values(), BARROW], ids=[*ROBOTS, "barrow"])


def observation_on_route(
    robot: Robot, others: People = NO_PEOPLE, heading_rad: float = 0.0, v_mps: float = 0.0
) -> Observation:
    """Return an observation of a robot on a straight route along the x axis; the walkway is free
    1.7 m to either side."""
    state = RobotState(Pose(5.0, 0.0, heading_rad), v_mps)
    free = box(-2.0, -1.7, 60.0, 1.7)
    known = Privileged(
        state, Polyline([(0.0, 0.0), (50.0, 0.0)]), 5.0, others, NO_VEHICLES, {}, (), free
    )
    return Observation(0, 0.0, None, v_mps, 0.0, robot, known)


def standing(x_m: float, y_m: float) -> People:
    return People.of(("c0",), [(x_m, y_m)], [0.0], [0.0], ("stand",))


@EVERY
def test_planning_disks_enclose_the_robot(robot: Robot) -> None:
    """Every point of its outline lies in the two disks of its body and in the one around it, and
    these are tight."""
    disks = BodyDisks.of(robot)
    (half_m, aside_m) = (robot.length_m / 2, robot.width_m / 2)
    edge = np.array(
        shapely.box(-half_m, -aside_m, half_m, aside_m).segmentize(0.01).exterior.coords
    )
    away = np.abs(np.abs(edge) - (disks.nose_m, 0.0))
    assert np.hypot(*away.T).max() <= disks.radius_m < np.hypot(half_m / 2, aside_m) + 0.02
    assert np.hypot(*edge.T).max() <= disks.around_m < math.hypot(half_m, aside_m) + 0.02


@EVERY
def test_policies_use_the_pace_and_turning_rate_of_their_robot(robot: Robot) -> None:
    """Alone on a straight way each policy drives at its share of the pace, and off its way it turns
    at the robot's limit."""
    paces = {
        "route": 1.0,
        "orca": 28 / 30,
        "straight": 4 / 5,
        "social_force": min(1.0, 1.34 / robot.cruise_mps),
    }
    for name, share in paces.items():
        policy = POLICIES[name]()
        policy.reset("t", 0)
        command = command_of(
            policy.act(observation_on_route(robot)), rule=WaypointRule(), robot=robot
        )
        assert command.v_mps == pytest.approx(share * robot.cruise_mps, rel=1e-3), name
        policy.reset("t", 0)
        turned = policy.act(observation_on_route(robot, heading_rad=-1.0))
        assert isinstance(turned, Command) and (
            name == "straight" or turned.w_radps == robot.w_max_radps
        ), name


def test_larger_robots_keep_larger_distances() -> None:
    """A wider robot passes people at a larger distance, and a longer one stops earlier before
    people and red signals."""
    for small, large in itertools.pairwise((SCOUT, COURIER, BARROW)):
        beside = standing(8.0, 0.62 + BodyDisks.of(small).radius_m)
        known = observation_on_route(small, beside).privileged
        assert known is not None
        here = PathState(
            SampledPath(known.route), known.route_s_m, DistanceField(known.free, known.route)
        )
        lanes = [
            best_lane_past(known, BodyDisks.of(one), here, lines(beside), 0.0)
            for one in (small, large)
        ]
        assert lanes[1] < lanes[0] == 0.0
        offsets = [best_lane(known, one, 0.0, patient=True)[0] for one in (small, large)]
        assert offsets[1] < offsets[0] == 0.0
        assert contact_distance_m(large) - contact_distance_m(small) == pytest.approx(
            (large.length_m - small.length_m) / 2
        )
        red = dataclasses.replace(
            known, crossings=(("c", 7.0, 12.0),), signals={"c": Signal(False, 30.0)}
        )
        assert crossing_limit(red, large) < crossing_limit(red, small)


def test_answers_are_clipped_to_the_robot_that_drives() -> None:
    """A command and waypoints beyond the third robot's limits are clipped to them."""
    for answer in (Command(9.0, -9.0), np.array([[2.0, -9.0]] * 3)):
        command = command_of(answer, rule=WaypointRule(), robot=BARROW)
        assert (command.v_mps, command.w_radps) == (1.0, -0.4)


def test_a_camera_is_at_the_mount_of_its_robot(barrow: Robot) -> None:
    """The same policy sees from another height on each robot; a mount is a name, or a place on any
    robot."""
    surface = StreetSurface(tiny_map(), 1)
    state = RobotState(Pose(-40.0, 100.0, 0.0))
    for robot in (COURIER, SCOUT, barrow):
        eye_m = robot_shot(surface, robot, CameraSpec(), state).eye_m - (-40.0, 100.0, 0.0)
        assert eye_m == pytest.approx(robot.mounts["front"].at_m)
    assert CameraSpec(mount="rail").on(barrow) == Mount((0.0, 0.0, 1.4), 20.0)
    own = Mount((0.1, 0.0, 0.3), 5.0)
    assert CameraSpec(mount=own).on(barrow) == CameraSpec(mount=own).on(SCOUT) == own
    with pytest.raises(UsageError, match="unknown camera mount of robot 'scout' 'rail'"):
        CameraSpec(mount="rail").on(SCOUT)


@pytest.mark.parametrize("robot", ROBOTS.values(), ids=lambda robot: robot.name)
def test_the_mounts_of_a_robot_are_on_it(robot: Robot) -> None:
    """Every robot has "front", each mount is over the outline at a low height, and pictures from a
    mount have its heading and tilt."""
    surface = StreetSurface(tiny_map(), 1)
    state = RobotState(Pose(-40.0, 100.0, 0.3))
    assert "front" in robot.mounts
    for name, mount in robot.mounts.items():
        x_m, y_m, z_m = mount.at_m
        assert (
            abs(x_m) <= robot.length_m / 2 and abs(y_m) <= robot.width_m / 2 and 0.1 < z_m <= 1.2
        ), name
        taken = robot_shot(surface, robot, CameraSpec(mount=name), state)
        assert taken.view.heading_rad == pytest.approx(0.3 + math.radians(mount.yaw_left_deg)), name
        assert math.degrees(taken.steep_rad) == pytest.approx(mount.pitch_down_deg), name
        assert (mount.yaw_left_deg > 0) == (y_m > 0) == (name == "left")


def test_a_mount_that_the_robot_lacks_is_refused_before_anything_runs(
    barrow: Robot, tmp_path: Path
) -> None:
    """No run folder is made, and the robot with this mount is accepted."""
    policy = MastCamera()
    for name in ("courier", "scout"):
        mounts = ", ".join(sorted(ROBOTS[name].mounts))
        message = f"unknown camera mount of robot '{name}' 'rail'. Valid choices: {mounts}."
        with pytest.raises(UsageError, match=re.escape(message)):
            run(
                "reactive",
                policy,
                episodes=1,
                out=tmp_path / "run",
                options=EpisodeOptions(robot=name),
            )
    assert not (tmp_path / "run").exists()
    suite = with_robot(load_suite("reactive"), barrow.name)
    spec = run_spec(
        suite, suite.scenarios[:1], "p", PolicyCaller.of(policy), EpisodeOptions(camera="bullet")
    )
    assert spec.robots == {"barrow": robot_hash(barrow)}


def test_a_barrier_stands_across_the_route_of_a_wider_robot(barrow: Robot) -> None:
    """At a barrier 0.35 m beside the route the courier passes and the third robot does not."""
    fence = barrier(x_m=-20.0, y_m=1.0, heading_rad=0.0, length_m=1.3, strip="west", end=0)
    fine = from_west_to_east(barriers=(fence,))
    assert list(misfits([fine], crossroads())) == []
    assert list(misfits([fine.driven_by(barrow.name)], crossroads())) == [
        "scenario 's': barriers[0] on strip 'west' stands across the route"
    ]


def test_another_robot_is_another_run_of_the_same_suite(tmp_path: Path) -> None:
    """The suite's own robot changes nothing, and a run is neither resumed nor merged with another
    robot."""
    shipped = load_suite("long-horizon")
    by_scout = with_robot(shipped, "scout")
    assert (by_scout.version, {s.robot for s in by_scout.scenarios}) == (shipped.version, {"scout"})
    assert content_hash(by_scout.scenarios[0]) != content_hash(shipped.scenarios[0])
    assert with_robot(shipped, "courier") is with_robot(shipped, "") is shipped
    none = Suite(name="s", version="1", scenarios=())
    spec = spec_of(none)
    with RunFolder.create(tmp_path / "run", spec, none):
        pass
    with pytest.raises(
        RunError, match=r"its robots is \{'courier': 'h', 'scout': None\}, and this command has"
    ):
        RunFolder.resume(tmp_path / "run", changed(spec, robots={"scout": "h"}))
    parts = [run_of(tmp_path / name, ["goal"], robot=name) for name in ("courier", "scout")]
    with pytest.raises(RunError, match="robots"):
        merge_runs(parts, tmp_path / "merged", ignore)


@pytest.mark.engine
def test_runs_by_two_robots_have_the_suite_hash_of_the_shipped_scenarios(tmp_path: Path) -> None:
    """Folders and records of both runs have the same suite hash, and scenarios with the limits of
    their robot."""
    scenario = msgspec.structs.replace(small_scenario(), time_limit_s=1.0, ends_on_failure=True)
    suite = Suite(name="s", version="1", scenarios=(scenario,))
    for robot in ("", "scout"):
        options = EpisodeOptions(robot=robot, seed=1)
        run(suite, "straight", out=tmp_path / f"run{robot}", options=options)
        verified = read_verified_run(tmp_path / f"run{robot}")
        assert verified.spec.setup.suite_hash == suite.content_hash
        assert verified.spec.suite_version == "1" and [*verified.spec.robots] == [
            robot or "courier"
        ]
        (record,) = verified.records.values()
        assert record.setup.suite_hash == suite.content_hash
        assert verified.scenarios[scenario.id] == scenario.driven_by(robot)


def test_an_edited_robot_has_another_hash(barrow: Robot, tmp_path: Path) -> None:
    """The hash covers the numbers of its row and the text of its URDF."""
    copy = dataclasses.replace(barrow, urdf=str(tmp_path / "again.urdf"))
    Path(copy.urdf).write_bytes(urdf_path(barrow).read_bytes())
    unchanged = robot_hash(copy)
    assert (
        robot_hash(dataclasses.replace(copy, v_max_mps=copy.v_max_mps + 0.1))
        != unchanged
        == robot_hash(copy)
    )
    Path(copy.urdf).write_bytes(urdf_path(barrow).read_bytes() + b"<!-- heavier -->")
    assert robot_hash(copy) != unchanged


def test_a_replay_that_differs_names_an_edited_robot(barrow: Robot, tmp_path: Path) -> None:
    """The message has the hash of the run, and the current hash of the row and files."""
    folder = run_of(tmp_path / "run", ["goal"], robot=barrow.name)
    episode = load_recorded(folder, "s-000")
    for recorded, why in (
        (episode.robot_hash, f"robot 'barrow' with hash h, and .* have hash {robot_hash(barrow)}"),
        (robot_hash(barrow), "(other|same) versions: "),
    ):
        error = replay_mismatch(folder, episode._replace(robot_hash=recorded), "from 1 s on")
        assert re.search(why, str(error))


def test_an_unknown_robot_is_refused_with_the_known_ones(cosim: Cosim, tmp_path: Path) -> None:
    """`run` and `look` refuse it before they read or write a file, and `list` names the known
    robots."""
    for words in (("run", "reactive", "--out", "run"), ("look", "lh-011-00")):
        done = cosim(*words, "--robot", "tank", cwd=tmp_path)
        assert (
            done.returncode == 2
            and f"unknown robot 'tank'. Valid choices: {', '.join(sorted(ROBOTS))}." in done.stderr
        )
    assert not list(tmp_path.iterdir())
    assert "robot   scout  0.50 x 0.40 m, travels at 2 m/s" in cosim("list").stdout


def test_a_faulty_row_of_the_robot_table_does_not_hide_the_rest_of_the_list(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """`list` marks the row, prints all others, and ends with the row's fault."""
    faulty = dataclasses.replace(ROBOTS["courier"], name="tank", length_m=-1.0)
    monkeypatch.setattr(table, "ROBOTS", {"tank": faulty, **ROBOTS})
    with pytest.raises(SpecError, match="robot 'tank': length_m"):
        print_names(Console(width=200))
    output = capsys.readouterr().out
    assert "robot   tank  cannot be used" in output
    assert "robot   scout  0.50" in output and "goal    final_point" in output


WHEELED = [name for name, one in ROBOTS.items() if isinstance(one.drive, Skid)]
"""Robots on wheels; for legs see `tests.physics.test_legs`."""


@pytest.mark.engine
@pytest.mark.parametrize("name", [*WHEELED, "barrow"])
def test_a_urdf_matches_its_row(name: str, barrow: Robot) -> None:
    """The collision body fills the outline, and wheels and centre of mass are where the row
    says."""
    from physics.dynamics.bullet import p

    robot = table.robot_called(name)
    client = p.connect(p.DIRECT)
    try:
        body = p.loadURDF(
            str(urdf_path(robot)), flags=p.URDF_USE_INERTIA_FROM_FILE, physicsClientId=client
        )
        infos = [p.getJointInfo(body, j, client) for j in range(p.getNumJoints(body, client))]
        (x, y, z), _ = p.getBasePositionAndOrientation(body, client)
        bounds = np.array([p.getAABB(body, link, client) for link in range(-1, len(infos))])
        at = [p.getLinkState(body, info[0], physicsClientId=client)[4] for info in infos]
    finally:
        p.disconnect(client)
    wheels = {info[1].decode(): np.array(spot) for info, spot in zip(infos, at, strict=True)}
    low, high = bounds[:, 0].min(axis=0), bounds[:, 1].max(axis=0)
    assert (x, y, z) == pytest.approx((0.0, 0.0, robot.com_height_m))
    half = (robot.length_m / 2, robot.width_m / 2)
    assert high == pytest.approx([*half, robot.height_m], abs=0.01) and low == pytest.approx(
        [-half[0], -half[1], 0.0], abs=0.01
    )
    assert isinstance(robot.drive, Skid)
    ahead, aside = (0.5 * span for span in robot.drive.span_m)
    radius = robot.drive.wheel_radius_m
    for side, joints in ((aside, robot.drive.left), (-aside, robot.drive.right)):
        for along, joint in zip((ahead, -ahead), joints, strict=True):
            assert wheels[joint] == pytest.approx([along, side, radius], abs=1e-6)


@pytest.mark.engine
@pytest.mark.parametrize("name", [*WHEELED, "barrow"])
def test_every_robot_reaches_its_limits_upright(name: str, barrow: Robot) -> None:
    """At its pace, at its highest speed in a curve, and turning in place, speeds are within 5 % of
    the command."""
    from physics.dynamics.world import BulletWorld

    robot = table.robot_called(name)
    empty = Street(0)
    with BulletWorld(StreetSurface(tiny_map(), 1), robot=robot) as world:
        for v_mps, w_radps in (
            (robot.cruise_mps, 0.0),
            (robot.v_max_mps, robot.w_max_radps),
            (0.0, robot.w_max_radps),
        ):
            world.place(Pose(-40.0, 100.0, 0.0))
            states = [
                world.step(Command(v_mps, w_radps), empty, empty, 10).robot for _ in range(70)
            ][40:]
            assert np.mean([s.v_mps for s in states]) == pytest.approx(v_mps, rel=0.05, abs=0.02)
            assert np.mean([s.w_radps for s in states]) == pytest.approx(
                w_radps, rel=0.05, abs=0.01
            )
            assert max(s.tilt_rad for s in states) < 0.03


@pytest.mark.engine
def test_an_episode_uses_the_row_of_its_robot_everywhere(barrow: Robot) -> None:
    """In two seconds in a small city, engines, referee and policy use the values of the row."""
    import libsumo

    from scenarios.episodes.episode import Episode

    scenario = msgspec.structs.replace(small_scenario(), time_limit_s=2.0)
    manifest = Manifest("mine", rate_hz=10.0, camera=None, privileged=True)
    stages = []
    options = EpisodeOptions(robot="barrow")
    policy = POLICIES["route"]()
    with Episode(scenario, manifest, options, through=stages.append) as episode:
        observation = episode.reset()
        assert observation.robot is barrow and episode.footprint_m == (1.0, 0.8)
        assert libsumo.vehicletype.getLength("robot") == pytest.approx(1.3)
        assert libsumo.vehicletype.getWidth("robot") == pytest.approx(1.25)
        known = observation.privileged
        assert known is not None
        _, street_map = place(scenario.place)
        near = shapely.buffer(LineString(scenario.route), 5.0)
        walkable = street_map.walkable_near(shapely.buffer(near, 5.0))
        free = shapely.intersection(known.free, near)
        assert walkable.covers(shapely.buffer(free, 0.39)) and not walkable.covers(
            shapely.buffer(free, 0.45)
        )
        while not episode.over:
            observation = episode.advance(policy.act(observation))
        record, log = episode.result()
    assert (record.scenario.robot, record.scenario.hash) == (
        "barrow",
        content_hash(scenario.driven_by("barrow")),
    )
    v_mps = log.speed[:, 0]
    assert np.diff(v_mps[5:]).max() < 1.1 * barrow.acceleration_mps2 * log.tick_s
    assert 0.7 < v_mps.max() < 1.1 * barrow.cruise_mps
    assert log.command.max(axis=0)[0] <= barrow.cruise_mps


@pytest.mark.engine
def test_a_route_is_wide_enough_for_its_robot(
    barrow: Robot, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A route that is built for the third robot is wide enough for it, and a robot as wide as the
    sidewalks has no route."""
    from scenarios.suites import long_horizon

    where = small_scenario().place
    _, street_map = place(where)
    graph = WalkGraph(street_map)
    built = long_horizon.build_long_horizon(where, street_map, graph, 0, "wide", barrow)
    assert built.robot == "barrow"
    route = LineString(built.route)
    open_to_all = without_barriers(
        street_map.walkable_near(shapely.buffer(route, 20.0)), built.barriers
    )
    assert shapely.buffer(open_to_all, -barrow.width_m / 2).covers(route)
    monkeypatch.setattr(long_horizon, "TRIES", 20)
    monkeypatch.setattr(long_horizon, "SEARCHES", 0)
    huge = dataclasses.replace(barrow, width_m=4.5)
    with pytest.raises(SpecError, match="no long-horizon route on"):
        long_horizon.build_long_horizon(where, street_map, graph, 0, "huge", huge)
