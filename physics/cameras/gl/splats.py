"""Drawing of Gaussian splats: order, projection, lists of tiles, and blending, in compute shaders.

A picture is a function of splats and view alone. Splats are ordered by their distance from the
nearest point of a lattice of eyes, so the order does not depend on the heading.
"""

from __future__ import annotations

from collections import OrderedDict
from typing import Final, NamedTuple

import moderngl
import numpy as np
from numpy.typing import NDArray

from cosim.core.geometry import Floats
from cosim.place.scan import Splats
from physics.cameras.gl import splat_shaders as glsl
from physics.cameras.gl.context import is_card
from physics.cameras.view import Shot

LATTICE_M: Final = 0.25
"""Spacing of the eyes that splats are sorted for, metres."""
_ORDERS_MAX: Final = 4
_LEAST_KEY: Final = 251904
_MOST_KEY: Final = 65535
_COUNTS_MAX: Final = 1 << 23
"""Maximum number of counters of a sort."""
_CHUNK_MAX: Final = 32768
"""Maximum number of items of a chunk: llvmpipe ends loops after 65535 iterations."""
_VIEW_ROWS: Final = 7
_LINE: Final = 65535 * 64
"""Maximum number of invocations in one dimension of a dispatch."""


class Tuning(NamedTuple):
    """Sizes of work; they affect the speed alone.

    sorts_here: sort by numpy, not in shaders
    lanes: invocations of a work group of the serial shaders
    chunks: maximum number of chunks of a sort
    group: chunks that are summed by one invocation
    splats_chunk: splats whose pairs are counted by one invocation
    pairs_span: pairs that are listed by one invocation
    rows: pixels of an invocation that blends
    """

    sorts_here: bool
    lanes: int
    chunks: int
    group: int
    splats_chunk: int
    pairs_span: int
    rows: int


PROCESSOR: Final = Tuning(True, 8, 128, 16, 1024, 512, 8)
CARD: Final = Tuning(False, 32, 4096, 64, 32, 64, 1)


def tuning_of(context: moderngl.Context) -> Tuning:
    """Return the sizes of work for the context's renderer."""
    return CARD if is_card(context) else PROCESSOR


def lattice_point(eye_m: Floats) -> NDArray[np.float32]:
    """Return the (3,) point of the lattice of eyes nearest to an eye."""
    return (np.round(np.asarray(eye_m) / LATTICE_M) * LATTICE_M).astype(np.float32)


def distance_keys(centres: NDArray[np.float32], point: NDArray[np.float32]) -> NDArray[np.uint16]:
    """Return (N,) keys that grow with the distance of (N, 3) centres from a point.

    The result is the same as that of the shader `KEYS` to the bit.
    """
    x, y, z = (centres[:, k] - point[k] for k in range(3))
    bits = (x * x + y * y + z * z).view(np.uint32) >> np.uint32(12)
    steps = np.clip(bits, _LEAST_KEY, _LEAST_KEY + _MOST_KEY) - np.uint32(_LEAST_KEY)
    return np.asarray(steps, dtype=np.uint16)


def cholesky(covariances: NDArray[np.float32]) -> NDArray[np.float64]:
    """Return (N, 6) lower triangles L of (N, 6) covariances L L^T: xx, yx, yy, zx, zy, zz.

    Flat splats have zeros.
    """
    xx, xy, xz, yy, yz, zz = covariances.astype(np.float64).T
    least = 1e-12 * np.maximum(xx + yy + zz, 1e-30)
    found = np.zeros((len(xx), 6))
    found[:, 0] = np.sqrt(np.maximum(xx, least))
    found[:, 1] = xy / found[:, 0]
    found[:, 2] = np.sqrt(np.maximum(yy - found[:, 1] ** 2, least))
    found[:, 3] = xz / found[:, 0]
    found[:, 4] = (yz - found[:, 1] * found[:, 3]) / found[:, 2]
    found[:, 5] = np.sqrt(np.maximum(zz - found[:, 3] ** 2 - found[:, 4] ** 2, 0.0))
    return found


