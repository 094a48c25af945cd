"""Interface of surfaces that robots, people and vehicles move on.

Physics and cameras use this interface only. A surface is divided into the tiles of
`physics.ground.tiles`, so that only nearby ones are loaded. Subclasses implement `heights` and
`chunk`; the other methods have defaults for plain surfaces.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np
import shapely
from numpy.typing import ArrayLike

from cosim.core.cache import Arrays
from cosim.core.geometry import Floats, Pose
from cosim.place.scan import Scan
from cosim.place.street_map import StreetMap
from cosim.spec.obstacle import Obstacle
from physics.ground.mesh import Mesh
from physics.ground.tiles import Key
from physics.street.buildings import Building
from physics.street.decals import Decals
from physics.street.furniture import Prop, obstacle_prop
from physics.street.props import SignalPost
from physics.textures.facades import WallStyle
from physics.textures.layers import Colour

_WHEEL_SHARE: Final = np.array([0.32, 0.4])
"""Position of a vehicle's wheels as a fraction of its length and width from the centre."""


class Patch(NamedTuple):
    """Triangles of one material.

    friction: coefficient of friction against a tyre of 1.0
    label: one of `cosim.core.state.LABELS`
    colour: sRGB colour
    layer: layer of `physics.textures.ground` for cameras with textures
    tinted: whether the colour tints the layer
    """

    name: str
    mesh: Mesh
    friction: float
    label: str
    colour: Colour
    layer: str
    tinted: bool = True


class ScannedPatch(NamedTuple):
    """Scanned triangles, whose colours contain their light.

    colours: (V, 3) sRGB, 0 to 1
    label: one of `cosim.core.state.LABELS`
    """

    mesh: Mesh
    colours: Floats
    label: str


@dataclass(frozen=True, slots=True)
class Chunk:
    """Contents of a tile: ground, buildings, and props with the height of their foot in metres.

    standing: scanned obstacles, without a look of their own
    """

    ground: tuple[Patch, ...]
    buildings: tuple[Building, ...] = ()
    props: tuple[tuple[Prop, float], ...] = ()
    standing: tuple[Mesh, ...] = ()


@dataclass(frozen=True, slots=True)
class TexturedDetails:
    """Details of a tile for cameras with textures.

    laid: thin covers, drawn before the ground under them
    painted: markings that change colours only
    styles: style of each building of the chunk
    decals: pictures on the ground that change colours only, drawn after the markings
    """

    laid: tuple[Patch, ...] = ()
    painted: tuple[Patch, ...] = ()
    styles: tuple[WallStyle, ...] = ()
    decals: tuple[Decals, ...] = ()


