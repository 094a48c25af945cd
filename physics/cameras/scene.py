"""Street around a point on a canvas: tiles, buildings, props, fences, signals, people, vehicles."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from cosim.core.clock import Clock
from cosim.core.geometry import Floats
from cosim.core.state import People, Street, Vehicles
from physics.cameras.canvas import BulletCanvas, Rigs
from physics.cameras.posture import Posture
from physics.cameras.view import (
    FORGET_M,
    PERSON_MARGIN_M,
    PROP_MARGIN_M,
    VEHICLE_MARGIN_M,
    VISIBLE_M,
    View,
)
from physics.dynamics.world import BulletWorld
from physics.ground.tiles import Key, tile_bounds, tile_distance, tiles_within
from physics.people.appearance import family_of
from physics.people.families import FAMILIES
from physics.people.parts import part_colours, part_meshes, placed_parts
from physics.robots import urdf_path
from physics.street import props, vehicles
from physics.street.buildings import FACADES, WINDOW_COLOUR, facade_meshes
from physics.street.furniture import KINDS, Prop, parts_of
from physics.street.scan_surface import posterized
from physics.street.surface import grounded_obstacles
from physics.textures.layers import Colour


@dataclass(frozen=True, slots=True)
class _TileBodies:
    """Bodies of a built tile.

    bodies: body -> its place (x, y, z and heading)
    posts: signals of the tile
    furniture: props with the heights of their feet
    furniture_xy: (N, 2) positions of the props
    seen_m: (N,) drawing distances of the props
    """

    bodies: dict[int, tuple[tuple[float, float, float], float]]
    posts: list[props.SignalPost]
    furniture: tuple[tuple[Prop, float], ...]
    furniture_xy: Floats
    seen_m: Floats


class BulletScene:
    """Street around a view on a canvas; the result depends on view and street alone.

    built: number of tiles built since the start
    """

    def __init__(self, canvas: BulletCanvas, world: BulletWorld) -> None:
        self._canvas = canvas
        self._surface = surface = world.surface
        self._model = world.robot
        self._tiles: dict[Key, _TileBodies] = {}
        self._shown: set[Key] = set()
        self.built = 0
        self._post = canvas.shape(props.post_mesh())
        self._walkers = {family: Rigs(canvas, part_meshes(family), "person") for family in FAMILIES}
        self._lamps = {
            walk: Rigs(canvas, [props.lamp_mesh(walk)], "signal") for walk in props.LAMPS
        }
        self._vehicles: dict[tuple[vehicles.Shape, float, float], Rigs] = {}
        self._furniture: dict[tuple[str, int, int], Rigs] = {}
        self._painted: dict[int, Colour] = {}
        self._robot = canvas.load(urdf_path(world.robot), "robot")
        self._obstacles = _with_furniture(
            {}, [], tuple(grounded_obstacles(world.obstacles, surface))
        )
        for barrier in world.barriers:
            size = (barrier.thickness_m, barrier.length_m)
            z = surface.foot(barrier.x_m, barrier.y_m, barrier.heading_rad, size)
            for part in props.barrier_parts(barrier):
                body = canvas.add(part.mesh, part.colour or props.PROP_RED, "barrier")
                canvas.put(body, (barrier.x_m, barrier.y_m, z), barrier.heading_rad)

    def arrange(self, view: View, street: Street) -> None:
        """Update the canvas to everything that this view can show, without the robot."""
        self._stream(view)
        self._show_people(view, street.people, Clock().time_s(street.tick))
        self._show_vehicles(view, street.vehicles)
        self._show_signals(street)
        self._show_furniture(view)
        self._canvas.put_away(self._robot)

    def show_robot(self, posture: Posture) -> None:
        """Place the robot's body, until the next `arrange`."""
        (x, y, z), roll, pitch, heading, angles = posture
        if angles:
            self._canvas.put_jointed(self._robot, (x, y, z), (roll, pitch, heading), angles)
            return
        h = self._model.com_height_m
        ahead = h * math.sin(pitch)
        x, y = x + ahead * math.cos(heading), y + ahead * math.sin(heading)
        self._canvas.put_turned(self._robot, (x, y, z + h), (roll, pitch, heading))

    def _stream(self, view: View) -> None:
        x, y = float(view.eye_m[0]), float(view.eye_m[1])
        for key in [k for k in self._tiles if tile_distance(k, x, y) > FORGET_M]:
            self._canvas.remove(list(self._tiles.pop(key).bodies))
            self._shown.discard(key)
        wanted = set(tiles_within(x, y, VISIBLE_M))
        for key in self._shown - wanted:
            for body in self._tiles[key].bodies:
                self._canvas.put_away(body)
        for key in tiles_within(x, y, VISIBLE_M):
            if key not in self._tiles:
                self._tiles[key] = self._built(key)
                self.built += 1
            if key not in self._shown:
                for body, (at, heading_rad) in self._tiles[key].bodies.items():
                    self._canvas.put(body, at, heading_rad)
        self._shown = wanted

    def _built(self, key: Key) -> _TileBodies:
        x0, y0, x1, y1 = tile_bounds(key)
        middle = np.array([0.5 * (x0 + x1), 0.5 * (y0 + y1), 0.0])
        chunk, posts = self._surface.chunk(key), self._surface.posts(key)
        if self._surface.scan is not None:
            parts = posterized(self._surface.scanned(key))
        else:
            patches = (*chunk.ground, *self._surface.covers(key))
            parts = [(patch.mesh, patch.colour, patch.label) for patch in patches]
        for facade, mesh in facade_meshes(chunk.buildings).items():
            parts.append((mesh, WINDOW_COLOUR if facade < 0 else FACADES[facade], "building"))
        at = (float(middle[0]), float(middle[1]), 0.0)
        bodies = {
            self._canvas.add(mesh.moved(-middle), colour, label): (at, 0.0)
            for mesh, colour, label in parts
            if len(mesh)
        }
        for post in posts:
            bodies[self._canvas.add(self._post, props.POLE, "signal")] = (
                self._foot(post),
                post.heading_rad,
            )
        return _with_furniture(bodies, posts, chunk.props)

    def _foot(self, post: props.SignalPost) -> tuple[float, float, float]:
        return post.x_m, post.y_m, float(self._surface.heights([[post.x_m, post.y_m]])[0])

    def _show_people(self, view: View, who: People, time_s: float) -> None:
        who = who.only(view.rows(who.xy, PERSON_MARGIN_M))
        parts = placed_parts(who, self._surface.heights(who.xy), time_s)
        for rigs in self._walkers.values():
            rigs.start()
        for name, age, at, turn in zip(
            who.ids, who.age.tolist(), parts.at_m.tolist(), parts.turn.tolist(), strict=True
        ):
            bodies = self._walkers[family_of(name, age)].lend()
            colours = part_colours(name, age, self._surface.seed)
            for k, (body, colour) in enumerate(zip(bodies, colours, strict=True)):
                self._canvas.put_at(body, at[k], turn[k])
                if self._painted.get(body) != colour:
                    self._painted[body] = colour
                    self._canvas.paint(body, colour)
        for rigs in self._walkers.values():
            rigs.finish()

    def _show_vehicles(self, view: View, which: Vehicles) -> None:
        for rigs in self._vehicles.values():
            rigs.start()
        rows = view.rows(which.xy, VEHICLE_MARGIN_M)
        leans = self._surface.road(which.xy[rows], which.heading[rows], which.size[rows]).tolist()
        for i, (z, roll, pitch) in zip(rows.tolist(), leans, strict=True):
            length, width = (round(float(side), 1) for side in which.size[i])
            form = vehicles.vehicle_shape(which.ids[i], length), length, width
            parts = vehicles.vehicle_parts(*form)
            if form not in self._vehicles:
                self._vehicles[form] = Rigs(self._canvas, [part.mesh for part in parts], "vehicle")
            paint = vehicles.vehicle_colour(which.ids[i])
            at = (float(which.xy[i, 0]), float(which.xy[i, 1]), z)
            for body, part in zip(self._vehicles[form].lend(), parts, strict=True):
                if roll or pitch:
                    self._canvas.put_turned(body, at, (roll, pitch, float(which.heading[i])))
                else:
                    self._canvas.put(body, at, float(which.heading[i]))
                self._canvas.paint(body, part.colour or paint)
        for rigs in self._vehicles.values():
            rigs.finish()

    def _show_signals(self, street: Street) -> None:
        for rigs in self._lamps.values():
            rigs.start()
        for key in sorted(self._shown):
            for post in self._tiles[key].posts:
                if post.crossing in street.signals:
                    walk = street.signals[post.crossing].walk
                    (lamp,) = self._lamps[walk].lend()
                    self._canvas.put(lamp, self._foot(post), post.heading_rad)
                    self._canvas.paint(lamp, props.LAMPS[walk])
        for rigs in self._lamps.values():
            rigs.finish()

    def _show_furniture(self, view: View) -> None:
        """Assign pooled bodies to the props in view and in range, as for people."""
        for rigs in self._furniture.values():
            rigs.start()
        for tile in (*(self._tiles[key] for key in sorted(self._shown)), self._obstacles):
            if not tile.furniture:
                continue
            rows = view.rows(tile.furniture_xy, PROP_MARGIN_M)
            gap = np.hypot(*(tile.furniture_xy[rows] - view.eye_m[:2]).T)
            for i in rows[gap < tile.seen_m[rows]].tolist():
                prop, z = tile.furniture[i]
                form = prop.form
                parts = parts_of(*form)
                if form not in self._furniture:
                    self._furniture[form] = Rigs(
                        self._canvas, [part.mesh for part in parts], "prop"
                    )
                for body, part in zip(self._furniture[form].lend(), parts, strict=True):
                    self._canvas.put(body, (prop.x_m, prop.y_m, z), prop.drawn_heading_rad)
                    colour = part.colour or KINDS[prop.kind].paints[prop.paint]
                    if self._painted.get(body) != colour:
                        self._painted[body] = colour
                        self._canvas.paint(body, colour)
        for rigs in self._furniture.values():
            rigs.finish()


def _with_furniture(
    bodies: dict[int, tuple[tuple[float, float, float], float]],
    posts: list[props.SignalPost],
    furniture: tuple[tuple[Prop, float], ...],
) -> _TileBodies:
    xy = np.array([(prop.x_m, prop.y_m) for prop, _ in furniture]).reshape(-1, 2)
    return _TileBodies(
        bodies, posts, furniture, xy, np.array([KINDS[prop.kind].seen_m for prop, _ in furniture])
    )
