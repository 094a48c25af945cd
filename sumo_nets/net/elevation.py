"""Build a Terrain from the elevations of a net, or reject implausible elevations."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Final, Literal, NamedTuple, Protocol

import numpy as np
import scipy  # its parts are loaded when first used
import shapely
from numpy.typing import NDArray

from cosim.core.geometry import Floats
from cosim.place.street_map import Corner, Strip
from cosim.place.terrain import (
    CLAMP_THRESHOLD_M,
    IMPLAUSIBLE_GRADE,
    ROBOT_GRADE_MAX,
    WALK_GRADE_MAX,
    Elevation,
    Terrain,
)

SAME_LEVEL_M: Final = 1.5
"""Adjacent places whose heights differ by more, in metres, are on different terraces."""

GROUND: Final = ("no", "", "building_passage")
"""Values of the params `bridge` and `tunnel` for ways on the ground."""

_SPACING_M = 4.0
"""Distance between the points of a Profile along a course, metres."""
_JOIN_M = 5.0
"""Points of courses closer than this, in metres, and on one level are joined."""
_ROUNDS = 300
"""Maximum number of relaxation rounds in `clamped`."""
_NEAR_M = 1e-6
"""Height change, in metres, below which `_lowered` has converged."""
_SAMPLE_M: Final = 2.0
"""Spacing of the terrain lattice, metres."""
NODES_MAX: Final = 6_000_000
"""Maximum number of lattice points; larger places get a coarser lattice."""
_MARGIN_M: Final = 80.0
"""Width of the terrain beyond the net, metres."""
KNOWN_SHARE: Final = 0.5
"""Elevations are dropped if a smaller share of the points has a plausible one."""
FALSE_SHARE: Final = 0.15
"""Share of the streets' length that may be steeper than IMPLAUSIBLE_GRADE; beyond it, elevations
are dropped."""
DEEPEST_M: Final = -450.0
"""Lowest plausible elevation of a street, metres."""
HIGHEST_M: Final = 5500.0
"""Highest plausible elevation of a street, metres."""

_SPIKE_M = 3.0
"""A single point that differs by more from both neighbours, in metres, is a false elevation."""
_STEP_M = 0.5
"""Tolerance on the height difference to a zero elevation, metres."""
_ZERO_REACH_M = 12.0
"""Zero elevations are compared with nonzero ones within this distance, metres."""
_SIGMA_M = 4.0
"""Standard deviation of the Gaussian weights of the terrain, metres."""
_REACH_M = 12.0
"""The terrain follows the profile within this distance, metres."""
_KERB_M = 6.0
"""Within this distance of a street, in metres, the terrain follows streets only."""
_NEIGHBOURS = 24
"""Number of profile points that a lattice point averages."""
_FILL_ROUNDS = 40
"""Number of smoothing passes over the land between streets."""

_Ints = NDArray[np.intp]
On = Literal["street", "path", "steps", "raised"]


@dataclass(frozen=True, slots=True)
class Course:
    """A polyline of a net with elevations.

    edge: SUMO edge id.
    points: (N, 3) metres, NaN for a missing elevation.
    on: kind of ground; "path" without vehicles, "raised" for bridges and tunnels.
    ring: whether it is the outline of a walking area.
    """

    edge: str
    points: Floats
    on: On = "street"
    ring: bool = False


class CourseJunction(NamedTuple):
    """A walking area and the courses that end at it.

    ring: index of its outline among the courses.
    ports: index of a course, and 0 for the start of its line or 1 for its end.
    """

    ring: int
    ports: tuple[tuple[int, int], ...]


def parse_course(edge: str, shape: str, on: On = "street", ring: bool = False) -> Course:
    """Parse a shape of points "x,y" and "x,y,z", in any mixture.

    netconvert omits an elevation of 0, and writes 0 for an unknown one.
    """
    rows = [[float(value) for value in point.split(",")] for point in shape.split()]
    points = np.array([[*row[:2], row[2] if len(row) > 2 else 0.0] for row in rows])
    return Course(edge, points, on, ring)


def off_ground(params: Mapping[str, str], kind: str) -> bool:
    """Return whether the params or the type of an edge say that it is a bridge or a tunnel."""
    if any(params.get(key, "no") not in GROUND for key in ("bridge", "tunnel")):
        return True
    return params.get("layer", "0") not in ("0", "") or kind.endswith(("_bridge", "_tunnel"))


def kind_at(kind: str, params: Mapping[str, str], apart: bool) -> On:
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
    """Points every few metres along all courses, and joints between points that are connected by a
    walk or a drive.

    xy: (N, 2) metres.
    z: (N,) heights, metres.
    street: (N,) whether WALK_GRADE_MAX applies.
    tail, head: (E,) indices of the points of each joint.
    run_m: (E,) horizontal lengths of the joints.
    """

    xy: Floats
    z: Floats
    street: NDArray[np.bool_]
    tail: _Ints
    head: _Ints
    run_m: Floats

    @classmethod
    def of(cls, courses: Sequence[Course], meets: Sequence[CourseJunction]) -> Profile:
        rows = []
        tails = []
        heads = []
        first = [0]
        streets: list[NDArray[np.bool_]] = []
        for c in courses:
            points = _resampled(c)
            start = first[-1]
            n = len(points)
            rows.append(points)
            streets.append(np.full(n, c.on == "street"))
            first.append(start + n)
            if n > 1:
                tails.append(start + np.arange(n - 1))
                heads.append(start + np.arange(1, n))
        at = np.concatenate(rows)
        tree = scipy.spatial.cKDTree(at[:, :2])
        pairs = tree.query_pairs(_JOIN_M, output_type="ndarray")
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
        """Return (N,) heights with no joint on streets steeper than WALK_GRADE_MAX."""
        return clamped(self.z, self.tail, self.head, WALK_GRADE_MAX * self.run_m)


def clamped(z_m: Floats, tail: _Ints, head: _Ints, most_m: Floats) -> Floats:
    """Return heights near `z_m` (N,) that differ by at most `most_m` (E,) between `tail` and `head`
    (E,).

    First, every joint that is too steep pulls its ends together, which removes narrow faults
    locally. The rest is set half way between the highest heights below and the lowest above that
    satisfy the bounds.
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
    """Return the highest heights at most `z_m` that satisfy the bounds."""
    z = z_m.copy()
    while True:
        before = z.copy()
        np.minimum.at(z, head, before[tail] + most_m)
        np.minimum.at(z, tail, before[head] + most_m)
        if (before - z).max(initial=0.0) < _NEAR_M:
            return z


