"""Who is near the people that the director moves: what it is told of the street at each tick."""

from __future__ import annotations

import numpy as np

from cosim.core.state import DIRECTED, People, PersonKind
from cosim.people.steering import STEERING_NEAR_M
from cosim.spec.events import NearbyPerson


def nearby_people(people: People) -> tuple[NearbyPerson, ...]:
    """Those within STEERING_NEAR_M of somebody the director moves, in the order of the street; not
    the events' own people.

    The events' people are in the states of a query. Injected people are moved by the director and
    see each other here.
    """
    if not people.kind.any():  # all are of the crowd
        return ()
    moved = people.xy[people.are(*DIRECTED)]
    if not len(moved):
        return ()
    gap = people.xy[:, None] - moved[None]
    near = ((gap * gap).sum(axis=2) < STEERING_NEAR_M * STEERING_NEAR_M).any(axis=1)
    rows = np.flatnonzero(near & (people.kind != PersonKind.EVENT)).tolist()
    if not rows:
        return ()
    heading, speed = people.heading, people.speed
    vx, vy = (
        (speed[rows] * np.cos(heading[rows])).tolist(),
        (speed[rows] * np.sin(heading[rows])).tolist(),
    )
    told = zip(rows, people.xy[rows].tolist(), vx, vy, people.kind[rows].tolist(), strict=True)
    return tuple(
        NearbyPerson(people.ids[i], x, y, u, v, PersonKind(kind)) for i, (x, y), u, v, kind in told
    )
