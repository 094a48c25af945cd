"""Background of a picture: the sky, and infinite ground below the horizon."""

from __future__ import annotations

from typing import Final

import moderngl

from cosim.core.state import LABELS
from physics.cameras.gl.lighting import sky_texture
from physics.cameras.gl.shading import SKY_UNIT, programs
from physics.cameras.gl.variants import Variant
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
#ifdef WEATHER
vec3 starlight(vec3 ray) {{
    vec2 on_sky = 90.0 * vec2(atan(ray.y, ray.x), asin(ray.z)), cell = floor(on_sky);
    float drawn = hashed(mod(cell, 251.0));
    float off = length(on_sky - cell - 0.25 - 0.5 * vec2(hashed(cell + 3.0), hashed(cell + 7.0)));
    float star = drawn < 0.03 ? fading(0.13, 0.02, off) * (0.3 + 30.0 * drawn) : 0.0;
    float apart = acos(clamp(dot(ray, normalize(vec3(0.55, -0.62, 0.46))), -1.0, 1.0));
    float moon = fading(0.0075, 0.0065, apart) * 2.0e-2 + 1.2e-4 * exp(-apart / 0.03);
    return vec3(6.0e-4 * star * smoothstep(0.08, 0.4, ray.z)) + moon * vec3(1.0, 0.96, 0.86);
}}
#endif
void main() {{
    vec3 ray = normalize(ahead.xyz + spot.x * right.w * right.xyz - spot.y * up.w * up.xyz);
    vec2 where = vec2(0.5 - atan(ray.y, ray.x) * 0.15915494, 0.5 - asin(ray.z) * 0.31830989);
    float label = ray.z < 0.0 ? {LABELS["ground"]}.0 : {LABELS["sky"]}.0;
    vec3 seen = texture(sky, where).rgb;
    if (ray.z < 0.0) seen = max(seen + (fog.rgb - all_around) * exp(ray.z / {HORIZON_FADE}), 0.0);
#ifdef WEATHER
    seen += sun_light.rgb * (night.z * towards_sun(ray) * (1.0 - exp(-fog.w * 60.0 / max(ray.z, 0.12))));
    if (night.y > 0.0 && ray.z > 0.0) seen += starlight(ray) * night.y;
#endif
    pixel = vec4(on_screen(seen), label / 255.0);
}}
"""


class Backdrop:
    """Background triangle over the whole picture at the far end of the depth; draw it last.

    sky: its texture
    """

    def __init__(self, context: moderngl.Context, sky: Sky, variant: int = 0) -> None:
        self._program = programs(context, _VERTEX, _FRAGMENT, variant & ~Variant.SHADOWS).colour
        self._all_around = tuple(float(c) for c in sky.fog_colour)
        self._array = context.vertex_array(self._program, [])
        self.sky = sky_texture(context, sky.radiance)

    def draw(self) -> None:
        self._program["all_around"] = self._all_around
        self.sky.use(SKY_UNIT)
        self._array.render(moderngl.TRIANGLES, vertices=3)

    def release(self) -> None:
        self._array.release()
        self.sky.release()
