"""Static objects of the pictures of a batch: shared buffers, and draws by step.

Meshes of tiles and instances of objects of all scenes are in one buffer each. A scene lists its
draws by step and material; a step of several pictures is one call.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Final, Literal, NamedTuple

import moderngl
import numpy as np

from cosim.core.geometry import Floats
from physics.cameras.gl import corners, walls
from physics.cameras.gl.context import is_card
from physics.cameras.gl.gl_state import masked
from physics.cameras.gl.instances import MATERIALS, POOLED, Forms, Material, ThingArrays
from physics.cameras.gl.lighting import Lighting
from physics.cameras.gl.pool import Draws, MeshPool, PictureRange, Pool
from physics.cameras.gl.scans import scan_shaders
from physics.cameras.gl.shading import Pass
from physics.cameras.gl.surfaces import SurfaceShaders, surfaces
from physics.cameras.gl.tiles import decal_shaders, tile_shaders
from physics.cameras.gl.variants import Variant
from physics.cameras.gl.walls import wall_shaders
from physics.cameras.gl.weather import WeatherLook

if TYPE_CHECKING:
    from physics.cameras.gl.scene import GlScene

TileKind = Literal["ground", "paint", "decals", "walls", "scan"]
TILE_KINDS: Final[tuple[TileKind, ...]] = ("ground", "paint", "decals", "walls", "scan")
"""Layers of a tile's meshes, each with a program."""
TileStep = Literal["colour", "still"]
ThingStep = Literal["seen", "standing", "fenced"]
"""Objects in view, objects that cast shadows, and fences, which do both."""
Step = tuple[TileStep, TileKind] | tuple[ThingStep, Material]
STEPS: Final[tuple[Step, ...]] = (
    *(("colour", kind) for kind in TILE_KINDS),
    *(("still", kind) for kind in TILE_KINDS),
    *((things, material) for things in ("seen", "standing", "fenced") for material in MATERIALS),
)
_OPAQUE: Final[tuple[Material, ...]] = ("solid", "cut-out")
_PLACE: Final = np.dtype([("middle", "f4", 2), ("middle_in_world", "f4", 2), ("scene_id", "i4")])
_PLACE_LAYOUT: Final = ("2f 2f 1i4/i", "middle", "middle_in_world", "scene_id")


class Style(NamedTuple):
    """What the programs of a scene depend on.

    scan: variant of the scan's mesh
    splats: the mesh is drawn apart, as normals
    """

    variant: Variant
    night: bool
    scan: Variant
    splats: bool


def style_of(light: Lighting, splats: bool, look: WeatherLook | None, layers: bool) -> Style:
    """Return the style of a scene. The arguments are those of `GlScene`."""
    together = Variant.LAYERS if layers else Variant.NONE
    variant = Variant(light.shadows) if look is None else look.variant
    scan = Variant(light.shadows and not splats)
    return Style(variant | together, light.lamps > 0.0, scan | together, splats)


