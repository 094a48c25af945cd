"""Goal protocols: the forms in which a policy gets its destination.

The manifest or the run (`--goal`) selects a protocol, a row of `GOALS`. Its goals are instances of
a subclass of `AnyGoal`, which mirrors, copies and serializes them. Goals depend on the reference
route, the robot's pose and a random generator, but not on people, events or the street.
"""

from __future__ import annotations

import math
import re
import string
from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Any, Final, Literal, NamedTuple, Protocol, Self, cast

import msgspec
import numpy as np
from numpy.typing import NDArray

from cosim.core.errors import unknown
from cosim.core.geometry import Floats, Polyline, Pose
from cosim.spec.camera import flipped
from cosim.spec.manoeuvres import instruction_at, manoeuvres
from cosim.spec.scenario import Scenario

GoalProtocol = Literal[
    "none",
    "route_point",
    "final_point",
    "random_point",
    "image",
    "random_image",
    "instruction",
    "route_patch",
    "route_points",
]
"""Names of the rows of `GOALS`."""
Turn = Literal["left", "straight", "right"]
Pixels = NDArray[np.uint8]
TakePicture = Callable[[Pose], Pixels]
"""Function that returns the camera's picture at a pose, (H, W, 3) uint8, without people."""

PATCH_PX: Final = 80
"""Rows and columns of a route patch."""
PATCH_M: Final = 0.5
"""Size of a route patch's pixel in metres. Pixels closer than this to the route are on it."""
ROUTE_POINTS: Final = 11
"""Number of points of the route in a goal."""
ROUTE_STEP_M: Final = 2.0
"""Distance between them along the route, in metres."""
_GREY: Final = 128
"""Grey value of an example picture."""
_FARTHEST_M: Final = 10_000.0
"""Largest coordinate of a point in a learner's space, in metres."""
_MAX_LETTERS: Final = 400
"""Largest length of an instruction in a learner's space, in characters."""
_NEAREST_M: Final = 5.0
"""Least distance of a sub-goal or random point, in metres."""
_FARTHEST_DRAWN_M: Final = 20.0
"""Largest distance of a sub-goal or random point, in metres."""
_ASIDE_M: Final = 5.0
"""Largest lateral offset of a random point, in metres."""
_REACHED_M: Final = 1.0
"""Distance at which a random point counts as reached, in metres."""
_SLACK_M: Final = 1e-6
"""Tolerance for rounding in metres."""
_ANNOUNCEMENT: Final = re.compile(r"(?:In (\d+) m, )?(?:turn|bear) (left|right)", re.IGNORECASE)
"""Pattern of a turn in an instruction, with its distance if it is not due."""


class ArraySpace(NamedTuple):
    """Array space of a type of goal for learners."""

    low: float
    high: float
    shape: tuple[int, ...]
    dtype: type[np.uint8] | type[np.float32]


class TextSpace(NamedTuple):
    """Text space of a type of goal for learners: at most `most` characters of `charset`."""

    most: int
    charset: str


class AnyGoal(msgspec.Struct, frozen=True):
    """Base class of goals. Fields are numbers, texts and arrays."""

    @classmethod
    def space(cls, size: tuple[int, int]) -> ArraySpace | TextSpace:
        """Return the space of the goal's plain values.

        size: width and height of the policy's pictures.
        """
        raise NotImplementedError

    @classmethod
    def example(cls, size: tuple[int, int]) -> Self:
        """Return a goal straight ahead, for testing a policy. `size` is as in `space`."""
        raise NotImplementedError

    def mirrored(self) -> Self:
        """Return the goal with left and right exchanged."""
        raise NotImplementedError

    def probes(self) -> Mapping[str, AnyGoal]:
        """Return goals of this type for the checks of `cosim policy check`, by name.

        "ahead" is required. The checks compare it with "left", "right" and "zero", and "left" with
        "near".
        """
        return {"ahead": self}

    def painted(self, paint: Callable[[Pixels], Pixels]) -> Self:
        """Return the goal with its picture edited, if it is a picture."""
        return self

    def copied(self) -> Self:
        """Return the goal with arrays of its own."""
        return type(self)(
            *(
                one.copy() if isinstance(one, np.ndarray) else one
                for one in msgspec.structs.astuple(self)
            )
        )

    def plain(self) -> NDArray[Any] | str:
        """Return the goal as an array or a text for learners."""
        return np.asarray(self)

    def encoded(self) -> dict[str, Any]:
        """Serialize the goal: its type as "type", and its fields as values and arrays."""
        return {"type": self.__struct_config__.tag, **msgspec.structs.asdict(self)}


