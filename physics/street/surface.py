"""Surface: what wheels and feet stand on. The world and the cameras take one and do not know what
it was made from.

A surface is cut into the squares of physics.ground.tiles, so that only what is near is held. Two
methods make one, `heights` and `chunk`; what stands on a street (signals, textures, paint) is told
by those that a plain one inherits.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from cosim.core.cache import Arrays
from cosim.core.geometry import Floats, Pose
from cosim.spec.obstacle import Obstacle
from physics.ground.mesh import Mesh
from physics.ground.tiles import Key
from physics.street.buildings import Building
from physics.street.furniture import Prop, obstacle_prop
from physics.street.props import SignalPost
from physics.textures.facades import WallStyle
from physics.textures.layers import Colour

_WHEELS: Final = np.array([0.32, 0.4])
"""Where a vehicle's wheels are, as shares of its length and width from its middle."""


class Patch(NamedTuple):
    """Triangles of one material. friction: against a tyre of 1.0; label: of
    cosim.core.state.LABELS; layer: of physics.textures.ground, which cameras with textures show, in
    the colour if it is tinted."""

    name: str
    mesh: Mesh
    friction: float
    label: str
    colour: Colour
    layer: str
    tinted: bool = True


@dataclass(frozen=True, slots=True)
class Chunk:
    """What is in a square: ground, buildings, and props with the heights of their feet in
    metres."""

    ground: tuple[Patch, ...]
    buildings: tuple[Building, ...] = ()
    props: tuple[tuple[Prop, float], ...] = ()


@dataclass(frozen=True, slots=True)
class Finish:
    """What cameras with textures add to a chunk. laid: thin covers, drawn before the ground they
    lie on; painted: what changes colours alone; styles: of the chunk's buildings, one each."""

    laid: tuple[Patch, ...] = ()
    painted: tuple[Patch, ...] = ()
    styles: tuple[WallStyle, ...] = ()


class Surface(ABC):
    """Heights, and chunks of what is solid and seen. seed: of what is drawn by chance over it:
    clouds, a lens's noise. level: whether the land lies flat at height 0."""

    seed: int = 0
    level: bool = False
    _leant: tuple[Pose, tuple[float, float], tuple[float, float, float]] | None = None

    @abstractmethod
    def heights(self, xy: ArrayLike) -> Floats:
        """Height of the surface at (N, 2) points, (N,) metres."""

    @abstractmethod
    def chunk(self, key: Key) -> Chunk:
        """What is in a square."""

    def posts(self, key: Key) -> list[SignalPost]:
        """The pedestrian signals in a square."""
        return []

    def covers(self, key: Key) -> tuple[Patch, ...]:
        """Thin covers on the ground of a square, for cameras that show no finish, which has them
        too."""
        return ()

    def finish(self, key: Key) -> Finish:
        """What cameras with textures add to the chunk of a square."""
        return Finish()

    def kept(self, kind: str, key: Key, make: Callable[[], Arrays]) -> Arrays:
        """What `make` makes of a square, or what it has made of it before; kind: its name."""
        return make()

    def land(self, xy: ArrayLike) -> Floats:
        """The lie of the land at (N, 2) points, (N,) metres, steps such as curbs left out."""
        return self.heights(xy)

    def foot(
        self, x_m: float, y_m: float, heading_rad: float, size_m: tuple[float, float]
    ) -> float:
        """Height of the foot of a level thing of some length (along its heading) and width: nothing
        of it floats."""
        return float(
            self.heights([[x_m, y_m]])[0] - self.fall([(x_m, y_m)], [heading_rad], [size_m])[0]
        )

    def road(self, xy: ArrayLike, heading_rad: ArrayLike, size_m: ArrayLike) -> Floats:
        """(N, 3) height, roll and pitch of N vehicles at (N, 2) points, (N, 2) long and wide, on
        their wheels."""
        size = np.asarray(size_m, dtype=float).reshape(-1, 2)
        land = self._land_around(xy, heading_rad, _WHEELS * size)
        if land is None:
            return np.zeros((len(size), 3))
        front_left, front_right, rear_left, rear_right = land.T
        pitch = np.arctan2(
            rear_left + rear_right - front_left - front_right, 4.0 * _WHEELS[0] * size[:, 0]
        )
        roll = np.arctan2(
            front_left + rear_left - front_right - rear_right, 4.0 * _WHEELS[1] * size[:, 1]
        )
        return np.column_stack([land.mean(axis=1), roll, pitch])

    def fall(self, xy: ArrayLike, heading_rad: ArrayLike, size_m: ArrayLike) -> Floats:
        """(N,) how far the land at the lowest corner of things lies below that at their middle."""
        around = self._land_around(
            xy, heading_rad, 0.5 * np.asarray(size_m, dtype=float).reshape(-1, 2)
        )
        if around is None:
            return np.zeros(len(np.asarray(xy).reshape(-1, 2)))
        return np.asarray(np.maximum(self.land(xy) - around.min(axis=1), 0.0))

    def _land_around(self, xy: ArrayLike, heading_rad: ArrayLike, half_m: Floats) -> Floats | None:
        """(N, 4) land at the corners of N rectangles: front left, front right, rear left, rear
        right; None if level."""
        if self.level:
            return None
        at = np.asarray(xy, dtype=float).reshape(-1, 2)
        heading = np.asarray(heading_rad, dtype=float)
        ahead = half_m[:, :1] * np.column_stack([np.cos(heading), np.sin(heading)])
        left = half_m[:, 1:] * np.column_stack([-np.sin(heading), np.cos(heading)])
        corners = np.stack(
            [at + ahead + left, at + ahead - left, at - ahead + left, at - ahead - left], axis=1
        )
        return self.land(corners.reshape(-1, 2)).reshape(-1, 4)

    def lean(self, pose: Pose, span_m: tuple[float, float]) -> tuple[float, float, float]:
        """How a robot whose feet span this length and width stands at a pose: height of the base
        frame in metres, roll and pitch in radians. Who asks for the same pose again gets the last
        answer."""
        if self._leant is None or self._leant[:2] != (pose, span_m):
            self._leant = pose, span_m, self._lean(pose, span_m)
        return self._leant[2]

    def _lean(self, pose: Pose, span_m: tuple[float, float]) -> tuple[float, float, float]:
        cos, sin = math.cos(pose.heading_rad), math.sin(pose.heading_rad)
        ahead, aside = 0.5 * span_m[0], 0.5 * span_m[1]
        feet = [(a * ahead, b * aside) for a in (1, -1) for b in (1, -1)]
        at = [(pose.x_m + cos * u - sin * v, pose.y_m + sin * u + cos * v) for u, v in feet]
        front_left, front_right, rear_left, rear_right = self.heights(at).tolist()
        pitch = math.atan2(rear_left + rear_right - front_left - front_right, 4.0 * ahead)
        roll = math.atan2(front_left + rear_left - front_right - rear_right, 4.0 * aside)
        return 0.25 * (front_left + front_right + rear_left + rear_right), roll, pitch


def stood(obstacles: Sequence[Obstacle], surface: Surface) -> list[tuple[Prop, float]]:
    """Obstacles as props, each with the height of its foot on a surface in metres."""
    props = [obstacle_prop(obstacle, number) for number, obstacle in enumerate(obstacles)]
    return [
        (prop, surface.foot(prop.x_m, prop.y_m, prop.heading_rad, prop.size_m[:2]))
        for prop in props
    ]
