"""Ground of tiles as one static buffer, with materials mapped by world position."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import moderngl
import numpy as np

from cosim.core.geometry import Floats
from cosim.core.state import LABELS
from physics.cameras.gl.corners import corners, joined_corners
from physics.cameras.gl.surfaces import Surfaces, SurfaceShaders, TileRows
from physics.street.decals import Decals
from physics.street.surface import Patch

_TINTED: Final = 128
"""Offset of the label of a surface whose colour tints its texture."""

_VERTEX: Final = """
in vec3 in_at; in vec4 in_normal; in vec4 in_colour;
in vec2 middle; in vec2 middle_in_world;
out vec3 at; out vec3 normal; out vec3 in_map; out vec2 spot; flat out vec3 tint; flat out vec2 layer_label;
void main() {
    int layer = int(in_normal.w * 255.0 + 0.5);
    float label = in_colour.a * 255.0;
    at = in_at + vec3(middle, 0.0);
    normal = unpacked(in_normal);
    in_map = on_map(at, normal);
    tint = label > 127.5 ? tint_of(in_colour.rgb, layer) : vec3(1.0);
    float side = layers[layer].w;
    spot = fract(middle_in_world / side) + in_at.xy / side;
    layer_label = vec2(layer, label > 127.5 ? label - 128.0 : label);
    gl_Position = project(at);
}
"""

_FRAGMENT: Final = """
in vec3 at; in vec3 normal; in vec3 in_map; in vec2 spot; flat in vec3 tint; flat in vec2 layer_label;
void main() {
    vec4 seen = texture(surfaces, vec3(spot, layer_label.x), -0.5);
    vec3 albedo = decoded(seen.rgb) * mix(vec3(1.0), tint, seen.a);
    show_linear(albedo, vec3(0.0), normal, at, layer_label.y, sunlit_on(in_map));
}
"""


DECALS_M: Final = 18.0
"""Distance at which decals have faded out, metres."""

_DECAL_VERTEX: Final = """
in vec3 in_at; in vec4 in_normal; in vec4 in_colour;
in vec2 middle;
out vec3 spot; flat out float opacity;
void main() {
    spot = vec3(in_colour.rg, int(in_normal.w * 255.0 + 0.5));
    opacity = in_colour.b;
    gl_Position = project(in_at + vec3(middle, 0.0));
}
"""

_DECAL_FRAGMENT: Final = f"""
in vec3 spot; flat in float opacity;
void main() {{
    vec4 seen = texture(surfaces, spot, -0.7);
    float near = clamp(2.0 - 2.0 / (gl_FragCoord.w * {DECALS_M}), 0.0, 1.0);
    pixel = vec4(mix(vec3(0.5), seen.rgb, seen.a * opacity * near), 0.0);
}}
"""
"""Shader of decals, which multiply the colours of the lit ground by twice their own."""


def tile_shaders(context: moderngl.Context, surfaces: Surfaces, shadows: int) -> SurfaceShaders:
    """Create the program of the ground of all tiles."""
    return SurfaceShaders(context, surfaces, _VERTEX, _FRAGMENT, shadows)


def decal_shaders(context: moderngl.Context, surfaces: Surfaces, variant: int) -> SurfaceShaders:
    """Create the program of the decals of all tiles."""
    return SurfaceShaders(context, surfaces, _DECAL_VERTEX, _DECAL_FRAGMENT, variant)


def ground_rows(surfaces: Surfaces, patches: Sequence[Patch], middle: Floats) -> TileRows | None:
    """Return patches of one tile, drawn in their order. middle: (2,) of the tile, world metres."""
    parts = []
    for patch in patches:
        here = patch.mesh.moved((*-middle, 0.0))
        rows = corners(here, patch.colour, LABELS[patch.label] + (_TINTED if patch.tinted else 0))
        rows["normal"][:, 3] = surfaces.surfaces.index(patch.layer)
        parts.append((here, rows))
    return joined_corners(parts) if parts else None


def decal_rows(surfaces: Surfaces, decals: Sequence[Decals], middle: Floats) -> TileRows | None:
    """Return decals of one tile, drawn in their order. middle: (2,) of the tile, world metres."""
    parts = []
    for decal in decals:
        here = decal.mesh.moved((*-middle, 0.0))
        rows = corners(here, np.column_stack([decal.spots, decal.opacity]), 0)
        rows["normal"][:, 3] = surfaces.surfaces.index(decal.layer)
        parts.append((here, rows))
    return joined_corners(parts) if parts else None