class TurningGoal(AnyGoal, frozen=True):
    """Goal that implies a turn."""

    def turn(self, ahead_m: float, beyond_deg: float) -> Turn:
        """Return the side to turn to.

        ahead_m: maximum distance of a turn in metres.
        beyond_deg: minimum bearing of the goal in degrees.
        """
        raise NotImplementedError


class PointGoal(TurningGoal, frozen=True, tag="point"):
    """Point in the robot's frame in metres: x ahead, y to the left.

    >>> goal = PointGoal(3.0, 4.0)
    >>> goal.distance_m, np.asarray(goal)
    (5.0, array([3., 4.]))
    """

    x_m: float
    y_m: float

    @property
    def distance_m(self) -> float:
        return math.hypot(self.x_m, self.y_m)

    @property
    def bearing_rad(self) -> float:
        """Bearing, counter-clockwise from ahead, in (-pi, pi]."""
        return math.atan2(self.y_m, self.x_m)

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> NDArray[Any]:
        """Return (2,) float64 metres: x ahead, y to the left."""
        return np.array((self.x_m, self.y_m), dtype)

    @classmethod
    def space(cls, size: tuple[int, int]) -> ArraySpace:
        return ArraySpace(-_FARTHEST_M, _FARTHEST_M, (2,), np.float32)

    @classmethod
    def example(cls, size: tuple[int, int]) -> PointGoal:
        return PointGoal(10.0, 0.0)

    def mirrored(self) -> PointGoal:
        return PointGoal(self.x_m, -self.y_m)

    def probes(self) -> Mapping[str, PointGoal]:
        aside = {
            "left": PointGoal(10.0, 5.0),
            "right": PointGoal(10.0, -5.0),
            "near": PointGoal(5.0, 2.5),
        }
        return {"ahead": PointGoal(10.0, 0.0), **aside, "zero": PointGoal(0.0, 0.0)}

    def turn(self, ahead_m: float, beyond_deg: float) -> Turn:
        if abs(self.bearing_rad) <= math.radians(beyond_deg):
            return "straight"
        return "left" if self.bearing_rad > 0.0 else "right"


class ImageGoal(AnyGoal, frozen=True, tag="image"):
    """Picture at the destination: (H, W, 3) uint8, of the camera's size.

    >>> ImageGoal(np.zeros((96, 96, 3), np.uint8)).rgb.shape
    (96, 96, 3)
    """

    rgb: Pixels

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> NDArray[Any]:
        """Return the picture, (H, W, 3) uint8."""
        return np.array(self.rgb, dtype, copy=copy)

    @classmethod
    def space(cls, size: tuple[int, int]) -> ArraySpace:
        return ArraySpace(0, 255, (size[1], size[0], 3), np.uint8)

    @classmethod
    def example(cls, size: tuple[int, int]) -> ImageGoal:
        return ImageGoal(np.full((size[1], size[0], 3), _GREY, np.uint8))

    def mirrored(self) -> ImageGoal:
        return ImageGoal(flipped(self.rgb))

    def probes(self) -> Mapping[str, ImageGoal]:
        # The mirrored picture serves as "left"; its true side is unknown.
        return {"ahead": self, "left": self.mirrored(), "zero": ImageGoal(np.zeros_like(self.rgb))}

    def painted(self, paint: Callable[[Pixels], Pixels]) -> ImageGoal:
        return ImageGoal(paint(self.rgb))


