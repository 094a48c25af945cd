"""Lamps of a picture at night: street lamps with the houses that block them, and headlights.

Houses are higher than lamps, so a lamp's light ends at one distance in each direction.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final, NamedTuple

import moderngl
import numpy as np
import shapely
from numpy.typing import NDArray

from cosim.core.geometry import Floats
from cosim.core.state import Age, People, Vehicles
from physics.cameras.gl.corners import CornerRows
from physics.cameras.gl.weather_shaders import LAMPS_MAX, PEOPLE_MAX, WALL_ANGLES, WALLS_UNIT
from physics.cameras.view import View
from physics.ground.tiles import Key, tiles_within
from physics.street.furniture import KINDS
from physics.street.surface import Surface

STREET_LAMPS_MAX: Final = 8
"""Maximum number of street lamps of a picture; the others of LAMPS_MAX are headlights."""
_ARM_M: Final = 1.3
"""Distance of a lamp's glass from its pole in metres."""
_RANGE_M: Final = 34.0
_LAMP: Final = 0.018 * np.array([1.0, 0.80, 0.55])
"""Light of a street lamp, radiance of a white surface at 1 m: some 47 lx under a lamp of 7 m."""
_LAMP_ENDS: Final = -0.02
"""Cosine from straight down at which a street lamp's light ends."""
_HEADLIGHT: Final = 0.035 * np.array([1.0, 0.95, 0.86])
_HEADLIGHT_ENDS: Final = 0.72
_HEADLIGHT_DOWN: Final = 0.075
_HEADLIGHT_RANGE_M: Final = 32.0
_TAIL_LIGHT: Final = 0.0011 * np.array([1.0, 0.05, 0.03])
_TAIL_RANGE_M: Final = 7.0
_AHEAD_M: Final = 12.0
"""Distance ahead of the eye to the point that the chosen lamps are near to."""


class Lamps(NamedTuple):
    """Lamps of a picture.

    at: (N, 3) world metres
    light: (N, 3) radiance of a white surface at 1 m
    way: (N, 3) unit vectors
    ends: (N,) cosines at which the light ends
    range_m: (N,)
    walls: (N,) rows of the wall map, -1 without
    """

    at: Floats
    light: Floats
    way: Floats
    ends: Floats
    range_m: Floats
    walls: Floats

    def rows(self, anchor: Floats, brightness: float) -> NDArray[np.float32]:
        """Return the rows (3, LAMPS_MAX, 4) of the block `Weather`."""
        rows = np.zeros((3, LAMPS_MAX, 4), dtype=np.float32)
        n = len(self.at)
        rows[0, :n, :3] = self.at - (float(anchor[0]), float(anchor[1]), 0.0)
        rows[0, :n, 3] = 1.0 / self.range_m**2
        rows[1, :n, :3], rows[1, :n, 3] = brightness * self.light, self.walls
        rows[2, :n, :3], rows[2, :n, 3] = self.way, self.ends
        return rows


_CAST_AHEAD_M: Final = 5.0
_CAST_M: Final = 14.0
"""Distance from a point so far ahead of the eye within which people cast shadows by lamps."""
_PERSON_M: Final = 1.72
_CHILD_M: Final = 1.2
_SEEN_M: Final = 45.0
"""Distance from that point within which lamps are chosen."""


def lamp_heads(forms: Sequence[tuple[str, int, int]], things: CornerRows, middle: Floats) -> Floats:
    """Return (N, 3) world positions of the glasses of a tile's street lamps.

    forms: of the tile's props, whose instances are the first of `things`
    """
    rows = [i for i, form in enumerate(forms) if form[0] == "lamp"]
    heights = [KINDS["lamp"].size_m(forms[i][1])[2] for i in rows]
    at = things["at"][rows].astype(float)
    turn = things["turn"][rows].astype(float)
    heading = 2.0 * np.arctan2(turn[:, 2], turn[:, 3])
    arm = _ARM_M * np.column_stack([-np.sin(heading), np.cos(heading)])
    return np.column_stack([at[:, :2] + middle + arm, at[:, 2] + np.array(heights) - 0.1])


def nearest(heads: Floats, eye_m: Floats, heading_rad: float) -> NDArray[np.intp]:
    """Return the rows of the lamps that light a view most, at most STREET_LAMPS_MAX."""
    way = np.array([math.cos(heading_rad), math.sin(heading_rad)])
    off = heads[:, :2] - eye_m[:2]
    far = np.hypot(*(off - _AHEAD_M * way).T)
    order = np.argsort(far, kind="stable")
    order = order[(far[order] < _SEEN_M) & (off[order] @ way > -_RANGE_M)]
    return np.asarray(order[:STREET_LAMPS_MAX])


