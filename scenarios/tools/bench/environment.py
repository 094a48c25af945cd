"""Measures environment processes: speed part by part, memory, start, places, and many environments
together.

Engines are imported in functions: a fresh process is measured from its start.
"""

from __future__ import annotations

import math
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from contextlib import ExitStack, suppress
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Final, NamedTuple, cast

import msgspec
import numpy as np

from cosim.core.clock import Clock
from cosim.core.errors import EngineError
from cosim.core.geometry import Pose
from cosim.core.state import Command, PersonKind, RobotState
from cosim.episode.interfaces import Camera, Crowd, Director, Observation, World
from cosim.policies.baselines import Straight
from cosim.policies.privileged.route import Route
from cosim.spec.camera import CameraSpec
from cosim.spec.events import Actor, EventReply
from cosim.spec.manifest import Manifest
from cosim.spec.options import EpisodeOptions
from cosim.spec.robot import ROBOTS, Legs
from cosim.spec.scenario import City, CrowdSpec, Scenario, Suite
from scenarios.tools.bench.figures import MORE, Figure, PartTimes, TimedEngine, taken

if TYPE_CHECKING:
    from scenarios.episodes.scorer import Scorer
    from scenarios.episodes.wiring import StagedScenario

_WARM_UP_S: Final = 5.0
_MEASURED_S: Final = 60.0
"""Simulated seconds of a drive."""
_QUERIES: Final = 300
_BETWEEN: Final = 4_000_000
"""Numbers that are changed between two queries: more than the processor's caches hold."""
_PATIENCE_S: Final = 60.0
_ENGINES: Final = {"crowd": "SUMO's own step", "physics": "PyBullet's own step"}
_PARTS: Final = ("crowd", "physics", "camera", "policy", "bridge", "referee", "loop")
_VEHICLES: Final = 20
_MEASURED_TICKS: Final = 1200
_WARM_UP_TICKS: Final = 100
_PACE_MPS: Final = 1.0
_AHEAD_M: Final = 6.0
"""The event pedestrians walk abreast this far before the robot."""
_CAST: Final = 4
_ABREAST_M: Final = 0.7
_SCENARIOS: Final = 20
_ROUNDS: Final = 10
_EPISODES: Final = 32
_JOBS: Final = 2
_COMPARED: Final = 48
_WARM: Final = 4
"""Compared episodes that end before the clock runs: engines are loaded and places read in them."""
_TOGETHER: Final = 10
"""Environments that share a renderer."""
_TOGETHER_S: Final = 30.0
"""Simulated seconds of each of these that are measured, on average."""
_QUESTIONS: Final = 500
"""Queries of a place whose mean time is measured."""


class FourHertz(Route):
    """The route policy at the rate and with the camera of the figures."""

    manifest = Manifest("route-4hz", rate_hz=4.0, camera=CameraSpec(96, 96), privileged=True)


class _FiveHertz(Route):
    """The same with the picture that the paper's models see."""

    manifest = Manifest("route-5hz", rate_hz=5.0, camera=CameraSpec(512, 288), privileged=True)


class StraightWithPictures(Straight):
    """The policy `straight` with the default camera, so that its runs draw pictures."""

    manifest = Manifest("straight-with-pictures")


_WITH_PICTURES: Final = f"{__name__}:{StraightWithPictures.__name__}"


class _Drive(NamedTuple):
    """One drive.

    ms: wall milliseconds of each part per simulated second.
    engine_ms: the share of these inside the engine.
    ticks: ticks in a simulated second.
    """

    ms: dict[str, float]
    engine_ms: dict[str, float]
    factor: float
    memory_mib: float
    ticks: float


def scenario_in(size_m: float) -> Scenario:
    """Build a long-horizon scenario with 50 persons and 20 vehicles in a city of a size."""
    from cosim.place.walk_graph import WalkGraph
    from scenarios.places.nets import place
    from scenarios.suites.long_horizon import build_long_horizon

    city = City(seed=5, size_m=size_m)
    _, street_map = place(city)
    whole = build_long_horizon(city, street_map, WalkGraph(street_map), 7, "bench")
    return msgspec.structs.replace(whole, crowd=CrowdSpec(persons=50, radius_m=80.0, vehicles=20))


