"""Checks of a place: its size, its walkable network, and its errors.

`scenarios/suites/capacity.py` computes which scenarios it can hold.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence

import msgspec
import numpy as np
import shapely

from cosim.core.geometry import Floats, Polyline
from cosim.place import overlay
from cosim.place.car_paths import corners_driven_over
from cosim.place.street_map import Lane, StreetMap, Strip
from cosim.place.terrain import ROBOT_GRADE_MAX, WALK_GRADE_MAX, Elevation
from cosim.place.walk_graph import WalkGraph

_NARROW_M = 1.0
"""Width of a strip in metres below which a robot and a person cannot pass each other."""
STUB_M = 1.0
"""Length in metres below which a strip counts as a stub."""
STEEP_GRADE = 0.08
"""Grade from which a walkable lane counts as steep."""
MOSTLY_SHARE = 0.5
"""Share of a sidewalk's area on roads above which it counts as lying on the road."""
MIN_ISLAND_SHARE = 0.6
"""Share of the largest island below which the check warns; scenarios use only the largest one."""


class NetFacts(msgspec.Struct, frozen=True, kw_only=True):
    """Facts about a SUMO net beyond its StreetMap. Ids are those of SUMO edges and traffic lights.

    mixed_km: lanes that people share with cars, which are not walkable here.
    elevation_m: lowest and highest point, None for a flat net.
    steep, false_grades: numbers of walkable lanes.
    no_program: signals of crossings without a program; SUMO controls level crossings itself.
    levels: walkable edges on bridges or in tunnels.
    """

    version: str
    projected: bool
    left_hand: bool
    edges: int
    pavement_km: float
    shared_km: float
    mixed_km: float
    areas: int
    crossings: int
    twisted_areas: int
    widths_missing: int
    signals: int
    never_green: tuple[str, ...]
    always_green: tuple[str, ...]
    misfits: tuple[str, ...]
    no_program: tuple[str, ...]
    elevation_m: tuple[float, float] | None
    steep: int
    false_grades: int
    levels: tuple[str, ...]
    levels_km: float

    @property
    def walkable_km(self) -> float:
        """Length of all lanes on which SUMO allows pedestrians, including shared ones."""
        return self.pavement_km + self.shared_km + self.mixed_km


class Island(msgspec.Struct, frozen=True):
    """Connected part of the walkable strips.

    share: share of the total length.
    """

    strips: int
    km: float
    share: float


class Problem(msgspec.Struct, frozen=True):
    """Problem at one strip or corner.

    kind: island, narrow, on_road, stacked, driven_over, steep, short_green, never_green,
        always_green, level or misfit.
    piece: id of the strip or corner.
    """

    kind: str
    piece: str
    x_m: float
    y_m: float


class MapCheck(msgspec.Struct, frozen=True, kw_only=True):
    """Result of `check_map`.

    reasons: why the map is unusable; empty if it is usable.
    warnings: what to change.
    notes: what to know.
    walkable_km: length of sidewalks and shared paths, without crossings.
    overlap_share: share of the sidewalks' area on lanes of roads.
    on_road: number of sidewalks that lie mostly on roads.
    stacked: number of sidewalks that cross a road without a crossing.
    driven_over: number of corners that cars drive over.
    guessed_share: share of the sidewalks' length that the importer made up; None if unknown.
    features: number of mapped buildings and objects by kind.
    """

    name: str
    size_m: tuple[float, float]
    walkable_km: float
    crossing_km: float
    sidewalks: int
    crossings: int
    signalised: int
    corners: int
    roads_km: float
    left_hand: bool
    islands: tuple[Island, ...]
    narrow: int
    narrow_km: float
    narrowest_m: float
    stubs: int
    dead_ends: int
    overlap_share: float
    on_road: int
    stacked: int
    driven_over: int
    guessed_share: float | None
    elevation: Elevation | None
    facts: NetFacts | None
    reasons: tuple[str, ...]
    warnings: tuple[str, ...]
    notes: tuple[str, ...]
    problems: tuple[Problem, ...]
    features: dict[str, int]

    @property
    def usable(self) -> bool:
        return not self.reasons


