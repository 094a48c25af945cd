"""Every metric against a case worked out by hand."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from cosim.results.log import Log
from cosim.results.metrics import METRICS, POOLED, EpisodeFacts, compute_metrics, progress_of
from cosim.results.referee import Failure
from tests.logs import log_with


def log(
    s_m: list[float], *, resets: dict[int, float] | None = None, person_m: float = np.inf
) -> Log:
    """The log of a robot on the x axis at s_m after each tick; the first tick begins at 0."""
    s = np.array(s_m)
    n = len(s)
    reset = np.full(n, np.nan)
    begins = np.concatenate([[0.0], s[:-1]])
    for tick, to_m in (resets or {}).items():
        reset[tick] = to_m
        begins[tick + 1] = to_m
    moved = np.abs(s - begins)
    return log_with(
        n,
        pose=np.column_stack([s, np.zeros(n), np.zeros(n)]),
        speed=np.column_stack([moved / 0.05, np.zeros(n)]),
        route_s_m=s,
        travelled_m=moved,
        person_m=np.full(n, person_m),
        clearance_m=np.full(n, person_m - 0.65),
        collision_in_s=np.full(n, np.inf),
        reset_s_m=reset,
    )


def failure(kind: str, other_kind: str = "") -> Failure:
    return Failure(kind, 0, 0.0, 0.0, 0.0, 1.0, "x", other_kind)  # type: ignore[arg-type]


def episode(
    trajectory: Log, *failures: Failure, ended: str = "timeout", length_m: float = 100.0
) -> EpisodeFacts:
    return EpisodeFacts(trajectory, failures, 0, ended, length_m)  # type: ignore[arg-type]


def test_a_clean_drive_to_the_goal() -> None:
    """100 m at 1 m/s in 2,000 ticks without people give the textbook values."""
    measures = compute_metrics(episode(log([0.05 * (i + 1) for i in range(2000)]), ended="goal"))
    expected = {
        "success": 1.0,
        "goal_reached": 1.0,
        "route_completion": 1.0,
        "spl": 1.0,
        "failures_per_100m": 0.0,
        "velocity_mean_mps": 1.0,
        "path_length_m": 100.0,
        "progress_m": 100.0,
        "time_s": 100.0,
        "time_to_goal_s": 100.0,
        "stalled_time_s": 0.0,
        "failure_to_progress": 0.0,
        "failures": 0.0,
    }
    assert {name: measures[name] for name in expected} == pytest.approx(expected)
    assert measures["pedestrian_distance_min_m"] is None
    assert measures["space_compliance"] is None


def test_rates_are_per_100_m_travelled_and_of_progress() -> None:
    """40 m forward and 20 m back with 3 failures give 3 on 60 m travelled and on 40 m of progress."""
    forward = [0.1 * (i + 1) for i in range(400)]
    back = [40.0 - 0.1 * (i + 1) for i in range(200)]
    failures = (
        failure("collision", "pedestrian"),
        failure("collision", "vehicle"),
        failure("freezing"),
    )
    measures = compute_metrics(episode(log(forward + back), *failures))
    assert measures["path_length_m"] == pytest.approx(60.0)
    assert measures["progress_m"] == pytest.approx(40.0)
    assert measures["failures_per_100m"] == pytest.approx(5.0)
    assert measures["collisions_per_100m"] == pytest.approx(2 * 100 / 60)
    assert measures["freezings_per_100m"] == pytest.approx(100 / 60)
    assert measures["failures_per_100m_progress"] == pytest.approx(7.5)
    assert (measures["collisions_pedestrian"], measures["collisions_vehicle"]) == (1.0, 1.0)
    assert measures["route_completion"] == pytest.approx(0.4)
    assert (measures["success"], measures["spl"]) == (0.0, 0.0)


def test_rates_count_a_detour_up_to_a_bound() -> None:
    """100 m of progress count as at most 135 m; speed and path length use all metres."""
    ahead = [0.1 * (i + 1) for i in range(500)]
    circles = [50.0 - 0.1 * (i % 2) for i in range(4001)]
    onward = [50.0 + 0.1 * (i + 1) for i in range(500)]
    hits = (failure("collision", "wall"),) * 2 + (failure("out_of_lane"), failure("freezing"))
    straight, round_someone, circling, longer = (
        compute_metrics(episode(log(ahead + circles[:n] + onward), *hits))
        for n in (0, 101, 4001, 2001)
    )
    assert [m["rated_m"] for m in (straight, round_someone, circling, longer)] == pytest.approx(
        [100.0, 110.0, 135.0, 135.0]
    )
    assert circling["path_length_m"] == pytest.approx(500.0)
    assert circling["velocity_mean_mps"] == pytest.approx(2.0, abs=1e-3)
    for name, least in {"collisions": 2, "out_of_lane": 1, "freezings": 1, "failures": 4}.items():
        rates = [m[f"{name}_per_100m"] for m in (circling, longer)]
        assert rates == pytest.approx([100.0 * least / 135.0] * 2), name
    for name in ("failures_per_100m_progress", "failures_per_100m_route"):
        assert circling[name] == pytest.approx(straight[name]) == 4.0
    pooled_on = {metres for _, metres in POOLED.values()}
    assert pooled_on == {"rated_m", "progress_m", "route_length_m"}


def test_circling_without_progress_counts_as_ten_metres() -> None:
    """400 s of circles at the start, or after a reset, give a failure on 10 m, not on 400."""
    circles = [0.1 * (i % 2) for i in range(8000)]
    stuck = compute_metrics(episode(log(circles), failure("collision", "wall")))
    assert stuck["path_length_m"] == pytest.approx(799.9) and stuck["progress_m"] == 0.1
    assert stuck["rated_m"] == pytest.approx(10.125)
    again = log([*circles, *[30.0 + s for s in circles]], resets={7999: 30.0})
    put_on = compute_metrics(episode(again, failure("collision", "wall")))
    assert put_on["rated_m"] == pytest.approx(10.25)
    assert put_on["collisions_per_100m"] == pytest.approx(100.0 / 10.25)


def test_the_total_is_the_sum_of_its_parts() -> None:
    """FC = C + OL + F, as in the paper's table."""
    failures = [failure(k) for k in ("collision", "out_of_lane", "out_of_lane", "freezing")]
    m = compute_metrics(episode(log([0.05 * i for i in range(1, 500)]), *failures))
    parts = (m[f"{name}_per_100m"] for name in ("collisions", "out_of_lane", "freezings"))
    assert m["failures_per_100m"] == pytest.approx(sum(p for p in parts if p is not None))


