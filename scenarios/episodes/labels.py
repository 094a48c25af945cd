"""Labels of a demonstration's pictures from the simulator, for auxiliary heads of a network.

near   (LABELLED_PEOPLE, 6) nearest people ahead: 1, x, y, vx, vy in the robot's axes, and 1 plus
       the index of their activity in `DOINGS`; else 0
free   (FREE_RAYS,) distances in m that the robot's middle can drive at bearings from
       FREE_HALF_RAD on the left to FREE_HALF_RAD on the right; 0 outside of the free ground
scene  (2,) signal of the next crossing on the route, see `signal_ahead`; 1 plus the index of the
       kind of the nearest event ahead, from its trigger on, else 0, see `event_numbers`
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Final, get_args

import numpy as np
import shapely
from numpy.typing import NDArray

from cosim.core.geometry import Floats, Pose
from cosim.core.packed_demos import FREE_RAYS, LABELLED_PEOPLE
from cosim.core.state import PERSON_RADIUS_M, Doing, PersonKind, Vehicles
from cosim.episode.interfaces import Observation, Privileged
from cosim.spec.scenario import Scenario
from scenarios.events import EVENT_KINDS

DOINGS: Final = get_args(Doing)
"""Activities of people, numbered by their place."""
PEOPLE_RANGE_M: Final = 12.0
"""Largest distance of labelled people, who are ahead of the robot's middle."""
FREE_RANGE_M: Final = 10.0
"""Largest labelled free distance."""
FREE_HALF_RAD: Final = math.pi / 2.0
"""Largest bearing of a labelled free distance, to the left and to the right."""
SIGNAL_RANGE_M: Final = 20.0
"""Largest distance along the route to a crossing whose signal is labelled."""
EVENT_NUMBERS: Final[Mapping[str, int]] = MappingProxyType(
    {kind: number for number, kind in enumerate(EVENT_KINDS, 1)}
)
"""Label of each kind of event."""


def label_rows(seen: Observation) -> dict[str, NDArray[np.float32]]:
    """Return near, free and the signal of an observation with privileged state; {} without it."""
    known = seen.privileged
    if known is None:
        return {}
    return {
        "near": people_ahead(known),
        "free": free_distances(known, seen.robot.width_m / 2.0),
        "scene": np.array([signal_ahead(known), 0.0], np.float32),
    }


def people_ahead(known: Privileged) -> NDArray[np.float32]:
    """Return the rows of near, nearest first."""
    people, pose = known.people, known.robot.pose
    found = np.zeros((LABELLED_PEOPLE, 6), np.float32)
    place = _in_frame(people.xy - pose.xy, pose.heading_rad)
    rows = _nearest_ahead(place)[:LABELLED_PEOPLE]
    along = np.stack([np.cos(people.heading[rows]), np.sin(people.heading[rows])], axis=1)
    velocity = _in_frame(people.speed[rows, None] * along, pose.heading_rad)
    found[: len(rows), 0] = 1.0
    found[: len(rows), 1:3] = place[rows]
    found[: len(rows), 3:5] = velocity
    found[: len(rows), 5] = [1 + DOINGS.index(people.doing[row]) for row in rows]
    return found


def event_person(known: Privileged | None) -> str:
    """Return the id of the nearest event pedestrian ahead; "" without one."""
    if known is None:
        return ""
    people, pose = known.people, known.robot.pose
    rows = _nearest_ahead(_in_frame(people.xy - pose.xy, pose.heading_rad))
    directed = people.are(PersonKind.EVENT)
    return next((people.ids[row] for row in rows if directed[row]), "")


def event_numbers(
    scenario: Scenario,
    persons: Sequence[str],
    ticks: Sequence[int],
    triggered: Mapping[str, int],
) -> NDArray[np.float32]:
    """Return the label of the event of each row (n,).

    It is 0 for the person "", before the event's trigger, and if nothing happens in the event
    (`Event.decoy`). Until the trigger an event and its decoy are equal. A decoy with the other side
    free is an event like any other.

    persons: id of the nearest event pedestrian of each row.
    ticks: tick of each row.
    triggered: tick of the trigger by the id of the event.
    """
    known = {
        name: (EVENT_NUMBERS.get(event.kind, 0), triggered[event.id])
        for event in scenario.events
        if event.id in triggered and not event.decoy
        for name in event.names
    }
    found = [
        number if tick >= first else 0
        for tick, (number, first) in zip(
            ticks, (known.get(person, (0, 0)) for person in persons), strict=True
        )
    ]
    return np.array(found, np.float32)


def signal_ahead(known: Privileged) -> int:
    """Return 1 if people may walk over the next crossing of the route, 2 if not; 0 without a
    signal within SIGNAL_RANGE_M."""
    for crossing, enter_s_m, leave_s_m in known.crossings:
        if leave_s_m < known.route_s_m:
            continue
        signal = known.signals.get(crossing)
        if signal is None or enter_s_m - known.route_s_m > SIGNAL_RANGE_M:
            return 0
        return 1 if signal.walk else 2
    return 0


