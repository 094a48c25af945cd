"""Inputs of a graph: the manifest field `inputs`.

{"what": "picture", "frames": 6, "size": [85, 64], "layout": "N(TC)HW", "mean": [0.485, 0.456,
 0.406], "std": [0.229, 0.224, 0.225]}
{"what": "goal_point", "values": ["distance", "cos", "sin"], "unit_m": 200, "most_m": 200}
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from typing import Annotated, ClassVar, Final, Literal

from cosim.spec.goal import (
    GOALS,
    AnyGoal,
    Goal,
    GoalProtocol,
    ImageGoal,
    PointGoal,
    RoutePatch,
    TurningGoal,
    protocols_of,
)
from cosim.spec.validation import ItemCount, Ranged, Within

_NUMBER: Final = Within(-1e9, 1e9)
_SIDE: Final = Within(1, 4096)
_AXES: Final = {"N", "T", "C", "H", "W"}


class AnyInput(Ranged, frozen=True, kw_only=True):
    """Base class of all inputs."""

    made_of: ClassVar[type[AnyGoal] | None] = None
    """Type of goal that the input needs, if any; such an input has a field `missing`."""

    @property
    def prefix(self) -> str:
        return f"{self.__struct_config__.tag} "

    @property
    def needs(self) -> tuple[GoalProtocol, ...]:
        """Goal protocols that the input can use; () without a goal or with `missing`."""
        return (
            protocols_of(self.made_of)
            if self.made_of and getattr(self, "missing", None) is None
            else ()
        )

    def takes(self, goal: Goal | None) -> bool:
        """Return whether the input can use this goal."""
        return self.made_of is not None and isinstance(goal, self.made_of)


class PastInput(AnyInput, frozen=True, kw_only=True):
    """History of `frames` values, one of `every` commands of the policy, including the current.

    before: Values before the episode began or the robot was moved: the first one repeated, or
        zeros.
    """

    frames: Annotated[int, Within(1, 256)] = 1
    every: Annotated[int, Within(1, 256)] = 1
    order: Literal["oldest_first", "newest_first"] = "oldest_first"
    before: Literal["repeat", "zeros"] = "repeat"


class VectorInput(PastInput, frozen=True, kw_only=True):
    """Numbers (frames, values), reshaped to the graph's input.

    mean, std: One of each value, which becomes (value - mean) / std; empty for 0 and 1.
    """

    values: tuple[str, ...] = ()
    mean: Annotated[tuple[float, ...], ItemCount(0, 16)] = ()
    std: Annotated[tuple[float, ...], ItemCount(0, 16)] = ()

    def contradictions(self) -> Iterator[str]:
        yield from _normalised(self.prefix, self.mean, self.std, len(self.values))


class PixelsInput(PastInput, frozen=True, kw_only=True):
    """Pictures.

    size: Width and height in pixels.
    crop: Part of the picture to use, as fractions (x0, y0, x1, y1) of its sides.
    fit: How the part is brought to `size`: stretched, cropped to its aspect ratio, or whole in the
        middle (letterbox) or in the upper left corner.
    border: Grey value (0 to 255) around a whole picture.
    resample: Interpolation.
    colour: Order of channels; yuv420 is six channels of half the size (four of Y, U, V) as in
        openpilot.
    scale, mean, std: A number becomes (pixel / scale - mean) / std; scale 1 leaves 0 to 255, which
        a uint8 graph needs.
    layout: Axes of the graph, outermost first: N of 1, T frames, C channels, H rows, W columns.
        Letters in brackets are one axis: "N(TC)HW" stacks frames into channels. N may be absent; T
        and C may be absent if they are 1.
    """

    size: tuple[Annotated[int, _SIDE], Annotated[int, _SIDE]]
    fit: Literal["stretch", "crop", "letterbox", "corner"] = "stretch"
    crop: tuple[float, float, float, float] | None = None
    border: Annotated[int, Within(0, 255)] = 114
    resample: Literal["area", "linear", "cubic", "nearest"] = "area"
    colour: Literal["rgb", "bgr", "grey", "yuv420"] = "rgb"
    scale: Annotated[float, Within(0, 1e6, above=True)] = 255.0
    mean: Annotated[tuple[float, ...], ItemCount(0, 6)] = ()
    std: Annotated[tuple[float, ...], ItemCount(0, 6)] = ()
    layout: str = "NCHW"

    @property
    def channels(self) -> int:
        """Number of channels of a frame."""
        return {"grey": 1, "yuv420": 6}.get(self.colour, 3)

    @property
    def keeps_bytes(self) -> bool:
        """Whether pixels stay bytes."""
        return self.scale == 1.0 and not self.mean and not self.std

    @property
    def sides(self) -> tuple[int, int]:
        """Rows and columns of the tensor."""
        width, height = self.size
        return (height // 2, width // 2) if self.colour == "yuv420" else (height, width)

    def contradictions(self) -> Iterator[str]:
        yield from _normalised(self.prefix, self.mean, self.std, self.channels)
        yield layout_fault(self.prefix, self.layout, T=self.frames, C=self.channels)
        if not all(_SIDE.low <= side <= _SIDE.high for side in self.size):
            yield f"{self.prefix}size must be two sides of {_SIDE} pixels, not {list(self.size)}"
        elif self.colour == "yuv420" and (self.size[0] % 2 or self.size[1] % 2):
            yield f"{self.prefix}size must be even for yuv420, not {list(self.size)}"
        if self.crop is not None and not (
            0.0 <= self.crop[0] < self.crop[2] <= 1.0 and 0.0 <= self.crop[1] < self.crop[3] <= 1.0
        ):
            yield (
                f"{self.prefix}crop must be shares [x0, y0, x1, y1] with 0 <= x0 < x1 <= 1, not "
                f"{list(self.crop)}"
            )


class PictureInput(PixelsInput, frozen=True, kw_only=True, tag="picture", tag_field="what"):
    """Camera image.

    camera: A name in `cameras`; "" for `camera`.

    >>> PictureInput(size=(85, 64), frames=6, layout="N(TC)HW").channels
    3
    """

    camera: str = ""


class GoalPictureInput(
    PixelsInput, frozen=True, kw_only=True, tag="goal_picture", tag_field="what"
):
    """Goal picture.

    missing: Fills the tensor if a run has no goal picture; None: refused.
    """

    made_of = ImageGoal
    missing: Annotated[float | None, _NUMBER] = None


class GoalPointInput(VectorInput, frozen=True, kw_only=True, tag="goal_point", tag_field="what"):
    """Goal point in the robot's frame.

    values: x, y and distance in units of `unit_m`; bearing in radians, counter-clockwise from
        ahead.
    most_m: Upper bound of the distance in metres; x and y are scaled in proportion.
    missing: Normalised values if a run has no goal point; None: refused.
    """

    made_of = PointGoal
    values: Annotated[
        tuple[
            Literal["x", "-x", "y", "-y", "distance", "cos", "sin", "-sin", "bearing", "-bearing"],
            ...,
        ],
        ItemCount(1, 8),
    ] = ("x", "y")
    unit_m: Annotated[float, Within(0, 1e6, above=True)] = 1.0
    most_m: Annotated[float | None, Within(0, 1e6, above=True)] = None
    missing: tuple[float, ...] | None = None

    def contradictions(self) -> Iterator[str]:
        yield from super().contradictions()
        if self.missing is not None and len(self.missing) != len(self.values):
            yield (
                f"goal_point missing must hold {len(self.values)} numbers, one of each value, "
                f"not {len(self.missing)}"
            )


class RoutePatchInput(PastInput, frozen=True, kw_only=True, tag="route_patch", tag_field="what"):
    """Raster of the route around the robot (`cosim.spec.goal.RoutePatch`).

    on, off: Values of pixels on and off the route.
    missing: Fills the tensor if a run has no route patch; None: refused.
    """

    made_of = RoutePatch
    on: Annotated[float, _NUMBER] = 1.0
    off: Annotated[float, _NUMBER] = 0.0
    layout: str = "NCHW"
    missing: Annotated[float | None, _NUMBER] = None

    def contradictions(self) -> Iterator[str]:
        yield layout_fault(self.prefix, self.layout, T=self.frames, C=1)


class TurnInput(AnyInput, frozen=True, kw_only=True, tag="command", tag_field="what"):
    """Direction to take: the numbers of left, straight or right.

    ahead_m: Distance in metres from which an instruction applies.
    beyond_deg: Bearing in degrees from which a goal point is to the left or right.
    missing: Numbers for other goals; None: refused.
    """

    made_of = TurningGoal
    left: Annotated[tuple[float, ...], ItemCount(1, 16)] = (-1.0,)
    straight: Annotated[tuple[float, ...], ItemCount(1, 16)] = (0.0,)
    right: Annotated[tuple[float, ...], ItemCount(1, 16)] = (1.0,)
    ahead_m: Annotated[float, Within(0, 20)] = 5.0
    beyond_deg: Annotated[float, Within(0, 180)] = 30.0
    missing: Annotated[tuple[float, ...] | None, ItemCount(1, 16)] = None

    def contradictions(self) -> Iterator[str]:
        counts = {
            len(one)
            for one in (self.left, self.straight, self.right, self.missing)
            if one is not None
        }
        if len(counts) > 1:
            yield "command left, straight, right and missing must hold as many numbers each"


class SpeedsInput(VectorInput, frozen=True, kw_only=True, tag="speeds", tag_field="what"):
    """Robot's own speeds in m/s and rad/s."""

    values: Annotated[tuple[Literal["v", "w", "-w"], ...], ItemCount(1, 8)] = ("v", "w")


