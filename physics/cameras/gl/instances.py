"""Instanced drawing of many rigid objects in one call, for any number of forms.

A form is a mesh with the colours of its parts.
An instance is a form with a position, rotation and paint.
All forms are in one buffer, and the counts of a draw in another (multi-draw indirect).

The triangles of a form are grouped by material, and each material has a program:

solid      opaque surfaces
cut-out    leaves: texels of low alpha are discarded, also from shadow maps
pane       clear glass, blended over the finished picture; it casts no shadow
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Mapping, Sequence
from itertools import pairwise
from typing import Final, Literal

import moderngl
import numpy as np
from numpy.typing import ArrayLike, NDArray

from physics.cameras.gl.corners import LAYOUT, CornerRows, corners, joined_corners
from physics.cameras.gl.pool import NO_DRAWS, Pool
from physics.cameras.gl.shading import Programs, programs
from physics.cameras.gl.surfaces import KNOWN, LOOKED_UP, Surfaces
from physics.ground.mesh import Part
from physics.textures.walls import CUT_OUT, PANE

INSTANCE: Final = np.dtype([("at", "f4", 3), ("turn", "f4", 4), ("paint", "u1", 4)])
"""at: metres from the anchor; turn: quaternion x, y, z, w; paint: colour, with the label as fourth
channel.
"""

POOLED: Final = np.dtype([*INSTANCE.descr, ("scene_id", "i4")])
"""Row of INSTANCE in a pool, with the id of its scene."""

_OWN = 255
_PAINT = 0
_GLOW = 128
"""Fourth channel of a corner's colour: own colour, the instance's, or the instance's and emissive.

If the colour is the instance's, rgb is the share of light that reaches the corner.
"""
Material = Literal["solid", "cut-out", "pane"]
MATERIALS: Final[tuple[Material, ...]] = ("solid", "cut-out", "pane")
"""Groups of triangles, each with a program."""
_BARE = 255
_LAMP = 254
"""Fourth channel of a corner's normal besides surface layers: no surface, or emissive at night."""
_LAMPLIGHT: Final = "6.0e-3, 4.8e-3, 3.0e-3"
"""Radiance of a street lamp's glass for a camera, in the units of physics.cameras.sky."""

_VERTEX: Final = f"""
in vec3 in_at; in vec4 in_normal; in vec4 in_colour;
in vec3 thing_at; in vec4 thing_turn; in vec4 thing_paint;
out vec3 at; out vec3 normal; out vec3 in_map; out vec3 albedo; out vec3 spot; out vec3 side;
flat out float label; flat out float shines; flat out float cover;
vec3 turned(vec3 v) {{ return v + 2.0 * cross(thing_turn.xyz, cross(thing_turn.xyz, v) + thing_turn.w * v); }}
void main() {{
    at = thing_at + turned(in_at);
    side = unpacked(in_normal);
    normal = turned(side);
    in_map = on_map(at, normal);
    bool own = in_colour.a > 0.75;
    vec3 colour = own ? in_colour.rgb : thing_paint.rgb;
    int layer = int(in_normal.w * 255.0 + 0.5);
    shines = (in_colour.a > 0.25 && !own) ? 1.0 : 0.0;
    cover = layer < {_LAMP} ? float(layer) : -1.0;
    albedo = shines > 0.5 ? colour : layer < {_LAMP} ? tint_of(colour, layer) : decoded(colour);
    albedo *= own ? 1.0 : in_colour.r;
    shines = layer == {_LAMP} ? -1.0 : shines;
    spot = layer < {_LAMP} ? in_at / layers[layer].w : vec3(0.0);
    label = thing_paint.a * 255.0;
    gl_Position = project(at);
}}
"""

_FRAGMENT: Final = f"""
in vec3 at; in vec3 normal; in vec3 in_map; in vec3 albedo; in vec3 spot; in vec3 side;
flat in float label; flat in float shines; flat in float cover;
void main() {{
    if (shines > 0.5) {{ glow(albedo, label); return; }}
    vec3 colour = albedo, own = vec3(0.0), n = normalize(normal);
    if (cover >= 0.0) {{
        vec3 s = abs(side);
        vec2 where = s.z > max(s.x, s.y) ? spot.xy : s.x > s.y ? spot.yz : spot.xz;
        vec4 seen = texture(surfaces, vec3(where, cover));
        colour *= decoded(seen.rgb);
    }} else if (shines < -0.5) {{
        own = vec3({_LAMPLIGHT}) * colour * (1.6 * side_light.w);
    }}
    show_linear(colour, own, n, at, label, sunlit_on(in_map));
}}
"""

