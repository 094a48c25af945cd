"""Shading: the GLSL that all programs share, the uniform block they read, and the passes they are drawn in.

A drawable's program is written once and works in every pass. `programs` puts this file's chunks before its code:

vertex shader     reads its own attributes and ends with `gl_Position = project(at);`, where `at` is a position in
                  metres relative to the anchor of the picture (below). Normals are in world axes.
fragment shader   calls `show(albedo, normal, at, label)` once, or `glow(colour, label)` for what shines by itself.
                  albedo, colour: vec3 as one would write it for a screen, 0 to 1 (gamma 2: linear light is its
                  square); normal: vec3, unit length or nearly; at: as in the vertex shader; label: float, an id of
                  cosim.state.LABELS. In the shadow pass it is not run: leave the depth alone and do not discard.

Positions are relative to the anchor, a point of the ground near the eye on a lattice of ANCHOR_M, so that float32 holds
them to a hundredth of a millimetre anywhere in a city. `anchor_of(eye)` is it, in world metres: subtract
it in float64 before an upload.

The uniform block `Scene` (binding SCENE_BINDING, written once per pass by `SceneBlock`):

    mat4 clip_from_at      the camera's, or the sun's in the shadow pass; `project` is all that needs it
    mat4 shadow_from_at    to the shadow map's texture space
    vec4 eye               xyz from the anchor; w exposure
    vec4 sun               xyz towards the sun; w how dark its shadows are, 0 (off) to 1
    vec4 sun_light         rgb linear
    vec4 sky_light         rgb linear, ambient from above
    vec4 ground_light      rgb linear, ambient from below
    vec4 fog               rgb linear; w largest share
    vec4 fog_range         x where it begins in metres; y share per metre
    vec4 anchor            xy in world metres (float32: for patterns, not for geometry)
    vec4 right, up, ahead  axes of the picture; w of right and up: tangents of half its width and height

Textures: the shadow maps are bound to units STILL_UNIT (what stands) and MOVING_UNIT (what walks and drives); free
for drawables are units 0 to 5.

A drawable takes part in a pass by

    class Drawable(Protocol):
        def draw(self, stage: Stage) -> None: ...

drawing itself with its program of that stage: "colour"; "still", the shadows of what stands, drawn anew only
when the eye has moved on; "moving", the shadows of what moves, drawn for every picture. A drawable that casts no shadow
of a kind returns at once. Back faces are culled in the picture; front faces are counter-clockwise as in physics.mesh.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final, Literal, NamedTuple, Protocol

import moderngl
import numpy as np

from cosim.geometry import Floats
from physics.gl.lighting import Lighting
from physics.view import FAR_M, NEAR_M, Shot

Stage = Literal["colour", "still", "moving"]

SCENE_BINDING: Final = 0
STILL_UNIT: Final = 6
MOVING_UNIT: Final = 7
ANCHOR_M: Final = 64.0


class Drawable(Protocol):
    """Something that is drawn."""

    def draw(self, stage: Stage) -> None: ...


class Programs(NamedTuple):
    """A drawable's programs: for the picture, and for shadow maps."""

    colour: moderngl.Program
    shadow: moderngl.Program

    def of(self, stage: Stage) -> moderngl.Program:
        return self.colour if stage == "colour" else self.shadow


_BLOCK = """#version 430
layout(std140, binding = 0) uniform Scene {
    mat4 clip_from_at;
    mat4 shadow_from_at;
    vec4 eye;
    vec4 sun;
    vec4 sun_light;
    vec4 sky_light;
    vec4 ground_light;
    vec4 fog;
    vec4 fog_range;
    vec4 anchor;
    vec4 right;
    vec4 up;
    vec4 ahead;
};
"""

_VERTEX = """
vec3 unpacked(vec4 normal) { return normal.xyz * (255.0 / 127.0) - 1.0; }
vec4 project(vec3 at) { return clip_from_at * vec4(at, 1.0); }
"""

