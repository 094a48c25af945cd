"""How fast one environment process drives, part by part, and how much memory it takes."""

from __future__ import annotations

import statistics
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, NamedTuple, cast

import msgspec

from cosim.episode.interfaces import Camera, Crowd, Director, World
from cosim.policies.privileged.route import Route
from cosim.spec.camera import CameraSpec
from cosim.spec.manifest import Manifest
from cosim.spec.scenario import City, CrowdSpec, Scenario
from scenarios.tools.bench.figures import MORE, Figure, Spent

if TYPE_CHECKING:
    from scenarios.episodes.scorer import Scorer
    from scenarios.episodes.wiring import StagedScenario

_MEASURED_S: Final = 60.0
_WARM_UP_S: Final = 5.0
_QUERIES: Final = 300
_BETWEEN: Final = 4_000_000
"""So many numbers are more than the processor's caches hold."""
_PATIENCE_S: Final = 60.0
_ENGINES: Final = {"crowd": "SUMO's own step", "physics": "PyBullet's own step"}
_PARTS: Final = ("crowd", "physics", "camera", "policy", "bridge", "referee", "loop")


class FourHertz(Route):
    """The route policy at the rate and with the camera of the figures."""

    manifest = Manifest("route-4hz", rate_hz=4.0, camera=CameraSpec(96, 96), privileged=True)


class _FiveHertz(Route):
    """The same with the picture that the paper's models see."""

    manifest = Manifest("route-5hz", rate_hz=5.0, camera=CameraSpec(512, 288), privileged=True)


class _Timed:
    """An engine behind its port, with a stopwatch on one method."""

    def __init__(self, engine: object, method: str, part: str, spent: Spent) -> None:
        self._engine = engine
        self._methods = {method: spent.timed(part, getattr(engine, method))}

    def __getattr__(self, name: str) -> Any:
        return self._methods.get(name) or getattr(self._engine, name)


class _Drive(NamedTuple):
    """One drive. ms: wall milliseconds per simulated second of each part; engine_ms: of them,
    inside the engine; ticks: in a simulated second."""

    ms: dict[str, float]
    engine_ms: dict[str, float]
    factor: float
    memory_mib: float
    ticks: float


def scenario_in(size_m: float) -> Scenario:
    """A long-horizon scenario with 50 persons and 20 vehicles in a city of a size."""
    from cosim.place.walk_graph import WalkGraph
    from scenarios.places.nets import place
    from scenarios.suites.long_horizon import build_long_horizon

    city = City(seed=5, size_m=size_m)
    _, street_map = place(city)
    whole = build_long_horizon(city, street_map, WalkGraph(street_map), 7, "bench")
    return msgspec.structs.replace(whole, crowd=CrowdSpec(persons=50, radius_m=80.0, vehicles=20))


def driving() -> list[Figure]:
    """A 2 km city with a small picture: the speed, each part, the director, the memory."""
    drive = _drive(2000.0, FourHertz())
    found = [
        _factor("long-horizon, 96x96 at 4 Hz, simulated s per s", drive, 10.0),
        Figure("memory of a further process, MiB", drive.memory_mib, reach=400.0),
        Figure(
            "director, ms a tick",
            drive.ms["bridge"] / drive.ticks,
            _bare_query_ms(),
            "an empty question, now and then",
            0.2,
        ),
    ]
    for part in _PARTS:
        inside = drive.engine_ms.get(part) if part in _ENGINES else None
        whole = f"{part}, ms per simulated s"
        reach = 1.2 if part == "physics" else None
        found.append(
            Figure(whole, drive.ms[part], inside, _ENGINES.get(part, ""), reach, reach_ratio=True)
        )
    return found


def own_memory_mib() -> float:
    """What this process has written: a further one takes as much. Pages of files are shared, baked
    ones too."""
    rows = (row.split() for row in Path("/proc/self/smaps_rollup").read_text().splitlines())
    return sum(int(words[1]) for words in rows if words[0] == "Private_Dirty:") / 1024.0


def driving_large_pictures() -> list[Figure]:
    """The same with large pictures."""
    return [
        _factor(
            "long-horizon, 512x288 at 5 Hz, simulated s per s", _drive(2000.0, _FiveHertz()), 6.0
        )
    ]


def driving_in_towns() -> list[Figure]:
    """A simulated second in a 2 km city beside one in a city of a sixteenth of its area."""
    big, small = _drive(2000.0, FourHertz()), _drive(500.0, FourHertz())
    name = "a simulated second, ms: 2 km city, limit 0.5 km city"
    return [
        Figure(
            name,
            1000.0 / big.factor,
            1000.0 / small.factor,
            "the small city",
            1.1,
            reach_ratio=True,
        )
    ]


def _factor(name: str, drive: _Drive, reach: float) -> Figure:
    engines_ms = sum(drive.engine_ms[part] for part in _ENGINES)
    return Figure(
        name,
        drive.factor,
        1000.0 / engines_ms,
        "SUMO's and PyBullet's own steps alone",
        reach,
        MORE,
    )


def _bare_query_ms() -> float:
    """A question that nothing is done for, asked now and then as in an episode: what Zenoh needs is
    in no cache."""
    import numpy as np

    from bridge.session import LoneSession

    between = np.ones(_BETWEEN)
    found = []
    with LoneSession() as session:
        session.serve("bench", bytes)
        for _ in range(_QUERIES):
            between += 1.0
            began = time.perf_counter()
            session.ask("bench", b"", timeout_s=_PATIENCE_S)
            found.append(time.perf_counter() - began)
    return 1000.0 * statistics.median(found)


def _drive(size_m: float, policy: Route) -> _Drive:
    """Drive for MEASURED_S simulated seconds in a city of a size."""
    import physics.dynamics.profiling
    import sumo_nets.engine
    from cosim.episode.loop import Parts
    from scenarios.episodes.episode import Episode

    scenario, spent, engine = scenario_in(size_m), Spent(float), Spent(float)
    physics.dynamics.profiling.put_physics_stopwatch(engine.timed)
    sumo_nets.engine.put_crowd_stopwatch(engine.timed)

    def timed(stage: StagedScenario) -> None:
        parts = stage.parts
        stage.parts = Parts(
            cast(World, _Timed(parts.world, "step", "physics", spent)),
            cast(Crowd, _Timed(parts.crowd, "step", "crowd", spent)),
            cast(Director, _Timed(parts.director, "react", "bridge", spent)),
            cast(Camera, _Timed(parts.camera, "render", "camera", spent)),
        )
        stage.scorer = cast("Scorer", _Timed(stage.scorer, "score", "referee", spent))

    with Episode(scenario, policy.manifest, through=timed) as episode:
        act = spent.timed("policy", policy.act)
        policy.reset(episode.id, episode.seed)
        observation = episode.reset()
        warm = episode.clock.ticks(_WARM_UP_S)
        last = episode.clock.ticks(_WARM_UP_S + _MEASURED_S)
        while episode.moment.tick < warm:
            observation = episode.advance(act(observation))
        spent.clear()
        engine.clear()
        began = time.perf_counter()
        while episode.moment.tick < last:
            observation = episode.advance(act(observation))
        whole = time.perf_counter() - began
    spent["loop"] = whole - sum(spent.values())
    scale = 1000.0 / _MEASURED_S
    return _Drive(
        ms={part: seconds * scale for part, seconds in spent.items()},
        engine_ms={part: seconds * scale for part, seconds in engine.items()},
        factor=_MEASURED_S / whole,
        memory_mib=own_memory_mib(),
        ticks=(last - warm) / _MEASURED_S,
    )
