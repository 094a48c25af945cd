"""Elevations of a net as a clean Terrain, or none if they are implausible."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Final, Literal, NamedTuple, Protocol

import numpy as np
import shapely
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt, uniform_filter
from scipy.spatial import cKDTree

from cosim.core.geometry import Floats
from cosim.place.street_map import Corner, Strip
from cosim.place.terrain import (
    CLAMPED_M,
    FALSE_GRADE,
    ROBOT_GRADE_MAX,
    WALK_GRADE_MAX,
    Elevation,
    Terrain,
)

SAME_LEVEL_M: Final = 1.5
"""Places side by side that differ by more are on different terraces."""

GROUND: Final = ("no", "", "building_passage")
"""Values of the params `bridge` and `tunnel` for ways on the ground."""

_SPACING_M = 4.0
_BESIDE_M = 5.0
_ROUNDS = 300
_NEAR_M = 1e-6

_Ints = NDArray[np.intp]
On = Literal["street", "path", "steps", "raised"]


@dataclass(frozen=True, slots=True)
class Course:
    """A line of a net with elevations. points: (N, 3) metres, NaN where the third is missing; on:
    what lies there, "path" where nothing drives, "raised" for bridges and tunnels; ring: whether it
    is the outline of a walking area; edge: SUMO edge id."""

    edge: str
    points: Floats
    on: On = "street"
    ring: bool = False


class Meeting(NamedTuple):
    """A walking area: the number of its outline among the courses, and its ports: the number of a
    course, and 0 for the start of its line or 1 for its end."""

    ring: int
    ports: tuple[tuple[int, int], ...]


def course(edge: str, shape: str, on: On = "street", ring: bool = False) -> Course:
    """A shape of points "x,y" and "x,y,z" in any mixture: netconvert leaves an elevation of 0 away,
    and writes 0 where it knows none."""
    rows = [[float(value) for value in point.split(",")] for point in shape.split()]
    points = np.array([[*row[:2], row[2] if len(row) > 2 else 0.0] for row in rows])
    return Course(edge, points, on, ring)


def off_ground(params: Mapping[str, str], kind: str) -> bool:
    """Return whether the params or the type of an edge say that it is a bridge or a tunnel."""
    if any(params.get(key, "no") not in GROUND for key in ("bridge", "tunnel")):
        return True
    return params.get("layer", "0") not in ("0", "") or kind.endswith(("_bridge", "_tunnel"))


def what_lies_there(kind: str, params: Mapping[str, str], apart: bool) -> On:
    """Return the kind of ground under an edge, from its type and params.

    apart: whether no vehicles drive on it.
    """
    if off_ground(params, kind):
        return "raised"
    if "steps" in kind:
        return "steps"
    return "path" if apart else "street"


@dataclass(frozen=True, slots=True)
class Profile:
    """Points every few metres along all courses, joined where one can walk or drive from one to the
    other.

    xy: (N, 2); z: (N,) heights; street: (N,) whether WALK_GRADE_MAX holds there; tail, head, run_m:
    (E,) the joints.
    """

    xy: Floats
    z: Floats
    street: NDArray[np.bool_]
    tail: _Ints
    head: _Ints
    run_m: Floats

    @classmethod
    def of(cls, courses: Sequence[Course], meets: Sequence[Meeting]) -> Profile:
        rows = []
        tails = []
        heads = []
        first = [0]
        streets: list[NDArray[np.bool_]] = []
        for c in courses:
            points = _dense(c)
            start = first[-1]
            n = len(points)
            rows.append(points)
            streets.append(np.full(n, c.on == "street"))
            first.append(start + n)
            if n > 1:
                tails.append(start + np.arange(n - 1))
                heads.append(start + np.arange(1, n))
        at = np.concatenate(rows)
        tree = cKDTree(at[:, :2])
        pairs = tree.query_pairs(_BESIDE_M, output_type="ndarray")
        near = np.abs(at[pairs[:, 0], 2] - at[pairs[:, 1], 2]) <= SAME_LEVEL_M
        tails.append(pairs[near, 0])
        heads.append(pairs[near, 1])
        for ring, ports in meets:
            ends = np.array(
                [first[k + end] - end for k, end in ports if first[k] < first[k + 1]], dtype=np.intp
            )
            around = np.arange(first[ring], first[ring + 1])
            joined: list[tuple[int, int]] = list(combinations(ends.tolist(), 2))
            if len(around) and len(ends):
                gaps = np.hypot(
                    *(at[ends][:, None, :2] - at[around][None, :, :2]).transpose(2, 0, 1)
                )
                joined += zip(ends.tolist(), around[gaps.argmin(axis=1)].tolist(), strict=True)
            tails.append(np.array([pair[0] for pair in joined], dtype=np.intp))
            heads.append(np.array([pair[1] for pair in joined], dtype=np.intp))
        tail, head = np.concatenate(tails).astype(np.intp), np.concatenate(heads).astype(np.intp)
        street = np.concatenate(streets)
        both = street[tail] & street[head]
        tail, head = tail[both], head[both]
        run = np.maximum(np.hypot(*(at[tail, :2] - at[head, :2]).T), 0.5)
        return cls(at[:, :2], at[:, 2], street, tail, head, run)

    def clamped(self) -> Floats:
        """(N,) heights with no joint on streets steeper than WALK_GRADE_MAX."""
        return clamped(self.z, self.tail, self.head, WALK_GRADE_MAX * self.run_m)


def clamped(z_m: Floats, tail: _Ints, head: _Ints, most_m: Floats) -> Floats:
    """Heights near (N,) `z_m` of which those of `tail` and `head`, (E,) numbers, differ by (E,)
    `most_m` at most.

    First every joint that is too steep pulls its ends together, many times, which takes narrow
    faults away where they are. What is left is put half way between the highest heights below and
    the lowest above that keep the bounds.
    """
    z = z_m.copy()
    count = len(z_m)
    joints = 1 + np.bincount(tail, minlength=count) + np.bincount(head, minlength=count)
    for _ in range(_ROUNDS):
        rise = z[head] - z[tail]
        over = rise - np.clip(rise, -most_m, most_m)
        if not over.any():
            return z
        z += (np.bincount(tail, over, count) - np.bincount(head, over, count)) / joints
    return 0.5 * (_lowered(z, tail, head, most_m) - _lowered(-z, tail, head, most_m))


def _lowered(z_m: Floats, tail: _Ints, head: _Ints, most_m: Floats) -> Floats:
    """The highest heights not above `z_m` that keep the bounds."""
    z = z_m.copy()
    while True:
        before = z.copy()
        np.minimum.at(z, head, before[tail] + most_m)
        np.minimum.at(z, tail, before[head] + most_m)
        if (before - z).max(initial=0.0) < _NEAR_M:
            return z


def _dense(c: Course) -> Floats:
    """(N, 3) points of a course every few metres, missing elevations between known ones
    interpolated; none at all where no point has one."""
    known = np.isfinite(c.points[:, 2])
    if not known.any():
        return np.zeros((0, 3))
    at = metres_along(c.points)
    count = max(int(np.ceil(at[-1] / _SPACING_M)), 1)
    s = (
        np.unique(np.concatenate([np.linspace(0.0, at[-1], count + 1)]))
        if at[-1] > 0.0
        else np.zeros(1)
    )
    columns = [np.interp(s, at, c.points[:, k]) for k in (0, 1)]
    return np.column_stack([*columns, np.interp(s, at[known], c.points[known, 2])])


def metres_along(points: Floats) -> Floats:
    """(N,) metres from the first of (N, 2) points or more columns, level."""
    return np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(points[:, :2], axis=0).T))])


_SAMPLE_M: Final = 2.0
NODES_MAX: Final = 6_000_000
"""Larger places get a coarser lattice."""
_MARGIN_M: Final = 80.0
KNOWN_SHARE: Final = 0.5
"""With fewer of the points known, an elevation is a guess."""
FALSE_SHARE: Final = 0.15
"""With more of the streets' length beyond FALSE_GRADE, the elevation is false as a whole."""
DEEPEST_M: Final = -450.0
HIGHEST_M: Final = 5500.0
"""No street on Earth lies lower or higher."""

