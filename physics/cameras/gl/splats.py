"""Drawing of Gaussian splats: order, projection, lists of tiles, and blending, in compute shaders.

A picture is a function of splats and view alone. Splats are ordered by their distance from the
nearest point of a lattice of eyes, so the order does not depend on the heading. A pass may draw
several views of a cloud; each has the bits of a pass of its own.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Sequence
from typing import Final, NamedTuple

import moderngl
import numpy as np
from numpy.typing import NDArray

from cosim.core.geometry import Floats
from cosim.place.scan import Splats
from physics.cameras.gl import splat_shaders as glsl
from physics.cameras.gl.splat_sort import (
    Buffers,
    NumpySort,
    ShaderSort,
    SplatShaders,
    Tuning,
    bind,
    read_words,
    tuning_of,
)
from physics.cameras.view import Shot

LATTICE_M: Final = 0.25
"""Spacing of the eyes that splats are sorted for, metres."""
_ORDERS_MAX: Final = 4
_MIN_KEY: Final = 251904
_MAX_KEY: Final = 65535
_KEY_BITS: Final = 16
_VIEW_ROWS: Final = 5
_CHUNK: Final = 16_384
"""Splats that are packed at once, which fit into the processor's cache."""
_LOOP_MAX: Final = 65000
"""Number of iterations after which llvmpipe may end the loops of an invocation."""


def lattice_point(eye_m: Floats) -> NDArray[np.float32]:
    """Return the (3,) point of the lattice of eyes nearest to an eye."""
    return (np.round(np.asarray(eye_m) / LATTICE_M) * LATTICE_M).astype(np.float32)


def distance_keys(centres: NDArray[np.float32], point: NDArray[np.float32]) -> NDArray[np.uint16]:
    """Return (N,) keys that grow with the distance of (N, 3) centres from a point.

    The result is the same as that of the shader `KEYS` to the bit.
    """
    x, y, z = (centres[:, k] - point[k] for k in range(3))
    bits = (x * x + y * y + z * z).view(np.uint32) >> np.uint32(12)
    steps = np.clip(bits, _MIN_KEY, _MIN_KEY + _MAX_KEY) - np.uint32(_MIN_KEY)
    return np.asarray(steps, dtype=np.uint16)


def cholesky(covariances: NDArray[np.float32]) -> NDArray[np.float64]:
    """Return (N, 6) lower triangles L of (N, 6) covariances L L^T: xx, yx, yy, zx, zy, zz.

    Flat splats have zeros.
    """
    xx, xy, xz, yy, yz, zz = np.ascontiguousarray(covariances.T, dtype=np.float64)
    least = 1e-12 * np.maximum(xx + yy + zz, 1e-30)
    a = np.sqrt(np.maximum(xx, least))
    b = xy / a
    c = np.sqrt(np.maximum(yy - b**2, least))
    d = xz / a
    e = (yz - b * d) / c
    f = np.sqrt(np.maximum(zz - d**2 - e**2, 0.0))
    return np.stack([a, b, c, d, e, f], axis=1)


def packed_splats(splats: Splats) -> NDArray[np.float32]:
    """Return the (N, 12) rows of the buffer `Splats` of the shaders."""
    rows = np.zeros((len(splats), 12), dtype=np.float32)
    rows[:, :3] = splats.centres
    rows.view(np.uint32)[:, 3] = np.ascontiguousarray(splats.rgba).view("<u4")[:, 0]
    for first in range(0, len(rows), _CHUNK):
        part = slice(first, first + _CHUNK)
        rows[part, 4:10] = cholesky(splats.covariances[part])
    rows[:, 10] = splats.ground
    return rows


class SplatCloud:
    """Splats of a scan on the renderer. Orders by numpy are cached for the last lattice points."""

    def __init__(self, context: moderngl.Context, splats: Splats) -> None:
        self._context = context
        self._splats = splats
        self.buffer = context.buffer(packed_splats(splats))
        self._orders: OrderedDict[tuple[float, ...], moderngl.Buffer] = OrderedDict()

    def __len__(self) -> int:
        return len(self._splats)

    def order(self, point: NDArray[np.float32]) -> moderngl.Buffer:
        """Return the numbers of the splats by distance from a point; ties by number."""
        key = tuple(point.tolist())
        if key in self._orders:
            self._orders.move_to_end(key)
            return self._orders[key]
        if len(self._orders) < _ORDERS_MAX:
            held = self._context.buffer(reserve=4 * len(self))
        else:
            held = self._orders.popitem(last=False)[1]
        keys = distance_keys(self._splats.centres, point)
        held.write(keys.argsort(kind="stable").astype(np.uint32))
        self._orders[key] = held
        return held

    def release(self) -> None:
        self.buffer.release()
        while self._orders:
            self._orders.popitem()[1].release()


