"""Common GLSL of all programs, the uniform block they read, and the render passes.

A drawable's program is written once and works in every pass.
`programs` puts this file's chunks before its code:

vertex shader     Reads its own attributes and ends with `gl_Position = project(at);`,
                  or `in_picture(clip)`.
                  at: position in metres relative to the picture's anchor (below).
                  Normals are in world axes.
fragment shader   Calls `show(albedo, normal, at, label)` once, or `glow(colour, label)`
                  for emissive surfaces.
                  albedo, colour: vec3 sRGB, 0 to 1
                  normal: vec3, approximately unit length
                  at: as in the vertex shader
                  label: float, an id of cosim.core.state.LABELS
                  `show_linear` takes a linear albedo and a radiance emitted by the surface.
                  Its optional sixth argument is the share of sunlight. It saves time where the
                  vertex shader computes it (`sunlit`), or its point on the shadow maps (`on_map`,
                  for `sunlit_on` in the fragment shader).
                  sRGB textures are decoded when they are read.
                  The shadow pass skips it: do not write depth. Code that discards has a shadow
                  shader that discards, too.

Positions are relative to the anchor, a ground point near the eye on a lattice of ANCHOR_M.
In float32 they are then accurate to 0.01 mm anywhere in a city.
`anchor_of(eye)` returns the anchor in world metres: subtract it in float64 before an upload.

Uniform block `Scene` (binding SCENE_BINDING, one per pass and picture, from `SceneBlocks`):

    mat4 clip_from_at      of the camera, or of the sun in the shadow pass; read by `project`
    mat4 shadow_from_at    to the shadow map's texture space
    vec4 eye               xyz from the anchor
    vec4 sun               xyz towards the sun; w 1 where it casts shadows
    vec4 sun_light         rgb linear; w exposure
    vec4 side_light        rgb linear, ambient of an upright surface; w lamps: 0 by day to 1 at
                           night
    vec4 tilt_light        rgb linear, added times the z of the normal
    vec4 flat_light        rgb linear, added times the absolute z of the normal
    vec4 fog               rgb linear; w extinction per metre
    vec4 haze              start in metres, share per metre, maximum share
    vec4 anchor            xy in world metres (float32: for patterns, not for geometry)
    vec4 right, up, ahead  axes of the picture; w of right and up: tangents of half width and
                           height; w of ahead: width of a pixel at a distance of 1 m, metres
    vec4 backdrop          with layers: rgb linear, all around the horizon; w layer of the sky

With `Variant.LAYERS` one draw fills layers of array textures, one for each picture. The attribute
`scene_id` of an instance is that of its scene; the buffer `SceneMap` maps it to the block and the layer of
the picture, and `project` selects both. Then eye.w is the layer of the static shadow map.

Textures: the shadow maps are bound to units STILL_UNIT (static) and MOVING_UNIT (moving objects).
SKY_UNIT holds the sky; SURFACES_UNIT, FACADES_UNIT and FINISH_UNIT those of ground and walls.
MAPS_UNIT holds maps of people.
Units 0 and 1 are free for drawables; people use them for the time of a batch.

A drawable implements `draw(stage)` and draws itself with its program of that stage:

    "colour"  the picture
    "still"   shadows of static objects, redrawn only when the eye has moved on
    "moving"  shadows of moving objects, drawn for every picture

A drawable that casts no shadow of a kind returns at once. Back faces are culled in the picture.
Front faces are counter-clockwise as in physics.ground.mesh.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Final, Literal, NamedTuple

import moderngl
import numpy as np
from numpy.typing import NDArray

from cosim.core.geometry import Floats
from physics.cameras.gl.variants import Variant
from physics.cameras.gl.weather_shaders import BLOCK, FOG_GLOW, LAMPS, PATTERNS
from physics.cameras.view import FAR_PLANE_M, NEAR_PLANE_M, Shot

Pass = Literal["colour", "still", "moving"]

SCENE_BINDING: Final = 0
FINISH_UNIT: Final = 2
SURFACES_UNIT: Final = 3
FACADES_UNIT: Final = 4
SKY_UNIT: Final = 5
STILL_UNIT: Final = 6
MOVING_UNIT: Final = 7
MAPS_UNIT: Final = 8
"""Texture unit of the maps of people, bound for each draw of them."""
PICTURE_UNIT: Final = MAPS_UNIT
"""Texture unit of the pictures to be read back, after all draws."""
ANCHOR_M: Final = 64.0
PICTURES_MAX: Final = 128
"""Maximum number of pictures of a batch: their blocks fill the uniform block of a layered draw."""
SCENE_MAPS_BINDING: Final = 1
_BLOCK_ROWS: Final = 32
"""Rows (vec4) of a block; graphics cards require aligned starts of blocks."""


class Programs(NamedTuple):
    """Programs of a drawable: one for the picture, one for shadow maps."""

    colour: moderngl.Program
    shadow: moderngl.Program

    def uniforms(self, name: str) -> list[moderngl.Uniform | None]:
        """Return a uniform of both programs; None where the compiler removed it."""
        found = [program.get(name, None) for program in self]
        return [uniform if isinstance(uniform, moderngl.Uniform) else None for uniform in found]


_MEMBERS: Final = (
    ("mat4", "clip_from_at"),
    ("mat4", "shadow_from_at"),
    *(("vec4", name) for name in ("eye", "sun", "sun_light", "side_light", "tilt_light")),
    *(("vec4", name) for name in ("flat_light", "fog", "haze", "anchor", "right", "up", "ahead")),
    ("vec4", "backdrop"),
)
_DECLARED: Final = "".join(f"    {kind} {name};\n" for kind, name in _MEMBERS)

_VERSION: Final = "#version 430\n"
_LAYER_EXTENSION: Final = "#extension GL_ARB_shader_viewport_layer_array : require\n"
"""For vertex shaders, which select the layer; other shaders have no such extension."""
_BLOCK: Final = f"""
layout(std140, binding = 0) uniform Scene {{
{_DECLARED}}};
"""
_BLOCKS: Final = f"""
layout(std140, binding = 0) uniform Scenes {{ vec4 rows[{_BLOCK_ROWS * PICTURES_MAX}]; }};
"""


def _of_picture() -> str:
    """Return GLSL of the values of one block under the names that they have without layers."""
    lines, row = [], 0
    for kind, name in _MEMBERS:
        size = 4 if kind == "mat4" else 1
        rows = ", ".join(f"rows[{_BLOCK_ROWS} * PICTURE + {row + i}]" for i in range(size))
        lines.append(f"{kind} {name} = {kind}({rows});\n")
        row += size
    return "".join(lines)


_OF_PICTURE: Final = _of_picture()

_VERTEX = """
invariant gl_Position;  // the same depth in all programs
vec3 unpacked(vec4 normal) { return normal.xyz * (255.0 / 127.0) - 1.0; }
vec4 in_picture(vec4 clip) { return clip; }
vec4 project(vec3 at) { return clip_from_at * vec4(at, 1.0); }
"""

_SCENE_MAP: Final = f"""
layout(std430, binding = {SCENE_MAPS_BINDING}) readonly buffer SceneMap {{ ivec2 scene_map[]; }};
in int scene_id;
flat out int picture;
ivec2 block_layer = scene_map[scene_id];
#define PICTURE block_layer.x
{_OF_PICTURE}"""
_LAYERS_VERTEX: Final = """
invariant gl_Position;
vec3 unpacked(vec4 normal) { return normal.xyz * (255.0 / 127.0) - 1.0; }
vec4 in_picture(vec4 clip) {
    gl_Layer = block_layer.y;
    picture = block_layer.x;
    return clip;
}
vec4 project(vec3 at) { return in_picture(clip_from_at * vec4(at, 1.0)); }
"""
_LAYERS_FRAGMENT: Final = f"flat in int picture;\n#define PICTURE picture\n{_OF_PICTURE}"

_DECODED = """
vec3 decoded(vec3 c) { return c * (c * (c * 0.305306011 + 0.682171111) + 0.012522878); }
"""
"""Conversion of sRGB to linear by a cubic, accurate to about one 8-bit level."""

_SHADOW = """
#ifdef LAYERS
layout(binding = 6) uniform sampler2DArrayShadow still_shadow;
layout(binding = 7) uniform sampler2DArrayShadow moving_shadow;
#define STILL(p) texture(still_shadow, vec4((p).xy, eye.w, (p).z))
#define MOVING(p) texture(moving_shadow, vec4((p).xy, float(PICTURE), (p).z))
#else
layout(binding = 6) uniform sampler2DShadow still_shadow;
layout(binding = 7) uniform sampler2DShadow moving_shadow;
#define STILL(p) texture(still_shadow, p)
#define MOVING(p) texture(moving_shadow, p)
#endif
vec3 on_map(vec3 at, vec3 normal) { return (shadow_from_at * vec4(at + 0.06 * normal, 1.0)).xyz; }
float sunlit_on(vec3 spot) {
#ifdef SHADOWS
    vec2 off = abs(spot.xy - 0.5);
    float inside = clamp((0.5 - max(off.x, off.y)) * 20.0, 0.0, 1.0);
    float lit = min(STILL(spot), MOVING(spot));
    return 1.0 - sun.w * inside * (1.0 - lit);
#else
    return 1.0;
#endif
}
float sunlit(vec3 at, vec3 normal) { return sunlit_on(on_map(at, normal)); }
"""
"""Share of sunlight at a point, for both shaders. `on_map` is linear, so it can be interpolated."""

_FRAGMENT = """
out vec4 pixel;

