"""A scenario from above before anything is run: streets with coordinates, the way with its metres,
what is on it."""

from __future__ import annotations

from typing import Final

import numpy as np
import shapely

from cosim.place.street_map import StreetMap, Strip
from cosim.report.above import (
    BARRIER,
    EVENT,
    OBSTACLE,
    PX_PER_M,
    ROUTE,
    TRACK,
    USUAL_PX,
    Sheet,
    draw_ends_and_events,
    draw_streets,
    draw_way_and_things,
)
from cosim.report.legend import Image, Rgb255, legend
from cosim.report.mapsheet import SIGNAL
from cosim.spec.scenario import Scenario

_GRID: Final[Rgb255] = (160, 172, 186)
_INK: Final[Rgb255] = (70, 84, 104)
_STEPS_M: Final = (1.0, 2.0, 5.0, 10.0, 20.0, 50.0, 100.0, 200.0, 500.0, 1000.0, 2000.0, 5000.0)
_LINES = 10
"""Maximum number of grid lines across the picture of a scenario."""
_LINES_OF_ALL = 25
"""Maximum number of grid lines across the picture of a place or a part of it."""
_MARGIN_M: Final = 12.0
_LEAST_SHARE: Final = 0.6
"""Least ratio of the shorter to the longer side of a picture."""
_BETWEEN_PX: Final = 60.0
"""Least distance, pixels, between two labels along the route."""
_Bounds = tuple[float, float, float, float]


def draw_plan(
    street_map: StreetMap,
    scenario: Scenario | None,
    *,
    whole: bool = False,
    part: _Bounds | None = None,
    credit: str = "",
) -> Image:
    """Draw a scenario on its place: (H, W, 3) uint8 RGB.

    scenario: None to draw the place alone
    whole: True to show the whole place
    part: x0, y0, x1, y1 in metres to show
    credit: attribution of the map data
    """
    bounds = part or _around(street_map.bounds if whole or scenario is None else _ends(scenario))
    lines = _LINES_OF_ALL if part or whole or scenario is None else _LINES
    longest_m = max(bounds[2] - bounds[0], bounds[3] - bounds[1])
    sheet = Sheet(bounds, max(PX_PER_M, USUAL_PX / longest_m))
    draw_streets(sheet, street_map, shapely.box(*bounds))
    step_m = next((step for step in _STEPS_M if longest_m <= step * lines), _STEPS_M[-1])
    for strip in street_map.near("strip", shapely.box(*bounds)):
        if isinstance(strip, Strip) and strip.signalised:
            sheet.line(strip.line[:, :2], SIGNAL, 0.5)
    _grid(sheet, bounds, step_m)
    cells = [(f"{street_map.name}: x east, y north, a line every {step_m:g} m", _INK)]
    cells += [(credit, _INK)] if credit else []
    if scenario is None:
        return legend(sheet.image, cells)
    draw_way_and_things(sheet, scenario)
    draw_ends_and_events(sheet, scenario)
    _metres(sheet, scenario)
    return legend(sheet.image, [*_words(scenario), *cells])


def _ends(scenario: Scenario) -> _Bounds:
    """Return the bounds of a scenario."""
    spots = [*scenario.route, *((event.x_m, event.y_m) for event in scenario.events)]
    (x0, y0) = np.min(spots, axis=0).tolist()
    (x1, y1) = np.max(spots, axis=0).tolist()
    return x0, y0, x1, y1


def _around(bounds: _Bounds) -> _Bounds:
    """Return bounds with a margin and a limited aspect ratio."""
    x0, y0, x1, y1 = bounds
    least_m = _LEAST_SHARE * max(x1 - x0, y1 - y0)
    wide_m, high_m = (_MARGIN_M + max(0.0, least_m - long_m) / 2 for long_m in (x1 - x0, y1 - y0))
    return x0 - wide_m, y0 - high_m, x1 + wide_m, y1 + high_m


def _grid(sheet: Sheet, bounds: _Bounds, step_m: float) -> None:
    """Draw grid lines with their coordinates at the lower and left edge."""
    x0, y0, x1, y1 = bounds
    edge_m = 14.0 / sheet.px_per_m
    for x in np.arange(np.ceil(x0 / step_m) * step_m, x1, step_m).tolist():
        sheet.line(np.array([[x, y0], [x, y1]]), _GRID, 0.0)
        sheet.text((x, y0 + edge_m), f"{x + 0.0:g}", _INK)
    for y in np.arange(np.ceil(y0 / step_m) * step_m, y1, step_m).tolist():
        sheet.line(np.array([[x0, y], [x1, y]]), _GRID, 0.0)
        sheet.text((x0 + 2.0 * edge_m, y), f"{y + 0.0:g}", _INK)


def _metres(sheet: Sheet, scenario: Scenario) -> None:
    """Label the route with its arc length, metres."""
    route = scenario.route_line
    least_m = max(route.length_m / _LINES, _BETWEEN_PX / sheet.px_per_m)
    step_m = next((step for step in _STEPS_M[1:] if step >= least_m), _STEPS_M[-1])
    for s_m in np.arange(step_m, route.length_m - 0.3 * step_m, step_m).tolist():
        at = route.at(s_m)
        sheet.dot(at.xy[None], ROUTE, 0.35)
        sheet.text((at.x_m, at.y_m), f"{s_m:g} m", ROUTE, 0.35)


def _words(scenario: Scenario) -> list[tuple[str, Rgb255]]:
    """Return the legend of a scenario."""
    return [
        (scenario.id, TRACK),
        (f"way of {scenario.route_line.length_m:.1f} m", ROUTE),
        *([("fences", BARRIER)] if scenario.barriers else []),
        *([(f"obstacles: {len(scenario.obstacles)}", OBSTACLE)] if scenario.obstacles else []),
        *([(f"events: {len(scenario.events)}", EVENT)] if scenario.events else []),
        ("crossings with signals", SIGNAL),
    ]