_SPIKE_M = 3.0
_STEP_M = 0.5
_BESIDE_M_ELEVATION = 12.0
_SIGMA_M = 4.0
_REACH_M = 12.0
_KERB_M = 6.0
_NEIGHBOURS = 24
_FILL_ROUNDS = 40


class NetEdge(Protocol):
    """An edge as it is in a net: its attributes, those of its lanes, and its params."""

    attributes: dict[str, str]
    lanes: list[dict[str, str]]
    params: dict[str, str]


def land_of(
    edges: Iterable[NetEdge],
    apart: Collection[str],
    walked: Mapping[str, int],
    ports: Mapping[tuple[str, int], str],
) -> tuple[Terrain | None, Elevation | None]:
    """The land of a net as `surveyed` finds it; of bridges and tunnels only those count that one
    can walk on.

    apart: edges on which nothing drives. walked: edges with a strip, and the number of its lane.
    ports: the walking area at an end, 0 or 1, of a strip.
    """
    outer = [edge for edge in edges if edge.lanes and edge.attributes.get("function") != "internal"]
    if not any(
        lane["shape"].count(",") > lane["shape"].count(" ") + 1
        for edge in outer
        for lane in edge.lanes
    ):
        return None, None
    courses: list[Course] = []
    first: dict[str, int] = {}
    for edge in outer:
        name = edge.attributes["id"]
        function = edge.attributes.get("function", "")
        on = what_lies_there(
            edge.attributes.get("type", ""), edge.params, name in apart and not function
        )
        if on != "raised" or name in walked:
            first[name] = len(courses)
            courses += [
                course(name, lane["shape"], on, function == "walkingarea") for lane in edge.lanes
            ]
    met: dict[str, list[tuple[int, int]]] = defaultdict(list)
    for (strip, end), corner in ports.items():
        if strip in first:
            met[corner].append((first[strip] + walked[strip], end))
    return surveyed(
        courses, [Meeting(first[corner], tuple(found)) for corner, found in met.items()]
    )


