"""Stretches of sidewalk, on which straight scenarios are drawn.

In a net of streets, each sidewalk between two corners is a stretch. The net of a scan is cut where
the width of the ground changes. Its pieces are joined again, and the ground around a way determines
the width that is free.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import combinations
from typing import Final, NamedTuple

import numpy as np
import shapely
from shapely.geometry import LineString, Point, Polygon

from cosim.core.errors import SpecError
from cosim.core.geometry import Floats, Polyline, Pose, wrap_angle
from cosim.place import overlay
from cosim.place.medial_axis import between
from cosim.place.street_map import Port, StreetMap, Strip
from cosim.place.walk_graph import WalkGraph

ENDS_CLEAR_M: Final = 6.0
"""Least distance of route and event from the ends of their sidewalk, in metres."""
BEND_M: Final = 0.15
"""Largest distance of a straight way from the middle of a sidewalk of a street, in metres."""
_TURN_RAD: Final = math.radians(60.0)
"""Largest turn from one piece of a stretch to the next."""
_NARROW_M: Final = 1.2
"""Width below which a piece is narrow, in metres."""
_LENGTH_M: Final = 42.0
"""Length of a stretch of a scan, in metres: the longest route, and ENDS_CLEAR_M at both ends."""
_SPACING_M: Final = 15.0
"""Largest distance between the starts of neighbouring stretches of a scan, in metres."""
_REACH_M: Final = 12.0
"""Distance to each side of a way of a scan up to which the ground is measured, in metres."""


@dataclass(frozen=True, slots=True)
class Stretch(Strip):
    """Part of the joined sidewalks of a scan. Neighbouring stretches overlap.

    width_m: clear width of the widest piece.
    ground: walkable ground around the stretch.
    """

    ground: shapely.Geometry = field(default_factory=Polygon)


class StraightWay(NamedTuple):
    """Straight way along a sidewalk. half_width_m: of the free ground around it."""

    line: Polyline
    half_width_m: float


def sidewalks_of(street_map: StreetMap, graph: WalkGraph) -> list[Strip]:
    """Return the sidewalks that robots may use, sorted by id; of a scan, its stretches."""
    pieces = {
        strip_id: strip
        for strip_id in sorted(graph.main_strips - street_map.steep)
        if (strip := street_map.strips[strip_id]).kind == "sidewalk" and strip.going == "plain"
    }
    if not street_map.scanned:
        return [*pieces.values()]
    return [
        stretch
        for ports in _chains(street_map, pieces)
        for stretch in _stretches(street_map, [pieces[port.strip] for port in ports], ports)
    ]


def straight_along(strip: Strip, length_m: float, rng: np.random.Generator) -> StraightWay:
    """Draw a straight way of a length along a sidewalk. Raises SpecError if none fits."""
    line = strip.line[:, :2] if rng.random() < 0.5 else strip.line[::-1, :2]
    middle = Polyline(line)
    room_m = middle.length_m - length_m - 2 * ENDS_CLEAR_M
    if room_m < 0.0:
        raise SpecError("the sidewalk is too short")
    start_m = ENDS_CLEAR_M + float(rng.uniform(0.0, room_m))
    ends = np.stack([middle.at(start_m).xy, middle.at(start_m + length_m).xy])
    if isinstance(strip, Stretch):
        return _over_ground(strip, ends, length_m)
    chord = Polyline(ends)
    inner = middle.points[(middle.s_m > start_m) & (middle.s_m < start_m + length_m)]
    if any(abs(chord.project(x, y)[1]) > BEND_M for x, y in inner.tolist()):
        raise SpecError("the sidewalk is not straight")
    return StraightWay(chord, strip.width_m / 2)


def _over_ground(stretch: Stretch, ends: Floats, length_m: float) -> StraightWay:
    """Return the way of a length from one point towards another, if all of it is walkable."""
    along = (ends[1] - ends[0]) / max(float(np.hypot(*(ends[1] - ends[0]))), 1e-9)
    points = np.stack([ends[0], ends[0] + length_m * along])
    line = LineString(points)
    if not shapely.covers(stretch.ground, line):
        raise SpecError("the sidewalk is not straight")
    edge = shapely.boundary(stretch.ground)
    return StraightWay(Polyline(points), min(_REACH_M, float(shapely.distance(line, edge))))


def middle_at(strip: Strip, pose: Pose, half_width_m: float) -> tuple[Pose, float]:
    """Return the pose moved aside to the middle of its sidewalk, and half of the width there.

    half_width_m: of the ground around the way. In a net of streets, the way is the middle.
    """
    if not isinstance(strip, Stretch):
        return pose, half_width_m
    aside = np.array([-math.sin(pose.heading_rad), math.cos(pose.heading_rad)])
    at = Point(pose.xy)
    right_m, left_m = (
        max(
            part.length
            for part in shapely.get_parts(
                shapely.intersection(
                    LineString([pose.xy, pose.xy + side * _REACH_M * aside]), strip.ground
                )
            )
            if part.distance(at) < 1e-6
        )
        for side in (-1.0, 1.0)
    )
    x_m, y_m = (pose.xy + 0.5 * (left_m - right_m) * aside).tolist()
    return Pose(x_m, y_m, pose.heading_rad), 0.5 * (left_m + right_m)


def _chains(street_map: StreetMap, pieces: Mapping[str, Strip]) -> Iterator[list[Port]]:
    """Yield the pieces that lead on from one another, each by the port at which it is entered."""
    onward = _joints(street_map, pieces)
    seen: set[str] = set()
    starts = [Port(name, end) for name in pieces for end in (0, 1)]
    # Loops have no end: they start anywhere.
    for start in sorted(starts, key=lambda port: (port in onward, port.strip, port.end)):
        chain: list[Port] = []
        port: Port | None = start
        while port is not None and port.strip not in seen:
            seen.add(port.strip)
            chain.append(port)
            port = onward.get(port.other)
        if chain:
            yield chain


def _joints(street_map: StreetMap, pieces: Mapping[str, Strip]) -> dict[Port, Port]:
    """Return the port at which each port leads on: at every corner, the straightest pairs.

    Narrow pieces, such as those behind a post, are joined last.
    """
    onward: dict[Port, Port] = {}
    for corner in street_map.corners.values():
        ports = sorted({port for port in corner.ports if port.strip in pieces})
        turns = [
            (
                min(pieces[a.strip].width_m, pieces[b.strip].width_m) < _NARROW_M,
                abs(wrap_angle(_outward(pieces, a) + math.pi - _outward(pieces, b))),
                a,
                b,
            )
            for a, b in combinations(ports, 2)
            if a.strip != b.strip
        ]
        for _, turn_rad, a, b in sorted(turns):
            if turn_rad < _TURN_RAD and a not in onward and b not in onward:
                onward |= {a: b, b: a}
    return onward


def _outward(pieces: Mapping[str, Strip], port: Port) -> float:
    """Return the heading on leaving a piece by a port."""
    line = pieces[port.strip].line[:, :2]
    points = line[[-2, -1]] if port.end == 1 else line[[1, 0]]
    east, north = (points[1] - points[0]).tolist()
    return math.atan2(north, east)


def _stretches(
    street_map: StreetMap, pieces: Sequence[Strip], ports: Sequence[Port]
) -> Iterator[Stretch]:
    """Yield the stretches of joined pieces. ports: at which each piece is entered."""
    lines = [
        piece.line[:, :2] if port.end == 0 else piece.line[::-1, :2]
        for piece, port in zip(pieces, ports, strict=True)
    ]
    whole = Polyline(np.concatenate(lines))
    spare_m = max(whole.length_m - _LENGTH_M, 0.0)
    for k, from_m in enumerate(np.linspace(0.0, spare_m, math.ceil(spare_m / _SPACING_M) + 1)):
        line = between(whole.points, float(from_m), min(float(from_m) + _LENGTH_M, whole.length_m))
        around = shapely.box(*shapely.buffer(LineString(line), _REACH_M).bounds)
        ground = overlay.intersection(street_map.walkable, around)
        shapely.prepare(ground)
        yield Stretch(
            id=f"{pieces[0].id}+{k}",
            kind="sidewalk",
            line=line,
            width_m=max(piece.width_m for piece in pieces),
            polygon=shapely.buffer(LineString(line), 0.5 * pieces[0].width_m, cap_style="flat"),
            corners=(None, None),
            ground=ground,
        )
