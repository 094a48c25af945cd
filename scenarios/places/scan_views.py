"""Coverage of the views from a scan's walkable area by its splats."""

from __future__ import annotations

from typing import Final

import numpy as np

from cosim.core.geometry import Floats
from cosim.place.scan import Scan
from physics.scans.clean import walkable_area
from physics.scans.coverage import coverage, view_points

_VIEWS: Final = 24
"""Number of views whose coverage is measured."""


def coverage_of(scan: Scan) -> tuple[Floats, Floats]:
    """Return eyes (K, 3) in metres, and the covered share of each view; empty without splats."""
    if scan.splats is None:
        return np.empty((0, 3)), np.empty(0)
    eyes = view_points(walkable_area(scan.areas), scan.heights, _VIEWS)
    return eyes, coverage(scan.splats, eyes)
