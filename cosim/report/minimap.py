"""Minimap: surroundings of the robot from above at one moment, north up."""

from __future__ import annotations

import math
from typing import Final

import cv2
import numpy as np
import shapely

from cosim.core.geometry import Floats
from cosim.core.state import DIRECTED, PERSON_RADIUS_M, People, RobotState, Street
from cosim.place.street_map import StreetMap
from cosim.report.above import (
    BARRIER,
    EVENT,
    GROUND_COLOUR,
    OBSTACLE,
    PERSON,
    RESIDENT,
    ROUTE,
    Sheet,
    barrier_line,
    bounds_around,
    draw_streets,
)
from cosim.report.legend import Image, Rgb255
from cosim.spec.obstacle import footprint
from cosim.spec.scenario import Scenario

MINIMAP_REACH_M: Final = 11.0
"""Distance from the middle of the map to its nearer borders, metres."""
_AHEAD_M: Final = 4.0
"""Distance of the map's middle ahead of the robot, metres."""
SHARPEST_PX_PER_M: Final = 16.0
ROBOT: Final[Rgb255] = (20, 20, 20)
NOSE: Final[Rgb255] = (90, 200, 255)
VEHICLE: Final[Rgb255] = (60, 80, 130)
_WALK: Final[Rgb255] = (0, 170, 80)
RED_SIGNAL: Final[Rgb255] = (220, 30, 30)
PLANNED: Final[Rgb255] = (15, 163, 177)
_INK: Final[Rgb255] = (40, 40, 40)
COLOURS: Final = (PERSON, EVENT, RESIDENT, EVENT)
"""Colours of people by `PersonKind`."""
_NOSE_M: Final = 0.62
"""Distance, metres, from a person's centre to the tip that shows the heading."""


class Minimap:
    """Minimap of a scenario: static streets drawn once, moving things per picture.

    footprint_m: length and width of the robot
    """

    def __init__(
        self, street_map: StreetMap, scenario: Scenario, footprint_m: tuple[float, float]
    ) -> None:
        bounds = bounds_around(scenario.route, 4.0 * MINIMAP_REACH_M)
        sheet = Sheet(bounds, SHARPEST_PX_PER_M)
        draw_streets(sheet, street_map, shapely.box(*bounds))
        sheet.line(np.array(scenario.route), ROUTE, 0.2)
        for barrier in scenario.barriers:
            sheet.line(barrier_line(barrier), BARRIER, 0.4)
        for obstacle in scenario.obstacles:
            sheet.area(footprint(obstacle), OBSTACLE)
        sheet.dot(np.array([scenario.goal]), ROUTE, 0.7)
        sheet.dot(np.array([scenario.goal]), (255, 255, 255), 0.3)
        self._streets = sheet
        self._footprint = np.array(footprint_m)
        self._lights = {
            c.id: street_map.strips[c.id].line[:, :2] for c in scenario.crossings if c.signalised
        }

    def picture(
        self,
        robot: RobotState,
        street: Street,
        size_px: tuple[int, int],
        ahead: Floats,
        plan: Floats | None = None,
    ) -> Image:
        """Draw the map around the robot: (height, width, 3) uint8 RGB.

        size_px: width, height
        ahead: (2,) direction in which the map shows more
        plan: (N, 2) waypoints that are followed, or None

        People have a nose in their heading. Event people are orange and labelled with what they do,
        residents are green. A stopping hand is red.
        """
        width, height = size_px
        half_m = MINIMAP_REACH_M * np.array([width, height]) / min(width, height)
        middle = robot.pose.xy + _AHEAD_M * ahead / np.hypot(*ahead)
        (x0, y0) = (middle - half_m).tolist()
        (x1, y1) = (middle + half_m).tolist()
        sheet = Sheet((x0, y0, x1, y1), max(width, height) / (2.0 * half_m.max()))
        sheet.image = self._ground(x0, y1, sheet.px_per_m, size_px)
        for crossing, line in self._lights.items():
            if crossing in street.signals:
                sheet.line(line, _WALK if street.signals[crossing].walk else RED_SIGNAL, 0.4)
        for xy, heading, size_m in zip(
            street.vehicles.xy, street.vehicles.heading, street.vehicles.size, strict=True
        ):
            sheet.area(shapely.Polygon(_box(xy, heading, size_m)), VEHICLE)
        _draw_people(sheet, street.people)
        body = _box(robot.pose.xy, robot.pose.heading_rad, self._footprint)
        sheet.area(shapely.buffer(shapely.Polygon(body), 0.15), (255, 255, 255))
        sheet.area(shapely.Polygon(body), ROBOT)
        tip = robot.pose.xy + 0.5 * (body[0] + body[1] - 2.0 * robot.pose.xy)
        sheet.area(
            shapely.Polygon([tip, 0.5 * (body[0] + body[3]), 0.5 * (body[1] + body[2])]), NOSE
        )
        if plan is not None:
            sheet.line(plan, PLANNED, 0.12)
            sheet.dot(plan[1:], PLANNED, 0.14)
        return sheet.image

    def _ground(self, x0: float, y1: float, px_per_m: float, size_px: tuple[int, int]) -> Image:
        """Return the streets of the part whose upper left corner is at x0, y1, metres."""
        streets = self._streets
        left, upper = (streets.px(np.array([[x0, y1]]))[0] / 16.0).tolist()
        zoom = streets.px_per_m / px_per_m
        onto = np.array([[zoom, 0.0, left], [0.0, zoom, upper]])
        how = cv2.INTER_AREA if zoom > 1.0 else cv2.INTER_LINEAR
        ground: Image = cv2.warpAffine(
            streets.image,
            onto,
            size_px,
            flags=how | cv2.WARP_INVERSE_MAP,
            borderValue=GROUND_COLOUR,
        ).astype(np.uint8)
        return ground


