"""Goals: each protocol against a case worked out by hand, and their dependence on the seed."""

from __future__ import annotations

import math
import re

import msgspec
import numpy as np
import pytest

from cosim.core.errors import UsageError
from cosim.core.geometry import Polyline, Pose
from cosim.episode.manifest_checks import calibration_of, with_goal
from cosim.results.table import table_row
from cosim.spec.camera import CameraSpec, Lens
from cosim.spec.goal import (
    GOALS,
    Goal,
    GoalKind,
    GoalProtocol,
    Goals,
    ImageGoal,
    Instruction,
    PointGoal,
    RoutePatch,
    RoutePoints,
    TurningGoal,
    decoded_goal,
    goals_for,
    route_patch_at,
)
from cosim.spec.manifest import Manifest
from cosim.spec.manoeuvres import instruction_at, manoeuvres
from cosim.spec.robot import COURIER, Mount
from cosim.spec.scenario import City, RouteCrossing, Scenario
from scenarios.suites.catalog import load_suite
from tests.run_specs import record_of

CORNER = ((0.0, 0.0), (40.0, 0.0), (40.0, 60.0))
NORTH = 0.5 * math.pi


def scenario(
    route: tuple[tuple[float, float], ...] = CORNER, crossings: tuple[RouteCrossing, ...] = ()
) -> Scenario:
    """A route of 100 m that turns left after 40 m."""
    return Scenario(
        id="a",
        suite="mine",
        place=City(seed=1, size_m=500.0),
        seed=0,
        start=(*route[0], 0.0),
        goal=route[-1],
        route=route,
        crossings=crossings,
    )


def goals(protocol: GoalProtocol, seed: int = 0, **more: object) -> Goals:
    return goals_for(protocol, scenario(), np.random.default_rng(seed), **more)  # type: ignore[arg-type]


def point(goal: Goal | None) -> tuple[float, float]:
    assert isinstance(goal, PointGoal)
    return round(goal.x_m, 9), round(goal.y_m, 9)


def test_the_point_of_the_route_lies_5_to_20_m_along_it() -> None:
    """The goal is set 20 m along the route and again at 5 m or after a reset; near the end it is
    the end."""
    protocol = goals("route_point")
    assert point(protocol.at(Pose(0.0, 0.0, 0.0), 0.0)) == (20.0, 0.0)
    assert point(protocol.at(Pose(15.0, 1.0, 0.0), 15.0)) == (5.0, -1.0)
    assert point(protocol.at(Pose(15.5, 1.0, NORTH), 15.5)) == (
        -1.0,
        -20.0,
    )  # 35.5 m along: (35.5, 0)
    assert point(protocol.at(Pose(31.0, 0.0, 0.0), 31.0)) == (9.0, 11.0)  # 51 m along: (40, 11)
    protocol.on_reset()
    assert point(protocol.at(Pose(25.0, 0.0, 0.0), 25.0)) == (
        15.0,
        5.0,
    )  # 26 m were too many: 45 m along, (40, 5)
    assert point(protocol.at(Pose(40.0, 58.0, NORTH), 98.0)) == (2.0, 0.0)


@pytest.mark.parametrize("s_m", [0.0, 7.3, 14.999, 15.001, 33.0, 61.2, 79.9])
def test_every_point_of_the_route_is_5_to_20_m_along_it(s_m: float) -> None:
    """Its arc length is in [5, 20] m for every robot that drives along the route, in steps of 0.4
    m."""
    protocol = goals("route_point")
    line = Polyline(CORNER)
    for here in np.arange(s_m, 80.0, 0.4).tolist():
        goal = protocol.at(Pose(0.0, 0.0, 0.0), here)
        assert isinstance(goal, PointGoal)
        ahead = line.project(goal.x_m, goal.y_m)[0] - here
        assert 5.0 - 1e-6 <= ahead <= 20.0 + 1e-6