class PastPositionsInput(
    VectorInput, frozen=True, kw_only=True, tag="past_positions", tag_field="what"
):
    """Past positions by odometry in the current robot frame; the last one is the origin.

    values: x and y in units of `unit_m`; heading in radians, counter-clockwise from the current
        one.
    """

    values: Annotated[
        tuple[Literal["x", "-x", "y", "-y", "cos", "sin", "-sin", "heading", "-heading"], ...],
        ItemCount(1, 8),
    ] = ("x", "y")
    unit_m: Annotated[float, Within(0, 1e6, above=True)] = 1.0


class ScanInput(PastInput, frozen=True, kw_only=True, tag="scan", tag_field="what"):
    """Distances of the lidar in units of `unit_m`, ring by ring, counter-clockwise from behind.

    sectors: Number of equal sectors of a ring, of which the smallest distance is taken; 0 for all
        rays.
    clockwise: Whether bearings fall.
    most_m: Upper bound of a distance in metres, and its value without a return; None: the range.
    """

    sectors: Annotated[int, Within(0, 4096)] = 0
    clockwise: bool = False
    unit_m: Annotated[float, Within(0, 1e6, above=True)] = 1.0
    most_m: Annotated[float | None, Within(0, 1e6, above=True)] = None


class ImuInput(VectorInput, frozen=True, kw_only=True, tag="imu", tag_field="what"):
    """Reading of the inertial sensor: angular speeds in rad/s, specific force in m/s2."""

    values: Annotated[
        tuple[Literal["gyro_x", "gyro_y", "gyro_z", "accel_x", "accel_y", "accel_z"], ...],
        ItemCount(1, 8),
    ] = ("gyro_x", "gyro_y", "gyro_z", "accel_x", "accel_y", "accel_z")


