"""Table of all policy checks by name, and their common result."""

from __future__ import annotations

import statistics
from collections.abc import Callable, Collection, Mapping
from types import MappingProxyType
from typing import Final, NamedTuple

from cosim.core.errors import PolicyError
from cosim.core.progress import Progress, ignore
from cosim.episode.policy_caller import PolicyCaller
from cosim.spec.manifest import Manifest
from scenarios.tools.policy_check.answer_checks import (
    behind,
    constant,
    deterministic,
    example,
    finite,
    history_reset,
    put_back,
    speed_unit,
    time_step,
)
from scenarios.tools.policy_check.drives import SceneName, ShownDrive
from scenarios.tools.policy_check.goal_checks import (
    goal_ignored,
    goal_mirrored,
    goal_scaled,
    goal_zero,
)
from scenarios.tools.policy_check.outcome import CheckEnded, CheckOutcome, failed, inapplicable
from scenarios.tools.policy_check.picture_checks import (
    colour_order,
    frame_order,
    person,
    picture_ignored,
    side,
    street_mirrored,
)
from scenarios.tools.policy_check.query import PolicyQuery
from scenarios.tools.policy_check.sensor_checks import lidar_ignored, people_ignored

POLICY_CHECKS: Final[Mapping[str, Callable[[PolicyQuery], CheckOutcome]]] = MappingProxyType(
    {
        "finite": finite,
        "example": example,
        "determinism": deterministic,
        "history_reset": history_reset,
        "put_back": put_back,
        "time_step": time_step,
        "unit": speed_unit,
        "behind": behind,
        "constant": constant,
        "picture_ignored": picture_ignored,
        "lidar_ignored": lidar_ignored,
        "people_ignored": people_ignored,
        "frame_order": frame_order,
        "colour_order": colour_order,
        "mirror": street_mirrored,
        "side": side,
        "person": person,
        "goal_zero": goal_zero,
        "goal_scaled": goal_scaled,
        "goal_mirrored": goal_mirrored,
        "goal_ignored": goal_ignored,
    }
)
"""Checks in their order. Those of crashes and randomness come first, since both spoil the
others.
"""

_BY_CHANCE: Final = ("finite", "example", "determinism", "unit", "behind")
"""Checks that apply to a policy whose answers are random."""


class CheckedPolicy(NamedTuple):
    """Outcomes by the names of the checks.

    query: for further queries.
    answer_ms: median duration of the answers, without first ones, in milliseconds.
    """

    query: PolicyQuery
    outcomes: Mapping[str, CheckOutcome]
    answer_ms: float
    answers: int

    def count(self, outcome: CheckEnded) -> int:
        return sum(one.outcome == outcome for one in self.outcomes.values())


def checked_policy(
    caller: PolicyCaller,
    manifest: Manifest,
    drives: Mapping[SceneName, ShownDrive],
    progress: Progress = ignore,
    only: Collection[str] = (),
) -> CheckedPolicy:
    """Run all checks of a policy, or these. manifest: with the goals of the run."""
    query = PolicyQuery(caller, manifest, drives, progress)
    outcomes: dict[str, CheckOutcome] = {}
    for name, check in POLICY_CHECKS.items():
        if only and name not in only:
            continue
        if (
            name not in _BY_CHANCE
            and "determinism" in outcomes
            and outcomes["determinism"].outcome == "failed"
        ):
            outcomes[name] = inapplicable("its answers change by chance: see `determinism`")
            continue
        try:
            outcomes[name] = check(query)
        except PolicyError as error:
            crashes = "finite" in outcomes and outcomes["finite"].outcome == "failed"
            outcomes[name] = (
                inapplicable("it crashes: see `finite`") if crashes else failed(str(error))
            )
    took = query.took_ms
    return CheckedPolicy(query, outcomes, statistics.median(took) if took else 0.0, len(took))
