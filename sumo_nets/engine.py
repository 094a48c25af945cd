"""Typed access to libsumo, for the functions that the project uses. No other file imports libsumo.

SUMO runs once per process. `start` and `close` bound its run; `sumo` holds its functions, with
SUMO's own names and units.
"""

from __future__ import annotations

import importlib.util
import os
import sys
import tempfile
from collections.abc import Callable, Container, Iterator, Sequence
from contextlib import contextmanager, suppress
from itertools import chain, compress
from types import TracebackType
from typing import Any, Final, NamedTuple, Protocol

import numpy as np
import sumo as eclipse_sumo  # noqa: F401  sets the path of SUMO's data

from cosim.core.errors import EngineError
from cosim.core.geometry import Floats


@contextmanager
def _unexecuted(package: str) -> Iterator[None]:
    """Import modules of a package without running its `__init__`. Later imports get the whole
    package."""
    found = importlib.util.find_spec(package)
    if package in sys.modules or found is None or found.submodule_search_locations is None:
        yield
        return
    sys.modules[package] = importlib.util.module_from_spec(found)
    try:
        yield
    finally:
        del sys.modules[package]


with _unexecuted("libsumo"):  # its __init__ imports traci, sumolib and pyproj, which are not needed
    import libsumo.libsumo as _sumo

libsumo: Any = _sumo
libsumo.simulationStep = libsumo.simulation.step
_native: Final = libsumo._libsumo
"""libsumo without its Python wrappers, for functions that are called hundreds of times a tick."""

for _name in ("moveToXY", "getRoadID", "getNextEdge", "getLanePosition", "getAngle", "setSpeed"):
    setattr(libsumo.person, _name, getattr(_native, f"person_{_name}"))
for _name in ("getLaneID", "getLanePosition", "setSpeed"):
    setattr(libsumo.vehicle, _name, getattr(_native, f"vehicle_{_name}"))


_ERRORS: Final = (libsumo.TraCIException, libsumo.FatalTraCIError)


class _Persons(Protocol):
    getIDList: Callable[[], Sequence[str]]
    getRoadID: Callable[[str], str]
    getNextEdge: Callable[[str], str]
    getPosition: Callable[[str], tuple[float, float]]
    getLanePosition: Callable[[str], float]
    getSpeed: Callable[[str], float]
    getAngle: Callable[[str], float]

    def add(self, name: str, edge: str, at_m: float, /, *, typeID: str = ...) -> None: ...
    def appendWalkingStage(
        self, name: str, edges: list[str], until_m: float, /, *, speed: float = ...
    ) -> None: ...

    def moveToXY(
        self,
        name: str,
        edge: str,
        x_m: float,
        y_m: float,
        angle_deg: float,
        mode: int,
        match_m: float,
        /,
    ) -> None: ...

    setSpeed: Callable[[str, float], None]
    setMinGap: Callable[[str, float], None]
    remove: Callable[[str], None]


class _Cars(Protocol):
    getIDList: Callable[[], Sequence[str]]
    getNextTLS: Callable[[str], Sequence[tuple[str, int, float, str]]]
    getLaneID: Callable[[str], str]
    getLanePosition: Callable[[str], float]
    getRoute: Callable[[str], Sequence[str]]
    getRouteIndex: Callable[[str], int]
    setSpeed: Callable[[str, float], None]
    setSpeedMode: Callable[[str, int], None]

    def add(
        self, name: str, route: str, /, *, typeID: str, departLane: str, departPos: str
    ) -> None: ...

    remove: Callable[[str], None]


class _Lanes(Protocol):
    getLength: Callable[[str], float]
    getWidth: Callable[[str], float]
    getShape: Callable[[str], Sequence[Sequence[float]]]
    getAllowed: Callable[[str], Sequence[str]]
    getLinks: Callable[[str], Sequence[tuple[str, bool, bool, bool, str, str, str, float]]]


class _Edges(Protocol):
    getIDList: Callable[[], Sequence[str]]
    getFromJunction: Callable[[str], str]
    getToJunction: Callable[[str], str]
    getLaneNumber: Callable[[str], int]


class _Phase(Protocol):
    duration: float
    state: str


