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
from cosim.report.above import (
    BARRIER,
    EVENT,
    OBSTACLE,
    PX_PER_M,
    ROUTE,
    TRACK,
    USUAL_PX,
    Bounds,
    Sheet,
    draw_ends_and_events,
    draw_route_and_objects,
    draw_streets,
)
from cosim.report.legend import Image, Rgb255, legend
from cosim.spec.scenario import Scenario

_MARGIN_M: Final = 20.0
SIGNAL: Final[Rgb255] = (30, 150, 60)
MARKS: Final[dict[str, tuple[Rgb255, str]]] = {
    "island": ((200, 60, 200), "cut off from the main island"),
    "narrow": ((230, 140, 0), "narrower than 1 m"),
    "on_road": ((220, 0, 0), "mostly on the road"),
    "stacked": ((250, 90, 60), "over or under a road"),
    "driven_over": ((150, 0, 90), "cars turn over the corner"),
    "short_green": ((200, 120, 120), "green too short to walk"),
    "never_green": ((120, 0, 0), "signal never green"),
    "always_green": ((0, 120, 200), "signal always green"),
    "misfit": ((90, 60, 30), "signal without a program that fits"),
    "steep": ((120, 40, 160), "too steep for robots"),
    "level": ((40, 60, 220), "bridge or tunnel"),
}
"""Colour and meaning of each kind of problem."""

_GRID: Final[Rgb255] = (160, 172, 186)
_INK: Final[Rgb255] = (70, 84, 104)
_STEPS_M: Final = (1.0, 2.0, 5.0, 10.0, 20.0, 50.0, 100.0, 200.0, 500.0, 1000.0, 2000.0, 5000.0)
_SCENARIO_LINES = 10
"""Maximum number of grid lines across the picture of a scenario."""
_PLACE_LINES = 25
"""Maximum number of grid lines across the picture of a place or a part of it."""
_SCENARIO_MARGIN_M: Final = 12.0
_MIN_ASPECT: Final = 0.6
"""Least ratio of the shorter to the longer side of a picture."""
_LABEL_GAP_PX: Final = 60.0
"""Least distance, pixels, between two labels along the route."""


def draw_map(
    street_map: StreetMap, check: MapCheck, part: Bounds | None = None, credit: str = ""
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
    draw_scale_bar(sheet, bounds)
    return legend(sheet.image, [*_map_legend(check), *([(credit, TRACK)] if credit else [])])


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


def _map_legend(check: MapCheck) -> list[tuple[str, Rgb255]]:
    """Return the legend: size of the map and meaning of each colour."""
    kinds = [kind for kind in MARKS if any(problem.kind == kind for problem in check.problems)]
    crossings = f"{check.crossings} crossings, {check.signalised} with signals"
    words = f"{check.name}  {check.walkable_km:.1f} km walkable, {crossings}"
    return [(words, TRACK), *((MARKS[kind][1], MARKS[kind][0]) for kind in kinds)]


def draw_scale_bar(sheet: Sheet, bounds: Bounds) -> None:
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


def draw_plan(
    street_map: StreetMap,
    scenario: Scenario | None,
    *,
    whole: bool = False,
    part: Bounds | None = None,
    credit: str = "",
) -> Image:
    """Draw a scenario on its place: (H, W, 3) uint8 RGB.

    scenario: None to draw the place alone
    whole: True to show the whole place
    part: x0, y0, x1, y1 in metres to show
    credit: attribution of the map data
    """
    bounds = part or _with_margin(
        street_map.bounds if whole or scenario is None else _bounds_of(scenario)
    )
    lines = _PLACE_LINES if part or whole or scenario is None else _SCENARIO_LINES
    longest_m = max(bounds[2] - bounds[0], bounds[3] - bounds[1])
    sheet = Sheet(bounds, max(PX_PER_M, USUAL_PX / longest_m))
    draw_streets(sheet, street_map, shapely.box(*bounds))
    step_m = next((step for step in _STEPS_M if longest_m <= step * lines), _STEPS_M[-1])
    for strip in street_map.near("strip", shapely.box(*bounds)):
        if isinstance(strip, Strip) and strip.signalised:
            sheet.line(strip.line[:, :2], SIGNAL, 0.5)
    _draw_grid(sheet, bounds, step_m)
    cells = [(f"{street_map.name}: x east, y north, a line every {step_m:g} m", _INK)]
    cells += [(credit, _INK)] if credit else []
    if scenario is None:
        return legend(sheet.image, cells)
    draw_route_and_objects(sheet, scenario)
    draw_ends_and_events(sheet, scenario)
    _draw_arc_lengths(sheet, scenario)
    return legend(sheet.image, [*_scenario_legend(scenario), *cells])


def _bounds_of(scenario: Scenario) -> Bounds:
    """Return the bounds of a scenario."""
    spots = [*scenario.route, *((event.x_m, event.y_m) for event in scenario.events)]
    (x0, y0) = np.min(spots, axis=0).tolist()
    (x1, y1) = np.max(spots, axis=0).tolist()
    return x0, y0, x1, y1


def _with_margin(bounds: Bounds) -> Bounds:
    """Return bounds with a margin and a limited aspect ratio."""
    x0, y0, x1, y1 = bounds
    least_m = _MIN_ASPECT * max(x1 - x0, y1 - y0)
    wide_m, high_m = (
        _SCENARIO_MARGIN_M + max(0.0, least_m - long_m) / 2 for long_m in (x1 - x0, y1 - y0)
    )
    return x0 - wide_m, y0 - high_m, x1 + wide_m, y1 + high_m


def _draw_grid(sheet: Sheet, bounds: Bounds, step_m: float) -> None:
    """Draw grid lines with their coordinates at the lower and left edge."""
    x0, y0, x1, y1 = bounds
    edge_m = 14.0 / sheet.px_per_m
    for x in np.arange(np.ceil(x0 / step_m) * step_m, x1, step_m).tolist():
        sheet.line(np.array([[x, y0], [x, y1]]), _GRID, 0.0)
        sheet.text((x, y0 + edge_m), f"{x + 0.0:g}", _INK)
    for y in np.arange(np.ceil(y0 / step_m) * step_m, y1, step_m).tolist():
        sheet.line(np.array([[x0, y], [x1, y]]), _GRID, 0.0)
        sheet.text((x0 + 2.0 * edge_m, y), f"{y + 0.0:g}", _INK)


def _draw_arc_lengths(sheet: Sheet, scenario: Scenario) -> None:
    """Label the route with its arc length, metres."""
    route = scenario.route_line
    least_m = max(route.length_m / _SCENARIO_LINES, _LABEL_GAP_PX / sheet.px_per_m)
    step_m = next((step for step in _STEPS_M[1:] if step >= least_m), _STEPS_M[-1])
    for s_m in np.arange(step_m, route.length_m - 0.3 * step_m, step_m).tolist():
        at = route.at(s_m)
        sheet.dot(at.xy[None], ROUTE, 0.35)
        sheet.text((at.x_m, at.y_m), f"{s_m:g} m", ROUTE, 0.35)


def _scenario_legend(scenario: Scenario) -> list[tuple[str, Rgb255]]:
    """Return the legend of a scenario."""
    return [
        (scenario.id, TRACK),
        (f"way of {scenario.route_line.length_m:.1f} m", ROUTE),
        *([("fences", BARRIER)] if scenario.barriers else []),
        *([(f"obstacles: {len(scenario.obstacles)}", OBSTACLE)] if scenario.obstacles else []),
        *([(f"events: {len(scenario.events)}", EVENT)] if scenario.events else []),
        ("crossings with signals", SIGNAL),
    ]
