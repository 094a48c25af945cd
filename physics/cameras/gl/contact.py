"""Contact shadows of people: soft dark spots where feet are near the ground."""

from __future__ import annotations

from typing import Final

import moderngl
import numpy as np
from numpy.typing import NDArray

from physics.cameras.gl.shading import programs
from physics.people.skeleton import INDEX

_SPOT: Final = np.dtype([("person", "i4"), ("tall", "f4"), ("seat", "i4")])
_VERTEX: Final = f"""
layout(binding = 0) uniform sampler2D posed;
in int person; in float tall;
out vec2 off; out float dark;
vec3 sole(int joint, float y) {{
    vec4 rest = vec4(vec3(0.03, y, 0.0) / tall, 1.0);
    return vec3(dot(texelFetch(posed, ivec2(3 * joint, person), 0), rest),
        dot(texelFetch(posed, ivec2(3 * joint + 1, person), 0), rest),
        dot(texelFetch(posed, ivec2(3 * joint + 2, person), 0), rest));
}}
void main() {{
    vec3 left = sole({INDEX["left_ankle"]}, 0.094), right = sole({INDEX["right_ankle"]}, -0.094);
    vec3 foot = gl_VertexID < 6 ? left : right;
    int corner = gl_VertexID % 6;
    off = vec2(corner == 1 || corner == 2 || corner == 4 ? 1.0 : -1.0, corner > 1 && corner != 3 ? 1.0 : -1.0);
    float ground = min(left.z, right.z);
    dark = 0.62 * clamp(1.0 - (foot.z - ground) / 0.14, 0.0, 1.0);
    gl_Position = project(vec3(foot.xy + 0.24 * off, ground + 0.012));
}}
"""
_FRAGMENT: Final = """
in vec2 off; in float dark;
void main() {
    float inside = max(1.0 - dot(off, off), 0.0);
    pixel = vec4(0.0, 0.0, 0.0, dark * inside * inside * (1.0 - fogged()));
}
"""


class ContactShadows:
    """Spots under the feet of the people of a batch, from the matrices in texture unit 0."""

    def __init__(self, context: moderngl.Context) -> None:
        self._context = context
        self._counts = np.zeros(0, dtype=np.intp)
        self._room = 0
        self._held: list[moderngl.Buffer] = []
        self._arrays: dict[int, moderngl.VertexArray] = {}

    def set(
        self,
        counts: NDArray[np.intp],
        person: NDArray[np.intp],
        tall: NDArray[np.floating],
        seat: NDArray[np.intp],
    ) -> None:
        """Upload spots, by part of the batch.

        counts: (parts,) people with spots
        person: (N,) rows of the matrix texture
        tall: (N,) size of the modelled man relative to their family
        seat: (N,) of their scenes
        """
        self._counts = counts
        table = np.empty(len(person), dtype=_SPOT)
        table["person"], table["tall"], table["seat"] = person, tall, seat
        commands = np.zeros((len(counts), 5), dtype=np.uint32)
        commands[:, 0], commands[:, 1], commands[:, 3] = 12, counts, np.cumsum(counts) - counts
        if max(table.nbytes, commands.nbytes) > self._room or not self._held:
            self._grow(max(2 * table.nbytes, 2 * commands.nbytes, 1024))
        self._spots.write(table)
        self._commands.write(commands)

    def draw(self, part: int, layers: int) -> None:
        """Darken the ground of a part of the batch. Labels and depth must be masked.

        layers: `Variant.LAYERS`, or 0
        """
        if part < len(self._counts) and self._counts[part]:
            self._context.enable(moderngl.BLEND)
            self._array(layers).render_indirect(self._commands, moderngl.TRIANGLES, 1, part)
            self._context.disable(moderngl.BLEND)

    def release(self) -> None:
        for array in self._arrays.values():
            array.release()
        for buffer in self._held:
            buffer.release()
        self._arrays = {}
        self._held = []

    def _grow(self, room: int) -> None:
        self.release()
        self._room = room
        self._spots, self._commands = (self._context.buffer(reserve=room) for _ in range(2))
        self._held = [self._spots, self._commands]

    def _array(self, layers: int) -> moderngl.VertexArray:
        if layers not in self._arrays:
            drawn = programs(self._context, _VERTEX, _FRAGMENT, layers).colour
            layout = ("1i4 1f4 1i4/i", "person", "tall", "seat")
            content = [(self._spots, *(layout if layers else ("1i4 1f4 4x/i", *layout[1:3])))]
            self._arrays[layers] = self._context.vertex_array(drawn, content)
        return self._arrays[layers]
