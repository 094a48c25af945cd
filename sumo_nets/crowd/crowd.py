"""SumoCrowd: background pedestrians, vehicles and signals around the robot, simulated by SUMO.

Each tick is one SUMO step. The robot and the event pedestrians are mirrored into SUMO as proxies,
so the crowd evades them one tick late.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import count
from pathlib import Path
from types import TracebackType
from typing import ClassVar, Self

import numpy as np

from cosim.core.errors import EngineError
from cosim.core.geometry import Pose, headings_from_sumo
from cosim.core.state import (
    NO_VEHICLES,
    People,
    RobotState,
    Street,
    Vehicles,
    write_protect,
    write_protected_copy,
)
from cosim.episode.interfaces import Crowd
from cosim.people.yielding import (
    ROBOT_STANDS_MPS,
    RobotBody,
    StandingObstacles,
    outline_mps,
)
from cosim.place.street_map import Port, StreetMap, ports_of
from cosim.spec.events import Actor, EventReply
from cosim.spec.robot import COURIER
from cosim.spec.scenario import CrowdSpec
from cosim.spec.weather import CLEAR, WEATHERS, Weather
from sumo_nets import engine
from sumo_nets.crowd.braking import BrakingForRobot
from sumo_nets.crowd.demand import (
    LEAVE_MARGIN_M,
    VEHICLE_REACH_M,
    Drivers,
    Pedestrians,
    Seen,
    replayed_demand,
)
from sumo_nets.crowd.demand_log import Entrances
from sumo_nets.crowd.empty_street import TICK_MS, sumo_start
from sumo_nets.crowd.following_gaps import FollowingGaps
from sumo_nets.crowd.free_space import InnerGround
from sumo_nets.crowd.group_cohesion import GroupCohesion
from sumo_nets.crowd.lights import Signals, SumoLights, WaitingSpots
from sumo_nets.crowd.proxy import Proxy, Walks
from sumo_nets.crowd.shown_people import PoseFilter, ShownPeople, positions_of, sorted_actors
from sumo_nets.engine import NearPersons, NearReader, NearVehicles, sumo, sumo_errors

_ROLL_TICKS = 10
"""Interval in ticks at which persons and vehicles enter and leave."""

_WARM_UP_S = 8.0
"""Driving time of the vehicles before the first tick, seconds; persons start at the first tick."""

LET_PAST_S = 1.5
"""Time, seconds, after which people of SUMO walk on where a standing robot blocks a sidewalk. The
displayed people walk round it; without this, robot and people could wait for each other forever."""

_BERTH_M = (0.3, 0.45)
"""Length and width added to the robot's proxy, metres, so that SUMO's pedestrians keep their
distance."""


class SumoCrowd(Crowd):
    """The crowd on a street net. Use it as a context manager.

    net_path: the street net.
    street_map: the map read from that net.
    seed: seed of all random draws; the same calls give the same streets, bit for bit.
    closed: ports with barriers; background pedestrians never pass them.
    start_xy: start position of the robot, metres.
    footprint_m: length and width of the robot, metres.
    recorded: entries and exits of an earlier run to replay.
    obstacles: obstacles, besides the robot, that people step around.
    entrances: entries and exits of this run.
    """

    _running: ClassVar[SumoCrowd | None] = None
    entrances: Entrances

    def __init__(
        self,
        net_path: Path,
        street_map: StreetMap,
        spec: CrowdSpec,
        seed: int,
        closed: frozenset[Port],
        start_xy: tuple[float, float],
        footprint_m: tuple[float, float] = COURIER.footprint_m,
        recorded: Entrances | None = None,
        obstacles: StandingObstacles | None = None,
        weather: Weather = WEATHERS[CLEAR],
    ) -> None:
        self._net_path = net_path
        self._map = street_map
        self._spec = spec
        self._weather = weather
        self._seed = seed
        self._closed = closed | ports_of(street_map.uncrowded)
        self._ground = InnerGround(street_map) if street_map.scanned else None
        self._start_xy = start_xy
        self._half_m = (footprint_m[0] / 2, footprint_m[1] / 2)
        self._recorded = recorded
        self._obstacles = StandingObstacles() if obstacles is None else obstacles
        self._street: Street | None = None
        self._stood_ticks = 0

    def __enter__(self) -> Self:
        if SumoCrowd._running is not None:
            raise EngineError(
                "a SumoCrowd is already running in this process, and SUMO can run only once per "
                "process: close it first, or use another process"
            )
        _, rng_persons, rng_vehicles = np.random.default_rng(self._seed).spawn(3)
        self._launch(*sumo_start(self._seed))
        SumoCrowd._running = self
        try:
            with sumo_errors("setting up the crowd"):
                self._populate(rng_persons, rng_vehicles)
        except BaseException:
            self.close()
            raise
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        at: TracebackType | None,
    ) -> None:
        self.close()

    def close(self) -> None:
        """Stop SUMO; a second call does nothing."""
        if SumoCrowd._running is self:
            SumoCrowd._running = None
            self._street = None
            engine.close()

    @property
    def street(self) -> Street:
        """The current street."""
        if self._street is None:
            raise EngineError("this SumoCrowd is not running: use it as a context manager")
        return self._street

    @property
    def groups(self) -> tuple[tuple[str, ...], ...]:
        """The person ids of each group."""
        return self._cohesion.groups

    def step(self, robot: RobotState, reply: EventReply, *, absent: bool = False) -> Street:
        """Advance by one tick, with the robot and the event pedestrians at their current poses.

        absent: leave the robot out; its position still determines where the crowd enters and
            leaves.
        """
        tick = self.street.tick
        with sumo_errors(f"stepping from tick {tick}"):
            x_m, y_m = robot.pose[:2]
            self._braking.update(self._found[1], None if absent else robot.pose)
            if tick % _ROLL_TICKS == 0:
                persons, vehicles = self._found
                self._gaps.update(persons)
                seen = _seen(persons, engine.persons_waiting_s(persons))
                self._pedestrians.update(x_m, y_m, seen, self._waits_at_red)
                seen = _seen(vehicles, engine.vehicles_waiting_s(vehicles))
                self._drivers.update(x_m, y_m, seen)
            stands = outline_mps(robot.v_mps, robot.w_radps, self._half_m) < ROBOT_STANDS_MPS
            self._stood_ticks = self._stood_ticks + 1 if stands else 0
            if not absent:
                let_past = self._stood_ticks * TICK_MS >= LET_PAST_S * 1000
                self._robot.update(robot.pose, let_past=let_past)
            actors = sorted_actors(reply.actors, self._pedestrians.ages)
            self._mirror(reply.actors)
            sumo.simulationStep()
            body = None if absent else RobotBody(robot.pose, self._half_m, robot.v_mps)
            self._street = self._read(tick + 1, x_m, y_m, actors, body)
        return self._street

    def _launch(self, sumo_seed: int, begin_s: int) -> None:
        if not self._net_path.is_file():
            raise EngineError(f"no street net at {self._net_path}")
        try:
            engine.start(_arguments(self._net_path, sumo_seed, begin_s))
        except EngineError as error:
            raise EngineError(f"SUMO cannot start on {self._net_path}: {error}") from error

    def _populate(
        self, rng_persons: np.random.Generator, rng_vehicles: np.random.Generator
    ) -> None:
        x_m, y_m = self._start_xy
        robot_m = (2.0 * self._half_m[0] + _BERTH_M[0], 2.0 * self._half_m[1] + _BERTH_M[1])
        for kind, (length_m, width_m), gap_m in (
            ("robot", robot_m, 0.5),
            ("event", (0.5, 0.8), 0.25),
        ):
            sumo.vehicletype.copy("DEFAULT_PEDTYPE", kind)
            sumo.vehicletype.setLength(kind, length_m)
            sumo.vehicletype.setWidth(kind, width_m)
            sumo.vehicletype.setMinGap(kind, gap_m)
        self._walks = Walks(sumo, self._map)
        self._signals = Signals(SumoLights(sumo, self._map), self._map)
        self._kerbs = WaitingSpots(self._map)
        self._cohesion = GroupCohesion(sumo, self._map.strips, TICK_MS / 1000)
        self._gaps = FollowingGaps(sumo)
        self._pedestrians, self._drivers = self._demand(rng_persons, rng_vehicles)
        self._reader = NearReader(self._pedestrians.ages)
        self._braking = BrakingForRobot(sumo, self._half_m, self._drivers.size_m, TICK_MS / 1000)
        self._serial: Iterator[int] = count()
        self._robot = Proxy(sumo, self._walks, base="r", kind="robot", serial=self._serial)
        self._actors: dict[str, Proxy] = {}
        self._mirrored: list[str] = []
        self._poses = PoseFilter(TICK_MS / 1000, self._obstacles)
        self._shown = ShownPeople(TICK_MS / 1000)
        self._sized = NO_VEHICLES.ids, NO_VEHICLES.size, NO_VEHICLES.speed
        if self._spec.vehicles:
            self._drivers.fill(x_m, y_m)
            for _ in range(round(_WARM_UP_S * 1000 / TICK_MS)):
                sumo.simulationStep()
        self._pedestrians.fill(x_m, y_m)
        sumo.simulationStep()
        self._street = self._read(0, x_m, y_m, [], None)

    def _demand(
        self, rng_persons: np.random.Generator, rng_vehicles: np.random.Generator
    ) -> tuple[Pedestrians, Drivers]:
        """Return the sources of pedestrians and vehicles; `entrances` records their entries and
        exits."""
        self.entrances = Entrances()
        if self._recorded is not None:
            return replayed_demand(
                sumo,
                self._recorded,
                self._map,
                self._spec,
                self._closed,
                self._cohesion,
                self._gaps,
            )
        logged = sumo, self.entrances, self._map, self._spec
        people = Pedestrians(
            *logged, rng_persons, self._closed, self._cohesion, self._gaps, self._weather
        )
        return people, Drivers(*logged, rng_vehicles)

    def _mirror(self, actors: tuple[Actor, ...]) -> None:
        names = [actor.id for actor in actors]
        if names != self._mirrored:
            self._mirrored = names
            for name in sorted(self._actors.keys() - set(names)):
                self._actors.pop(name).remove()
            for name in names:
                if name not in self._actors:
                    self._actors[name] = Proxy(
                        sumo, self._walks, base=name, kind="event", serial=self._serial
                    )
        for actor in actors:
            self._actors[actor.id].update(Pose(actor.x_m, actor.y_m, actor.heading_rad))

    def _read(
        self, tick: int, x_m: float, y_m: float, actors: list[Actor], body: RobotBody | None
    ) -> Street:
        reach_m = self._spec.radius_m + LEAVE_MARGIN_M
        self._found = self._reader.near(x_m, y_m, reach_m, VEHICLE_REACH_M)
        persons, vehicles = self._found
        people = self._people(persons, actors, body)
        return Street(tick, people, self._vehicles(vehicles), self._signals.near(x_m, y_m))

    def _people(self, persons: NearPersons, actors: list[Actor], body: RobotBody | None) -> People:
        xy = persons.xy
        if red := self._signals.red(persons.ahead):
            xy = xy.copy()
            xy[red] = self._kerbs.behind([persons.ahead[i] for i in red], xy[red])
        if self._ground is not None:
            xy = self._ground.nearest(xy)
        shown = self._poses.update(
            persons.names, xy, persons.mps, _facing, body, positions_of(actors)
        )
        return self._shown.merged(actors, self._pedestrians.ages, persons.names, *shown)

    def _vehicles(self, near: NearVehicles) -> Vehicles:
        """Convert SUMO's positions, the middles of the front bumpers, to the middles of the
        boxes."""
        if near.names != self._sized[0]:
            sizes = [self._drivers.size_m(name) for name in near.names]
            size = write_protected_copy(sizes, shape=(len(sizes), 2))
            self._sized = near.names, size, 0.5 * size[:, 0]
        _, size, half_m = self._sized
        heading = headings_from_sumo(near.angle_deg)
        xy = near.xy.copy()
        xy[:, 0] -= half_m * np.cos(heading)
        xy[:, 1] -= half_m * np.sin(heading)
        return Vehicles(
            near.names, write_protect(xy), write_protect(heading), write_protect(near.mps), size
        )

    def _waits_at_red(self, person: str) -> bool:
        return self._signals.is_red(sumo.person.getNextEdge(person))


def _seen(near: NearPersons | NearVehicles, waiting_s: list[float]) -> dict[str, Seen]:
    x_m, y_m = near.xy.T.tolist()
    return dict(zip(near.names, map(Seen, x_m, y_m, waiting_s), strict=True))


def _facing(person: str) -> float:
    return float(headings_from_sumo(sumo.person.getAngle(person)))


def _arguments(net_path: Path, sumo_seed: int, begin_s: int) -> list[str]:
    """Return SUMO's command line.

    Without jam times nobody squeezes past the robot. With route errors ignored, a blocked person
    jumps to the next edge of its walk; otherwise SUMO stops all persons permanently.
    """
    options: dict[str, object] = {
        "net-file": net_path,
        "seed": sumo_seed,
        "begin": begin_s,
        "step-length": TICK_MS / 1000,
        "pedestrian.model": "striping",
        "pedestrian.striping.dawdling": 0,
        "pedestrian.striping.reserve-oncoming": 0.34,
        "pedestrian.striping.walkingarea-detail": 20,
        "pedestrian.striping.jamtime": -1,
        "pedestrian.striping.jamtime.crossing": -1,
        "collision.action": "warn",
        "collision.check-junctions": "true",
        "time-to-teleport": -1,
        "max-depart-delay": 1,
        "lanechange.duration": 2,
        "ignore-route-errors": "true",
        "no-step-log": "true",
        "no-warnings": "true",
    }
    return [word for name, value in options.items() for word in (f"--{name}", str(value))]
