"""One resident: walks to a node of the behaviour graph, idles or does an activity there.

Pure functions. Phases: "walking" along its path, "idle" at a waypoint, "interacting" with a bench,
shop window or bus stop. Random choices use the generator passed in.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from typing import Final, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray
from shapely import covers
from shapely.geometry import LineString

from cosim.core.geometry import wrap_angle
from cosim.core.state import Age, Doing, PersonKind
from cosim.people.steering import SHOULDER_TO_SHOULDER_M, Neighbour, Vector, steered
from cosim.people.yielding import reaction_distance_m, stepped_around
from cosim.spec.events import Actor, EventQuery
from scenarios.events.behaviour_graph import BehaviorGraph
from scenarios.events.walking import robot_body, turn_towards

SPEED_MPS: Final = (1.1, 1.65)
"""Range of walking speeds in m/s."""
STAY_RANGES_S: Final = {
    "bench": (20.0, 60.0),
    "window": (5.0, 25.0),
    "stop": (15.0, 60.0),
    "idle": (5.0, 20.0),
}
"""Ranges of the seconds that a resident stays, by activity."""
_FAR_M: Final = 120.0
"""Largest walking distance in metres to a goal."""
SPOT_PROBABILITY: Final = 0.75
"""Probability of choosing an interaction spot over a waypoint, if one is available."""
_APART_M: Final = 1.2
"""Smallest distance in metres between standing residents, except on a bench."""
ACCELERATION_MPS2: Final = 3.0
"""Largest change of velocity in m/s^2."""
ARRIVAL_M: Final = 0.04
"""Metres from the goal at which a resident arrives."""
WAYPOINT_PASSED_M: Final = 0.3
"""Metres from a waypoint at which a resident heads for the next."""
SHORTCUT_TICKS: Final = 8
"""Ticks between checks whether a waypoint can be skipped."""
_GIVES_UP_S: Final = 3.0
"""Seconds without progress after which a resident chooses another goal."""
TURNING_MPS: Final = 0.25
"""Animated speed in m/s while turning on the spot: `cosim.people.gait` blends from it."""
RISING_S: Final = 0.55
"""Seconds in which a body rises from its activity, such as sitting, before it moves."""
RISING_MPS: Final = 0.3
"""Animated speed in m/s during `RISING_S`."""
_ABOUT: Final[tuple[Doing, ...]] = ("stand", "look", "phone")
"""Activities of an idle resident."""
_FACES_RAD: Final = 0.02
"""Heading error in radians below which a resident faces its activity."""
_DETOURS_RAD: Final = (0.0, 0.4, -0.4, 0.8, -0.8, 1.2, -1.2)
"""Turns in radians that are tried in order when a step is blocked."""


class Resident(NamedTuple):
    """State of a resident.

    goal: Node it walks to or is at.
    way: Nodes still to visit; the last is the goal.
    doing: Activity at the goal.
    stay_s: Seconds it stays at the goal.
    since_tick: Tick at which the activity began; None before.
    moving_mps: Velocity of its last step.
    shown_mps: Animated speed; greater than zero also while it turns on the spot.
    choices: Number of goals chosen, which seeds the next choice.
    """

    number: int
    x_m: float
    y_m: float
    heading_rad: float
    speed_mps: float
    goal: int
    phase: Literal["walking", "idle", "interacting"] = "walking"
    way: tuple[int, ...] = ()
    doing: Doing = "stand"
    stay_s: float = 0.0
    since_tick: int | None = None
    moving_mps: Vector = (0.0, 0.0)
    shown_mps: float = 0.0
    blocked_ticks: int = 0
    choices: int = 0
    age: Age = Age.ADULT

    @property
    def name(self) -> str:
        return f"n{self.number}"


def resident_actor(resident: Resident) -> Actor:
    """Return the actor of a resident."""
    here = resident.phase != "walking" and resident.since_tick is not None
    return Actor(
        id=resident.name,
        x_m=resident.x_m,
        y_m=resident.y_m,
        heading_rad=resident.heading_rad,
        speed_mps=math.hypot(*resident.moving_mps),
        pace_mps=resident.shown_mps,
        doing=resident.doing if here else "walk" if resident.shown_mps > 0.0 else "stand",
        kind=PersonKind.RESIDENT,
        age=resident.age,
    )


def needs_new_goal(resident: Resident, query: EventQuery) -> bool:
    """Return whether its stay is over or it makes no progress."""
    if resident.phase == "walking":
        return resident.blocked_ticks * query.tick_ms / 1000 >= _GIVES_UP_S
    return _here_s(resident, query) >= resident.stay_s + RISING_S


def choose_goal(
    resident: Resident, graph: BehaviorGraph, rng: np.random.Generator, taken: Collection[int]
) -> Resident:
    """Choose a new goal for a resident.

    taken: Nodes that other residents occupy or walk to.
    """
    node = graph.nearest(resident.x_m, resident.y_m)
    resident = resident._replace(
        blocked_ticks=0, choices=resident.choices + 1, since_tick=None, phase="walking"
    )
    if node is None:
        return resident
    distance, _ = graph.distances(node)
    within = (distance > 0.0) & (distance < _FAR_M)
    within[sorted({*taken, resident.goal})] = False
    goal = draw_spot(graph, within, rng) if rng.random() < SPOT_PROBABILITY else None
    if goal is None:
        goal = draw_waypoint(graph, within, rng, taken)
    if goal is None:
        return resident
    return assign_goal(resident._replace(way=(node, *graph.way(node, goal))), graph, goal, rng)


def draw_spot(
    graph: BehaviorGraph, open_to: NDArray[np.bool_], rng: np.random.Generator
) -> int | None:
    """Draw an interaction spot: first the activity, then the node; None if there is none.

    open_to: (N,) bool, the nodes to choose from.
    """
    offered = [
        nodes
        for of_what in graph.nodes_by_activity.values()
        if len(nodes := of_what[open_to[of_what]])
    ]
    if not offered:
        return None
    nodes = offered[int(rng.integers(len(offered)))]
    return int(nodes[int(rng.integers(len(nodes)))])


def draw_waypoint(
    graph: BehaviorGraph,
    open_to: NDArray[np.bool_],
    rng: np.random.Generator,
    taken: Collection[int],
) -> int | None:
    """Draw a waypoint away from occupied nodes, preferably one for idling; None if there is none.

    open_to: (N,) bool, the nodes to choose from.
    """
    open_to = open_to[: graph.waypoints].copy()
    for x, y in graph.xy[sorted(taken)].tolist():
        open_to &= np.hypot(*(graph.xy[: graph.waypoints] - (x, y)).T) > _APART_M
    aside = open_to & graph.idle
    nodes = np.flatnonzero(aside if aside.any() else open_to)
    return int(nodes[int(rng.integers(len(nodes)))]) if len(nodes) else None


def assign_goal(
    resident: Resident, graph: BehaviorGraph, goal: int, rng: np.random.Generator
) -> Resident:
    """Set a resident's goal, its activity there and the duration."""
    spot = graph.spot(goal)
    low, high = STAY_RANGES_S["idle" if spot is None else spot.what]
    stay_s = float(rng.uniform(low, high))
    doing = _ABOUT[int(rng.integers(len(_ABOUT)))]
    if spot is None and not graph.idle[goal]:
        stay_s = 0.0  # standing here would block others
    elif spot is not None and spot.what != "stop":
        doing = "sit" if spot.what == "bench" else "look"
    return resident._replace(goal=goal, doing=doing, stay_s=stay_s)


