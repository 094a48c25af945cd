"""What a run says of a policy as a whole: pooled rates, crashes, episodes that do not count."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pandas as pd
import pytest

from cosim.results.metrics import METRICS, UNKNOWN_WITH_CRASH, WORST
from cosim.results.table import summary_of, why_inconclusive


def table(*rows: tuple[float, float, float], crashed: int = 0, invalid: int = 0) -> pd.DataFrame:
    """metres travelled, failures, metres of route of each episode that is done; and so many
    others."""
    done = [
        dict.fromkeys(METRICS, None)
        | {
            "status": "done",
            "path_length_m": m,
            "rated_m": m,
            "failures": n,
            "route_length_m": way,
            "success": float(n == 0),
        }
        | {"failures_per_100m": 100.0 * n / m if m >= 1.0 else None}
        for m, n, way in rows
    ]
    others = [dict.fromkeys(METRICS, None) | WORST | {"status": "crashed"} for _ in range(crashed)]
    others += [dict.fromkeys(METRICS, None) | {"status": "invalid"} for _ in range(invalid)]
    return pd.DataFrame(done + others)


def test_a_rate_of_a_run_is_all_failures_on_all_metres() -> None:
    """2 m with 10 failures, 400 m with none, 0 m with 19: 29 on 402 m, not the mean of 500 and 0;
    and the one that stands counts on the way that it should have driven."""
    three = table((2.0, 10, 100.0), (400.0, 0, 400.0), (0.0, 19, 300.0))
    summary = summary_of(three, ["failures_per_100m", "failures_per_100m_route"])
    assert summary["mean"].tolist() == pytest.approx([100 * 29 / 402, 100 * 29 / 800])
    assert summary["n"].tolist() == [3, 3]
    assert summary["counted"].tolist() == [29, 29] and summary["metres"].tolist() == [402, 800]


def test_a_robot_that_never_moved_has_no_rate_but_failures_on_its_route() -> None:
    """Nothing travelled: no rate per 100 m travelled, and not 0."""
    stands = summary_of(table((0.0, 30, 300.0)), ["failures_per_100m", "failures_per_100m_route"])
    assert (
        np.isnan(stands.loc["failures_per_100m", "mean"])
        and stands.loc["failures_per_100m_route", "mean"] == 10.0
    )


@pytest.mark.parametrize(
    "name", ["failures_per_100m", "failures_per_100m_route", "collisions_per_100m"]
)
def test_who_crashes_before_it_fails_has_no_rate(name: str) -> None:
    """An episode given up cannot make a rate better: there is none."""
    rows: Sequence[tuple[float, float, float]] = [(300.0, 1, 300.0)] * 4
    assert np.isnan(summary_of(table(*rows, crashed=1), [name]).loc[name, "mean"])


def test_crashing_improves_no_metric_that_is_ranked() -> None:
    """Beside an episode that went badly, and alone: a crash makes each such mean worse, or there is
    none."""
    for name, metric in METRICS.items():
        if metric.higher_is_better is None:
            continue
        worst = WORST.get(name)
        assert (worst is None) == (name in UNKNOWN_WITH_CRASH), name
        one = table((300.0, 0, 300.0), crashed=1)
        one.loc[0, name] = 0.4
        both, crash = (summary_of(part, [name]).loc[name] for part in (one, one[1:]))
        if worst is None:
            assert both["n"] == crash["n"] == 0 and np.isnan([both["mean"], crash["mean"]]).all()
        else:
            assert metric.higher_is_better and crash["mean"] == worst == 0.0, name
            assert both["mean"] == 0.2, name


def test_a_crash_touches_and_leaves_nothing() -> None:
    """No person, thing, edge or rule of a crashed episode is counted, and its row has no count of
    them."""
    assert {*WORST} == {"success", "goal_reached", "route_completion", "spl", "velocity_mean_mps"}
    shares = {name for name, metric in METRICS.items() if metric.share}
    assert shares == {
        "success",
        "goal_reached",
        "pedestrian_collision",
        "other_collision",
        "left_lane",
        "broke_rule",
    }


def test_an_invalid_episode_is_in_no_mean_and_two_in_a_hundred_spoil_a_table() -> None:
    """The denominator is what was scheduled less what is invalid; more than 2 % of that, and nobody
    is to quote it."""
    few = table(*[(10.0, 0, 10.0)] * 98, invalid=2)
    assert (
        summary_of(few, ["success"]).loc["success", "n"] == 98 and why_inconclusive(few, 100) == ""
    )
    many = table(*[(10.0, 0, 10.0)] * 97, invalid=3)
    assert why_inconclusive(many, 100) == "3 of 100 scheduled episodes are invalid, more than 2 %"
    assert why_inconclusive(few, 120) == "20 of 120 scheduled episodes have not ended"
