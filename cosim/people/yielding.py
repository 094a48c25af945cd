"""Motion of people around the robot and the obstacles of a scenario.

SUMO's walkers sometimes walk through the robot at the edge of a crossing or corner. Directed people
avoid other people by `cosim.people.steering`, but the robot only here. A person slides round the
robot's outline instead of entering it. Only the person's own motion changes: the robot can hit
people.

Obstacles are merged to few rectangles: those without a gap for a person count as one. If one
reaches the edge of the walkable ground, people pass on its other side.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np
import shapely
from numpy.typing import NDArray
from shapely.geometry import MultiPolygon, Point, Polygon

from cosim.core.geometry import Floats, Pose, hypot
from cosim.core.state import PERSON_RADIUS_M
from cosim.spec.events import StandingBody
from cosim.spec.obstacle import Obstacle, footprint

STEP_ROUND_GAP_M = 0.12
"""Gap between a person's disk and the robot's outline below which the person steps round, in
metres."""

BACK_AWAY_M = 0.015
"""Distance per tick of 0.05 s by which a standing person backs away from the robot, in metres."""

TOUCH_M = 0.01
"""Gap in metres below which a person touches the robot."""
ROBOT_STANDS_MPS: Final = 0.05
"""Speed of the robot's fastest point below which it stands, in m/s."""
STOOD_S: Final = 1.0
"""Time below ROBOT_STANDS_MPS after which the robot counts as standing, in seconds. Then people
walk round it, and the referee blames those who walk into it."""
_ROUNDING_M: Final = 1e-6
"""Tolerance for rounding in metres."""
ANTICIPATION_S = 0.6
"""Time ahead in which people avoid the ground that the robot will cover, in seconds."""
_ROOM_M: Final = 2.0 * (PERSON_RADIUS_M + STEP_ROUND_GAP_M)
"""Width in metres below which a gap is too narrow for a person."""


def outline_mps(v_mps: float, w_radps: float, half_m: tuple[float, float]) -> float:
    """Return an upper bound of the speed of the robot's outline in m/s."""
    return abs(v_mps) + abs(w_radps) * math.hypot(*half_m)


class RobotBody(NamedTuple):
    """Footprint of the robot or an obstacle: pose, half length and half width in metres, speed.

    closed: unit vector to the side without a passage; (0, 0) if both sides are free.
    """

    pose: Pose
    half_m: tuple[float, float]
    v_mps: float = 0.0
    closed: tuple[float, float] = (0.0, 0.0)


def reaction_distance_m(body: RobotBody) -> float:
    """Return the distance to the body's centre within which people step round it, in metres."""
    return (
        math.hypot(*body.half_m)
        + ANTICIPATION_S * max(body.v_mps, 0.0)
        + PERSON_RADIUS_M
        + STEP_ROUND_GAP_M
    )


def stepped_around(
    before: Floats, preferred: Floats, body: RobotBody, standing: NDArray[np.bool_] | None = None
) -> Floats:
    """Return new positions of people near a body, (N, 2) metres.

    before, preferred: (N, 2) current and preferred positions.
    standing: (N,) whether a person wants to stand there. Such a person approaches the robot, and
        backs away slowly from one that is too close, instead of circling it.

    People avoid the ground that a moving robot will cover: those ahead of it step aside. Otherwise,
    a step towards the robot within STEP_ROUND_GAP_M loses its inward part. Its length goes into the
    tangent, on the side on which the step passes the centre. The choice reinforces itself, so that
    people do not oscillate.
    """
    rows = _within_gap(preferred, body)
    if not rows:
        return preferred
    turn = _axes(body)
    centre = body.pose.xy
    targets = (preferred - centre) @ turn
    local = (before - centre) @ turn
    closed = None if body.closed == (0.0, 0.0) else (np.array(body.closed) @ turn).tolist()
    front_m = body.half_m[0] + ANTICIPATION_S * max(body.v_mps, 0.0)
    for row in rows:
        target = targets[row].tolist()
        if _box_gap(target, body.half_m, front_m) < STEP_ROUND_GAP_M:
            is_standing = standing is not None and bool(standing[row])
            targets[row] = _stepped(local[row].tolist(), target, body.half_m, closed, is_standing)
    rounded: Floats = targets @ turn.T + centre
    return rounded