def step_resident(
    resident: Resident, graph: BehaviorGraph, query: EventQuery, neighbours: Sequence[Neighbour]
) -> Resident:
    """Advance a resident by one tick."""
    if resident.phase == "walking":
        return _walked(resident, graph, query, neighbours)
    if resident.since_tick is None:
        return _turned(resident, graph, query)
    leaves = _here_s(resident, query) >= resident.stay_s
    return resident._replace(shown_mps=RISING_MPS if leaves else 0.0)


def arrived(resident: Resident, graph: BehaviorGraph) -> Resident:
    """Place a resident at its goal, before it turns to its activity."""
    x, y = graph.points[resident.goal]
    phase: Literal["idle", "interacting"] = (
        "idle" if graph.spot(resident.goal) is None else "interacting"
    )
    return resident._replace(
        x_m=x, y_m=y, phase=phase, way=(), moving_mps=(0.0, 0.0), since_tick=None
    )


def _turned(resident: Resident, graph: BehaviorGraph, query: EventQuery) -> Resident:
    spot = graph.spot(resident.goal)
    wanted = resident.heading_rad if spot is None else spot.heading_rad
    heading = turn_towards(resident.heading_rad, wanted, query.tick_ms / 1000)
    if abs(wrap_angle(heading - wanted)) > _FACES_RAD:
        return resident._replace(heading_rad=heading, moving_mps=(0.0, 0.0), shown_mps=TURNING_MPS)
    return resident._replace(
        heading_rad=wanted, moving_mps=(0.0, 0.0), shown_mps=0.0, since_tick=query.tick
    )