def surveyed(
    courses: Sequence[Course], meets: Sequence[Meeting] = ()
) -> tuple[Terrain | None, Elevation | None]:
    """The land under the lines of a net, and what was done to its elevations; None and None without
    any.

    meets: where courses join, whatever their elevations say.
    """
    heights = np.concatenate([c.points[:, 2] for c in courses]) if courses else np.zeros(0)
    heights = np.where((heights < DEEPEST_M) | (heights > HIGHEST_M), np.nan, heights)
    if not np.nan_to_num(heights).any():
        return None, None
    filled = _without_false_points(courses, heights)
    raw = np.concatenate([f.points[:, 2] for f in filled if not f.ring] or [heights])
    known = raw[np.isfinite(raw)]
    missing = int((~np.isfinite(raw)).sum())
    share = false_share(filled)
    street = np.concatenate([f.points[:, 2] for f in filled if f.on == "street"] or [known])
    street = street[np.isfinite(street)]
    found = Elevation(
        low_m=float(np.min(street, initial=np.inf)),
        high_m=float(np.max(street, initial=-np.inf)),
        points=len(raw),
        missing=missing,
        false_share=share,
    )
    if len(street) == 0 or len(known) < KNOWN_SHARE * len(raw):
        return None, replace(
            found, dropped=f"only {len(known)} of {len(raw)} points have one that can be true"
        )
    if share > FALSE_SHARE:
        return None, replace(
            found, dropped=f"{share:.0%} of the streets' length are steeper than {FALSE_GRADE:.0%}"
        )
    if np.ptp(street) < 0.5:
        return None, replace(found, dropped="it is the same everywhere")
    nodes = Profile.of(filled, meets)
    level = nodes.clamped()
    moved = np.abs(level - nodes.z)[nodes.street]
    terrain = _spread(nodes, level)
    return terrain, replace(
        found, clamped=int((moved > CLAMPED_M).sum()), moved_m=float(moved.max(initial=0.0))
    )


def steep_strips(terrain: Terrain, strips: Sequence[Strip]) -> tuple[str, ...]:
    """Ids of the strips with a spot steeper than ROBOT_GRADE_MAX, at their middle line or near
    either side."""
    half = [0.4 * strip.width_m for strip in strips]
    found = _steep(terrain, [strip.line for strip in strips], half)
    return tuple(strip.id for strip, is_steep in zip(strips, found, strict=True) if is_steep)


