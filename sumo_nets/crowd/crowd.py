"""SumoCrowd: the people, vehicles and signals around the robot, by SUMO. The only file that imports libsumo.

One SUMO per process, and one step of it per tick. Persons, robot and event pedestrians share SUMO's sidewalks: the
robot and the event pedestrians are mirrored in as proxies, so the crowd evades them one tick late.
"""

from __future__ import annotations

import os
import sys
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from itertools import count
from pathlib import Path
from types import TracebackType
from typing import Any, ClassVar, Self

import libsumo
import numpy as np

from cosim.core.errors import EngineError
from cosim.core.geometry import Floats, Pose, headings_from_sumo
from cosim.core.state import People, PersonKind, RobotState, Street, Vehicles
from cosim.episode.ports import Crowd
from cosim.people.gait import Strides
from cosim.people.yielding import RobotBody
from cosim.place.street_map import Port, StreetMap
from cosim.spec.events import Actor, EventReply
from cosim.spec.robot import COURIER
from cosim.spec.scenario import CrowdSpec
from sumo_nets.crowd.demand import LINGER_M, VEHICLE_REACH_M, Drivers, Pedestrians, Seen
from sumo_nets.crowd.demand_log import DRIVERS, PEDESTRIANS, Entrances, Kept
from sumo_nets.crowd.demand_replay import replayed_demand
from sumo_nets.crowd.group_cohesion import Together
from sumo_nets.crowd.lights import Signals
from sumo_nets.crowd.pose_filter import PERSON_STANDS_MPS, PoseFilter
from sumo_nets.crowd.proxy import Proxy, Walks
from sumo_nets.crowd.waiting_spots import Kerbs

TICK_MS = 50
"""One step of SUMO."""

_ROLL_TICKS = 10
"""How often persons and vehicles come and go."""

_WARM_UP_S = 8.0
"""How long the vehicles drive before the first tick; persons walk at once."""

SIGNAL_CLOCK_S = 3600
"""The signals' clocks start somewhere in this span, drawn from the seed."""

NOWHERE_M = -1e8
"""Who has not set out yet is beyond this."""

_BERTH_M = (0.3, 0.45)
"""To SUMO's walkers the robot is so much longer and wider than it is: they pass it wide."""

EYE = "robot"
Row = dict[int, Any]
"""Somebody's variables of one tick, as SUMO numbers them."""

tc = libsumo.constants
SUMO_ERRORS = (libsumo.TraCIException, libsumo.FatalTraCIError)


