"""Maps from above: a whole map with its problems marked, or a scenario before it is run."""

from __future__ import annotations

from pathlib import Path
from typing import Final

import cv2
import numpy as np
import shapely

from cosim.core.errors import UsageError, unwritable
from cosim.core.files import write_atomic
from cosim.place.map_check import MapCheck
from cosim.place.street_map import StreetMap, Strip
from cosim.report.above import TRACK, Sheet, draw_streets
from cosim.report.legend import Image, Rgb255, legend

_MARGIN_M: Final = 20.0
SIGNAL: Final[Rgb255] = (30, 150, 60)
MARKS: Final[dict[str, tuple[Rgb255, str]]] = {
    "island": ((200, 60, 200), "cut off from the main island"),
    "narrow": ((230, 140, 0), "narrower than 1 m"),
    "on_road": ((220, 0, 0), "mostly on the road"),
    "stacked": ((250, 90, 60), "over or under a road"),
    "driven_over": ((150, 0, 90), "cars turn over the corner"),
    "never_green": ((120, 0, 0), "signal never green"),
    "always_green": ((0, 120, 200), "signal always green"),
    "misfit": ((90, 60, 30), "signal without a program that fits"),
    "steep": ((120, 40, 160), "too steep for robots"),
    "level": ((40, 60, 220), "bridge or tunnel"),
}
"""Colour and meaning of each kind of problem."""


def draw_map(
    street_map: StreetMap,
    check: MapCheck,
    part: tuple[float, float, float, float] | None = None,
    credit: str = "",
) -> Image:
    """Draw a map with its problems: (H, W, 3) uint8 RGB.

    part: x0, y0, x1, y1 in metres; None for the whole map
    credit: attribution of the map data
    """
    x0, y0, x1, y1 = street_map.bounds if part is None else part
    margin_m = _MARGIN_M if part is None else 0.0
    bounds = (x0 - margin_m, y0 - margin_m, x1 + margin_m, y1 + margin_m)
    sheet = Sheet(bounds)
    area = shapely.box(*bounds)
    draw_streets(sheet, street_map, area)
    for strip in street_map.near("strip", area):
        if isinstance(strip, Strip) and strip.signalised:
            middle = strip.line[:, :2].mean(axis=0)
            sheet.dot(middle[None], SIGNAL, 1.2)
    for problem in check.problems:
        colour, _ = MARKS[problem.kind]
        if problem.piece in street_map.strips:
            sheet.line(street_map.strips[problem.piece].line[:, :2], colour, 1.0)
        sheet.dot(np.array([[problem.x_m, problem.y_m]]), colour, 4.0, filled=False)
    _scale_bar(sheet, bounds)
    return legend(sheet.image, [*_facts(check), *([(credit, TRACK)] if credit else [])])


def write_png(image: Image, path: Path) -> None:
    """Write an RGB picture.

    Raises UsageError for a name without .png, MachineError if it cannot be written.
    """
    if path.suffix.lower() != ".png":
        raise UsageError(f"{path}: cannot be written as a picture; use a name that ends in .png")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        write_atomic(
            path, cv2.imencode(".png", cv2.cvtColor(image, cv2.COLOR_RGB2BGR))[1].tobytes()
        )
    except OSError as error:
        raise unwritable(path, error) from error


def _facts(check: MapCheck) -> list[tuple[str, Rgb255]]:
    """Return the legend: size of the map and meaning of each colour."""
    kinds = [kind for kind in MARKS if any(problem.kind == kind for problem in check.problems)]
    crossings = f"{check.crossings} crossings, {check.signalised} with signals"
    words = f"{check.name}  {check.walkable_km:.1f} km walkable, {crossings}"
    return [(words, TRACK), *((MARKS[kind][1], MARKS[kind][0]) for kind in kinds)]


def _scale_bar(sheet: Sheet, bounds: tuple[float, float, float, float]) -> None:
    """Draw a scale bar of a round number of metres in the lower left corner."""
    width_m = bounds[2] - bounds[0]
    bar_m = max(
        b
        for b in (1, 2, 5, 10, 20, 50, 100, 200, 500, 1000, 2000, 5000)
        if b == 1 or b <= width_m / 5.0
    )
    x, y = bounds[0] + 0.02 * width_m, bounds[1] + 0.02 * width_m
    sheet.line(np.array([[x, y], [x + bar_m, y]]), TRACK, width_m / 400.0)
    sheet.text((x, y), f"{bar_m} m", TRACK)
