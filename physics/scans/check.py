"""Checks of a scan: axes, scale, winding, ground, and agreement of splats and mesh."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Final, NamedTuple

import numpy as np
import shapely
from numpy.typing import NDArray
from shapely.geometry.base import BaseGeometry

from cosim.core.geometry import Floats
from cosim.place.scan import HeightGrid, ScanArea, ScanMesh, Splats
from physics.scans.clean import above_ground, grid_cells, walkable_area
from physics.scans.findings import Finding, note, refusal, warning
from physics.scans.frame import UP_AXES, Matrix, move, move_splats
from physics.scans.mesh_distance import MeshDistance, areas_of, unit_normals
from physics.scans.ordering import take_splats
from physics.scans.read_splats import QuaternionOrder, RawSplats

MAX_TILT_DEG: Final = 5.0
"""Largest angle between the ground's normal and the stated up axis, in degrees."""
SIZES_M: Final = (5.0, 3000.0)
"""Plausible lengths of a scan in metres."""
MAX_HEIGHT_M: Final = 250.0
"""Largest plausible height of a scan in metres."""
WAY_HEIGHTS_M: Final = (-0.3, 3.0)
"""Plausible heights of a walked way, or of its cameras, over the ground in metres."""
MIN_COVERED: Final = 0.98
"""Share of the walkable area with measured ground below which a warning is given."""
REFUSED_COVERED: Final = 0.5
"""Share of an area with measured ground below which the scan is refused."""
MEDIAN_GAP_M: Final = 0.05
"""Largest median distance of opaque splats to the mesh without a warning, in metres."""
MAX_GAP_M: Final = 0.25
"""Largest distance of 95 % of the opaque splats to the mesh without a warning, in metres."""
GROUND_BIAS_M: Final = 0.03
"""Largest median height of ground splats over the mesh without a warning, in metres."""
REFUSED_GAP_M: Final = 0.5
"""Median distance of opaque splats to the mesh from which the scan is refused, in metres."""
REFUSED_SHIFT_M: Final = 0.3
"""Shift of splats against the mesh from which the scan is refused, in metres."""
_OPAQUE: Final = 128
"""Opacity of 255 from which splats count as opaque."""
_GROUND_REACH_M: Final = 0.4
_MEASURED: Final = 20_000
"""Number of splats that are measured."""
_PLANES: Final = 200
_POINTS: Final = 4000
"""Numbers of random planes and points by which the ground is found."""
_LEVEL: Final = math.cos(math.radians(30.0))
"""Least vertical component of the normal of a level plane."""


class Ground(NamedTuple):
    """Plane of the ground of a mesh.

    normal: unit vector that points up, by what is above the plane.
    support: share of the mesh's area in the plane.
    facing_up: share of that area whose front is above.
    """

    normal: Floats
    support: float
    facing_up: float


def ground_planes(mesh: ScanMesh) -> tuple[Ground, Ground]:
    """Return the plane with most of a mesh's area and little below it, by RANSAC.

    Returns the best plane of all, and the best one within 30 degrees of level.
    """
    corners = mesh.vertices.astype(np.float64)[mesh.triangles]
    areas, normals = areas_of(corners), unit_normals(corners)
    random = np.random.default_rng(0)  # the same planes for the same mesh
    ends = np.cumsum(areas)
    picks = np.minimum(np.searchsorted(ends, random.random(_POINTS) * ends[-1]), len(areas) - 1)
    points, directions = corners[picks].mean(axis=1), normals[picks]
    reach_m = 0.015 * float(np.abs(points - np.median(points, axis=0)).max())
    none = Ground(np.array([0.0, 0.0, 1.0]), 0.0, 1.0)
    best, scores = [none, none], [0.0, 0.0]
    for k in range(_PLANES):
        found = _plane(points, directions, points[k], directions[k], reach_m)
        if found is None:
            continue
        ground, below = found
        score = ground.support * max(0.0, 1.0 - 4.0 * below)
        for which, least in enumerate((-1.0, _LEVEL)):
            if ground.normal[2] >= least and score > scores[which]:
                best[which], scores[which] = ground, score
    return best[0], best[1]