class PeopleInput(PastInput, frozen=True, kw_only=True, tag="people", tag_field="what"):
    """Tracked people in the robot's frame, a row each, nearest first.

    rows: Number of rows; farther people are left out.
    values: Positions and distances in m, velocities in m/s, and 1 for a person.
    absent: Fills rows without a person.
    """

    rows: Annotated[int, Within(1, 256)]
    values: Annotated[
        tuple[Literal["x", "-x", "y", "-y", "distance", "vx", "-vx", "vy", "-vy", "present"], ...],
        ItemCount(1, 8),
    ] = ("x", "y", "vx", "vy")
    absent: Annotated[float, _NUMBER] = 0.0


class MaskInput(AnyInput, frozen=True, kw_only=True, tag="mask", tag_field="what"):
    """Number that says whether there is a goal that another input uses."""

    given: Annotated[float, _NUMBER] = 0.0
    missing: Annotated[float, _NUMBER] = 1.0


class ConstantInput(AnyInput, frozen=True, kw_only=True, tag="constant", tag_field="what"):
    """Constant: one number for the whole tensor, or all numbers in row-major order."""

    value: float | tuple[float, ...]


class NoiseInput(AnyInput, frozen=True, kw_only=True, tag="noise", tag_field="what"):
    """Normal noise, drawn for every command from the episode's seed."""


