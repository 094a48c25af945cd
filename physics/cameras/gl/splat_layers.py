"""Pictures of scanned places with splats: layers, and their composition.

A picture has three layers: objects (people, vehicles, robot, obstacles) before the sky, normals and
labels of the scan's mesh, and the splats. The mesh decides whether splats cover an object. It also
gives the labels, and receives the shadows of objects and the shade at feet.
"""

from __future__ import annotations

import math
from collections import OrderedDict
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Final

import moderngl
import msgspec
import numpy as np

from cosim.core.errors import EngineError
from cosim.place.scan import ScanFacts, Splats
from cosim.spec.scenario import Light
from physics.cameras.gl import splat_shaders as glsl
from physics.cameras.gl.full_screen import VERTEX as FULL_SCREEN
from physics.cameras.gl.lighting import Lighting
from physics.cameras.gl.scans import SHADE
from physics.cameras.gl.shading import programs
from physics.cameras.gl.splats import SplatCloud, SplatDrawing, SplatTarget, Views
from physics.cameras.gl.targets import Target
from physics.cameras.sky import Sky, sky_of
from physics.cameras.view import FAR_PLANE_M, NEAR_PLANE_M, Shot

_SIZES_MAX: Final = 4
_ALWAYS: Final = "1"
"""Depth function of moderngl that passes every pixel."""
_CLOUDS_MAX: Final = 2
"""Unused clouds that stay on the renderer."""
_CONTACT: Final = 0.5
"""Share of a scanned colour that is left under an object."""
_CONTACT_M: Final = 0.2
"""Radius over which a contact shadow is blurred, metres."""

_ABOVE: Final = np.array([0.0, 0.0, 1.0])
_DARK: Final = np.zeros(3)

_FRAGMENT: Final = f"""
layout(binding = {glsl.OBJECTS_UNIT}) uniform sampler2D objects;
layout(binding = {glsl.OBJECTS_DEPTH_UNIT}) uniform sampler2D objects_depth;
layout(binding = {glsl.MESH_UNIT}) uniform sampler2D mesh;
layout(binding = {glsl.MESH_DEPTH_UNIT}) uniform sampler2D mesh_depth;
layout(binding = {glsl.COLOUR_UNIT}) uniform sampler2D splats;
layout(binding = {glsl.MEDIAN_UNIT}) uniform sampler2D median;
layout(binding = {glsl.LIMITS_UNIT}) uniform sampler2D limits;
layout(binding = {glsl.FEET_UNIT}) uniform sampler2D at_feet;
uniform int first_row;
in vec2 spot;
{glsl.METRES}
float shaded(vec3 at, vec3 normal) {{
#ifdef CONTACT
    const float SHADED = {_CONTACT};
    float lit = 0.2 * sunlit(at, normal);
    for (int k = 0; k < 4; ++k) {{
        vec2 off = {_CONTACT_M} * vec2(k == 0 ? 1.0 : k == 1 ? -1.0 : 0.0, k == 2 ? 1.0 : k == 3 ? -1.0 : 0.0);
        lit += 0.2 * sunlit(at + vec3(off, 0.0), normal);
    }}
#else
    const float SHADED = {SHADE};
    float lit = sunlit(at, normal);
#endif
    return mix(1.0, mix(SHADED, 1.0, lit), smoothstep(0.0, 0.2, dot(normal, sun.xyz)));
}}
void main() {{
    ivec2 here = ivec2(gl_FragCoord.xy), stacked = here + ivec2(0, first_row);
    vec4 behind = texelFetch(objects, here, 0), blended = texelFetch(splats, stacked, 0);
    vec4 surface = texelFetch(mesh, here, 0);
    float far = texelFetch(mesh_depth, here, 0).r, limit = abs(texelFetch(limits, stacked, 0).r);
    float object = texelFetch(objects_depth, here, 0).r, middle = texelFetch(median, stacked, 0).r;
    bool covered = blended.a <= 0.5, none = limit >= {glsl.NOTHING_M:.1f};
    vec3 colour = blended.rgb;
    if (far < 1.0 && limit > 0.0) {{
        vec3 ray = ahead.xyz + spot.x * right.w * right.xyz - spot.y * up.w * up.xyz;
        vec3 at = eye.xyz + metres(far) * ray;
        colour *= shaded(at, normalize(2.0 * surface.rgb - 1.0)) * texelFetch(at_feet, here, 0).r;
    }}
    bool own = !none && !covered, hidden = none && object < 1.0;
    vec3 rest = hidden ? colour / max(1.0 - blended.a, 0.05) : behind.rgb;
    float label = own || far >= 1.0 ? behind.a : surface.a;
    float deep = ({FAR_PLANE_M} - {FAR_PLANE_M * NEAR_PLANE_M} / max(middle, {NEAR_PLANE_M})) / {FAR_PLANE_M - NEAR_PLANE_M};
    pixel = vec4(colour + blended.a * rest, label);
    gl_FragDepth = own ? object : covered ? min(deep, 1.0) : far;
}}
"""