class StreetDrawing:
    """Drawing of the static objects of batches; one instance per context.

    forms: registry of all forms of objects
    things, places, meshes: rows of instances, positions of tiles, and meshes of each kind
    """

    def __init__(self, context: moderngl.Context, forms: Forms) -> None:
        self._context = context
        self._surfaces = surfaces(context)
        self.forms = forms
        self.things = Pool(context, POOLED.itemsize)
        self.places = Pool(context, _PLACE.itemsize)
        ground, wall = (MeshPool(context, row.itemsize) for row in (corners.CORNER, walls.CORNER))
        self.meshes = {kind: wall if kind == "walls" else ground for kind in TILE_KINDS}
        self._thing_arrays = ThingArrays(context, forms, self.things)
        self._tile_arrays: dict[tuple[TileKind, Style], tuple[int, list[moderngl.VertexArray]]] = {}
        self._draws = Draws(context)
        self._drawn_for: list[int] = []
        self._scenes: Sequence[GlScene] = ()
        self._free_ids: list[int] = []
        self._ids_end = 0

    def take_id(self) -> int:
        """Return an unused number for a scene."""
        if not self._free_ids:
            self._ids_end += 1
            return self._ids_end - 1
        return self._free_ids.pop()

    def give_id(self, scene_id: int) -> None:
        """Return a number from `take_id`."""
        self._free_ids.append(scene_id)
        self._scenes = ()

    @property
    def scene_ids_end(self) -> int:
        """Number above all ids."""
        return self._ids_end

    def place(self, first: int, scene_id: int, middles: Floats, anchor: Floats) -> None:
        """Set the positions of a scene's tiles.

        first: row of `places`
        middles: (T, 2) world metres
        """
        rows = np.empty(len(middles), dtype=_PLACE)
        rows["middle"], rows["middle_in_world"], rows["scene_id"] = (
            middles - anchor,
            middles,
            scene_id,
        )
        self.places.write(first, rows)

    def set(self, scenes: Sequence[GlScene]) -> None:
        """Prepare the arranged scenes of a batch's pictures."""
        versions = [scene.version for scene in scenes]
        self._scenes = scenes
        if versions != self._drawn_for:
            self._draws.set(list(zip(*(scene.draws for scene in scenes), strict=True)))
            self._drawn_for = versions

    def draw(self, part: PictureRange, stage: Pass, style: Style) -> None:
        """Draw the streets of a part: small objects first, then walls and ground from near to
        far."""
        if stage == "moving":
            return
        for material in _OPAQUE:
            self._draw_things(
                "seen" if stage == "colour" else "standing", material, stage, style, part
            )
        for material in _OPAQUE:
            self._draw_fences(material, stage, style, part)
        if stage == "colour":
            self._draw_walls(style, part)
        else:
            self._draw_tiles("walls", stage, style, part)
        self._draw_tiles("ground", stage, style, part)
        if not style.splats:
            self._draw_tiles("scan", stage, style, part)

    def draw_mesh(self, part: PictureRange, style: Style) -> None:
        """Draw normals and labels of the scan's mesh."""
        self._draw_tiles("scan", "colour", style, part)

    def draw_paint(self, part: PictureRange, style: Style) -> None:
        """Draw road paint after the ground, without labels and depth."""
        self._draw_tiles("paint", "colour", style, part)

    def draw_decals(self, part: PictureRange, style: Style) -> None:
        """Draw pictures on the ground, unless snow covers it; the blending multiplies colours."""
        if Variant.SNOW not in style.variant:
            self._draw_tiles("decals", "colour", style, part)

    def draw_panes(self, part: PictureRange, labels: bool, style: Style) -> None:
        """Draw clear glass over the finished picture: its colours, or its labels and depth."""
        step = STEPS.index(("seen", "pane"))
        if self._draws.count(step, part.first, part.end):
            array = self._thing_arrays.of("pane", labels, style.variant & ~Variant.SHADOWS)
            self._draws.draw(array, step, part.first, part.end)

    def _draw_things(
        self, things: ThingStep, material: Material, stage: Pass, style: Style, part: PictureRange
    ) -> None:
        step = _STEP[things, material]
        if self._draws.count(step, part.first, part.end):
            array = self._thing_arrays.of(material, stage != "colour", style.variant)
            self._draws.draw(array, step, part.first, part.end)

    def _draw_fences(
        self, material: Material, stage: Pass, style: Style, part: PictureRange
    ) -> None:
        """Draw fences, whose forms are those of their scene."""
        step = _STEP["fenced", material]
        if not self._draws.count(step, part.first, part.end):
            return
        for i in range(part.first, part.end):
            if self._draws.count(step, i, i + 1):
                arrays = self._scenes[i].fence_arrays
                array = arrays.of(material, stage != "colour", style.variant)
                self._draws.draw(array, step, i, i + 1)

    def _draw_walls(self, style: Style, part: PictureRange) -> None:
        """Draw the walls of pictures.

        A software renderer first draws their depths alone, so that hidden walls are not shaded.
        """
        gl = self._context
        step = _STEP["colour", "walls"]
        if is_card(gl) or not self._draws.count(step, part.first, part.end):
            self._draw_tiles("walls", "colour", style, part)
            return
        with masked(gl.fbo, only="depth"):
            self._draws.draw(self._tile_array("walls", style)[1], step, part.first, part.end)
        gl.depth_func = "<="
        try:
            self._draw_tiles("walls", "colour", style, part)
        finally:
            gl.depth_func = "<"

    def _draw_tiles(self, kind: TileKind, stage: Pass, style: Style, part: PictureRange) -> None:
        step = _STEP["colour" if stage == "colour" else "still", kind]
        if self._draws.count(step, part.first, part.end):
            array = self._tile_array(kind, style)[stage != "colour"]
            self._draws.draw(array, step, part.first, part.end)

    def _tile_array(self, kind: TileKind, style: Style) -> list[moderngl.VertexArray]:
        pool = self.meshes[kind]
        version, arrays = self._tile_arrays.get((kind, style), (-1, []))
        if version != pool.version + self.places.version:
            for array in arrays:
                array.release()
            rows, triangles = pool.buffers
            layout = walls.LAYOUT if kind == "walls" else corners.LAYOUT
            content = [(rows, *layout), (self.places.buffer, *_PLACE_LAYOUT)]
            arrays = [
                self._context.vertex_array(program, content, triangles, skip_errors=True)
                for program in self._shaders(kind, style).programs
            ]
            self._tile_arrays[kind, style] = pool.version + self.places.version, arrays
        return arrays

    def _shaders(self, kind: TileKind, style: Style) -> SurfaceShaders:
        gl, textures = self._context, self._surfaces
        match kind:
            case "walls":
                return wall_shaders(gl, textures, style.variant, style.night)
            case "decals":
                return decal_shaders(gl, textures, style.variant & Variant.LAYERS)
            case "scan":
                return scan_shaders(gl, textures, style.scan, style.splats)
            case "ground" | "paint":
                return tile_shaders(gl, textures, style.variant)


_STEP: Final = {step: i for i, step in enumerate(STEPS)}
