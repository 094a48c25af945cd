"""Rewards of an episode, against hand-computed cases."""

from __future__ import annotations

import msgspec
import numpy as np
import pytest

from cosim.policies.load import load_policy
from cosim.results.record import Record, RedLightEntry, TriggeredEvent
from cosim.results.referee import Failure
from scenarios.episodes.reward import row_rewards, tick_rewards
from scenarios.suites.catalog import load_suite
from tests.logs import log_with
from tests.run_specs import record_of

TIME = -0.2 * 0.05


def record_with(**changes: object) -> Record:
    record = record_of(load_suite("unit").scenarios[0], load_policy("stop").manifest)
    return msgspec.structs.replace(record, **changes)


def test_only_new_ground_counts_and_failures_cost_more_than_they_save() -> None:
    """Driving back and forth and resets ahead are no progress, and only the tick of a failure or
    red light has its cost."""
    resets = np.full(8, np.nan)
    resets[4] = 5.0
    log = log_with(
        8, route_s_m=np.array([1.0, 2.0, 1.0, 2.0, 3.0, 5.0, 6.0, 6.5]), reset_s_m=resets
    )
    hit = Failure("collision", 4, 0.0, 0.0, 3.0, 1.0, "x", "prop")
    record = record_with(
        status="done",
        ended="goal",
        measures={"success": 0.0},
        failures=(hit,),
        red_light_entries=(RedLightEntry(6, "c"),),
    )
    gained = np.array([1.0, 1.0, 0.0, 0.0, 1.0 - 20.0, 0.0, 1.0 - 10.0, 0.5])
    np.testing.assert_allclose(tick_rewards(record, log), gained + TIME)
    rows = row_rewards(record, log, np.array([0, 4]))
    np.testing.assert_allclose(rows[:, 0], [2.0 + 4 * TIME, -27.5 + 4 * TIME], rtol=1e-6)


@pytest.mark.parametrize(
    ("changes", "tick", "reward"),
    [
        ({"ended": "goal", "measures": {"success": 1.0}}, 5, 10.0),
        ({"ended": "timeout", "measures": {"success": 0.0}}, 5, -20.0),
        (
            {
                "ended": "goal",
                "measures": {"success": 0.0},
                "events": (
                    TriggeredEvent(
                        id="e", kind="crossing", passed=True, rule_met=False, passed_at_s=0.15
                    ),
                ),
            },
            2,
            -20.0,
        ),
    ],
    ids=["success", "timeout", "broken rule"],
)
def test_an_end_has_its_reward(changes: dict[str, object], tick: int, reward: float) -> None:
    """A success is rewarded at the last tick, a timeout costs as much as a failure, and a broken
    rule costs where the person was passed."""
    log = log_with(6, reset_s_m=np.full(6, np.nan))
    wanted = np.full(6, TIME)
    wanted[tick] += reward
    np.testing.assert_allclose(tick_rewards(record_with(status="done", **changes), log), wanted)
