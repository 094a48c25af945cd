"""Contact shadows of people: soft dark spots where feet are near the ground."""

from __future__ import annotations

from typing import Final

import moderngl

from physics.cameras.gl.gl_state import blending
from physics.cameras.gl.shading import programs
from physics.people.skeleton import INDEX

CORNERS: Final = 12
"""Corners of the two spots of a person."""
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
        self._arrays: dict[int, moderngl.VertexArray] = {}

    def draw(
        self,
        instances: moderngl.Buffer,
        commands: moderngl.Buffer,
        first: int,
        count: int,
        layers: int,
    ) -> None:
        """Draw `count` indirect draws, from `first` on. Labels and depth must be masked.

        instances: as for `Skins`, until `release`
        layers: `Variant.LAYERS`, or 0
        """
        if layers not in self._arrays:
            drawn = programs(self._context, _VERTEX, _FRAGMENT, layers).colour
            layout = ("1i4 8x 1f4 1i4/i", "person", "tall", "scene_id")
            content = [(instances, *(layout if layers else ("1i4 8x 1f4 4x/i", *layout[1:3])))]
            self._arrays[layers] = self._context.vertex_array(drawn, content)
        with blending(self._context):
            self._arrays[layers].render_indirect(commands, moderngl.TRIANGLES, count, first)

    def release(self) -> None:
        """Free the arrays; they are made again when needed."""
        for array in self._arrays.values():
            array.release()
        self._arrays = {}
