"""Bodies on the graphics card: near meshes and far tubes, with shaders that skin them.

The vertex shader turns a tube's rings towards the eye.
A ring of four or six corners then has the outline of a round one.
In shadow maps, rings turn towards the sun.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from typing import Final

import moderngl
import numpy as np
from numpy.typing import NDArray

from physics.cameras.gl.cloth import FRAGMENT, TEXELS_PER_M
from physics.cameras.gl.shading import Pass, Programs, programs
from physics.people.body import COATS, FarBody, SkinnedBody

_CORNER: Final = np.dtype(
    [
        ("at", "f4", 3),
        ("normal", "u1", 4),
        ("joints", "u1", 4),
        ("weights", "u1", 4),
        ("coat", "u1", 4),
    ]
)
"""normal: as in corners.CORNER, fourth: offset by fat; weights: of 255.

coat: row of COATS, unshaded light of 255
"""

FAR_CORNER: Final = np.dtype(
    [
        ("middle", "f4", 3),
        ("ahead", "f4", 3),
        ("side", "f4", 3),
        ("ring", "f4", 4),
        ("joints", "u1", 4),
        ("weights", "u1", 4),
        ("coat", "u1", 4),
    ]
)
"""Corner of a tube.

coat: row of COATS, offset by fat, 1 for a fixed ring plus 2 for a ribbon, unshaded light of 255
"""

_MESH_LAYOUT: Final = (
    "3f4 4f1 4u1 4f1 4u1",
    "in_at",
    "in_normal",
    "in_joints",
    "in_weights",
    "in_coat",
)
_TUBE_LAYOUT: Final = (
    "3f4 3f4 3f4 4f4 4u1 4f1 4u1",
    *("in_middle", "in_ahead", "in_side", "in_ring", "in_joints", "in_weights", "in_coat"),
)
_SKIN: Final = (
    f"const int TRIM = {COATS.index('trim')};\nconst float TEXELS_PER_M = {TEXELS_PER_M};\n"
    + """
