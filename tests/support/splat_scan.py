"""A scanned street of flat ground and a wall, with a mesh and splats of the same surfaces; and a
slow reference rasteriser of splats."""

from __future__ import annotations

import hashlib

import numpy as np
import shapely

from cosim.core.geometry import Floats
from cosim.core.state import LABELS
from cosim.place.scan import HeightGrid, Scan, ScanArea, ScanFacts, ScanMesh, ScanSun, Splats
from physics.cameras.gl import context
from physics.cameras.gl.splat_sort import Tuning
from physics.cameras.gl.splats import SplatCloud, SplatDrawing, SplatTarget, Views
from physics.cameras.view import Shot, shot

AHEAD = shot((0.0, 0.0, 0.0), (1.0, 0.02, -0.05), (160, 96), 60.0)
"""View of random splats."""
SIDE_M = 14.0
WALL_X_M = 6.0
WALL_Y_M = (0.0, 6.0)
WALL_HIGH_M = 2.6
_SPACING_M = 0.12


def covariances(axes: Floats, sizes: Floats) -> np.ndarray:
    """Return (N, 6) covariances of (N, 3, 3) axes in columns with (N, 3) standard deviations."""
    factors = axes * sizes[:, None, :]
    matrices = factors @ factors.transpose(0, 2, 1)
    return matrices[:, (0, 0, 0, 1, 1, 2), (0, 1, 2, 1, 2, 2)].astype(np.float32)


def turns(rng: np.random.Generator, count: int) -> Floats:
    """Return (count, 3, 3) random rotations."""
    return np.linalg.qr(rng.normal(size=(count, 3, 3)))[0]


def street_scan(
    *, opacity: int = 255, noise_m: float = 0.05, sun: ScanSun | None = None, walled: bool = True
) -> Scan:
    """Return flat ground with a wall across its left half, x ahead.

    noise_m: of the splats.
    walled: whether the mesh has the wall, too.
    """
    rng = np.random.default_rng(5)
    at = np.arange(-SIDE_M, SIDE_M, _SPACING_M)
    x, y = (part.ravel() for part in np.meshgrid(at, at))
    ground = np.column_stack([x, y, np.zeros(len(x))])
    y, z = (
        part.ravel()
        for part in np.meshgrid(
            np.arange(*WALL_Y_M, _SPACING_M), np.arange(0.0, WALL_HIGH_M, _SPACING_M)
        )
    )
    wall = np.column_stack([np.full(len(y), WALL_X_M), y, z])
    centres = np.concatenate([ground, wall])
    centres += rng.normal(0.0, noise_m, centres.shape)
    sizes = np.full((len(centres), 3), 0.1)
    sizes[: len(ground), 2] = sizes[len(ground) :, 0] = 0.01
    count = len(centres)
    rgba = np.empty((count, 4), dtype=np.uint8)
    rgba[: len(ground), :3], rgba[len(ground) :, :3] = (120, 130, 110), (200, 60, 40)
    rgba[:, :3] = np.clip(rgba[:, :3] + rng.integers(-15, 16, (count, 3)), 0, 255)
    rgba[:, 3] = opacity
    splats = Splats(
        centres.astype(np.float32),
        covariances(np.tile(np.eye(3), (count, 1, 1)), sizes),
        rgba,
        np.arange(count) < len(ground),
    )
    return Scan(_facts(sun, walled), _mesh(walled), _heights(), _areas(), splats)


def _facts(sun: ScanSun | None, walled: bool) -> ScanFacts:
    identity = tuple(tuple(map(float, row)) for row in np.eye(4))
    return ScanFacts(
        name="street",
        files={},
        scale=1.0,
        up="+z",
        transform=identity,
        sun=sun,
        mesh_hash="splat-street" if walled else "splat-street without a wall",
        areas_hash="splat-street",
    )


def _mesh(walled: bool) -> ScanMesh:
    s = SIDE_M
    (y0, y1) = WALL_Y_M
    vertices = np.array(
        [(-s, -s, 0), (s, -s, 0), (s, s, 0), (-s, s, 0)]
        + [(WALL_X_M, y, z) for y in (y0, y1) for z in (0.0, WALL_HIGH_M)],
        dtype=np.float32,
    )
    triangles = np.array([(0, 1, 2), (0, 2, 3), (4, 5, 7), (4, 7, 6)], dtype=np.int32)
    triangles = triangles if walled else triangles[:2]
    colours = np.concatenate([np.tile((120, 130, 110), (4, 1)), np.tile((200, 60, 40), (4, 1))])
    labels = np.array([LABELS["sidewalk"]] * 2 + [LABELS["building"]] * 2, dtype=np.uint8)
    return ScanMesh(vertices, triangles, colours.astype(np.uint8), labels[: len(triangles)])


def _heights() -> HeightGrid:
    count = round(2 * SIDE_M / 0.25) + 1
    flat = np.zeros((count, count), dtype=np.float32)
    return HeightGrid(np.full(2, -SIDE_M), 0.25, flat, flat == 0.0, flat != 0.0)


def _areas() -> tuple[ScanArea, ...]:
    return (ScanArea("sidewalk", shapely.box(-SIDE_M, -SIDE_M, SIDE_M, SIDE_M)),)