def _walked(
    resident: Resident, graph: BehaviorGraph, query: EventQuery, neighbours: Sequence[Neighbour]
) -> Resident:
    if not resident.way:
        return resident._replace(
            moving_mps=(0.0, 0.0), shown_mps=0.0, blocked_ticks=resident.blocked_ticks + 1
        )
    tick_s = query.tick_ms / 1000
    at = resident.x_m, resident.y_m
    way = _ahead(resident, graph, query)
    x, y = graph.points[way[0]]
    far_m = math.dist(at, (x, y))
    if len(way) == 1 and far_m < max(ARRIVAL_M, 0.5 * resident.shown_mps * tick_s):
        return arrived(resident, graph)._replace(
            moving_mps=((x - at[0]) / tick_s, (y - at[1]) / tick_s)
        )
    pace = resident.speed_mps if len(way) > 1 else min(resident.speed_mps, max(0.35, far_m / 0.5))
    pace = min(pace, far_m / tick_s)
    wanted = (pace * (x - at[0]) / max(far_m, 1e-9), pace * (y - at[1]) / max(far_m, 1e-9))
    velocity = _eased(
        resident.moving_mps, steered(at, resident.moving_mps, wanted, neighbours), tick_s
    )
    after = _stepped(at, velocity, graph, query, neighbours, tick_s)
    moved = (after[0] - at[0]) / tick_s, (after[1] - at[1]) / tick_s
    shown = math.hypot(*moved)
    heading = resident.heading_rad
    if shown > 0.1:
        heading = turn_towards(heading, math.atan2(moved[1], moved[0]), tick_s)
    slow = shown < 0.3 * pace
    return resident._replace(
        x_m=after[0],
        y_m=after[1],
        heading_rad=heading,
        moving_mps=moved,
        shown_mps=shown,
        way=way,
        blocked_ticks=resident.blocked_ticks + 1 if slow else 0,
    )


def _ahead(resident: Resident, graph: BehaviorGraph, query: EventQuery) -> tuple[int, ...]:
    """Return the path without waypoints that are reached or can be skipped."""
    way = resident.way
    at = (resident.x_m, resident.y_m)
    while len(way) > 1 and math.dist(at, graph.points[way[0]]) < WAYPOINT_PASSED_M:
        way = way[1:]
    looks = (query.tick + resident.number) % SHORTCUT_TICKS == 0
    if len(way) > 1 and looks and covers(graph.ground, LineString([at, graph.points[way[1]]])):
        way = way[1:]
    return way


def _eased(before: Vector, wanted: Vector, tick_s: float) -> Vector:
    """Return the velocity limited by the acceleration of a person."""
    dx, dy = wanted[0] - before[0], wanted[1] - before[1]
    share = min(1.0, ACCELERATION_MPS2 * tick_s / max(math.hypot(dx, dy), 1e-9))
    return before[0] + share * dx, before[1] + share * dy


def _stepped(
    at: Vector,
    velocity: Vector,
    graph: BehaviorGraph,
    query: EventQuery,
    neighbours: Sequence[Neighbour],
    tick_s: float,
) -> Vector:
    """Return the position after a step around the robot, people and the graph's boundary.

    The current position if every detour is blocked.
    """
    robot = robot_body(query)
    for turn_rad in _DETOURS_RAD:
        cos, sin = math.cos(turn_rad), math.sin(turn_rad)
        onward = (
            at[0] + tick_s * (cos * velocity[0] - sin * velocity[1]),
            at[1] + tick_s * (sin * velocity[0] + cos * velocity[1]),
        )
        if math.dist(onward, robot.pose[:2]) < reaction_distance_m(robot):
            x, y = stepped_around(np.array([at]), np.array([onward]), robot)[0].tolist()
            onward = x, y
        if graph.free(*onward) and not any(_nearer(at, onward, one) for one in neighbours):
            return onward
    return at


def _nearer(at: Vector, onward: Vector, one: Neighbour) -> bool:
    """Return whether a step leads closer to a person who is too close."""
    far_m = math.hypot(onward[0] - one.x_m, onward[1] - one.y_m)
    return far_m < SHOULDER_TO_SHOULDER_M and far_m < math.hypot(at[0] - one.x_m, at[1] - one.y_m)


def _here_s(resident: Resident, query: EventQuery) -> float:
    return (
        -math.inf
        if resident.since_tick is None
        else (query.tick - resident.since_tick) * query.tick_ms / 1000
    )