#ifdef WEATHER
WEATHER_CODE
#endif

vec3 on_curve(vec3 light) {
    // The ACES curve (Narkowicz's fit) in sRGB, which reaches white at 1.96, as a polynomial of
    // the root of light: to two levels below 0.8, without a division.
    vec3 s = min(sqrt(light), 1.4);
    return s * (0.1725 + s * (6.1673 + s * (-11.3129 + s * (7.7517 - s * 1.8716))));
}

#ifdef WEATHER
vec3 on_screen(vec3 light) { return light; }
#else
vec3 on_screen(vec3 light) { return on_curve(light * sun_light.w); }
#endif

float fogged() {
    float far = 1.0 / gl_FragCoord.w;
    return max(1.0 - exp(-fog.w * far), clamp((far - haze.x) * haze.y, 0.0, haze.z));
}

#ifdef WEATHER
void glow(vec3 colour, float label) {
    pixel = vec4(mix(decoded(colour) * 1.3 / sun_light.w, fog.rgb, fogged()), label / 255.0);
}

void show_linear(vec3 albedo, vec3 own, vec3 normal, vec3 at, float label, float lit_by_sun) {
    float raised = smoothstep(0.35, 0.75, normal.z);
    float facing = max(dot(normal, sun.xyz), 0.0);
    vec3 light = side_light.rgb + normal.z * tilt_light.rgb + abs(normal.z) * flat_light.rgb;
    light += sun_light.rgb * (facing * lit_by_sun);
    float gloss = 0.0, lit = in_contact(at, normal);
#ifdef WET
    float pool = puddle(at, label);
    albedo *= mix(1.0, mix(0.78, 0.55, raised), surface.x) * mix(1.0, 0.55, pool);
    if (is_ground(label)) gloss = mix(24.0, 90.0, pool) * surface.x;
#endif
#ifdef SNOW
    float lies = snow_on(at, raised, label);
    vec2 on_snow = ground_at(at);
    float heaped = 0.35 * noise(on_snow, 0.5) + 0.3 * noise(on_snow, 0.125) + 0.2 * noise(on_snow, 0.03125) + 0.15 * noise(on_snow, 2.0);
    albedo = mix(albedo, vec3(0.86, 0.88, 0.92) * (is_ground(label) ? 0.70 + 0.42 * heaped : 1.0), lies);
#endif
#ifdef LAMPS
    vec3 mirrored_lamps;
    vec3 lamps = lamplight(at, normal, gloss, mirrored_lamps);
    light += lamps;
    own += lit * mirrored_lamps;
#endif
    light *= lit;
    vec3 ray = normalize(at - eye.xyz);
    pixel = vec4(mix(albedo * light + own, fog_towards(ray), fogged()), label / 255.0);
}
#else
void glow(vec3 colour, float label) {
    pixel = vec4(mix(colour, on_screen(fog.rgb), fogged()), label / 255.0);
}