def _resampled(c: Course) -> Floats:
    """Resample a course every few metres, (N, 3), with missing elevations interpolated.

    Returns no points for a course without any elevation.
    """
    known = np.isfinite(c.points[:, 2])
    if not known.any():
        return np.zeros((0, 3))
    at = metres_along(c.points)
    count = max(int(np.ceil(at[-1] / _SPACING_M)), 1)
    s = np.linspace(0.0, at[-1], count + 1) if at[-1] > 0.0 else np.zeros(1)
    columns = [np.interp(s, at, c.points[:, k]) for k in (0, 1)]
    return np.column_stack([*columns, np.interp(s, at[known], c.points[known, 2])])


def metres_along(points: Floats) -> Floats:
    """Return the horizontal arc lengths (N,) of (N, 2) points, metres; further columns are
    ignored."""
    return np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(points[:, :2], axis=0).T))])


class NetEdge(Protocol):
    """An edge of a net: its attributes, those of its lanes, and its params."""

    attributes: dict[str, str]
    lanes: list[dict[str, str]]
    params: dict[str, str]


def terrain_of_net(
    edges: Iterable[NetEdge],
    apart: Collection[str],
    walked: Mapping[str, int],
    ports: Mapping[tuple[str, int], str],
) -> tuple[Terrain | None, Elevation | None]:
    """Return the terrain of a net and a report on its elevations, see `terrain_of_courses`.

    Bridges and tunnels count only if they have a walkway.

    apart: edges without vehicles.
    walked: edges with a strip, and the index of its lane.
    ports: walking area at end 0 or 1 of a strip.
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
        on = kind_at(edge.attributes.get("type", ""), edge.params, name in apart and not function)
        if on != "raised" or name in walked:
            first[name] = len(courses)
            courses += [
                parse_course(name, lane["shape"], on, function == "walkingarea")
                for lane in edge.lanes
            ]
    met: dict[str, list[tuple[int, int]]] = defaultdict(list)
    for (strip, end), corner in ports.items():
        if strip in first:
            met[corner].append((first[strip] + walked[strip], end))
    return terrain_of_courses(
        courses, [CourseJunction(first[corner], tuple(found)) for corner, found in met.items()]
    )


def terrain_of_courses(
    courses: Sequence[Course], meets: Sequence[CourseJunction] = ()
) -> tuple[Terrain | None, Elevation | None]:
    """Return the terrain under the courses of a net and a report on its elevations, or None and
    None.

    meets: places where courses join, regardless of their elevations.
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
            found,
            dropped=f"{share:.0%} of the streets' length are steeper than {IMPLAUSIBLE_GRADE:.0%}",
        )
    if np.ptp(street) < 0.5:
        return None, replace(found, dropped="it is the same everywhere")
    nodes = Profile.of(filled, meets)
    level = nodes.clamped()
    moved = np.abs(level - nodes.z)[nodes.street]
    terrain = _terrain(nodes, level)
    return terrain, replace(
        found, clamped=int((moved > CLAMP_THRESHOLD_M).sum()), moved_m=float(moved.max(initial=0.0))
    )