def driving() -> list[Figure]:
    """Measure a drive in a 2 km city with a small picture: speed, each part, director, memory."""
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
    """Return the memory that this process wrote, MiB: a further process needs as much.

    Pages of files are shared.
    """
    rows = (row.split() for row in Path("/proc/self/smaps_rollup").read_text().splitlines())
    return sum(int(words[1]) for words in rows if words[0] == "Private_Dirty:") / 1024.0


def driving_large_pictures() -> list[Figure]:
    """Measure the same drive with large pictures."""
    return [
        _factor(
            "long-horizon, 512x288 at 5 Hz, simulated s per s", _drive(2000.0, _FiveHertz()), 6.0
        )
    ]


def driving_in_towns() -> list[Figure]:
    """Compare a simulated second in a 2 km city with one in a city of a sixteenth of its area."""
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


def driving_on_legs() -> list[Figure]:
    """Compare the physics of each robot with legs with the courier's, in a city of 0.5 km."""
    courier_ms = _drive(500.0, FourHertz()).ms["physics"]
    return [
        Figure(
            f"physics of {robot.name}, ms per simulated s",
            _drive(500.0, FourHertz(), robot.name).ms["physics"],
            courier_ms,
            "the courier's",
            1.3,
            reach_ratio=True,
        )
        for robot in ROBOTS.values()
        if isinstance(robot.drive, Legs)
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
    """Time an empty query at intervals as in an episode, so that Zenoh's data is in no cache."""
    from bridge.session import LocalSession

    between = np.ones(_BETWEEN)
    found = []
    with LocalSession() as session:
        session.serve("bench", bytes)
        for _ in range(_QUERIES):
            between += 1.0
            began = time.perf_counter()
            session.query("bench", b"", timeout_s=_PATIENCE_S)
            found.append(time.perf_counter() - began)
    return 1000.0 * statistics.median(found)


def _drive(size_m: float, policy: Route, robot: str = "") -> _Drive:
    """Drive for _MEASURED_S simulated seconds in a city of a size.

    robot: by default the courier
    """
    import physics.dynamics.bullet
    import sumo_nets.engine
    from cosim.episode.loop import EpisodeEngines
    from scenarios.episodes.episode import Episode

    scenario = scenario_in(size_m).driven_by(robot)
    spent = PartTimes()
    engine = PartTimes()
    physics.dynamics.bullet.time_physics_calls(engine.timed)
    sumo_nets.engine.time_crowd_steps(engine.timed)

    def timed(stage: StagedScenario) -> None:
        engines = stage.engines
        stage.engines = EpisodeEngines(
            cast(World, TimedEngine(engines.world, "step", "physics", spent)),
            cast(Crowd, TimedEngine(engines.crowd, "step", "crowd", spent)),
            cast(Director, TimedEngine(engines.director, "react", "bridge", spent)),
            cast(Camera, TimedEngine(engines.camera, "render", "camera", spent)),
        )
        stage.scorer = cast("Scorer", TimedEngine(stage.scorer, "score", "referee", spent))

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


def walking(persons: int) -> list[Figure]:
    """Time the street's step for a simulated minute of a route among `persons`."""
    import sumo_nets.engine
    from scenarios.episodes.wiring import crowd_of

    inside = PartTimes()
    scenario = msgspec.structs.replace(
        scenario_in(2000.0), crowd=CrowdSpec(persons=persons, vehicles=_VEHICLES)
    )
    line = scenario.route_line
    sumo_nets.engine.time_crowd_steps(inside.timed)
    spent_s = 0.0
    with crowd_of(scenario) as crowd:
        for tick in range(_WARM_UP_TICKS + _MEASURED_TICKS):
            if tick == _WARM_UP_TICKS:
                inside.clear()
                spent_s = 0.0
            way_m = _PACE_MPS * Clock().tick_s * tick
            reply = EventReply(
                episode="", tick=tick, states=(), actors=_cast(line.at(way_m + _AHEAD_M))
            )
            began = time.perf_counter()
            crowd.step(RobotState(line.at(way_m), _PACE_MPS), reply)
            spent_s += time.perf_counter() - began
    ms, engine_ms = (1000.0 * seconds / _MEASURED_TICKS for seconds in (spent_s, inside["crowd"]))
    return [
        Figure(
            f"step of the street, {persons} persons, ms",
            ms,
            engine_ms,
            "SUMO's own step",
            2.0,
            reach_ratio=True,
        )
    ]


def _cast(middle: Pose) -> tuple[Actor, ...]:
    """Return _CAST people walking abreast."""
    x_m, y_m, heading_rad = middle
    return tuple(
        Actor(
            id=f"e{k}",
            x_m=x_m - left_m * math.sin(heading_rad),
            y_m=y_m + left_m * math.cos(heading_rad),
            heading_rad=heading_rad,
            speed_mps=_PACE_MPS,
            doing="walk",
            kind=PersonKind.EVENT,
        )
        for k, left_m in enumerate(_ABREAST_M * (n - (_CAST - 1) / 2) for n in range(_CAST))
    )


def starting(began_s: float) -> list[Figure]:
    """Time the first frame of three scenarios in turn.

    The first is in this process, which was started at `began_s` of the monotonic clock, the second
    in the same city, the third in another one. Their cities are in the cache.
    """
    from scenarios.suites.catalog import load_suite

    first, same, other = (load_suite("reactive").scenarios[i] for i in (0, 1, 8))
    fresh_s = _first_frame_s(first, began_s)
    same_s, other_s = (_first_frame_s(scenario, time.monotonic()) for scenario in (same, other))
    (engines,) = taken("engines")
    return [
        Figure(
            "first frame, fresh process, cached city, s", fresh_s, engines.value, engines.name, 1.5
        ),
        Figure("first frame, next episode, same city, s", same_s, reach=0.3),
        Figure("first frame, next episode, other cached city, s", other_s, reach=0.8),
    ]


def engines_starting(began_s: float) -> list[Figure]:
    """Time SUMO, PyBullet and OpenGL alone, in a process started at `began_s`.

    SUMO opens the net of the first scenario of `starting`.
    """
    from physics.cameras.gl.context import context
    from physics.dynamics.bullet import p
    from sumo_nets import engine
    from sumo_nets.city.store import city_net

    engine.start(
        [
            "--net-file",
            str(city_net(City(seed=1))),
            "--no-step-log",
            "true",
            "--no-warnings",
            "true",
        ]
    )
    engine.sumo.simulationStep()
    p.connect(p.DIRECT)
    with context():
        return [Figure("the engines alone, fresh process, s", time.monotonic() - began_s)]


def first_episode(began_s: float) -> list[Figure]:
    """Compare the first episode of a local run with that of a run in one process.

    Each is run by a process started for it.
    """
    late_s = _first_over_s(began_s, local=True) - taken("first episode alone")[0].value
    return [Figure("first episode of a local run, later than in one process, s", late_s, reach=1.0)]


def first_episode_alone(began_s: float) -> list[Figure]:
    """Time the first episode of a run in this process alone, which was started at `began_s`."""
    return [Figure("first episode in one process, s", _first_over_s(began_s, local=False))]


def _first_over_s(began_s: float, *, local: bool) -> float:
    """Run one short episode.

    local: in an environment process, as `cosim run` does; else in this process
    """
    from scenarios.runs.run import run
    from scenarios.suites.catalog import load_suite

    one = msgspec.structs.replace(load_suite("reactive").scenarios[0], time_limit_s=1.0, events=())
    suite = Suite(name="first", version="1", scenarios=(one,))
    run(
        suite,
        _WITH_PICTURES if local else StraightWithPictures(),
        options=EpisodeOptions(seed=1),
    )
    return time.monotonic() - began_s


def _first_frame_s(scenario: Scenario, began_s: float) -> float:
    from scenarios.episodes.episode import Episode

    with Episode(scenario, FourHertz.manifest) as episode:
        episode.reset()
        return time.monotonic() - began_s


def growing() -> list[Figure]:
    """Measure whether memory grows: a second of each of 20 scenarios, ten times in this process."""
    from scenarios.suites.catalog import load_suite

    after = []
    for _ in range(_ROUNDS):
        for scenario in load_suite("reactive").scenarios[:_SCENARIOS]:
            _begin(scenario)
        after.append(own_memory_mib())
    first = after[0]
    last = after[-1]
    name = f"memory of its own after {_SCENARIOS * _ROUNDS} episodes, MiB"
    return [Figure(name, last, first, f"after {_SCENARIOS}", 1.05, reach_ratio=True)]


def _begin(scenario: Scenario) -> None:
    from scenarios.episodes.episode import Episode

    policy = FourHertz()
    with Episode(scenario, policy.manifest) as episode:
        observation = episode.reset()
        while not episode.over and episode.time_s < 1.0:
            observation = episode.advance(policy.act(observation))


def reactive() -> list[Figure]:
    """Measure a run of the first reactive scenarios, four of each event, with pictures."""
    with tempfile.TemporaryDirectory() as folder:
        words = [
            "run",
            "reactive",
            "--policy",
            _WITH_PICTURES,
            "--episodes",
            str(_EPISODES),
            "--jobs",
            str(_JOBS),
        ]
        began = time.monotonic()
        done = subprocess.run(
            [sys.executable, "-m", "cosim", *words, "--out", f"{folder}/run"],
            env=os.environ,
            capture_output=True,
            text=True,
            check=False,
        )
        hours = (time.monotonic() - began) / 3600.0
    if done.returncode:
        raise EngineError(
            f"`cosim {' '.join(words)}` ended with exit code {done.returncode}: "
            f"{done.stderr[-300:]}"
        )
    name = f"reactive, {_JOBS} processes, episodes per hour"
    return [Figure(name, _EPISODES / hours, reach=1500.0, better=MORE)]


def two_processes() -> list[Figure]:
    """Compare short episodes per second of two local processes with those of one, after warm-up."""
    one, two = _episodes_per_s(1), _episodes_per_s(2)
    name = "reactive, two processes, episodes per s"
    return [Figure(name, two, one, "one process", 1.85, MORE, reach_ratio=True)]


def _episodes_per_s(jobs: int) -> float:
    from scenarios.ipc.messages import Done
    from scenarios.runs.run import run

    ends_s: list[float] = []

    def handle(message: object) -> None:
        if isinstance(message, Done):
            ends_s.append(time.monotonic())

    run(
        "reactive",
        _WITH_PICTURES,
        episodes=_COMPARED,
        jobs=jobs,
        options=EpisodeOptions(seed=1),
        tell=handle,
    )
    return (_COMPARED - _WARM) / (ends_s[-1] - ends_s[_WARM - 1])


class StraightTogether(Straight):
    """Policy that drives all episodes straight, slower where it is dark.

    It stacks all pictures as a model would.
    """

    manifest = Manifest("straight-together", rate_hz=4.0, camera=CameraSpec(96, 96))

    def act_batch(self, observations: Sequence[Observation]) -> list[Command]:
        pictures = np.stack([one.rgb for one in observations if one.rgb is not None])
        paces = np.clip(pictures.mean(axis=(1, 2, 3)) / 64.0, 0.5, 1.0).tolist()
        return [
            Command(pace * one.robot.cruise_mps, 0.0)
            for one, pace in zip(observations, paces, strict=True)
        ]


def driving_together() -> list[Figure]:
    """Measure simulated seconds per second of environments with one renderer and one policy."""
    from cosim.policies.load import load_policy
    from cosim.results.run_folder import RunFolder
    from scenarios.ipc.messages import Hello
    from scenarios.runs.local import LocalProcesses
    from scenarios.runs.planning import run_spec
    from scenarios.runs.pool import run_all
    from scenarios.runs.shared_renderer import SharedRenderer
    from scenarios.suites.catalog import load_suite

    shipped = load_suite("long-horizon").scenarios
    picked = [
        msgspec.structs.replace(shipped[i % len(shipped)], id=f"together-{i}", seed=i)
        for i in range(_TOGETHER)
    ]
    suite = Suite(name="together", version="1", scenarios=tuple(picked))
    name = f"{__name__}:{StraightTogether.__name__}"
    caller = load_policy(name)
    options = EpisodeOptions(camera="gl")
    hello = Hello(name, caller.manifest, caller.source_hash)
    watch = _RateMeter()
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory())) / "run"
        spec = run_spec(suite, picked, name, caller, options, True)
        held = stack.enter_context(RunFolder.create(folder, spec, suite))
        logs = held.path / "logs"
        renderer = stack.enter_context(SharedRenderer(logs, hello, asks=True))
        with suppress(_RateMeasured):
            processes = LocalProcesses(logs, _TOGETHER)
            run_all(
                held,
                picked,
                hello,
                processes,
                handle=watch.handle,
                options=options,
                renderer=renderer,
            )
    what = f"{_TOGETHER} environments, shared renderer and batched policy, simulated s per s in all"
    return [Figure(what, watch.rate(), reach=60.0, better=MORE)]


