"""Director that adds residents to another director's replies.

A fixed number is around the robot; residents appear and disappear out of its sight. Each draws from
its own generators, so its behaviour depends only on the scenario, its number and what it meets.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Final

import msgspec
import numpy as np
from numpy.typing import NDArray

from cosim.core.geometry import Floats
from cosim.core.state import Age, People, PersonKind
from cosim.episode.interfaces import Director
from cosim.people.steering import STEERING_NEAR_M, Neighbour
from cosim.place.street_map import StreetMap
from cosim.spec.events import EventQuery, EventReply
from cosim.spec.scenario import Scenario
from physics.street.surface import PlaceSurface
from scenarios.events.behaviour_graph import BehaviorGraph, behavior_graph
from scenarios.events.resident import (
    SPEED_MPS,
    Resident,
    arrived,
    assign_goal,
    choose_goal,
    draw_spot,
    draw_waypoint,
    needs_new_goal,
    resident_actor,
    step_resident,
)
from scenarios.events.sight import AVOIDANCE_SHARE, STANDING_MPS
from sumo_nets.crowd.demand import FIRST_FILL_CLEAR_M, SIGHT_M
from sumo_nets.crowd.group_sampling import ELDERLY_SHARE

APPEARS_WITHIN_M: Final = 60.0
"""Largest distance in metres from the robot at which residents appear."""
REMOVED_BEYOND_M: Final = 70.0
"""Distance in metres from the robot beyond which residents are removed."""
_POPULATION_TICKS: Final = 10
"""Ticks between updates of the population."""
_ROOM_M: Final = 1.5
"""Smallest distance in metres between a new resident and other people."""
SETTLED_PROBABILITY: Final = 0.5
"""Probability that a new resident is already at an interaction spot, if one is available."""
_MAX_NEIGHBOURS: Final = 6
"""Largest number of people that a resident's steering considers."""
_KIND: Final = 0x8E51
"""Separates the random generators of residents from others with the same seed."""


def with_residents(
    director: Director,
    scenario: Scenario,
    street_map: StreetMap,
    ground: PlaceSurface,
    people: Callable[[], People],
) -> Director:
    """Wrap a director to add the scenario's residents; unchanged if the scenario has none."""
    count = scenario.weathered_crowd.residents
    if not count:
        return director
    graph = behavior_graph(
        street_map, ground, scenario.route, scenario.barriers, scenario.obstacles
    )
    return Residents(director, graph, count, scenario.seed, people)


