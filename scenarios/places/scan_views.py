"""Coverage of the views from a scan's walkable area by its splats."""

from __future__ import annotations

import numpy as np

from cosim.core.geometry import Floats
from cosim.place.scan import Scan
from physics.scans.clean import walkable_area
from physics.scans.coverage import coverage, view_points


def coverage_of(scan: Scan, views: int = 24) -> tuple[Floats, Floats]:
    """Return eyes (K, 3) in metres, and the covered share of each view; empty without splats."""
    if scan.splats is None:
        return np.empty((0, 3)), np.empty(0)
    eyes = view_points(walkable_area(scan.areas), scan.heights, views)
    return eyes, coverage(scan.splats, eyes)
