"""What `cosim bench` measures: speed and memory of one environment process, part by part.

Every figure is taken in a process of its own, several rounds in turn; medians are shown. Beside the time of a part
stands the share that its engine spends inside its own step or picture: what is left is ours, and the engine's share
is the limit. Shares and ratios hold when the machine is slow; times do not.
"""

from __future__ import annotations

import multiprocessing
import resource
import signal
import statistics
import tempfile
import time
from collections import defaultdict
from collections.abc import Callable, Sequence
from itertools import pairwise
from multiprocessing.connection import Connection
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, cast

import msgspec

from cosim.core.errors import EngineError
from cosim.episode.ports import Camera, CameraSpec, Crowd, Director, Manifest, World
from cosim.policies.route import Route
from cosim.spec.scenario import City, CrowdSpec, Scenario

if TYPE_CHECKING:
    from scenarios.execution.scorer import Scorer
    from scenarios.execution.wiring import StagedScenario

MEASURED_S = 60.0
_WARM_UP_S = 5.0
ASKED = 500
"""Questions about a place whose mean time is taken."""
TIMED_PARTS = ("crowd", "physics", "camera", "policy", "bridge", "referee", "loop")


class FourHertz(Route):
    """The route policy at the rate and with the camera of the figures."""

    manifest = Manifest("route-4hz", rate_hz=4.0, camera=CameraSpec(96, 96), privileged=True)


class Spent(defaultdict[str, float]):
    """Seconds spent in each part."""

    def timed(self, part: str, work: Callable[..., Any]) -> Callable[..., Any]:
        """`work`, with its time added to `part`."""

        def run(*args: Any, **named: Any) -> Any:
            began = time.perf_counter()
            try:
                return work(*args, **named)
            finally:
                self[part] += time.perf_counter() - began

        return run


class _Timed:
    """An engine behind its port, with a stopwatch on one method."""

    def __init__(self, engine: object, method: str, part: str, spent: Spent) -> None:
        self._engine = engine
        self._methods = {method: spent.timed(part, getattr(engine, method))}

    def __getattr__(self, name: str) -> Any:
        return self._methods.get(name) or getattr(self._engine, name)


class Drive(NamedTuple):
    """One drive. ms: wall milliseconds per simulated second of each part; engine_ms: of them, inside the engine."""

    ms: dict[str, float]
    engine_ms: dict[str, float]
    factor: float
    memory_mib: float
    people: int
    round_trip_ms: float


def scenario_in(size_m: float) -> Scenario:
    """A long-horizon scenario with 50 persons and 20 vehicles in a city of a size."""
    from cosim.place.walk_graph import WalkGraph
    from scenarios.builders.long_horizon import build_long_horizon
    from scenarios.execution.places import place

    city = City(seed=5, size_m=size_m)
    _, street_map = place(city)
    whole = build_long_horizon(city, street_map, WalkGraph(street_map), 7, "bench")
    return msgspec.structs.replace(whole, crowd=CrowdSpec(persons=50, radius_m=80.0, vehicles=20))


def _drive(size_m: float) -> Drive:
    """Drive for MEASURED_S simulated seconds in a city of a size."""
    import physics.world.profiling
    import sumo_nets.engine
    from cosim.episode.loop import Parts
    from scenarios.execution.episode import Episode

    scenario, spent, engine = scenario_in(size_m), Spent(float), Spent(float)
    physics.world.profiling.put_physics_stopwatch(engine.timed)
    sumo_nets.engine.put_crowd_stopwatch(engine.timed)
    policy = FourHertz()

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
        policy.reset(scenario.id, scenario.seed)
        observation = episode.reset()
        warm, last = episode.clock.ticks(_WARM_UP_S), episode.clock.ticks(_WARM_UP_S + MEASURED_S)
        while episode.moment.tick < warm:
            observation = episode.advance(act(observation))
        spent.clear()
        engine.clear()
        began = time.perf_counter()
        while episode.moment.tick < last:
            observation = episode.advance(act(observation))
        whole = time.perf_counter() - began
        people = len(episode.moment.street.people)
    spent["loop"] = whole - sum(spent.values())
    scale = 1000.0 / MEASURED_S
    return Drive(
        ms={part: seconds * scale for part, seconds in spent.items()},
        engine_ms={part: seconds * scale for part, seconds in engine.items()},
        factor=MEASURED_S / whole,
        memory_mib=resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
        people=people,
        round_trip_ms=1000.0 * spent["bridge"] / (last - warm),
    )