def _plane(
    points: Floats, directions: Floats, at: Floats, normal: Floats, reach_m: float
) -> tuple[Ground, float] | None:
    """Return the plane through a point, refined, and the share of points below it."""
    for _ in range(2):
        away = _dots(points - at, normal)
        turned = _dots(directions, normal)
        inside = (np.abs(away) < reach_m) & (np.abs(turned) > 0.9)
        if np.count_nonzero(inside) < 30:
            return None
        signed = directions[inside] * np.sign(turned[inside])[:, None]
        mean = signed.mean(axis=0)
        normal = mean / math.sqrt(float((mean * mean).sum()))
        at = points[inside].mean(axis=0)
    away = _dots(points - at, normal)
    above, below = float((away > 2 * reach_m).mean()), float((away < -2 * reach_m).mean())
    front = float((_dots(directions[inside], normal) > 0.0).mean())
    # Without anything above or below, the fronts of the triangles decide.
    if below > above + 0.01 or (abs(above - below) <= 0.01 and front < 0.5):
        normal, above, below, front = -normal, below, above, 1.0 - front
    return Ground(normal, float(inside.mean()), front), below


def _dots(vectors: Floats, one: Floats) -> Floats:
    dots: Floats = vectors[:, 0] * one[0] + vectors[:, 1] * one[1] + vectors[:, 2] * one[2]
    return dots


def guess_up(normal: Floats, up: str) -> tuple[str, float]:
    """Return the file's axis that is nearest to a normal, and the angle between them in degrees.

    normal: (3,) in the frame after `up` was applied.
    """
    rows = UP_AXES[up]
    raw = [sum(rows[i][k] * float(normal[i]) for i in range(3)) for k in range(3)]
    axis = max(range(3), key=lambda k: abs(raw[k]))
    angle = math.degrees(math.acos(min(1.0, abs(raw[axis]))))
    return f"{'+' if raw[axis] > 0 else '-'}{'xyz'[axis]}", angle


def check_up(
    mesh: ScanMesh, up: str, level: Callable[[Floats], str] = lambda _: ""
) -> list[Finding]:
    """Check that the ground's normal is within 5 degrees of the stated up axis.

    up: axis of the file; "" if a transform is given in place of it.
    level: returns the option that levels the scan for a normal, "" if there is none.
    """
    overall, ground = ground_planes(mesh)
    if ground.support < 0.4 * overall.support:
        ground = overall
    tilt = math.degrees(math.acos(min(1.0, max(-1.0, float(ground.normal[2])))))
    if tilt <= MAX_TILT_DEG:
        words = f"the ground's normal is {tilt:.1f} degrees off the up axis"
        return [note(words), *_winding(ground)]
    said = f"the stated up axis {up}" if up else "the z axis after the transform"
    axis, angle = guess_up(ground.normal, up or "+z")
    words = f"up: the ground's normal is {tilt:.0f} degrees off {said}; at most 5 are allowed"
    if up and axis != up and angle < 15.0:
        return [refusal(f"{words}: the ground fits {axis} ({angle:.1f} degrees): try --up {axis}")]
    if option := level(ground.normal):
        return [refusal(f"{words}: level the scan before its export, or by {option}")]
    return [
        refusal(
            f"{words}: level the scan before its export, or turn it by --transform "
            f"(normal {', '.join(f'{one:.3f}' for one in ground.normal)})"
        )
    ]


def _winding(ground: Ground) -> list[Finding]:
    """Check that the fronts of ground triangles face up."""
    down = 1.0 - ground.facing_up
    if down > 0.9:
        return [
            refusal(
                f"mirrored: the fronts of {down:.0%} of the ground's triangles face down: axes "
                "are mirrored, or triangles are wound clockwise: use --mirror x if writing on "
                "walls reads backwards in a viewer, else --flip"
            )
        ]
    if down > 0.6:
        words = f"the fronts of {down:.0%} of the ground's triangles face down"
        return [warning(f"{words}: they count as no ground; unify the normals before the export")]
    return []