class Instruction(TurningGoal, frozen=True, tag="instruction"):
    """Instruction as a text.

    >>> Instruction("Follow the sidewalk. In 10 m, turn left.").text
    'Follow the sidewalk. In 10 m, turn left.'
    """

    text: str

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> NDArray[Any]:
        """Raise TypeError: an instruction is a text."""
        raise TypeError(
            "an instruction is a text and no array: read observation.goal.text, or ask for "
            "another goal"
        )

    @classmethod
    def space(cls, size: tuple[int, int]) -> TextSpace:
        return TextSpace(_MAX_LETTERS, string.ascii_letters + string.digits + " .,")

    @classmethod
    def example(cls, size: tuple[int, int]) -> Instruction:
        return Instruction("Follow the sidewalk.")

    def mirrored(self) -> Instruction:
        text = self.text.replace("left", "\0").replace("right", "left")
        return Instruction(text.replace("\0", "right"))

    def probes(self) -> Mapping[str, Instruction]:
        texts = {
            "ahead": "Follow the sidewalk.",
            "left": "Turn left.",
            "right": "Turn right.",
            "zero": "",
        }
        return {name: Instruction(text) for name, text in texts.items()}

    def plain(self) -> str:
        return self.text

    def turn(self, ahead_m: float, beyond_deg: float) -> Turn:
        found = _ANNOUNCEMENT.search(self.text)
        if found is None or (found[1] is not None and float(found[1]) > ahead_m):
            return "straight"
        return "left" if found[2].lower() == "left" else "right"


class RoutePatch(AnyGoal, frozen=True, tag="route_patch"):
    """Raster of the reference route around the robot: (80, 80) uint8, 255 on the route, 0
    elsewhere.

    A pixel is 0.5 m wide. The robot is in the middle; the first row is 20 m ahead, the first column
    20 m to the left.

    >>> RoutePatch(np.zeros((80, 80), np.uint8)).pixels.max()
    np.uint8(0)
    """

    pixels: Pixels

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> NDArray[Any]:
        """Return the raster, (80, 80) uint8."""
        return np.array(self.pixels, dtype, copy=copy)

    @classmethod
    def space(cls, size: tuple[int, int]) -> ArraySpace:
        return ArraySpace(0, 255, (PATCH_PX, PATCH_PX), np.uint8)

    @classmethod
    def example(cls, size: tuple[int, int]) -> RoutePatch:
        return RoutePatch(np.zeros((PATCH_PX, PATCH_PX), np.uint8))

    def mirrored(self) -> RoutePatch:
        return RoutePatch(flipped(self.pixels))

    def probes(self) -> Mapping[str, RoutePatch]:
        # Routes that turn 6 m ahead.
        ends = {"ahead": (20.0, 0.0), "left": (6.0, 20.0), "right": (6.0, -20.0)}
        routes = {name: np.array([(-20.0, 0.0), (6.0, 0.0), end]) for name, end in ends.items()}
        turns = {
            name: RoutePatch(route_patch_at(Pose(0.0, 0.0, 0.0), route))
            for name, route in routes.items()
        }
        return {**turns, "zero": RoutePatch(np.zeros_like(self.pixels))}


class RoutePoints(AnyGoal, frozen=True, tag="route_points"):
    """Points of the reference route in the robot's frame: (11, 2) float32 metres.

    The first is the robot's place on the route, the next ones are 2 to 20 m along it. At the end of
    the route the last point repeats.

    >>> RoutePoints(np.zeros((11, 2), np.float32)).points_m.shape
    (11, 2)
    """

    points_m: NDArray[np.float32]

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> NDArray[Any]:
        """Return the points, (11, 2) float32."""
        return np.array(self.points_m, dtype, copy=copy)

    @classmethod
    def space(cls, size: tuple[int, int]) -> ArraySpace:
        return ArraySpace(-_FARTHEST_M, _FARTHEST_M, (ROUTE_POINTS, 2), np.float32)

    @classmethod
    def example(cls, size: tuple[int, int]) -> RoutePoints:
        return RoutePoints(route_points_at(Pose(0.0, 0.0, 0.0), 0.0, Polyline([(0, 0), (30, 0)])))

    def mirrored(self) -> RoutePoints:
        return RoutePoints(self.points_m * np.array([1, -1], np.float32))

    def probes(self) -> Mapping[str, RoutePoints]:
        # Routes that turn by 45 degrees 6 m ahead.
        sides = {"ahead": 0.0, "left": 24.0, "right": -24.0}
        routes = {name: Polyline([(0, 0), (6, 0), (30, side)]) for name, side in sides.items()}
        turns = {
            name: RoutePoints(route_points_at(Pose(0.0, 0.0, 0.0), 0.0, route))
            for name, route in routes.items()
        }
        return {**turns, "zero": RoutePoints(np.zeros_like(self.points_m))}


