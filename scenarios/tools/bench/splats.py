"""Measures frames per second of scanned places: a street of a chosen number of splats, with people.

The robot drives on from frame to frame, so that splats are sorted again for each picture.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np
import shapely

from cosim.core.geometry import Floats, Pose
from cosim.core.state import LABELS, RobotState, Street
from cosim.place.scan import HeightGrid, Scan, ScanArea, ScanFacts, ScanMesh, ScanSun, Splats
from cosim.spec.camera import CameraSpec
from cosim.spec.run_config import Appearance
from scenarios.tools.bench.cameras import (
    SIZE,
    BusyStreet,
    busy_street_at,
    camera_city,
    median_s,
    one_ahead,
)

STEP_M: Final = 0.3
"""Distance of the robot from frame to frame, metres: more than the lattice of eyes."""
_LONG_M: Final = 80.0
_WIDE_M: Final = 12.0
_HIGH_M: Final = 8.0
_MESH_M: Final = 1.0
_GRID_M: Final = 0.25


def scanned_street(count: int) -> Scan:
    """Return a street with two fronts: about `count` splats of their surfaces, and their mesh."""
    area = _LONG_M * (_WIDE_M + 2.0 * _HIGH_M)
    spacing = math.sqrt(area / count)
    ground, fronts = _surfaces(spacing)
    centres = np.concatenate([ground, fronts])
    rng = np.random.default_rng(11)
    centres += rng.normal(0.0, 0.1 * spacing, centres.shape)
    size = np.full((len(centres), 3), (0.8 * spacing) ** 2)
    size[: len(ground), 2] = size[len(ground) :, 1] = (0.1 * spacing) ** 2
    covariances = np.zeros((len(centres), 6), dtype=np.float32)
    covariances[:, (0, 3, 5)] = size
    rgba = rng.integers(60, 200, (len(centres), 4)).astype(np.uint8)
    rgba[:, 3] = rng.integers(90, 256, len(centres))
    splats = Splats(
        centres.astype(np.float32), covariances, rgba, np.arange(len(centres)) < len(ground)
    )
    return Scan(_facts(count), _mesh(), _flat(), _area(), splats)


def scanned_frame(
    appearance: Appearance, count: int, persons: int, frames: int, size_m: float
) -> float:
    """Time a whole picture of a scanned street; median seconds."""
    from physics.cameras.choice import camera_of
    from physics.dynamics.world import BulletWorld
    from physics.street.scan_surface import ScanSurface

    world = BulletWorld(ScanSurface(camera_city(size_m), scanned_street(count), 0))
    busy, robots = _driving(persons, frames)
    spec = CameraSpec(*SIZE, fov_deg=60.0)
    with camera_of("gl", world, spec, appearance=appearance) as eyes:
        return median_s(lambda street: eyes.render(robots[street.tick], street), busy.streets)


def scanned_together(
    environments: int, count: int, persons: int, frames: int, size_m: float
) -> float:
    """Time pictures of several environments in one scanned street, drawn into one atlas.

    Returns: median seconds of one environment's picture
    """
    from physics.cameras.gl.atlas import Atlas
    from physics.dynamics.world import BulletWorld
    from physics.street.scan_surface import ScanSurface

    world = BulletWorld(ScanSurface(camera_city(size_m), scanned_street(count), 0))
    busy, robots = _driving(persons, frames + environments)
    with Atlas(CameraSpec(*SIZE, fov_deg=60.0)) as eyes:
        keys = [eyes.join(world) for _ in range(environments)]

        def begin(street: Street) -> None:
            eyes.begin([(key, robots[street.tick + k], street) for k, key in enumerate(keys)])

        return median_s(one_ahead(begin, eyes.end), busy.streets[:frames]) / environments


def _driving(persons: int, frames: int) -> tuple[BusyStreet, list[RobotState]]:
    start = Pose(-0.4 * _LONG_M, 0.5, 0.0)
    robots = [
        RobotState(Pose(start.x_m + STEP_M * (k % 100), start.y_m, 0.0)) for k in range(frames)
    ]
    return busy_street_at(start, persons, frames), robots


def _surfaces(spacing: float) -> tuple[Floats, Floats]:
    """Return points of the ground and of the fronts."""
    x = np.arange(-0.5 * _LONG_M, 0.5 * _LONG_M, spacing)
    gx, gy = (
        part.ravel() for part in np.meshgrid(x, np.arange(-0.5 * _WIDE_M, 0.5 * _WIDE_M, spacing))
    )
    fx, fz = (part.ravel() for part in np.meshgrid(x, np.arange(0.0, _HIGH_M, spacing)))
    ground = np.column_stack([gx, gy, np.zeros(len(gx))])
    sides = [
        np.column_stack([fx, np.full(len(fx), y), fz]) for y in (-0.5 * _WIDE_M, 0.5 * _WIDE_M)
    ]
    return ground, np.concatenate(sides)


def _facts(count: int) -> ScanFacts:
    whole = tuple(tuple(map(float, row)) for row in np.eye(4))
    sun = ScanSun(azimuth_deg=140.0, elevation_deg=45.0)
    name = f"bench-{count}"
    return ScanFacts(
        name=name,
        files={},
        scale=1.0,
        up="+z",
        transform=whole,
        sun=sun,
        mesh_hash="bench-street",
        areas_hash="bench-street",
    )


def _mesh() -> ScanMesh:
    """Return ground and fronts as squares of a metre."""
    vertices: list[Floats] = []
    triangles = []
    labels = []
    columns = round(_LONG_M / _MESH_M) + 1
    for label, points in zip(("sidewalk", "building", "building"), _sheets(), strict=True):
        rows = len(points) // columns
        first = (np.arange(rows - 1)[:, None] * columns + np.arange(columns - 1)).ravel()
        a, b, c, d = first, first + 1, first + columns + 1, first + columns
        start = sum(len(part) for part in vertices)
        triangles.append(start + np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)]))
        labels.append(np.full(len(triangles[-1]), LABELS[label]))
        vertices.append(points)
    at = np.concatenate(vertices).astype(np.float32)
    return ScanMesh(
        at,
        np.concatenate(triangles).astype(np.int32),
        np.full((len(at), 3), 130, dtype=np.uint8),
        np.concatenate(labels).astype(np.uint8),
    )


def _sheets() -> list[Floats]:
    x = np.linspace(-0.5 * _LONG_M, 0.5 * _LONG_M, round(_LONG_M / _MESH_M) + 1)
    half = 0.5 * _WIDE_M
    found = []
    for low, high in (((-half, 0.0), (half, 0.0)), ((half, 0.0), (half, _HIGH_M))):
        steps = round(math.dist(low, high) / _MESH_M) + 1
        across = np.linspace(low, high, steps)
        row, column = (part.ravel() for part in np.meshgrid(np.arange(steps), x, indexing="ij"))
        found.append(np.column_stack([column, across[row.astype(int)]]))
    mirrored = found[1] * np.array([1.0, -1.0, 1.0])
    columns = len(x)
    # The other front is seen from the other side.
    return [*found, mirrored.reshape(-1, columns, 3)[::-1].reshape(-1, 3)]


def _flat() -> HeightGrid:
    shape = tuple(round(side / _GRID_M) + 1 for side in (_WIDE_M, _LONG_M))
    zero = np.zeros(shape, dtype=np.float32)
    origin = np.array([-0.5 * _LONG_M, -0.5 * _WIDE_M])
    return HeightGrid(origin, _GRID_M, zero, zero == 0.0, zero != 0.0)


def _area() -> tuple[ScanArea, ...]:
    half = 0.5 * _LONG_M, 0.5 * _WIDE_M
    return (ScanArea("sidewalk", shapely.box(-half[0], -half[1], *half)),)
