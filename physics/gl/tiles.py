"""The ground and buildings of a tile as one static buffer, uploaded once."""

from __future__ import annotations

from typing import Final

import moderngl
import numpy as np

from cosim.geometry import Floats
from cosim.state import LABELS
from physics.buildings import FACADES, WINDOWS, facade_meshes
from physics.gl.corners import LAYOUT, corners, joined
from physics.gl.shading import Programs, Stage, programs, put
from physics.ground import Ground
from physics.tiles import Key, square, surface

_VERTEX: Final = """
in vec3 in_at; in vec4 in_normal; in vec4 in_colour;
uniform vec2 middle;
out vec3 at; out vec3 normal; out vec3 albedo; flat out float label;
void main() {
    at = in_at + vec3(middle, 0.0);
    normal = unpacked(in_normal);
    albedo = in_colour.rgb;
    label = in_colour.a * 255.0;
    gl_Position = project(at);
}
"""

_FRAGMENT: Final = """
in vec3 at; in vec3 normal; in vec3 albedo; flat in float label;
void main() { show(albedo, normalize(normal), at, label); }
"""


class TileBuffers:
    """What does not move in one tile. middle: (2,) world metres."""

    def __init__(self, context: moderngl.Context, shaders: Programs, ground: Ground, key: Key):
        x0, y0, x1, y1 = square(key)
        self.middle: Floats = np.array([0.5 * (x0 + x1), 0.5 * (y0 + y1)])
        parts = [(mesh, *surface(name)[::-1]) for name, mesh in ground.tile(key).parts.items()]
        for facade, mesh in facade_meshes(ground.buildings(key)).items():
            parts.append((mesh, WINDOWS if facade < 0 else FACADES[facade], "building"))
        local = [(mesh.moved((*-self.middle, 0.0)), colour, LABELS[label]) for mesh, colour, label in parts]
        rows, triangles = joined([(mesh, corners(mesh, colour, label)) for mesh, colour, label in local])
        self._shaders = shaders
        self._corners, self._triangles = context.buffer(rows.tobytes()), context.buffer(triangles.tobytes())
        content = [(self._corners, *LAYOUT)]
        self._arrays = [
            context.vertex_array(program, content, self._triangles, skip_errors=True) for program in shaders
        ]

    def draw(self, stage: Stage, anchor: Floats) -> None:
        if stage != "moving":
            put(self._shaders.of(stage), "middle", tuple(self.middle - anchor))
            self._arrays[stage != "colour"].render()

    def release(self) -> None:
        for array in self._arrays:
            array.release()
        self._corners.release()
        self._triangles.release()


def tile_programs(context: moderngl.Context, shadows: bool) -> Programs:
    return programs(context, _VERTEX, _FRAGMENT, shadows)
