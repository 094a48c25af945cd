"""Meshes of barriers and pedestrian signals, and the positions of signals."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import shapely

from cosim.core.geometry import Polyline
from cosim.place.street_map import StreetMap, Strip
from cosim.spec.scenario import Barrier
from physics.ground.mesh import Mesh, Part, box, join
from physics.ground.tiles import Key, grown_box, tile_at, tile_bounds

PROP_RED: Final = (0.82, 0.10, 0.09)
PROP_WHITE: Final = (0.93, 0.93, 0.91)
_STEEL: Final = (0.78, 0.79, 0.80)
POLE: Final = (0.22, 0.24, 0.25)
LAMPS: Final = {True: (0.10, 0.85, 0.35), False: (0.95, 0.12, 0.08)}
"""sRGB colour of the lit lamp: True is walk, False is stop."""

_BOARD_M: Final = 0.35
"""Length in metres of the red and white fields of a barrier."""


def barrier_parts(barrier: Barrier) -> tuple[Part, ...]:
    """Return a barrier about its foot, blocking the x direction: red, white and posts."""
    count = max(2 * round(barrier.length_m / _BOARD_M / 2.0) + 1, 3)
    step = barrier.length_m / count
    red: list[Mesh] = []
    white: list[Mesh] = []
    posts: list[Mesh] = []
    # Red above white, and posts away from the ends: detectors take an end of equal fields on a post
    # for a person.
    for first, (low, high) in enumerate(((0.45, 0.68), (0.77, 1.0))):
        height = (high - low) * barrier.height_m
        for k in range(count):
            centre = (
                0.0,
                (k + 0.5) * step - 0.5 * barrier.length_m,
                0.5 * (low + high) * barrier.height_m,
            )
            board = box((0.5 * barrier.thickness_m, step, height), centre, skip=("left", "right"))
            (red if (k + first) % 2 == 0 else white).append(board)
    for side in (-1, 1):
        y = side * (0.5 * barrier.length_m - min(0.45, 0.2 * barrier.length_m))
        posts.append(box((0.05, 0.05, 0.9 * barrier.height_m), (0.0, y, 0.45 * barrier.height_m)))
        posts.append(box((4.0 * barrier.thickness_m, 0.10, 0.06), (0.0, y, 0.03)))
    return tuple(
        Part(join(meshes), colour)
        for meshes, colour in ((red, PROP_RED), (white, PROP_WHITE), (posts, _STEEL))
    )


@dataclass(frozen=True, slots=True)
class SignalPost:
    """A pedestrian signal at one end of a crossing that faces the crossing."""

    crossing: str
    x_m: float
    y_m: float
    heading_rad: float


def signals_in_tile(street_map: StreetMap, key: Key) -> list[SignalPost]:
    """Return the pedestrian signals in a tile."""
    strips = street_map.near("strip", grown_box(tile_bounds(key), 5.0))
    crossings = [s for s in strips if isinstance(s, Strip) and s.signalised]
    posts = [post for s in crossings for post in signal_posts(street_map, s)]
    return [post for post in posts if tile_at(post.x_m, post.y_m) == key]


def signal_posts(street_map: StreetMap, crossing: Strip) -> tuple[SignalPost, SignalPost]:
    """Return the signals at both ends of a crossing.

    A signal is at the curb next to the crossing: on the right in walking direction, or on the left
        if only that side is not walkable.
    """
    line = Polyline(crossing.line)
    first, second = (
        _signal_post(street_map, crossing, Polyline(points))
        for points in (line.points, line.points[::-1])
    )
    return first, second


def _signal_post(street_map: StreetMap, crossing: Strip, line: Polyline) -> SignalPost:
    x, y, heading = line.at(line.length_m)
    cos, sin = math.cos(heading), math.sin(heading)
    aside = 0.5 * crossing.width_m + 0.3
    back = 0.15
    places = [
        (x - back * cos + side * aside * sin, y - back * sin - side * aside * cos)
        for side in (1, -1)
    ]
    free = [at for at in places if not _walkable(street_map, at)]
    return SignalPost(crossing.id, *(free or places)[0], heading + math.pi)


def _walkable(street_map: StreetMap, at: tuple[float, float]) -> bool:
    spot = shapely.Point(at).buffer(0.1)
    return bool(street_map.near("strip", spot) or street_map.near("corner", spot))


def post_mesh() -> Mesh:
    """Return pole and housing of a signal; the face is towards +x."""
    return join(
        [
            box((0.08, 0.08, 2.2), (0.0, 0.0, 1.1), skip=("bottom",)),
            box((0.14, 0.30, 0.62), (0.03, 0.0, 2.4)),
        ]
    )


def lamp_mesh(walk: bool) -> Mesh:
    """Return the lit lamp of a signal: red at the top, green at the bottom."""
    return box((0.03, 0.24, 0.24), (0.11, 0.0, 2.27 if walk else 2.54), skip=("back",))
