"""How people see the obstacles of a scenario: as few bodies that stand, round which they step as
round the robot.

What stands so near together that nobody fits between is one body. Where one reaches to the edge of
the walkable ground people pass it on its other side.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np
import shapely
from numpy.typing import NDArray
from shapely.geometry import MultiPolygon, Point, Polygon

from cosim.core.geometry import Floats, Pose
from cosim.core.state import PERSON_RADIUS_M
from cosim.people.yielding import STEP_ROUND_GAP_M, RobotBody, stepped_round, within_reach_m
from cosim.spec.events import StandingBody
from cosim.spec.obstacle import Obstacle, footprint

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
