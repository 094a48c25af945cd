"""The street around a view for the gl camera: the same things as in physics.cameras.scene, as buffers and instances."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Final

import moderngl
import numpy as np
from numpy.typing import NDArray

from cosim.core.clock import Clock
from cosim.core.geometry import Floats
from cosim.core.state import LABELS, RobotState, Street, Vehicles
from cosim.spec.robot import Robot
from cosim.spec.scenario import Barrier
from physics.cameras.gl.corners import CornerRows
from physics.cameras.gl.crowd import CrowdDrawing
from physics.cameras.gl.instances import INSTANCE, Forms, Things, instances
from physics.cameras.gl.lighting import Lighting
from physics.cameras.gl.robot_body import robot_parts
from physics.cameras.gl.shading import Pass
from physics.cameras.gl.shadows import SHADOW_REACH_M, STEP_M, middle_of
from physics.cameras.gl.surfaces import TileBuffers, surfaces
from physics.cameras.gl.tiles import ground_buffers, tile_shaders
from physics.cameras.gl.walls import wall_buffers, wall_shaders
from physics.cameras.view import FORGET_M, PERSON_MARGIN_M, PROP_MARGIN_M, VEHICLE_MARGIN_M, VISIBLE_M, Shot, View
from physics.robots import urdf_of
from physics.street import props, vehicles
from physics.street.furniture import KINDS, Prop, parts_of
from physics.textures.layers import Colour
from physics.world.bullet import p
from physics.world.mesh import Part
from physics.world.surface import Surface
from physics.world.tiles import Key, distance_to, distances_within, keys_within, square

CAST_M: Final = 18.0
"""How far from the eye people throw shadows."""
_TILE_REACH_M: Final = 34.0
"""A tile's farthest point from its middle, and what stands over its border."""

_Placed = tuple[NDArray[np.int64], CornerRows]
"""Numbers of forms and rows of instances."""
_CLOCK: Final = Clock()
_NOTHING: Final[_Placed] = (np.zeros(0, dtype=np.int64), np.zeros(0, dtype=INSTANCE))


@dataclass(frozen=True, slots=True)
class _Tile:
    """A tile on the graphics card, its (2,) middle in world metres, and the things that stand in it, at (N, 2)
    thing_xy, drawn as far as (N,) seen_m; their rows are relative to the middle."""

    middle: Floats
    ground: TileBuffers
    paint: TileBuffers
    walls: TileBuffers
    things: _Placed
    thing_xy: Floats
    seen_m: Floats
    posts: list[props.SignalPost]
    post_z: Floats

    def release(self) -> None:
        for buffers in (self.ground, self.paint, self.walls):
            buffers.release()