class _Program(Protocol):
    programID: str
    type: int
    phases: Sequence[_Phase]


class _Lights(Protocol):
    getIDList: Callable[[], Sequence[str]]
    getControlledLinks: Callable[[str], Sequence[Sequence[tuple[str, str, str]]]]
    getNextSwitch: Callable[[str], float]
    getRedYellowGreenState: Callable[[str], str]
    getPhase: Callable[[str], int]
    getProgram: Callable[[str], str]
    getAllProgramLogics: Callable[[str], Sequence[_Program]]


class _Routes(Protocol):
    add: Callable[[str, list[str]], None]


class _Types(Protocol):
    copy: Callable[[str, str], None]
    setLength: Callable[[str, float], None]
    setWidth: Callable[[str, float], None]
    setMinGap: Callable[[str, float], None]


class _Simulation(Protocol):
    getTime: Callable[[], float]


class Sumo(Protocol):
    """SUMO's functions, grouped by subject."""

    person: _Persons
    vehicle: _Cars
    lane: _Lanes
    edge: _Edges
    trafficlight: _Lights
    route: _Routes
    vehicletype: _Types
    simulation: _Simulation

    def simulationStep(self) -> None: ...


sumo: Final[Sumo] = libsumo


def start(arguments: list[str]) -> None:
    """Start SUMO with the arguments of its command line. Raises EngineError with SUMO's
    messages."""
    output: list[str] = []
    try:
        with _stderr_into(output):
            libsumo.simulation.start(["sumo", *arguments])
    except _ERRORS as error:
        with suppress(*_ERRORS):
            libsumo.simulation.close()
        raise EngineError(" ".join("".join([*output, str(error)]).split())) from error


def close() -> None:
    """Stop SUMO."""
    libsumo.simulation.close()


class sumo_errors:
    """Context that raises SUMO's exceptions as EngineError.

    doing: the action, for the message.
    """

    def __init__(self, doing: str) -> None:
        self._doing = doing

    def __enter__(self) -> None:
        pass

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        at: TracebackType | None,
    ) -> None:
        if isinstance(error, _ERRORS):
            raise EngineError(f"SUMO failed while {self._doing}: {error}") from error


class NearPersons(NamedTuple):
    """N persons, sorted by name.

    xy: positions (N, 2), metres.
    mps: speeds (N,), m/s.
    ahead: next edges of their walks.
    """

    names: tuple[str, ...]
    xy: Floats
    mps: Floats
    ahead: list[str]


class NearVehicles(NamedTuple):
    """N vehicles, sorted by name.

    xy: middles of the front bumpers (N, 2), metres.
    mps: speeds (N,), m/s.
    angle_deg: SUMO's angles (N,), degrees.
    from_xy, away_m: a point, metres, and the distances of the bumpers from it (N,), metres.
    """

    names: tuple[str, ...]
    xy: Floats
    mps: Floats
    angle_deg: Floats
    from_xy: tuple[float, float]
    away_m: Floats


_HALTING_MPS: Final = 0.2
"""Speed from which nothing is standing for SUMO, with a margin, m/s."""


def persons_waiting_s(near: NearPersons) -> list[float]:
    """Return for how long each of these persons has been standing, seconds."""
    return _waiting_s(_native.person_getWaitingTime, near)


def vehicles_waiting_s(near: NearVehicles) -> list[float]:
    """Return for how long each of these vehicles has been standing, seconds."""
    return _waiting_s(_native.vehicle_getWaitingTime, near)


def _waiting_s(query: Callable[[str], float], near: NearPersons | NearVehicles) -> list[float]:
    """Return waiting times, which are 0 for all that move."""
    paces = zip(near.names, near.mps.tolist(), strict=True)
    return [query(name) if mps < _HALTING_MPS else 0.0 for name, mps in paces]