def steep_strips(terrain: Terrain, strips: Sequence[Strip]) -> tuple[str, ...]:
    """Return the ids of strips steeper than ROBOT_GRADE_MAX anywhere on their middle line or
    near their sides."""
    half = [0.4 * strip.width_m for strip in strips]
    found = _steep(terrain, [strip.line for strip in strips], half)
    return tuple(strip.id for strip, is_steep in zip(strips, found, strict=True) if is_steep)


def steep_ports(
    terrain: Terrain, strips: Mapping[str, Strip], corners: Iterable[Corner], steep: Collection[str]
) -> tuple[tuple[str, int], ...]:
    """Return the ports, strip and end, to close so that no straight way across a corner is too
    steep.

    The port with the most steep ways is closed first.
    """
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
    """Return (N,) whether a line is steeper than ROBOT_GRADE_MAX anywhere on it or `half_m` to
    its sides."""
    owner = np.repeat(np.arange(len(lines)), [len(line) for line in lines])
    at, owner = shapely.get_coordinates(
        shapely.segmentize(shapely.linestrings(np.concatenate(lines), indices=owner), 1.0),
        return_index=True,
    )
    same = owner[1:] == owner[:-1]
    middle = (0.5 * (at[1:] + at[:-1]))[same]
    direction = np.diff(at, axis=0)[same]
    owner = owner[1:][same]
    direction /= np.maximum(np.hypot(*direction.T), 1e-9)[:, None]
    aside = np.asarray(half_m)[owner][:, None] * np.column_stack(
        [-direction[:, 1], direction[:, 0]]
    )
    steep = [
        np.hypot(*terrain.gradient(middle + k * aside).T) > ROBOT_GRADE_MAX for k in (-1, 0, 1)
    ]
    return np.asarray(np.bincount(owner, np.any(steep, axis=0), len(lines)) > 0)


def false_share(courses: Sequence[Course]) -> float:
    """Return the share of the streets' length that is steeper than IMPLAUSIBLE_GRADE, without steps
    and bridges."""
    total = false = 0.0
    for c in courses:
        if c.on == "street" and not c.ring:
            run = np.hypot(*np.diff(c.points[:, :2], axis=0).T)
            rise = np.abs(np.diff(c.points[:, 2]))
            there = np.isfinite(rise)
            total += float(run[there].sum())
            false += float(run[there & (rise > IMPLAUSIBLE_GRADE * run + 0.1)].sum())
    return false / total if total > 0.0 else 0.0