class GlScene:
    """Keeps what the street around a view needs; what is drawn depends on view and street alone."""

    def __init__(
        self, context: moderngl.Context, surface: Surface, barriers: Sequence[Barrier], model: Robot, light: Lighting
    ) -> None:
        self._context, self._surface, self._model = context, surface, model
        self._tiles: dict[Key, _Tile] = {}
        self._shadows = shadows = light.shadows
        self._surfaces = surfaces(context)
        self._shaders = tile_shaders(context, self._surfaces, shadows)
        self._wall_shaders = wall_shaders(context, self._surfaces, shadows, light.lamps > 0.0)
        self._forms = Forms(context, self._surfaces, shadows)
        self._seen = Things(context, self._forms, ("colour",))
        self._standing = Things(context, self._forms, ("still",))
        self._movers = Things(context, self._forms, ("moving",))
        self._still_for: tuple[float, ...] | None = None
        self._shading: list[_Tile] = []
        self._keys: list[Key] = []
        self._anchor: Floats = np.zeros(2)
        self._stands_for: tuple[frozenset[Key], Floats] | None = None
        self._stands: _Placed = _NOTHING
        self._stands_xy: Floats = np.zeros((0, 2))
        self._stands_seen_m: Floats = np.zeros(0)
        self._posts: list[tuple[props.SignalPost, float]] = []
        self._lit_for: list[bool | None] = []
        self._lit: _Placed = _NOTHING
        self._around: list[_Tile] = []
        self._middles: Floats = np.zeros((0, 2))
        self._in_view: list[_Tile] = []
        self._fences = [self._fence(barrier) for barrier in barriers]
        self._fence_xy = np.array([(b.x_m, b.y_m) for b in barriers]).reshape(-1, 2)
        self._fleet: dict[tuple[str, float, float], tuple[int, Colour]] = {}
        self._crowd = CrowdDrawing(context, shadows)

    def arrange(self, shot: Shot, anchor: Floats, street: Street, robot: RobotState | None, body: bool) -> None:
        """Hold everything that a picture can show. body: the robot itself is in the picture, not its shadow alone."""
        view = shot.view
        if (anchor != self._anchor).any():
            self._anchor = anchor
        self._stream(view)
        self._show_people(shot, street)
        middle = middle_of(view.eye_m)
        seen, cast = self._vehicles(view, middle, street.vehicles)
        placed = [self._things(view), *self._fences_now(), self._lamps(street), seen]
        myself = self._robot(robot) if robot is not None and (body or self._shadows) else _NOTHING
        _set(self._seen, [*placed, myself] if body else placed)
        if self._shadows:
            _set(self._movers, [cast, myself])
            self._stand(middle)

    def _show_people(self, shot: Shot, street: Street) -> None:
        """Those who can be in the picture, and those whose shadows can."""
        xy = street.people.xy
        seen = shot.view.sees(xy, PERSON_MARGIN_M)
        casts = _near(xy, shot.eye_m, CAST_M)
        rows = (seen | casts if self._shadows else seen).nonzero()[0]
        who = street.people.only(rows)
        z = self._surface.heights(who.xy)
        self._crowd.set(who, _CLOCK.time_s(street.tick), z, shot, self._anchor, seen[rows], casts[rows])

    def _stand(self, middle: Floats) -> None:
        """What stands and throws shadows in the square around its middle, seen or not."""
        still = (*middle.tolist(), *self._anchor.tolist())
        if still != self._still_for:
            keys = keys_within(float(middle[0]), float(middle[1]), VISIBLE_M - STEP_M)
            self._shading = [self._tiles[key] for key in keys]
            rows = [self._shifted(tile, np.arange(len(tile.thing_xy))) for tile in self._shading]
            _set(self._standing, [*rows, *self._fences_now()])
            self._still_for = still

    def draw(self, stage: Pass) -> None:
        """Draw what was arranged: the small and near first, then the ground from near to far."""
        self._crowd.draw(stage)
        if stage == "colour":
            self._surfaces.bind()
        for things in (self._seen, self._standing, self._movers):
            things.draw(stage)
        if stage != "moving":
            for tile in self._in_view if stage == "colour" else self._shading:
                tile.walls.draw(stage, self._anchor)
                tile.ground.draw(stage, self._anchor)

    def draw_paint(self) -> None:
        """Draw what lies on the ground; to be drawn after it, without labels and depth."""
        for tile in self._in_view:
            tile.paint.draw("colour", self._anchor)

    def release(self) -> None:
        for tile in self._tiles.values():
            tile.release()
        self._tiles.clear()
        for things in (self._seen, self._standing, self._movers):
            things.release()
        self._crowd.release()
        self._forms.release()

    def _stream(self, view: View) -> None:
        x, y = float(view.eye_m[0]), float(view.eye_m[1])
        keys = [key for _, key in sorted(distances_within(x, y, VISIBLE_M))]
        if keys != self._keys:
            for key in [k for k in self._tiles if distance_to(k, x, y) > FORGET_M]:
                self._tiles.pop(key).release()
            for key in keys:
                if key not in self._tiles:
                    self._tiles[key] = self._built(key)
            self._keys, self._around = keys, [self._tiles[key] for key in keys]
            self._middles = np.array([tile.middle for tile in self._around])
        self._in_view = [self._around[i] for i in view.sees(self._middles, _TILE_REACH_M, math.inf).nonzero()[0]]

    def _built(self, key: Key) -> _Tile:
        x0, y0, x1, y1 = square(key)
        middle = np.array([0.5 * (x0 + x1), 0.5 * (y0 + y1)])
        chunk, finish, posts = self._surface.chunk(key), self._surface.finish(key), self._surface.posts(key)
        ground = ground_buffers(self._context, self._shaders, (*finish.laid, *chunk.ground), middle)
        painted = ground_buffers(self._context, self._shaders, finish.painted, middle)
        walls = wall_buffers(self._context, self._wall_shaders, chunk.buildings, finish.styles, middle)
        post_xy = np.array([(post.x_m, post.y_m) for post in posts]).reshape(-1, 2)
        post_z = self._surface.heights(post_xy)
        furniture = chunk.props
        form = [self._prop_form(prop) for prop, _ in furniture]
        xyz = np.array([(prop.x_m - middle[0], prop.y_m - middle[1], z) for prop, z in furniture]).reshape(-1, 3)
        paint = np.array([KINDS[prop.kind].paints[prop.paint] for prop, _ in furniture]).reshape(-1, 3)
        rows = instances(xyz, [prop.drawn_rad for prop, _ in furniture], paint, LABELS["prop"])
        pole = self._forms.id(("signal", "post"), lambda: [Part(props.post_mesh(), props.POLE)])
        headings = [post.heading_rad for post in posts]
        poles = instances(np.column_stack([post_xy - middle, post_z]), headings, props.POLE, LABELS["signal"])
        things = np.array([*form, *[pole] * len(posts)], dtype=np.int64), np.concatenate([rows, poles])
        seen_m = np.array([*(KINDS[prop.kind].seen_m for prop, _ in furniture), *[math.inf] * len(posts)])
        thing_xy = np.concatenate([xyz[:, :2] + middle, post_xy])
        return _Tile(middle, ground, painted, walls, things, thing_xy, seen_m, posts, post_z)

    def _prop_form(self, prop: Prop) -> int:
        return self._forms.id(
            ("prop", *prop.form),
            lambda: parts_of(*prop.form),
        )

    def _things(self, view: View) -> _Placed:
        """What stands in the tiles around, as far as it is drawn."""
        keys = frozenset(self._keys)
        if self._stands_for is None or self._stands_for[0] != keys or self._stands_for[1] is not self._anchor:
            tiles = [self._tiles[key] for key in sorted(keys)]
            placed = [self._shifted(tile, np.arange(len(tile.thing_xy))) for tile in tiles]
            self._stands = np.concatenate([form for form, _ in placed]), np.concatenate([rows for _, rows in placed])
            self._stands_xy = np.concatenate([tile.thing_xy for tile in tiles])
            self._stands_seen_m = np.concatenate([tile.seen_m for tile in tiles])
            self._posts = [one for tile in tiles for one in zip(tile.posts, tile.post_z.tolist(), strict=True)]
            self._stands_for, self._lit_for = (keys, self._anchor), []
        rows = view.rows(self._stands_xy, PROP_MARGIN_M)
        rows = rows[_near(self._stands_xy[rows], view.eye_m, self._stands_seen_m[rows])]
        form, things = self._stands
        return form[rows], things[rows]

    def _shifted(self, tile: _Tile, rows: NDArray[np.intp]) -> _Placed:
        form, things = tile.things
        here = things[rows]
        here["at"][:, :2] += tile.middle - self._anchor
        return form[rows], here

    def _fence(self, barrier: Barrier) -> _Placed:
        z = self._surface.foot(barrier.x_m, barrier.y_m, barrier.heading_rad, (barrier.thickness_m, barrier.length_m))
        red, white = props.barrier_meshes(barrier)
        size = (barrier.length_m, barrier.height_m, barrier.thickness_m)
        form = self._forms.id(("barrier", *size), lambda: [Part(red, props.PROP_RED), Part(white, props.PROP_WHITE)])
        rows = instances((barrier.x_m, barrier.y_m, z), barrier.heading_rad, props.PROP_RED, LABELS["barrier"])
        return np.array([form]), rows

    def _fences_now(self) -> list[_Placed]:
        placed = []
        for (form, rows), xy in zip(self._fences, self._fence_xy, strict=True):
            here = rows.copy()
            here["at"][:, :2] = xy - self._anchor
            placed.append((form, here))
        return placed

    def _lamps(self, street: Street) -> _Placed:
        """The lit lamp of every signal whose state is known; after `_things`."""
        signals = street.signals
        shown = [signals[post.crossing].walk if post.crossing in signals else None for post, _ in self._posts]
        if shown != self._lit_for:
            self._lit_for, self._lit = shown, self._lamps_showing(shown)
        return self._lit

    def _lamps_showing(self, shown: list[bool | None]) -> _Placed:
        lit = {walk: self._forms.id(("signal", walk), partial(_lamp, walk)) for walk in props.LAMPS}
        forms, at, heading, paint = [], [], [], []
        for (post, z), walk in zip(self._posts, shown, strict=True):
            if walk is not None:
                forms.append(lit[walk])
                at.append((post.x_m - self._anchor[0], post.y_m - self._anchor[1], z))
                heading.append(post.heading_rad)
                paint.append(props.LAMPS[walk])
        if not forms:
            return _NOTHING
        return np.array(forms), instances(at, heading, paint, LABELS["signal"])

    def _vehicles(self, view: View, middle: Floats, which: Vehicles) -> tuple[_Placed, _Placed]:
        """Vehicles in the picture, and those that throw shadows in the square around its middle."""
        seen = view.sees(which.xy, VEHICLE_MARGIN_M)
        casts = _near(which.xy, middle, SHADOW_REACH_M)
        rows = (seen | casts if self._shadows else seen).nonzero()[0]
        if not len(rows):
            return _NOTHING, _NOTHING
        forms, paints = zip(*(self._vehicle_form(which.ids[i], *which.size[i].tolist()) for i in rows), strict=True)
        xy, heading, form = which.xy[rows], which.heading[rows], np.array(forms)
        lean = self._surface.road(xy, heading, which.size[rows])
        placed = instances(np.column_stack([xy - self._anchor, lean[:, 0]]), heading, paints, LABELS["vehicle"])
        if lean.any():
            placed["turn"] = [
                p.getQuaternionFromEuler((*turn, h)) for turn, h in zip(lean[:, 1:], heading, strict=True)
            ]
        seen, casts = seen[rows], casts[rows]
        return (form[seen], placed[seen]), (form[casts], placed[casts])

    def _vehicle_form(self, name: str, length_m: float, width_m: float) -> tuple[int, Colour]:
        """The form of a vehicle, and its paint."""
        key = name, length_m, width_m
        if key not in self._fleet:
            size = tuple(np.array([length_m, width_m]).round(1).tolist())
            shape = vehicles.shape(name, size[0])
            form = self._forms.id(("vehicle", shape, *size), partial(vehicles.vehicle_parts, shape, *size))
            self._fleet[key] = form, vehicles.paint(name)
        return self._fleet[key]

    def _robot(self, robot: RobotState) -> _Placed:
        """The robot with its base frame at its pose, leaning with the ground."""
        form = self._forms.id(("robot", self._model.name), partial(robot_parts, urdf_of(self._model)))
        _, roll, pitch = self._surface.lean(robot.pose, self._model.drive.span_m)
        rows = instances((robot.pose.x_m, robot.pose.y_m, robot.z_m), 0.0, (1.0, 1.0, 1.0), LABELS["robot"])
        rows["at"][:, :2] = np.array([robot.pose.x_m, robot.pose.y_m]) - self._anchor
        rows["turn"] = p.getQuaternionFromEuler((roll, pitch, robot.pose.heading_rad))
        return np.array([form]), rows


def _lamp(walk: bool) -> list[Part]:
    return [Part(props.lamp_mesh(walk), glows=True)]


def _set(things: Things, placed: Sequence[_Placed]) -> None:
    things.set(np.concatenate([form for form, _ in placed]), np.concatenate([rows for _, rows in placed]))


def _near(xy: Floats, middle: Floats, reach_m: float | Floats) -> NDArray[np.bool_]:
    """Which of (N, 2) points are less than so far from the first two of `middle`."""
    return np.asarray(np.hypot(xy[:, 0] - middle[0], xy[:, 1] - middle[1]) < reach_m)
