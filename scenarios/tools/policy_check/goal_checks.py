"""Checks of how a policy uses its goal, on a straight sidewalk."""

from __future__ import annotations

import math
from typing import Final

from cosim.spec.goal import GOALS
from scenarios.tools.policy_check.outcome import CheckOutcome, doubted, failed, inapplicable, passed
from scenarios.tools.policy_check.query import ROUNDING, Answered, PolicyQuery, apart

_CLEAR_RAD: Final = 0.03
_HARDLY: Final = 0.01


def goal_zero(query: PolicyQuery) -> CheckOutcome:
    """Check that an empty goal does no harm: a point at its place, a black picture, no words."""
    if none := _without(query):
        return none
    ahead, zero = _answer_with_goal(query, "ahead"), _answer_with_goal(query, "zero")
    if zero.v_mps < -1e-3 or abs(zero.turn_rad) > math.pi / 2 + 1e-6:
        return doubted(
            f"turns back ({zero.v_mps:.2f} m/s, {zero.degrees}) when the goal is reached"
        )
    if zero.v_mps > 3.0 * max(ahead.v_mps, 0.3):
        return failed(
            f"a goal of zero: {zero.v_mps:.1f} m/s, one ahead: {ahead.v_mps:.1f}: something "
            f"is divided by 0"
        )
    return passed(
        f"{zero.v_mps:.2f} m/s, {zero.degrees}; with a goal ahead {ahead.v_mps:.2f} m/s, "
        f"{ahead.degrees}"
    )


def goal_scaled(query: PolicyQuery) -> CheckOutcome:
    """A point twice as far in the same direction: it drives no slower, and turns no farther."""
    if none := _without(query):
        return none
    if "near" not in query.goals:
        return inapplicable(f"a goal of {query.manifest.goal} has no scale")
    near, far = _answer_with_goal(query, "near"), _answer_with_goal(query, "left")
    said = (
        f"at 5.6 m {near.v_mps:.2f} m/s, {near.degrees}; at 11.2 m, there, {far.v_mps:.2f} m/s, "
        f"{far.degrees}"
    )
    if abs(far.turn_rad) > 1.5 * abs(near.turn_rad) + _CLEAR_RAD:
        return failed(f"{said}: it turns by metres in place of an angle")
    if near.v_mps > 0.2 and far.v_mps < 0.5 * near.v_mps:
        return failed(f"{said}: farther is slower; is the distance turned round, or its unit off?")
    if (
        near.turn_rad * far.turn_rad < 0.0
        and min(abs(near.turn_rad), abs(far.turn_rad)) > _CLEAR_RAD
    ):
        return failed(f"{said}: it turns to the other side")
    if apart(near, far) <= ROUNDING:
        return passed("how far the goal is does not matter to it, only where")
    return passed(said)


def goal_mirrored(query: PolicyQuery) -> CheckOutcome:
    """Check that a goal to the left turns it farther to the left than one to the right."""
    if none := _without(query):
        return none
    if "right" not in query.goals:
        return inapplicable(
            "whether a picture lies to the left cannot be known without knowing the place"
        )
    left, right = _answer_with_goal(query, "left"), _answer_with_goal(query, "right")
    turns = left.turn_rad - right.turn_rad
    said = f"goal left: {left.degrees}; goal right: {right.degrees}"
    if turns < -_CLEAR_RAD:
        return failed(f"{said}: the sides are exchanged; y is to the left")
    if turns < _CLEAR_RAD:
        return doubted(
            f"{said}: its side hardly matters; right for a policy that takes goals as a hint"
        )
    if abs(left.turn_rad + right.turn_rad) > 3.0 * turns:
        return doubted(
            f"{said}: both to one side; right where it keeps to one, else something is off "
            f"by a constant"
        )
    return passed(said)


def goal_ignored(query: PolicyQuery) -> CheckOutcome:
    """Check that another goal changes the answer."""
    if none := _without(query):
        return none
    ahead = _answer_with_goal(query, "ahead")
    most, name = max((apart(ahead, _answer_with_goal(query, name)), name) for name in query.goals)
    if most <= ROUNDING:
        return failed(
            f"no goal changes the answer: give the manifest goal 'none', or pass "
            f"{query.manifest.goal} on"
        )
    if most < _HARDLY:
        return doubted(
            f"goals change {100.0 * most:.1g} % of the answer at most: is their unit right?"
        )
    return passed(f"goal '{name}' changes {100.0 * most:.0f} % of the answer")


def _answer_with_goal(query: PolicyQuery, goal: str) -> Answered:
    return query.answer("straight", query.goals[goal])


def _without(query: PolicyQuery) -> CheckOutcome | None:
    """Return the outcome of a goal check that does not apply, else None."""
    kind = GOALS[query.manifest.goal]
    return (
        inapplicable(f"its goal says nothing of where to go: {kind.summary}")
        if kind.noise
        else None
    )
