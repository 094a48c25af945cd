"""Nobody walks into the robot: how a person steps round it.

SUMO's walkers see the robot as stripes, and at the edge of a crossing or corner they sometimes walk
through it; our own people see other people (`cosim.people.steering`), the robot they see here. A
person goes where it wants to go, but slides round the robot's outline instead of entering it. Only
the person's own motion is changed: a robot that drives at somebody still hits them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np
import shapely
from numpy.typing import NDArray
from shapely.geometry import MultiPolygon, Point, Polygon

from cosim.core.geometry import Floats, Pose
from cosim.core.state import PERSON_RADIUS_M
from cosim.spec.events import StandingBody
from cosim.spec.obstacle import Obstacle, footprint

STEP_ROUND_GAP_M = 0.12
"""Gap between a person's disk and the robot's outline at which the person begins to step round."""

DRAWS_BACK_M = 0.015
"""Who stands nearer to the robot than KEEP_M goes back by this in a step of 0.05 s."""

TOUCH_M = 0.01
ROBOT_STANDS_MPS: Final = 0.05
STOOD_S: Final = 1.0
"""A robot of which no point has moved faster than ROBOT_STANDS_MPS for so long stands, for people
and for the referee: they walk round it, and who walks into it is at fault."""
_ROUNDING_M: Final = 1e-6
FORESEEN_S = 0.6
"""How far ahead people see the robot come: nobody walks into the ground it will cover in this
time."""


def outline_mps(v_mps: float, w_radps: float, half_m: tuple[float, float]) -> float:
    """How fast the fastest point of a robot's outline moves, at most."""
    return abs(v_mps) + abs(w_radps) * math.hypot(*half_m)


class RobotBody(NamedTuple):
    """The robot as people see it, or what stands: its pose, half its length and width in metres,
    its speed.

    closed: unit vector to the side on which nobody can pass it; (0, 0) where one can on either.
    """

    pose: Pose
    half_m: tuple[float, float]
    v_mps: float = 0.0
    closed: tuple[float, float] = (0.0, 0.0)


def within_reach_m(body: RobotBody) -> float:
    """How near to the robot's middle somebody must be for a step to be led round it."""
    return (
        math.hypot(*body.half_m)
        + FORESEEN_S * max(body.v_mps, 0.0)
        + PERSON_RADIUS_M
        + STEP_ROUND_GAP_M
    )


def stepped_round(
    before: Floats, wanted: Floats, body: RobotBody, stand: NDArray[np.bool_] | None = None
) -> Floats:
    """Where people go who want to go from `before` to `wanted`, (N, 2) metres each, near a robot.

    People keep out of the ground that a moving robot is about to cover, too: who walks against it
    there steps aside. Apart from that a step towards the robot from nearer than KEEP_M loses its
    inward part; its length goes into the way round: to the side on which the step would pass the
    robot's centre. That choice strengthens itself, so nobody dithers. stand (N,): who only wants to
    stand there comes up as near as it can and draws back slowly from a robot that is nearer than
    KEEP_M: it would go round it and back for ever.
    """
    length, width = body.half_m
    ahead = FORESEEN_S * max(body.v_mps, 0.0)
    low = np.array([-length, -width])
    high = np.array([length, width])
    reach = np.array([ahead, 0.0])
    offset = wanted - body.pose.xy
    if (
        np.hypot(offset[:, 0], offset[:, 1]).min(initial=np.inf)
        > within_reach_m(body) + _ROUNDING_M
    ):
        return wanted
    turn = _axes(body)
    everybody = offset @ turn
    rows = np.flatnonzero(_gap(everybody, low, high + reach) < STEP_ROUND_GAP_M)
    if not len(rows):
        return wanted
    local = ((before - body.pose.xy) @ turn)[rows]
    near = everybody[rows]
    step = near - local
    pace = np.hypot(step[:, 0], step[:, 1])
    side = np.where(local[:, 0] * step[:, 1] - local[:, 1] * step[:, 0] >= 0.0, 1.0, -1.0)

    if body.closed != (0.0, 0.0):
        shut = np.array(body.closed) @ turn
        to_left = step[:, 0] * shut[1] - step[:, 1] * shut[0]
        side = np.where(to_left == 0.0, side, np.where(to_left > 0.0, 1.0, -1.0))

    out = local - np.clip(local, low, high)
    far = np.hypot(out[:, 0], out[:, 1])
    normal = out / np.maximum(far, 1e-9)[:, None]
    inward = -(step * normal).sum(axis=1)
    tangent = np.column_stack([-normal[:, 1], normal[:, 0]])
    slides = (_gap(near, low, high) < STEP_ROUND_GAP_M) & (inward > 0.0) & (far > 1e-6)
    moved = np.where(slides[:, None], local + tangent * (side * pace)[:, None], near)
    if stand is not None:
        back = np.clip(STEP_ROUND_GAP_M + PERSON_RADIUS_M - far, 0.0, DRAWS_BACK_M)
        comes_up = slides & stand[rows]
        moved[comes_up] = (near + normal * (inward + back)[:, None])[comes_up]

    meets = ~slides & (step[:, 0] < 0.0) & (local[:, 0] > length)
    aside = np.where(local[:, 1] >= 0.0, pace, -pace)
    moved[meets] = local[meets] + np.column_stack([np.zeros_like(aside), aside])[meets]
    everybody[rows] = moved
    rounded: Floats = everybody @ turn.T + body.pose.xy
    return rounded