Goal = PointGoal | ImageGoal | Instruction | RoutePatch | RoutePoints
"""Any goal of a policy."""


class Goals(Protocol):
    """Goals of an episode."""

    def at(self, pose: Pose, route_s_m: float) -> Goal | None:
        """Return the goal of a robot at this pose and arc length of the route."""

    def on_reset(self) -> None:
        """Discard state that is invalid after the robot was reset to another pose."""


class GoalSource(NamedTuple):
    """Inputs for the goals of an episode.

    draws: generator of all random draws.
    size: width and height of the policy's pictures, 0 without a camera.
    take_picture: takes the camera's picture at a pose, for goals that are pictures.
    """

    scenario: Scenario
    draws: np.random.Generator
    size: tuple[int, int] = (0, 0)
    take_picture: TakePicture | None = None


class GoalKind(NamedTuple):
    """A goal protocol.

    summary: one line for `cosim list` and the documentation.
    type: class of its goals; None for no goals.
    draw: returns the goals of an episode.
    needs_camera: whether the goals are camera pictures, so that the policy needs a camera.
    noise: whether the goals carry no information.
    has_data_set_column: whether a data set has a column for the goals (`cosim collect`).
    """

    name: GoalProtocol
    summary: str
    type: type[Goal] | None
    draw: Callable[[GoalSource], Goals]
    needs_camera: bool = False
    noise: bool = False
    has_data_set_column: bool = False


def in_robot_frame(pose: Pose, point: Pose) -> PointGoal:
    """Return a point in the frame of a robot at a pose."""
    dx, dy = point.x_m - pose.x_m, point.y_m - pose.y_m
    cos, sin = math.cos(pose.heading_rad), math.sin(pose.heading_rad)
    return PointGoal(cos * dx + sin * dy, -sin * dx + cos * dy)


class SubGoals:
    """Selects the next sub-goal on the route, by arc length.

    It is 20 m ahead and stays until 5 m are left, or until a reset puts the robot too far from it.
    In the last 20 m it is the end of the route.

    >>> subgoals = SubGoals(100.0)
    >>> [subgoals.after(s_m) for s_m in (0.0, 14.0, 16.0, 85.0)]
    [20.0, 20.0, 36.0, 100.0]
    """

    def __init__(self, length_m: float) -> None:
        self._length_m = length_m
        self._s_m = math.nan

    def after(self, route_s_m: float) -> float:
        """Return the sub-goal's arc length for a robot at this arc length."""
        if not _NEAREST_M - _SLACK_M <= self._s_m - route_s_m <= _FARTHEST_DRAWN_M + _SLACK_M:
            self._s_m = min(route_s_m + _FARTHEST_DRAWN_M, self._length_m)
        return self._s_m


class _PositionGoals:
    """Goals that depend only on the robot's position."""

    def __init__(self, goal: Callable[[Pose, float], Goal | None]) -> None:
        self._goal = goal

    def at(self, pose: Pose, route_s_m: float) -> Goal | None:
        return self._goal(pose, route_s_m)

    def on_reset(self) -> None:
        """Nothing to forget."""


class _RandomPoints:
    """Random points in the robot's frame, fixed in the street until reached or no longer ahead."""

    def __init__(self, draws: np.random.Generator) -> None:
        self._draws = draws
        self._point: Pose | None = None

    def at(self, pose: Pose, route_s_m: float) -> PointGoal:
        goal = None if self._point is None else in_robot_frame(pose, self._point)
        if goal is None or goal.distance_m <= _REACHED_M or goal.x_m <= 0.0:
            ahead, aside = self._draws.uniform(
                (_NEAREST_M, -_ASIDE_M), (_FARTHEST_DRAWN_M, _ASIDE_M)
            ).tolist()
            cos, sin = math.cos(pose.heading_rad), math.sin(pose.heading_rad)
            self._point = Pose(
                pose.x_m + cos * ahead - sin * aside, pose.y_m + sin * ahead + cos * aside, 0.0
            )
            goal = PointGoal(ahead, aside)
        return goal

    def on_reset(self) -> None:
        self._point = None


