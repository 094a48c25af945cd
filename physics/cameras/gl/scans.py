"""Scanned triangles of tiles as one static buffer, in the colours of the scan.

The colours contain the light of the scan, so only shadows of people and objects are added. The mesh
itself casts no shadow.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import moderngl

from cosim.core.geometry import Floats
from cosim.core.state import LABELS
from physics.cameras.gl.corners import corners, joined_corners
from physics.cameras.gl.surfaces import Surfaces, SurfaceShaders, TileRows
from physics.street.surface import ScannedPatch

SHADE: Final = 0.7
"""Share of a scanned sRGB colour that is left in a shadow."""

_VERTEX: Final = """
in vec3 in_at; in vec4 in_normal; in vec4 in_colour;
in vec2 middle;
out vec3 at; out vec3 normal; out vec3 colour; flat out float label;
void main() {
    at = in_at + vec3(middle, 0.0);
    normal = unpacked(in_normal);
    colour = in_colour.rgb;
    label = in_colour.a * 255.0;
    gl_Position = project(at);
}
"""

_FRAGMENT: Final = f"""
in vec3 at; in vec3 normal; in vec3 colour; flat in float label;
void main() {{
    glow(colour * mix({SHADE}, 1.0, sunlit(at, normal)), label);
}}
"""


_NORMALS: Final = """
in vec3 at; in vec3 normal; in vec3 colour; flat in float label;
void main() { pixel = vec4(0.5 + 0.5 * normalize(normal), label / 255.0); }
"""


def scan_shaders(
    context: moderngl.Context, surfaces: Surfaces, shadows: int, normals: bool = False
) -> SurfaceShaders:
    """Create the program of all scanned triangles. normals: draw these in place of colours."""
    fragment = _NORMALS if normals else _FRAGMENT
    return SurfaceShaders(context, surfaces, _VERTEX, fragment, shadows)


def scan_rows(patches: Sequence[ScannedPatch], middle: Floats) -> TileRows | None:
    """Return the scanned triangles of one tile. middle: (2,) of the tile, world metres."""
    parts = []
    for mesh, colours, label in patches:
        here = mesh.moved((*-middle, 0.0))
        parts.append((here, corners(here, colours, LABELS[label])))
    return joined_corners(parts) if parts else None