class _RateMeasured(Exception):
    """Raised when the time to measure is over."""


class _RateMeter:
    """Handler of every environment's progress that measures simulated seconds per second."""

    def __init__(self) -> None:
        self._at_s: dict[str, float] = {}
        self._began: tuple[float, float] | None = None
        self._ended: tuple[float, float] | None = None

    def handle(self, message: object) -> None:
        """Count a message. Raises _RateMeasured at the end of the time to measure."""
        from scenarios.ipc.messages import EpisodeProgress

        if not isinstance(message, EpisodeProgress):
            return
        self._at_s[message.scenario] = message.time_s
        so_far = time.perf_counter(), sum(self._at_s.values())
        if self._began is None:
            if len(self._at_s) == _TOGETHER and min(self._at_s.values()) >= _WARM_UP_S:
                self._began = so_far
        elif so_far[1] - self._began[1] >= _TOGETHER_S * _TOGETHER:
            self._ended = so_far
            raise _RateMeasured

    def rate(self) -> float:
        """Return simulated seconds per second. Raises EngineError when environments ended early."""
        if self._began is None or self._ended is None:
            raise EngineError(
                "the environments ended before their speed could be taken: they crashed"
            )
        return (self._ended[1] - self._began[1]) / (self._ended[0] - self._began[0])