def test_the_final_point_is_the_goal_in_the_robots_frame() -> None:
    """From (10, 0), looking north, (40, 60) is 60 m ahead and 30 m to the right."""
    goal = goals("final_point").at(Pose(10.0, 0.0, NORTH), 10.0)
    assert point(goal) == (60.0, -30.0) and isinstance(goal, PointGoal)
    assert goal.distance_m == pytest.approx(math.hypot(60.0, 30.0))
    assert goal.bearing_rad == pytest.approx(math.atan2(-30.0, 60.0))


def test_random_points_are_drawn_ahead_and_fixed_until_reached_or_passed() -> None:
    """300 points fill 5 to 20 m ahead and 5 m aside; each stays until it is within 1 m, passed, or
    the robot is reset."""
    pose = Pose(3.0, -2.0, 0.7)
    first = [point(goals("random_point", seed).at(pose, 0.0)) for seed in range(300)]
    ahead, aside = np.array(first).T
    assert (ahead >= 5.0).all() and (ahead <= 20.0).all() and (np.abs(aside) <= 5.0).all()
    assert ahead.min() < 5.5 and ahead.max() > 19.5 and aside.min() < -4.5 and aside.max() > 4.5
    assert abs(ahead.mean() - 12.5) < 0.8 and abs(aside.mean()) < 0.6

    protocol = goals("random_point", 4)
    x_m, y_m = point(protocol.at(Pose(0.0, 0.0, 0.0), 0.0))
    assert point(protocol.at(Pose(1.0, 0.0, 0.0), 1.0)) == pytest.approx((x_m - 1.0, y_m))
    assert point(protocol.at(Pose(x_m - 2.0, y_m, 0.3), 9.0)) == pytest.approx(
        (2 * math.cos(0.3), -2 * math.sin(0.3))
    )
    assert protocol.at(Pose(x_m - 1.1, y_m, 0.0), 9.0) == PointGoal(
        pytest.approx(1.1), pytest.approx(0.0, abs=1e-9)
    )
    second = point(protocol.at(Pose(x_m - 0.9, y_m, 0.0), 9.0))
    assert 5.0 <= second[0] <= 20.0
    assert point(protocol.at(Pose(x_m - 0.9, y_m, 0.0), 9.0)) == second
    third = point(protocol.at(Pose(x_m - 0.9, y_m, math.pi), 9.0))
    assert 5.0 <= third[0] <= 20.0 and third != second
    protocol.on_reset()
    assert point(protocol.at(Pose(x_m - 0.9, y_m, math.pi), 9.0)) != third


def test_an_image_goal_is_taken_once_for_each_sub_goal() -> None:
    """It is taken 20 m along the route, looking along it; round the corner it looks the other way."""
    looked: list[Pose] = []

    def look(pose: Pose) -> np.ndarray:
        looked.append(pose)
        return np.full((2, 2, 3), len(looked), np.uint8)

    protocol = goals("image", take_picture=look)
    seen = [protocol.at(Pose(s_m, 0.0, 0.0), s_m) for s_m in (0.0, 5.0, 15.0, 16.0, 30.0, 32.0)]
    assert [one.rgb[0, 0, 0] for one in seen if isinstance(one, ImageGoal)] == [1, 1, 1, 2, 2, 3]
    assert [tuple(round(v, 9) for v in pose) for pose in looked] == [
        (20.0, 0.0, 0.0),
        (36.0, 0.0, 0.0),
        (40.0, 12.0, round(NORTH, 9)),
    ]


