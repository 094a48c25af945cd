"""Minimap: the neighbourhood of the robot from above, north up, at one moment."""

from __future__ import annotations

import math
from typing import Final

import cv2
import numpy as np
import shapely

from cosim.report.above import BARRIER, EVENT, PERSON, RESIDENT, ROUTE, Image, Sheet, draw_streets
from cosim.scenario import Scenario
from cosim.state import RobotState, Street
from cosim.streetmap import StreetMap

REACH_M: Final = 28.0
"""Metres from the robot to the border of the map."""
ROBOT: Final = (20, 20, 20)
VEHICLE: Final = (60, 80, 130)
WALK: Final = (0, 170, 80)
RED: Final = (220, 30, 30)


class Minimap:
    """Draws the streets around a scenario's route once, and what moves on them for each picture."""

    def __init__(self, street_map: StreetMap, scenario: Scenario) -> None:
        route = np.array(scenario.route)
        low, high = route.min(axis=0) - 2.0 * REACH_M, route.max(axis=0) + 2.0 * REACH_M
        bounds = (float(low[0]), float(low[1]), float(high[0]), float(high[1]))
        self._sheet = Sheet(bounds)
        draw_streets(self._sheet, street_map, shapely.box(*bounds))
        self._sheet.line(route, ROUTE, 0.4)
        for barrier in scenario.barriers:
            across = np.array([-math.sin(barrier.heading_rad), math.cos(barrier.heading_rad)]) * barrier.length_m / 2
            middle = np.array([barrier.x_m, barrier.y_m])
            self._sheet.line(np.array([middle - across, middle + across]), BARRIER, 0.5)
        self._sheet.dot(np.array([scenario.goal]), ROUTE, 1.0)
        self._streets = self._sheet.image.copy()
        self._lights = {c.id: street_map.strips[c.id].line[:, :2] for c in scenario.crossings if c.signalised}

    def picture(self, robot: RobotState, street: Street, side_px: int) -> Image:
        """(side_px, side_px, 3) uint8 RGB."""
        sheet = self._sheet
        sheet.image = self._streets.copy()
        for i in range(len(street.vehicles)):
            sheet.area(
                shapely.Polygon(_box(street.vehicles.xy[i], street.vehicles.heading[i], street.vehicles.size[i])),
                VEHICLE,
            )
        for crossing, line in self._lights.items():
            if crossing in street.signals:
                sheet.line(line, WALK if street.signals[crossing].walk else RED, 0.5)
        people = street.people
        kinds = np.array([name[0] for name in people.ids], dtype=str)
        sheet.dot(people.xy[(kinds != "e") & (kinds != "n")], PERSON, 0.45)
        sheet.dot(people.xy[kinds == "n"], RESIDENT, 0.45)
        sheet.dot(people.xy[kinds == "e"], EVENT, 0.55)
        nose = _box(robot.pose.xy, robot.pose.heading_rad, np.array([2.4, 1.6]))
        sheet.area(shapely.Polygon([(nose[0] + nose[1]) / 2, nose[2], nose[3]]), ROBOT)
        corners = sheet.px(robot.pose.xy + np.array([[-REACH_M, REACH_M], [REACH_M, -REACH_M]])) // 16
        (x0, y0), (x1, y1) = corners.tolist()
        height, width = sheet.image.shape[:2]
        x0, y0, x1, y1 = max(x0, 0), max(y0, 0), min(x1, width), min(y1, height)
        if x1 - x0 < 2 or y1 - y0 < 2:
            return np.full((side_px, side_px, 3), 128, dtype=np.uint8)
        cut: Image = cv2.resize(sheet.image[y0:y1, x0:x1], (side_px, side_px), interpolation=cv2.INTER_AREA)
        return cut


def _box(xy: np.ndarray, heading_rad: float, size_m: np.ndarray) -> np.ndarray:
    """(4, 2) corners of a box: fore left, fore right, aft right, aft left."""
    along = 0.5 * size_m[0] * np.array([math.cos(heading_rad), math.sin(heading_rad)])
    aside = 0.5 * size_m[1] * np.array([-math.sin(heading_rad), math.cos(heading_rad)])
    return np.array([xy + along + aside, xy + along - aside, xy - along - aside, xy - along + aside])