def steep_ports(
    terrain: Terrain, strips: Mapping[str, Strip], corners: Iterable[Corner], steep: Collection[str]
) -> tuple[tuple[str, int], ...]:
    """Ports, strip and end, to close so that no straight way across a corner is too steep: the
    worst ones first."""
    met = [
        [port for port in dict.fromkeys(corner.ports) if port.strip not in steep]
        for corner in corners
    ]
    ways = [pair for ports in met for pair in combinations(ports, 2)]
    if not ways:
        return ()
    lines = [np.array([strips[port.strip].line[-port.end] for port in pair]) for pair in ways]
    too_steep = {
        pair
        for pair, found in zip(ways, _steep(terrain, lines, [0.2] * len(ways)), strict=True)
        if found
    }
    shut: list[tuple[str, int]] = []
    for ports in met:
        left = [pair for pair in combinations(ports, 2) if pair in too_steep]
        while left:
            worst = max(ports, key=lambda port: sum(port in pair for pair in left))
            shut.append((worst.strip, worst.end))
            left = [pair for pair in left if worst not in pair]
    return tuple(shut)


def _steep(terrain: Terrain, lines: Sequence[Floats], half_m: Sequence[float]) -> NDArray[np.bool_]:
    """(N,) which lines have a spot steeper than ROBOT_GRADE_MAX on them or `half_m` beside them."""
    owner = np.repeat(np.arange(len(lines)), [len(line) for line in lines])
    at, owner = shapely.get_coordinates(
        shapely.segmentize(shapely.linestrings(np.concatenate(lines), indices=owner), 1.0),
        return_index=True,
    )
    same = owner[1:] == owner[:-1]
    middle = (0.5 * (at[1:] + at[:-1]))[same]
    metres_along = np.diff(at, axis=0)[same]
    owner = owner[1:][same]
    metres_along /= np.maximum(np.hypot(*metres_along.T), 1e-9)[:, None]
    aside = np.asarray(half_m)[owner][:, None] * np.column_stack(
        [-metres_along[:, 1], metres_along[:, 0]]
    )
    steep = [
        np.hypot(*terrain.gradient(middle + k * aside).T) > ROBOT_GRADE_MAX for k in (-1, 0, 1)
    ]
    return np.asarray(np.bincount(owner, np.any(steep, axis=0), len(lines)) > 0)


def false_share(courses: Sequence[Course]) -> float:
    """Part of the streets' length, steps, bridges and tunnels apart, that is steeper than
    FALSE_GRADE."""
    total = false = 0.0
    for c in courses:
        if c.on == "street" and not c.ring:
            run = np.hypot(*np.diff(c.points[:, :2], axis=0).T)
            rise = np.abs(np.diff(c.points[:, 2]))
            there = np.isfinite(rise)
            total += float(run[there].sum())
            false += float(run[there & (rise > FALSE_GRADE * run + 0.1)].sum())
    return false / total if total > 0.0 else 0.0


def _without_false_points(courses: Sequence[Course], heights: Floats) -> list[Course]:
    """The courses with NaN for each elevation that cannot be: zeros beside heights, and single
    spikes."""
    ends = np.cumsum([len(c.points) for c in courses])[:-1]
    every = np.column_stack([np.concatenate([c.points[:, :2] for c in courses]), heights])
    high = every[np.isfinite(heights) & (heights != 0.0)]
    gap, nearest = cKDTree(high[:, :2]).query(
        every[:, :2], distance_upper_bound=_BESIDE_M_ELEVATION
    )
    beside = high[np.minimum(nearest, len(high) - 1), 2]
    every[(heights == 0.0) & (np.abs(beside) > FALSE_GRADE * gap + _STEP_M), 2] = np.nan
    out = []
    for c, points in zip(courses, np.split(every, ends), strict=True):
        if c.ring and not np.nan_to_num(points[:, 2]).any():
            # Corners mended on import have lost their elevations, and others say no more than the
            # streets they join.
            points[:, 2] = np.nan
        _drop_zeros(points)
        _drop_spikes(points)
        on: On = (
            c.on if c.on != "path" else "steps" if _climb(points) > ROBOT_GRADE_MAX else "street"
        )
        out.append(Course(c.edge, points, on, c.ring))
    return out