_CUT_VERTEX: Final = """
in vec3 in_at; in vec4 in_normal; in vec4 in_colour;
in vec3 thing_at; in vec4 thing_turn; in vec4 thing_paint;
out vec3 at; out vec3 normal; out vec3 in_map; out vec3 spot; flat out vec4 albedo_label; out float shade;
vec3 turned(vec3 v) { return v + 2.0 * cross(thing_turn.xyz, cross(thing_turn.xyz, v) + thing_turn.w * v); }
void main() {
    at = thing_at + turned(in_at);
    normal = turned(unpacked(in_normal));
    in_map = on_map(at, normal);
    int layer = int(in_normal.w * 255.0 + 0.5);
    shade = in_colour.r;
    spot = vec3(in_colour.gb, layer);
    vec3 tint = tint_of(thing_paint.rgb, layer);
    tint = mix(vec3(dot(tint, vec3(0.35, 0.55, 0.10))), tint, 0.72);
    albedo_label = vec4(tint, thing_paint.a * 255.0);
    gl_Position = project(at);
}
"""

_CUT: Final = """
in vec3 spot;
vec4 leaf() {
    vec4 seen = texture(surfaces, spot, -1.25);
    if (seen.a < 0.45) discard;
    return seen;
}
"""

_CUT_FRAGMENT: Final = f"""{_CUT}
in vec3 at; in vec3 normal; in vec3 in_map; flat in vec4 albedo_label; in float shade;
void main() {{
    vec3 colour = albedo_label.rgb * decoded(leaf().rgb) * shade;
    // Leaves let light through, so the side away from the sun is lit, too.
    show_linear(colour, vec3(0.0), normalize(normal + 0.6 * sun.xyz), at, albedo_label.a,
        sunlit_on(in_map));
}}
"""

_CUT_SHADOW: Final = f"{LOOKED_UP}{_CUT}void main() {{ leaf(); }}\n"

_PANE_FRAGMENT: Final = """
in vec3 at; in vec3 normal; in vec3 albedo; flat in float label;
void main() {
    vec3 n = normalize(normal), ray = normalize(at - eye.xyz);
    float facing = abs(dot(n, ray));
    float mirror = 0.06 + 0.74 * pow(1.0 - facing, 4.0);
    vec3 up = reflect(ray, n);
    vec3 seen = mix(side_light.rgb * 0.45, fog.rgb * 1.2, smoothstep(-0.05, 0.35, up.z));
    float dirt = 0.10;
    float share = mirror + dirt - mirror * dirt;
    vec3 light = (side_light.rgb + 0.4 * sun_light.rgb * max(dot(n, sun.xyz), 0.0)) * albedo;
    pixel = vec4(on_screen(mix(light, seen, mirror / share)), share);
}
"""
_PANE_LABEL: Final = """
out vec4 pixel;
flat in float label;
void main() { pixel = vec4(0.0, 0.0, 0.0, label / 255.0); }
"""


_SHADERS: Final[Mapping[Material, tuple[str, str, str]]] = {
    "solid": (_VERTEX, _FRAGMENT, ""),
    "cut-out": (_CUT_VERTEX, _CUT_FRAGMENT, _CUT_SHADOW),
    "pane": (_VERTEX, _PANE_FRAGMENT, _PANE_LABEL),
}
"""Vertex shader and two fragment shaders of each material.

The second one draws into shadow maps; a pane's draws labels instead.
"""


