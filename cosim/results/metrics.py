"""Metrics of an episode: `METRICS` maps each name to its definition, a pure function.

A value that does not exist is None. Names follow the literature (Anderson et al. 1807.06757;
Francis et al. 2306.16740; the SidewalkBench paper).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Final, NamedTuple

import numpy as np

from cosim.core.clock import Clock
from cosim.core.geometry import Floats
from cosim.results.go_on import is_measured
from cosim.results.log import Log
from cosim.results.record import Record
from cosim.results.referee import Ended, Failure
from cosim.results.validity import why_bypassed
from cosim.spec.scenario import Scenario

STALLED_MPS = 0.05
_PERSONAL_SPACE_M = 1.2
INTIMATE_SPACE_M = 0.45
PROGRESS_WINDOW_S = 5.0
PROGRESS_MIN_M = 0.1
RATE_NEEDS_M = 1.0
"""Least distance, metres, for a rate per 100 m."""
RATED_PER_PROGRESS = 1.25
"""Metres per metre of progress that count for rates: room for walking round people and things."""
RATED_EXTRA_M = 10.0
"""Metres of an episode that count for rates beyond RATED_PER_PROGRESS times its progress."""


@dataclass(frozen=True)
class EpisodeFacts:
    """Input of the metrics of one episode.

    route_length_m: geodesic walkable length of the reference route
    rules_met: False if the rule of an event is unmet, also because the event was not passed
    rules_broken: number of events whose rule was broken
    bypassed: whether the robot bypassed an event (`cosim.results.validity`)
    walked_into: contacts and falls at a person's fault
    period_ticks: ticks between two commands of the policy
    """

    log: Log
    failures: tuple[Failure, ...]
    red_light_entries: int
    ended: Ended | None
    route_length_m: float
    rules_met: bool = True
    rules_broken: int = 0
    bypassed: bool = False
    walked_into: tuple[Failure, ...] = ()
    period_ticks: int = 5

    @classmethod
    def of(cls, record: Record, scenario: Scenario, log: Log) -> EpisodeFacts:
        """Build the facts of a recorded episode from its files."""
        clock = Clock.for_rate(record.manifest.rate_hz)
        return cls(
            log=log,
            failures=record.failures,
            red_light_entries=len(record.red_light_entries),
            ended=record.ended,
            route_length_m=scenario.route_line.length_m,
            rules_met=all(event.rule_met is not False for event in record.events),
            rules_broken=rules_broken(record, scenario),
            bypassed=why_bypassed(record, scenario) != "",
            walked_into=record.walked_into,
            period_ticks=clock.policy_ms // clock.tick_ms,
        )


def rules_broken(record: Record, scenario: Scenario) -> int:
    """Return the number of events that the robot passed against their rules.

    A rule on the speed of passing is broken once the event was passed. Where the episode ends at a
    stop before a person, driving past is the broken rule.
    """
    measured = {event.id for event in scenario.events if is_measured(event, scenario)}
    unmet = sum(
        event.rule_met is False and (event.id not in measured or event.passed_at_s is not None)
        for event in record.events
    )
    drove_past = scenario.ends_at == "stop" and record.ended == "failure" and not record.failures
    return unmet + drove_past


class Metric(NamedTuple):
    """Definition of a metric.

    unit: "" if dimensionless
    higher_is_better: None if neither direction is better
    of: computes the value
    worst: value of an episode whose policy crashed, so that crashing gains nothing. None if a
        crash says nothing of it; if one direction is better, a run with a crash then has no mean
    pooled: for a rate, the metric counted and the metres it is counted on
    share: whether each value is 0 or 1, so that the mean is a share of episodes

    A rate over several episodes divides all counts by all metres. A mean of rates would let an
    episode of 2 m outweigh one of 400 m, and skip policies that never moved.
    """

    unit: str
    higher_is_better: bool | None
    of: Callable[[EpisodeFacts], float | None]
    worst: float | None = None
    pooled: tuple[str, str] | None = None
    share: bool = False


def goal_reached(episode: EpisodeFacts) -> float:
    """Return 1 if the goal was reached within the time limit, regardless of failures."""
    return float(episode.ended == "goal")


SUCCESS_IN_WORDS = (
    "success: the goal reached in time (of gesturing: the stop made) without a failure or a "
    "broken rule (of conversing and queueing: pass round them; of decoys: go on), and no event "
    "bypassed"
)


def success(episode: EpisodeFacts) -> float:
    """Return 1 if the goal or required stop was reached in time, without failure, broken rule or
    bypassed event."""
    return float(
        episode.ended in ("goal", "stop")
        and episode.rules_met
        and not (episode.failures or episode.bypassed)
    )


def travelled_m(episode: EpisodeFacts) -> float:
    """Return the travelled length without reset jumps: sum of `Log.travelled_m`."""
    return float(episode.log.travelled_m.sum())


def route_length_m(episode: EpisodeFacts) -> float:
    """Return the length of the reference route."""
    return episode.route_length_m


def progress_m(episode: EpisodeFacts) -> float:
    """Return the arc length gained by driving: growth of its maximum, without reset jumps."""
    return progress_of(episode.log.route_s_m, episode.log.reset_s_m)


def progress_of(route_s_m: np.ndarray, reset_s_m: np.ndarray) -> float:
    """Return `progress_m` of arc lengths (T,) and reset arc lengths (T,), NaN without a reset."""
    furthest = gained = 0.0
    for s_m, reset_to_m in zip(route_s_m.tolist(), reset_s_m.tolist(), strict=True):
        gained += max(s_m - furthest, 0.0)
        furthest = max(furthest, s_m)
        if not np.isnan(reset_to_m):
            furthest = max(furthest, reset_to_m)
    return gained


def rated_m(episode: EpisodeFacts) -> float:
    """Return the distance that rates refer to: `travelled_m`, at most 1.25 x progress + 10 m.

    The bound keeps detours round people, and gains nothing for a robot that circles.
    """
    return min(travelled_m(episode), RATED_PER_PROGRESS * progress_m(episode) + RATED_EXTRA_M)


def route_completion(episode: EpisodeFacts) -> float:
    """Return progress / route length, in [0, 1]; 1 at the goal or required stop without a reset."""
    if episode.ended in ("goal", "stop") and not np.isfinite(episode.log.reset_s_m).any():
        return 1.0
    return min(progress_m(episode) / episode.route_length_m, 1.0)


def spl(episode: EpisodeFacts) -> float:
    """Return SPL, success weighted by path length: S l / max(p, l) (Anderson et al.)."""
    return (
        success(episode)
        * episode.route_length_m
        / max(travelled_m(episode), episode.route_length_m)
    )


def time_s(episode: EpisodeFacts) -> float:
    """Return the simulated duration."""
    return len(episode.log) * episode.log.tick_s


def velocity_mean_mps(episode: EpisodeFacts) -> float | None:
    """Return metres travelled / simulated time, including time at rest."""
    return travelled_m(episode) / time_s(episode) if len(episode.log) else None


def _least(values: Floats) -> float | None:
    """Return the minimum; None if there is no finite value."""
    least = float(values.min(initial=np.inf))
    return least if np.isfinite(least) else None


def pedestrian_distance_min_m(episode: EpisodeFacts) -> float | None:
    """Return the least centre distance to a person; None without people."""
    return _least(episode.log.person_m)


def pedestrian_distance_min_success_m(episode: EpisodeFacts) -> float | None:
    """Return `pedestrian_distance_min_m` of a successful episode, as in the paper; else None."""
    return pedestrian_distance_min_m(episode) if success(episode) else None


def clearance_min_m(episode: EpisodeFacts) -> float | None:
    """Return the least gap between robot outline and a person's 0.3 m disk; None without people."""
    return _least(episode.log.clearance_m)


