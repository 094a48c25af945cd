"""Flat scans and drawn areas, small enough to check by hand."""

from __future__ import annotations

from importlib.metadata import version
from pathlib import Path

import numpy as np
import shapely

from cosim.place.scan import HeightGrid, ScanArea
from sumo_nets.maps.import_rules import IMPORTER_VERSION
from sumo_nets.maps.map_store import About, store_map
from sumo_nets.maps.scan_net import build_scan_net


def flat_grid(
    x0: float, y0: float, x1: float, y1: float, step_m: float = 0.25, height_m: float = 0.0
) -> HeightGrid:
    """Return level ground, all of it measured and free."""
    shape = (round((y1 - y0) / step_m) + 1, round((x1 - x0) / step_m) + 1)
    return HeightGrid(
        np.array([x0, y0]),
        step_m,
        np.full(shape, height_m, dtype=np.float32),
        np.ones(shape, dtype=bool),
        np.zeros(shape, dtype=bool),
    )


STREET_GRID = flat_grid(-5.0, -5.0, 105.0, 65.0)


def street_areas() -> list[ScanArea]:
    """Return a street of 100 m with sidewalks of 3 and 4 m, a crossing, an obstacle, and a side
    path."""
    box = shapely.box
    return [
        ScanArea("sidewalk", box(0.0, 0.0, 100.0, 3.0)),
        ScanArea("sidewalk", box(0.0, 10.0, 100.0, 14.0)),
        ScanArea("sidewalk", box(97.0, 14.0, 100.0, 60.0)),
        ScanArea("road", box(0.0, 3.0, 100.0, 10.0)),
        ScanArea("crossing", box(48.0, 3.0, 52.0, 10.0)),
        ScanArea("obstacle", box(70.0, 1.5, 71.0, 2.2)),
    ]


def store_flat(name: str, areas: list[ScanArea], grid: HeightGrid = STREET_GRID) -> tuple[str, ...]:
    """Store a flat scan as a map, without a mesh, and return the findings of its net."""
    findings: list[str] = []

    def fill(ready: Path) -> About:
        findings.extend(build_scan_net(areas, grid, None, ready).findings)
        return About(
            name=name,
            source=name,
            source_hash="0" * 16,
            format="scan",
            imported_at="",
            bbox=None,
            lefthand=None,
            versions={"importer": str(IMPORTER_VERSION), "eclipse-sumo": version("eclipse-sumo")},
            changes=tuple(findings),
            guessed_share=None,
            licences=(),
            net_hash="",
        )

    store_map(name, fill)
    return tuple(findings)
