"""An episode from above: map, route, barriers, track, people, events, failures, as one picture."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from typing import Final

import cv2
import numpy as np
import shapely
from numpy.typing import NDArray
from shapely.geometry import LineString, MultiPolygon, Polygon

from cosim.geometry import Floats
from cosim.record import Log, Record
from cosim.scenario import Scenario
from cosim.streetmap import Lane, StreetMap

MARGIN_M: Final = 25.0
LONGEST_PX: Final = 2400
PX_PER_M: Final = 10.0
LEGEND_PX: Final = 34

Colour = tuple[int, int, int]
GROUND: Final[Colour] = (214, 226, 214)
ROAD: Final[Colour] = (120, 120, 124)
VERGE: Final[Colour] = (150, 200, 150)
WALK: Final[Colour] = (238, 236, 230)
CROSSING: Final[Colour] = (250, 250, 190)
ROUTE: Final[Colour] = (60, 120, 220)
TRACK: Final[Colour] = (20, 20, 20)
BARRIER: Final[Colour] = (210, 30, 30)
PERSON: Final[Colour] = (150, 120, 190)
EVENT: Final[Colour] = (230, 120, 0)
RESIDENT: Final[Colour] = (0, 140, 110)
RESET: Final[Colour] = (120, 120, 120)
FAILURES: Final[dict[str, Colour]] = {"collision": (220, 0, 0), "out_of_lane": (190, 0, 190), "freezing": (0, 140, 200)}

Image = NDArray[np.uint8]


class Sheet:
    """A picture of a part of the world: x east is right, y north is up."""

    def __init__(self, bounds: tuple[float, float, float, float]) -> None:
        x0, y0, x1, y1 = bounds
        self._scale = min(PX_PER_M, LONGEST_PX / max(x1 - x0, y1 - y0))
        self._x0, self._y1 = x0, y1
        width, height = math.ceil((x1 - x0) * self._scale), math.ceil((y1 - y0) * self._scale)
        self.image: Image = np.full((height + LEGEND_PX, width, 3), GROUND, dtype=np.uint8)

    def px(self, xy: Floats) -> NDArray[np.int32]:
        """World metres (N, 2) as sixteenths of pixels."""
        xy = np.asarray(xy, dtype=float).reshape(-1, 2)
        at = np.column_stack([xy[:, 0] - self._x0, self._y1 - xy[:, 1]]) * self._scale * 16
        return np.round(at).astype(np.int32)

    def area(self, shape: Polygon | MultiPolygon, colour: Colour) -> None:
        for part in shapely.get_parts(shape):
            if isinstance(part, Polygon) and not part.is_empty:
                rings = [self.px(np.array(ring.coords)) for ring in (part.exterior, *part.interiors)]
                cv2.fillPoly(self.image, rings, colour, cv2.LINE_AA, 4)

    def line(self, xy: Floats, colour: Colour, width_m: float) -> None:
        thickness = max(1, round(width_m * self._scale))
        cv2.polylines(self.image, [self.px(xy)], False, colour, thickness, cv2.LINE_AA, 4)

    def dot(self, xy: Floats, colour: Colour, radius_m: float, *, filled: bool = True) -> None:
        radius = max(2, round(radius_m * self._scale))
        for x, y in self.px(xy):
            cv2.circle(self.image, (int(x), int(y)), radius * 16, colour, -1 if filled else 2, cv2.LINE_AA, 4)

    def text(self, xy: Sequence[float], words: str, colour: Colour) -> None:
        x, y = self.px(np.array([xy]))[0] // 16
        cv2.putText(self.image, words, (int(x) + 8, int(y) - 6), cv2.FONT_HERSHEY_SIMPLEX, 0.5, colour, 1, cv2.LINE_AA)


def draw_above(street_map: StreetMap, scenario: Scenario, record: Record, log: Log) -> Image:
    """The picture of an episode, (H, W, 3) uint8 RGB."""
    route = np.array(scenario.route)
    low, high = route.min(axis=0) - MARGIN_M, route.max(axis=0) + MARGIN_M
    bounds = (float(low[0]), float(low[1]), float(high[0]), float(high[1]))
    sheet = Sheet(bounds)
    draw_streets(sheet, street_map, shapely.box(*bounds))
    sheet.line(route, ROUTE, 0.4)
    for barrier in scenario.barriers:
        across = np.array([-math.sin(barrier.heading_rad), math.cos(barrier.heading_rad)]) * barrier.length_m / 2
        middle = np.array([barrier.x_m, barrier.y_m])
        sheet.line(np.array([middle - across, middle + across]), BARRIER, 0.5)
    sheet.dot(log.people_xy[~(log.people_event | log.people_resident)], PERSON, 0.15)
    sheet.dot(log.people_xy[log.people_resident], RESIDENT, 0.2)
    sheet.dot(log.people_xy[log.people_event], EVENT, 0.25)
    draw_track(sheet, log)
    for event in scenario.events:
        sheet.dot(np.array([[event.x_m, event.y_m]]), EVENT, 0.9, filled=False)
        sheet.text((event.x_m, event.y_m), f"{event.id} {event.kind}", EVENT)
    for failure in record.failures:
        colour = FAILURES[failure.kind]
        sheet.dot(np.array([[failure.x_m, failure.y_m]]), colour, 0.6, filled=False)
        sheet.text((failure.x_m, failure.y_m), f"{failure.kind} {failure.tick * log.tick_s:.0f} s", colour)
    sheet.text(scenario.start[:2], "start", TRACK)
    sheet.text(scenario.goal, "goal", TRACK)
    sheet.dot(np.array([scenario.start[:2], scenario.goal]), TRACK, 0.6)
    legend(sheet.image, scenario, record, len(log) * log.tick_s)
    return sheet.image


def draw_streets(sheet: Sheet, street_map: StreetMap, area: Polygon) -> None:
    """Ground zones of a part of a map."""
    lanes = [piece for piece in street_map.near("lane", area) if isinstance(piece, Lane)]
    for junction in street_map.near("junction", area):
        sheet.area(junction.polygon, ROAD)
    for kind, colour in (("road", ROAD), ("verge", VERGE)):
        for lane in lanes:
            if lane.kind == kind:
                sheet.area(lane.polygon, colour)
    for corner in street_map.near("corner", area):
        sheet.area(corner.polygon, WALK)
    for strip in street_map.near("strip", area):
        sheet.area(strip.polygon, CROSSING if strip.id.startswith(":") else WALK)


def draw_track(sheet: Sheet, log: Log) -> None:
    """The robot's track, with a dashed jump where it was reset."""
    jumps = np.flatnonzero(~np.isnan(log.reset_s_m)) + 1
    pieces = np.split(log.pose[:, :2], jumps)
    for piece in pieces:
        if len(piece) > 1:
            sheet.line(piece, TRACK, 0.15)
    for before, after in itertools.pairwise(pieces):
        if len(before) and len(after):
            dashes = LineString([before[-1], after[0]])
            at = np.arange(0.0, dashes.length, 0.8)
            for s in at:
                ends = [dashes.interpolate(s).coords[0], dashes.interpolate(s + 0.4).coords[0]]
                sheet.line(np.array(ends), RESET, 0.1)


def legend(image: Image, scenario: Scenario, record: Record, time_s: float) -> None:
    """One line below the picture."""
    image[-LEGEND_PX:] = 255
    measures = record.measures
    words = (
        f"{record.scenario}  policy {record.policy}  {record.ended} after {time_s:.0f} s  "
        f"RC {measures.get('route_completion') or 0.0:.2f}  failures {measures.get('failures') or 0.0:.0f}   "
        "blue route, black track, red barriers, violet people, orange events"
    )
    if scenario.crowd.residents:
        words += ", green residents"
    cv2.putText(image, words, (8, len(image) - 11), cv2.FONT_HERSHEY_SIMPLEX, 0.5, TRACK, 1, cv2.LINE_AA)
