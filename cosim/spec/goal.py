"""Goals: what a policy is told of where to go, by a protocol that its manifest names or the run
gives (`--goal`)."""

from __future__ import annotations

import math
from collections.abc import Mapping
from types import MappingProxyType
from typing import Any, Final, Literal, cast

import msgspec
import numpy as np
from numpy.typing import NDArray

from cosim.core.errors import unknown

GoalProtocol = Literal[
    "none",
    "route_point",
    "final_point",
    "random_point",
    "image",
    "random_image",
    "instruction",
    "route_patch",
]

GOALS: Final[Mapping[str, str]] = MappingProxyType(
    {
        "none": "nothing",
        "route_point": "the next sub-goal: a point of the reference route, 5 to 20 m along it",
        "final_point": "the goal of the episode, as a point",
        "random_point": "a point drawn 5 to 20 m ahead and up to 5 m aside, anew when it is "
        "reached or passed",
        "image": "what the policy's camera would see at the next sub-goal, with nobody in the "
        "street",
        "random_image": "a picture of noise, drawn once for each episode",
        "instruction": "'Follow the sidewalk.', with each turn and crosswalk of the route before "
        "it comes",
        "route_patch": "a raster of the reference route around the robot, 80 x 80 pixels of 0.5 m",
    }
)
"""What a policy gets by each protocol. Points, and what is around the robot, are in the robot's
frame."""


class PointGoal(msgspec.Struct, frozen=True, tag="point"):
    """A point in the robot's frame, in metres: x ahead, y to the left.

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
        """Where it lies, counter-clockwise from ahead, in (-pi, pi]."""
        return math.atan2(self.y_m, self.x_m)

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> NDArray[Any]:
        """(2,) float64 metres: x ahead, y to the left."""
        return np.array((self.x_m, self.y_m), dtype)


class ImageGoal(msgspec.Struct, frozen=True, tag="image"):
    """A picture of where to go: (H, W, 3) uint8, as large as the camera's.

    >>> ImageGoal(np.zeros((96, 96, 3), np.uint8)).rgb.shape
    (96, 96, 3)
    """

    rgb: NDArray[np.uint8]

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> NDArray[Any]:
        """(H, W, 3) uint8."""
        return np.array(self.rgb, dtype, copy=copy)


class Instruction(msgspec.Struct, frozen=True, tag="instruction"):
    """What to do, in words.

    >>> Instruction("Follow the sidewalk. In 10 m, turn left.").text
    'Follow the sidewalk. In 10 m, turn left.'
    """

    text: str

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> NDArray[Any]:
        """Raises TypeError: it is a text."""
        raise TypeError(
            "an instruction is a text and no array: read observation.goal.text, or ask for "
            "another goal"
        )


class RoutePatch(msgspec.Struct, frozen=True, tag="route_patch"):
    """The reference route around the robot: (80, 80) uint8, 255 on the route and 0 beside it, 0.5 m
    a pixel.

    The robot is in the middle; the first row lies 20 m ahead, the first column 20 m to the left.

    >>> RoutePatch(np.zeros((80, 80), np.uint8)).pixels.max()
    np.uint8(0)
    """

    pixels: NDArray[np.uint8]

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> NDArray[Any]:
        """(80, 80) uint8."""
        return np.array(self.pixels, dtype, copy=copy)


Goal = PointGoal | ImageGoal | Instruction | RoutePatch


def own_goal(goal: Goal | None) -> Goal | None:
    """The same goal, in an array of its own."""
    if isinstance(goal, ImageGoal):
        return ImageGoal(goal.rgb.copy())
    return RoutePatch(goal.pixels.copy()) if isinstance(goal, RoutePatch) else goal


def goal_called(name: str) -> GoalProtocol:
    """The protocol of that name. Raises UsageError, listing them, when there is none."""
    if name not in GOALS:
        raise unknown("goal protocol", name, GOALS)
    return cast(GoalProtocol, name)