def walls_around(outlines: Sequence[shapely.Polygon], head: Floats) -> NDArray[np.float32]:
    """Return (WALL_ANGLES,) distances from a lamp to the nearest wall by direction, metres.

    The directions are those of points at equal distances on a square, as in the shader.
    outlines: of the buildings around it
    """
    x, y = float(head[0]), float(head[1])
    reach = np.full(WALL_ANGLES, 2.0 * _RANGE_M)
    near = [one for one in outlines if one.distance(shapely.Point(x, y)) < _RANGE_M]
    if near:
        rings = [shapely.get_coordinates(one.exterior) for one in near]
        begin = np.concatenate([ring[:-1] for ring in rings]) - (x, y)
        along = np.concatenate([np.diff(ring, axis=0) for ring in rings])
        turn = 4.0 * (np.arange(WALL_ANGLES) + 0.5) / WALL_ANGLES
        side = 1.0 - np.abs(turn % 2.0 - 1.0)  # 0, 1, 0, 1, 0 around the square
        ray = np.column_stack(
            [
                np.where((turn < 1.0) | (turn > 3.0), 1.0 - side, side - 1.0),
                np.sign(2.0 - turn) * side,
            ]
        )
        ray = (ray / np.hypot(*ray.T)[:, None])[:, None]
        cross = ray[..., 0] * along[:, 1] - ray[..., 1] * along[:, 0]
        with np.errstate(divide="ignore", invalid="ignore"):
            far = (begin[:, 0] * along[:, 1] - begin[:, 1] * along[:, 0]) / cross
            share = (begin[:, 0] * ray[..., 1] - begin[:, 1] * ray[..., 0]) / cross
        hit = np.isfinite(far) & (far > 0.0) & (share >= 0.0) & (share <= 1.0)
        reach = np.minimum(reach, np.where(hit, far, np.inf).min(axis=1))
    return reach.astype(np.float32)


def casting_people(people: People, surface: Surface, view: View) -> Floats:
    """Return (N, 4) feet and heights in metres of the people whose shadows are drawn without sun."""
    way = np.array([math.cos(view.heading_rad), math.sin(view.heading_rad)])
    far = np.hypot(*(people.xy - view.eye_m[:2] - _CAST_AHEAD_M * way).T)
    near = np.argsort(far, kind="stable")[:PEOPLE_MAX]
    near = near[far[near] < _CAST_M]
    heights = np.where(people.age[near] == Age.CHILD, _CHILD_M, _PERSON_M)
    return np.column_stack([people.xy[near], surface.heights(people.xy[near]), heights])


class WallMap:
    """Texture of `walls_around` of a picture's street lamps, one row each."""

    def __init__(self, context: moderngl.Context, surface: Surface) -> None:
        self._context = context
        self._surface = surface
        self._known: dict[tuple[float, ...], NDArray[np.float32]] = {}
        self._outlines: dict[Key, list[shapely.Polygon]] = {}
        self._held: list[tuple[float, ...]] = []
        self._texture: moderngl.Texture | None = None

    def set(self, heads: Floats) -> None:
        """Upload the rows of (N, 3) lamps if they are others than before."""
        keys = [tuple(head) for head in heads.tolist()]
        if self._texture is None:
            self._texture = self._context.texture((WALL_ANGLES, LAMPS_MAX), 1, dtype="f4")
            self._texture.filter = moderngl.LINEAR, moderngl.LINEAR
            self._texture.repeat_x = True
            self._texture.repeat_y = False
        if keys == self._held:
            return
        rows = np.full((LAMPS_MAX, WALL_ANGLES), 2.0 * _RANGE_M, dtype=np.float32)
        for row, (key, head) in enumerate(zip(keys, heads, strict=True)):
            if key not in self._known:
                self._known[key] = walls_around(self._around(head), head)
            rows[row] = self._known[key]
        self._texture.write(rows)
        self._held = keys

    def _around(self, head: Floats) -> list[shapely.Polygon]:
        """Return the outlines of the buildings of the tiles around a lamp."""
        keys = tiles_within(float(head[0]), float(head[1]), _RANGE_M)
        for key in keys:
            if key not in self._outlines:
                buildings = self._surface.chunk(key).buildings
                self._outlines[key] = [building.polygon for building in buildings]
        return [outline for key in keys for outline in self._outlines[key]]

    def bind(self) -> None:
        if self._texture is not None:
            self._texture.use(WALLS_UNIT)

    def release(self) -> None:
        if self._texture is not None:
            self._texture.release()
            self._texture = None
        self._held = []


def lamps_of(heads: Floats, vehicles: Vehicles, surface: Surface, eye_m: Floats) -> Lamps:
    """Return the lamps of a picture: street lamps, then the lights of the nearest vehicles.

    heads: (N, 3) of `nearest`
    """
    n = len(heads)
    far = np.hypot(*(vehicles.xy - eye_m[:2]).T)
    near = np.argsort(far, kind="stable")
    near = near[far[near] < _SEEN_M][: (LAMPS_MAX - n) // 2]
    heading, size = vehicles.heading[near], vehicles.size[near]
    ahead = np.column_stack([np.cos(heading), np.sin(heading)])
    half = 0.5 * size[:, :1]
    z = surface.heights(vehicles.xy[near]) + 0.65 if len(near) else np.zeros(0)
    front = np.column_stack([vehicles.xy[near] + (half + 0.05) * ahead, z])
    rear = np.column_stack([vehicles.xy[near] - (half + 0.25) * ahead, z])
    down = np.full(len(near), -_HEADLIGHT_DOWN)
    count = np.ones(len(near))
    return Lamps(
        np.concatenate([heads, front, rear]),
        np.concatenate(
            [np.tile(one, (k, 1)) for one, k in ((_LAMP, n), (_HEADLIGHT, len(near)))]
            + [np.tile(_TAIL_LIGHT, (len(near), 1))]
        ),
        np.concatenate(
            [
                np.tile([0.0, 0.0, -1.0], (n, 1)),
                np.column_stack([ahead, down]) / math.hypot(1.0, _HEADLIGHT_DOWN),
                np.column_stack([-ahead, 0.0 * down]),
            ]
        ),
        np.concatenate([np.full(n, _LAMP_ENDS), _HEADLIGHT_ENDS * count, 0.0 * count]),
        np.concatenate([np.full(n, _RANGE_M), _HEADLIGHT_RANGE_M * count, _TAIL_RANGE_M * count]),
        np.concatenate([np.arange(n, dtype=float), -count, -count]),
    )