def _draw_people(sheet: Sheet, people: People) -> None:
    """Draw people with a nose, event people on top and labelled with what they do."""
    event = people.are(*DIRECTED)
    ahead = np.column_stack([np.cos(people.heading), np.sin(people.heading)])
    for row in np.argsort(event, kind="stable").tolist():
        xy = people.xy[row]
        way = ahead[row]
        colour = COLOURS[people.kind[row]]
        aside = 0.8 * PERSON_RADIUS_M * np.array([-way[1], way[0]])
        nose = shapely.Polygon([xy + _NOSE_M * way, xy + aside, xy - aside])
        body = shapely.MultiPolygon([shapely.Point(*xy).buffer(PERSON_RADIUS_M), nose])
        for part in body.geoms:
            sheet.area(part.buffer(0.09), _INK)
        sheet.area(body, colour)
        if people.doing[row] == "stop":
            hand = np.array(
                [xy + (_NOSE_M + 0.1) * way + 2.0 * aside, xy + (_NOSE_M + 0.1) * way - 2.0 * aside]
            )
            sheet.line(hand, RED_SIGNAL, 0.25)
    doing = np.array(people.doing)
    for word in dict.fromkeys(doing[event].tolist()):
        if word not in ("walk", "stand"):
            middle = people.xy[event & (doing == word)].mean(axis=0)
            sheet.text(middle.tolist(), word, _INK, 1.1, 0.38)


def _box(xy: Floats, heading_rad: float, size_m: Floats) -> Floats:
    """Return the (4, 2) corners of a box: fore left, fore right, aft right, aft left."""
    along = 0.5 * size_m[0] * np.array([math.cos(heading_rad), math.sin(heading_rad)])
    aside = 0.5 * size_m[1] * np.array([-math.sin(heading_rad), math.cos(heading_rad)])
    return np.array(
        [xy + along + aside, xy + along - aside, xy - along - aside, xy - along + aside]
    )