class SumoCrowd(Crowd):
    """The crowd around the robot on the street net at `net_path`, of which `street_map` was read.

    closed: ports where barriers stand; background walkers never pass them. start_xy: where the robot starts, metres.
    footprint_m: its length and width. before: who entered and left a street like this one, to be let in and out again.
    Everything random comes from `seed`: the same calls give the same streets, bit for bit. Use as a context manager.
    entrances: who has come and gone since it was entered.
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
        before: Entrances | None = None,
    ) -> None:
        self._net_path, self._map, self._spec, self._seed = net_path, street_map, spec, seed
        self._closed, self._start_xy = closed, start_xy
        self._half_m = (footprint_m[0] / 2, footprint_m[1] / 2)
        self._before = before
        self._street: Street | None = None

    def __enter__(self) -> Self:
        if SumoCrowd._running is not None:
            raise EngineError(
                "a SumoCrowd is already running in this process, and SUMO can run only once per process: "
                "close it first, or use another process"
            )
        rng_sumo, rng_persons, rng_vehicles = np.random.default_rng(self._seed).spawn(3)
        self._launch(int(rng_sumo.integers(2**31)), int(rng_sumo.integers(SIGNAL_CLOCK_S)))
        SumoCrowd._running = self
        try:
            with _translated("setting up the crowd"):
                self._populate(rng_persons, rng_vehicles)
        except BaseException:
            self.close()
            raise
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self.close()

    def close(self) -> None:
        """Stop SUMO; a second call does nothing."""
        if SumoCrowd._running is self:
            SumoCrowd._running = None
            self._street = None
            libsumo.close()

    @property
    def street(self) -> Street:
        """The street now."""
        if self._street is None:
            raise EngineError("this SumoCrowd is not running: use it as a context manager")
        return self._street

    @property
    def groups(self) -> tuple[tuple[str, ...], ...]:
        """The ids of those who walk together, group by group."""
        return self._together.groups

    def step(self, robot: RobotState, reply: EventReply, *, absent: bool = False) -> Street:
        """One tick on, with the robot and the event pedestrians where they are now.

        absent: nobody is there where the robot would be; the crowd still comes and goes around that point.
        """
        tick = self.street.tick
        with _translated(f"stepping from tick {tick}"):
            x_m, y_m = robot.pose[:2]
            libsumo.poi.setPosition(EYE, x_m, y_m)
            if tick % _ROLL_TICKS == 0:
                persons, vehicles = self._found
                self._pedestrians.roll(x_m, y_m, _seen(libsumo.person, persons), self._waits_at_red)
                self._drivers.roll(x_m, y_m, _seen(libsumo.vehicle, vehicles))
            if not absent:
                self._robot.update(robot.pose)
            self._mirror(reply.actors)
            libsumo.simulationStep()
            body = None if absent else RobotBody(robot.pose, self._half_m, robot.v_mps)
            self._street = self._read(tick + 1, x_m, y_m, reply.actors, body)
        return self._street

    def _launch(self, sumo_seed: int, begin_s: int) -> None:
        if not self._net_path.is_file():
            raise EngineError(f"no street net at {self._net_path}")
        said: list[str] = []
        try:
            with _stderr_into(said):
                libsumo.start(_arguments(self._net_path, sumo_seed, begin_s))
        except SUMO_ERRORS as error:
            with suppress(*SUMO_ERRORS):
                libsumo.close()
            reason = " ".join("".join([*said, str(error)]).split())
            raise EngineError(f"SUMO cannot start on {self._net_path}: {reason}") from error

    def _populate(self, rng_persons: np.random.Generator, rng_vehicles: np.random.Generator) -> None:
        x_m, y_m = self._start_xy
        robot_m = (2.0 * self._half_m[0] + _BERTH_M[0], 2.0 * self._half_m[1] + _BERTH_M[1])
        for kind, (length_m, width_m), gap_m in (("robot", robot_m, 0.5), ("event", (0.5, 0.8), 0.25)):
            libsumo.vehicletype.copy("DEFAULT_PEDTYPE", kind)
            libsumo.vehicletype.setLength(kind, length_m)
            libsumo.vehicletype.setWidth(kind, width_m)
            libsumo.vehicletype.setMinGap(kind, gap_m)
        self._walks = Walks(libsumo, self._map)
        self._signals = Signals(libsumo, self._map)
        self._kerbs = Kerbs(self._map)
        self._together = Together(libsumo, self._map.strips, TICK_MS / 1000)
        self._pedestrians, self._drivers = self._demand(rng_persons, rng_vehicles)
        self._serial: Iterator[int] = count()
        self._robot = Proxy(libsumo, self._walks, base="r", kind="robot", serial=self._serial)
        self._actors: dict[str, Proxy] = {}
        self._poses = PoseFilter(TICK_MS / 1000)
        self._strides = Strides(TICK_MS / 1000)
        self._watch(x_m, y_m)
        if self._spec.vehicles:
            self._drivers.fill(x_m, y_m)
            for _ in range(round(_WARM_UP_S * 1000 / TICK_MS)):
                libsumo.simulationStep()
        self._pedestrians.fill(x_m, y_m)
        libsumo.simulationStep()
        self._street = self._read(0, x_m, y_m, (), None)

    def _demand(
        self, rng_persons: np.random.Generator, rng_vehicles: np.random.Generator
    ) -> tuple[Pedestrians, Drivers]:
        """Those who let people and vehicles in and out; what they do is kept in `entrances`."""
        self.entrances = Entrances()
        if self._before is not None:
            return replayed_demand(self._before, self._map, self._spec, self._closed, self._together)
        on_foot, driving = (Kept(libsumo, self.entrances, whose) for whose in (PEDESTRIANS, DRIVERS))
        people = Pedestrians(on_foot, self._map, self._spec, rng_persons, self._closed, self._together)
        self.entrances.ages = people.ages
        return people, Drivers(driving, self._map, self._spec, rng_vehicles)

    def _watch(self, x_m: float, y_m: float) -> None:
        """One subscription each to the persons and to the vehicles around a point that follows the robot."""
        libsumo.poi.add(EYE, x_m, y_m, (0, 0, 0, 0))
        for domain, reach_m, variables in (
            (tc.CMD_GET_PERSON_VARIABLE, self._spec.radius_m + LINGER_M, (tc.VAR_SPEED, tc.VAR_NEXT_EDGE)),
            (tc.CMD_GET_VEHICLE_VARIABLE, VEHICLE_REACH_M, (tc.VAR_SPEED, tc.VAR_ANGLE)),
        ):
            libsumo.poi.subscribeContext(EYE, domain, reach_m, [tc.VAR_POSITION, *variables])

    def _mirror(self, actors: tuple[Actor, ...]) -> None:
        present = {actor.id for actor in actors}
        if len(present) != len(actors) or present & self._pedestrians.ages.keys():
            raise EngineError(f"actors need unique ids, and none of the crowd's: {[a.id for a in actors]}")
        for name in sorted(self._actors.keys() - present):
            self._actors.pop(name).remove()
        for actor in actors:
            if actor.id not in self._actors:
                self._actors[actor.id] = Proxy(libsumo, self._walks, base=actor.id, kind="event", serial=self._serial)
            self._actors[actor.id].update(Pose(actor.x_m, actor.y_m, actor.heading_rad))

    def _read(self, tick: int, x_m: float, y_m: float, actors: tuple[Actor, ...], body: RobotBody | None) -> Street:
        found: dict[str, Row] = libsumo.poi.getContextSubscriptionResults(EYE)
        here = sorted(name for name, row in found.items() if row[tc.VAR_POSITION][0] > NOWHERE_M)
        persons = {name: found[name] for name in here if name in self._pedestrians.ages}
        vehicles = {name: found[name] for name in here if tc.VAR_ANGLE in found[name]}
        self._found = persons, vehicles
        people = self._people(persons, actors, body)
        return Street(tick, people, self._vehicles(vehicles), self._signals.near(x_m, y_m))

    def _people(self, persons: dict[str, Row], actors: tuple[Actor, ...], body: RobotBody | None) -> People:
        ids = tuple(persons)
        xy, speed = _column(persons, tc.VAR_POSITION, 2), _column(persons, tc.VAR_SPEED)
        for i, row in enumerate(persons.values()):
            if self._signals.is_red(ahead := row[tc.VAR_NEXT_EDGE]):
                xy[i] = self._kerbs.behind(ahead, *row[tc.VAR_POSITION])
        cast = sorted(actors, key=lambda actor: actor.id)
        others = np.array([(a.x_m, a.y_m) for a in cast], dtype=float).reshape(-1, 2)
        xy, heading, speed = self._poses.update(ids, xy, speed, _facing, body, others)
        names = (*ids, *(a.id for a in cast))
        places = np.concatenate([xy, others])
        speeds = np.concatenate([speed, [a.speed_mps for a in cast]])
        paces = np.concatenate([speed, [a.speed_mps if a.pace_mps is None else a.pace_mps for a in cast]])
        ages = [*(self._pedestrians.ages[name] for name in ids), *(a.age for a in cast)]
        return People.of(
            names,
            places,
            np.concatenate([heading, [a.heading_rad for a in cast]]),
            speeds,
            (*("walk" if fast else "stand" for fast in (speed > PERSON_STANDS_MPS).tolist()), *(a.doing for a in cast)),
            *self._strides.update(names, places, paces, ages),
            [*[PersonKind.CROWD] * len(ids), *(a.kind for a in cast)],
            ages,
        )

    def _vehicles(self, vehicles: dict[str, Row]) -> Vehicles:
        """SUMO's position is the middle of the front bumper; the street's is the middle of the box."""
        size = np.array([self._drivers.size_m(name) for name in vehicles], dtype=float).reshape(-1, 2)
        heading = headings_from_sumo(_column(vehicles, tc.VAR_ANGLE))
        back = 0.5 * size[:, :1] * np.column_stack([np.cos(heading), np.sin(heading)])
        xy = _column(vehicles, tc.VAR_POSITION, 2) - back
        return Vehicles.of(tuple(vehicles), xy, heading, _column(vehicles, tc.VAR_SPEED), size)

    def _waits_at_red(self, person: str) -> bool:
        return self._signals.is_red(libsumo.person.getNextEdge(person))


def _seen(domain: Any, found: Mapping[str, Row]) -> dict[str, Seen]:
    at = {name: row[tc.VAR_POSITION] for name, row in found.items()}
    return {name: Seen(x_m, y_m, domain.getWaitingTime(name)) for name, (x_m, y_m) in at.items()}


def _facing(person: str) -> float:
    return float(headings_from_sumo(libsumo.person.getAngle(person)))


def _column(found: Mapping[str, Row], variable: int, width: int | None = None) -> Floats:
    """One variable of everybody: (N,), or (N, width)."""
    values = np.array([row[variable] for row in found.values()], dtype=float)
    return values if width is None else values.reshape(-1, width)


def _arguments(net_path: Path, sumo_seed: int, begin_s: int) -> list[str]:
    """SUMO's command line; see the options' own help for more.

    Without jam times nobody squeezes through the robot. With route errors ignored, somebody who cannot walk on jumps to
    the next edge of the walk: without, SUMO stops all persons for good.
    """
    options: dict[str, object] = {
        "net-file": net_path,
        "seed": sumo_seed,
        "begin": begin_s,
        "step-length": TICK_MS / 1000,
        "pedestrian.model": "striping",
        "pedestrian.striping.dawdling": 0,
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
    return ["sumo", *(word for name, value in options.items() for word in (f"--{name}", str(value)))]


@contextmanager
def _stderr_into(said: list[str]) -> Iterator[None]:
    """Collect what is written to the process's stderr: libsumo prints there what its exceptions leave out."""
    sys.stderr.flush()
    with tempfile.TemporaryFile() as heard:
        kept = os.dup(2)
        os.dup2(heard.fileno(), 2)
        try:
            yield
        finally:
            os.dup2(kept, 2)
            os.close(kept)
            heard.seek(0)
            said.append(heard.read().decode(errors="replace"))


@contextmanager
def _translated(doing: str) -> Iterator[None]:
    try:
        yield
    except SUMO_ERRORS as error:
        raise EngineError(f"SUMO failed while {doing}: {error}") from error