class Forms:
    """Registry of all forms by key, in one vertex and one index buffer; a new key extends it.

    draws: (F, M, 3) count, first index and first corner of each form's materials
    """

    def __init__(
        self,
        context: moderngl.Context,
        surfaces: Surfaces,
        programs_of: dict[tuple[Material, int], Programs] | None = None,
    ) -> None:
        self._context = context
        self._surfaces = surfaces
        self._programs: dict[tuple[Material, int], Programs] = (
            {} if programs_of is None else programs_of
        )
        self._corners: list[NDArray[np.void]] = []
        self._indices: list[NDArray[np.uint32]] = []
        self._ids: dict[Hashable, int] = {}
        self._starts: list[list[tuple[int, int, int]]] = []
        self.rank = np.zeros(0, dtype=np.int64)
        self.draws = np.zeros((0, len(MATERIALS), 3), dtype=np.uint32)
        self.version = 0
        self._held = -1
        self._buffers: tuple[moderngl.Buffer, moderngl.Buffer] | None = None

    def apart(self) -> Forms:
        """Create an empty registry with the same programs, for forms with the lifetime of their
        owner.
        """
        return Forms(self._context, self._surfaces, self._programs)

    def programs(self, material: Material, shadows: int) -> Programs:
        """Return the programs of a material. shadows: they apply shadow maps."""
        if (material, shadows) not in self._programs:
            vertex, fragment, cut_out = _SHADERS[material]
            made = programs(self._context, KNOWN + vertex, LOOKED_UP + fragment, shadows, cut_out)
            for uniform in made.uniforms("layers"):
                if uniform is not None:
                    uniform.write(self._surfaces.known)
            self._programs[material, shadows] = made
        return self._programs[material, shadows]

    def id(self, key: Hashable, parts: Callable[[], Sequence[Part]]) -> int:
        """Return the number of a form. A new key calls `parts` to create the form."""
        if key not in self._ids:
            self._add(key, parts())
        return self._ids[key]

    def _add(self, key: Hashable, parts: Sequence[Part]) -> None:
        self._ids[key] = len(self._ids)
        starts = []
        for material in MATERIALS:
            first, base = sum(map(len, self._indices)), sum(map(len, self._corners))
            own = [(p.mesh, self._rows(p)) for p in parts if _material_of(p) == material]
            if own:
                rows, indices = joined_corners(own)
                self._corners.append(rows)
                self._indices.append(indices)
            starts.append((len(self._indices[-1]) if own else 0, first, base))
        self._starts.append(starts)
        by_name = sorted(self._ids, key=repr)  # order independent of insertion
        self.rank = np.zeros(len(by_name), dtype=np.int64)
        self.rank[[self._ids[name] for name in by_name]] = np.arange(len(by_name))
        self.draws = np.array(self._starts, dtype=np.uint32)
        self.version += 1

    def _rows(self, part: Part) -> CornerRows:
        shade = np.ones(len(part.mesh.vertices)) if part.shade is None else part.shade
        colour = np.tile(part.colour, (len(shade), 1)) if part.colour else np.ones((len(shade), 3))
        colour = colour * shade[:, None]
        if part.spots is not None:
            colour[:, 1:] = part.spots
        rows = corners(part.mesh, colour, _GLOW if part.glows else _OWN if part.colour else _PAINT)
        named = {"": _BARE, "lamp": _LAMP, PANE: _BARE}
        rows["normal"][:, 3] = (
            named[part.cover] if part.cover in named else self._surfaces.surfaces.index(part.cover)
        )
        return rows

    def buffers(self) -> tuple[moderngl.Buffer, moderngl.Buffer]:
        """Return vertex and index buffers of all forms.

        Vertex arrays bound to buffers of an older `version` are invalid.
        """
        if self._buffers is None or self._held != self.version:
            self.release()
            first = self._context.buffer(np.concatenate(self._corners).tobytes())
            self._buffers = first, self._context.buffer(np.concatenate(self._indices).tobytes())
            self._held = self.version
        return self._buffers

    def release(self) -> None:
        for buffer in self._buffers or ():
            buffer.release()
        self._buffers = None


def _material_of(part: Part) -> Material:
    return "pane" if part.cover == PANE else "cut-out" if part.cover in CUT_OUT else "solid"


class Things:
    """Set of instances in runs of one form each, replaced as a whole.

    rows: pool of POOLED rows, shared with other sets
    draws: of each material, by part
    """

    def __init__(self, forms: Forms, rows: Pool) -> None:
        self._forms = forms
        self._rows = rows
        self._start = 0
        self._room = 0
        self.draws = _no_draws(1)

    def set(
        self,
        form: NDArray[np.intp],
        rows: CornerRows,
        scene_id: int | NDArray[np.intp],
        part: NDArray[np.intp] | None = None,
        parts: int = 1,
    ) -> None:
        """Replace all instances.

        form: (N,) numbers of forms
        rows: (N,) rows of INSTANCE
        scene_id: of their scene, or (N,)
        part: (N,) index of the part, below `parts`
        """
        self.clear(parts)
        if not len(form):
            return
        rank = self._forms.rank
        kinds = len(self._forms.rank)
        order, key, commands = runs_of(rank[form] if part is None else rank[form] + kinds * part)
        draws = self._forms.draws[form[order[commands[:, 4]]]]
        if len(form) > self._room:
            self.release()
            self._room = 2 * len(form)
            self._start = self._rows.take(self._room)
        commands[:, 4] += self._start
        limits = kinds * np.arange(parts + 1)
        for k, material in enumerate(MATERIALS):
            drawn = draws[:, k, 0] > 0
            if not drawn.any():
                continue
            own = commands[drawn]
            own[:, 0], own[:, 2:4] = draws[drawn, k, 0], draws[drawn, k, 1:]
            ends = key[drawn].searchsorted(limits).tolist() if parts > 1 else [0, len(own)]
            self.draws[material] = [own[i:j] for i, j in pairwise(ends)]
        pooled = np.empty((len(form), POOLED.itemsize), dtype=np.uint8)
        pooled[:, : INSTANCE.itemsize] = rows[order].view(np.uint8).reshape(len(form), -1)
        ids = pooled.view(POOLED)["scene_id"][:, 0]
        ids[:] = scene_id if isinstance(scene_id, int) else scene_id[order]
        self._rows.write(self._start, pooled)

    def clear(self, parts: int = 1) -> None:
        """Remove all instances."""
        self.draws = _no_draws(parts)

    def release(self) -> None:
        self._rows.give(self._start, self._room)
        self._room = 0