class Views(NamedTuple):
    """Views of pictures of one size.

    size: width and height in pixels
    rows: (N, _VIEW_ROWS, 4) values of `View` in the shaders
    """

    size: tuple[int, int]
    rows: NDArray[np.float32]

    @classmethod
    def of(cls, taken: Sequence[Shot]) -> Views:
        """Return at least one view."""
        rows = np.zeros((len(taken), _VIEW_ROWS, 4), dtype=np.float32)
        for row, one in zip(rows, taken, strict=True):
            wide, tall = one.half_picture
            row[0] = *one.eye_m, 0.5 * one.size[1] / tall
            row[1:4, :3] = one.axes
            row[1:3, 3] = wide, tall
            row[4, :3] = lattice_point(one.eye_m)
        return cls(taken[0].size, rows)

    @property
    def tiles(self) -> tuple[int, int]:
        """Columns and rows of tiles of a picture."""
        width, height = self.size
        return -(-width // glsl.TILE_PX), -(-height // glsl.TILE_PX)

    def block(self, splats: int, first: int) -> NDArray[np.float32]:
        """Return the rows of the block `Splatting`. first: number of the first view's picture."""
        sizes = np.array([(*self.size, *self.tiles), (splats, len(self.rows), first, 0)])
        return np.concatenate([sizes.astype(np.uint32).view(np.float32), self.rows.reshape(-1, 4)])


class SplatDrawing:
    """Drawing of splats in a context."""

    def __init__(self, context: moderngl.Context, tuning: Tuning | None = None) -> None:
        self._context = context
        self.tuning = tuning or tuning_of(context)
        self._shaders = SplatShaders(context, self.tuning)
        self._buffers = Buffers(context)
        here = self.tuning.sorts_here
        self._sort = NumpySort(context) if here else ShaderSort(self._shaders, self._buffers)
        rows = 2 + _VIEW_ROWS * self.tuning.views
        self._block = context.buffer(reserve=16 * rows, dynamic=True)
        self.splats = self.pairs = 0
        """Numbers of projected splats, and of pairs of tile and splat, in the last pass."""

    def draw(
        self, cloud: SplatCloud, views: Views, target: SplatTarget, limited: bool, first: int = 0
    ) -> None:
        """Draw a cloud into the pictures of views, in several passes if they need much memory.

        limited: draw up to the depths in the texture of unit LIMITS_UNIT
        first: number of the first view's picture in the target
        """
        most = max(1, min(self.tuning.views, self.tuning.splats // max(len(cloud), 1)))
        few = -(-len(views.rows) // -(-len(views.rows) // most))
        for start in range(0, len(views.rows), few):
            part = views._replace(rows=views.rows[start : start + few])
            self._draw_pass(cloud, part, target, limited, first + start)

    def limit(self, views: Views, nth: int, limits: moderngl.Texture) -> None:
        """Compute the limits of the nth view from its layers, which are bound to their units."""
        few = min(self.tuning.views, len(views.rows))
        start = nth // few * few
        self._bind_views(views._replace(rows=views.rows[start : start + few]), 0, start)
        limits.bind_to_image(0, read=False, write=True)
        self._shaders.run("LIMITS", views.size, (glsl.TILE_PX,) * 2, nth=nth - start)

    def _bind_views(self, views: Views, splats: int, first: int) -> None:
        self._block.write(views.block(splats, first))
        self._block.bind_to_uniform_block(glsl.VIEW_BINDING)

    def _draw_pass(
        self, cloud: SplatCloud, views: Views, target: SplatTarget, limited: bool, first: int
    ) -> None:
        run, room = self._shaders, self._buffers.room
        self._bind_views(views, len(cloud), first)
        order, count = self._order(cloud, views)
        tiles, records = room("tiles", count + 1), room("records", 8 * count)
        rects, slopes = room("rects", 2 * count), room("slopes", 2 * count)
        bind(cloud.buffer, tiles, order, records, rects, slopes)
        run.along("PROJECT", count, total=count)
        self._sort.sums(tiles, count)
        # Room for all pairs must be known before they are written.
        total = int(read_words(self._context, tiles, count, 1)[0])
        self.splats, self.pairs = count, total
        half = len(views.rows) // 2
        if half and total > self.tuning.pairs:
            for part, start in ((views.rows[:half], first), (views.rows[half:], first + half)):
                self._draw_pass(cloud, views._replace(rows=part), target, limited, start)
            return
        lists, starts = self._listed(views, count, total)
        bind(records, starts, lists, slopes)
        target.bind()
        across, down = views.tiles
        name = "PAINT LIMITED" if limited else "PAINT"
        if self.tuning.rows > 1:
            sums = read_words(self._context, starts, 0, across * down + 1)
            name += " LONG" if np.diff(sums).max() > _LOOP_MAX else ""
        size = across * glsl.TILE_PX, len(views.rows) * down * glsl.TILE_PX
        run.run(name, size, (glsl.TILE_PX,) * 2)

    def _order(self, cloud: SplatCloud, views: Views) -> tuple[moderngl.Buffer, int]:
        """Return numbers of splats by distance, and how many; in shaders, only those in view."""
        if self.tuning.sorts_here:
            return cloud.order(views.rows[0, 4, :3].copy()), len(cloud)
        room, everything = self._buffers.room, len(views.rows) * len(cloud)
        seen = room("seen", everything + 1)
        bind(cloud.buffer, seen)
        self._shaders.along("PROJECT CULL", everything, total=everything)
        self._sort.sums(seen, everything)
        count = int(read_words(self._context, seen, everything, 1)[0])
        names = ("near", "near values", "near next", "near values next")
        keys, values, keys_next, values_next = (room(name, count) for name in names)
        bind(cloud.buffer, seen, keys, values)
        self._shaders.along("KEYS", everything)
        found = self._sort.sort((keys, values), (keys_next, values_next), count, _KEY_BITS)
        return found[1], count

    def _listed(
        self, views: Views, count: int, total: int
    ) -> tuple[moderngl.Buffer, moderngl.Buffer]:
        """Return the splats of each tile in their order, and where the tiles start."""
        run, room, lanes = self._shaders, self._buffers.room, (self.tuning.lanes, 1)
        names = ("pairs", "pairs values", "pairs next", "pairs values next")
        keys, values, keys_next, values_next = (room(name, total) for name in names)
        bind(room("rects", 2 * count), room("tiles", count + 1), keys, values)
        span = self.tuning.pairs_span
        run.run("EMIT", (-(-total // span), 1), lanes, drawn=count, span=span, total=total)
        across, down = views.tiles
        tiles = across * down * len(views.rows)
        bits = (tiles - 1).bit_length()
        keys, lists = self._sort.sort((keys, values), (keys_next, values_next), total, bits)
        starts = room("starts", tiles + 1)
        bind(keys, starts)
        run.run("STARTS", (tiles + 1, 1), (64, 1), tiles=tiles, total=total)
        return lists, starts

    def release(self) -> None:
        self._buffers.release()
        self._block.release()


class SplatTarget:
    """Premultiplied colour with transmittance in half floats, and median depth.

    size: of a picture
    pictures: number of pictures, one below the other
    """

    def __init__(self, context: moderngl.Context, size: tuple[int, int], pictures: int = 1) -> None:
        self.size = size[0], pictures * size[1]
        self.colour = context.texture(self.size, 4, dtype="f2")
        self.median = context.texture(self.size, 1, dtype="f4")

    def bind(self) -> None:
        self.colour.bind_to_image(0, read=False, write=True)
        self.median.bind_to_image(1, read=False, write=True)

    def read(self) -> tuple[NDArray[np.float16], NDArray[np.float32]]:
        """Read colour and transmittance (H, W, 4), and median depth (H, W), 0 for none."""
        width, height = self.size
        colour = np.frombuffer(self.colour.read(), dtype=np.float16).reshape(height, width, 4)
        median = np.frombuffer(self.median.read(), dtype=np.float32).reshape(height, width)
        return colour, median

    def release(self) -> None:
        self.colour.release()
        self.median.release()
