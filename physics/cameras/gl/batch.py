"""Batches of pictures of any number of environments.

All pictures of a batch are arranged, posed, culled and uploaded together. On a graphics card,
pictures by clear day are layers of one array texture: one call draws a material of all of them.
Pictures with splats, weather, night or depth are drawn one by one, and all pictures on a software
renderer. The same code draws both: a part of a batch is one or more pictures. Pictures are drawn
in the order of their programs; bits do not depend on it.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import lru_cache, partial
from typing import Final, NamedTuple, Protocol

import moderngl
import numpy as np
from numpy.typing import NDArray

from cosim.core.clock import Clock
from cosim.core.state import RobotState, Street
from cosim.spec.robot import Robot
from physics.cameras.gl.air import AirDrawing, LinearTarget
from physics.cameras.gl.backdrop import Backdrop, SkySlot
from physics.cameras.gl.crowd import CrowdDrawing, PeopleSeen
from physics.cameras.gl.driver import flush
from physics.cameras.gl.gl_state import blending, masked, polygon_offset
from physics.cameras.gl.instances import Forms
from physics.cameras.gl.lamps import casting_people
from physics.cameras.gl.layers import LayerTarget, LayerTargets
from physics.cameras.gl.lighting import Lighting
from physics.cameras.gl.pool import PictureRange
from physics.cameras.gl.scene import GlScene
from physics.cameras.gl.shading import PICTURES_MAX, Pass, SceneBlocks, SceneMaps
from physics.cameras.gl.shadows import (
    NO_SUN,
    TO_TEXTURE,
    ShadowLayers,
    ShadowMaps,
    ShadowSlot,
    casting,
)
from physics.cameras.gl.shots import Shots
from physics.cameras.gl.splat_layers import Layers, splat_pictures
from physics.cameras.gl.splats import SplatCloud
from physics.cameras.gl.street import StreetDrawing
from physics.cameras.gl.surfaces import surfaces
from physics.cameras.gl.targets import Frame, Target
from physics.cameras.gl.traffic import Driven, TrafficDrawing
from physics.cameras.gl.variants import Variant
from physics.cameras.gl.weather import WeatherBlocks, WeatherLook
from physics.cameras.view import Shot
from physics.people.wardrobe import Season
from physics.street.surface import Surface

_CLOCK: Final = Clock()
_PEOPLE_MAX: Final = 8192
"""Maximum number of people in a batch; a picture with more is a separate batch."""


class Stage(NamedTuple):
    """Resources of a camera: street scene, optional shadow maps, backdrop, light.

    shadows, backdrop: slots where pictures are drawn as layers
    cloud: splats of the place, None without
    season: of people's clothes
    rain: most people hold umbrellas
    look: weather and night; None by a clear day
    """

    surface: Surface
    model: Robot
    scene: GlScene
    shadows: ShadowMaps | ShadowSlot | None
    backdrop: Backdrop | SkySlot
    light: Lighting
    cloud: SplatCloud | None = None
    season: Season = "mild"
    rain: bool = False
    look: WeatherLook | None = None

    @property
    def variant(self) -> Variant:
        """Variant of the programs."""
        return self.scene.style.variant


class PictureOrder(NamedTuple):
    """Request for a picture.

    light: as this view sees it
    rows: (8, 4) of this light and of the backdrop, for `SceneBlocks`
    robot: None without a robot
    body: the robot's body is drawn in the picture itself, not only its shadow
    """

    stage: Stage
    taken: Shot
    light: Lighting
    rows: NDArray[np.float32]
    street: Street
    robot: RobotState | None
    body: bool


class Sink(Protocol):
    """Receiver of drawn pictures, before the next ones are drawn."""

    def take(self, place: int) -> None:
        """Take the picture with a number from the target."""

    def take_layers(self, drawn: LayerTarget, places: Sequence[int]) -> None:
        """Take pictures from the first layers. places: number of each"""


class BatchDrawing:
    """Drawing of batches; one instance per context, with the same lifetime.

    street: buffers of all scenes
    """

    def __init__(self, context: moderngl.Context) -> None:
        self._context = context
        self._surfaces = surfaces(context)
        forms = Forms(context, self._surfaces)
        self.street = StreetDrawing(context, forms)
        self._crowd = CrowdDrawing(context)
        self._traffic = TrafficDrawing(context, forms, self.street.things)
        self._blocks, self._scene_maps = SceneBlocks(context), SceneMaps(context)
        self._layers = LayerTargets(context)
        self._pictures = splat_pictures(context)
        self._weather, self._air = WeatherBlocks(context), AirDrawing(context)

    def draw(self, pictures: Sequence[PictureOrder], target: Target, sink: Sink) -> None:
        """Draw pictures of the target's size, one after another into it, or as layers.

        The caller must hold the context.
        """
        first = 0
        for some in _batches(pictures):
            order = _order(some)
            few = [some[i] for i in order]
            places = [first + i for i in order]
            parts = _parts(few)
            shots = self._arrange(few, parts)
            self._surfaces.bind()
            self._cast(few, parts, shots)
            self._context.enable_only(moderngl.DEPTH_TEST | moderngl.CULL_FACE)
            self._context.front_face = "cw"  # draw upside down, to read the top row first
            layered = [part for part in parts if _shared(few[part.first]) is not None]
            if layered:
                self._draw_layered(few, layered, target.size, sink, places)
            for group in self._together(few, parts[len(layered) :], target.size):
                for i in self._draw_some(few, group, target):
                    sink.take(places[i])
            first += len(few)

    def _arrange(self, pictures: Sequence[PictureOrder], parts: Sequence[PictureRange]) -> Shots:
        shots = Shots([one.taken for one in pictures])
        for one, lattice in zip(pictures, shots.lattice, strict=True):
            one.stage.scene.arrange(one.taken.view, lattice, one.street)
        scenes = [one.stage.scene for one in pictures]
        self.street.set(scenes)
        watched, driven = [], []
        for one in pictures:
            stage, surface = one.stage, one.stage.surface
            shadows = stage.shadows is not None
            watched.append(
                PeopleSeen(
                    one.street.people,
                    _CLOCK.time_s(one.street.tick),
                    surface.heights,
                    shadows,
                    surface.seed,
                    stage.season,
                    stage.rain,
                )
            )
            driven.append(
                Driven(one.street.vehicles, surface, stage.model, one.robot, one.body, shadows)
            )
        part = np.repeat(np.arange(len(parts)), [one.end - one.first for one in parts])
        scene_ids = np.array([scene.id for scene in scenes])
        self._crowd.set(watched, shots, part, scene_ids)
        self._traffic.set(driven, shots, part, scene_ids)
        self._arrange_blocks(pictures, shots)
        self._arrange_layers(pictures, parts, scene_ids)
        self._arrange_weather(pictures, shots)
        return shots

    def _arrange_blocks(self, pictures: Sequence[PictureOrder], shots: Shots) -> None:
        """Upload the blocks of the pictures and of their shadow passes."""
        suns, to_maps = np.empty((2, len(pictures), 4, 4))
        suns[:], to_maps[:] = NO_SUN, TO_TEXTURE
        views = shots.views()
        for i, one in enumerate(pictures):
            if (shadows := one.stage.shadows) is not None:
                matrices = shadows.matrices(shots.lattice[i], one.stage.light)
                suns[i], to_maps[i] = matrices
                if isinstance(shadows, ShadowSlot):
                    views[i, 0, 3] = shadows.layer
        lights = np.array([one.rows for one in pictures])
        self._blocks.set(shots.cameras(), suns, to_maps, views, lights)

    def _arrange_layers(
        self,
        pictures: Sequence[PictureOrder],
        parts: Sequence[PictureRange],
        scene_ids: NDArray[np.intp],
    ) -> None:
        """Upload the layers of the scenes whose pictures are drawn together."""
        stages = [one.stage for one in pictures]
        if not any(Variant.LAYERS in stage.variant for stage in stages):
            return
        maps = [
            stage.shadows.layer if isinstance(stage.shadows, ShadowSlot) else 0 for stage in stages
        ]
        self._scene_maps.set(self.street.scene_ids_end, scene_ids, np.array(maps))
        for skies in {
            id(stage.backdrop.skies): stage.backdrop.skies
            for stage in stages
            if isinstance(stage.backdrop, SkySlot)
        }.values():
            skies.set(scene_ids, parts)

    def _arrange_weather(self, pictures: Sequence[PictureOrder], shots: Shots) -> None:
        """Upload weather and lamps of the pictures that have these."""
        if all(one.stage.look is None for one in pictures):
            return
        self._weather.room(len(pictures))
        for i, (one, anchor) in enumerate(zip(pictures, shots.anchor, strict=True)):
            if (look := one.stage.look) is not None:
                lamps = one.stage.scene.lamps(one.taken.view, one.street.vehicles)
                people = casting_people(one.street.people, one.stage.surface, one.taken.view)
                self._weather.put(i, look, lamps, people, anchor, one.street.tick)
        self._weather.upload()

    def _cast(
        self, pictures: Sequence[PictureOrder], parts: Sequence[PictureRange], shots: Shots
    ) -> None:
        """Update the shadow maps of all pictures."""
        begun = set[int]()
        with casting(self._context):
            for part in parts:
                stage = pictures[part.first].stage
                if isinstance(stage.shadows, ShadowSlot):
                    maps = stage.shadows.maps
                    self._cast_layered(pictures, part, shots, maps, id(maps) not in begun)
                    begun.add(id(maps))
                elif stage.shadows is not None:
                    i = part.first
                    self._blocks.bind(i, sun=True)
                    draw = partial(self._draw_pass, part, stage)
                    stage.shadows.draw(shots.lattice[i], stage.light, draw)

    def _cast_layered(
        self,
        pictures: Sequence[PictureOrder],
        part: PictureRange,
        shots: Shots,
        maps: ShadowLayers,
        begins: bool,
    ) -> None:
        """Update the shadow maps of a part. begins: it is the first of the batch with these maps"""
        stage = pictures[part.first].stage
        self._blocks.bind_all(sun=True)
        wanted = {}
        number = {}
        for i in range(part.first, part.end):
            shadows = pictures[i].stage.shadows
            assert isinstance(shadows, ShadowSlot)
            wanted[shadows.layer] = shots.lattice[i][1:], shadows.to_sun
            number[shadows.layer] = i
        with maps.begin_still(wanted) as changed:
            self._scene_maps.bind(still=True)
            for layer in changed:
                one = PictureRange(part.number, number[layer], number[layer] + 1)
                self._draw_pass(one, stage, "still")
        self._scene_maps.bind()
        maps.begin_moving(len(pictures), begins)
        self._draw_pass(part, stage, "moving")

    def _together(
        self, pictures: Sequence[PictureOrder], parts: Sequence[PictureRange], size: tuple[int, int]
    ) -> Iterator[Sequence[PictureRange]]:
        """Split parts into those that are drawn together: pictures in a row with splats of the same
        cloud.
        """
        begun = 0
        most = self._pictures.most(size)
        for i in range(1, len(parts) + 1):
            cloud = pictures[parts[begun].first].stage.cloud
            alone = cloud is None or i - begun == most
            if i == len(parts) or alone or pictures[parts[i].first].stage.cloud is not cloud:
                yield parts[begun:i]
                begun = i

    def _draw_layered(
        self,
        pictures: Sequence[PictureOrder],
        parts: Sequence[PictureRange],
        size: tuple[int, int],
        sink: Sink,
        places: Sequence[int],
    ) -> None:
        """Draw the pictures of the first parts as layers. places: number of each of the batch"""
        flush()  # the graphics card starts people and shadow maps
        end = parts[-1].end
        target = self._layers.of(size, end)
        self._blocks.bind_all()
        self._scene_maps.bind()
        target.clear()
        for part in parts:
            stage = pictures[part.first].stage
            if isinstance(stage.shadows, ShadowSlot):
                stage.shadows.maps.bind()
            self._draw(part, stage, target)
        sink.take_layers(target, places[:end])

    def _draw_some(
        self, pictures: Sequence[PictureOrder], parts: Sequence[PictureRange], target: Target
    ) -> Iterator[int]:
        """Draw pictures that belong together into the target; yield the number of each.

        parts: one for each
        """
        start = parts[0].first
        first = pictures[start]
        cloud = first.stage.cloud
        if cloud is None:
            look = first.stage.look
            drawn = target if look is None else self._air.target(target.size)
            drawn.clear()
            self._bind(start, first)
            self._draw(parts[0], first.stage, drawn)
            if isinstance(drawn, LinearTarget) and look is not None:
                assert isinstance(first.stage.backdrop, Backdrop)
                self._air.draw(look.variant, drawn, first.stage.backdrop.sky, target)
            yield start
            return
        stack = self._pictures.stack(target.size, len(parts))
        self._pictures.draw(
            cloud,
            [pictures[part.first].taken for part in parts],
            stack,
            lambda nth, layers: self._draw_layers(parts[nth], pictures[parts[nth].first], layers),
        )
        for nth, part in enumerate(parts):
            picture = pictures[part.first]
            self._bind(part.first, picture)
            target.clear()
            self._context.enable_only(moderngl.DEPTH_TEST)
            self._pictures.compose(nth, picture.light, stack, target)
            self._context.enable_only(moderngl.DEPTH_TEST | moderngl.CULL_FACE)
            yield part.first

    def _bind(self, i: int, picture: PictureOrder) -> None:
        """Bind a picture's scene block and shadow maps."""
        if isinstance(picture.stage.shadows, ShadowMaps):
            picture.stage.shadows.bind()
        self._blocks.bind(i)
        if picture.stage.look is not None:
            self._weather.bind(i)
            picture.stage.scene.bind_lamps()

    def _draw(self, part: PictureRange, stage: Stage, target: Frame) -> None:
        """Draw a part without splats. Its blocks and shadow maps must be bound."""
        gl = self._context
        style = stage.scene.style
        gl.depth_func = "<"
        self._draw_pass(part, stage, "colour")
        # Paint and the shade at feet change colours only; labels and depth stay those of the ground.
        with polygon_offset(gl, -1.0, -8.0), masked(target.frame, only="colours"):
            self.street.draw_paint(part, style)
            with blending(gl):
                gl.blend_func = moderngl.DST_COLOR, moderngl.SRC_COLOR
                self.street.draw_decals(part, style)
            self._crowd.draw_contact(style.variant & Variant.LAYERS, part.number)
        gl.depth_func = "<="
        self._draw_sky(part, stage)
        # Glass shows what is behind it; its labels and depth are its own.
        with blending(gl), masked(target.frame, only="colours"):
            self.street.draw_panes(part, False, style)
        with masked(target.frame, only="labels"):
            self.street.draw_panes(part, True, style)

    def _draw_layers(self, part: PictureRange, picture: PictureOrder, layers: Layers) -> None:
        """Draw objects before the sky, and the scan's mesh apart, with the shade at feet."""
        gl = self._context
        self._bind(part.first, picture)
        gl.depth_func = "<"
        layers.objects.use()
        layers.objects.clear(depth=1.0)
        self._draw_pass(part, picture.stage, "colour")
        gl.depth_func = "<="
        self._draw_sky(part, picture.stage)
        layers.mesh.use()
        layers.mesh.clear(depth=1.0)
        gl.depth_func = "<"
        gl.enable_only(moderngl.DEPTH_TEST)
        self.street.draw_mesh(part, picture.stage.scene.style)
        layers.feet.use()
        layers.feet.clear(red=1.0)
        with polygon_offset(gl, -3.0, -8.0):
            self._crowd.draw_contact(0, part.number)
        gl.enable_only(moderngl.DEPTH_TEST | moderngl.CULL_FACE)

    def _draw_sky(self, part: PictureRange, stage: Stage) -> None:
        if isinstance(stage.backdrop, SkySlot):
            stage.backdrop.skies.draw(part)
        else:
            stage.backdrop.draw()

    def _draw_pass(self, part: PictureRange, stage: Stage, which: Pass) -> None:
        variant = stage.variant
        self._crowd.draw(which, variant, part.number)
        self.street.draw(part, which, stage.scene.style)
        self._traffic.draw(which, variant, part.number)


