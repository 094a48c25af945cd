"""Buildings of tiles as one static buffer: brick or plaster walls with bays of windows and fronts.

The geometry is that of physics.street.buildings.
Wall, windows and fronts of a building depend on its name.
Each bay of the upper storeys has its own variant.
A ground floor has one front along its length, with doors at regular distances.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import moderngl
import numpy as np
from numpy.typing import NDArray

from cosim.core.geometry import Floats
from cosim.core.state import LABELS
from physics.cameras.gl.corners import CornerRows, joined_corners
from physics.cameras.gl.shading import FACADES_UNIT, FINISH_UNIT
from physics.cameras.gl.surfaces import Surfaces, SurfaceShaders, TileRows
from physics.ground.mesh import Mesh
from physics.ground.tiles import CURB_M
from physics.street.building_style import WINDOW_WALL_MIN_M, building_appearance
from physics.street.buildings import Building, facade_meshes
from physics.textures.facade_canvas import BAY_M, STOREY_M
from physics.textures.facades import BAY_VARIANTS, WallStyle

CORNER: Final = np.dtype(
    [
        ("at", "f4", 3),
        ("normal", "u1", 4),
        ("colour", "u1", 4),
        ("spot", "f4", 4),
        ("kind", "u1", 4),
        ("fronts", "u1", 4),
    ]
)
"""Vertex of a building.

normal: fourth channel is the layer of the wall
colour: fourth channel is 255 where it tints
spot: along and up, in metres and in bays and storeys
kind: first layer of the upper storeys' windows, storeys, flag for a street side, random number
fronts: layers of the front and of its bays with doors, door spacing, random number

