"""Spots where pedestrians can sit on a bench, look into a shop window or wait at a shelter.

A spot gives the position and heading of a person. The caller checks whether the person fits there.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import Final, Literal, NamedTuple

import shapely

from cosim.core.geometry import wrap_angle
from cosim.core.state import PERSON_RADIUS_M
from cosim.place.street_map import Lane, StreetMap
from physics.street.building_style import WINDOW_WALL_MIN_M, building_appearance, wall_style_of
from physics.street.buildings import Building
from physics.street.covers import has_paved_frontage
from physics.street.furniture import Prop
from physics.textures.facade_canvas import BAY_M

SpotKind = Literal["bench", "window", "stop"]

_SEAT_FRONT_M: Final = PERSON_RADIUS_M + 0.05
"""Distance in metres from the edge of a bench to a seated person's position, which is at the legs.

See `physics.people.gestures.SEATED_BACK_M`.
"""
_SEAT_M: Final = 0.36
"""Distance in metres from the centre of a bench to the centre of each of its two seats."""
_SHELTER_GAP_M: Final = 0.45
"""Distance in metres from a shelter's open side to waiting people."""

_WINDOW_M: Final = (0.8, 0.55, 1.2, 1.6, 2.0, 2.3)
"""Viewing distances from a shop window in metres, best first."""
_ROAD_M: Final = 30.0
"""Search radius in metres for the road that people at a shelter watch."""

_SHOP_BAYS = ("shop-window", "cafe")
"""Ground-floor bays that are shop windows."""


class ShopWindow(NamedTuple):
    """Centre of a shop window on the ground.

    heading_rad: direction from the street into the window
    """

    x_m: float
    y_m: float
    heading_rad: float


class InteractionSpot(NamedTuple):
    """Position and heading for an activity.

    thing: id of the prop or building, and number of its seat or window; spots of one thing exclude
        each other
    at_m: point on the thing that the person sits on, looks at or waits at
    """

    what: SpotKind
    thing: str
    x_m: float
    y_m: float
    heading_rad: float
    at_m: tuple[float, float]


def spots(
    street_map: StreetMap, props: Sequence[Prop], buildings: Sequence[Building]
) -> Iterator[InteractionSpot]:
    """Return all spots at these props and buildings; the best spot of a thing comes first."""
    for prop in props:
        if prop.kind == "bench":
            yield from _seats(prop)
        elif prop.kind == "shelter":
            yield from _shelter_spots(prop, street_map)
    for building in buildings:
        strip = street_map.strips.get(building.id.removeprefix("building:").rpartition(":")[0])
        if strip is not None and not has_paved_frontage(strip):
            continue  # people do not walk on gardens
        for number, window in enumerate(shop_windows(building, street_map)):
            for away_m in _WINDOW_M:
                x = window.x_m - away_m * math.cos(window.heading_rad)
                y = window.y_m - away_m * math.sin(window.heading_rad)
                thing = f"{building.id}/{number}@{window.x_m:.1f},{window.y_m:.1f}"
                yield InteractionSpot(
                    "window", thing, x, y, window.heading_rad, (window.x_m, window.y_m)
                )


def _seats(bench: Prop) -> Iterator[InteractionSpot]:
    """Return the seats of a bench; people face right of its heading."""
    for number, along_m in enumerate((-_SEAT_M, _SEAT_M)):
        seat = _offset(bench, along_m, 0.0)
        feet = _offset(bench, along_m, 0.5 * bench.size_m[1] + _SEAT_FRONT_M)
        yield InteractionSpot(
            "bench",
            f"{bench.id}/{number}",
            *feet,
            wrap_angle(bench.heading_rad - 0.5 * math.pi),
            seat,
        )


def _shelter_spots(shelter: Prop, street_map: StreetMap) -> Iterator[InteractionSpot]:
    """Return spots before a shelter's open side, facing the road."""
    point = shapely.Point(shelter.x_m, shelter.y_m)
    lanes = [
        p
        for p in street_map.near("lane", point.buffer(_ROAD_M))
        if isinstance(p, Lane) and p.kind == "road"
    ]
    if not lanes:
        return
    nearest = min(lanes, key=lambda lane: (float(shapely.distance(lane.polygon, point)), lane.id))
    to = shapely.get_coordinates(shapely.shortest_line(point, nearest.polygon))[1]
    open_rad = shelter.heading_rad - 0.5 * math.pi
    ahead = (to[0] - shelter.x_m) * math.cos(open_rad) + (to[1] - shelter.y_m) * math.sin(open_rad)
    facing = wrap_angle(open_rad if ahead > 0.0 else open_rad + math.pi)
    for number, share in enumerate((-0.3, 0.0, 0.3)):
        feet = _offset(shelter, share * shelter.size_m[0], 0.5 * shelter.size_m[1] + _SHELTER_GAP_M)
        yield InteractionSpot(
            "stop", f"{shelter.id}/{number}", *feet, facing, (shelter.x_m, shelter.y_m)
        )


def _offset(prop: Prop, along_m: float, right_m: float) -> tuple[float, float]:
    """Return the point at an offset along and right of a prop."""
    cos, sin = math.cos(prop.heading_rad), math.sin(prop.heading_rad)
    return prop.x_m + along_m * cos + right_m * sin, prop.y_m + along_m * sin - right_m * cos


def shop_windows(building: Building, street_map: StreetMap) -> Iterator[ShopWindow]:
    """Return a building's shop windows: ground-floor bays of shops and cafes without a door."""
    face = building_appearance(building, wall_style_of(building, street_map))
    if face.front.between not in _SHOP_BAYS:
        return
    for x0, y0, x1, y1 in (
        building.walls if building.outline is not None else [_street_wall(building)]
    ):
        width = math.hypot(x1 - x0, y1 - y0)
        if width < WINDOW_WALL_MIN_M:
            continue
        count = max(round(width / BAY_M), 1)
        into = math.atan2(x1 - x0, -(y1 - y0))  # the outside is on the right of the wall
        for k in range(count):
            if k % face.front.every != face.first_door:
                share = (k + 0.5) / count
                yield ShopWindow(x0 + share * (x1 - x0), y0 + share * (y1 - y0), into)


def _street_wall(building: Building) -> tuple[float, float, float, float]:
    """Return the wall of a box-shaped building that faces the street."""
    cos, sin = math.cos(building.heading_rad), math.sin(building.heading_rad)
    half, away = 0.5 * building.size_m[0], 0.5 * building.size_m[1]
    x = building.x_m + away * sin
    y = building.y_m - away * cos
    return x - half * cos, y - half * sin, x + half * cos, y + half * sin
