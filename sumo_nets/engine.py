"""The one door to SUMO: libsumo, typed as far as it is used here. No other file imports it.

One SUMO per process: `start` and `close` are its life, `sumo` its functions meanwhile, in SUMO's own names and units.
"""

from __future__ import annotations

import importlib.util
import os
import sys
import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from typing import Any, Final, NamedTuple, Protocol

import sumo as eclipse_sumo  # noqa: F401  sets where SUMO finds its data

from cosim.core.errors import EngineError


@contextmanager
def _unexecuted(package: str) -> Iterator[None]:
    """Meanwhile modules of a package are imported without its `__init__`; who imports it afterwards gets all of it."""
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

_EYE: Final = "robot"
_NOWHERE_M: Final = -1e8
"""Who has not set out yet is beyond this."""
_ERRORS: Final = (libsumo.TraCIException, libsumo.FatalTraCIError)


class _Persons(Protocol):
    def getIDList(self) -> Sequence[str]: ...
    def getRoadID(self, name: str, /) -> str: ...
    def getNextEdge(self, name: str, /) -> str: ...
    def getLanePosition(self, name: str, /) -> float: ...
    def getSpeed(self, name: str, /) -> float: ...
    def getAngle(self, name: str, /) -> float: ...
    def getWaitingTime(self, name: str, /) -> float: ...
    def add(self, name: str, edge: str, at_m: float, /, *, typeID: str = ...) -> None: ...
    def appendWalkingStage(self, name: str, edges: list[str], until_m: float, /, *, speed: float = ...) -> None: ...
    def moveToXY(
        self, name: str, edge: str, x_m: float, y_m: float, angle_deg: float, mode: int, match_m: float, /
    ) -> None: ...
    def setSpeed(self, name: str, mps: float, /) -> None: ...
    def remove(self, name: str, /) -> None: ...


class _Cars(Protocol):
    def getIDList(self) -> Sequence[str]: ...
    def getNextTLS(self, name: str, /) -> Sequence[tuple[str, int, float, str]]: ...
    def getWaitingTime(self, name: str, /) -> float: ...
    def add(self, name: str, route: str, /, *, typeID: str, departLane: str, departPos: str) -> None: ...
    def remove(self, name: str, /) -> None: ...


class _Lanes(Protocol):
    def getLength(self, lane: str, /) -> float: ...
    def getShape(self, lane: str, /) -> Sequence[Sequence[float]]: ...
    def getAllowed(self, lane: str, /) -> Sequence[str]: ...
    def getLinks(self, lane: str, /) -> Sequence[tuple[str, bool, bool, bool, str, str, str, float]]: ...


class _Edges(Protocol):
    def getIDList(self) -> Sequence[str]: ...
    def getFromJunction(self, edge: str, /) -> str: ...
    def getToJunction(self, edge: str, /) -> str: ...


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
    """Start SUMO with the arguments of its command line. Raises EngineError with all that it says."""
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


class NearPerson(NamedTuple):
    """A person near the eye: where, how fast, and the next edge of its walk."""

    x_m: float
    y_m: float
    mps: float
    ahead: str


class NearVehicle(NamedTuple):
    """A vehicle near the eye: where its front bumper's middle is, how fast it drives, and its angle."""

    x_m: float
    y_m: float
    mps: float
    angle_deg: float


def open_eye(x_m: float, y_m: float, persons_m: float, vehicles_m: float) -> None:
    """From now on the persons and vehicles so near to a point are told, by one subscription each."""
    libsumo.poi.add(_EYE, x_m, y_m, (0, 0, 0, 0))
    for domain, reach_m, variable in (
        (libsumo.CMD_GET_PERSON_VARIABLE, persons_m, libsumo.VAR_NEXT_EDGE),
        (libsumo.CMD_GET_VEHICLE_VARIABLE, vehicles_m, libsumo.VAR_ANGLE),
    ):
        libsumo.poi.subscribeContext(_EYE, domain, reach_m, [libsumo.VAR_POSITION, libsumo.VAR_SPEED, variable])


def move_eye(x_m: float, y_m: float) -> None:
    """The point is there now."""
    libsumo.poi.setPosition(_EYE, x_m, y_m)


def near_eye() -> tuple[dict[str, NearPerson], dict[str, NearVehicle]]:
    """Who has set out and is near the point, by name, in the order of the names."""
    persons, vehicles = {}, {}
    for name, row in sorted(libsumo.poi.getContextSubscriptionResults(_EYE).items()):
        x_m, y_m = row[libsumo.VAR_POSITION]
        if x_m <= _NOWHERE_M:
            continue
        if libsumo.VAR_ANGLE in row:
            vehicles[name] = NearVehicle(x_m, y_m, row[libsumo.VAR_SPEED], row[libsumo.VAR_ANGLE])
        else:
            persons[name] = NearPerson(x_m, y_m, row[libsumo.VAR_SPEED], row[libsumo.VAR_NEXT_EDGE])
    return persons, vehicles


def put_crowd_stopwatch(timed: Callable[[str, Callable[[], None]], Callable[[], None]]) -> None:
    """For the bench: replace SUMO's step by a timed one, for the rest of this process."""
    libsumo.simulationStep = timed("crowd", libsumo.simulationStep)


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
