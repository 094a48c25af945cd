"""Isolated check of the OpenGL driver with a fixed shader; only the driver affects the result."""

from __future__ import annotations

import hashlib
from typing import Final

import moderngl
import numpy as np

from physics.cameras.gl.context import context

_SIDE: Final = 128
_VERTEX: Final = """#version 430
in vec2 at; out vec2 uv;
void main() {
    uv = at;
    gl_Position = vec4(at * (1.0 + 0.1 * at.y), 0.1 * at.x, 1.0 + 0.3 * at.y);
}"""
_FRAGMENT: Final = """#version 430
uniform sampler2D picture; in vec2 uv; out vec4 colour;
void main() {
    vec3 normal = normalize(vec3(sin(7.0 * uv.x), cos(5.0 * uv.y), 1.3));
    float shine = pow(max(dot(normal, normalize(vec3(0.3, 0.5, 0.8))), 0.0), 9.5);
    colour = vec4(texture(picture, 3.7 * uv).rgb * (0.2 + shine) * exp(-0.4 * length(uv)), 1.0);
}"""


def driver_alone() -> str:
    """Render a shaded, textured, tilted square and return its hash.

    Raises EngineError without OpenGL.
    """
    with context() as gl:
        program = gl.program(vertex_shader=_VERTEX, fragment_shader=_FRAGMENT)
        corners = gl.buffer(np.array([-1, -1, 1, -1, -1, 1, 1, 1], dtype="f4").tobytes())
        square = gl.vertex_array(program, [(corners, "2f", "at")])
        texels = (np.arange(64 * 64 * 4, dtype=np.uint32) * 2654435761 >> 24).astype(np.uint8)
        texture = gl.texture((64, 64), 4, texels.tobytes())
        texture.build_mipmaps()
        texture.filter = (moderngl.LINEAR_MIPMAP_LINEAR, moderngl.LINEAR)
        target = gl.simple_framebuffer((_SIDE, _SIDE))
        target.use()
        target.clear()
        texture.use()
        square.render(moderngl.TRIANGLE_STRIP)
        seen = hashlib.blake2b(target.read(components=3), digest_size=8).hexdigest()
        for thing in (target, texture, square, corners, program):
            thing.release()
    return seen