void show_linear(vec3 albedo, vec3 own, vec3 normal, vec3 at, float label, float lit_by_sun) {
    float facing = max(dot(normal, sun.xyz), 0.0);
    vec3 light = side_light.rgb + normal.z * tilt_light.rgb + abs(normal.z) * flat_light.rgb;
    light += sun_light.rgb * (facing * lit_by_sun);
    pixel = vec4(on_screen(mix(albedo * light + own, fog.rgb, fogged())), label / 255.0);
}
#endif

void show_linear(vec3 albedo, vec3 own, vec3 normal, vec3 at, float label) {
    show_linear(albedo, own, normal, at, label, sunlit(at, normal));
}

void show(vec3 albedo, vec3 normal, vec3 at, float label) {
    show_linear(decoded(albedo), vec3(0.0), normal, at, label);
}
"""

_WEATHER: Final = (
    PATTERNS
    + FOG_GLOW
    + "#ifdef LAMPS\n"
    + LAMPS
    + "#endif\n"
    + """
float in_contact(vec3 at, vec3 normal) {
    // Light that is left right under people and vehicles without sun.
#ifdef SHADOWS
    if (normal.z < 0.3 || sun.w == 0.0 || sun_light.r > 0.0) return 1.0;
    vec3 in_map = (shadow_from_at * vec4(at + 0.06 * normal, 1.0)).xyz;
    vec2 off = abs(in_map.xy - 0.5);
    if (max(off.x, off.y) > 0.49) return 1.0;
    const float r = 0.004;
    float lit = 0.25 * (texture(moving_shadow, in_map + vec3(r, 0.0, 0.0)) + texture(moving_shadow, in_map - vec3(r, 0.0, 0.0))
        + texture(moving_shadow, in_map + vec3(0.0, r, 0.0)) + texture(moving_shadow, in_map - vec3(0.0, r, 0.0)));
    lit = mix(0.42, 1.0, lit);
    int count = int(night.w);
    for (int k = 0; k < count; k++) {
        vec3 off = at - person[k].xyz;
        lit *= 1.0 - 0.62 * exp(-dot(off.xy, off.xy) / 0.075) * fading(0.35, 0.1, abs(off.z));
    }
    return lit;
#else
    return 1.0;
#endif
}
#ifdef SNOW
float snow_on(vec3 at, float raised, float label) {
    vec2 here = ground_at(at);
    float patchy = 0.6 * noise(here, 1.3) + 0.4 * noise(here, 0.35);
    // Least on people, who move, and where wheels and feet do.
    float cover = label < 1.5 ? 0.50 : label < 3.5 ? 0.66 : label > 9.5 && label < 10.5 ? 0.05 : 1.1;
    return surface.z * raised * smoothstep(0.28, 0.62, patchy + cover - 0.5);
}
#endif
"""
)
"""Code of the variants with `Variant.WEATHER`."""

_NOTHING: Final = "void main() {}\n"


@lru_cache(maxsize=128)
def programs(
    context: moderngl.Context, vertex: str, fragment: str, shadows: int, cut_out: str = ""
) -> Programs:
    """Create a drawable's programs, for the picture and for shadow maps.

    vertex, fragment: GLSL without a version line
    shadows: flags of a `Variant`; as a bool, whether `show` reads the shadow maps
    cut_out: fragment shader of the shadow maps, where parts of the surface are discarded

    Equal programs are shared during the context's lifetime, so set their uniforms before each draw.
    """
    variant = Variant(shadows)
    return Programs(
        context.program(
            vertex_shader=_before_vertex(variant) + vertex,
            fragment_shader=_before_fragment(variant) + fragment,
        ),
        context.program(
            # These programs draw into the shadow maps, so they must not read them.
            vertex_shader=_before_vertex(variant & ~Variant.SHADOWS) + vertex,
            fragment_shader=_VERSION + (cut_out or _NOTHING),
        ),
    )


def _before_vertex(variant: Variant) -> str:
    """Return the GLSL before a drawable's vertex shader."""
    if Variant.LAYERS in variant:
        head = _VERSION + _LAYER_EXTENSION + _BLOCKS + variant.defines + _SCENE_MAP
        return head + _DECODED + _SHADOW + _LAYERS_VERTEX
    return _VERSION + _BLOCK + variant.defines + _DECODED + _SHADOW + _VERTEX