class Layers:
    """Layers of a picture that are drawn by triangles.

    feet: light left on the mesh at feet, 0 to 1, with the depths of the mesh
    """

    def __init__(self, context: moderngl.Context, size: tuple[int, int]) -> None:
        self._objects = context.texture(size, 4, dtype="f2")
        self._mesh = context.texture(size, 4)
        self._feet = context.texture(size, 1)
        self._depths = [context.depth_texture(size) for _ in range(2)]
        for depth in self._depths:
            depth.compare_func = ""
        self.objects = context.framebuffer([self._objects], self._depths[0])
        self.mesh = context.framebuffer([self._mesh], self._depths[1])
        self.feet = context.framebuffer([self._feet], self._depths[1])
        self.feet.depth_mask = False

    def bind(self) -> None:
        """Bind the layers to their texture units."""
        for texture, unit in (
            (self._objects, glsl.OBJECTS_UNIT),
            (self._depths[0], glsl.OBJECTS_DEPTH_UNIT),
            (self._mesh, glsl.MESH_UNIT),
            (self._depths[1], glsl.MESH_DEPTH_UNIT),
            (self._feet, glsl.FEET_UNIT),
        ):
            texture.use(unit)

    def release(self) -> None:
        self.objects.release()
        self.mesh.release()
        self.feet.release()
        for texture in (self._objects, self._mesh, self._feet, *self._depths):
            texture.release()


class Stack:
    """Layers of pictures of one size that are drawn together.

    The splats and the limits of all pictures are in one texture each, one picture below the other.
    """

    def __init__(self, context: moderngl.Context, size: tuple[int, int], pictures: int) -> None:
        self.layers = [Layers(context, size) for _ in range(pictures)]
        self.splats = SplatTarget(context, size, pictures)
        self.limits = context.texture(self.splats.size, 1, dtype="f4")

    def bind(self, nth: int) -> None:
        """Bind the layers of the nth picture to their texture units."""
        self.layers[nth].bind()
        self.splats.colour.use(glsl.COLOUR_UNIT)
        self.splats.median.use(glsl.MEDIAN_UNIT)
        self.limits.use(glsl.LIMITS_UNIT)

    def release(self) -> None:
        while self.layers:
            self.layers.pop().release()
        self.splats.release()
        self.limits.release()


@dataclass(slots=True)
class _Held:
    """A cloud on the renderer, and the number of its users."""

    cloud: SplatCloud
    splats: Splats
    users: int = 0


