"""Bytes of pictures in a buffer, in the order of their readback: all colours, then all labels."""

from __future__ import annotations

from functools import lru_cache
from typing import Final

import moderngl

from physics.cameras.gl.shading import PICTURE_UNIT

_BINDING: Final = 2
_GROUP: Final = 64


def write_picture(
    context: moderngl.Context, picture: moderngl.Texture, buffer: moderngl.Buffer, offset: int
) -> None:
    """Queue a copy of a picture into a buffer. offset: bytes, a multiple of 4"""
    picture.use(PICTURE_UNIT)
    _run(context, _program(context, False), picture.size, buffer, (0, 1), offset)


def write_layers(
    context: moderngl.Context,
    pictures: moderngl.TextureArray,
    buffer: moderngl.Buffer,
    layers: tuple[int, int],
    offset: int,
) -> None:
    """Queue a copy of pictures that are layers, one after another, into a buffer.

    layers: first layer and count
    offset: bytes, a multiple of 4
    """
    pictures.use(PICTURE_UNIT)
    _run(context, _program(context, True), pictures.size[:2], buffer, layers, offset)


def _run(
    context: moderngl.Context,
    program: moderngl.ComputeShader,
    size: tuple[int, ...],
    buffer: moderngl.Buffer,
    layers: tuple[int, int],
    offset: int,
) -> None:
    first, count = layers
    words = size[0] * size[1]
    buffer.bind_to_storage_buffer(_BINDING)
    program["places"] = first, offset // 4, words
    # Without this barrier, llvmpipe reads stale texels where a picture was cleared but not drawn.
    context.memory_barrier()
    program.run((words + _GROUP - 1) // _GROUP, count)
    context.memory_barrier()


@lru_cache(maxsize=2)
def _program(context: moderngl.Context, layered: bool) -> moderngl.ComputeShader:
    sampler, texel = ("sampler2DArray", "ivec3(xy, layer)") if layered else ("sampler2D", "xy")
    return context.compute_shader(
        f"""#version 430
        layout(local_size_x = {_GROUP}) in;
        layout(binding = {PICTURE_UNIT}) uniform {sampler} pictures;
        layout(std430, binding = {_BINDING}) writeonly buffer Bytes {{ uint words[]; }};
        uniform ivec3 places;  // first layer, first word, words of a picture
        void main() {{
            int word = int(gl_GlobalInvocationID.x), nth = int(gl_WorkGroupID.y);
            if (word >= places.z) return;
            int wide = textureSize(pictures, 0).x, colours = 3 * places.z;
            int layer = places.x + nth;
            vec4 four;
            for (int i = 0; i < 4; i++) {{
                int k = 4 * word + i, at = k < colours ? k / 3 : k - colours;
                ivec2 xy = ivec2(at % wide, at / wide);
                vec4 seen = texelFetch(pictures, {texel}, 0);
                four[i] = seen[k < colours ? k - 3 * at : 3];
            }}
            words[places.y + nth * places.z + word] = packUnorm4x8(four);
        }}
        """
    )
