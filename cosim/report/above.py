"""Picture of an episode from above: map, route, barriers, track, people, events and failures."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Sequence
from typing import Final

import cv2
import numpy as np
import shapely
from numpy.typing import NDArray
from shapely.geometry import LineString, MultiPolygon, Polygon

from cosim.core.geometry import Floats
from cosim.core.state import DIRECTED, PersonKind
from cosim.place.open_ground import GROUND_LOOKS, PLAIN_GROUND, open_ground
from cosim.place.street_map import Lane, StreetMap
from cosim.report.legend import Image, Rgb255, legend, text_width_px
from cosim.results.log import Log
from cosim.results.record import Record
from cosim.spec.obstacle import footprint
from cosim.spec.scenario import Barrier, Scenario

_MARGIN_M: Final = 25.0
LONGEST_PX: Final = 2400
USUAL_PX: Final = 1400
"""Longest side, pixels, of the picture of a short route."""
PX_PER_M: Final = 10.0
TEXT_GAP_PX: Final = 6
PLAIN_STD: Final = 25.0
"""Standard deviation of pixel values above which a background is too busy for a label."""
EVENT_RING_M: Final = 0.9
FAILURE_RING_M: Final = 0.6
END_M: Final = 0.6
"""Radius, metres, of the dots at start and goal."""

GROUND_COLOUR: Final[Rgb255] = GROUND_LOOKS[PLAIN_GROUND].drawn
ROAD: Final[Rgb255] = (120, 120, 124)
VERGE: Final[Rgb255] = (150, 200, 150)
_WALK: Final[Rgb255] = (238, 236, 230)
_CROSSING: Final[Rgb255] = (250, 250, 190)
_STREETS: Final = {"road": ROAD, "verge": VERGE, "walk": _WALK, "crossing": _CROSSING}
_GROUNDS: Final[dict[str, Rgb255]] = {
    **{kind: look.drawn for kind, look in GROUND_LOOKS.items()},
    **_STREETS,
}
ROUTE: Final[Rgb255] = (60, 120, 220)
TRACK: Final[Rgb255] = (20, 20, 20)
BARRIER: Final[Rgb255] = (210, 30, 30)
OBSTACLE: Final[Rgb255] = (120, 80, 40)
PERSON: Final[Rgb255] = (150, 120, 190)
EVENT: Final[Rgb255] = (230, 120, 0)
RESIDENT: Final[Rgb255] = (0, 140, 110)
RESET: Final[Rgb255] = (120, 120, 120)
FAILURES: Final[dict[str, Rgb255]] = {
    "collision": (220, 0, 0),
    "out_of_lane": (190, 0, 190),
    "freezing": (0, 140, 200),
    "fall": (230, 150, 0),
}

Bounds = tuple[float, float, float, float]
"""Part of the world in metres: x0, y0, x1, y1."""


class Sheet:
    """Picture of a part of the world: x east is right, y north is up.

    bounds: x0, y0, x1, y1 in metres
    """

    def __init__(self, bounds: Bounds, px_per_m: float = PX_PER_M) -> None:
        x0, y0, x1, y1 = bounds
        self.px_per_m = min(px_per_m, LONGEST_PX / max(x1 - x0, y1 - y0))
        self._x0 = x0
        self._y1 = y1
        width, height = math.ceil((x1 - x0) * self.px_per_m), math.ceil((y1 - y0) * self.px_per_m)
        self.image: Image = np.full((height, width, 3), GROUND_COLOUR, dtype=np.uint8)
        self._labels: list[Polygon] = []

    def px(self, xy: Floats) -> NDArray[np.int32]:
        """Convert world metres (N, 2) to sixteenths of pixels."""
        xy = np.asarray(xy, dtype=float).reshape(-1, 2)
        at = np.column_stack([xy[:, 0] - self._x0, self._y1 - xy[:, 1]]) * self.px_per_m * 16
        return np.round(at).astype(np.int32)

    def area(self, shape: Polygon | MultiPolygon, colour: Rgb255) -> None:
        """Fill a shape, metres."""
        for part in shapely.get_parts(shape):
            if isinstance(part, Polygon) and not part.is_empty:
                rings = [
                    self.px(np.array(ring.coords)) for ring in (part.exterior, *part.interiors)
                ]
                cv2.fillPoly(self.image, rings, colour, cv2.LINE_AA, 4)

    def line(self, xy: Floats, colour: Rgb255, width_m: float) -> None:
        """Draw a polyline (N, 2), metres."""
        thickness = max(1, round(width_m * self.px_per_m))
        cv2.polylines(self.image, [self.px(xy)], False, colour, thickness, cv2.LINE_AA, 4)

    def dot(self, xy: Floats, colour: Rgb255, radius_m: float, *, filled: bool = True) -> None:
        """Draw circles at (N, 2), metres, of at least 2 pixels radius."""
        radius = max(2, round(radius_m * self.px_per_m))
        for x, y in self.px(xy):
            cv2.circle(
                self.image,
                (int(x), int(y)),
                radius * 16,
                colour,
                -1 if filled else 2,
                cv2.LINE_AA,
                4,
            )

    def text(
        self,
        xy: Sequence[float],
        words: str,
        colour: Rgb255,
        beside_m: float = 0.0,
        size: float = 0.5,
    ) -> None:
        """Draw a label on a light plate below, above or next to a place, where it hides least.

        beside_m: gap to the place, metres, to avoid covering its mark
        size: font scale of OpenCV
        """
        x, y = (self.px(np.array([xy]))[0] // 16).tolist()
        clear_px = round(beside_m * self.px_per_m)
        text_width = text_width_px(words, size)
        text_height = round(22 * size)
        gap = clear_px + TEXT_GAP_PX
        left = x - text_width // 2
        corners = [
            (left, y + gap + text_height),
            (left, y - gap),
            (x + gap, y + text_height // 2),
            (x - gap - text_width, y + text_height // 2),
        ]
        for row in (1, 2, 3):
            further = row * (text_height + 10)
            corners += [(left, y + gap + text_height + further), (left, y - gap - further)]
        height, width = self.image.shape[:2]
        corners = [
            (max(3, min(a, width - text_width - 3)), max(text_height + 3, min(b, height - 5)))
            for a, b in corners
        ]
        plates = [
            shapely.box(a - 3, b - text_height - 3, a + text_width + 3, b + 5) for a, b in corners
        ]
        mark = shapely.box(x - clear_px, y - clear_px, x + clear_px, y + clear_px)
        occupied = shapely.union_all([*self._labels, mark])
        free = [k for k, plate in enumerate(plates) if not occupied.intersects(plate)]
        contrast = [self._pixels(plate).std() for plate in plates]
        chosen = min(free, key=lambda k: (round(contrast[k] / PLAIN_STD), k)) if free else 0
        self._labels += [plates[chosen], mark]
        plate = self._pixels(plates[chosen])
        plate[:] = 191 + plate // 4
        cv2.putText(
            self.image,
            words,
            corners[chosen],
            cv2.FONT_HERSHEY_SIMPLEX,
            size,
            colour,
            1,
            cv2.LINE_AA,
        )

    def _pixels(self, box: Polygon) -> Image:
        """Return the part of the picture in a box of pixels."""
        x0, y0, x1, y1 = (max(int(edge), 0) for edge in box.bounds)
        return self.image[y0:y1, x0:x1]


def bounds_around(points: Sequence[tuple[float, float]], margin_m: float) -> Bounds:
    """Return the bounds of points with a margin, metres."""
    low = np.min(points, axis=0) - margin_m
    high = np.max(points, axis=0) + margin_m
    return float(low[0]), float(low[1]), float(high[0]), float(high[1])


def draw_above(street_map: StreetMap, scenario: Scenario, record: Record, log: Log) -> Image:
    """Draw an episode: (H, W, 3) uint8 RGB."""
    bounds = bounds_around(scenario.route, _MARGIN_M)
    sheet = Sheet(
        bounds, max(PX_PER_M, USUAL_PX / max(bounds[2] - bounds[0], bounds[3] - bounds[1]))
    )
    draw_streets(sheet, street_map, shapely.box(*bounds))
    draw_route_and_objects(sheet, scenario)
    sheet.dot(log.people_xy[log.people_kind == PersonKind.CROWD], PERSON, 0.15)
    sheet.dot(log.people_xy[log.people_kind == PersonKind.RESIDENT], RESIDENT, 0.2)
    sheet.dot(log.people_xy[np.isin(log.people_kind, DIRECTED)], EVENT, 0.25)
    draw_track(sheet, log)
    draw_ends_and_events(sheet, scenario)
    for failure in record.failures:
        colour = FAILURES[failure.kind]
        sheet.dot(np.array([[failure.x_m, failure.y_m]]), colour, FAILURE_RING_M, filled=False)
        words = f"{failure.kind} {failure.tick * log.tick_s:.0f} s"
        sheet.text((failure.x_m, failure.y_m), words, colour, FAILURE_RING_M)
    return legend(sheet.image, _facts(scenario, record, len(log) * log.tick_s))


def draw_route_and_objects(sheet: Sheet, scenario: Scenario) -> None:
    """Draw the route, barriers and obstacles of a scenario."""
    sheet.line(np.array(scenario.route), ROUTE, 0.4)
    for barrier in scenario.barriers:
        sheet.line(barrier_line(barrier), BARRIER, 0.5)
    for obstacle in scenario.obstacles:
        sheet.area(footprint(obstacle), OBSTACLE)


def barrier_line(barrier: Barrier) -> Floats:
    """Return the (2, 2) ends of a barrier, metres."""
    cos, sin = math.cos(barrier.heading_rad), math.sin(barrier.heading_rad)
    across = np.array([-sin, cos]) * barrier.length_m / 2
    middle = np.array([barrier.x_m, barrier.y_m])
    return np.array([middle - across, middle + across])


def draw_ends_and_events(sheet: Sheet, scenario: Scenario) -> None:
    """Draw and label start, goal and events of a scenario."""
    sheet.dot(np.array([scenario.start[:2], scenario.goal]), TRACK, END_M)
    sheet.text(scenario.start[:2], "start", TRACK, END_M)
    sheet.text(scenario.goal, "goal", TRACK, END_M)
    for event in scenario.events:
        sheet.dot(np.array([[event.x_m, event.y_m]]), EVENT, EVENT_RING_M, filled=False)
        sheet.text((event.x_m, event.y_m), f"{event.id} {event.kind}", EVENT, EVENT_RING_M)


def draw_streets(sheet: Sheet, street_map: StreetMap, area: Polygon) -> None:
    """Draw the ground zones of a part of a map."""
    for kind, shape in street_areas(street_map, area):
        sheet.area(shape, _GROUNDS[kind])


def street_areas(
    street_map: StreetMap, area: Polygon
) -> Iterator[tuple[str, Polygon | MultiPolygon]]:
    """Yield (kind, shape) of the ground zones in a part of a map, in drawing order.

    Kinds: open ground (`GROUND_LOOKS`), road, verge, walk, crossing.
    """
    yield from open_ground(street_map, area)
    lanes = [piece for piece in street_map.near("lane", area) if isinstance(piece, Lane)]
    for junction in street_map.near("junction", area):
        yield "road", junction.polygon
    for kind in ("road", "verge"):
        yield from ((kind, lane.polygon) for lane in lanes if lane.kind == kind)
    for corner in street_map.near("corner", area):
        yield "walk", corner.polygon
    for strip in street_map.near("strip", area):
        yield "crossing" if strip.id.startswith(":") else "walk", strip.polygon


def draw_track(sheet: Sheet, log: Log) -> None:
    """Draw the robot's track, with a dashed line for each reset."""
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


def _facts(scenario: Scenario, record: Record, time_s: float) -> list[tuple[str, Rgb255]]:
    """Return the legend: outcome of the episode and meaning of each colour."""
    measures = record.measures
    return [
        (record.scenario.id, TRACK),
        (f"policy {record.manifest.name}", TRACK),
        (f"{record.ended} after {time_s:.0f} s", TRACK),
        (f"RC {measures.get('route_completion') or 0.0:.2f}", TRACK),
        (f"failures {measures.get('failures') or 0.0:.0f}", TRACK),
        ("route", ROUTE),
        ("track", TRACK),
        ("barriers", BARRIER),
        *([("obstacles", OBSTACLE)] if scenario.obstacles else []),
        ("people", PERSON),
        ("events", EVENT),
        *([("residents", RESIDENT)] if scenario.crowd.residents else []),
    ]