The door spacing is 16 times the bays from door to door, plus the first bay with a door.
"""
LAYOUT: Final = (
    "3f 4f1 4f1 4f 4f1 4f1",
    "in_at",
    "in_normal",
    "in_colour",
    "in_spot",
    "in_kind",
    "in_fronts",
)
LIT_SHARE: Final = 0.35
"""Share of the windows that are lit in the dark where the hour is not of the night."""
_OPEN: Final = 1.7
"""Ground floors, from door to door, that are lit, for each window that is."""
_LAMPLIGHT: Final = "0.96e-3, 0.72e-3, 0.42e-3"
"""Radiance of a lit window, in the units of physics.cameras.sky, about 36 candela per square
metre.
"""

_COOL_LIGHT: Final = "0.66e-3, 0.72e-3, 0.78e-3"
"""Radiance of a window that is lit by a fluorescent or LED lamp."""

_VERTEX: Final = """
in vec3 in_at; in vec4 in_normal; in vec4 in_colour; in vec4 in_spot; in vec4 in_kind; in vec4 in_fronts;
in vec2 middle;
out vec3 at; flat out vec3 normal; out vec3 in_map; out vec2 spot; out vec2 cells;
flat out vec4 tint; flat out vec4 kind; flat out vec4 fronts; flat out vec3 doors;
void main() {
    int layer = int(in_normal.w * 255.0 + 0.5);
    at = in_at + vec3(middle, 0.0);
    normal = unpacked(in_normal);
    in_map = on_map(at, normal);
    tint = vec4(in_colour.a > 0.5 ? tint_of(in_colour.rgb, layer) : vec3(1.0), layer);
    spot = in_spot.xy / layers[layer].w;
    cells = in_spot.zw;
    kind = in_kind * 255.0;
    fronts = in_fronts * 255.0;
    float every = floor((fronts.z + 0.5) / 16.0);
    doors = vec3(every, 1.0 / every, fronts.z - 16.0 * every);
    gl_Position = project(at);
}
"""

_FRAGMENT: Final = f"""
layout(binding = {FACADES_UNIT}) uniform sampler2DArray facades;
layout(binding = {FINISH_UNIT}) uniform sampler2DArray finish;
in vec3 at; flat in vec3 normal; in vec3 in_map; in vec2 spot; in vec2 cells;
flat in vec4 tint; flat in vec4 kind; flat in vec4 fronts; flat in vec3 doors;
float chance(vec2 cell, float of) {{
    vec2 p = fract((cell + of) * vec2(0.1031, 0.1030));
    p += dot(p, p.yx + 33.33);
    return fract((p.x + p.y) * p.x);
}}
void main() {{
    vec4 wall = texture(surfaces, vec3(spot, tint.a));
    vec3 albedo = decoded(wall.rgb) * mix(vec3(1.0), tint.rgb, wall.a);
    vec2 cell = floor(cells);
    float drawn = chance(cell, kind.w + 7.0 * fronts.w);
    bool ground_floor = cell.y < 0.5 && kind.z > 0.5;
    float from_door = cell.x - doors.x * floor((cell.x + 0.5) * doors.y) - doors.z;
    float front = abs(from_door) < 0.5 ? fronts.y : fronts.x;
    float layer = ground_floor ? front : kind.x + floor(fract(drawn * 17.0) * {BAY_VARIANTS}.0);
    float up = ground_floor ? clamp(cells.y, 0.006, 0.994) : cells.y;  // its plinth does not show over its top
    vec4 bay = texture(facades, vec3(cells.x, -up, layer), -0.4);
    bool none = cell.y < 0.0 || cell.y >= kind.y;
    albedo = none ? albedo : decoded(bay.rgb) + bay.a * albedo;
    vec3 own = vec3(0.0);
#ifdef NIGHT
    float shop = chance(vec2(floor((cell.x + 0.5) / max(doors.x, 1.0)), 3.0), kind.w + fronts.w);
#ifdef WEATHER
    float share = surface.w;
#else
    float share = {LIT_SHARE};
#endif
    float lit = (ground_floor ? shop < {_OPEN} * share : fract(drawn * 29.0) < share) ? side_light.w : 0.0;
    vec3 room = vec3(0.25) + 2.5 * decoded(bay.rgb);
    vec3 lamp = mix(vec3({_LAMPLIGHT}), vec3({_COOL_LIGHT}), step(0.75, fract((ground_floor ? shop : drawn) * 53.0)));
    lamp *= ground_floor ? 0.7 + 0.6 * fract(shop * 31.0) : 0.25 + fract(drawn * 71.0);
    own = none ? own : lamp * room * (lit * texture(finish, vec3(cells.x, -cells.y, layer)).g);
#endif
    show_linear(albedo, own, normal, at, {LABELS["building"]}.0, sunlit_on(in_map));
}}
"""


def wall_shaders(
    context: moderngl.Context, surfaces: Surfaces, shadows: int, night: bool
) -> SurfaceShaders:
    """Create the program of all buildings. night: some of their windows are lit."""
    return SurfaceShaders(
        context, surfaces, _VERTEX, ("#define NIGHT\n" if night else "") + _FRAGMENT, shadows
    )


def wall_rows(
    surfaces: Surfaces, buildings: Sequence[Building], styles: Sequence[WallStyle], middle: Floats
) -> TileRows | None:
    """Return the buildings of one tile, each of a style. middle: (2,) of the tile, world metres."""
    parts = [
        part
        for b, style in zip(buildings, styles, strict=True)
        for part in _parts(b, style, surfaces, middle)
    ]
    return joined_corners(parts) if parts else None


def _parts(
    building: Building, style: WallStyle, surfaces: Surfaces, middle: Floats
) -> list[tuple[Mesh, CornerRows]]:
    """Return a building's walls and roof, with their rows."""
    face = building_appearance(building, style)
    layers, bays = surfaces.surfaces, surfaces.facades
    wall, roof = layers.index(face.wall), layers.index(face.roof)
    upper = bays.index(f"{face.upper}-0")
    fronts = [bays.index(f"{name}-{face.number}") for name in (face.front.between, face.front.door)]
    doors = 16 * face.front.every + face.first_door
    colour, chance = face.tint, face.chance
    street = np.array([np.sin(building.heading_rad), -np.cos(building.heading_rad), 0.0])
    found = []
    for facade, mesh in facade_meshes((building,)).items():
        if facade < 0 or not len(mesh):
            continue  # windows of the bullet camera; here they are textures
        rows = np.zeros(len(mesh.vertices), dtype=CORNER)
        rows["at"] = mesh.vertices - np.array([*middle, 0.0])
        rows["normal"][:, :3] = np.rint(127.0 * mesh.normals) + 127.0
        flat = mesh.normals[:, 2] > 0.5
        rows["normal"][:, 3] = np.where(flat, roof, wall)
        if colour is not None:
            rows["colour"] = *np.rint(255.0 * np.array(colour)), 255.0
            rows["colour"][flat] = 0
        rows["spot"], storeys = _spots(mesh, flat, building.floor_m + CURB_M)
        # A mapped house may be on a corner or in a yard, so all its walls have doors.
        fronted = (mesh.normals @ street > 0.9) | (building.outline is not None)
        rows["kind"] = np.stack(
            [np.full(len(rows), upper), storeys, fronted, np.full(len(rows), chance[0])], 1
        )
        rows["fronts"] = *fronts, doors, chance[1]
        found.append((mesh, rows))
    return found


def _spots(mesh: Mesh, flat: NDArray[np.bool_], floor_m: float) -> tuple[Floats, NDArray[np.int64]]:
    """Return facade coordinates (V, 4), and storeys with windows (V,), of vertices.

    The coordinates are along and up each wall, in metres and in bays and storeys.
    Storeys below the floor have no windows.
    """
    spots = np.zeros((len(flat), 4))
    storeys = np.zeros(len(flat), dtype=np.int64)
    spots[flat, :2] = mesh.vertices[flat, :2]
    spots[flat, 3] = -1.0
    walls = np.flatnonzero(~flat).reshape(
        -1, 4
    )  # upright faces are quads: four consecutive corners
    for quad in walls:
        normal = mesh.normals[quad[0]]
        along = mesh.vertices[quad] @ np.array([-normal[1], normal[0], 0.0])
        along -= along.min()
        up = mesh.vertices[quad, 2] - floor_m
        width = along.max()
        count = max(round(width / BAY_M), 1)
        spots[quad] = np.stack([along, up, along / width * count, up / STOREY_M], axis=1)
        storeys[quad] = (
            max(int((up.max() + 0.3) / STOREY_M), 1)
            if width >= WINDOW_WALL_MIN_M and up.max() > 0.0
            else 0
        )
    return spots, storeys