def _without_false_points(courses: Sequence[Course], heights: Floats) -> list[Course]:
    """Return the courses with NaN for false elevations: zeros next to heights, and single
    spikes."""
    ends = np.cumsum([len(c.points) for c in courses])[:-1]
    every = np.column_stack([np.concatenate([c.points[:, :2] for c in courses]), heights])
    high = every[np.isfinite(heights) & (heights != 0.0)]
    gap, nearest = scipy.spatial.cKDTree(high[:, :2]).query(
        every[:, :2], distance_upper_bound=_ZERO_REACH_M
    )
    reference_m = high[np.minimum(nearest, len(high) - 1), 2]
    every[(heights == 0.0) & (np.abs(reference_m) > IMPLAUSIBLE_GRADE * gap + _STEP_M), 2] = np.nan
    out = []
    for c, points in zip(courses, np.split(every, ends), strict=True):
        if c.ring and not np.nan_to_num(points[:, 2]).any():
            # Corners repaired on import have lost their elevations; the streets provide them.
            points[:, 2] = np.nan
        _drop_zeros(points)
        _drop_spikes(points)
        on: On = (
            c.on
            if c.on != "path"
            else "steps"
            if _mean_grade(points) > ROBOT_GRADE_MAX
            else "street"
        )
        out.append(Course(c.edge, points, on, c.ring))
    return out


def _drop_zeros(points: Floats) -> None:
    """Set zeros to NaN, in place, that are too far below the elevations along the same course."""
    zero = points[:, 2] == 0.0
    high = ~zero & np.isfinite(points[:, 2])
    if zero.any() and high.any():
        at = metres_along(points)
        reference_m = np.abs(np.interp(at[zero], at[high], points[high, 2]))
        gap = np.abs(at[zero][:, None] - at[high][None]).min(axis=1)
        points[np.flatnonzero(zero)[reference_m > IMPLAUSIBLE_GRADE * gap + _STEP_M], 2] = np.nan


def _drop_spikes(points: Floats) -> None:
    """Set single points to NaN, in place, that differ strongly from both neighbours."""
    known = np.flatnonzero(np.isfinite(points[:, 2]))
    if len(known) < 3:
        return
    x, y, z = points[known].T
    before = z[1:-1] - z[:-2]
    after = z[1:-1] - z[2:]
    run = np.hypot(np.diff(x), np.diff(y))
    off = np.minimum(np.abs(before), np.abs(after))
    steep = (np.abs(before) > 2.0 * IMPLAUSIBLE_GRADE * run[:-1]) & (
        np.abs(after) > 2.0 * IMPLAUSIBLE_GRADE * run[1:]
    )
    spikes = (before * after > 0.0) & (off > _SPIKE_M) & steep
    points[known[1:-1][spikes], 2] = np.nan


def _mean_grade(points: Floats) -> float:
    """Return the total rise and fall of a line per metre of its length."""
    known = points[np.isfinite(points[:, 2])]
    run = float(metres_along(known)[-1]) if len(known) else 0.0
    return float(np.abs(np.diff(known[:, 2])).sum()) / run if run > 0.0 else 0.0


def _terrain(nodes: Profile, level: Floats) -> Terrain:
    """Build the terrain: flat across streets at their heights, smooth between them."""
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
    # Where steps end at a street, the street's height applies.
    for which, reach_m in ((nodes.street, _KERB_M), (np.ones(len(level), dtype=bool), _REACH_M)):
        free = np.flatnonzero(np.isnan(surface))
        surface[free] = _mean_heights(grid[free], nodes.xy[which], level[which], reach_m)
    land: Floats = surface.reshape(rows, columns)
    open_land = ~np.isfinite(land)
    _, (j, i) = scipy.ndimage.distance_transform_edt(open_land, return_indices=True)
    land = land[j, i]
    for _ in range(_FILL_ROUNDS):
        land = np.where(open_land, scipy.ndimage.uniform_filter(land, 3, mode="nearest"), land)
    datum = float(np.floor(land.min()))
    heights = (land - datum).astype(np.float32)
    heights.flags.writeable = False
    return Terrain(float(origin[0]), float(origin[1]), step_m, heights, datum)


def _mean_heights(grid: Floats, xy: Floats, level: Floats, reach_m: float) -> Floats:
    """Return (N,) heights at lattice points: a weighted mean of the nodes on the level of the
    nearest one.

    The result is NaN beyond `reach_m`. Nodes on another terrace are ignored.
    """
    out = np.full(len(grid), np.nan)
    if not len(xy):
        return out
    tree = scipy.spatial.cKDTree(xy)
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