def test_a_reset_is_neither_travel_nor_progress() -> None:
    """Forward jumps reduce the progress, and ground driven again after a jump back counts once."""
    assert progress_of(
        np.array([4.0, 6.0, 12.0]), np.array([np.nan, 10.0, np.nan])
    ) == pytest.approx(8.0)
    assert progress_of(np.array([8.0, 6.0, 9.0]), np.array([5.0, np.nan, np.nan])) == pytest.approx(
        9.0
    )
    drive = log([1.0, 2.0, 3.0, 11.0, 12.0], resets={2: 10.0})
    assert compute_metrics(episode(drive))["path_length_m"] == pytest.approx(5.0)


def test_a_goal_reached_with_failures_is_no_success() -> None:
    """`goal_reached` counts the arrival, `success` only a clean one."""
    measures = compute_metrics(episode(log([50.0, 100.0]), failure("out_of_lane"), ended="goal"))
    assert (measures["goal_reached"], measures["success"]) == (1.0, 0.0)


def test_a_rate_without_distance_is_absent_not_zero() -> None:
    """A robot that never moved has failures but no failures per 100 m, and no time to goal."""
    measures = compute_metrics(episode(log([0.0] * 400), failure("freezing")))
    assert measures["freezings"] == 1.0
    assert measures["failures_per_100m"] is None
    assert measures["time_to_goal_s"] is None
    assert measures["stalled_time_s"] == pytest.approx(20.0)
    assert measures["failure_to_progress"] == 4.0


def test_space_metrics_have_the_signs_of_their_names() -> None:
    """At 1 m from a person the intimate space is respected and the personal space violated, at 0.4
    m both are violated."""
    at_1m, at_40cm = (compute_metrics(episode(log([0.05] * 10, person_m=d))) for d in (1.0, 0.4))
    assert (at_1m["space_compliance"], at_1m["personal_space_violation"]) == (1.0, 1.0)
    assert (at_40cm["space_compliance"], at_40cm["personal_space_violation"]) == (0.0, 1.0)
    assert at_40cm["pedestrian_distance_min_m"] == 0.4