def test_a_random_image_is_constant_noise_of_the_cameras_size() -> None:
    """All values are equally frequent; it is the same throughout an episode and differs with
    another seed."""
    protocol = goals("random_image", 1, size=(64, 48))
    first, later = (protocol.at(Pose(s_m, 0.0, 0.0), s_m) for s_m in (0.0, 50.0))
    other = goals("random_image", 2, size=(64, 48)).at(Pose(0.0, 0.0, 0.0), 0.0)
    assert (
        isinstance(first, ImageGoal)
        and isinstance(later, ImageGoal)
        and isinstance(other, ImageGoal)
    )
    assert first.rgb.shape == (48, 64, 3) and first.rgb.dtype == np.uint8
    assert len(np.unique(first.rgb)) == 256 and abs(float(first.rgb.mean()) - 127.5) < 3.0
    assert (first.rgb == later.rgb).all() and (first.rgb != other.rgb).mean() > 0.9


def test_an_instruction_announces_turns_and_crosswalks() -> None:
    """A left turn at 40 m and a crosswalk from 70 to 80 m are announced to 5 m; otherwise it says
    to follow the sidewalk."""
    crossing = RouteCrossing(id="x", enter_s_m=70.0, leave_s_m=80.0, signalised=True)
    protocol = goals_for("instruction", scenario(crossings=(crossing,)), np.random.default_rng(0))
    words = {}
    for s_m in np.arange(0.0, 100.0, 0.5).tolist():
        goal = protocol.at(Pose(0.0, 0.0, 0.0), s_m)
        assert isinstance(goal, Instruction)
        words[s_m] = goal.text
    assert (
        words[0.0]
        == words[19.5]
        == words[41.0]
        == words[49.5]
        == words[80.0]
        == words[99.5]
        == ("Follow the sidewalk.")
    )
    assert words[20.0] == "Follow the sidewalk. In 20 m, turn left."
    assert words[29.0] == "Follow the sidewalk. In 10 m, turn left."
    assert words[37.0] == "Follow the sidewalk. In 5 m, turn left."
    assert words[37.5] == words[40.5] == "Turn left."
    assert words[55.0] == "Follow the sidewalk. In 15 m, cross the street at the crosswalk."
    assert words[68.0] == words[79.5] == "Cross the street at the crosswalk."


def test_instructions_mention_only_turns_and_crosswalks() -> None:
    """On every metre of long ways the only number is the distance, to 5 m and at most 20; no
    people, events or goal."""
    what = r"((turn|bear) (left|right)|cross the street at the crosswalk)"
    allowed = re.compile(
        rf"(Follow the sidewalk\.|{what}\.( {what}\.)*)( In (5|10|15|20) m, {what}\.)?",
        re.IGNORECASE,
    )
    instructions = set()
    for one in load_suite("long-horizon").scenarios[:12]:
        ways = manoeuvres(one.route_line, one.crossings)
        instructions |= {
            instruction_at(s_m, ways) for s_m in np.arange(0.0, one.route_line.length_m).tolist()
        }
    assert [text for text in instructions if not allowed.fullmatch(text)] == [] and len(
        instructions
    ) > 8


@pytest.mark.parametrize(
    ("route", "expected"),
    [
        ([(0, 0), (60, 0)], []),
        ([(0, 0), (30, 0), (30, -30)], ["turn right"]),
        ([(0, 0), (30, 0), (60, 30)], ["bear left"]),
        ([(0, 0), (30, 0), (60, 15)], []),
        ([(0, 0), (30, 0), (30, 30), (60, 30)], ["turn left", "turn right"]),
        ([(40 * math.sin(a), 40 - 40 * math.cos(a)) for a in np.linspace(0.0, 3.0, 60)], []),
    ],
    ids=["straight", "right", "half", "slight", "two", "curve"],
)
def test_the_angle_of_a_turn_decides_its_instruction(
    route: list[tuple[float, float]], expected: list[str]
) -> None:
    """Of 45 degrees one bears, of 27 one follows the sidewalk, as round a long curve."""
    assert [one.words for one in manoeuvres(Polyline(route))] == expected
    assert instruction_at(0.0, ()) == "Follow the sidewalk."