class StateInput(AnyInput, frozen=True, kw_only=True, tag="state", tag_field="what"):
    """Recurrent state: the output `output` of the previous call.

    append: Append the output as a row and drop the oldest row.
    begin: Fills the tensor when an episode begins or the robot was moved.
    """

    output: str
    append: bool = False
    begin: Annotated[float, _NUMBER] = 0.0


_Part = (
    GoalPointInput
    | SpeedsInput
    | PastPositionsInput
    | TurnInput
    | ConstantInput
    | ScanInput
    | ImuInput
    | PeopleInput
)


class JoinedInput(AnyInput, frozen=True, kw_only=True, tag="joined", tag_field="what"):
    """Concatenated vectors."""

    parts: Annotated[tuple[_Part, ...], ItemCount(1, 8)]

    @property
    def needs(self) -> tuple[GoalProtocol, ...]:
        return common_goals(self.parts)

    def takes(self, goal: Goal | None) -> bool:
        return any(part.takes(goal) for part in self.parts)

    def contradictions(self) -> Iterator[str]:
        if any(part.needs for part in self.parts) and not self.needs:
            yield "joined parts need goals that no run can give at once"


GraphInput = (
    PictureInput
    | GoalPictureInput
    | GoalPointInput
    | RoutePatchInput
    | TurnInput
    | SpeedsInput
    | PastPositionsInput
    | ScanInput
    | ImuInput
    | PeopleInput
    | MaskInput
    | ConstantInput
    | NoiseInput
    | StateInput
    | JoinedInput
)


def common_goals(inputs: Iterable[AnyInput]) -> tuple[GoalProtocol, ...]:
    """Return the protocols that all of these inputs can use; () if they need none."""
    wanted = [set(one.needs) for one in inputs if one.needs]
    return tuple(name for name in GOALS if wanted and name in set.intersection(*wanted))


def axes_of(layout: str) -> list[str]:
    """Return the axes of a layout, outermost first; letters in brackets are one axis.

    >>> axes_of("N(TC)HW")
    ['N', 'TC', 'H', 'W']
    """
    groups: list[str] = []
    inside = False
    for letter in layout:
        if letter in "()":
            inside = letter == "("
            groups.append("")
        elif inside:
            groups[-1] += letter
        else:
            groups.append(letter)
    return [group for group in groups if group]


def layout_fault(called: str, layout: str, **counts: int) -> str:
    """Return the fault of a layout for given numbers of frames T and channels C; "" if valid."""
    groups = axes_of(layout)
    letters = "".join(groups)
    brackets = layout.replace("(", "").replace(")", "") == letters and layout.count(
        "("
    ) == layout.count(")")
    if not brackets or len(set(letters)) != len(letters) or not {"H", "W"} <= set(letters) <= _AXES:
        return (
            f"{called}layout must be of the letters N T C H W, once each, with H and W, such as "
            f"N(TC)HW: not {layout!r}"
        )
    absent = [
        f"{letter} of {count}"
        for letter, count in counts.items()
        if count > 1 and letter not in letters
    ]
    return f"{called}layout {layout!r} has no axis for {', '.join(absent)}" if absent else ""


def _normalised(
    called: str, mean: Sequence[float], std: Sequence[float], count: int
) -> Iterator[str]:
    """Yield faults of the mean and standard deviation of `count` values."""
    for field, numbers in (("mean", mean), ("std", std)):
        if numbers and len(numbers) != count:
            yield f"{called}{field} must hold {count} numbers or none, not {len(numbers)}"
        elif not all(abs(number) < _NUMBER.high for number in numbers) or (
            field == "std" and not all(numbers)
        ):
            yield (
                f"{called}{field} must hold finite numbers{', not 0' if field == 'std' else ''}: "
                f"{list(numbers)}"
            )