_FRAGMENT = """
out vec4 pixel;
layout(binding = 6) uniform sampler2DShadow still_shadow;
layout(binding = 7) uniform sampler2DShadow moving_shadow;

float sunlit(vec3 at, vec3 normal) {
#ifdef SHADOWS
    vec3 in_map = (shadow_from_at * vec4(at + 0.06 * normal, 1.0)).xyz;
    vec2 off = abs(in_map.xy - 0.5);
    float inside = clamp((0.5 - max(off.x, off.y)) * 20.0, 0.0, 1.0);
    float lit = min(texture(still_shadow, in_map), texture(moving_shadow, in_map));
    return 1.0 - sun.w * inside * (1.0 - lit);
#else
    return 1.0;
#endif
}

vec3 on_screen(vec3 light, float share_of_fog) {
    vec3 seen = mix(light, fog.rgb, share_of_fog) * eye.w;
    return sqrt(min(seen, 1.0));
}

void glow(vec3 colour, float label) {
    float share = clamp((1.0 / gl_FragCoord.w - fog_range.x) * fog_range.y, 0.0, fog.w);
    pixel = vec4(on_screen(colour * colour, share), label / 255.0);
}

void show(vec3 albedo, vec3 normal, vec3 at, float label) {
    float facing = max(dot(normal, sun.xyz), 0.0);
    vec3 light = mix(ground_light.rgb, sky_light.rgb, 0.5 + 0.5 * normal.z);
    light += sun_light.rgb * (facing * sunlit(at, normal));
    float share = clamp((1.0 / gl_FragCoord.w - fog_range.x) * fog_range.y, 0.0, fog.w);
    pixel = vec4(on_screen(albedo * albedo * light, share), label / 255.0);
}
"""

_NOTHING = "#version 430\nvoid main() {}\n"


def programs(context: moderngl.Context, vertex: str, fragment: str, shadows: bool) -> Programs:
    """A drawable's programs: for the picture, and for shadow maps. vertex, fragment: GLSL without a version line.

    shadows: whether `show` looks into the shadow maps.
    """
    head = _BLOCK + ("#define SHADOWS\n" if shadows else "")
    return Programs(
        context.program(vertex_shader=_BLOCK + _VERTEX + vertex, fragment_shader=head + _FRAGMENT + fragment),
        context.program(vertex_shader=_BLOCK + _VERTEX + vertex, fragment_shader=_NOTHING),
    )


def put(program: moderngl.Program, name: str, value: float | Sequence[float]) -> None:
    """Set a uniform; one that the compiler dropped is passed over."""
    if name in program:
        uniform = program[name]
        assert isinstance(uniform, moderngl.Uniform)
        uniform.value = value


def anchor_of(eye_m: Floats) -> Floats:
    """(2,) the point of the anchors' lattice nearest to an eye."""
    return np.round(np.asarray(eye_m[:2]) / ANCHOR_M) * ANCHOR_M


def camera_matrix(shot: Shot, anchor: Floats) -> Floats:
    """(4, 4) from metres relative to the anchor to clip space, the first row of the picture below (read top first)."""
    right, up, ahead = shot.axes
    tall = np.tan(0.5 * np.radians(shot.fov_deg))
    wide = tall * shot.size[0] / shot.size[1]
    far, near = FAR_M, NEAR_M
    rows = np.stack([right / wide, -up / tall, ahead * (far + near) / (far - near), ahead])
    eye = shot.eye_m - np.array([*anchor, 0.0])
    shift = -rows @ eye
    shift[2] -= 2.0 * far * near / (far - near)
    return np.column_stack([rows, shift])


class SceneBlock:
    """The uniform block of a pass."""

    def __init__(self, context: moderngl.Context) -> None:
        self._buffer = context.buffer(reserve=4 * 4 * (4 + 4 + 11))

    def write(self, clip_from_at: Floats, shadow_from_at: Floats, shot: Shot, anchor: Floats, light: Lighting) -> None:
        """Set it for what is drawn next; matrices (4, 4)."""
        right, up, ahead = shot.axes
        tall = np.tan(0.5 * np.radians(shot.fov_deg))
        wide = tall * shot.size[0] / shot.size[1]
        rows = [
            (*(shot.eye_m[:2] - anchor), shot.eye_m[2], light.exposure),
            (*light.to_sun, light.shadows),
            (*light.sun, 0.0),
            (*light.sky, 0.0),
            (*light.ground, 0.0),
            (*light.fog, light.fog_most),
            (light.fog_from_m, light.fog_per_m, 0.0, 0.0),
            (*anchor, 0.0, 0.0),
            (*right, wide),
            (*up, tall),
            (*ahead, 0.0),
        ]
        matrices = np.concatenate([clip_from_at.T, shadow_from_at.T])
        self._buffer.write(np.concatenate([matrices, np.array(rows)]).astype(np.float32).tobytes())
        self._buffer.bind_to_uniform_block(SCENE_BINDING)

    def release(self) -> None:
        self._buffer.release()