class _ImageGoals:
    """Pictures at the sub-goals along the route, taken when a sub-goal is selected."""

    def __init__(self, route: Polyline, take_picture: TakePicture) -> None:
        self._route = route
        self._take_picture = take_picture
        self._subgoals = SubGoals(route.length_m)
        self._taken_s_m = math.nan
        self._goal = ImageGoal(np.zeros((0, 0, 3), np.uint8))

    def at(self, pose: Pose, route_s_m: float) -> ImageGoal:
        s_m = self._subgoals.after(route_s_m)
        if s_m != self._taken_s_m:
            self._taken_s_m, self._goal = s_m, ImageGoal(self._take_picture(self._route.at(s_m)))
        return self._goal

    def on_reset(self) -> None:
        """Nothing to discard: the sub-goals detect a reset themselves."""


_PIXELS: Final = np.moveaxis(np.mgrid[:PATCH_PX, :PATCH_PX], 0, -1)
"""(80, 80, 2) row and column of the pixels of a raster."""


def route_patch_at(pose: Pose, route: Floats) -> NDArray[np.uint8]:
    """Return a raster as in `RoutePatch`, (80, 80) uint8.

    route: (N, 2) points in metres.
    """
    cos, sin = math.cos(pose.heading_rad), math.sin(pose.heading_rad)
    offset = route - pose.xy
    ahead_left = offset @ np.array([[cos, -sin], [sin, cos]])
    at = 0.5 * (PATCH_PX - 1) - ahead_left / PATCH_M  # row and column, integers at pixel centres
    low = np.maximum(np.ceil(np.minimum(at[:-1], at[1:]) - 1.0), 0.0).astype(int)
    high = np.minimum(np.floor(np.maximum(at[:-1], at[1:]) + 1.0) + 1.0, PATCH_PX).astype(int)
    pixels = np.zeros((PATCH_PX, PATCH_PX), np.uint8)
    for i in np.flatnonzero((low < high).all(axis=1)).tolist():
        (top, left) = low[i]
        (bottom, right) = high[i]
        step = at[i + 1] - at[i]
        off = _PIXELS[top:bottom, left:right] - at[i]
        along = np.clip(off @ step / max(float(step @ step), 1e-12), 0.0, 1.0)
        off -= along[..., None] * step
        pixels[top:bottom, left:right][(off * off).sum(axis=-1) <= 1.0] = 255
    return pixels


def route_points_at(pose: Pose, route_s_m: float, route: Polyline) -> NDArray[np.float32]:
    """Return the points of `RoutePoints` for a robot at a pose and arc length, (11, 2) float32."""
    places = (route_s_m + ROUTE_STEP_M * i for i in range(ROUTE_POINTS))
    points = [in_robot_frame(pose, route.at(min(s_m, route.length_m))) for s_m in places]
    return np.array([(point.x_m, point.y_m) for point in points], np.float32)


def _along_route(source: GoalSource) -> Goals:
    route = source.scenario.route_line
    return _PositionGoals(lambda pose, s_m: RoutePoints(route_points_at(pose, s_m, route)))


def _route_points(source: GoalSource) -> Goals:
    route = source.scenario.route_line
    subgoals = SubGoals(route.length_m)
    return _PositionGoals(lambda pose, s_m: in_robot_frame(pose, route.at(subgoals.after(s_m))))


def _final_points(source: GoalSource) -> Goals:
    end = Pose(*source.scenario.goal, 0.0)
    return _PositionGoals(lambda pose, s_m: in_robot_frame(pose, end))


def _images(source: GoalSource) -> Goals:
    assert source.take_picture is not None, "image goals need a camera"
    return _ImageGoals(source.scenario.route_line, source.take_picture)


def _random_images(source: GoalSource) -> Goals:
    noise = ImageGoal(source.draws.integers(0, 256, (source.size[1], source.size[0], 3), np.uint8))
    return _PositionGoals(lambda pose, s_m: noise)