def check_scale(mesh: ScanMesh) -> list[Finding]:
    """Check that the size of a mesh is that of a place in metres."""
    low, high = np.percentile(mesh.vertices.astype(np.float64), [0.5, 99.5], axis=0)
    length_m, height_m = float((high - low)[:2].max()), float((high - low)[2])
    words = f"scale: the scan is {length_m:.4g} m long and {height_m:.4g} m high"
    if SIZES_M[0] <= length_m <= SIZES_M[1] and height_m <= MAX_HEIGHT_M:
        return [note(words)]
    small = length_m < SIZES_M[0]
    fits = [
        f"--scale {1.0 / factor if small else factor:g}"
        for factor in (0.01, 0.001, 0.1)
        if 20.0 <= length_m * (1.0 / factor if small else factor) <= 1000.0
    ]
    advice = f"; of usual units {' or '.join(fits)} would fit" if fits else ""
    return [
        refusal(
            f"{words}; plausible are {SIZES_M[0]:g} to {SIZES_M[1]:g} m and at most "
            f"{MAX_HEIGHT_M:g} m: give the metres per unit with --scale{advice}"
        )
    ]


def check_way(way_z: Floats, way: Floats, heights: HeightGrid) -> list[Finding]:
    """Check the height of a walked way, or of its cameras, over the ground.

    way_z: (N,) heights. way: (N, 2) m.
    """
    above, known = above_ground(heights, np.column_stack([way, way_z]))
    if not known.any():
        return [refusal("way: no point of it is over measured ground: check frame and scale")]
    middle = float(np.median(above[known]))
    words = f"way: it is {middle:.2f} m over the ground (median)"
    if WAY_HEIGHTS_M[0] <= middle <= WAY_HEIGHTS_M[1]:
        return [note(words)]
    return [
        refusal(
            f"{words}; plausible are {WAY_HEIGHTS_M[0]:g} to {WAY_HEIGHTS_M[1]:g} m: check --scale "
            "and the frame of the way"
        )
    ]


def check_areas(areas: Sequence[ScanArea], heights: HeightGrid) -> list[Finding]:
    """Check that there is a walkable area, and that areas have measured ground below them."""
    walkable = walkable_area(areas)
    if walkable.is_empty:
        return [
            refusal(
                f"areas: no walkable area among {len(areas)} areas: draw at least one of kind "
                "sidewalk or crossing, or give --way with --width"
            )
        ]
    findings = []
    for number, area in enumerate(areas):
        if area.kind in ("sidewalk", "crossing"):
            share = ground_share(area.polygon, heights)
            if share < REFUSED_COVERED:
                findings.append(
                    refusal(
                        f"areas: only {share:.0%} of area {number} ({area.kind}) has ground in "
                        f"the scan; at least {REFUSED_COVERED:.0%} is needed: draw it where the "
                        "scan has ground, or check its frame"
                    )
                )
    share = ground_share(walkable, heights)
    words = f"holes: {share:.1%} of the walkable area has measured ground"
    if share < MIN_COVERED:
        findings.append(
            warning(
                f"{words}, and {MIN_COVERED:.0%} should: heights are interpolated in holes; scan "
                "the ground again, or draw areas around them"
            )
        )
    else:
        findings.append(note(words))
    return findings


def ground_share(area: BaseGeometry, heights: HeightGrid) -> float:
    """Return the share of an area with measured ground, or with an obstacle on it."""
    points = lattice_points(area, heights.step_m)
    if not len(points):
        return 0.0
    row, column, inside = grid_cells(heights, points)
    known = heights.measured | heights.blocked
    return float((inside & known[row, column]).mean())