def _before_fragment(variant: Variant) -> str:
    """Return the GLSL before a drawable's fragment shader."""
    if Variant.LAYERS in variant:
        head = _VERSION + _BLOCKS + variant.defines + _LAYERS_FRAGMENT
    else:
        head = _VERSION + _BLOCK + variant.defines
    weather = BLOCK if variant & Variant.WEATHER else ""
    return head + weather + _DECODED + _SHADOW + _FRAGMENT.replace("WEATHER_CODE", _WEATHER)


def anchor_of(eye_m: Floats) -> Floats:
    """Return the (..., 2) points of the anchors' lattice nearest to (..., 3) eyes."""
    return np.asarray(np.round(eye_m[..., :2] / ANCHOR_M) * ANCHOR_M)


def camera_matrix(shot: Shot, anchor: Floats) -> Floats:
    """Return the (4, 4) matrix from metres relative to the anchor to clip space.

    The first row of the picture is at the bottom, as it is read top first.
    """
    eye = shot.eye_m - (float(anchor[0]), float(anchor[1]), 0.0)
    matrices = camera_matrices(shot.axes[None], eye[None], np.array([shot.half_picture]))
    return np.asarray(matrices[0])


def camera_matrices(axes: Floats, eye: Floats, half_picture: Floats) -> Floats:
    """Return the (N, 4, 4) matrices of `camera_matrix` of N views.

    axes: (N, 3, 3) as in `Shot`
    eye: (N, 3) metres from the anchors
    half_picture: (N, 2) as in `Shot`
    """
    far, near = FAR_PLANE_M, NEAR_PLANE_M
    matrix = np.empty((len(axes), 4, 4))
    matrix[:, :3, :3] = axes
    x, y, z = eye.T[:, :, None]
    matrix[:, :3, 3] = -(axes[..., 0] * x + axes[..., 1] * y + axes[..., 2] * z)
    matrix[:, 3] = matrix[:, 2]
    deep = (far + near) / (far - near)
    matrix[:, 0] *= (1.0 / half_picture[:, 0])[:, None]
    matrix[:, 1] *= (-1.0 / half_picture[:, 1])[:, None]
    matrix[:, 2] *= deep
    matrix[:, 2, 3] -= 2.0 * far * near / (far - near)
    return matrix


