"""Estimates of the duration of a run, from the durations of earlier episodes on this machine.

After a run one line for each of its episodes is added to `pace.jsonl` in the cache folder. Errors
of this file are ignored, because only the estimate depends on it.
"""

from __future__ import annotations

import heapq
import os
import platform
import re
import statistics
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Final, NamedTuple

import msgspec
import numpy as np

from cosim.core.cache import cache_folder
from cosim.core.clock import Clock
from cosim.core.errors import CosimError
from cosim.core.files import write_atomic
from cosim.core.units import duration
from cosim.results.record import Record
from cosim.results.run_folder import RunFolder
from cosim.spec.scenario import Scenario

FILE: Final = "pace.jsonl"
"""Name of the file of durations in the cache folder."""
EPISODES_KEPT: Final = 500
"""Number of lines to which the file is truncated when it has twice as many."""
RECENT: Final = 40
"""Number of newest episodes that an estimate uses, because the code and the machine change."""
ENOUGH: Final = 3
"""Smallest number of episodes that an estimate is based on."""
POLICY_SPEED_MPS: Final = (0.9, 1.4)
"""Mean speed in m/s of slow and fast policies, including waits at red lights."""
SIMULATION_SPEED: Final = (3.0, 8.0)
"""Simulated seconds per second of an environment process, on slow and fast cores."""
SETUP_S: Final = (2.0, 10.0)
"""Shortest and longest time in seconds to an episode's first tick; longer if its city is new."""
COMPARISON_FACTOR: Final = 1.4
"""Duration of an episode with the comparison without the robot, relative to one without it."""
NARROWEST_RANGE: Final = (0.6, 1.5)
"""Narrowest range of an estimate as factors on its median, because other programs also run."""
_SHARED: Final = 1.4
"""Factor on durations with more processes than were measured, which share caches and memory."""


class EpisodeDuration(msgspec.Struct, frozen=True, kw_only=True):
    """Durations of an episode.

    short: whether it ends on a failure.
    setup_s: seconds until its first tick.
    work_s: seconds from then on.
    """

    machine: str
    policy: str
    renderer: str
    jobs: int
    short: bool
    compared: bool
    route_m: float
    simulated_s: float
    work_s: float
    setup_s: float


class Estimate(NamedTuple):
    """Range of the duration of a run in seconds, and its basis in words."""

    low_s: float
    high_s: float
    basis: str


def announcement(
    scenarios: Sequence[Scenario],
    policy: str,
    renderer: str,
    jobs: int,
    compared: bool,
    pace: float = 0.0,
) -> str:
    """Return a line with the number of episodes of a run, its route length, the maximum simulated
    time and the estimate.

    pace: see `cosim.spec.options.EpisodeOptions`.
    """
    known = load_durations()
    cores = len(os.sched_getaffinity(0))

    def taken(jobs: int) -> Estimate:
        free = estimate(scenarios, known, policy, renderer, jobs, compared, cores)
        return paced_estimate(free, scenarios, known, policy, jobs, pace) if pace else free

    here = taken(jobs)
    length_m = sum(s.route_line.length_m for s in scenarios)
    length = f"{length_m / 1000.0:.1f} km" if length_m >= 1000.0 else f"{length_m:.0f} m"
    most_s = sum(s.time_limit_s for s in scenarios)
    words = (
        f"{_episodes(len(scenarios))}, {length} of route, at most {duration(most_s)} of simulated "
        f"time. "
    )
    words += f"About {format_estimate(here)} with --jobs {jobs}"
    if jobs < (most := min(cores, len(scenarios))):
        words += f", {format_estimate(taken(most))} with --jobs {most}"
    return f"{words}: {here.basis}."