@lru_cache(maxsize=1)
def batch_drawing(context: moderngl.Context) -> BatchDrawing:
    """Return the context's single instance."""
    return BatchDrawing(context)


def _batches(pictures: Sequence[PictureOrder]) -> Iterator[Sequence[PictureOrder]]:
    """Split the pictures, in order, into batches.

    A batch holds at most PICTURES_MAX pictures and _PEOPLE_MAX people, and no stage twice. A
    picture with more people is a separate batch.
    """
    begun = 0
    people = 0
    stages = set[int]()
    for i, one in enumerate(pictures):
        people += len(one.street.people)
        full = i - begun == PICTURES_MAX or people > _PEOPLE_MAX
        if i > begun and (full or id(one.stage) in stages):
            yield pictures[begun:i]
            begun = i
            people = len(one.street.people)
            stages = set()
        stages.add(id(one.stage))
    if begun < len(pictures):
        yield pictures[begun:]


def _shared(picture: PictureOrder) -> object:
    """Return what pictures of one part have in common: the programs and textures of their layers.

    None for a picture that is not drawn as a layer.
    """
    stage = picture.stage
    if not isinstance(stage.backdrop, SkySlot):
        return None
    maps = stage.shadows.maps if isinstance(stage.shadows, ShadowSlot) else None
    return stage.scene.style, id(maps), id(stage.backdrop.skies)


def _order(pictures: Sequence[PictureOrder]) -> list[int]:
    """Return the order in which pictures are drawn: layers by part, then others by splats."""
    ranks: dict[object, int] = {}
    keys = []
    for one in pictures:
        shared = _shared(one)
        key = id(one.stage.cloud) if shared is None else shared
        keys.append((shared is None, ranks.setdefault(key, len(ranks))))
    return sorted(range(len(pictures)), key=keys.__getitem__)


def _parts(pictures: Sequence[PictureOrder]) -> list[PictureRange]:
    """Split a batch into parts: pictures in a row that share their programs, or single ones."""
    parts: list[PictureRange] = []
    last: object = None
    for i, one in enumerate(pictures):
        shared = _shared(one)
        if shared is not None and shared == last:
            parts[-1] = parts[-1]._replace(end=i + 1)
        else:
            parts.append(PictureRange(len(parts), i, i + 1))
        last = shared
    return parts
