"""Short ways in one small city, and environments of them in separate processes. `python -m
tests.support.gym_suite killed` prints the ids of its processes and waits to be killed; `error`
prints the error of one environment of several; `differences` prints which of them differ from
single ones."""

from __future__ import annotations

import multiprocessing
import sys
import warnings
from functools import partial
from typing import Any

import numpy as np
from gymnasium.vector import AsyncVectorEnv

import cosim
from cosim.core.geometry import Polyline
from cosim.spec.scenario import City, CrowdSpec, Scenario, Suite
from scenarios.places.nets import place
from scenarios.tools.gym.environment import SidewalkEnv

CITY = City(seed=1, size_m=500.0)
BLIND = cosim.Manifest("blind", camera=None, goal="final_point", odometry="wheel")
COUNT = 4


def short_ways(**more: Any) -> Suite:
    """Return six straight ways of 12 m on sidewalks, 2 s each. more: fields of all of them."""
    strips = [
        s for s in place(CITY)[1].strips.values() if s.kind == "sidewalk" and s.length_m > 25.0
    ][:6]
    ways = tuple(_way(k, Polyline(strip.line), more) for k, strip in enumerate(strips))
    return Suite(name="short", version="1", description="", scenarios=ways)


def _way(k: int, line: Polyline, more: dict[str, Any]) -> Scenario:
    start = line.at(4.0)
    route = tuple((p.x_m, p.y_m) for p in map(line.at, np.linspace(4.0, 16.0, 5)))
    fields = {"crowd": CrowdSpec(persons=0, vehicles=0), "time_limit_s": 2.0} | more
    begins = (start.x_m, start.y_m, start.heading_rad)
    return Scenario(
        id=f"way-{k}",
        suite="short",
        place=CITY,
        seed=k,
        start=begins,
        goal=route[-1],
        route=route,
        **fields,
    )


def one_env() -> SidewalkEnv:
    """Return an environment of these ways for a learner without a camera."""
    return cosim.make_env(short_ways(), BLIND)


def _speeds(k: int) -> np.ndarray:
    return np.float32([[0.5 + 0.2 * i, 0.02 * (k % 5)] for i in range(COUNT)])


def _differences(envs: AsyncVectorEnv) -> list[int]:
    """Return the numbers of environments that differ from one that is driven here with the same
    seed."""
    seen, _ = envs.reset(seed=5)
    vectorized = [seen, *(envs.step(_speeds(k)) for k in range(8))]
    differ = []
    with one_env() as env:
        for i in range(COUNT):
            seen, _ = env.reset(seed=5 + i)
            same = all((vectorized[0][name][i] == seen[name]).all() for name in seen)
            for k in range(8):
                seen, reward, terminated, truncated, _ = env.step(_speeds(k)[i])
                step = vectorized[k + 1]
                same &= all((step[0][name][i] == seen[name]).all() for name in seen)
                same &= (step[1][i], step[2][i], step[3][i]) == (reward, terminated, truncated)
            differ += [] if same and truncated else [i]
    return differ


if __name__ == "__main__":
    warnings.simplefilter("ignore")
    mode = sys.argv[1]
    count = COUNT if mode == "differences" else 2
    multiprocessing.set_forkserver_preload(
        ["tests.support.gym_suite", "scenarios.episodes.episode"]
    )
    envs = AsyncVectorEnv([partial(one_env)] * count, context="forkserver")
    try:
        if mode == "differences":
            print(_differences(envs))
        else:
            envs.reset(seed=1)
            print(*(process.pid for process in envs.processes), flush=True)
            if mode == "killed":
                sys.stdin.read()
            envs.step(np.float32([[1.0, 0.0], [np.nan, 0.0]]))
    except cosim.CosimError as error:
        print(type(error).__name__, error)
    finally:
        envs.close()