def check_map(
    street_map: StreetMap,
    graph: WalkGraph | None = None,
    facts: NetFacts | None = None,
    guessed_share: float | None = None,
) -> MapCheck:
    """Check a place without simulating it.

    graph: walking graph of the place; built if None.
    facts: facts about its net, if known.
    guessed_share: as in `MapCheck`.
    """
    graph = WalkGraph(street_map) if graph is None else graph
    strips = list(street_map.strips.values())
    sidewalks = [s for s in strips if s.kind == "sidewalk"]
    crossings = [s for s in strips if s.kind == "crossing"]
    lengths = {s.id: s.length_m for s in strips}
    share = on_road_shares(street_map, sidewalks)
    areas = np.array([s.polygon.area for s in sidewalks])
    on_road = [s for s, part in zip(sidewalks, share, strict=True) if part > MOSTLY_SHARE]
    stacked = [s for s in stacked_on_roads(street_map, sidewalks) if s not in on_road]
    narrow = [s for s in sidewalks if s.width_m < _NARROW_M]
    driven_over = corners_driven_over(street_map)
    islands = _islands(graph, lengths)
    x0, y0, x1, y1 = street_map.bounds
    return MapCheck(
        name=street_map.name,
        size_m=(x1 - x0, y1 - y0),
        walkable_km=sum(lengths[s.id] for s in sidewalks) / 1000.0,
        crossing_km=sum(lengths[s.id] for s in crossings) / 1000.0,
        sidewalks=len(sidewalks),
        crossings=len(crossings),
        signalised=sum(s.signalised for s in crossings),
        corners=len(street_map.corners),
        roads_km=sum(_length_m(lane) for lane in street_map.lanes.values() if _is_road(lane))
        / 1000.0,
        left_hand=street_map.left_hand,
        islands=islands,
        narrow=len(narrow),
        narrow_km=sum(lengths[s.id] for s in narrow) / 1000.0,
        narrowest_m=min((s.width_m for s in sidewalks), default=0.0),
        stubs=sum(lengths[s.id] < STUB_M for s in strips),
        dead_ends=sum(corner is None for s in strips for corner in s.corners),
        overlap_share=float((share * areas).sum() / areas.sum()) if areas.sum() > 0.0 else 0.0,
        on_road=len(on_road),
        stacked=len(stacked),
        driven_over=len(driven_over),
        guessed_share=guessed_share,
        elevation=street_map.elevation,
        facts=facts,
        reasons=tuple(_unusable_reasons(street_map)),
        warnings=tuple(_island_warnings(islands)),
        notes=(
            *_elevation_notes(street_map),
            *_stairs_notes(sidewalks),
            *_driven_over_notes(driven_over),
            *_short_green_notes(crossings),
            *_net_notes(facts),
        ),
        problems=(
            *_problems("island", [s for s in strips if s.id not in graph.main_strips]),
            *_problems("narrow", narrow),
            *_problems("on_road", on_road),
            *_problems("stacked", stacked),
            *_corner_problems("driven_over", driven_over),
            *_problems("steep", [s for s in strips if s.id in street_map.steep]),
            *_problems("short_green", [s for s in crossings if s.short_green]),
            *_net_problems(street_map, facts),
        ),
        features=dict(sorted(Counter(feature.kind for feature in street_map.features).items())),
    )


def _net_problems(street_map: StreetMap, facts: NetFacts | None) -> Iterator[Problem]:
    """Yield the problems of the strips that the facts about a net name."""
    if facts is not None:
        for kind in ("never_green", "always_green", "levels", "misfits"):
            known = [street_map.strips[i] for i in getattr(facts, kind) if i in street_map.strips]
            yield from _problems(kind.removesuffix("s"), known)


def on_road_shares(street_map: StreetMap, sidewalks: Sequence[Strip]) -> Floats:
    """Return the share of each sidewalk's area on lanes, without junctions, (N,) from 0 to 1."""
    roads = [lane.polygon for lane in street_map.lanes.values() if _is_road(lane)]
    if not roads or not sidewalks:
        return np.zeros(len(sidewalks))
    polygons = np.array([s.polygon for s in sidewalks], dtype=object)
    tree = shapely.STRtree(roads)
    strip, lane = tree.query(polygons, predicate="intersects")
    both = shapely.area(overlay.intersection(polygons[strip], tree.geometries[lane]))
    covered = np.bincount(strip, weights=both, minlength=len(sidewalks))
    return np.minimum(covered / np.maximum(shapely.area(polygons), 1e-9), 1.0)


def stacked_on_roads(street_map: StreetMap, sidewalks: Sequence[Strip]) -> list[Strip]:
    """Return sidewalks that cross a lane of another edge: bridges, tunnels or map errors."""
    roads = [lane for lane in street_map.lanes.values() if _is_road(lane)]
    if not roads or not sidewalks:
        return []
    tree = shapely.STRtree([shapely.LineString(lane.line[:, :2]) for lane in roads])
    lines = [shapely.LineString(s.line[:, :2]) for s in sidewalks]
    pairs = zip(*tree.query(lines, predicate="crosses"), strict=True)
    hit = {int(i) for i, k in pairs if roads[k].edge != sidewalks[i].id}
    return [sidewalks[i] for i in sorted(hit)]


def _is_road(lane: Lane) -> bool:
    return lane.kind == "road" and not lane.internal


def _length_m(lane: Lane) -> float:
    return float(np.hypot(*np.diff(lane.line[:, :2], axis=0).T).sum())


def _problems(kind: str, strips: Sequence[Strip]) -> list[Problem]:
    middles = [
        (s, Polyline(s.line[:, :2]).at(s.length_m / 2.0)) for s in strips if s.length_m > 0.0
    ]
    return [Problem(kind, s.id, round(at.x_m, 2), round(at.y_m, 2)) for s, at in middles]