def free_distances(known: Privileged, half_m: float) -> NDArray[np.float32]:
    """Return the free distance at each bearing, from left to right.

    People and vehicles end it, too. half_m: half the robot's width.
    """
    pose = known.robot.pose
    edges, inside = _edges_near(known.free, pose)
    bearings = pose.heading_rad + np.linspace(FREE_HALF_RAD, -FREE_HALF_RAD, FREE_RAYS)
    rays = np.stack([np.cos(bearings), np.sin(bearings)], axis=1)
    if not inside:
        return np.zeros(FREE_RAYS, np.float32)
    edges = np.concatenate([edges, _sides(known.vehicles, pose, half_m)])
    found = np.minimum(_to_edges(rays, edges), FREE_RANGE_M)
    offset = known.people.xy - pose.xy
    near = offset[np.hypot(*offset.T) < FREE_RANGE_M + 1.0]
    found = np.minimum(found, _to_disks(rays, near, PERSON_RADIUS_M + half_m))
    return found.astype(np.float32)


def _in_frame(offset: Floats, heading_rad: float) -> Floats:
    """Rotate world offsets (N, 2) into the axes of a robot with this heading."""
    cos, sin = math.cos(heading_rad), math.sin(heading_rad)
    return np.stack(
        [cos * offset[:, 0] + sin * offset[:, 1], cos * offset[:, 1] - sin * offset[:, 0]], axis=1
    )


def _nearest_ahead(place: Floats) -> NDArray[np.intp]:
    """Return the rows of the people ahead within PEOPLE_RANGE_M, nearest first."""
    far_m = np.hypot(place[:, 0], place[:, 1])
    rows = np.flatnonzero((place[:, 0] > 0.0) & (far_m <= PEOPLE_RANGE_M))
    return rows[np.argsort(far_m[rows], kind="stable")]


def _edges_near(free: shapely.Polygon | shapely.MultiPolygon, pose: Pose) -> tuple[Floats, bool]:
    """Return the edges (E, 2, 2) of the free ground near a pose, relative to it.

    Also returns whether the pose lies inside.
    """
    x, y, far = pose.x_m, pose.y_m, FREE_RANGE_M
    near = shapely.clip_by_rect(free, x - far, y - far, x + far, y + far)
    if near.is_empty or not shapely.contains_xy(near, x, y):
        return np.zeros((0, 2, 2)), False
    rings = shapely.get_rings(shapely.get_parts(near))
    points, ring = shapely.get_coordinates(rings, return_index=True)
    edges = np.stack([points[:-1], points[1:]], axis=1)[ring[:-1] == ring[1:]]
    return edges - pose.xy, True


def _sides(vehicles: Vehicles, pose: Pose, half_m: float) -> Floats:
    """Return the sides (4 M, 2, 2) of vehicles, widened by half_m, relative to a pose."""
    along = np.stack([np.cos(vehicles.heading), np.sin(vehicles.heading)], axis=1)
    across = np.stack([-along[:, 1], along[:, 0]], axis=1)
    ahead = along * (vehicles.size[:, :1] / 2.0 + half_m)
    aside = across * (vehicles.size[:, 1:] / 2.0 + half_m)
    corners = (
        np.stack([ahead + aside, ahead - aside, -ahead - aside, -ahead + aside], axis=1)
        + (vehicles.xy - pose.xy)[:, None]
    )
    return np.stack([corners, np.roll(corners, -1, axis=1)], axis=2).reshape(-1, 2, 2)


def _to_edges(rays: Floats, edges: Floats) -> Floats:
    """Return the distance (R,) at which each ray from the origin first meets an edge, else inf."""
    start, along = edges[:, 0], edges[:, 1] - edges[:, 0]
    cross = rays[:, :1] * along[:, 1] - rays[:, 1:] * along[:, 0]
    with np.errstate(divide="ignore", invalid="ignore"):
        far = (start[:, 0] * along[:, 1] - start[:, 1] * along[:, 0]) / cross
        share = (start[:, 0] * rays[:, 1:] - start[:, 1] * rays[:, :1]) / cross
    met = (cross != 0.0) & (far >= 0.0) & (share >= 0.0) & (share <= 1.0)
    found: Floats = np.where(met, far, np.inf).min(axis=1, initial=np.inf)
    return found


def _to_disks(rays: Floats, middles: Floats, radius_m: float) -> Floats:
    """Return the distance (R,) at which each ray from the origin first meets a disk, else inf."""
    along = rays @ middles.T
    aside2 = (middles**2).sum(axis=1) - along**2
    half = np.sqrt(np.maximum(radius_m**2 - aside2, 0.0))
    met = (aside2 <= radius_m**2) & (along + half >= 0.0)
    found: Floats = np.where(met, np.maximum(along - half, 0.0), np.inf).min(axis=1, initial=np.inf)
    return found
