"""Who is near the people that the director moves: what it is told of the street at each tick."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Iterable

import numpy as np

from cosim.core.state import People
from cosim.people.steering import STEERING_NEAR_M
from cosim.spec.events import Bystander, Event


def bystanders(people: People, events: Iterable[Event]) -> tuple[Bystander, ...]:
    """Those within NEAR_M of somebody the director moves, in the order of the street; not the events' own people.

    The events' people are in the states of a query. Guests are moved by the director and see each other here.
    """
    first, last = bisect_left(people.ids, "e"), bisect_left(people.ids, "f")
    if first == last:
        return ()
    own = {name for event in events for name in event.names}
    gap = people.xy[:, None] - people.xy[None, first:last]
    near = ((gap * gap).sum(axis=2) < STEERING_NEAR_M * STEERING_NEAR_M).any(axis=1)
    rows = [i for i in np.flatnonzero(near).tolist() if people.ids[i] not in own]
    if not rows:
        return ()
    heading, speed = people.heading, people.speed
    vx, vy = (speed[rows] * np.cos(heading[rows])).tolist(), (speed[rows] * np.sin(heading[rows])).tolist()
    places = people.xy[rows].tolist()
    return tuple(
        Bystander(people.ids[i], x, y, vx[k], vy[k]) for k, (i, (x, y)) in enumerate(zip(rows, places, strict=True))
    )
