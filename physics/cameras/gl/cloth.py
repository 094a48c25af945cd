"""Surfaces of people, as GLSL: maps of cloth, skin and hair, and the light around them.

Inputs from the vertex shaders of `skins`:

at_unshaded    `at` of shading; share of the sky's light that the body itself leaves, baked
normal_ahead   as for `show_linear` of shading; x of the point below
own            y and z of the point on the body of 1.75 m as modelled, metres; share of sunlight;
               level of the map. Maps move with the body.
albedo_coat    sRGB of the surface; row of COATS
trim_map       second colour of the clothes; row of the map
"""

from __future__ import annotations

from typing import Final

import moderngl

from cosim.core.state import LABELS
from physics.cameras.gl.mipmaps import mipmapped
from physics.cameras.gl.shading import MAPS_UNIT
from physics.people.body import COATS
from physics.people.cloth_maps import ROWS, SIDE_M, TALL_M, cloth_maps

TEXELS_PER_M: Final = ROWS / TALL_M
_SHINE: Final = {"skin": 0.25, "lips": 0.3, "hair": 0.9, "shoes": 0.5, "metal": 1.0, "fur": 0.3}
_SHINES: Final = ", ".join(str(_SHINE.get(coat, 0.08)) for coat in COATS)
_SOFT: Final = ", ".join("1.0" if coat in ("skin", "lips") else "0.0" for coat in COATS)

FRAGMENT: Final = f"""
in vec4 at_unshaded; in vec4 normal_ahead; in vec4 own; flat in vec4 albedo_coat; flat in vec4 trim_map;
layout(binding = {MAPS_UNIT}) uniform sampler2DArray maps;
const float shines[{len(COATS)}] = float[]({_SHINES});
const float softs[{len(COATS)}] = float[]({_SOFT});
void main() {{
    vec3 at = at_unshaded.xyz, n = normalize(normal_ahead.xyz), towards = normalize(eye.xyz - at);
    int coat = int(albedo_coat.w);
    float shine = shines[coat], soft = softs[coat], unshaded = at_unshaded.w;
    float column = clamp(own.x * {0.25 / SIDE_M} + 0.25, 0.004, 0.496) + (normal_ahead.w < -0.012 ? 0.5 : 0.0);
    vec4 map = textureLod(maps, vec3(column, own.y * {1.0 / TALL_M}, trim_map.w), own.w);
    float bright = map.y * {255.0 / 128.0};
    // what dark cloth reflects at its folds is not of its colour
    vec3 colour = max(decoded(mix(albedo_coat.rgb, trim_map.rgb, map.x)) * bright + 0.05 * (bright - 0.85), 0.006);
    vec2 lean = map.zw * {255.0 / 127.0} - {128.0 / 127.0};
    n = normalize(n + vec3(n.y * lean.y, -n.x * lean.y, lean.x));
    // light from the ground nearby; light that enters skin leaves it nearby, mostly red
    vec3 above = side_light.rgb + tilt_light.rgb + flat_light.rgb;
    float facing = dot(n, sun.xyz), edge = 1.0 - max(dot(n, towards), 0.0);
    float low = (0.145 - 0.085 * n.z) * (1.0 - 0.2 * min(own.y, 1.7));
    vec3 glow_ = colour * (above + sun_light.rgb * (0.8 * max(sun.z, 0.0))) * (low * unshaded);
    float spread = max(facing * 0.714 + 0.286, 0.0) - max(facing, 0.0);
    float glint = max(dot(normalize(towards + sun.xyz), n), 0.0);
    glint *= glint; glint *= glint; glint *= glint; glint *= glint;
    glow_ += sun_light.rgb * own.z
        * (colour * vec3(0.75, 0.30, 0.20) * (spread * soft) + 0.12 * shine * glint);
    edge *= edge;
    glow_ += above * (0.30 * shine * edge * edge * unshaded);
    show_linear(colour * unshaded, glow_, n, at, {LABELS["person"]}.0, own.z);
}}
"""
"""Fragment shader of people."""


def map_texture(context: moderngl.Context) -> moderngl.TextureArray:
    """Upload the maps, with coarser ones for people at a distance."""
    texture = mipmapped(context, cloth_maps())
    texture.filter = moderngl.LINEAR_MIPMAP_NEAREST, moderngl.LINEAR
    texture.repeat_x = texture.repeat_y = False
    return texture