def time_to_collision_min_s(episode: EpisodeFacts) -> float | None:
    """Return the least time to collision with a person at constant velocities; None without one.

    Both are disks, see `cosim.results.log.time_to_collision_s` (Francis et al., after Biswas et al.
    2022).
    """
    return _least(episode.log.collision_in_s)


def space_compliance(episode: EpisodeFacts) -> float | None:
    """Return the share of ticks without a person within 0.45 m (centres); None without people."""
    if pedestrian_distance_min_m(episode) is None:
        return None
    return float((episode.log.person_m > INTIMATE_SPACE_M).mean())


def personal_space_violation(episode: EpisodeFacts) -> float | None:
    """Return the share of ticks with a person within 1.2 m (centres); None without people."""
    if pedestrian_distance_min_m(episode) is None:
        return None
    return float((episode.log.person_m < _PERSONAL_SPACE_M).mean())


def stalled_time_s(episode: EpisodeFacts) -> float:
    """Return the time slower than 0.05 m/s."""
    return float((np.abs(episode.log.speed[:, 0]) < STALLED_MPS).sum() * episode.log.tick_s)


def failure_to_progress(episode: EpisodeFacts) -> float:
    """Return the number of successive 5 s windows with less than 0.1 m of arc length gained.

    Reset jumps do not count.
    """
    window = round(PROGRESS_WINDOW_S / episode.log.tick_s)
    s_m, reset_s_m = episode.log.route_s_m, episode.log.reset_s_m
    begins = np.concatenate([[0.0], np.where(np.isnan(reset_s_m), s_m, reset_s_m)[:-1]])
    driven = s_m - begins
    windows = range(0, len(driven) - window + 1, window)
    return float(sum(driven[i : i + window].sum() < PROGRESS_MIN_M for i in windows))