def random_splats(seed: int, count: int = 300) -> Splats:
    """Return splats before an eye at the origin that looks along x: blobs, needles, huge ones, some
    behind the eye, some transparent or opaque."""
    rng = np.random.default_rng(seed)
    centres = np.column_stack([rng.uniform(0.5, 12.0, count), *rng.uniform(-4.0, 4.0, (2, count))])
    sizes = np.exp(rng.uniform(-4.5, -0.7, (count, 3)))
    needles, huge, behind = (slice(k * 25, k * 25 + 25) for k in range(3))
    sizes[needles] = (2.0, 0.002, 0.002)
    sizes[huge] = rng.uniform(1.0, 6.0, (25, 3))
    centres[huge, 0] += 4.0
    centres[behind, 0] *= -1.0
    rgba = rng.integers(0, 256, (count, 4)).astype(np.uint8)
    rgba[75:95, 3], rgba[95:115, 3] = 0, 255
    rgba[huge, 3] = rng.integers(0, 60, 25)
    return Splats(
        centres.astype(np.float32),
        covariances(turns(rng, count), sizes),
        rgba,
        np.zeros(count, dtype=bool),
    )


def drawn(
    splats: Splats, taken: Shot = AHEAD, tuning: Tuning | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Return premultiplied colour with transmittance, and median depth, as the camera draws them."""
    return drawn_together(splats, [taken], tuning)[0]


def drawn_together(
    splats: Splats, views: list[Shot], tuning: Tuning | None = None
) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return what `drawn` does for views of one size that are drawn together."""
    height = views[0].size[1]
    with context.context() as gl:
        cloud, drawing, target = (
            SplatCloud(gl, splats),
            SplatDrawing(gl, tuning),
            SplatTarget(gl, views[0].size, len(views)),
        )
        drawing.draw(cloud, Views.of(views), target, limited=False)
        colour, median = target.read()
        for thing in (cloud, drawing, target):
            thing.release()
    rows = [slice(k * height, (k + 1) * height) for k in range(len(views))]
    return [(colour[one], median[one]) for one in rows]


def picture_hash() -> str:
    """Return the hash of a picture of many random splats."""
    return hashlib.sha256(
        b"".join(part.tobytes() for part in drawn(random_splats(2, 9000)))
    ).hexdigest()


def reference_picture(splats: Splats, taken: Shot) -> tuple[Floats, Floats]:
    """Draw splats in float64, each over all pixels.

    Returns premultiplied colour with transmittance (H, W, 4), and median depth (H, W), 0 for none.
    """
    width, height = taken.size
    focal = 0.5 * height / taken.half_picture[1]
    lattice = np.round(taken.eye_m / 0.25) * 0.25
    x, y = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    colour, left, median = np.zeros((height, width, 3)), np.ones((height, width)), np.zeros_like(x)
    view = taken.axes * np.array([[1.0], [-1.0], [1.0]])
    for i in _near_to_far(splats.centres.astype(float) - lattice):
        u, v, z = view @ (splats.centres[i].astype(float) - taken.eye_m)
        opacity = splats.rgba[i, 3] / 255.0
        if z <= 0.2 or opacity == 0.0:
            continue
        xx, xy, xz, yy, yz, zz = splats.covariances[i].astype(float)
        covariance = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
        limit = 1.3 * np.array(taken.half_picture)
        tu, tv = np.clip((u / z, v / z), -limit, limit)
        jacobian = focal / z * np.array([[1.0, 0.0, -tu], [0.0, 1.0, -tv]]) @ view
        flatter = covariance @ covariance
        (a, b), (_, c) = jacobian @ flatter @ jacobian.T
        zu, zv = jacobian @ flatter @ view[2]
        slope = np.array([c * zu - b * zv, a * zv - b * zu]) / ((1.0 + 1e-4) * a * c - b * b)
        flat = np.linalg.inv(jacobian @ covariance @ jacobian.T + 0.3 * np.eye(2))
        dx, dy = x - 0.5 * width - focal * u / z, y - 0.5 * height - focal * v / z
        power = flat[0, 0] * dx * dx + 2.0 * flat[0, 1] * dx * dy + flat[1, 1] * dy * dy
        alpha = opacity * np.exp(-0.5 * power)
        share = np.where(alpha >= 1.0 / 255.0, alpha, 0.0) * left
        colour += share[..., None] * splats.rgba[i, :3] / 255.0
        left = left - share
        aside = np.clip(slope[0] * dx + slope[1] * dy, -0.3 * z, 0.3 * z)
        median = np.where((median == 0.0) & (left < 0.5), z * z / (z - aside), median)
    return np.concatenate([colour, left[..., None]], axis=2), median


def _near_to_far(offsets: Floats) -> np.ndarray:
    """Return the order by squared distance, in 2048 steps to a factor of two from 0.25 m on."""
    fraction, exponent = np.frexp(np.maximum((offsets**2).sum(axis=1), 2.0**-4))
    return np.argsort(exponent * 2048 + np.floor((2.0 * fraction - 1.0) * 2048), kind="stable")
