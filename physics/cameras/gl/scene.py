"""Street around a view for the gl camera: the content of physics.cameras.scene as buffers.

Visibility is decided for a whole cell of eyes and sector of headings, with a margin.
A moving robot therefore mostly reuses the buffers.
Cell and sector depend on the view alone, and so does the picture.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import count
from typing import Final

import moderngl
import msgspec
import numpy as np
from numpy.typing import NDArray

from cosim.core.cache import Arrays
from cosim.core.geometry import Floats
from cosim.core.state import LABELS, Street, Vehicles
from cosim.spec.obstacle import Obstacle
from cosim.spec.scenario import Barrier
from physics.cameras.gl.corners import CornerRows
from physics.cameras.gl.instances import INSTANCE, MATERIALS, ThingArrays, Things, instances
from physics.cameras.gl.lamps import Lamps, WallMap, lamp_heads, lamps_of, nearest
from physics.cameras.gl.lighting import Lighting
from physics.cameras.gl.pool import NO_DRAWS, Piece
from physics.cameras.gl.scans import scan_rows
from physics.cameras.gl.shots import CELL_M, STEP_M, Lattice
from physics.cameras.gl.street import (
    STEPS,
    TILE_KINDS,
    Step,
    StreetDrawing,
    ThingStep,
    TileKind,
    TileStep,
    style_of,
)
from physics.cameras.gl.surfaces import surfaces
from physics.cameras.gl.tiles import DECALS_M, decal_rows, ground_rows
from physics.cameras.gl.variants import Variant
from physics.cameras.gl.walls import wall_rows
from physics.cameras.gl.weather import WeatherLook
from physics.cameras.view import FORGET_M, PROP_MARGIN_M, VISIBLE_M, View
from physics.dynamics.world import BulletWorld
from physics.ground.mesh import Detail, Part
from physics.ground.tiles import (
    Key,
    tile_bounds,
    tile_distance,
    tile_distances_within,
    tiles_within,
)
from physics.street import props
from physics.street.furniture import KINDS, parts_of
from physics.street.surface import grounded_obstacles

_SECTOR_RAD: Final = math.radians(7.5)
_SLACK_M: Final = CELL_M * math.sqrt(0.5)
"""Maximum distance of an eye from the middle of its cell, metres."""
_NEAR_M: Final = 12.0
"""Distance within which objects have all their details, metres."""
_VERSIONS: Final = count(1)
_DETAILS: Final[tuple[Detail, ...]] = ("near", "far")
_TILE_REACH_M: Final = 34.0
"""Maximum distance of a tile's content from its middle, including objects over its border,
metres.
"""

_Placed = tuple[NDArray[np.intp], CornerRows]
"""Numbers of forms and rows of instances."""
_NOTHING: Final[_Placed] = (np.zeros(0, dtype=np.intp), np.zeros(0, dtype=INSTANCE))


@dataclass(frozen=True, slots=True)
class _Tile:
    """Content of a tile.

    middle: (2,) world metres, which its meshes and objects are relative to
    meshes: by layer of the ground
    far: (N,) forms of its objects at a distance
    lamps: (N, 3) glasses of street lamps, world metres
    thing_xy: (N, 2) positions of its objects
    seen_m: (N,) drawing distances of its objects
    """

    middle: Floats
    meshes: Mapping[TileKind, Piece]
    lamps: Floats
    things: _Placed
    far: NDArray[np.intp]
    thing_xy: Floats
    seen_m: Floats
    posts: list[props.SignalPost]
    post_z: Floats


class _Words(msgspec.Struct, array_like=True):
    """Data of a tile that are not arrays. forms: of its props, for `parts_of`."""

    forms: list[tuple[str, int, int]]
    posts: list[props.SignalPost]


class GlScene:
    """Static street around a view, as a function of view and signals alone.

    look: weather and night; None by a clear day
    splats: the scan's mesh is not in the picture, but drawn apart
    layers: pictures are drawn as layers, together with those of other scenes

    id: number of the scene in the shared buffers
    draws: of each of STEPS, for `StreetDrawing`
    version: unique number of `draws`
    """

    def __init__(
        self,
        context: moderngl.Context,
        street: StreetDrawing,
        world: BulletWorld,
        light: Lighting,
        splats: bool = False,
        look: WeatherLook | None = None,
        layers: bool = False,
    ) -> None:
        self._look = look
        self._surface = world.surface
        self._street = street
        self._forms = street.forms
        self._shadows = light.shadows
        self._surfaces = surfaces(context)
        self.id = street.take_id()
        self.style = style_of(light, splats, look, layers)
        self.draws = [NO_DRAWS] * len(STEPS)
        self.version = 0
        self._changed()
        self._seen, self._standing = (Things(self._forms, street.things) for _ in range(2))
        self._fence_forms = self._forms.apart()  # the number of sizes is unlimited
        self._fenced = Things(self._fence_forms, street.things)
        self.fence_arrays = ThingArrays(context, self._fence_forms, street.things)
        self._walls_map = WallMap(context, world.surface)
        self._places = (0, 0)
        self._tiles: dict[Key, _Tile] = {}
        self._keys: list[Key] = []
        self._cell: tuple[int, int] | None = None
        self._placed_for: tuple[float, ...] | None = None
        self._anchor: Floats = np.zeros(2)
        self._seen_for: tuple[tuple[int, int], int, int | None] | None = None
        self._still_for: tuple[tuple[float, ...], tuple[float, ...]] | None = None
        self._lit_for: list[bool | None] = []
        self._lit: _Placed = _NOTHING
        self._fences = [self._fence(barrier) for barrier in world.barriers]
        self._fence_xy = np.array([(b.x_m, b.y_m) for b in world.barriers]).reshape(-1, 2)
        self._obstacles = self._stood(world.obstacles)
        self._obstacle_xy = np.array([(o.x_m, o.y_m) for o in world.obstacles]).reshape(-1, 2)

    def arrange(self, view: View, lattice: Lattice, street: Street) -> None:
        """Prepare all static objects that a picture can show."""
        cell, anchor, middle = lattice.cell, lattice.anchor, lattice.middle
        if cell != self._cell:
            self._stream(cell)
            self._cell = cell
        if anchor != self._placed_for:
            self._place(np.array(anchor))
            self._placed_for = anchor
        self._light(street)
        seen_for = cell, *_sector(view)
        if seen_for != self._seen_for:
            self._choose(*seen_for)
            self._seen_for = seen_for
        if self._shadows and (middle, anchor) != self._still_for:
            self._stand(middle, np.array(anchor))
            self._still_for = middle, anchor

    def lamps(self, view: View, vehicles: Vehicles) -> Lamps | None:
        """Return the lamps of a view after `arrange`, and prepare their wall map; None by day."""
        if self._look is None or not self._look.variant & Variant.LAMPS:
            return None
        heads = self._heads[nearest(self._heads, view.eye_m, view.heading_rad)]
        self._walls_map.set(heads)
        return lamps_of(heads, vehicles, self._surface, view.eye_m)

    def bind_lamps(self) -> None:
        """Bind the wall map of the last view's lamps."""
        self._walls_map.bind()

    def release(self) -> None:
        for things in (self._seen, self._standing, self._fenced):
            things.release()
        self.fence_arrays.release()
        self._fence_forms.release()
        self._walls_map.release()
        self._street.places.give(*self._places)
        for tile in self._tiles.values():
            self._drop(tile)
        self._tiles.clear()
        self._street.give_id(self.id)

    def _drop(self, tile: _Tile) -> None:
        for kind, piece in tile.meshes.items():
            self._street.meshes[kind].drop(piece)

    def _changed(self) -> None:
        self.version = next(_VERSIONS)

    def _show(self, step: Step, draws: NDArray[np.uint32]) -> None:
        self.draws[STEPS.index(step)] = draws
        self._changed()

    def _show_things(self, step: ThingStep, things: Things) -> None:
        for material in MATERIALS:
            self._show((step, material), things.draws[material][0])

    def _show_tiles(self, step: TileStep, kind: TileKind, tiles: NDArray[np.intp]) -> None:
        """Select the tiles to draw in a step from now on, in this order."""
        draws = self._tile_draws[kind][tiles]
        self._show((step, kind), draws[draws[:, 0] > 0])

    def _stream(self, cell: tuple[int, int]) -> None:
        """Load the tiles around a cell, the nearest first."""
        x, y = cell[0] * CELL_M, cell[1] * CELL_M
        keys = [key for _, key in sorted(tile_distances_within(x, y, VISIBLE_M + _SLACK_M))]
        if keys == self._keys:
            return
        for key in [k for k in self._tiles if tile_distance(k, x, y) > FORGET_M]:
            self._drop(self._tiles.pop(key))
        for key in keys:
            if key not in self._tiles:
                self._tiles[key] = self._built(key)
        tiles = [self._tiles[key] for key in keys]
        self._keys = keys
        self._middles = np.array([tile.middle for tile in tiles])
        self._street.places.give(*self._places)
        self._places = self._street.places.take(len(tiles)), len(tiles)
        self._tile_draws = {kind: self._draws_of(kind, tiles) for kind in TILE_KINDS}
        self._heads = np.concatenate([tile.lamps for tile in tiles])
        self._stands_xy = np.concatenate([*(tile.thing_xy for tile in tiles), self._obstacle_xy])
        always = np.full(len(self._obstacle_xy), math.inf)
        self._stands_seen_m = np.minimum(
            np.concatenate([*(tile.seen_m for tile in tiles), always]), VISIBLE_M
        )
        self._posts = [
            one for tile in tiles for one in zip(tile.posts, tile.post_z.tolist(), strict=True)
        ]
        self._placed_for = None

    def _place(self, anchor: Floats) -> None:
        """Set the anchor that all positions are relative to."""
        self._anchor = anchor
        self._seen_for = None
        self._still_for = None
        self._lit_for = []
        self._street.place(self._places[0], self.id, self._middles, anchor)
        placed = [self._shifted(self._tiles[key]) for key in self._keys]
        self._stands = _joined([*placed, _at(self._obstacles, self._obstacle_xy, anchor)])
        self._far = np.concatenate(
            [*(self._tiles[key].far for key in self._keys), self._obstacles[0]]
        )
        self._fenced.set(*_joined([_NOTHING, *self._fences_now(anchor)]), self.id)
        self._show_things("fenced", self._fenced)

    def _choose(self, cell: tuple[int, int], sector: int, half: int | None) -> None:
        """Select everything visible from any eye in the cell with a heading in the sector."""
        offset = self._stands_xy - np.multiply(cell, CELL_M)
        away = np.hypot(offset[:, 0], offset[:, 1])
        chosen = away < self._stands_seen_m + _SLACK_M
        tiles = np.ones(len(self._keys), dtype=bool)
        if half is not None:
            chosen &= _within(offset, sector, half, PROP_MARGIN_M)
            tiles = _within(self._middles - np.multiply(cell, CELL_M), sector, half, _TILE_REACH_M)
        rows = chosen.nonzero()[0]
        form, things = self._stands
        form = np.where(away > _NEAR_M, self._far, form)
        self._seen.set(*_joined([(form[rows], things[rows]), self._lit]), self.id)
        self._show_things("seen", self._seen)
        for kind in TILE_KINDS:
            if kind != "decals":
                self._show_tiles("colour", kind, tiles.nonzero()[0])
        x, y = np.multiply(cell, CELL_M).tolist()
        near = [tile_distance(key, x, y) < DECALS_M + _SLACK_M for key in self._keys]
        self._show_tiles("colour", "decals", (tiles & np.array(near)).nonzero()[0])

    def _stand(self, middle: tuple[float, ...], anchor: Floats) -> None:
        """Prepare the shadow casters in the square around `middle`, visible or not."""
        keys = tiles_within(middle[0], middle[1], VISIBLE_M - STEP_M)
        obstacles = _at(self._obstacles, self._obstacle_xy, anchor)
        self._standing.set(
            *_joined([*(self._shifted(self._tiles[key]) for key in keys), obstacles]),
            self.id,
        )
        self._show_things("standing", self._standing)
        tiles = np.array([self._keys.index(key) for key in keys], dtype=np.intp)
        for kind in ("ground", "walls"):
            self._show_tiles("still", kind, tiles)

    def _built(self, key: Key) -> _Tile:
        held = self._surface.kept("gl", key, lambda: self._made(key))
        words = msgspec.msgpack.decode(held["words"].data, type=_Words)
        pole = self._forms.id(("signal", "post"), lambda: [Part(props.post_mesh(), props.POLE)])
        forms = [self._form(*form) for form in words.forms] + [(pole, pole)] * len(words.posts)
        near, far = np.array(forms, dtype=np.intp).reshape(-1, 2).T
        return _Tile(
            _middle(key),
            {
                kind: self._street.meshes[kind].hold(held[kind], held[f"{kind}_triangles"])
                for kind in TILE_KINDS
                if kind in held
            },
            lamp_heads(words.forms, held["things"], _middle(key)),
            (near, held["things"]),
            far,
            held["thing_xy"],
            held["seen_m"],
            words.posts,
            held["post_z"],
        )

    def _draws_of(self, kind: TileKind, tiles: Sequence[_Tile]) -> NDArray[np.uint32]:
        """Return the (T, 5) draws of the meshes of a kind, without indices where there is none."""
        draws = np.zeros((len(tiles), 5), dtype=np.uint32)
        draws[:, 1] = 1
        draws[:, 4] = self._places[0] + np.arange(len(tiles))
        for row, tile in zip(draws, tiles, strict=True):
            if kind in tile.meshes:
                row[0], row[2], row[3] = tile.meshes[kind].draw
        return draws

    def _form(self, kind: str, variant: int, look: int) -> tuple[int, int]:
        """Return the numbers of a prop's forms, near and at a distance."""
        near, far = (parts_of(kind, variant, look, detail) for detail in _DETAILS)
        one = self._forms.id(("prop", kind, variant, look), lambda: near)
        if len(near) == len(far) and all(a is b for a, b in zip(near, far, strict=True)):
            return one, one
        return one, self._forms.id(("prop", kind, variant, look, "far"), lambda: far)

    def _made(self, key: Key) -> Arrays:
        """Build the data of a tile that depend on its surface alone."""
        middle = _middle(key)
        chunk, finish, posts = (
            self._surface.chunk(key),
            self._surface.finish(key),
            self._surface.posts(key),
        )
        scanned = self._surface.scanned(key)
        ground = (*finish.laid, *chunk.ground) if self._surface.scan is None else ()
        layers = {
            "scan": scan_rows(scanned, middle),
            "ground": ground_rows(self._surfaces, ground, middle),
            "paint": ground_rows(self._surfaces, finish.painted, middle),
            "decals": decal_rows(self._surfaces, finish.decals, middle),
            "walls": wall_rows(self._surfaces, chunk.buildings, finish.styles, middle),
        }
        post_xy = np.array([(post.x_m, post.y_m) for post in posts]).reshape(-1, 2)
        post_z = self._surface.heights(post_xy)
        furniture = chunk.props
        xyz = np.array(
            [(prop.x_m - middle[0], prop.y_m - middle[1], z) for prop, z in furniture]
        ).reshape(-1, 3)
        paint = np.array([KINDS[prop.kind].paints[prop.paint] for prop, _ in furniture]).reshape(
            -1, 3
        )
        rows = instances(
            xyz, [prop.drawn_heading_rad for prop, _ in furniture], paint, LABELS["prop"]
        )
        headings = [post.heading_rad for post in posts]
        poles = instances(
            np.column_stack([post_xy - middle, post_z]), headings, props.POLE, LABELS["signal"]
        )
        words = msgspec.msgpack.encode(_Words([prop.form for prop, _ in furniture], posts))
        found = {
            "words": np.frombuffer(words, dtype=np.uint8),
            "things": np.concatenate([rows, poles]),
            "thing_xy": np.concatenate([xyz[:, :2] + middle, post_xy]),
            "seen_m": np.array(
                [*(KINDS[prop.kind].seen_m for prop, _ in furniture), *[math.inf] * len(posts)]
            ),
            "post_z": post_z,
        }
        for name, layer in layers.items():
            if layer is not None:
                found[name], found[f"{name}_triangles"] = layer
        return found

    def _shifted(self, tile: _Tile) -> _Placed:
        form, things = tile.things
        here = things.copy()
        here["at"][:, :2] += tile.middle - self._anchor
        return form, here

    def _fence(self, barrier: Barrier) -> _Placed:
        z = self._surface.foot(
            barrier.x_m, barrier.y_m, barrier.heading_rad, (barrier.thickness_m, barrier.length_m)
        )
        size = (barrier.length_m, barrier.height_m, barrier.thickness_m)
        form = self._fence_forms.id(("barrier", *size), lambda: props.barrier_parts(barrier))
        rows = instances(
            (barrier.x_m, barrier.y_m, z), barrier.heading_rad, props.PROP_RED, LABELS["barrier"]
        )
        return np.array([form]), rows

    def _stood(self, obstacles: Sequence[Obstacle]) -> _Placed:
        standing = grounded_obstacles(obstacles, self._surface)
        if not standing:
            return _NOTHING
        form = [self._form(*prop.form)[0] for prop, _ in standing]
        paint = np.array([KINDS[prop.kind].paints[prop.paint] for prop, _ in standing])
        xyz = np.array([(0.0, 0.0, z) for _, z in standing])
        rows = instances(
            xyz, [prop.drawn_heading_rad for prop, _ in standing], paint, LABELS["prop"]
        )
        return np.array(form, dtype=np.intp), rows

    def _fences_now(self, anchor: Floats) -> list[_Placed]:
        return [
            _at(fence, xy, anchor) for fence, xy in zip(self._fences, self._fence_xy, strict=True)
        ]

    def _light(self, street: Street) -> None:
        """Turn on the lamp of every signal with a known state."""
        signals = street.signals
        shown = [
            signals[post.crossing].walk if post.crossing in signals else None
            for post, _ in self._posts
        ]
        if shown != self._lit_for:
            self._lit_for, self._lit, self._seen_for = shown, self._lamps_showing(shown), None

    def _lamps_showing(self, shown: list[bool | None]) -> _Placed:
        lit = {walk: self._forms.id(("signal", walk), partial(_lamp, walk)) for walk in props.LAMPS}
        forms = []
        at = []
        heading = []
        paint = []
        for (post, z), walk in zip(self._posts, shown, strict=True):
            if walk is not None:
                forms.append(lit[walk])
                at.append((post.x_m - self._anchor[0], post.y_m - self._anchor[1], z))
                heading.append(post.heading_rad)
                paint.append(props.LAMPS[walk])
        if not forms:
            return _NOTHING
        return np.array(forms), instances(at, heading, paint, LABELS["signal"])


