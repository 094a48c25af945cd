"""Bytes of pictures in a buffer, in the order of their readback: all colours, then all labels."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from typing import Final

import moderngl
import numpy as np

from physics.cameras.gl.shading import PICTURE_UNIT, PICTURES_MAX

_BINDING: Final = 2
_GROUP: Final = 64


def write_picture(
    context: moderngl.Context, picture: moderngl.Texture, buffer: moderngl.Buffer, offset: int
) -> None:
    """Queue a copy of a picture into a buffer. offset: bytes, a multiple of 4"""
    picture.use(PICTURE_UNIT)
    program = _program(context, False)
    program["first_word"] = offset // 4
    _run(context, program, picture.size, buffer, 1)


def write_layers(
    context: moderngl.Context,
    pictures: moderngl.TextureArray,
    buffer: moderngl.Buffer,
    places: Sequence[int],
) -> None:
    """Queue a copy of pictures that are the first layers into a buffer.

    places: number of each in the buffer, at most PICTURES_MAX
    """
    pictures.use(PICTURE_UNIT)
    program = _program(context, True)
    numbers = np.zeros(PICTURES_MAX, dtype=np.int32)
    numbers[: len(places)] = places
    uniform = program["places"]
    assert isinstance(uniform, moderngl.Uniform)
    uniform.write(numbers)
    _run(context, program, pictures.size[:2], buffer, len(places))


def _run(
    context: moderngl.Context,
    program: moderngl.ComputeShader,
    size: tuple[int, ...],
    buffer: moderngl.Buffer,
    count: int,
) -> None:
    words = size[0] * size[1]
    buffer.bind_to_storage_buffer(_BINDING)
    # Without this barrier, llvmpipe reads stale texels where a picture was cleared but not drawn.
    context.memory_barrier()
    program.run((words + _GROUP - 1) // _GROUP, count)
    context.memory_barrier()


@lru_cache(maxsize=2)
def _program(context: moderngl.Context, layers: bool) -> moderngl.ComputeShader:
    layered = "#define LAYERED\n" if layers else ""
    return context.compute_shader(
        f"""#version 430
{layered}
        layout(local_size_x = {_GROUP}) in;
        layout(std430, binding = {_BINDING}) writeonly buffer Bytes {{ uint words[]; }};
#ifdef LAYERED
        layout(binding = {PICTURE_UNIT}) uniform sampler2DArray pictures;
        uniform int places[{PICTURES_MAX}];
        #define AT(xy) ivec3(xy, gl_WorkGroupID.y)
#else
        layout(binding = {PICTURE_UNIT}) uniform sampler2D pictures;
        uniform int first_word;
        #define AT(xy) xy
#endif
        void main() {{
            ivec2 size = textureSize(pictures, 0).xy;
            int word = int(gl_GlobalInvocationID.x), whole = size.x * size.y, colours = 3 * whole;
            if (word >= whole) return;
            vec4 four;
            for (int i = 0; i < 4; i++) {{
                int k = 4 * word + i, at = k < colours ? k / 3 : k - colours;
                vec4 seen = texelFetch(pictures, AT(ivec2(at % size.x, at / size.x)), 0);
                four[i] = seen[k < colours ? k - 3 * at : 3];
            }}
#ifdef LAYERED
            int first_word = places[gl_WorkGroupID.y] * whole;
#endif
            words[first_word + word] = packUnorm4x8(four);
        }}
        """
    )
