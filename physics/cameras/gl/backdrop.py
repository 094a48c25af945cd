"""Background of a picture: the sky, and infinite ground below the horizon."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from functools import lru_cache
from typing import Final

import moderngl
import numpy as np
from numpy.typing import NDArray

from cosim.core.state import LABELS
from physics.cameras.gl.full_screen import SPOT
from physics.cameras.gl.lighting import sky_texels, sky_texture
from physics.cameras.gl.pool import PictureRange
from physics.cameras.gl.shading import PICTURES_MAX, SKY_UNIT, programs
from physics.cameras.gl.variants import Variant
from physics.cameras.sky import HORIZON_FADE, Sky

_VERTEX: Final = f"""
out vec2 spot;
void main() {{
    spot = {SPOT};
    gl_Position = in_picture(vec4(spot, 1.0, 1.0));
}}
"""

_FRAGMENT: Final = f"""
#ifdef LAYERS
layout(binding = {SKY_UNIT}) uniform sampler2DArray sky;
#define ON_SKY(where) vec3(where, backdrop.w)
vec3 all_around = backdrop.rgb;
#else
layout(binding = {SKY_UNIT}) uniform sampler2D sky;
#define ON_SKY(where) where
uniform vec3 all_around;
#endif
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
    vec3 seen = texture(sky, ON_SKY(where)).rgb;
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


class SkySlot:
    """A sky in `SkyLayers`. layer: of the array; around: rgb all around the horizon"""

    def __init__(self, skies: SkyLayers, sky: Sky) -> None:
        self.skies = skies
        self.layer = skies.hold(sky)
        self.around = tuple(float(c) for c in sky.fog_colour)

    def release(self) -> None:
        self.skies.drop(self.layer)


class SkyLayers:
    """Skies of one size as layers of an array, for pictures that are drawn together.

    Equal skies share a layer.
    """

    def __init__(self, context: moderngl.Context) -> None:
        self._context = context
        self._held: list[tuple[bytes, int, NDArray[np.float16]] | None] = []
        self._texture: moderngl.TextureArray | None = None
        self._scene_ids: moderngl.Buffer | None = None
        self._commands: moderngl.Buffer | None = None
        self._set_for: tuple[bytes, Sequence[PictureRange]] | None = None

    def hold(self, sky: Sky) -> int:
        """Return the layer of a sky. `drop` it when it is not needed any more."""
        texels = sky_texels(sky.radiance)
        key = hashlib.blake2b(texels.tobytes(), digest_size=16).digest()
        free = len(self._held)
        for layer, held in enumerate(self._held):
            if held is not None and held[0] == key:
                self._held[layer] = key, held[1] + 1, texels
                return layer
            if held is None:
                free = min(free, layer)
        self._held[free : free + 1] = [(key, 1, texels)]
        if self._texture is not None and free < self._texture.layers:
            self._write(free, texels)
        return free

    def drop(self, layer: int) -> None:
        """Return a layer from `hold`."""
        held = self._held[layer]
        assert held is not None
        key, users, texels = held
        self._held[layer] = (key, users - 1, texels) if users > 1 else None

    def set(self, scene_ids: NDArray[np.intp], parts: Sequence[PictureRange]) -> None:
        """Prepare the draws of a batch. scene_ids: of the scenes of its pictures"""
        wanted = scene_ids.tobytes(), parts
        if wanted == self._set_for:
            return
        self._set_for = wanted
        if self._scene_ids is None or self._commands is None:
            self._scene_ids = self._context.buffer(reserve=4 * PICTURES_MAX)
            self._commands = self._context.buffer(reserve=20 * PICTURES_MAX)
            program = programs(self._context, _VERTEX, _FRAGMENT, Variant.LAYERS).colour
            content = [(self._scene_ids, "1i4/i", "scene_id")]
            self._array = self._context.vertex_array(program, content)
        commands = np.zeros((len(parts), 5), dtype=np.uint32)
        for row, part in zip(commands, parts, strict=True):
            row[:4] = 3, part.end - part.first, 0, part.first
        self._scene_ids.write(scene_ids.astype(np.int32))
        self._commands.write(commands)

    def draw(self, part: PictureRange) -> None:
        """Draw the skies of a part after its streets."""
        assert self._commands is not None
        self._bind()
        self._array.render_indirect(self._commands, moderngl.TRIANGLES, 1, part.number)

    def _bind(self) -> None:
        if self._texture is None or self._texture.layers < len(self._held):
            if self._texture is not None:
                self._texture.release()
            texels = next(held[2] for held in self._held if held is not None)
            rows, columns, channels = texels.shape
            size = columns, rows, 2 * len(self._held) - 1
            array = self._context.texture_array(size, channels, dtype="f2", alignment=2)
            array.filter = moderngl.LINEAR, moderngl.LINEAR
            array.repeat_x, array.repeat_y = True, False
            self._texture = array
            for layer, held in enumerate(self._held):
                if held is not None:
                    self._write(layer, held[2])
        self._texture.use(SKY_UNIT)

    def _write(self, layer: int, texels: NDArray[np.float16]) -> None:
        assert self._texture is not None
        rows, columns, _ = texels.shape
        viewport = (0, 0, layer, columns, rows, 1)
        self._texture.write(texels.tobytes(), viewport=viewport, alignment=2)


@lru_cache(maxsize=8)
def sky_layers(context: moderngl.Context, shape: tuple[int, int]) -> SkyLayers:
    """Return the context's skies of a shape, with the same lifetime."""
    return SkyLayers(context)
