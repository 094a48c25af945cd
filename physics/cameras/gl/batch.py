"""Batches of pictures of any number of environments.

Moving objects of all pictures are posed, culled and uploaded together, and splats of one scan are
drawn together. Triangles of each picture are drawn separately. Bits do not depend on the batch.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import lru_cache, partial
from typing import Final, NamedTuple

import moderngl

from cosim.core.clock import Clock
from cosim.core.geometry import Floats
from cosim.core.state import RobotState, Street
from cosim.spec.robot import Robot
from physics.cameras.gl.backdrop import Backdrop
from physics.cameras.gl.crowd import CrowdDrawing, PeopleSeen
from physics.cameras.gl.instances import Forms
from physics.cameras.gl.lighting import Lighting
from physics.cameras.gl.scene import GlScene
from physics.cameras.gl.shading import Pass, SceneBlocks, camera_matrix
from physics.cameras.gl.shadows import TO_TEXTURE, ShadowMaps, casting
from physics.cameras.gl.shots import Shots
from physics.cameras.gl.splat_layers import Layers, splat_pictures
from physics.cameras.gl.splats import SplatCloud
from physics.cameras.gl.surfaces import surfaces
from physics.cameras.gl.targets import Target
from physics.cameras.gl.traffic import Driven, TrafficDrawing
from physics.cameras.view import Shot
from physics.street.surface import Surface

_CLOCK: Final = Clock()
_PEOPLE_MAX: Final = 4096
"""Maximum number of people in a batch; a picture with more is a separate batch."""


class Stage(NamedTuple):
    """Resources of a camera: street scene, optional shadow maps, backdrop, light.

    cloud: splats of the place, None without
    """

    surface: Surface
    model: Robot
    scene: GlScene
    shadows: ShadowMaps | None
    backdrop: Backdrop
    light: Lighting
    cloud: SplatCloud | None = None


class PictureOrder(NamedTuple):
    """Request for a picture.

    light: as this view sees it
    robot: None without a robot
    body: the robot's body is drawn in the picture itself, not only its shadow
    """

    stage: Stage
    taken: Shot
    light: Lighting
    street: Street
    robot: RobotState | None
    body: bool


class BatchDrawing:
    """Drawing of batches; one instance per context, with the same lifetime."""

    def __init__(self, context: moderngl.Context) -> None:
        self._context = context
        self._surfaces = surfaces(context)
        self.forms = Forms(context, self._surfaces)
        self._crowd, self._traffic = CrowdDrawing(context), TrafficDrawing(context, self.forms)
        self._blocks = SceneBlocks(context)
        self._pictures = splat_pictures(context)

    def draw(
        self, pictures: Sequence[PictureOrder], target: Target, drawn: Callable[[int], None]
    ) -> None:
        """Draw each picture into the target.

        drawn: called with the picture's number before the next one is drawn

        The caller must hold the context.
        """
        first = 0
        for few in _batches(pictures):
            shots = self._arrange(few)
            self._surfaces.bind()
            self._cast(few, shots)
            self._context.enable_only(moderngl.DEPTH_TEST | moderngl.CULL_FACE)
            self._context.front_face = "cw"  # draw upside down, to read the top row first
            for start, some in self._together(few, target.size):
                for i in self._draw_some(start, some, target):
                    drawn(first + i)
            first += len(few)

    def _arrange(self, pictures: Sequence[PictureOrder]) -> Shots:
        shots = Shots([one.taken for one in pictures])
        for one, middle, anchor in zip(pictures, shots.middles, shots.anchors, strict=True):
            one.stage.scene.arrange(one.taken.view, middle, anchor, one.street)
        watched = []
        driven = []
        for stage, _, _, street, robot, body in pictures:
            surface = stage.surface
            shadows = stage.shadows is not None
            watched.append(
                PeopleSeen(
                    street.people,
                    _CLOCK.time_s(street.tick),
                    surface.heights,
                    shadows,
                    surface.seed,
                )
            )
            driven.append(Driven(street.vehicles, surface, stage.model, robot, body, shadows))
        self._crowd.set(watched, shots)
        self._traffic.set(driven, shots)
        self._blocks.room(2 * len(pictures))
        for i, (one, middle, anchor) in enumerate(
            zip(pictures, shots.middles, shots.anchors, strict=True)
        ):
            to_map: Floats = TO_TEXTURE
            if one.stage.shadows is not None:
                from_sun, to_map = one.stage.shadows.matrices(middle, anchor, one.stage.light)
                self._blocks.put_sun(2 * i + 1, from_sun, one.stage.light)
            self._blocks.put(
                2 * i, camera_matrix(one.taken, anchor), to_map, one.taken, anchor, one.light
            )
        self._blocks.upload()
        return shots

    def _cast(self, pictures: Sequence[PictureOrder], shots: Shots) -> None:
        """Update the shadow maps of all pictures."""
        with casting(self._context):
            for i, (one, middle, anchor) in enumerate(
                zip(pictures, shots.middles, shots.anchors, strict=True)
            ):
                if one.stage.shadows is not None:
                    self._blocks.bind(2 * i + 1)
                    draw = partial(self._draw_pass, i, one.stage)
                    one.stage.shadows.draw(middle, anchor, one.stage.light, draw)

    def _together(
        self, pictures: Sequence[PictureOrder], size: tuple[int, int]
    ) -> Iterator[tuple[int, Sequence[PictureOrder]]]:
        """Split pictures into those that are drawn together, with the number of the first.

        These are pictures in a row with splats of the same cloud.
        """
        begun = 0
        most = self._pictures.most(size)
        for i in range(1, len(pictures) + 1):
            cloud = pictures[begun].stage.cloud
            alone = cloud is None or i - begun == most
            if i == len(pictures) or alone or pictures[i].stage.cloud is not cloud:
                yield begun, pictures[begun:i]
                begun = i

    def _draw_some(
        self, start: int, pictures: Sequence[PictureOrder], target: Target
    ) -> Iterator[int]:
        """Draw pictures that belong together into the target; yield the number of each.

        start: number of the first
        """
        cloud = pictures[0].stage.cloud
        if cloud is None:
            target.clear()
            self._draw(start, pictures[0], target)
            yield start
            return
        stack = self._pictures.stack(target.size, len(pictures))
        self._pictures.draw(
            cloud,
            [one.taken for one in pictures],
            stack,
            lambda nth, layers: self._draw_layers(start + nth, pictures[nth], layers),
        )
        for nth, picture in enumerate(pictures):
            self._bind(start + nth, picture)
            target.clear()
            self._context.enable_only(moderngl.DEPTH_TEST)
            self._pictures.compose(nth, picture.light, stack, target)
            self._context.enable_only(moderngl.DEPTH_TEST | moderngl.CULL_FACE)
            yield start + nth

    def _bind(self, i: int, picture: PictureOrder) -> None:
        """Bind a picture's scene block and shadow maps."""
        if picture.stage.shadows is not None:
            picture.stage.shadows.bind()
        self._blocks.bind(2 * i)

    def _draw(self, i: int, picture: PictureOrder, target: Target) -> None:
        """Draw a picture without splats."""
        gl = self._context
        stage = picture.stage
        self._bind(i, picture)
        gl.depth_func = "<"
        self._draw_pass(i, stage, "colour")
        # Paint changes colours only; labels and depth stay those of the ground.
        gl.polygon_offset = -1.0, -8.0
        with target.only("colours"):
            stage.scene.draw_paint()
            gl.enable(moderngl.BLEND)
            gl.blend_func = moderngl.DST_COLOR, moderngl.SRC_COLOR
            stage.scene.draw_decals()
            gl.blend_func = moderngl.SRC_ALPHA, moderngl.ONE_MINUS_SRC_ALPHA
            gl.disable(moderngl.BLEND)
        gl.polygon_offset = 0.0, 0.0
        gl.depth_func = "<="
        stage.backdrop.draw()
        # Glass shows what is behind it; its labels and depth are its own.
        gl.enable(moderngl.BLEND)
        with target.only("colours"):
            stage.scene.draw_panes(labels=False)
        gl.disable(moderngl.BLEND)
        with target.only("labels"):
            stage.scene.draw_panes(labels=True)

    def _draw_layers(self, i: int, picture: PictureOrder, layers: Layers) -> None:
        """Draw objects before the sky, and the scan's mesh apart."""
        gl = self._context
        self._bind(i, picture)
        gl.depth_func = "<"
        layers.objects.use()
        layers.objects.clear(depth=1.0)
        self._draw_pass(i, picture.stage, "colour")
        gl.depth_func = "<="
        picture.stage.backdrop.draw()
        layers.mesh.use()
        layers.mesh.clear(depth=1.0)
        gl.depth_func = "<"
        gl.enable_only(moderngl.DEPTH_TEST)
        picture.stage.scene.draw_mesh()
        gl.enable_only(moderngl.DEPTH_TEST | moderngl.CULL_FACE)

    def _draw_pass(self, i: int, stage: Stage, which: Pass) -> None:
        shaded = stage.shadows is not None
        self._crowd.draw(which, shaded, i)
        stage.scene.draw(which)
        self._traffic.draw(which, shaded, i)


@lru_cache(maxsize=1)
def batch_drawing(context: moderngl.Context) -> BatchDrawing:
    """Return the context's single instance."""
    return BatchDrawing(context)


def _batches(pictures: Sequence[PictureOrder]) -> Iterator[Sequence[PictureOrder]]:
    """Split the pictures, in order, into batches.

    A batch holds at most _PEOPLE_MAX people, and no stage twice. A picture with more people is a
    separate batch.
    """
    begun = 0
    people = 0
    stages = set[int]()
    for i, one in enumerate(pictures):
        people += len(one.street.people)
        if i > begun and (people > _PEOPLE_MAX or id(one.stage) in stages):
            yield pictures[begun:i]
            begun = i
            people = len(one.street.people)
            stages = set()
        stages.add(id(one.stage))
    if begun < len(pictures):
        yield pictures[begun:]