def comes_too_near(before: Floats, after: Floats, body: RobotBody) -> NDArray[np.bool_]:
    """(N,) who goes from `before` to `after`, (N, 2) metres each, nearer to the robot's outline
    than one steps round it."""
    turn = _axes(body)
    half = np.array(body.half_m)
    gap = _gap((after - body.pose.xy) @ turn, -half, half)
    near: NDArray[np.bool_] = (gap < STEP_ROUND_GAP_M) & (
        gap < _gap((before - body.pose.xy) @ turn, -half, half)
    )
    return near


def touches(xy: Floats, body: RobotBody, within_m: float = TOUCH_M) -> bool:
    """Whether the disk of a person at (2,) metres meets the robot's outline, or comes so near to
    it."""
    local = (np.asarray(xy) - body.pose.xy)[None] @ _axes(body)
    half = np.array(body.half_m)
    return bool(_gap(local, -half, half)[0] <= within_m)


def _axes(body: RobotBody) -> Floats:
    """(2, 2) ahead and left of the robot, as columns: what an offset from its middle is multiplied
    by to be told in its frame."""
    cos, sin = np.cos(body.pose.heading_rad), np.sin(body.pose.heading_rad)
    return np.array([[cos, -sin], [sin, cos]])


def _gap(points: Floats, low: Floats, high: Floats) -> Floats:
    """Distance from people's disks to a box that is square to the axes, (N,) metres."""
    away = points - np.clip(points, low, high)
    gap: Floats = np.hypot(away[:, 0], away[:, 1]) - PERSON_RADIUS_M
    return gap


_ROOM_M: Final = 2.0 * (PERSON_RADIUS_M + STEP_ROUND_GAP_M)
"""Through a narrower gap nobody walks."""


class Standing:
    """The bodies of a scenario's obstacles. bodies: as a director is told of them."""

    def __init__(self, bodies: Sequence[StandingBody] = ()) -> None:
        self.bodies = tuple(bodies)
        self._seen = [as_met(body) for body in self.bodies]
        self._xy = np.array([(body.x_m, body.y_m) for body in self.bodies]).reshape(-1, 2)
        self._reach_m = np.array([within_reach_m(body) for body in self._seen])

    def near(self, xy: Floats, margin_m: float = 0.0) -> tuple[StandingBody, ...]:
        """The bodies round which somebody at (N, 2) metres steps, or one who is so much farther
        away."""
        return tuple(self.bodies[i] for i in self._rows(xy, margin_m))

    def stepped_round(
        self, before: Floats, wanted: Floats, stand: NDArray[np.bool_] | None = None
    ) -> Floats:
        """As `cosim.people.yielding.stepped_round`, round all of the bodies that are near."""
        if len(self.bodies) and len(wanted):
            for i in self._rows(wanted, 0.0):
                wanted = stepped_round(before, wanted, self._seen[i], stand)
        return wanted

    def _rows(self, xy: Floats, margin_m: float) -> list[int]:
        gap = xy[:, None] - self._xy[None]
        near = (gap * gap).sum(axis=2) < (self._reach_m + margin_m) ** 2
        rows: list[int] = np.flatnonzero(near.any(axis=0)).tolist()
        return rows


def standing_bodies(obstacles: Sequence[Obstacle], walkable: Polygon | MultiPolygon) -> Standing:
    """Obstacles on walkable ground as people see them."""
    grounds = np.array([footprint(one) for one in obstacles], dtype=object)
    if not len(grounds):
        return Standing()
    together = shapely.get_parts(shapely.union_all(shapely.buffer(grounds, 0.5 * _ROOM_M)))
    edge = shapely.boundary(walkable)
    bodies = []
    for whole in together:
        box = shapely.oriented_envelope(
            shapely.union_all(grounds[shapely.intersects(whole, grounds)])
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
    return Standing(bodies)


def as_met(body: StandingBody) -> RobotBody:
    """A body as one steps round it."""
    pose = Pose(body.x_m, body.y_m, body.heading_rad)
    return RobotBody(
        pose, (0.5 * body.length_m, 0.5 * body.width_m), 0.0, (body.closed_x, body.closed_y)
    )