def _no_draws(parts: int) -> dict[Material, list[NDArray[np.uint32]]]:
    return {material: [NO_DRAWS] * parts for material in MATERIALS}


class ThingArrays:
    """Vertex arrays that draw instances of a registry's forms from a pool of POOLED rows."""

    def __init__(self, context: moderngl.Context, forms: Forms, rows: Pool) -> None:
        self._context = context
        self._forms = forms
        self._rows = rows
        self._bound = (-1, -1)
        self._arrays: dict[tuple[Material, int], list[moderngl.VertexArray]] = {}

    def of(self, material: Material, second: bool, variant: int) -> moderngl.VertexArray:
        """Return the array of a material with its first or second program."""
        if self._bound != (self._forms.version, self._rows.version):
            self.release()
            self._bound = self._forms.version, self._rows.version
        if (material, variant) not in self._arrays:
            at_corners, triangles = self._forms.buffers()
            names = ("thing_at", "thing_turn", "thing_paint", "scene_id")
            content = [(at_corners, *LAYOUT), (self._rows.buffer, "3f 4f 4f1 1i4/i", *names)]
            self._arrays[material, variant] = [
                self._context.vertex_array(program, content, triangles, skip_errors=True)
                for program in self._forms.programs(material, variant)
            ]
        return self._arrays[material, variant][second]

    def release(self) -> None:
        for array in (array for both in self._arrays.values() for array in both):
            array.release()
        self._arrays = {}


def runs_of(key: NDArray[np.intp]) -> tuple[NDArray[np.intp], NDArray[np.intp], NDArray[np.uint32]]:
    """Group equal keys into runs.

    Returns the stable sorting order of (N,) keys, the distinct keys (F,), and indirect draws (F,
    5).
    Each row of a draw holds the run's count and its offset in that order.
    """
    order = key.argsort(kind="stable")
    key = key[order]
    begins = np.empty(len(key), dtype=bool)
    begins[:1], begins[1:] = True, key[1:] != key[:-1]
    first = begins.nonzero()[0]
    commands = np.zeros((len(first), 5), dtype=np.uint32)
    commands[:, 4] = first
    commands[:-1, 1], commands[-1:, 1] = first[1:] - first[:-1], len(key) - first[-1:]
    return order, key[first], commands


def instances(at: ArrayLike, heading: ArrayLike, paint: ArrayLike, label: int) -> CornerRows:
    """Return rows of INSTANCE.

    at: (N, 3) from the anchor, metres
    heading: rad
    paint: (N, 3) or (3,)
    """
    return turned_instances(at, 0.0, 0.0, heading, paint, label)


def turned_instances(
    at: ArrayLike,
    roll: ArrayLike,
    pitch: ArrayLike,
    heading: ArrayLike,
    paint: ArrayLike,
    label: int | NDArray[np.intp],
) -> CornerRows:
    """Return rows of INSTANCE, rotated about x, then y, then z.

    at: (N, 3) from the anchor, metres
    paint: (N, 3) or (3,)
    """
    at = np.asarray(at, dtype=float).reshape(-1, 3)
    half = [0.5 * np.asarray(angle, dtype=float) for angle in (roll, pitch, heading)]
    (cx, cy, cz) = map(np.cos, half)
    (sx, sy, sz) = map(np.sin, half)
    rows = np.zeros(len(at), dtype=INSTANCE)
    rows["at"] = at
    turn = rows["turn"]
    turn[:, 0], turn[:, 1] = sx * cy * cz - cx * sy * sz, cx * sy * cz + sx * cy * sz
    turn[:, 2], turn[:, 3] = cx * cy * sz - sx * sy * cz, cx * cy * cz + sx * sy * sz
    rows["paint"][:, :3] = np.rint(255.0 * np.asarray(paint, dtype=float))
    rows["paint"][:, 3] = label
    return rows
