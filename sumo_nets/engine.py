"""The one door to SUMO: libsumo, typed as far as it is used here. No other file imports it.

One SUMO per process: `start` and `close` are its life, `sumo` its functions meanwhile, in SUMO's
own names and units.
"""

from __future__ import annotations

import importlib.util
import os
import sys
import tempfile
from collections.abc import Callable, Container, Iterator, Sequence
from contextlib import contextmanager, suppress
from itertools import chain, compress
from typing import Any, Final, NamedTuple, Protocol

import numpy as np
import sumo as eclipse_sumo  # noqa: F401  sets where SUMO finds its data

from cosim.core.errors import EngineError
from cosim.core.geometry import Floats
from cosim.core.state import frozen


@contextmanager
def _unexecuted(package: str) -> Iterator[None]:
    """Meanwhile modules of a package are imported without its `__init__`; who imports it afterwards
    gets all of it."""
    found = importlib.util.find_spec(package)
    if package in sys.modules or found is None or found.submodule_search_locations is None:
        yield
        return
    sys.modules[package] = importlib.util.module_from_spec(found)
    try:
        yield
    finally:
        del sys.modules[package]


with _unexecuted("libsumo"):  # which would import traci, sumolib and pyproj, none of them used here
    import libsumo.libsumo as _sumo

libsumo: Any = _sumo
libsumo.simulationStep = libsumo.simulation.step
_told: Final = libsumo._libsumo
"""The same without wrappers in Python, for what is asked hundreds of times a tick."""

_ERRORS: Final = (libsumo.TraCIException, libsumo.FatalTraCIError)


class _Persons(Protocol):
    def getIDList(self) -> Sequence[str]: ...
    def getRoadID(self, name: str, /) -> str: ...
    def getNextEdge(self, name: str, /) -> str: ...
    def getPosition(self, name: str, /) -> tuple[float, float]: ...
    def getLanePosition(self, name: str, /) -> float: ...
    def getSpeed(self, name: str, /) -> float: ...
    def getAngle(self, name: str, /) -> float: ...
    def getWaitingTime(self, name: str, /) -> float: ...
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
    def setSpeed(self, name: str, mps: float, /) -> None: ...
    def remove(self, name: str, /) -> None: ...


class _Cars(Protocol):
    def getIDList(self) -> Sequence[str]: ...
    def getNextTLS(self, name: str, /) -> Sequence[tuple[str, int, float, str]]: ...
    def getWaitingTime(self, name: str, /) -> float: ...
    def add(
        self, name: str, route: str, /, *, typeID: str, departLane: str, departPos: str
    ) -> None: ...
    def remove(self, name: str, /) -> None: ...


class _Lanes(Protocol):
    def getLength(self, lane: str, /) -> float: ...
    def getWidth(self, lane: str, /) -> float: ...
    def getShape(self, lane: str, /) -> Sequence[Sequence[float]]: ...
    def getAllowed(self, lane: str, /) -> Sequence[str]: ...
    def getLinks(
        self, lane: str, /
    ) -> Sequence[tuple[str, bool, bool, bool, str, str, str, float]]: ...


class _Edges(Protocol):
    def getIDList(self) -> Sequence[str]: ...
    def getFromJunction(self, edge: str, /) -> str: ...
    def getToJunction(self, edge: str, /) -> str: ...
    def getLaneNumber(self, edge: str, /) -> int: ...


class _Phase(Protocol):
    duration: float
    state: str


class _Program(Protocol):
    programID: str
    type: int
    phases: Sequence[_Phase]


class _Lights(Protocol):
    def getIDList(self) -> Sequence[str]: ...
    def getControlledLinks(self, light: str, /) -> Sequence[Sequence[tuple[str, str, str]]]: ...
    def getNextSwitch(self, light: str, /) -> float: ...
    def getRedYellowGreenState(self, light: str, /) -> str: ...
    def getPhase(self, light: str, /) -> int: ...
    def getProgram(self, light: str, /) -> str: ...
    def getAllProgramLogics(self, light: str, /) -> Sequence[_Program]: ...


