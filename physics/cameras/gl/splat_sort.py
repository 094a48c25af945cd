"""Compute shaders of a context, their buffers, prefix sums, and stable sorts."""

from __future__ import annotations

from typing import Final, NamedTuple

import moderngl
import numpy as np
from numpy.typing import NDArray

from physics.cameras.gl import splat_shaders as glsl
from physics.cameras.gl.context import is_card

_LINE: Final = 65535 * 64
"""Maximum number of invocations in one dimension of a dispatch."""
_DIGIT_BITS: Final = glsl.DIGITS.bit_length() - 1


class Tuning(NamedTuple):
    """Sizes of work; they affect speed and memory alone.

    sorts_here: sort by numpy, not in shaders
    lanes: invocations of a work group of sorts and lists; a power of two
    pairs_span: pairs that are listed by one invocation
    rows: pixels of an invocation that blends
    views: maximum number of views of a pass
    splats: maximum number of splats of a pass with several views, counted once for each view
    pairs: maximum number of pairs of tile and splat of a pass with several views
    """

    sorts_here: bool
    lanes: int
    pairs_span: int
    rows: int
    views: int
    splats: int
    pairs: int


PROCESSOR: Final = Tuning(True, 8, 512, 8, 1, 0, 0)
CARD: Final = Tuning(False, 32, 64, 1, 16, 1 << 24, 1 << 25)


def tuning_of(context: moderngl.Context) -> Tuning:
    """Return the sizes of work for the context's renderer."""
    return CARD if is_card(context) else PROCESSOR


class SplatShaders:
    """Compute shaders of a context. tuning: sizes of work."""

    def __init__(self, context: moderngl.Context, tuning: Tuning) -> None:
        self._context = context
        self.tuning = tuning
        self._shaders: dict[str, tuple[moderngl.ComputeShader, dict[str, moderngl.Uniform]]] = {}

    def run(self, name: str, size: tuple[int, int], each: tuple[int, int], **uniforms: int) -> None:
        """Run a shader over (x, y) invocations in groups of `each`, and wait for its writes.

        name: of the shader, and the words that are defined in it
        """
        if name not in self._shaders:
            self._shaders[name] = self._compiled(name)
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

    def _compiled(self, name: str) -> tuple[moderngl.ComputeShader, dict[str, moderngl.Uniform]]:
        shader, *defined = name.split()
        code: str = getattr(glsl, shader)
        version = "#version 430\n"
        code = code.replace(version, version + "".join(f"#define {one}\n" for one in defined))
        lanes, rows, views = self.tuning.lanes, self.tuning.rows, self.tuning.views
        down = glsl.TILE_PX // rows
        for word, value in (("LANES", lanes), ("ROWS", rows), ("DOWN", down), ("VIEWS", views)):
            code = code.replace(word, str(value))
        made = self._context.compute_shader(code)
        members = {member: made[member] for member in made}
        return made, {k: one for k, one in members.items() if isinstance(one, moderngl.Uniform)}

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


def bind(*buffers: moderngl.Buffer) -> None:
    """Bind buffers to the storage blocks 0, 1 and so on."""
    for place, buffer in enumerate(buffers):
        buffer.bind_to_storage_buffer(place)


Pairs = tuple[moderngl.Buffer, moderngl.Buffer]
"""Keys and values."""


class ShaderSort:
    """Prefix sums and stable sorts in shaders, without atomics."""

    def __init__(self, shaders: SplatShaders, buffers: Buffers) -> None:
        self._shaders = shaders
        self._room = buffers.room

    def sums(self, values: moderngl.Buffer, count: int, level: int = 0) -> None:
        """Replace `count` values by the sums of those before, and append the sum of all."""
        blocks = -(-(count + 1) // glsl.SCANNED)
        parts = self._room(f"sums {level}", blocks + 1)
        bind(values, parts)
        self._shaders.run("SCAN", (blocks, 1), (1, 1), total=count)
        if blocks > 1:
            self.sums(parts, blocks, level + 1)
            bind(values, parts)
            self._shaders.along("ADD", count + 1, total=count + 1)

    def sort(self, pairs: Pairs, spare: Pairs, total: int, bits: int) -> Pairs:
        """Sort pairs by the lowest bits of their keys, with spare buffers of the same size.

        Returns those of the buffers that have the sorted pairs.
        """
        blocks = -(-total // glsl.SORTED)
        counts = self._room("counts", glsl.DIGITS * blocks + 1)
        lanes = self._shaders.tuning.lanes
        size = blocks * lanes, 1
        for shift in range(0, bits if total else 0, _DIGIT_BITS):
            sizes = {"total": total, "blocks": blocks, "shift": shift}
            bind(counts, pairs[0])
            self._shaders.run("COUNT", size, (lanes, 1), **sizes)
            self.sums(counts, glsl.DIGITS * blocks)
            bind(counts, *pairs, *spare)
            self._shaders.run("SCATTER", size, (lanes, 1), **sizes)
            pairs, spare = spare, pairs
        return pairs


class NumpySort:
    """The same sums and sorts by numpy, which is faster on a renderer without a GPU."""

    def __init__(self, context: moderngl.Context) -> None:
        self._context = context

    def sums(self, values: moderngl.Buffer, count: int) -> None:
        """Replace `count` values by the sums of those before, and append the sum of all."""
        sums = np.zeros(count + 1, dtype=np.uint32)
        np.cumsum(read_words(self._context, values, 0, count), out=sums[1:])
        values.write(sums)

    def sort(self, pairs: Pairs, spare: Pairs, total: int, bits: int) -> Pairs:
        """Sort pairs by keys of at most `bits` bits into the spare buffers, and return these."""
        keys, values = (read_words(self._context, part, 0, total) for part in pairs)
        order = keys.astype(f"u{2 if bits <= 16 else 4}").argsort(kind="stable")
        for part, sorted_ in zip(spare, (keys[order], values[order]), strict=True):
            part.write(sorted_)
        return spare


def read_words(
    context: moderngl.Context, buffer: moderngl.Buffer, first: int, count: int
) -> NDArray[np.uint32]:
    """Read `count` words of a buffer that shaders have written; it waits for the renderer.

    They are copied to a buffer of their own first: some drivers move the whole of a buffer that is
    read out of the memory of the card.
    """
    if not count:
        return np.zeros(0, dtype=np.uint32)
    context.memory_barrier(moderngl.BUFFER_UPDATE_BARRIER_BIT)
    size = 4 * count
    copy = context.buffer(reserve=size)
    context.copy_buffer(copy, buffer, size, read_offset=4 * first)
    words = np.frombuffer(copy.read(), dtype=np.uint32)
    copy.release()
    return words