def accelerations_mps2(episode: EpisodeFacts) -> list[Floats]:
    """Return accelerations along the heading from command to command, one array per stretch.

    A reset ends a stretch; no difference is taken across it.
    """
    log, period = episode.log, episode.period_ticks
    ends = [*(np.flatnonzero(np.isfinite(log.reset_s_m)) + 1).tolist(), len(log)]
    stretches = zip([0, *ends[:-1]], ends, strict=True)
    speeds = (
        np.concatenate([[0.0], log.speed[begin:end, 0]])[::period] for begin, end in stretches
    )
    return [np.diff(v_mps) / (period * log.tick_s) for v_mps in speeds]


def mean_acceleration_mps2(episode: EpisodeFacts) -> float | None:
    """Return the mean magnitude of the acceleration, at the policy's rate (Francis et al.)."""
    return _mean_magnitude(accelerations_mps2(episode))


def mean_jerk_mps3(episode: EpisodeFacts) -> float | None:
    """Return the mean magnitude of the jerk, at the policy's rate (Francis et al.)."""
    period_s = episode.period_ticks * episode.log.tick_s
    return _mean_magnitude([np.diff(one) / period_s for one in accelerations_mps2(episode)])


def _mean_magnitude(stretches: list[Floats]) -> float | None:
    values = np.abs(np.concatenate(stretches))
    return float(values.mean()) if len(values) else None


def carriageway_time_s(episode: EpisodeFacts) -> float:
    """Return the time with the base centre on a road, or on a crossing at red."""
    return float(episode.log.on_carriageway.sum() * episode.log.tick_s)


def vehicles_braked(episode: EpisodeFacts) -> float:
    """Return how often a vehicle braked by more than 2 m/s2 for a robot without right of way."""
    return float(episode.log.vehicles_braked.sum())


def count(kind: str) -> Callable[[EpisodeFacts], float]:
    """Return a metric that counts failures of a kind; "" counts all."""
    return lambda episode: float(sum(kind in ("", failure.kind) for failure in episode.failures))


def falls(episode: EpisodeFacts) -> float | None:
    """Return the number of falls; None for a robot on wheels."""
    return count("fall")(episode) if episode.log.on_legs else None


def falls_per_100m(episode: EpisodeFacts) -> float | None:
    """Return the falls per 100 m travelled; None for a robot on wheels and below 1 m."""
    return per_100m("fall", rated_m)(episode) if episode.log.on_legs else None


def collisions_with(other_kind: str) -> Callable[[EpisodeFacts], float]:
    """Return a metric that counts collisions with a kind of thing."""
    return lambda episode: float(
        sum(f.kind == "collision" and f.other_kind == other_kind for f in episode.failures)
    )


def walked_into(episode: EpisodeFacts) -> float:
    """Return the number of contacts at a person's fault, without the falls that follow."""
    return float(sum(one.kind == "collision" for one in episode.walked_into))


def any_of(count_of: Callable[[EpisodeFacts], float]) -> Callable[[EpisodeFacts], float]:
    """Return a metric that is 1 if the count is above 0; its mean is a rate of episodes."""
    return lambda episode: float(count_of(episode) > 0.0)


def collisions_with_others(episode: EpisodeFacts) -> float:
    """Return the number of collisions with anything but a person."""
    return count("collision")(episode) - collisions_with("pedestrian")(episode)


def per_100m(
    kind: str, distance: Callable[[EpisodeFacts], float]
) -> Callable[[EpisodeFacts], float | None]:
    """Return a metric of failures of a kind per 100 m of a distance; None below 1 m."""

    def rate(episode: EpisodeFacts) -> float | None:
        metres = distance(episode)
        return 100.0 * count(kind)(episode) / metres if metres >= RATE_NEEDS_M else None

    return rate