class Surface(ABC):
    """Ground heights and tile contents.

    seed: seed of random details such as clouds and lens noise
    level: whether the land is flat at height 0
    scan: the scan of a scanned place
    """

    seed: int = 0
    level: bool = False
    scan: Scan | None = None
    _last_lean: tuple[Pose, tuple[float, float], tuple[float, float, float]] | None = None

    @abstractmethod
    def heights(self, xy: ArrayLike) -> Floats:
        """Return the (N,) heights of the surface in metres at (N, 2) points."""

    @abstractmethod
    def chunk(self, key: Key) -> Chunk:
        """Return the contents of a tile."""

    def posts(self, key: Key) -> list[SignalPost]:
        """Return the pedestrian signals in a tile."""
        return []

    def covers(self, key: Key) -> tuple[Patch, ...]:
        """Return thin ground covers of a tile for cameras without textures.

        The covers are also part of `finish`.
        """
        return ()

    def finish(self, key: Key) -> TexturedDetails:
        """Return the details of a tile for cameras with textures."""
        return TexturedDetails()

    def scanned(self, key: Key) -> tuple[ScannedPatch, ...]:
        """Return the scanned triangles of a tile, which are drawn in place of its ground."""
        return ()

    def kept(self, kind: str, key: Key, make: Callable[[], Arrays]) -> Arrays:
        """Return the cached arrays of a tile, or compute them with `make`.

        kind: name of the arrays in the cache
        """
        return make()

    def land(self, xy: ArrayLike) -> Floats:
        """Return the (N,) heights of the land in metres at (N, 2) points.

        Steps such as curbs are excluded.
        """
        return self.heights(xy)

    def foot(
        self, x_m: float, y_m: float, heading_rad: float, size_m: tuple[float, float]
    ) -> float:
        """Return the height in metres of the foot of a level object.

        It is low enough that no corner floats.

        size_m: length along the heading, and width
        """
        return float(
            self.heights([[x_m, y_m]])[0]
            - self.drop_to_corner([(x_m, y_m)], [heading_rad], [size_m])[0]
        )

    def road(self, xy: ArrayLike, heading_rad: ArrayLike, size_m: ArrayLike) -> Floats:
        """Return (N, 3) height, roll and pitch of N vehicles on their wheels.

        xy: (N, 2) positions, m
        size_m: (N, 2) length and width
        """
        size = np.asarray(size_m, dtype=float).reshape(-1, 2)
        land = self._land_around(xy, heading_rad, _WHEEL_SHARE * size)
        if land is None:
            return np.zeros((len(size), 3))
        front_left, front_right, rear_left, rear_right = land.T
        pitch = np.arctan2(
            rear_left + rear_right - front_left - front_right, 4.0 * _WHEEL_SHARE[0] * size[:, 0]
        )
        roll = np.arctan2(
            front_left + rear_left - front_right - rear_right, 4.0 * _WHEEL_SHARE[1] * size[:, 1]
        )
        return np.column_stack([land.mean(axis=1), roll, pitch])

    def drop_to_corner(self, xy: ArrayLike, heading_rad: ArrayLike, size_m: ArrayLike) -> Floats:
        """Return (N,) the drop in metres of the land from objects' centres to the lowest corner."""
        around = self._land_around(
            xy, heading_rad, 0.5 * np.asarray(size_m, dtype=float).reshape(-1, 2)
        )
        if around is None:
            return np.zeros(len(np.asarray(xy).reshape(-1, 2)))
        return np.asarray(np.maximum(self.land(xy) - around.min(axis=1), 0.0))

    def _land_around(self, xy: ArrayLike, heading_rad: ArrayLike, half_m: Floats) -> Floats | None:
        """Return (N, 4) land heights at the corners of N rectangles; None on level land.

        Order: front left, front right, rear left, rear right.
        """
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
        """Return height in metres, roll and pitch in radians of a robot's base frame at a pose.

        span_m: length and width between the outer wheels

        The last result is cached.
        """
        if self._last_lean is None or self._last_lean[:2] != (pose, span_m):
            self._last_lean = pose, span_m, self._lean(pose, span_m)
        return self._last_lean[2]

    def _lean(self, pose: Pose, span_m: tuple[float, float]) -> tuple[float, float, float]:
        cos, sin = math.cos(pose.heading_rad), math.sin(pose.heading_rad)
        ahead, aside = 0.5 * span_m[0], 0.5 * span_m[1]
        feet = [(a * ahead, b * aside) for a in (1, -1) for b in (1, -1)]
        at = [(pose.x_m + cos * u - sin * v, pose.y_m + sin * u + cos * v) for u, v in feet]
        front_left, front_right, rear_left, rear_right = self.heights(at).tolist()
        pitch = math.atan2(rear_left + rear_right - front_left - front_right, 4.0 * ahead)
        roll = math.atan2(front_left + rear_left - front_right - rear_right, 4.0 * aside)
        return 0.25 * (front_left + front_right + rear_left + rear_right), roll, pitch


class PlaceSurface(Surface):
    """Surface of a place.

    street_map: map of the place
    """

    street_map: StreetMap

    def buildings(self, key: Key) -> tuple[Building, ...]:
        """Return the buildings whose centre lies in the tile, placed on the land."""
        return ()

    def standing(self, area: shapely.Geometry) -> list[Prop]:
        """Return the props in the tiles that an area touches."""
        return []


def grounded_obstacles(obstacles: Sequence[Obstacle], surface: Surface) -> list[tuple[Prop, float]]:
    """Return obstacles as props, each with the height of its foot on the surface in metres."""
    props = [obstacle_prop(obstacle, number) for number, obstacle in enumerate(obstacles)]
    return [
        (prop, surface.foot(prop.x_m, prop.y_m, prop.heading_rad, prop.size_m[:2]))
        for prop in props
    ]
