"""The summary of a run: pooled rates, crashes, and invalid episodes."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pandas as pd
import pytest

from cosim.results.metrics import METRICS, UNKNOWN_WITH_CRASH, WORST
from cosim.results.table import summary_of, why_inconclusive


def table(*rows: tuple[float, float, float], crashed: int = 0, invalid: int = 0) -> pd.DataFrame:
    """The table of finished episodes with metres travelled, failures and route metres, and of
    others by status."""
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
    """10, 0 and 19 failures on 2, 400 and 0 m are 29 on 402 m travelled and on 800 m of route."""
    three = table((2.0, 10, 100.0), (400.0, 0, 400.0), (0.0, 19, 300.0))
    summary = summary_of(three, ["failures_per_100m", "failures_per_100m_route"])
    assert summary["mean"].tolist() == pytest.approx([100 * 29 / 402, 100 * 29 / 800])
    assert summary["n"].tolist() == [3, 3]
    assert summary["counted"].tolist() == [29, 29] and summary["metres"].tolist() == [402, 800]


def test_a_robot_that_never_moved_has_no_rate_but_failures_on_its_route() -> None:
    """Without travel there is no rate per 100 m travelled, rather than 0."""
    stands = summary_of(table((0.0, 30, 300.0)), ["failures_per_100m", "failures_per_100m_route"])
    assert (
        np.isnan(stands.loc["failures_per_100m", "mean"])
        and stands.loc["failures_per_100m_route", "mean"] == 10.0
    )


@pytest.mark.parametrize(
    "name", ["failures_per_100m", "failures_per_100m_route", "collisions_per_100m"]
)
def test_a_crash_before_a_failure_leaves_no_rate(name: str) -> None:
    """An aborted episode cannot improve a rate."""
    rows: Sequence[tuple[float, float, float]] = [(300.0, 1, 300.0)] * 4
    assert np.isnan(summary_of(table(*rows, crashed=1), [name]).loc[name, "mean"])


def test_a_crash_improves_no_ranked_metric() -> None:
    """Beside a bad episode, and alone, a crash makes each such mean worse or absent."""
    for name, metric in METRICS.items():
        if metric.higher_is_better is None:
            continue
        worst = WORST.get(name)
        assert (worst is None) == (name in UNKNOWN_WITH_CRASH), name
        crashed_once = table((300.0, 0, 300.0), crashed=1)
        crashed_once.loc[0, name] = 0.4
        both, crash = (
            summary_of(part, [name]).loc[name] for part in (crashed_once, crashed_once[1:])
        )
        if worst is None:
            assert both["n"] == crash["n"] == 0 and np.isnan([both["mean"], crash["mean"]]).all()
        else:
            assert metric.higher_is_better and crash["mean"] == worst == 0.0, name
            assert both["mean"] == 0.2, name


def test_a_crash_adds_to_no_count() -> None:
    """No person, obstacle, edge or rule of a crashed episode is counted, and its row has no counts."""
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


def test_invalid_episodes_are_in_no_mean_and_over_2_percent_make_it_inconclusive() -> None:
    """The denominator excludes them, and above 2 %, or with unfinished episodes, the table is
    inconclusive."""
    few = table(*[(10.0, 0, 10.0)] * 98, invalid=2)
    assert (
        summary_of(few, ["success"]).loc["success", "n"] == 98 and why_inconclusive(few, 100) == ""
    )
    many = table(*[(10.0, 0, 10.0)] * 97, invalid=3)
    assert why_inconclusive(many, 100) == "3 of 100 scheduled episodes are invalid, more than 2 %"
    assert why_inconclusive(few, 120) == "20 of 120 scheduled episodes have not ended"