def places() -> list[Figure]:
    """Time a 2 km city: generation, reading from the cache, queries of points and of walks."""
    from cosim.place.street_map import WalkableArea
    from cosim.place.walk_graph import WalkGraph
    from sumo_nets.city.store import build_city, city_net
    from sumo_nets.net.net_file import read_net
    from sumo_nets.net.snapshot import street_map_of

    city = City(seed=5, size_m=2000.0)
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
    graph = WalkGraph(street_map)
    area = WalkableArea(street_map.walkable)
    rng = np.random.default_rng(1)
    ends = rng.integers(len(graph.ports), size=(_QUESTIONS, 2)).tolist()
    points = graph.xy[rng.integers(len(graph.xy), size=_QUESTIONS)] + rng.normal(
        0.0, 2.0, (_QUESTIONS, 2)
    )
    graph.shortest(graph.ports[0], graph.ports[-1])
    # The first queries build GEOS's indices; a referee queries one neighbourhood again and again.
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
    contains_s, distance_s, walk_s = ((b - a) / _QUESTIONS for a, b in pairwise(stamps))
    return [
        Figure("city from its seed to a street map, s", made_s, reach=4.0),
        Figure("cached city to a street map, s", read_s, reach=0.5),
        Figure("point in the walkable area, us", 1e6 * contains_s, reach=5.0),
        Figure("distance to its edge, us", 1e6 * distance_s, reach=20.0),
        Figure("shortest walk, ms", 1e3 * walk_s, reach=2.0),
    ]