class NearReader:
    """Reads persons and vehicles near a point.

    Names are sorted again only where SUMO's list of them may have changed.

    crowd: names of the persons to read; those of persons that are in SUMO already never change.
    """

    def __init__(self, crowd: Container[str]) -> None:
        self._crowd = crowd
        self._persons: tuple[str, ...] = ()
        self._counted_at = -1, -1.0
        self._listed: Sequence[str] = ()
        self._vehicles: tuple[str, ...] = ()
        self._reach: tuple[int, int, float, float] = (0, 0, 0.0, 0.0)
        self._reach_m = np.zeros(0)

    def near(
        self, x_m: float, y_m: float, persons_m: float, vehicles_m: float
    ) -> tuple[NearPersons, NearVehicles]:
        """Return the persons of the crowd within `persons_m` of a point, and the vehicles within
        `vehicles_m`.

        While they are the same, the names are the same tuple.
        """
        try:
            self._update_names()
            return self._read(x_m, y_m, persons_m, vehicles_m)
        except libsumo.TraCIException:  # a person left, and another was loaded for later
            self._counted_at = -1, -1.0
            self._update_names()
            return self._read(x_m, y_m, persons_m, vehicles_m)

    def _read(
        self, x_m: float, y_m: float, persons_m: float, vehicles_m: float
    ) -> tuple[NearPersons, NearVehicles]:
        persons, vehicles = self._persons, self._vehicles
        k, n = len(persons), len(persons) + len(vehicles)
        places = chain(
            map(_native.person_getPosition, persons), map(_native.vehicle_getPosition, vehicles)
        )
        xy = np.fromiter(chain.from_iterable(places), dtype=float, count=2 * n).reshape(n, 2)
        speeds = chain(
            map(_native.person_getSpeed, persons), map(_native.vehicle_getSpeed, vehicles)
        )
        mps = np.fromiter(speeds, dtype=float, count=n)
        dx, dy = xy[:, 0] - x_m, xy[:, 1] - y_m
        away_m = np.sqrt(dx * dx + dy * dy)
        if (reach := (k, n, persons_m, vehicles_m)) != self._reach:
            self._reach = reach
            self._reach_m = np.repeat([persons_m, vehicles_m], [k, n - k])
        near = away_m <= self._reach_m
        inside = near.tobytes()
        if 0 in inside:
            if 0 in inside[:k]:
                persons = tuple(compress(persons, inside[:k]))
            if 0 in inside[k:]:
                vehicles = tuple(compress(vehicles, inside[k:]))
            k = len(persons)
            xy, mps, away_m = xy[near], mps[near], away_m[near]
        xy.setflags(write=False)
        angles = map(_native.vehicle_getAngle, vehicles)
        angle_deg = np.fromiter(angles, dtype=float, count=len(vehicles))
        return (
            NearPersons(persons, xy[:k], mps[:k], [*map(_native.person_getNextEdge, persons)]),
            NearVehicles(vehicles, xy[k:], mps[k:], angle_deg, (x_m, y_m), away_m[k:]),
        )

    def _update_names(self) -> None:
        """Sort names that may have changed.

        Persons are the same while no step has been missed, none departed in the last one, and their
        number has not changed.
        """
        count, now_s = _native.person_getIDCount(), _native.simulation_getTime()
        counted, at_s = self._counted_at
        missed = now_s - at_s > 1.5 * _native.simulation_getDeltaT() or now_s < at_s
        if missed or count != counted or _native.simulation_getDepartedPersonNumber():
            names = tuple(filter(self._crowd.__contains__, sorted(_native.person_getIDList())))
            if names != self._persons:
                self._persons = names
        self._counted_at = count, now_s
        if (listed := _native.vehicle_getIDList()) != self._listed:
            self._listed = listed
            self._vehicles = tuple(sorted(listed))


def time_crowd_steps(timed: Callable[[str, Callable[[], None]], Callable[[], None]]) -> None:
    """Replace SUMO's step by a timed one for the rest of this process, for benchmarks."""
    libsumo.simulationStep = timed("crowd", libsumo.simulationStep)


@contextmanager
def _stderr_into(output: list[str]) -> Iterator[None]:
    """Append what the process writes to stderr to `output`: libsumo prints details there that
    its exceptions leave out."""
    sys.stderr.flush()
    with tempfile.TemporaryFile() as file:
        original = os.dup(2)
        os.dup2(file.fileno(), 2)
        try:
            yield
        finally:
            os.dup2(original, 2)
            os.close(original)
            file.seek(0)
            output.append(file.read().decode(errors="replace"))
