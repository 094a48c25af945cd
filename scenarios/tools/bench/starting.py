"""How long it takes until the first picture, in a fresh process and from one episode to the next;
and until the first episode of a run is over."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Final

import msgspec

from cosim.spec.options import EpisodeOptions
from cosim.spec.scenario import City, Scenario, Suite
from scenarios.tools.bench.driving import FourHertz
from scenarios.tools.bench.figures import Figure

ENGINES_ALONE: Final = "the engines alone, fresh process, s"


def starting(began_s: float) -> list[Figure]:
    """Seconds to the first frame of three scenarios in turn: in this process, fresh at `began_s` of
    the monotonic clock; in the same city; in another one. Their cities are in the cache."""
    from scenarios.suites.catalog import load_suite

    first, same, other = (load_suite("reactive").scenarios[i] for i in (0, 1, 8))
    fresh_s = _first_frame_s(first, began_s)
    same_s, other_s = (_first_frame_s(scenario, time.monotonic()) for scenario in (same, other))
    return [
        Figure("first frame, fresh process, cached city, s", fresh_s, reach=1.5),
        Figure("first frame, next episode, same city, s", same_s, reach=0.3),
        Figure("first frame, next episode, other cached city, s", other_s, reach=0.8),
    ]


def engines_starting(began_s: float) -> list[Figure]:
    """Seconds until SUMO on the net of that first scenario, PyBullet and OpenGL alone stand in this
    process, fresh at `began_s`."""
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
        return [Figure(ENGINES_ALONE, time.monotonic() - began_s)]


def first_episode(began_s: float, of_one_process: Callable[[], Figure]) -> list[Figure]:
    """Seconds by which the first episode of a local run is over later than in one process alone,
    each begun fresh; this one at `began_s` of the monotonic clock."""
    late_s = _first_over_s(began_s, local=True) - of_one_process().value
    return [Figure("first episode of a local run, later than in one process, s", late_s, reach=1.0)]


def first_episode_alone(began_s: float) -> list[Figure]:
    """Seconds until the first episode of a run in this process alone, begun at `began_s`, is
    over."""
    return [Figure("first episode in one process, s", _first_over_s(began_s, local=False))]


def _first_over_s(began_s: float, *, local: bool) -> float:
    """local: driven by a process of its own, as `cosim run` does it; else by this one."""
    from cosim.policies.load import load_policy
    from scenarios.runs.run import run
    from scenarios.suites.catalog import load_suite

    one = msgspec.structs.replace(load_suite("reactive").scenarios[0], time_limit_s=1.0, events=())
    suite = Suite(name="first", version="1", scenarios=(one,))
    run(
        suite,
        "straight" if local else load_policy("straight").policy,
        options=EpisodeOptions(seed=1),
    )
    return time.monotonic() - began_s


def _first_frame_s(scenario: Scenario, began_s: float) -> float:
    from scenarios.episodes.episode import Episode

    with Episode(scenario, FourHertz.manifest) as episode:
        episode.reset()
        return time.monotonic() - began_s