METRICS: Mapping[str, Metric] = MappingProxyType(
    {
        "success": Metric("", True, success, worst=0.0, share=True),
        "goal_reached": Metric("", True, goal_reached, worst=0.0, share=True),
        "route_completion": Metric("", True, route_completion, worst=0.0),
        "spl": Metric("", True, spl, worst=0.0),
        "failures_per_100m": Metric(
            "1/100 m", False, per_100m("", rated_m), pooled=("failures", "rated_m")
        ),
        "collisions_per_100m": Metric(
            "1/100 m",
            False,
            per_100m("collision", rated_m),
            pooled=("collisions", "rated_m"),
        ),
        "out_of_lane_per_100m": Metric(
            "1/100 m",
            False,
            per_100m("out_of_lane", rated_m),
            pooled=("out_of_lane", "rated_m"),
        ),
        "freezings_per_100m": Metric(
            "1/100 m",
            False,
            per_100m("freezing", rated_m),
            pooled=("freezings", "rated_m"),
        ),
        "falls_per_100m": Metric("1/100 m", False, falls_per_100m, pooled=("falls", "rated_m")),
        "failures_per_100m_progress": Metric(
            "1/100 m", False, per_100m("", progress_m), pooled=("failures", "progress_m")
        ),
        "failures_per_100m_route": Metric(
            "1/100 m", False, per_100m("", route_length_m), pooled=("failures", "route_length_m")
        ),
        "velocity_mean_mps": Metric("m/s", True, velocity_mean_mps, worst=0.0),
        "failures": Metric("", False, count("")),
        "rules_broken": Metric("", False, lambda episode: float(episode.rules_broken)),
        "collisions": Metric("", False, count("collision")),
        "out_of_lane": Metric("", False, count("out_of_lane")),
        "freezings": Metric("", False, count("freezing")),
        "falls": Metric("", False, falls),
        "collisions_pedestrian": Metric("", False, collisions_with("pedestrian")),
        "collisions_vehicle": Metric("", False, collisions_with("vehicle")),
        "collisions_wall": Metric("", False, collisions_with("wall")),
        "collisions_object": Metric("", False, collisions_with("object")),
        "walked_into": Metric("", None, walked_into),
        "pedestrian_collision": Metric(
            "", False, any_of(collisions_with("pedestrian")), share=True
        ),
        "other_collision": Metric("", False, any_of(collisions_with_others), share=True),
        "left_lane": Metric("", False, any_of(count("out_of_lane")), share=True),
        "broke_rule": Metric(
            "", False, any_of(lambda episode: float(episode.rules_broken)), share=True
        ),
        "red_light_entries": Metric("", False, lambda episode: float(episode.red_light_entries)),
        "carriageway_time_s": Metric("s", False, carriageway_time_s),
        "vehicles_braked": Metric("", False, vehicles_braked),
        "pedestrian_distance_min_m": Metric("m", True, pedestrian_distance_min_m),
        "pedestrian_distance_min_success_m": Metric("m", True, pedestrian_distance_min_success_m),
        "clearance_min_m": Metric("m", True, clearance_min_m),
        "time_to_collision_min_s": Metric("s", True, time_to_collision_min_s),
        "space_compliance": Metric("", True, space_compliance),
        "personal_space_violation": Metric("", False, personal_space_violation),
        "stalled_time_s": Metric("s", False, stalled_time_s),
        "failure_to_progress": Metric("", False, failure_to_progress),
        "acceleration_mean_mps2": Metric("m/s2", False, mean_acceleration_mps2),
        "jerk_mean_mps3": Metric("m/s3", False, mean_jerk_mps3),
        "path_length_m": Metric("m", None, travelled_m),
        "rated_m": Metric("m", None, rated_m),
        "route_length_m": Metric("m", None, route_length_m),
        "progress_m": Metric("m", True, progress_m),
        "time_s": Metric("s", None, time_s),
        "time_to_goal_s": Metric("s", False, lambda e: time_s(e) if goal_reached(e) else None),
    }
)

POOLED: Mapping[str, tuple[str, str]] = MappingProxyType(
    {name: metric.pooled for name, metric in METRICS.items() if metric.pooled}
)
"""Rates, each with the count and the metres that it is pooled from."""
WORST: Mapping[str, float] = MappingProxyType(
    {name: metric.worst for name, metric in METRICS.items() if metric.worst is not None}
)
"""Measures of an episode whose policy crashed; an invalid episode has none.

A crash is a failure that covers no route. What it would have touched or left is unknown.
"""
UNKNOWN_WITH_CRASH: frozenset[str] = frozenset(
    name
    for name, metric in METRICS.items()
    if metric.worst is None and metric.higher_is_better is not None
)
"""Metrics without a mean if a policy crashed: it could have ended episodes that went badly."""

COUNTERFACTUAL: Mapping[str, str] = MappingProxyType(
    {"people_delay_s": "s", "people_compared": "", "vehicles_delay_s": "s", "vehicles_compared": ""}
)
"""Name and unit of measures against the street without the robot (`cosim.results.delay`).

Delays of bodies that came near the robot, summed, and their number; only in episodes that request
it.
"""


BRIEF: Final = ("success", "route_completion", *POOLED["failures_per_100m"])
"""Metrics of an episode of a search, computed from BRIEF_COLUMNS of the log alone."""
BRIEF_COLUMNS: Final = ("route_s_m", "travelled_m", "reset_s_m")


def compute_metrics(
    episode: EpisodeFacts, names: Iterable[str] = tuple(METRICS)
) -> dict[str, float | None]:
    """Compute metrics of an episode, by default every one."""
    return {name: METRICS[name].of(episode) for name in names}