def test_a_route_patch_has_the_route_around_the_robot() -> None:
    """Ahead is up at 0.5 m a pixel: a straight way is two columns, a turned one is rotated, and a
    corner leads left."""
    pixels = route_patch_at(Pose(20.0, 0.0, 0.0), np.array([(-100.0, 0.0), (100.0, 0.0)]))
    assert (
        pixels.shape == (80, 80) and pixels.dtype == np.uint8 and set(np.unique(pixels)) == {0, 255}
    )
    assert set(np.flatnonzero(pixels.any(axis=0))) == {39, 40} and (pixels[:, 39:41] == 255).all()
    aside = route_patch_at(Pose(20.0, 4.25, 0.0), np.array([(-100.0, 0.0), (100.0, 0.0)]))
    assert set(np.flatnonzero(aside.any(axis=0))) == {
        47,
        48,
        49,
    }  # 4.25 m to the right: column 48 is its middle
    ahead = goals("route_patch").at(Pose(30.0, 0.0, 0.0), 30.0)
    assert isinstance(ahead, RoutePatch)
    rows, columns = np.nonzero(ahead.pixels)
    assert (
        rows.min() == 19 and (ahead.pixels[:19] == 0).all()
    )  # the corner: row 19 is 10.25 m ahead
    assert (ahead.pixels[19:21, :40] == 255).all() and columns.min() == 0 and columns.max() == 40
    turned = route_patch_at(
        Pose(30.0, 0.0, -NORTH), np.array(CORNER)
    )  # looking right: the corner is to the left
    assert (np.rot90(ahead.pixels, 1) == turned).all()


def test_route_points_are_two_metres_apart_on_the_route() -> None:
    """They begin at the robot's place, in its frame, follow a corner, and end with the route."""
    ahead = goals("route_points").at(Pose(30.0, 1.0, 0.0), 30.0)
    assert isinstance(ahead, RoutePoints) and ahead.points_m.dtype == np.float32
    straight = [(2.0 * i, -1.0) for i in range(6)]
    corner = [(10.0, 2.0 * i - 1.0) for i in range(1, 6)]
    assert ahead.points_m.tolist() == [list(one) for one in straight + corner]
    assert ahead.mirrored().points_m[-1].tolist() == [10.0, -9.0]
    turned = goals("route_points").at(Pose(40.0, 55.0, NORTH), 95.0)
    assert isinstance(turned, RoutePoints)
    assert turned.points_m[:, 0] == pytest.approx([0, 2, 4, *(8 * [5])], abs=1e-6)


@pytest.mark.parametrize("protocol", sorted(GOALS))
def test_goals_are_the_same_for_the_same_seed(protocol: GoalProtocol) -> None:
    """A repeated drive has the same goals; where they are drawn, another seed gives others."""

    def drive(seed: int) -> list[bytes]:
        goal_source = goals(
            protocol,
            seed,
            size=(8, 6),
            take_picture=lambda pose: np.full((6, 8, 3), int(pose.x_m), np.uint8),
        )
        along = [
            goal_source.at(Pose(s_m, 0.5, 0.1), s_m) for s_m in np.arange(0.0, 40.0, 0.5).tolist()
        ]
        return [
            msgspec.msgpack.encode(one, enc_hook=lambda array: array.tobytes()) for one in along
        ]

    assert drive(5) == drive(5)
    assert (drive(5) != drive(6)) == protocol.startswith("random")


@pytest.mark.parametrize(
    "kind", [kind for kind in GOALS.values() if kind.type], ids=lambda kind: str(kind.name)
)
def test_a_type_of_goal_is_mirrored_copied_and_encoded(kind: GoalKind) -> None:
    """Mirrored twice, copied, or encoded and decoded it is equal, and a query carries its type."""
    assert kind.type is not None
    for goal in kind.type.example((8, 6)).probes().values():
        assert type(goal) is kind.type
        for same in (goal.mirrored().mirrored(), goal.copied(), decoded_goal(goal.encoded())):
            for name, value in msgspec.structs.asdict(goal).items():
                assert np.array_equal(getattr(same, name), value)
    left = kind.type.example((8, 6)).probes().get("left")
    if isinstance(left, TurningGoal):
        assert (left.turn(5.0, 20.0), left.mirrored().turn(5.0, 20.0)) == ("left", "right")


