"""Background of a picture: the sky, and infinite ground below the horizon."""

from __future__ import annotations

from typing import Final

import moderngl

from cosim.core.state import LABELS
from physics.cameras.gl.lighting import sky_texture
from physics.cameras.gl.shading import SKY_UNIT, programs
from physics.cameras.sky import HORIZON_FADE, Sky

_VERTEX: Final = """
out vec2 spot;
void main() {
    spot = vec2(gl_VertexID == 2 ? 3.0 : -1.0, gl_VertexID == 1 ? 3.0 : -1.0);
    gl_Position = vec4(spot, 1.0, 1.0);
}
"""

_FRAGMENT: Final = f"""
layout(binding = {SKY_UNIT}) uniform sampler2D sky;
uniform vec3 all_around;
in vec2 spot;
void main() {{
    vec3 ray = normalize(ahead.xyz + spot.x * right.w * right.xyz - spot.y * up.w * up.xyz);
    vec2 where = vec2(0.5 - atan(ray.y, ray.x) * 0.15915494, 0.5 - asin(ray.z) * 0.31830989);
    float label = ray.z < 0.0 ? {LABELS["ground"]}.0 : {LABELS["sky"]}.0;
    vec3 seen = texture(sky, where).rgb;
    if (ray.z < 0.0) seen = max(seen + (fog.rgb - all_around) * exp(ray.z / {HORIZON_FADE}), 0.0);
    pixel = vec4(on_screen(seen), label / 255.0);
}}
"""


class Backdrop:
    """Background triangle over the whole picture at the far end of the depth; draw it last."""

    def __init__(self, context: moderngl.Context, sky: Sky) -> None:
        self._program = programs(context, _VERTEX, _FRAGMENT, shadows=False).colour
        self._all_around = tuple(float(c) for c in sky.fog_colour)
        self._array = context.vertex_array(self._program, [])
        self._sky = sky_texture(context, sky.radiance)

    def draw(self) -> None:
        self._program["all_around"] = self._all_around
        self._sky.use(SKY_UNIT)
        self._array.render(moderngl.TRIANGLES, vertices=3)

    def release(self) -> None:
        self._array.release()
        self._sky.release()