def lattice_points(area: BaseGeometry, step_m: float) -> Floats:
    """Return the points of a lattice in an area, (N, 2) m."""
    if area.is_empty:
        return np.empty((0, 2))
    x0, y0, x1, y1 = area.bounds
    x = np.arange(math.floor(x0 / step_m), math.ceil(x1 / step_m) + 1) * step_m
    y = np.arange(math.floor(y0 / step_m), math.ceil(y1 / step_m) + 1) * step_m
    shapely.prepare(area)
    grid_x, grid_y = (one.ravel() for one in np.meshgrid(x, y))
    inside = shapely.contains_xy(area, grid_x, grid_y)
    return np.column_stack([grid_x[inside], grid_y[inside]])


def opaque_sample(splats: Splats) -> Splats:
    """Return about _MEASURED opaque splats, evenly over their order."""
    opaque = np.flatnonzero(splats.rgba[:, 3] >= _OPAQUE)
    return take_splats(splats, opaque[:: max(1, math.ceil(len(opaque) / _MEASURED))])


def check_alignment(
    splats: Splats, distance: MeshDistance, heights: HeightGrid, hint: str = ""
) -> list[Finding]:
    """Check that splats lie on the mesh and on its ground.

    hint: remedy if they do not, such as another frame that fits.
    """
    sample = opaque_sample(splats)
    if len(sample) < 100:
        return [
            refusal(
                f"splats: only {len(sample)} opaque ones (opacity over 0.5) are near the mesh: "
                "check their scale, up axis and transform (--splat-scale, --splat-up, "
                f"--splat-transform){hint}"
            )
        ]
    gaps, _ = distance.to_mesh(sample.centres)
    median, most = (float(one) for one in np.percentile(gaps, [50, 95]))
    words = (
        f"splats to mesh: {median:.3f} m (median), 95 % within {most:.2f} m; should be "
        f"{MEDIAN_GAP_M:g} and {MAX_GAP_M:g} m"
    )
    if median > REFUSED_GAP_M:
        return [
            refusal(
                f"{words}; refused from {REFUSED_GAP_M:g} m: splats and mesh have different "
                f"frames: give --splat-scale, --splat-up or --splat-transform{hint}"
            )
        ]
    shift = best_shift(_balanced(sample, heights), distance)
    if shift is not None:
        return [shift]
    fine = median <= MEDIAN_GAP_M and most <= MAX_GAP_M
    advice = ": people may be hidden wrongly by what the mesh lacks"
    return [
        note(words) if fine else warning(words + advice),
        *_ground_bias(sample, heights),
    ]