def estimate(
    scenarios: Sequence[Scenario],
    known: Sequence[EpisodeDuration],
    policy: str,
    renderer: str,
    jobs: int,
    compared: bool,
    cores: int,
) -> Estimate:
    """Estimate the duration of scenarios with `jobs` processes.

    known: measured on this machine, the newest last.
    """
    short = all(s.ends_on_failure for s in scenarios)
    comparable = [m for m in known if m.renderer == renderer and m.compared == compared]
    of_policy = [m for m in comparable if (m.policy, m.short) == (policy, short)][-RECENT:]
    any_policy = comparable[-RECENT:] if len(comparable) >= ENOUGH else []
    samples = of_policy if len(of_policy) >= ENOUGH else any_policy
    slots = min(jobs, cores)
    slower = _SHARED if slots > max((m.jobs for m in samples), default=1) else 1.0
    setup_s = _around([m.setup_s for m in samples]) if samples else SETUP_S

    def taken_s(low_s: Iterable[float], high_s: Iterable[float]) -> tuple[float, float]:
        fast, slow = (
            [setup + work for work in works]
            for setup, works in zip(setup_s, (low_s, high_s), strict=True)
        )
        return makespan(fast, slots), slower * makespan(slow, slots)

    lengths_m = [s.route_line.length_m for s in scenarios]
    if samples is of_policy:
        rates = _around([m.work_s / m.route_m for m in of_policy])
        basis = f"measured in {_episodes(len(of_policy))} of '{policy}' on this machine"
        return Estimate(
            *taken_s(*([rate * metres for metres in lengths_m] for rate in rates)), basis
        )
    if any_policy:
        slow, fast = _around([m.simulated_s / m.work_s for m in any_policy])
        middle = statistics.median(m.simulated_s / m.work_s for m in any_policy)
        least_mps, most_mps = POLICY_SPEED_MPS
        driven = f"the policy is taken to drive at {least_mps:g} to {most_mps:g} m/s"
        basis = f"this machine simulates {middle:.1f} s a second, {driven}"
    else:
        slow = SIMULATION_SPEED[0] / (COMPARISON_FACTOR if compared else 1.0)
        fast = SIMULATION_SPEED[1]
        basis = "a guess, as nothing is measured on this machine yet"
    spans = (
        [metres / (v * speed) for metres in lengths_m]
        for v, speed in zip(POLICY_SPEED_MPS, (slow, fast), strict=True)
    )
    high_s, low_s = spans
    stuck_s = taken_s([], [s.time_limit_s / slow for s in scenarios])[1]
    basis += f"; up to {duration(stuck_s)} if it stands still, longer if it thinks long"
    return Estimate(*taken_s(low_s, high_s), basis)


def paced_estimate(
    free: Estimate,
    scenarios: Sequence[Scenario],
    known: Sequence[EpisodeDuration],
    policy: str,
    jobs: int,
    pace: float,
) -> Estimate:
    """Estimate the duration of scenarios that are limited to `pace` times real time.

    free: the estimate without this limit.
    """
    short = all(s.ends_on_failure for s in scenarios)
    same = [m for m in known if (m.policy, m.short) == (policy, short)][-RECENT:]
    if len(same) >= ENOUGH:
        rates = _around([m.simulated_s / m.route_m for m in same])
        basis = f"as fast as {_episodes(len(same))} of '{policy}' on this machine drove, "
    else:
        rates = (1.0 / POLICY_SPEED_MPS[1], 1.0 / POLICY_SPEED_MPS[0])
        least_mps, most_mps = POLICY_SPEED_MPS
        basis = f"the policy is taken to drive at {least_mps:g} to {most_mps:g} m/s, "
    low_s, high_s = (
        makespan([setup_s + rate * s.route_line.length_m / pace for s in scenarios], jobs)
        for setup_s, rate in zip(SETUP_S, rates, strict=True)
    )
    if low_s <= free.low_s and high_s <= free.high_s:
        return free
    stuck_s = makespan([s.time_limit_s / pace for s in scenarios], jobs)
    basis += (
        f"held to {pace:g} x real time; up to {duration(stuck_s)} if it stands still, longer if "
        f"it thinks long"
    )
    return Estimate(max(low_s, free.low_s), max(high_s, free.high_s), basis)