class _Routes(Protocol):
    def add(self, name: str, edges: list[str], /) -> None: ...


class _Types(Protocol):
    def copy(self, kind: str, name: str, /) -> None: ...
    def setLength(self, kind: str, metres: float, /) -> None: ...
    def setWidth(self, kind: str, metres: float, /) -> None: ...
    def setMinGap(self, kind: str, metres: float, /) -> None: ...


class _Simulation(Protocol):
    def getTime(self) -> float: ...


class Sumo(Protocol):
    """SUMO's functions, by what they are about."""

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
    """Start SUMO with the arguments of its command line. Raises EngineError with all that it
    says."""
    said: list[str] = []
    try:
        with _stderr_into(said):
            libsumo.simulation.start(["sumo", *arguments])
    except _ERRORS as error:
        with suppress(*_ERRORS):
            libsumo.simulation.close()
        raise EngineError(" ".join("".join([*said, str(error)]).split())) from error


def close() -> None:
    """Stop SUMO."""
    libsumo.simulation.close()


@contextmanager
def translated(doing: str) -> Iterator[None]:
    """What SUMO raises becomes an EngineError that names what was being done."""
    try:
        yield
    except _ERRORS as error:
        raise EngineError(f"SUMO failed while {doing}: {error}") from error


class NearPersons(NamedTuple):
    """N persons, in the order of their names: xy (N, 2) where, mps (N,) how fast, and the next
    edges of their walks."""

    names: tuple[str, ...]
    xy: Floats
    mps: Floats
    ahead: list[str]


class NearVehicles(NamedTuple):
    """N vehicles, in the order of their names: xy (N, 2) where the middles of their front bumpers
    are, mps (N,) how fast they drive, and their angles (N,)."""

    names: tuple[str, ...]
    xy: Floats
    mps: Floats
    angle_deg: Floats


def persons_near(x_m: float, y_m: float, reach_m: float, crowd: Container[str]) -> NearPersons:
    """Those of a crowd who have set out and are so near to a point."""
    of_crowd = [name for name in sorted(libsumo.person.getIDList()) if name in crowd]
    names, xy = _near(x_m, y_m, reach_m, of_crowd, _told.person_getPosition)
    return NearPersons(
        names, xy, _of_each(_told.person_getSpeed, names), [*map(_told.person_getNextEdge, names)]
    )


def vehicles_near(x_m: float, y_m: float, reach_m: float) -> NearVehicles:
    """The vehicles so near to a point."""
    names, xy = _near(
        x_m, y_m, reach_m, sorted(libsumo.vehicle.getIDList()), _told.vehicle_getPosition
    )
    speeds, angles = (
        _of_each(told, names) for told in (_told.vehicle_getSpeed, _told.vehicle_getAngle)
    )
    return NearVehicles(names, xy, speeds, angles)


def _near(
    x_m: float,
    y_m: float,
    reach_m: float,
    names: Sequence[str],
    place_of: Callable[[str], tuple[float, float]],
) -> tuple[tuple[str, ...], Floats]:
    """Who of these is so near to a point, and where, (N, 2) metres."""
    xy = np.fromiter(chain.from_iterable(map(place_of, names)), dtype=float).reshape(-1, 2)
    gap = xy - (x_m, y_m)
    far_m2 = gap[:, 0] * gap[:, 0] + gap[:, 1] * gap[:, 1]
    near = np.sqrt(far_m2) <= reach_m
    return tuple(compress(names, near.tolist())), frozen(xy[near])


def _of_each(told: Callable[[str], float], names: Sequence[str]) -> Floats:
    return np.fromiter(map(told, names), dtype=float, count=len(names))


def put_crowd_stopwatch(timed: Callable[[str, Callable[[], None]], Callable[[], None]]) -> None:
    """For the bench: replace SUMO's step by a timed one, for the rest of this process."""
    libsumo.simulationStep = timed("crowd", libsumo.simulationStep)


@contextmanager
def _stderr_into(said: list[str]) -> Iterator[None]:
    """Collect what is written to the process's stderr: libsumo prints there what its exceptions
    leave out."""
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