layout(binding = 0) uniform sampler2D posed;
layout(binding = 1) uniform sampler2D dyed;
in uvec4 in_joints; in vec4 in_weights; in uvec4 in_coat;
in int person; in int dress; in float girth; in float tall;
// packed, because triangles are small: setting up outputs costs as much as pixels
out vec4 at_unshaded; out vec4 normal_ahead; out vec4 own; flat out vec4 albedo_coat; flat out vec4 trim_map;
vec4 x = vec4(0.0), y = vec4(0.0), z = vec4(0.0);
void pose(int bones) {
    for (int k = 0; k < bones; k++) {
        int column = 3 * int(in_joints[k]);
        x += in_weights[k] * texelFetch(posed, ivec2(column, person), 0);
        y += in_weights[k] * texelFetch(posed, ivec2(column + 1, person), 0);
        z += in_weights[k] * texelFetch(posed, ivec2(column + 2, person), 0);
    }
    vec4 dye = texelFetch(dyed, ivec2(int(in_coat.x), dress), 0);
    albedo_coat = vec4(dye.rgb, in_coat.x);
    trim_map = vec4(texelFetch(dyed, ivec2(TRIM, dress), 0).rgb, floor(dye.a * 255.0 + 0.5));
}
vec3 moved(vec3 v) { return vec3(dot(x.xyz, v), dot(y.xyz, v), dot(z.xyz, v)); }
vec3 placed(vec3 v) { return vec3(x.w, y.w, z.w) + moved(v); }
void finish(vec3 at, vec3 normal, vec3 modelled, float unshaded) {
    at_unshaded = vec4(at, unshaded);
    normal_ahead = vec4(normal, modelled.x * tall);
    gl_Position = project(at);
    own = vec4(modelled.yz * tall, sunlit(at, normal), log2(max(gl_Position.w * ahead.w * TEXELS_PER_M, 1.0)));
}
"""
)

_MESH: Final = """
in vec3 in_at; in vec4 in_normal;
void main() {
    pose(4);
    vec3 outward = in_normal.xyz * (255.0 / 127.0) - 1.0;
    vec3 at = placed(in_at + outward * (in_normal.w * girth));
    finish(at, moved(outward), in_at, float(in_coat.y) / 255.0);
}
"""

_TUBE: Final = """
in vec3 in_middle; in vec3 in_ahead; in vec3 in_side; in vec4 in_ring;
void main() {
    bool still = (in_coat.z & 1u) > 0u;
    pose(still ? 4 : 2);
    float share = still ? 1.0 : 1.0 / (in_weights.x + in_weights.y);
    x *= share; y *= share; z *= share;
    vec3 middle = placed(in_middle), ahead_ = moved(in_ahead), side = moved(in_side);
    float stout = float(in_coat.y) / 255.0 * girth;
    vec2 half_ = vec2(length(ahead_), length(side));
    ahead_ /= half_.x; side /= half_.y;
    half_ += stout;
    vec3 ray = TOWARDS;
    vec2 across = normalize(vec2(-dot(side, ray), dot(ahead_, ray)) + 1e-7);
    vec2 before = vec2(-across.y, across.x);
    vec2 way = in_ring.z * across + in_ring.w * before;
    if (still) way = in_ring.zw;
    float ribbon = still ? 0.0 : float(in_coat.z >> 1);
    float thick = length(vec2(before.x < 0.0 ? half_.x * in_ring.x : half_.x, half_.y) * before);
    if (way.x < 0.0) half_.x *= in_ring.x;
    // the corner is where the outline of a superellipse has the normal `way`
    float dual = in_ring.y / (in_ring.y - 1.0);
    vec2 lean = max(half_ * abs(way), 1e-9), power = pow(lean, vec2(dual));
    vec2 corner = half_ * sign(way) * (power / lean) * pow(power.x + power.y, -1.0 / in_ring.y);
    // a ribbon lies where the tube is nearest, and is shaded as if it were round
    corner += before * (thick * ribbon * RAISED);
    way = normalize(way + ribbon * before);
    vec3 modelled = in_middle + in_ahead * (corner.x / length(in_ahead)) + in_side * (corner.y / length(in_side));
    vec3 at = middle + ahead_ * corner.x + side * corner.y;
    finish(at, ahead_ * way.x + side * way.y, modelled, float(in_coat.w) / 255.0);
}
"""


class Skins:
    """Bodies in one vertex and one index buffer.

    instances: rows of person, dress, girth, tall and scene_id
    drawn: the programs, with and without shadow maps
    """

    def __init__(
        self,
        context: moderngl.Context,
        made: Callable[[int, int], SkinnedBody | FarBody],
        drawn: Callable[[int], Programs],
        layout: tuple[str, ...],
    ) -> None:
        self._context = context
        self._made = made
        self._drawn = drawn
        self._layout = layout
        self._rows: list[NDArray[np.void]] = []
        self._indices: list[NDArray[np.uint32]] = []
        self._buffers: list[moderngl.Buffer] = []
        self._arrays: dict[int, tuple[moderngl.VertexArray, moderngl.VertexArray]] = {}

    def start(self, outfit: int, level: int) -> tuple[int, int, int]:
        """Load a body, and return its count of indices, first index and first vertex."""
        made = self._made(outfit, level)
        first, base = sum(map(len, self._indices)), sum(map(len, self._rows))
        self._rows.append(_corners(made) if isinstance(made, SkinnedBody) else far_corners(made))
        self._indices.append(made.triangles.ravel().astype(np.uint32))
        self.release()
        return len(self._indices[-1]), first, base

    def draw(
        self,
        stage: Pass,
        shadows: int,
        instances: moderngl.Buffer,
        commands: moderngl.Buffer,
        count: int,
        first: int,
    ) -> None:
        """Draw `count` indirect draws, from `first` on."""
        if not count:
            return
        if shadows not in self._arrays:
            self._bind(shadows, instances)
        array = self._arrays[shadows][stage != "colour"]
        array.render_indirect(commands, moderngl.TRIANGLES, count=count, first=first)

    def release(self) -> None:
        """Free the data on the graphics card; they are rebuilt when needed."""
        for array in (array for both in self._arrays.values() for array in both):
            array.release()
        for buffer in self._buffers:
            buffer.release()
        self._buffers = []
        self._arrays = {}

    def _bind(self, shadows: int, instances: moderngl.Buffer) -> None:
        if not self._buffers:
            rows, indices = np.concatenate(self._rows), np.concatenate(self._indices)
            self._buffers = [self._context.buffer(held.tobytes()) for held in (rows, indices)]
        corner, index = self._buffers
        content = [
            (corner, *self._layout),
            (instances, "1i4 1i4 1f4 1f4 1i4/i", *("person", "dress", "girth", "tall", "scene_id")),
        ]
        colour, shadow = (
            self._context.vertex_array(program, content, index, skip_errors=True)
            for program in self._drawn(shadows)
        )
        self._arrays[shadows] = colour, shadow


def mesh_skins(context: moderngl.Context, made: Callable[[int, int], SkinnedBody]) -> Skins:
    """Create skins of meshes with four joints per corner."""

    def drawn(shadows: int) -> Programs:
        return programs(context, _SKIN + _MESH, FRAGMENT, shadows)

    return Skins(context, made, lru_cache(drawn), _MESH_LAYOUT)


def tube_skins(context: moderngl.Context, made: Callable[[int, int], FarBody]) -> Skins:
    """Create skins of tubes with two joints per turned ring and four per fixed ring."""

    def drawn(shadows: int) -> Programs:
        seen, cast = (
            programs(
                context,
                f"#define TOWARDS ({ray})\n#define RAISED {raised}\n" + _SKIN + _TUBE,
                FRAGMENT,
                shadows,
            )
            for ray, raised in (("middle - eye.xyz", 1.0), ("sun.xyz", 0.0))
        )
        return Programs(seen.colour, cast.shadow)

    return Skins(context, made, lru_cache(drawn), _TUBE_LAYOUT)


def _corners(made: SkinnedBody) -> NDArray[np.void]:
    """Return (V,) rows of CORNER."""
    rows = np.zeros(len(made.vertices), dtype=_CORNER)
    rows["at"] = made.vertices
    rows["normal"][:, :3] = np.rint(127.0 * made.normals) + 127.0
    rows["normal"][:, 3] = np.rint(255.0 * made.fat)
    rows["joints"], rows["coat"][:, 0] = made.joints, made.coat
    rows["coat"][:, 1] = np.rint(255.0 * made.unshaded)
    rows["weights"] = _bytes(made.weights)
    return rows


def far_corners(made: FarBody) -> NDArray[np.void]:
    """Return (V,) rows of FAR_CORNER."""
    rows = np.zeros(len(made.middle), dtype=FAR_CORNER)
    rows["middle"], rows["ahead"], rows["side"], rows["ring"] = (
        made.middle,
        made.ahead,
        made.side,
        made.ring,
    )
    rows["joints"], rows["weights"] = made.joints, _bytes(made.weights)
    rows["coat"][:, 0], rows["coat"][:, 1] = made.coat, np.rint(255.0 * made.fat)
    rows["coat"][:, 2] = made.still + 2 * made.ribbon
    rows["coat"][:, 3] = np.rint(255.0 * made.unshaded)
    return rows


def _bytes(weights: NDArray[np.float32]) -> NDArray[np.uint8]:
    """Return (V, 4) weights as bytes that sum to 255."""
    whole = np.rint(255.0 * weights).astype(np.int64)
    whole[:, 0] += 255 - whole.sum(axis=1)
    return np.asarray(whole.astype(np.uint8))