def _stepped(
    at: list[float],
    target: list[float],
    half_m: tuple[float, float],
    closed: list[float] | None,
    is_standing: bool,
) -> tuple[float, float]:
    """Return the new position of one person within the gap, in metres in the body's frame.

    at, target: current and preferred position.
    closed: direction to the side without a passage, if there is one.
    """
    length_m, width_m = half_m
    (x, y), (target_x, target_y) = at, target
    step_x, step_y = target_x - x, target_y - y
    pace = hypot(step_x, step_y)
    side = 1.0 if x * step_y - y * step_x >= 0.0 else -1.0
    if closed is not None:
        to_left = step_x * closed[1] - step_y * closed[0]
        if to_left != 0.0:
            side = 1.0 if to_left > 0.0 else -1.0

    out_x = x - min(max(x, -length_m), length_m)
    out_y = y - min(max(y, -width_m), width_m)
    far = hypot(out_x, out_y)
    normal_x, normal_y = out_x / max(far, 1e-9), out_y / max(far, 1e-9)
    inward = -(step_x * normal_x + step_y * normal_y)
    if inward > 0.0 and far > 1e-6 and _box_gap(target, half_m, length_m) < STEP_ROUND_GAP_M:
        if is_standing:
            back = min(max(STEP_ROUND_GAP_M + PERSON_RADIUS_M - far, 0.0), BACK_AWAY_M)
            on = inward + back
            return target_x + normal_x * on, target_y + normal_y * on
        on = side * pace
        return x - normal_y * on, y + normal_x * on
    if step_x < 0.0 and x > length_m:
        return x, y + (pace if y >= 0.0 else -pace)
    return target_x, target_y


def _box_gap(at: list[float], half_m: tuple[float, float], front_m: float) -> float:
    """Return the distance from a person's disk to the body in the body's frame, in metres.

    front_m: distance of the body's front.
    """
    x, y = at
    away_x = x - min(max(x, -half_m[0]), front_m)
    away_y = y - min(max(y, -half_m[1]), half_m[1])
    return hypot(away_x, away_y) - PERSON_RADIUS_M


def _within_gap(xy: Floats, body: RobotBody) -> list[int]:
    """Return the rows of people who may be within STEP_ROUND_GAP_M of the ground that a body covers
    or will cover; only rounding adds others."""
    x_m, y_m, heading_rad = body.pose
    near_m = reaction_distance_m(body) + _ROUNDING_M
    dx, dy = xy[:, 0] - x_m, xy[:, 1] - y_m
    near = dx * dx + dy * dy <= near_m * near_m
    if 1 not in near.tobytes():
        return []
    cos, sin = math.cos(heading_rad), math.sin(heading_rad)
    half_length, half_width = body.half_m
    front = half_length + ANTICIPATION_S * max(body.v_mps, 0.0)
    gap_m = PERSON_RADIUS_M + STEP_ROUND_GAP_M + _ROUNDING_M
    rows = []
    for row in near.nonzero()[0].tolist():
        x, y = float(dx[row]), float(dy[row])
        ahead, left = cos * x + sin * y, cos * y - sin * x
        beyond = max(ahead - front, -half_length - ahead, 0.0)
        if math.hypot(beyond, max(abs(left) - half_width, 0.0)) < gap_m:
            rows.append(row)
    return rows


def approaches_body(before: Floats, after: Floats, body: RobotBody) -> NDArray[np.bool_]:
    """Return whether each step approaches the robot's outline below the gap, (N,) booleans."""
    if not _within_gap(after, body._replace(v_mps=0.0)):
        return np.zeros(len(after), dtype=bool)
    turn = _axes(body)
    half = np.array(body.half_m)
    gap = _disk_gap((after - body.pose.xy) @ turn, -half, half)
    near: NDArray[np.bool_] = (gap < STEP_ROUND_GAP_M) & (
        gap < _disk_gap((before - body.pose.xy) @ turn, -half, half)
    )
    return near


def touches(xy: Floats, body: RobotBody, within_m: float = TOUCH_M) -> bool:
    """Return whether a person's disk at (2,) metres is within `within_m` of the robot's outline."""
    local = (np.asarray(xy) - body.pose.xy)[None] @ _axes(body)
    half = np.array(body.half_m)
    return bool(_disk_gap(local, -half, half)[0] <= within_m)


def _axes(body: RobotBody) -> Floats:
    """Return the robot's axes ahead and left as columns, (2, 2), to rotate world offsets."""
    cos, sin = np.cos(body.pose.heading_rad), np.sin(body.pose.heading_rad)
    return np.array([[cos, -sin], [sin, cos]])


def _disk_gap(points: Floats, low: Floats, high: Floats) -> Floats:
    """Return the distance from people's disks to an axis-aligned box, (N,) metres."""
    away = points - np.clip(points, low, high)
    gap: Floats = np.hypot(away[:, 0], away[:, 1]) - PERSON_RADIUS_M
    return gap


_SEARCH_M: Final = 1.0
"""Movement of people after which distances to obstacles are computed again, metres."""