def test_time_on_the_carriageway_and_braking_vehicles_are_summed() -> None:
    """Thirty ticks on the road are 1.5 s, and two vehicles that brake at one tick and one later are
    three."""
    trajectory = log([0.05 * (i + 1) for i in range(100)])
    trajectory.on_carriageway[20:50] = True
    trajectory.vehicles_braked[25], trajectory.vehicles_braked[40] = 2, 1
    measures = compute_metrics(episode(trajectory))
    assert measures["carriageway_time_s"] == pytest.approx(1.5)
    assert measures["vehicles_braked"] == 3.0


def test_spl_charges_detours() -> None:
    """A clean drive of 125 m for a route of 100 m has an SPL of 0.8."""
    forward = [0.5 * (i + 1) for i in range(225)]
    back = [112.5 - 0.5 * (i + 1) for i in range(25)]
    assert compute_metrics(episode(log(forward + back), ended="goal"))["spl"] == pytest.approx(0.8)


def test_every_metric_is_defined_for_every_episode() -> None:
    """No metric raises or gives NaN, whatever the episode."""
    for expected in (
        episode(log([0.05])),
        episode(log([0.0, 120.0]), ended="goal"),
        episode(log([1.0] * 3, person_m=0.1)),
    ):
        values = compute_metrics(expected)
        assert set(values) == set(METRICS)
        assert all(value is None or np.isfinite(value) for value in values.values())


def test_resets_neither_hide_nor_invent_a_failure_to_progress() -> None:
    """A forward jump is no progress of a standing robot, and a jump back does not stall a driving
    one."""
    stands = log([0.0] * 200 + [10.0] * 200, resets={199: 10.0})
    assert compute_metrics(episode(stands))["failure_to_progress"] == 4.0
    drives = [0.05 * (i + 1) for i in range(150)] + [0.05 * (i + 1) for i in range(150)]
    assert compute_metrics(episode(log(drives, resets={149: 0.0})))["failure_to_progress"] == 0.0


def test_people_who_walk_into_a_standing_robot_cost_it_nothing() -> None:
    """Two such contacts before the goal are a success with no collision and two contacts."""
    facts = episode(log([0.05 * (i + 1) for i in range(2000)]), ended="goal")
    measures = compute_metrics(
        replace(facts, walked_into=(failure("collision", "pedestrian"),) * 2)
    )
    assert [
        measures[name] for name in ("success", "collisions", "failures_per_100m", "walked_into")
    ] == [1, 0, 0, 2]


def test_accelerations_and_jerks_are_of_the_policys_periods() -> None:
    """At 4 Hz speeds of 0, 0.5, 1.5, 1.5 m/s give 2, 4, 0 m/s2, and so 8 and -16 m/s3."""
    trajectory = log([0.05] * 15)
    trajectory.speed[:, 0] = np.repeat([0.5, 1.5, 1.5], 5)
    measures = compute_metrics(episode(trajectory))
    assert measures["acceleration_mean_mps2"] == pytest.approx((2.0 + 4.0 + 0.0) / 3)
    assert measures["jerk_mean_mps3"] == pytest.approx((8.0 + 16.0) / 2)


def test_a_reset_is_no_deceleration() -> None:
    """A reset to rest at 1 m/s is left out, and the new start counts."""
    trajectory = log([0.05 * (i + 1) for i in range(20)], resets={9: 0.5})
    trajectory.speed[:, 0] = 1.0
    assert compute_metrics(episode(trajectory))["acceleration_mean_mps2"] == pytest.approx(
        (4.0 + 0.0 + 4.0 + 0.0) / 4
    )


def test_shares_of_episodes_count_an_episode_once() -> None:
    """Two collisions with people and one with a wall are one episode that hit a person, and one
    that hit something else."""
    hits = (
        failure("collision", "pedestrian"),
        failure("collision", "pedestrian"),
        failure("collision", "wall"),
    )
    measures = compute_metrics(episode(log([1.0, 2.0]), *hits))
    assert (
        measures["pedestrian_collision"],
        measures["other_collision"],
        measures["left_lane"],
    ) == (1.0, 1.0, 0.0)
    assert measures["failures_per_100m_route"] == 3.0


def test_the_nearest_of_a_success_is_absent_from_a_failure() -> None:
    """The paper averages the least distance over successful episodes only."""
    drive = log([50.0, 100.0], person_m=0.9)
    good, bad = (compute_metrics(episode(drive, ended=ended)) for ended in ("goal", "timeout"))
    assert (
        good["pedestrian_distance_min_success_m"],
        bad["pedestrian_distance_min_success_m"],
    ) == (0.9, None)
    assert bad["clearance_min_m"] == pytest.approx(0.25)