class SplatPictures:
    """Composition of pictures with splats; one instance per context, with the same lifetime."""

    def __init__(self, context: moderngl.Context) -> None:
        self._context = context
        self.drawing = SplatDrawing(context)
        self._sizes: OrderedDict[tuple[int, int], Stack] = OrderedDict()
        self._clouds: list[_Held] = []
        self._arrays: dict[int, tuple[moderngl.VertexArray, moderngl.Uniform]] = {}

    def cloud(self, splats: Splats) -> SplatCloud:
        """Return the cloud of splats, shared by all cameras that use it until `release`."""
        held = next((one for one in self._clouds if one.splats is splats), None)
        if held is None:
            unused = [one for one in self._clouds if not one.users]
            for one in unused[: len(unused) - _CLOUDS_MAX + 1]:
                one.cloud.release()
                self._clouds.remove(one)
            try:
                held = _Held(SplatCloud(self._context, splats), splats)
            except moderngl.Error as error:
                raise EngineError(
                    f"{len(splats)} splats do not fit into the renderer's memory ({error}): "
                    "import the scan with fewer, or use --appearance mesh"
                ) from error
            self._clouds.append(held)
        held.users += 1
        return held.cloud

    def release(self, cloud: SplatCloud) -> None:
        """Return a cloud; it may be used again."""
        next(one for one in self._clouds if one.cloud is cloud).users -= 1

    def most(self, size: tuple[int, int]) -> int:
        """Return the maximum number of pictures of a size that are drawn together."""
        tallest: int = self._context.info["GL_MAX_TEXTURE_SIZE"]
        return max(1, min(self.drawing.tuning.views, tallest // size[1]))

    def stack(self, size: tuple[int, int], pictures: int) -> Stack:
        """Return the layers of at least `pictures` pictures; those of the last few sizes are
        cached."""
        held = self._sizes.pop(size, None)
        if held is not None and len(held.layers) < pictures:
            held.release()
            held = None
        if held is None:
            if len(self._sizes) == _SIZES_MAX:
                self._sizes.popitem(last=False)[1].release()
            held = Stack(self._context, size, pictures)
        self._sizes[size] = held
        return held

    def draw(
        self,
        cloud: SplatCloud,
        taken: Sequence[Shot],
        stack: Stack,
        triangles: Callable[[int, Layers], None],
    ) -> None:
        """Draw all layers of pictures of one size. triangles: draws the layers of the nth one."""
        views = Views.of(taken)
        for nth in range(len(taken)):
            triangles(nth, stack.layers[nth])
            stack.bind(nth)
            self.drawing.limit(views, nth, stack.limits)
        self.drawing.draw(cloud, views, stack.splats, limited=True)

    def compose(self, nth: int, light: Lighting, stack: Stack, target: Target) -> None:
        """Compose the layers of the nth picture into the target.

        The picture's scene block and shadow maps must be bound.
        """
        stack.bind(nth)
        gl = self._context
        target.use()
        gl.depth_func = _ALWAYS
        array, first_row = self._array(light)
        first_row.value = nth * target.size[1]
        array.render(moderngl.TRIANGLES, vertices=3)
        gl.depth_func = "<"

    def _array(self, light: Lighting) -> tuple[moderngl.VertexArray, moderngl.Uniform]:
        contact = not light.sun.any()
        key = 2 * light.shadows + contact
        if key not in self._arrays:
            fragment = ("#define CONTACT\n" if contact else "") + _FRAGMENT
            program = programs(self._context, FULL_SCREEN, fragment, light.shadows).colour
            first_row = program["first_row"]
            assert isinstance(first_row, moderngl.Uniform)
            self._arrays[key] = self._context.vertex_array(program, []), first_row
        return self._arrays[key]


@lru_cache(maxsize=1)
def splat_pictures(context: moderngl.Context) -> SplatPictures:
    """Return the context's single instance."""
    return SplatPictures(context)


def scan_sky(light: Light, facts: ScanFacts, seed: int) -> Sky:
    """Return the sky whose light people and objects have in a scan.

    The scan contains its own light, so only shadows and the picture of the sky are those of
    `light`. Without a known sun the sky is overcast, and objects have contact shadows: the sun is
    straight above, without light.
    """
    own = Light(shadows=light.shadows, hdri=light.hdri, exposure_ev=facts.exposure_ev)
    if facts.sun is not None:
        azimuth, rise = (
            math.radians(angle) for angle in (facts.sun.azimuth_deg, facts.sun.elevation_deg)
        )
        flat = math.cos(rise)
        to_sun = flat * math.sin(azimuth), flat * math.cos(azimuth), math.sin(rise)
        return sky_of(own, seed, to_sun)
    sky = sky_of(msgspec.structs.replace(own, cloud_cover=1.0), seed)
    return replace(sky, sun=_ABOVE, sun_colour=_DARK, shadows=light.shadows)
