"""Many short episodes, each as the first of a process and then all in one process in another order.
`python -m tests.support.episode_order` prints the ids of those that differ, the number of compared ones,
and the number of different results. With --sample it takes SAMPLE alone."""

from __future__ import annotations

import hashlib
import os
import sys
from collections.abc import Callable, Iterator

import msgspec
import numpy as np

from cosim.core.geometry import Polyline
from cosim.core.state import Command
from cosim.results.record import StateHash
from cosim.spec.camera import CameraSpec
from cosim.spec.manifest import Manifest
from cosim.spec.robot import ROBOTS
from cosim.spec.scenario import City, CrowdSpec, Light, Scenario
from physics.dynamics.legs.gait_file import weights_in_words
from scenarios.episodes.episode import Episode
from scenarios.places.nets import place

COUNT = 30
SAMPLE = (0, 1, 7, 13, 18, 19, 24)
"""Episodes of all cities, crowds, robots and lights, two pairs of one seed among them."""
_SECONDS = 0.5
_CITIES = tuple(City(seed=seed, size_m=500.0) for seed in (1, 2))
_CROWDS = (
    CrowdSpec(persons=12, vehicles=8),
    CrowdSpec(persons=30, vehicles=20, groups=0.5, elderly=0.2, children=0.2, radius_m=60.0),
    CrowdSpec(density=8.0, vehicles=0, radius_m=50.0),
    CrowdSpec(persons=5, vehicles=4, residents=4),
    CrowdSpec(persons=0, vehicles=0),
)
_ROBOTS = [name for name, one in ROBOTS.items() if "missing" not in weights_in_words(one)]
_DRIVES = Command(1.0, 0.2)


def drawn() -> Iterator[tuple[Scenario, Manifest]]:
    """Yield scenarios that differ from their neighbours in all state that a process keeps between
    episodes, with their manifests. They come in sixes of one crowd and in pairs of one seed, which
    sets SUMO's clock to the same time, so that leftovers of an episode would affect the next
    one."""
    for k in range(COUNT):
        where = msgspec.structs.replace(_CITIES[k % 2], roughness=0.5 if k % 6 == 1 else 0.0)
        rng = np.random.default_rng(k // 4)
        strips = [
            s for s in place(where)[1].strips.values() if s.kind == "sidewalk" and s.length_m > 25.0
        ]
        line = Polyline(strips[int(rng.integers(len(strips)))].line)
        start = line.at(3.0 + k % 3)
        route = tuple(
            (pose.x_m, pose.y_m) for pose in map(line.at, np.linspace(3.0 + k % 3, 20.0, 5))
        )
        yield (
            Scenario(
                id=f"turn-{k}",
                suite="turn",
                place=where,
                seed=k // 2,
                start=(start.x_m, start.y_m, start.heading_rad),
                goal=route[-1],
                route=route,
                crowd=_CROWDS[k // 6],
                robot=_ROBOTS[k % 5 % len(_ROBOTS)],
                light=Light(hour=20.5) if k % 7 == 3 else Light(),
            ),
            Manifest("turn", camera=CameraSpec(64, 48) if k % 12 == 0 else None),
        )


def hash_of(scenario: Scenario, manifest: Manifest) -> str:
    """Return a hash of the simulated states, and of the pictures."""
    state = StateHash()
    seen = hashlib.sha256()
    with Episode(scenario, manifest, watches=[lambda step, _: state.add(step)]) as episode:
        observation = episode.reset()
        while not episode.over and episode.time_s < _SECONDS:
            if observation.rgb is not None:
                seen.update(observation.rgb.tobytes())
            observation = episode.advance(_DRIVES)
    return f"{state.hexdigest()} {seen.hexdigest()}"


def _as_the_first(work: Callable[[], str]) -> str:
    """Return the result of a process in which no engine has run; the engines of this process are
    imported and not started."""
    reading, writing = os.pipe()
    child = os.fork()
    if not child:
        try:
            os.write(writing, work().encode())
        finally:
            os._exit(0)
    os.close(writing)
    with os.fdopen(reading) as answer:
        result = answer.read()
    os.waitpid(child, 0)
    return result


if __name__ == "__main__":
    import scenarios.events.resident_director  # noqa: F401  as the engines
    import sumo_nets.crowd.crowd  # noqa: F401

    sample = "--sample" in sys.argv
    episodes = [one for k, one in enumerate(drawn()) if k in SAMPLE or not sample]
    first = [_as_the_first(lambda one=one: hash_of(*one)) for one in episodes]  # type: ignore[misc]
    order = np.random.default_rng(12).permutation(len(episodes)).tolist()
    differ = [episodes[k][0].id for k in order if hash_of(*episodes[k]) != first[k]]
    print(differ, sum(map(bool, first)), len(set(first)))