class SceneBlocks:
    """Uniform blocks of the pictures of a batch and of their shadow passes, uploaded together."""

    def __init__(self, context: moderngl.Context) -> None:
        self._rows = np.zeros((2, PICTURES_MAX, _BLOCK_ROWS, 4), dtype=np.float32)
        self._buffer = context.buffer(reserve=self._rows.nbytes)

    def set(
        self,
        cameras: Floats,
        suns: Floats,
        to_maps: Floats,
        views: Floats,
        lights: NDArray[np.float32],
    ) -> None:
        """Upload the blocks of N pictures.

        cameras, suns, to_maps: (N, 4, 4) matrices to the clip spaces of the picture and of its
            shadow maps, and to their texture space
        views: (N, 5, 4) eye, anchor, and the axes of the picture, as in the block
        lights: (N, 8, 4) rows of `Lighting.rows`, and the row of the backdrop
        """
        n = len(cameras)
        camera, sun = self._rows[:, :n]
        camera[:, :4], camera[:, 4:8] = cameras.transpose(0, 2, 1), to_maps.transpose(0, 2, 1)
        camera[:, 8], camera[:, 16:20] = views[:, 0], views[:, 1:]
        camera[:, 9:16], camera[:, 20] = lights[:, :7], lights[:, 7]
        sun[:, :4], sun[:, 9:16] = suns.transpose(0, 2, 1), lights[:, :7]
        self._buffer.write(self._rows[0, :n])
        self._buffer.write(self._rows[1, :n], offset=self._rows[0].nbytes)

    def bind(self, picture: int = 0, sun: bool = False) -> None:
        """Bind the block of a picture, or of its shadow pass, as uploaded last."""
        each = self._rows[0, 0].nbytes
        self._bind(sun, picture * each, each)

    def bind_all(self, sun: bool = False) -> None:
        """Bind all blocks, or those of the shadow passes, for draws with `Variant.LAYERS`."""
        self._bind(sun, 0, self._rows[0].nbytes)

    def _bind(self, sun: bool, offset: int, size: int) -> None:
        offset += sun * self._rows[0].nbytes
        self._buffer.bind_to_uniform_block(SCENE_BINDING, offset=offset, size=size)

    def release(self) -> None:
        self._buffer.release()


class SceneMaps:
    """Buffers `SceneMap`: blocks and layers of the scenes of a batch, for pictures and static maps."""

    def __init__(self, context: moderngl.Context) -> None:
        self._context = context
        self._room = 0
        self._buffers: list[moderngl.Buffer] = []
        self._held: tuple[int, bytes, bytes] | None = None

    def set(self, count: int, scene_ids: NDArray[np.intp], maps: NDArray[np.intp]) -> None:
        """Upload the places of N scenes.

        count: number above all ids
        scene_ids, maps: (N,) ids, and layers of the static shadow maps
        """
        if count > self._room:
            self.release()
            self._room = 2 * count
            self._buffers = [self._context.buffer(reserve=8 * self._room) for _ in range(2)]
            self._held = None
        wanted = count, scene_ids.tobytes(), maps.tobytes()
        if wanted == self._held:
            return
        self._held = wanted
        pictures = np.arange(len(scene_ids))
        for buffer, layers in zip(self._buffers, (pictures, maps), strict=True):
            rows = np.zeros((count, 2), dtype=np.int32)
            rows[scene_ids, 0], rows[scene_ids, 1] = pictures, layers
            buffer.write(rows)

    def bind(self, still: bool = False) -> None:
        """Bind the places of pictures, or of static shadow maps, for later draws."""
        self._buffers[still].bind_to_storage_buffer(SCENE_MAPS_BINDING)

    def release(self) -> None:
        for buffer in self._buffers:
            buffer.release()
        self._buffers = []
        self._room = 0