def _corner_problems(kind: str, grounds: Mapping[str, shapely.Geometry]) -> list[Problem]:
    spots = shapely.get_coordinates(
        [shapely.point_on_surface(ground) for ground in grounds.values()]
    ).tolist()
    return [
        Problem(kind, name, round(x_m, 2), round(y_m, 2))
        for name, (x_m, y_m) in zip(grounds, spots, strict=True)
    ]


def _islands(graph: WalkGraph, lengths: dict[str, float]) -> tuple[Island, ...]:
    """Return the connected parts, longest first."""
    labels = graph.component[::2]
    if not len(labels):
        return ()
    metres = np.bincount(labels, weights=[lengths[s] for s in graph.street_map.strips])
    counts = np.bincount(labels)
    total = max(float(metres.sum()), 1e-9)
    order = np.argsort(-metres, kind="stable")
    return tuple(
        Island(int(counts[i]), float(metres[i]) / 1000.0, float(metres[i]) / total) for i in order
    )


def _unusable_reasons(street_map: StreetMap) -> list[str]:
    if not street_map.strips:
        return ["nothing is walkable: no sidewalk, path or crossing"]
    if not street_map.corners:
        return [
            "its sidewalks are not connected: the net has no walking areas; import it "
            "without --as-is"
        ]
    return []


def _island_warnings(islands: Sequence[Island]) -> list[str]:
    if not islands or islands[0].share >= MIN_ISLAND_SHARE:
        return []
    return [
        f"the largest of {len(islands)} islands of connected walkways has {islands[0].share:.0%} "
        "of their length: scenarios are drawn on it alone, the rest stays unused. Import another "
        "part (--bbox), whose streets have sidewalks and crossings; a SUMO net without --as-is; "
        "or a file that was not cut through its streets. -o map.png draws the islands"
    ]


def _stairs_notes(sidewalks: Sequence[Strip]) -> list[str]:
    steps = [s.id for s in sidewalks if s.going == "steps"]
    return (
        [f"{len(steps)} walkable edges are stairs, flat here: routes keep off them"]
        if steps
        else []
    )


def _driven_over_notes(corners: Mapping[str, object]) -> list[str]:
    if not corners:
        return []
    return [
        f"cars turn over {len(corners)} corners, crossings apart: routes keep off there: "
        f"{_first_few([*corners])}"
    ]


def _short_green_notes(crossings: Sequence[Strip]) -> list[str]:
    short = [s.id for s in crossings if s.short_green]
    if not short:
        return []
    return [
        f"{len(short)} crossings have a green too short to walk, by a program that is not fixed: "
        f"long routes keep off them: {_first_few(short)}"
    ]


def _net_notes(facts: NetFacts | None) -> list[str]:
    if facts is None:
        return []
    notes = []
    if facts.mixed_km >= 0.01:
        notes.append(f"{facts.mixed_km:.2f} km that people share with cars are not walkable here")
    if facts.levels:
        notes.append(
            f"{len(facts.levels)} walkable edges ({facts.levels_km:.2f} km) are on bridges "
            f"or in tunnels: they lie "
            "level with the streets they pass over or under; routes keep off them"
        )
    if facts.widths_missing:
        notes.append(
            f"{facts.widths_missing} walkable lanes name no width: SUMO's default of 3.2 m holds"
        )
    if facts.no_program:
        notes.append(
            f"{len(facts.no_program)} level crossings are run by SUMO itself: "
            f"{_first_few(facts.no_program)}"
        )
    for which, words in (("never_green", "never green"), ("always_green", "always green")):
        found: tuple[str, ...] = getattr(facts, which)
        if found:
            notes.append(f"{len(found)} signalised crossings are {words}: {_first_few(found)}")
    if facts.misfits:
        notes.append(
            f"{len(facts.misfits)} crossings are beyond their signal's program: "
            f"{_first_few(facts.misfits)}"
        )
    return notes


def _elevation_notes(street_map: StreetMap) -> list[str]:
    elevation = street_map.elevation
    if elevation is None:
        return []
    span = f"elevation {round(elevation.low_m)} to {round(elevation.high_m)} m"
    if elevation.dropped:
        return [f"{span} is dropped, the ground is flat: {elevation.dropped}"]
    notes = [
        f"{span} is kept; {elevation.missing} of {elevation.points} points had none or a false one "
        f"and were interpolated; {elevation.clamped} places on streets were moved, by up to "
        f"{elevation.moved_m:.1f} m, so that no street or walkway rises more than "
        f"{WALK_GRADE_MAX:.0%} along its line"
    ]
    if elevation.steep:
        km = sum(street_map.strips[strip].length_m for strip in elevation.steep) / 1000.0
        notes.append(
            f"{len(elevation.steep)} walkways ({km:.1f} km) are steeper than {ROBOT_GRADE_MAX:.0%} "
            "somewhere (steps, hill paths, terraces closer together than heights can show): no "
            "robot is sent over them"
        )
    return notes


def _first_few(names: Sequence[str]) -> str:
    return ", ".join(names[:4]) + (" ..." if len(names) > 4 else "")