def _instructions(source: GoalSource) -> Goals:
    steps = manoeuvres(source.scenario.route_line, source.scenario.crossings)
    return _PositionGoals(lambda pose, s_m: Instruction(instruction_at(s_m, steps)))


def _route_patches(source: GoalSource) -> Goals:
    points = source.scenario.route_line.points
    return _PositionGoals(lambda pose, s_m: RoutePatch(route_patch_at(pose, points)))


_ROWS: Final = (
    GoalKind(
        "none",
        "no goal",
        None,
        lambda source: _PositionGoals(lambda pose, s_m: None),
        noise=True,
        has_data_set_column=True,
    ),
    GoalKind(
        "route_point",
        "the next point of the reference route, 5 to 20 m along it; in the last 20 m its end",
        PointGoal,
        _route_points,
        has_data_set_column=True,
    ),
    GoalKind(
        "final_point",
        "the goal of the episode, as a point",
        PointGoal,
        _final_points,
        has_data_set_column=True,
    ),
    GoalKind(
        "random_point",
        "a random point, 5 to 20 m ahead and up to 5 m aside",
        PointGoal,
        lambda source: _RandomPoints(source.draws),
    ),
    GoalKind(
        "image",
        "what the policy's camera would see at the next point of the route, without people",
        ImageGoal,
        _images,
        needs_camera=True,
    ),
    GoalKind(
        "random_image",
        "a picture of noise, drawn once per episode",
        ImageGoal,
        _random_images,
        needs_camera=True,
        noise=True,
    ),
    GoalKind(
        "instruction",
        'a text, such as "Follow the sidewalk. In 10 m, turn left."',
        Instruction,
        _instructions,
        has_data_set_column=True,
    ),
    GoalKind(
        "route_patch",
        "a raster of the reference route around the robot, 80 x 80 pixels of 0.5 m",
        RoutePatch,
        _route_patches,
    ),
    GoalKind(
        "route_points",
        "the reference route from the robot's place to 20 m ahead, as points 2 m apart",
        RoutePoints,
        _along_route,
    ),
)
"""Rows of `GOALS`."""
GOALS: Final[Mapping[GoalProtocol, GoalKind]] = MappingProxyType(
    {kind.name: kind for kind in _ROWS}
)
"""Goal protocols by name. Points and rasters are in the robot's frame."""
_TYPES: Final = {
    kind.type.__struct_config__.tag: kind.type for kind in _ROWS if kind.type is not None
}
"""Class of goals by its name in messages."""


def goal_called(name: str) -> GoalProtocol:
    """Return the protocol with a name. Raises UsageError with the valid names."""
    if name not in GOALS:
        raise unknown("goal protocol", name, GOALS)
    return cast(GoalProtocol, name)


def goals_for(
    protocol: GoalProtocol,
    scenario: Scenario,
    draws: np.random.Generator,
    size: tuple[int, int] = (0, 0),
    take_picture: TakePicture | None = None,
) -> Goals:
    """Return the goals of a scenario. The arguments are those of `GoalSource`."""
    return GOALS[protocol].draw(GoalSource(scenario, draws, size, take_picture))


def decoded_goal(fields: Mapping[str, Any]) -> Goal:
    """Deserialize a goal from the output of `AnyGoal.encoded`. Raises KeyError or TypeError."""
    values = dict(fields)
    return _TYPES[values.pop("type")](**values)


def protocols_of(*types: type[AnyGoal]) -> tuple[GoalProtocol, ...]:
    """Return the protocols whose goals have one of these types.

    >>> protocols_of(PointGoal)
    ('route_point', 'final_point', 'random_point')
    """
    return tuple(
        kind.name for kind in _ROWS if kind.type is not None and issubclass(kind.type, types)
    )


def max_goal_bytes(size: tuple[int, int]) -> int:
    """Return the size of the largest goal array in bytes.

    size: width and height of the policy's pictures.
    """
    spaces = [kind.type.space(size) for kind in _ROWS if kind.type is not None]
    return max(
        math.prod(one.shape) * np.dtype(one.dtype).itemsize
        for one in spaces
        if isinstance(one, ArraySpace)
    )