def test_unknown_goals_and_odometry_are_refused_with_the_valid_ones() -> None:
    """So are image goals for policies without a camera."""
    blind = Manifest("blind", camera=None)
    seeing = Manifest("seeing")
    with pytest.raises(
        UsageError, match=r"unknown goal protocol 'route_pont'.*Did you mean route_point\?"
    ):
        with_goal(seeing, "route_pont")  # type: ignore[arg-type]
    with pytest.raises(
        UsageError, match=r"unknown odometry 'imu'. Valid choices: exact, gps, none, wheel"
    ):
        with_goal(Manifest("odd", odometry="imu"), None)  # type: ignore[arg-type]
    with pytest.raises(
        UsageError, match=r"'blind' has no camera, and goal protocol 'image' .*one of none, route"
    ):
        with_goal(blind, "image")
    with pytest.raises(UsageError, match="'blind' has further cameras, but no main camera"):
        with_goal(Manifest("blind", camera=None, cameras={"left": CameraSpec()}), None)
    assert (
        with_goal(seeing, "image").goal == "image"
        and with_goal(Manifest("b", goal="instruction"), None).goal
    )


def test_goals_and_odometry_are_in_every_row() -> None:
    """A row has those that the policy got, and whether it was privileged."""
    manifest = with_goal(Manifest("mine", goal="image", odometry="wheel"), "route_point")
    row = table_row(record_of(scenario(), manifest))
    assert (row["goal_protocol"], row["odometry"], row["privileged"]) == (
        "route_point",
        "wheel",
        False,
    )


def test_a_calibration_follows_the_convention_of_computer_vision() -> None:
    """A point 1 m to the left, on the ground, 5 m ahead of the robot, projects where trigonometry
    puts it."""
    spec = CameraSpec(64, 48, 60.0, Mount((0.3, 0.0, 0.6), 10.0), Lens(k1=-0.1, k2=0.02))
    camera = calibration_of(spec, COURIER)
    assert np.allclose(camera.on_robot[:3, :3] @ camera.on_robot[:3, :3].T, np.eye(3))
    assert np.linalg.det(camera.on_robot) == pytest.approx(1.0)
    x, y, z = (np.linalg.inv(camera.on_robot) @ [5.0, 1.0, 0.0, 1.0])[:3]
    down = math.radians(10.0)
    assert (x, y, z) == pytest.approx(
        (
            -1.0,
            0.6 * math.cos(down) - 4.7 * math.sin(down),
            4.7 * math.cos(down) + 0.6 * math.sin(down),
        )
    )
    focal = 24.0 / math.tan(math.radians(30.0))
    assert (camera.matrix @ [x, y, z] / z)[:2] == pytest.approx(
        (31.5 + focal * x / z, 23.5 + focal * y / z)
    )
    assert camera.distortion.tolist() == [-0.1, 0.02, 0.0, 0.0, 0.0]
    aside = Mount((0.1, 0.25, 0.5), 0.0, yaw_left_deg=90.0)
    left = calibration_of(CameraSpec(64, 48, 60.0, aside, crop=(8, 10, 64, 48)), COURIER)
    seen = np.linalg.inv(left.on_robot) @ [
        0.1,
        3.25,
        0.5,
        1.0,
    ]  # 3 m to the left of it: on its axis
    assert seen[:3] == pytest.approx((0.0, 0.0, 3.0), abs=1e-12)
    assert (left.matrix @ seen[:3] / seen[2])[:2] == pytest.approx((31.5 - 8.0, 23.5 - 10.0))
