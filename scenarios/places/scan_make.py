"""Making of generated scans from generated cities."""

from __future__ import annotations

from pathlib import Path

import shapely

from cosim.core.errors import UsageError, unwritable
from cosim.core.progress import Progress, ignore
from cosim.place.street_map import StreetMap
from cosim.spec.scenario import City, Light
from physics.scans.generate import SPACING_M, Box, write_generated_scan
from physics.street.street_surface import StreetSurface
from scenarios.places.nets import place

SPACINGS_M = (0.03, 0.5)
"""Smallest and largest distance between splats of a generated scan in metres."""
MAX_M = 300.0
"""Maximum side of a generated scan in metres."""
MIN_M = 10.0
"""Minimum side of a generated scan in metres."""


def make_scan(
    city: City,
    box: Box | None,
    folder: Path,
    *,
    light: Light | None = None,
    spacing_m: float = SPACING_M,
    progress: Progress = ignore,
) -> int:
    """Write a part of a city as a scan for `cosim scan import`. Returns the number of splats.

    box: x0, y0, x1, y1 in metres of the city's frame; None for 80 x 60 m around the crossing that
        is nearest to the middle of the city.
    Raises UsageError for an unusable box or spacing, MachineError if the folder cannot be written.
    """
    _, street_map = place(city)
    box = crossing_box(street_map) if box is None else box
    x0, y0, x1, y1 = box
    if not all(MIN_M <= side <= MAX_M for side in (x1 - x0, y1 - y0)):
        raise UsageError(
            f"--box must be x0,y0,x1,y1 with sides of {MIN_M:g} to {MAX_M:g} m, not "
            f"{x1 - x0:g} x {y1 - y0:g} m"
        )
    if not shapely.box(*street_map.bounds).contains(shapely.box(*box)):
        low_x, low_y, high_x, high_y = street_map.bounds
        raise UsageError(
            f"--box {x0:g},{y0:g},{x1:g},{y1:g} is not within the city, which covers "
            f"{low_x:g},{low_y:g} to {high_x:g},{high_y:g}"
        )
    low_m, high_m = SPACINGS_M
    if not low_m <= spacing_m <= high_m:
        raise UsageError(f"--spacing must be {low_m:g} to {high_m:g} metres, not {spacing_m:g}")
    surface = StreetSurface(street_map, city.seed, city.roughness)
    try:
        return write_generated_scan(surface, box, folder, light, spacing_m, progress)
    except OSError as error:
        raise unwritable(folder, error, "give another folder with --out") from error


def crossing_box(street_map: StreetMap) -> Box:
    """Return the box around the crossing nearest to the middle of a city."""
    x0, y0, x1, y1 = street_map.bounds
    middle = shapely.Point(0.5 * (x0 + x1), 0.5 * (y0 + y1))
    crossings = [s.polygon.centroid for s in street_map.strips.values() if s.kind == "crossing"]
    if not crossings:
        raise UsageError("the city has no crossing: give --box")
    x, y = min(crossings, key=middle.distance).coords[0]
    return x - 40.0, y - 30.0, x + 40.0, y + 30.0