class Residents:
    """Adds residents to another director's replies.

    people: Returns all people on the street, including residents.
    """

    def __init__(
        self,
        director: Director,
        graph: BehaviorGraph,
        count: int,
        seed: int,
        people: Callable[[], People],
    ) -> None:
        self._director = director
        self._graph = graph
        self._count = count
        self._seed = seed
        self._people = people
        self._here: dict[int, Resident] = {}
        self._next = 0

    @property
    def here(self) -> tuple[Resident, ...]:
        """Residents that exist now."""
        return tuple(self._here.values())

    def react(self, query: EventQuery) -> EventReply:
        """Return the director's reply with the residents of this tick among its actors."""
        reply = self._director.react(query)
        people = self._people()
        self._advance(query, people)
        if query.tick % _POPULATION_TICKS == 0:
            self._repopulate(query, people)
        if not self._here:
            return reply
        return msgspec.structs.replace(
            reply, actors=(*reply.actors, *map(resident_actor, self._here.values()))
        )

    def _advance(self, query: EventQuery, people: People) -> None:
        robot = Neighbour(
            query.robot_x_m, query.robot_y_m, *_velocity(query.robot_v_mps, query.robot_heading_rad)
        )
        for number, resident in list(self._here.items()):
            if needs_new_goal(resident, query):
                taken = {one.goal for one in self._here.values() if one.number != number}
                resident = choose_goal(
                    resident, self._graph, self._rng(number, resident.choices), taken
                )
            self._here[number] = resident
        around = _around([one for one in self._here.values() if one.phase == "walking"], people)
        for number, resident in list(self._here.items()):
            self._here[number] = step_resident(
                resident, self._graph, query, (robot, *around.get(number, ()))
            )

    def _repopulate(self, query: EventQuery, people: People) -> None:
        robot = np.array([query.robot_x_m, query.robot_y_m])
        for number, one in list(self._here.items()):
            if np.hypot(one.x_m - robot[0], one.y_m - robot[1]) > REMOVED_BEYOND_M:
                del self._here[number]
        if len(self._here) >= self._count or not len(self._graph):
            return
        away = np.hypot(*(self._graph.xy - robot).T)
        nearest = SIGHT_M if query.tick else FIRST_FILL_CLEAR_M
        ring = (away >= nearest) & (away <= APPEARS_WITHIN_M)
        ring[[one.goal for one in self._here.values()]] = False
        for _ in range(self._count - len(self._here)):
            others = np.array(
                [*people.xy.tolist(), *((one.x_m, one.y_m) for one in self._here.values())]
            )
            resident = self._appearing(ring, others.reshape(-1, 2), query)
            if resident is None:
                return
            ring[resident.goal] = False
            self._here[resident.number] = resident

    def _appearing(
        self, ring: NDArray[np.bool_], others: Floats, query: EventQuery
    ) -> Resident | None:
        """Create a resident at one of the nodes, busy or walking; None if people are too close.

        ring: (N,) bool, the nodes to choose from.
        """
        number, graph = self._next, self._graph
        rng = self._rng(number, 0)
        self._next += 1
        node = draw_spot(graph, ring, rng) if rng.random() < SETTLED_PROBABILITY else None
        settled = node is not None
        if node is None:
            node = draw_waypoint(graph, ring, rng, ())
        if node is None or (np.hypot(*(others - graph.xy[node]).T) < _ROOM_M).any():
            return None
        x, y = graph.xy[node].tolist()
        spot = graph.spot(node)
        heading = float(rng.uniform(-np.pi, np.pi)) if spot is None else spot.heading_rad
        one = Resident(number, x, y, heading, float(rng.uniform(*SPEED_MPS)), node, choices=1)
        if settled:
            one = arrived(assign_goal(one, graph, node, rng), graph)
            one = one._replace(since_tick=query.tick, stay_s=one.stay_s * float(rng.random()))
        else:
            one = choose_goal(one, graph, rng, {other.goal for other in self._here.values()})
        return one._replace(age=Age.ELDERLY if rng.random() < ELDERLY_SHARE else Age.ADULT)

    def _rng(self, number: int, choice: int) -> np.random.Generator:
        return np.random.default_rng([self._seed, _KIND, number, choice])


def _around(walking: Sequence[Resident], people: People) -> dict[int, list[Neighbour]]:
    """Return the nearest people around each walking resident, by its number."""
    if not walking or not len(people):
        return {one.number: [] for one in walking}
    at = np.array([(one.x_m, one.y_m) for one in walking])
    apart = people.xy[None] - at[:, None]
    square = np.einsum("ijk,ijk->ij", apart, apart)
    found: dict[int, list[tuple[float, Neighbour]]] = {one.number: [] for one in walking}
    for k, i in np.argwhere(square < STEERING_NEAR_M**2).tolist():
        if people.ids[i] != walking[k].name:
            moving = _velocity(float(people.speed[i]), float(people.heading[i]))
            x, y = people.xy[i].tolist()
            steers = people.kind[i] != PersonKind.CROWD and people.speed[i] > STANDING_MPS
            one = Neighbour(x, y, *moving, AVOIDANCE_SHARE if steers else 1.0)
            found[walking[k].number].append((float(square[k, i]), one))
    return {
        number: [one for _, one in sorted(near)[:_MAX_NEIGHBOURS]] for number, near in found.items()
    }


def _velocity(speed_mps: float, heading_rad: float) -> tuple[float, float]:
    return speed_mps * math.cos(heading_rad), speed_mps * math.sin(heading_rad)