def first_frame(size_m: float) -> float:
    """Seconds from a new process to the first camera frame of a cached city, imports included."""
    began = time.perf_counter()
    from scenarios.execution.episode import Episode

    with Episode(scenario_in(size_m), FourHertz.manifest) as episode:
        episode.reset()
        return time.perf_counter() - began


class Places(NamedTuple):
    """How fast places are. made_s: a city from its seed, read_s: from the cache, both to a StreetMap; contains_us,
    distance_us: a point against the walkable area of the whole city; walk_ms: a shortest walk."""

    made_s: float
    read_s: float
    contains_us: float
    distance_us: float
    walk_ms: float


def places(size_m: float) -> Places:
    """Make a city of a size from its seed, read it again, ask it."""
    import numpy as np

    from cosim.place.street_map import WalkableArea
    from cosim.place.walk_graph import WalkGraph
    from sumo_nets.city.store import build_city, city_net
    from sumo_nets.net.netfile import read_net
    from sumo_nets.net.snapshot import street_map_of

    city = City(seed=5, size_m=size_m)
    with tempfile.TemporaryDirectory() as folder:
        began = time.perf_counter()
        path = Path(folder) / "city.net.xml"
        build_city(city, path)
        read_net(path)
        made_s = time.perf_counter() - began
    street_map_of(city_net(city))
    began = time.perf_counter()
    street_map = street_map_of(city_net(city))
    read_s = time.perf_counter() - began
    graph, area = WalkGraph(street_map), WalkableArea(street_map.walkable)
    rng = np.random.default_rng(1)
    ends = rng.integers(len(graph.ports), size=(ASKED, 2)).tolist()
    points = graph.xy[rng.integers(len(graph.xy), size=ASKED)] + rng.normal(0.0, 2.0, (ASKED, 2))
    graph.shortest(graph.ports[0], graph.ports[-1])
    # The first questions build GEOS's indices; a referee asks on and on about one neighbourhood.
    for x, y in points.tolist():
        area.contains(x, y)
    stamps = [time.perf_counter()]
    for x, y in points.tolist():
        area.contains(x, y)
    stamps.append(time.perf_counter())
    area.signed_distance(points)
    stamps.append(time.perf_counter())
    for a, b in ends:
        graph.shortest(graph.ports[a], graph.ports[b])
    stamps.append(time.perf_counter())
    each = [(b - a) / ASKED for a, b in pairwise(stamps)]
    return Places(made_s, read_s, 1e6 * each[0], 1e6 * each[1], 1e3 * each[2])


class Report(NamedTuple):
    """Every figure, one value per round. small: the same drive in a city of a sixteenth of the area."""

    big: list[Drive]
    small: list[Drive]
    first_frame_s: list[float]
    places: list[Places]

    def growth(self) -> list[float]:
        """Cost of a simulated second in the 2 km city over that in the 0.5 km city, round by round."""
        return [small.factor / big.factor for big, small in zip(self.big, self.small, strict=True)]


def time_episodes(rounds: int, tell: Callable[[str], None]) -> Report:
    """Take every figure `rounds` times, each in a fresh process."""
    report = Report([], [], [], [])
    for i in range(rounds):
        tell(f"round {i + 1} of {rounds}")
        report.big.append(alone(_drive, 2000.0))
        report.small.append(alone(_drive, 500.0))
        report.first_frame_s.append(alone(first_frame, 2000.0))
        report.places.append(alone(places, 2000.0))
    return report


def alone(work: Callable[[Any], Any], size: float) -> Any:
    """Run `work(size)` in a fresh process. Raises what it raises there, EngineError when its process dies."""
    context = multiprocessing.get_context("spawn")
    mine, theirs = context.Pipe(duplex=False)
    process = context.Process(target=_into, args=(theirs, work, size), daemon=True)
    process.start()
    theirs.close()
    try:
        found = mine.recv()
    except EOFError:
        process.join()
        code = process.exitcode or 0
        how = f"was killed by {signal.Signals(-code).name}" if code < 0 else f"ended with exit code {code}"
        raise EngineError(f"the process that draws or measures it {how}") from None
    finally:
        process.kill()
        process.join()
    if isinstance(found, Exception):
        raise found
    return found


def _into(pipe: Connection, work: Callable[[Any], Any], size: float) -> None:
    """Send what `work(size)` gives or raises."""
    try:
        found = work(size)
    except Exception as error:  # noqa: BLE001  it is raised again where the work was given out
        found = error
    pipe.send(found)


def spread(values: Sequence[float]) -> tuple[str, str]:
    """(median, "low to high") of a figure, for a table."""
    digits = 0 if statistics.median(values) >= 100 else 2
    return f"{statistics.median(values):.{digits}f}", f"{min(values):.{digits}f} to {max(values):.{digits}f}"