def packed_splats(splats: Splats) -> NDArray[np.float32]:
    """Return the (N, 12) rows of the buffer `Splats` of the shaders."""
    rows = np.zeros((len(splats), 12), dtype=np.float32)
    rows[:, :3] = splats.centres
    rows.view(np.uint32)[:, 3] = np.ascontiguousarray(splats.rgba).view("<u4")[:, 0]
    rows[:, 4:10] = cholesky(splats.covariances)[:, (0, 1, 2, 3, 4, 5)]
    rows[:, 10] = splats.ground
    return rows


class SplatShaders:
    """Compute shaders of a context. tuning: sizes of work."""

    def __init__(self, context: moderngl.Context, tuning: Tuning) -> None:
        self._context = context
        self.tuning = tuning
        self._shaders: dict[str, tuple[moderngl.ComputeShader, dict[str, moderngl.Uniform]]] = {}

    def run(self, name: str, size: tuple[int, int], each: tuple[int, int], **uniforms: int) -> None:
        """Run a shader over (x, y) invocations in groups of `each`, and wait for its writes."""
        if name not in self._shaders:
            code: str = getattr(glsl, name.split()[0])
            if "LIMITED" in name.split():
                code = code.replace("#version 430\n", "#version 430\n#define LIMITED\n")
            lanes, rows = self.tuning.lanes, self.tuning.rows
            for word, value in (("LANES", lanes), ("ROWS", rows), ("DOWN", glsl.TILE_PX // rows)):
                code = code.replace(word, str(value))
            made = self._context.compute_shader(code)
            members = {member: made[member] for member in made}
            self._shaders[name] = (
                made,
                {k: one for k, one in members.items() if isinstance(one, moderngl.Uniform)},
            )
        shader, known = self._shaders[name]
        for uniform, value in uniforms.items():
            if uniform in known:  # the compiler removes unused ones
                known[uniform].value = value
        x, y = (-(-count // group) for count, group in zip(size, each, strict=True))
        shader.run(x, y)
        self._context.memory_barrier(
            moderngl.SHADER_STORAGE_BARRIER_BIT
            | moderngl.SHADER_IMAGE_ACCESS_BARRIER_BIT
            | moderngl.TEXTURE_FETCH_BARRIER_BIT
        )

    def along(self, name: str, count: int, **uniforms: int) -> None:
        """Run a shader over `count` invocations, in several lines if there are too many."""
        line = min(count, _LINE)
        self.run(name, (line, -(-count // _LINE)), (64, 1), **uniforms)


class Buffers:
    """Storage buffers by name, which grow as needed and lose their content then."""

    def __init__(self, context: moderngl.Context) -> None:
        self._context = context
        self._held: dict[str, moderngl.Buffer] = {}

    def room(self, name: str, words: int) -> moderngl.Buffer:
        """Return a buffer of at least `words` words of 4 bytes."""
        held = self._held.get(name)
        if held is None or held.size < 4 * words:
            if held is not None:
                held.release()
            self._held[name] = self._context.buffer(reserve=max(64, 5 * words))
        return self._held[name]

    def release(self) -> None:
        while self._held:
            self._held.popitem()[1].release()


class StableSort:
    """Stable counting sort of (key, value) pairs by a digit of the key, without atomics."""

    def __init__(self, shaders: SplatShaders, buffers: Buffers) -> None:
        self._shaders = shaders
        self._buffers = buffers

    def sort(
        self,
        pairs: tuple[moderngl.Buffer, moderngl.Buffer],
        into: tuple[moderngl.Buffer | None, moderngl.Buffer],
        total: int,
        digits: int,
        shift: int = 0,
    ) -> moderngl.Buffer:
        """Sort pairs by `(key >> shift) % digits` into other buffers.

        into: keys, None to drop them, and values
        Returns the (digits + 1,) starts of the digits.
        """
        run, tuning, room = self._shaders, self._shaders.tuning, self._buffers.room
        most = max(1, min(tuning.chunks, _COUNTS_MAX // digits))
        chunk = min(max(1, -(-total // most)), _CHUNK_MAX)
        chunks = max(1, -(-total // chunk))
        groups = -(-chunks // tuning.group)
        counts, sums = room("counts", chunks * digits), room("groups", groups * digits)
        starts = room(f"starts {digits}", digits + 1)
        sizes = {"total": total, "chunk": chunk, "chunks": chunks, "digits": digits, "shift": shift}
        counts.bind_to_storage_buffer(0)
        run.along("CLEAR", chunks * digits, total=chunks * digits)
        pairs[0].bind_to_storage_buffer(1)
        run.run("COUNT", (chunks, 1), (tuning.lanes, 1), **sizes)
        sums.bind_to_storage_buffer(1)
        run.run("COLUMNS", (digits, groups), (64, 1), group=tuning.group, **sizes)
        sums.bind_to_storage_buffer(0)
        starts.bind_to_storage_buffer(1)
        run.run("GROUPS", (digits, 1), (64, 1), groups_of=groups, **sizes)
        starts.bind_to_storage_buffer(0)
        run.run("SCAN", (1, 1), (1, 1), digits=digits)
        keys = into[0] if into[0] is not None else pairs[0]
        for place, buffer in enumerate((counts, pairs[0], sums, starts, pairs[1], keys, into[1])):
            buffer.bind_to_storage_buffer(place)
        keep = int(into[0] is not None)
        lanes = (tuning.lanes, 1)
        run.run("SCATTER", (chunks, 1), lanes, group=tuning.group, keep_keys=keep, **sizes)
        return starts


class SplatCloud:
    """Splats of a scan on the renderer, and their orders for the last points of the lattice."""

    def __init__(self, context: moderngl.Context, splats: Splats) -> None:
        self._context = context
        self._splats = splats
        self.buffer = context.buffer(packed_splats(splats))
        self._orders: OrderedDict[tuple[float, ...], moderngl.Buffer] = OrderedDict()

    def __len__(self) -> int:
        return len(self._splats)

    def order(self, point: NDArray[np.float32], drawing: SplatDrawing) -> moderngl.Buffer:
        """Return the numbers of the splats by distance from a point; ties by number."""
        key = tuple(point.tolist())
        if key in self._orders:
            self._orders.move_to_end(key)
            return self._orders[key]
        if len(self._orders) < _ORDERS_MAX:
            held = self._context.buffer(reserve=4 * len(self))
        else:
            held = self._orders.popitem(last=False)[1]
        if drawing.tuning.sorts_here:
            keys = distance_keys(self._splats.centres, point)
            held.write(keys.argsort(kind="stable").astype(np.uint32))
        else:
            drawing.sort(self, held)
        self._orders[key] = held
        return held

    def release(self) -> None:
        self.buffer.release()
        while self._orders:
            self._orders.popitem()[1].release()


class SplatDrawing:
    """Drawing of splats in a context."""

    def __init__(self, context: moderngl.Context, tuning: Tuning | None = None) -> None:
        self._context = context
        self.tuning = tuning or tuning_of(context)
        self._shaders = SplatShaders(context, self.tuning)
        self._buffers = Buffers(context)
        self._sort = StableSort(self._shaders, self._buffers)
        self._view = context.buffer(reserve=16 * _VIEW_ROWS, dynamic=True)
        self.pairs = 0
        """Number of pairs of tile and splat in the last picture."""

    def sort(self, cloud: SplatCloud, into: moderngl.Buffer) -> None:
        """Sort a cloud by distance from the lattice point of the view, in shaders."""
        names = ("near", "near values", "near next", "near values next")
        keys, values, keys_next, values_next = (self._buffers.room(n, len(cloud)) for n in names)
        for place, buffer in enumerate((cloud.buffer, keys, values)):
            buffer.bind_to_storage_buffer(place)
        self._shaders.along("KEYS", len(cloud))
        self._sort.sort((keys, values), (keys_next, values_next), len(cloud), 256)
        self._sort.sort((keys_next, values_next), (None, into), len(cloud), 256, 8)

    def draw(
        self, cloud: SplatCloud, rows: NDArray[np.float32], target: SplatTarget, limited: bool
    ) -> None:
        """Draw a cloud.

        rows: of `view_rows`
        limited: draw up to the depths in the texture of unit LIMITS_UNIT
        """
        run, room = self._shaders, self._buffers.room
        sizes = rows.view(np.uint32)[4]
        tiles = int(sizes[2] * sizes[3])
        rows.view(np.uint32)[5, 0] = len(cloud)
        self._view.write(rows)
        self._view.bind_to_uniform_block(glsl.VIEW_BINDING)
        order = cloud.order(rows[6, :3].copy(), self)
        records, rects = room("records", 8 * len(cloud)), room("rects", 2 * len(cloud))
        slopes = room("slopes", 2 * len(cloud))
        for place, buffer in enumerate((cloud.buffer, order, records, rects, slopes)):
            buffer.bind_to_storage_buffer(place)
        run.along("PROJECT", len(cloud))
        lists, starts = self._listed(len(cloud), tiles, rects)
        for place, buffer in enumerate((records, starts, lists, slopes)):
            buffer.bind_to_storage_buffer(place)
        target.bind()
        name = "PAINT LIMITED" if limited else "PAINT"
        across, down = sizes[2:].tolist()
        run.run(name, (across * glsl.TILE_PX, down * glsl.TILE_PX), (glsl.TILE_PX,) * 2)

    def limit(self, rows: NDArray[np.float32], limits: moderngl.Texture) -> None:
        """Compute the limits of a picture from its layers, which are bound to their units."""
        self._view.write(rows)
        self._view.bind_to_uniform_block(glsl.VIEW_BINDING)
        limits.bind_to_image(0, read=False, write=True)
        across, down = rows.view(np.uint32)[4, :2].tolist()
        self._shaders.run("LIMITS", (across, down), (glsl.TILE_PX,) * 2)

    def _listed(
        self, count: int, tiles: int, rects: moderngl.Buffer
    ) -> tuple[moderngl.Buffer, moderngl.Buffer]:
        """Return the splats of each tile in their order, and where the tiles start."""
        run, tuning, room = self._shaders, self.tuning, self._buffers.room
        chunk, lanes = tuning.splats_chunk, (tuning.lanes, 1)
        chunks = -(-count // chunk)
        sums, before = room("sums", chunks + 1), room("before", count)
        for place, buffer in enumerate((rects, sums, before)):
            buffer.bind_to_storage_buffer(place)
        run.run("SUMS", (chunks, 1), lanes, chunk=chunk)
        sums.bind_to_storage_buffer(0)
        run.run("SCAN", (1, 1), (1, 1), digits=chunks)
        # Room for all pairs must be known before they are written: the only value that is read.
        self._context.memory_barrier(moderngl.BUFFER_UPDATE_BARRIER_BIT)
        total = int(np.frombuffer(sums.read(4, offset=4 * chunks), dtype=np.uint32)[0])
        self.pairs = total
        keys, values, lists = (room(name, total + 1) for name in ("tiles", "of tiles", "lists"))
        for place, buffer in enumerate((rects, sums, before, keys, values)):
            buffer.bind_to_storage_buffer(place)
        span = tuning.pairs_span
        size = -(-max(total, 1) // span), 1
        run.run("EMIT", size, lanes, chunk=chunk, chunks=chunks, span=span, total=total)
        starts = self._sort.sort((keys, values), (None, lists), total, tiles)
        return lists, starts

    def release(self) -> None:
        self._buffers.release()
        self._view.release()


class SplatTarget:
    """Premultiplied colour with transmittance in half floats, and median depth, of one size."""

    def __init__(self, context: moderngl.Context, size: tuple[int, int]) -> None:
        self.size = size
        self.colour = context.texture(size, 4, dtype="f2")
        self.median = context.texture(size, 1, dtype="f4")

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


def view_rows(taken: Shot) -> NDArray[np.float32]:
    """Return the (_VIEW_ROWS, 4) rows of the block `Splatting` for a view, with its order."""
    rows = np.zeros((_VIEW_ROWS, 4), dtype=np.float32)
    width, height = taken.size
    wide, tall = taken.half_picture
    rows[0] = *taken.eye_m, 0.5 * height / tall
    rows[1:4, :3] = taken.axes
    rows[1:3, 3] = wide, tall
    tiles = (-(-width // glsl.TILE_PX), -(-height // glsl.TILE_PX))
    rows.view(np.uint32)[4] = width, height, *tiles
    rows[6, :3] = lattice_point(taken.eye_m)
    return rows