def _balanced(sample: Splats, heights: HeightGrid) -> Floats:
    """Return places of splats, (N, 3): as many on the ground as above it, if there are enough."""
    above, known = above_ground(heights, sample.centres)
    ground = known & (np.abs(above) < _GROUND_REACH_M)
    parts = [np.flatnonzero(one) for one in (ground, ~ground)]
    picks = [part[:: max(1, len(part) // 350)] for part in parts]
    return sample.centres[np.concatenate(picks)].astype(np.float64)


def best_shift(points: Floats, distance: MeshDistance) -> Finding | None:
    """Return a refusal if a shift of splats at (N, 3) points fits the mesh much better."""

    def share(shift: Floats) -> float:
        return float((distance.to_planes(points + shift, 0.4) < 0.1).mean())

    unmoved = share(np.zeros(3))
    best, found = np.zeros(3), unmoved
    for reach_m, step_m in ((2.0, 0.5), (0.25, 0.25), (0.1, 0.1)):
        steps = np.arange(-round(reach_m / step_m), round(reach_m / step_m) + 1) * step_m
        heights = steps[np.abs(steps) <= 1.0]
        middle = best
        for offset in np.stack(np.meshgrid(steps, steps, heights), axis=-1).reshape(-1, 3):
            shift = middle + offset
            if (there := share(shift)) > found + 1e-3:
                best, found = shift, there
    length_m = math.sqrt(float((best * best).sum()))
    better = found > 1.25 * unmoved + 0.05 or (
        found > unmoved + 0.08 and 1.0 - found < 0.5 * (1.0 - unmoved)
    )
    if length_m < REFUSED_SHIFT_M or not better:
        return None
    return refusal(
        f"splats lie {length_m:.1f} m beside the mesh: {unmoved:.0%} of a sample are "
        f"within 0.1 m of it, and {found:.0%} after a shift by "
        f"({', '.join(f'{one:+.1f}' for one in best)}) m: add it to the translation of "
        "--splat-transform"
    )


def _ground_bias(sample: Splats, heights: HeightGrid) -> list[Finding]:
    above, known = above_ground(heights, sample.centres)
    row, column, _ = grid_cells(heights, sample.centres)
    near = known & (np.abs(above) < _GROUND_REACH_M) & ~heights.blocked[row, column]
    if np.count_nonzero(near) < 100:
        return []
    bias = float(np.median(above[near]))
    side = "over" if bias >= 0.0 else "below"
    words = f"ground splats are {abs(bias):.3f} m {side} the mesh's ground (median)"
    if abs(bias) <= GROUND_BIAS_M:
        return [note(words)]
    return [
        warning(f"{words}; at most {GROUND_BIAS_M:g} m: wheels and feet look sunken or floating")
    ]


def fitting_frame(
    raw_centres: NDArray[Any], frames: Mapping[str, Matrix], distance: MeshDistance
) -> str:
    """Return advice with the frame in which most splats lie on the mesh; "" if none fits well.

    raw_centres: (N, 3) in the file's frame.
    frames: matrices from it to the net's frame, by the options that give them.
    """
    points = raw_centres[:: max(1, len(raw_centres) // 2000)]
    best, advice = 0.3, ""
    for words, matrix in frames.items():
        share = float((distance.to_planes(move(points, matrix), 0.5) < 0.15).mean())
        if share > best + 0.02:
            best, advice = share, f"; {words} fits: {share:.0%} within 0.15 m"
    return advice


def check_rotations(
    raw: RawSplats, matrix: Matrix, order: QuaternionOrder, distance: MeshDistance
) -> list[Finding]:
    """Check the order of quaternions: flat splats lie along the mesh's surface in the right one.

    matrix: from the file's frame to the net's.
    """
    opaque = np.flatnonzero(raw.rgba[:, 3] >= _OPAQUE)
    rows = opaque[:: max(1, len(opaque) // 6000)]
    scales = np.sort(raw.scales[rows], axis=1)
    rows = rows[scales[:, 0] < 0.3 * scales[:, 1]]
    gaps, owners = distance.to_mesh(move(raw.centres[rows], matrix))
    near = gaps < 0.2
    if np.count_nonzero(near) < 200:
        return []
    rows, normals = rows[near], distance.normals[owners[near]]
    other: QuaternionOrder = "xyzw" if order == "wxyz" else "wxyz"
    columns = [3, 0, 1, 2] if order == "wxyz" else [1, 2, 3, 0]
    shares = [
        _along(
            RawSplats(raw.centres[rows], raw.scales[rows], quaternions, raw.rgba[rows]),
            matrix,
            normals,
        )
        for quaternions in (raw.quaternions[rows], raw.quaternions[rows][:, columns])
    ]
    words = f"{shares[0]:.0%} of the flat splats lie along the mesh's surface"
    if shares[1] < 1.15 * shares[0] + 0.02:
        return [note(words)]
    return [
        warning(
            f"{words}, and {shares[1]:.0%} with rotations stored as {other}: try --quaternions "
            f"{other}"
        )
    ]


def _along(raw: RawSplats, matrix: Matrix, normals: Floats) -> float:
    """Return the share of splats whose shortest axis is along a normal."""
    xx, xy, xz, yy, yz, zz = move_splats(raw, matrix).covariances.astype(np.float64).T
    matrices = np.stack([xx, xy, xz, xy, yy, yz, xz, yz, zz], axis=1).reshape(-1, 3, 3)
    _, vectors = np.linalg.eigh(matrices)
    return float((np.abs((vectors[:, :, 0] * normals).sum(axis=1)) > 0.8).mean())