def makespan(taken_s: Sequence[float], slots: int) -> float:
    """Return the end of the last of several tasks that `slots` workers start in order, in s."""
    free_at = [0.0] * slots
    for one_s in taken_s:
        heapq.heapreplace(free_at, free_at[0] + one_s)
    return max(free_at)


def format_estimate(found: Estimate) -> str:
    """Format an estimate, as "9 to 15 min"."""
    low, high = duration(found.low_s), duration(found.high_s)
    if low == high:
        return low
    return (
        f"{low.split()[0]} to {high}" if low.split()[1:] == high.split()[1:] else f"{low} to {high}"
    )


@contextmanager
def recording_durations(
    held: RunFolder, todo: Sequence[Scenario], jobs: int, pace: float = 0.0
) -> Iterator[None]:
    """Record the durations of the episodes of `todo` that finish in the block, also after an error.

    Episodes with a `pace` are not recorded: they do not show how fast this machine is.
    """
    try:
        yield
    finally:
        if not pace:
            with suppress(OSError, CosimError, KeyError):
                record_durations(held, todo, jobs)


def record_durations(held: RunFolder, todo: Sequence[Scenario], jobs: int) -> None:
    """Add the durations of the finished episodes of a run to the file."""
    lines = []
    for scenario in todo:
        path = held.episode_folder(scenario.id) / "record.json"
        if path.exists() and (record := Record.load(path)).ended is not None:
            one = duration_of(record, scenario, held.spec.policy, held.spec.counterfactual, jobs)
            lines.append(msgspec.json.encode(one))
    if not lines:
        return
    path = cache_folder() / FILE
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("ab") as file:
        file.write(b"".join(line + b"\n" for line in lines))
    if len(every := path.read_bytes().splitlines(keepends=True)) > 2 * EPISODES_KEPT:
        write_atomic(path, b"".join(every[-EPISODES_KEPT:]), shared=True)


def duration_of(
    record: Record, scenario: Scenario, policy: str, compared: bool, jobs: int
) -> EpisodeDuration:
    """Return the durations of an episode."""
    setup_s = record.clock["setup_s"]
    return EpisodeDuration(
        machine=machine(),
        policy=policy,
        renderer=record.setup.renderer,
        jobs=jobs,
        short=scenario.ends_on_failure,
        compared=compared,
        route_m=scenario.route_line.length_m,
        simulated_s=Clock().time_s(record.ticks),
        work_s=max(record.clock["wall_s"] - setup_s, 1e-3),
        setup_s=setup_s,
    )


def load_durations() -> list[EpisodeDuration]:
    """Load the durations measured on this machine, the newest last. Invalid lines are skipped."""
    found = []
    with suppress(OSError):
        for line in (cache_folder() / FILE).read_bytes().splitlines():
            with suppress(msgspec.DecodeError):
                found.append(msgspec.json.decode(line, type=EpisodeDuration))
    here = machine()
    return [one for one in found if one.machine == here]


def machine() -> str:
    """Return the processor and the number of usable cores, on which durations depend."""
    with suppress(OSError):
        if model := re.search(
            r"^model name\s*:\s*(.+)$", Path("/proc/cpuinfo").read_text(), re.MULTILINE
        ):
            return f"{model.group(1)} x{len(os.sched_getaffinity(0))}"
    return f"{platform.machine()} x{len(os.sched_getaffinity(0))}"


def _around(values: Sequence[float]) -> tuple[float, float]:
    """Return the quantiles 0.2 and 0.8 of values, widened to NARROWEST_RANGE."""
    low, middle, high = np.quantile(values, [0.2, 0.5, 0.8])
    return float(min(low, NARROWEST_RANGE[0] * middle)), float(
        max(high, NARROWEST_RANGE[1] * middle)
    )


def _episodes(count: int) -> str:
    return f"{count} episode" if count == 1 else f"{count} episodes"