def _middle(key: Key) -> Floats:
    """Return the (2,) middle of a tile, world metres."""
    x0, y0, x1, y1 = tile_bounds(key)
    return np.array([0.5 * (x0 + x1), 0.5 * (y0 + y1)])


def _sector(view: View) -> tuple[int, int | None]:
    """Return the sector of a heading, and half the width of its views in sectors.

    The half width is None for views in all directions.
    """
    half = math.ceil(view.half_angle_rad / _SECTOR_RAD + 0.5)
    if view.behind_m > 0.0 or half * _SECTOR_RAD >= 0.5 * math.pi:
        return 0, None
    return round(view.heading_rad / _SECTOR_RAD), half


def _within(offset: Floats, sector: int, half: int, margin_m: float) -> NDArray[np.bool_]:
    """Return which of (N, 2) points are visible from any eye of a cell with a heading in the
    sector.

    offset: points relative to the middle of the cell
    margin_m: radius of the objects at the points
    """
    heading, aside = sector * _SECTOR_RAD, half * _SECTOR_RAD
    cos, sin = math.cos(heading), math.sin(heading)
    ahead = offset @ np.array([cos, sin])
    across = np.abs(offset @ np.array([-sin, cos]))
    return np.asarray(across * math.cos(aside) - ahead * math.sin(aside) < margin_m + _SLACK_M)


def _lamp(walk: bool) -> list[Part]:
    return [Part(props.lamp_mesh(walk), glows=True)]


def _at(placed: _Placed, xy: Floats, anchor: Floats) -> _Placed:
    """Return objects at a point or at (N, 2) points of the world, relative to an anchor."""
    form, rows = placed
    here = rows.copy()
    here["at"][:, :2] = xy - anchor
    return form, here


def _joined(placed: Sequence[_Placed]) -> _Placed:
    return np.concatenate([form for form, _ in placed]), np.concatenate(
        [rows for _, rows in placed]
    )
