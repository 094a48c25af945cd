"""What lies behind everything: the sky, and below the horizon ground without end."""

from __future__ import annotations

from typing import Final

import moderngl

from cosim.state import LABELS
from physics.gl.shading import programs, put

_VERTEX: Final = """
out vec2 spot;
void main() {
    spot = vec2(gl_VertexID == 2 ? 3.0 : -1.0, gl_VertexID == 1 ? 3.0 : -1.0);
    gl_Position = vec4(spot, 1.0, 1.0);
}
"""

_FRAGMENT: Final = f"""
in vec2 spot;
uniform vec3 zenith;
void main() {{
    vec3 ray = normalize(ahead.xyz + spot.x * right.w * right.xyz - spot.y * up.w * up.xyz);
    float rise = clamp(asin(ray.z) / 0.7, 0.0, 1.0);
    pixel = vec4(sqrt(min(mix(fog.rgb, zenith, rise) * eye.w, 1.0)),
                 (ray.z < 0.0 ? {LABELS["ground"]}.0 : {LABELS["sky"]}.0) / 255.0);
}}
"""


class Backdrop:
    """One triangle over the whole picture, at the far end of the depth; draw it last."""

    def __init__(self, context: moderngl.Context) -> None:
        self._program = programs(context, _VERTEX, _FRAGMENT, shadows=False).colour
        self._array = context.vertex_array(self._program, [])

    def draw(self, zenith: tuple[float, float, float]) -> None:
        put(self._program, "zenith", zenith)
        self._array.render(moderngl.TRIANGLES, vertices=3)

    def release(self) -> None:
        self._array.release()