def _drop_zeros(points: Floats) -> None:
    """Take away zeros that no street can come down to from the heights before and after them, in
    place."""
    zero = points[:, 2] == 0.0
    high = ~zero & np.isfinite(points[:, 2])
    if zero.any() and high.any():
        at = metres_along(points)
        beside = np.abs(np.interp(at[zero], at[high], points[high, 2]))
        gap = np.abs(at[zero][:, None] - at[high][None]).min(axis=1)
        points[np.flatnonzero(zero)[beside > FALSE_GRADE * gap + _STEP_M], 2] = np.nan


def _drop_spikes(points: Floats) -> None:
    """Take away single points that stand out from both neighbours, in place."""
    known = np.flatnonzero(np.isfinite(points[:, 2]))
    if len(known) < 3:
        return
    x, y, z = points[known].T
    before = z[1:-1] - z[:-2]
    after = z[1:-1] - z[2:]
    run = np.hypot(np.diff(x), np.diff(y))
    off = np.minimum(np.abs(before), np.abs(after))
    steep = (np.abs(before) > 2.0 * FALSE_GRADE * run[:-1]) & (
        np.abs(after) > 2.0 * FALSE_GRADE * run[1:]
    )
    spikes = (before * after > 0.0) & (off > _SPIKE_M) & steep
    points[known[1:-1][spikes], 2] = np.nan


def _climb(points: Floats) -> float:
    """All that a line rises and falls, for each metre of its length."""
    known = points[np.isfinite(points[:, 2])]
    run = float(metres_along(known)[-1]) if len(known) else 0.0
    return float(np.abs(np.diff(known[:, 2])).sum()) / run if run > 0.0 else 0.0


def _spread(nodes: Profile, level: Floats) -> Terrain:
    """The land: around streets at their heights, level across them; smooth between."""
    low = nodes.xy.min(axis=0) - _MARGIN_M
    high = nodes.xy.max(axis=0) + _MARGIN_M
    step_m = _SAMPLE_M
    while np.prod((high - low) / step_m + 2.0) > NODES_MAX:
        step_m *= 2.0
    origin = np.floor(low / step_m) * step_m
    columns, rows = (np.ceil((high - origin) / step_m).astype(int) + 1).tolist()
    x, y = origin[0] + step_m * np.arange(columns), origin[1] + step_m * np.arange(rows)
    grid = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    surface = np.full(len(grid), np.nan)
    # Steps end at streets: there the street's height holds.
    for which, reach_m in ((nodes.street, _KERB_M), (np.ones(len(level), dtype=bool), _REACH_M)):
        free = np.flatnonzero(np.isnan(surface))
        surface[free] = _around(grid[free], nodes.xy[which], level[which], reach_m)
    land: Floats = surface.reshape(rows, columns)
    open_land = ~np.isfinite(land)
    _, (j, i) = distance_transform_edt(open_land, return_indices=True)
    land = land[j, i]
    for _ in range(_FILL_ROUNDS):
        land = np.where(open_land, uniform_filter(land, 3, mode="nearest"), land)
    datum = float(np.floor(land.min()))
    heights = (land - datum).astype(np.float32)
    heights.flags.writeable = False
    return Terrain(float(origin[0]), float(origin[1]), step_m, heights, datum)


def _around(grid: Floats, xy: Floats, level: Floats, reach_m: float) -> Floats:
    """(N,) heights at points of the lattice: the mean around of what lies level with the nearest
    node; NaN beyond reach. A terrace beside a street does not count, however near."""
    out = np.full(len(grid), np.nan)
    if not len(xy):
        return out
    tree = cKDTree(xy)
    gap, nearest = (np.asarray(each) for each in tree.query(grid, distance_upper_bound=reach_m))
    pinned = np.flatnonzero(np.isfinite(gap))
    count = min(_NEIGHBOURS, len(xy))
    found = tree.query(grid[pinned], k=count, distance_upper_bound=_REACH_M)
    away, node = (np.asarray(each).reshape(len(pinned), count) for each in found)
    node = np.minimum(node, len(xy) - 1).astype(np.intp)
    off = np.abs(level[node] - level[nearest[pinned]][:, None])
    there = np.isfinite(away) & (off <= SAME_LEVEL_M + WALK_GRADE_MAX * np.minimum(away, _REACH_M))
    weight = np.where(there, np.exp(-0.5 * (np.minimum(away, _REACH_M) / _SIGMA_M) ** 2), 0.0)
    out[pinned] = (weight * level[node]).sum(axis=1) / weight.sum(axis=1)
    return out