class StandingObstacles:
    """Obstacles of a scenario as people avoid them.

    bodies: obstacles as the director gets them.
    """

    def __init__(self, bodies: Sequence[StandingBody] = ()) -> None:
        self.bodies = tuple(bodies)
        self._footprints = [obstacle_body(body) for body in self.bodies]
        self._xy = np.array([(body.x_m, body.y_m) for body in self.bodies]).reshape(-1, 2)
        self._reach_m = np.array([reaction_distance_m(body) for body in self._footprints])
        self._searched = np.zeros((0, 2))
        self._spare_m: list[float] = []

    def near(self, xy: Floats, margin_m: float = 0.0) -> tuple[StandingBody, ...]:
        """Return the obstacles near people at (N, 2) metres, within stepping distance plus a
        margin."""
        return tuple(self.bodies[i] for i in self._rows(xy, margin_m))

    def stepped_around(
        self, before: Floats, preferred: Floats, standing: NDArray[np.bool_] | None = None
    ) -> Floats:
        """Return new positions of people, as `stepped_around` does, for all near obstacles."""
        if len(self.bodies) and len(preferred):
            for i in self._within_reach(preferred):
                preferred = stepped_around(before, preferred, self._footprints[i], standing)
        return preferred

    def closing(self, body: RobotBody) -> RobotBody:
        """Return a standing robot with its `closed` side towards the nearest obstacle.

        It has none if a person fits between the robot and every obstacle.
        """
        at = np.array([body.pose.xy])
        rows = self._rows(at, math.hypot(*body.half_m) + _ROOM_M)
        if not rows:
            return body
        ground = _outline(body)
        gaps_m = [shapely.distance(ground, _outline(self._footprints[i])) for i in rows]
        nearest = int(np.argmin(gaps_m))
        if gaps_m[nearest] >= _ROOM_M:
            return body
        to_side = self._xy[rows[nearest]] - at[0]
        side = (to_side / max(float(np.hypot(*to_side)), 1e-9)).tolist()
        return body._replace(closed=(side[0], side[1]))

    def _within_reach(self, xy: Floats) -> list[int]:
        """Return the rows of the obstacles within stepping distance of people; a single one may be
        farther away.

        Distances are computed only where people may have come near since the last search.
        """
        moved_m = math.inf
        if len(xy) == len(self._searched):
            moved_m = math.sqrt(2.0) * float(np.maximum.reduce(np.abs(xy - self._searched), None))
        if moved_m > _SEARCH_M:
            gap = xy[:, None] - self._xy[None]
            nearest_m = np.sqrt((gap * gap).sum(axis=2).min(axis=0))
            self._spare_m = (nearest_m - self._reach_m - _ROUNDING_M).tolist()
            self._searched = xy
            moved_m = 0.0
        rows = [i for i, spare_m in enumerate(self._spare_m) if spare_m <= moved_m]
        return rows if len(rows) < 2 else self._rows(xy, 0.0)

    def _rows(self, xy: Floats, margin_m: float) -> list[int]:
        gap = xy[:, None] - self._xy[None]
        near = (gap * gap).sum(axis=2) < (self._reach_m + margin_m) ** 2
        rows: list[int] = np.flatnonzero(near.any(axis=0)).tolist()
        return rows


def standing_obstacles(
    obstacles: Sequence[Obstacle], walkable: Polygon | MultiPolygon
) -> StandingObstacles:
    """Return the obstacles on walkable ground as people avoid them."""
    grounds = np.array([footprint(one) for one in obstacles], dtype=object)
    if not len(grounds):
        return StandingObstacles()
    together = shapely.get_parts(shapely.union_all(shapely.buffer(grounds, 0.5 * _ROOM_M)))
    edge = shapely.boundary(walkable)
    bodies = []
    for group in together:
        box = shapely.oriented_envelope(
            shapely.union_all(grounds[shapely.intersects(group, grounds)])
        )
        corners = shapely.get_coordinates(box)
        ahead, aside = corners[1] - corners[0], corners[2] - corners[1]
        x_m, y_m = corners[:4].mean(axis=0).tolist()
        closed = (0.0, 0.0)
        if shapely.distance(box, edge) < _ROOM_M:
            nearest = shapely.get_coordinates(shapely.shortest_line(Point(x_m, y_m), edge))[1]
            out = nearest - (x_m, y_m)
            closed = tuple((out / max(float(np.hypot(*out)), 1e-9)).tolist())
        heading = float(np.arctan2(ahead[1], ahead[0]))
        long, wide = float(np.hypot(*ahead)), float(np.hypot(*aside))
        bodies.append(StandingBody(x_m, y_m, heading, long, wide, *closed))
    return StandingObstacles(bodies)


def _outline(body: RobotBody) -> Polygon:
    """Return the outline of a footprint, in metres."""
    half = np.array(body.half_m)
    corners = half * [[1.0, 1.0], [-1.0, 1.0], [-1.0, -1.0], [1.0, -1.0]]
    return Polygon(corners @ _axes(body).T + body.pose.xy)


def obstacle_body(body: StandingBody) -> RobotBody:
    """Return an obstacle as a footprint to step round."""
    pose = Pose(body.x_m, body.y_m, body.heading_rad)
    return RobotBody(
        pose, (0.5 * body.length_m, 0.5 * body.width_m), 0.0, (body.closed_x, body.closed_y)
    )
