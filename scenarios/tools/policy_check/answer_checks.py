"""Checks of the answers: they can be driven, and only relevant inputs change them."""

from __future__ import annotations

import math
from typing import Final

from cosim.core.clock import Clock
from cosim.core.errors import PolicyError, UsageError
from cosim.spec.robot import COURIER
from scenarios.tools.policy_check.drives import SCENES
from scenarios.tools.policy_check.edits import ALL_BLACK, ALL_WHITE, AT_REST, LATER, then
from scenarios.tools.policy_check.outcome import CheckOutcome, doubted, failed, inapplicable, passed
from scenarios.tools.policy_check.query import ROUNDING, PolicyQuery, apart

_FAST: Final = 1.5
"""Ratio to the top speed of the robot above which a speed is certainly a mistake."""
_SLOW_MPS: Final = 0.12
_SPIN_RADPS: Final = 5.0
_ASIDE_RAD: Final = math.radians(60.0)


def finite(query: PolicyQuery) -> CheckOutcome:
    """Answers are numbers that can be driven, also for a black or white picture and a robot at
    rest.
    """
    asked = [(scene, "") for scene in SCENES]
    asked += [("straight", name) for name in ("black", "white", "standing")]
    edits = {"black": ALL_BLACK, "white": ALL_WHITE, "standing": AT_REST}
    for scene, name in asked:
        try:
            query.answer(scene, *([edits[name]] if name else []))
        except PolicyError as error:
            return failed(f"{name or scene}: {error}")
    return passed(f"{len(asked)} drives answered")


def deterministic(query: PolicyQuery) -> CheckOutcome:
    """Check that equal observations with the same seed give the same answer."""
    straight, left = query.drives["straight"].seen, query.drives["left"].seen
    answers = []
    for _ in range(2):
        query.episode(left)
        answers.append(query.episode(straight))
    differ = max(map(apart, *answers))
    if differ > ROUNDING:
        return failed(
            f"queried twice with one seed: {differ:.2g} of the answer differs: draw chance "
            f"from reset's seed"
        )
    return passed("queried twice with one seed: the same")


def history_reset(query: PolicyQuery) -> CheckOutcome:
    """Check that an episode leaves no state for the next one."""
    drives = query.drives
    after = []
    for before in ("left", "right", "person"):
        query.episode(drives[before].seen)
        after.append(query.episode(drives["straight"].seen))
    pairs = [enumerate(zip(after[0], answers, strict=True)) for answers in after[1:]]
    differ, number = max((apart(one, two), number) for each in pairs for number, (one, two) in each)
    if differ > ROUNDING:
        return failed(
            f"answer {number} of an episode hangs on the episode before (by {differ:.2g}): "
            f"forget all of it in reset()"
        )
    return passed("answers do not hang on the episode before")


def put_back(query: PolicyQuery) -> CheckOutcome:
    """Check that no state of the earlier way is left after the robot is put back."""
    drives = query.drives
    clock = Clock.for_rate(query.manifest.rate_hz)
    rate_hz = query.manifest.rate_hz
    second = drives["straight"].seen
    after = [
        query.episode(then(drives[first].seen, second, clock, rate_hz))[-len(second) :]
        for first in ("left", "right", "person")
    ]
    differ = max(
        apart(one, two) for answers in after[1:] for one, two in zip(after[0], answers, strict=True)
    )
    if differ > ROUNDING:
        return doubted(
            f"put elsewhere, its answers still hang on what it saw before (by {differ:.2g}): right "
            "for one with a map of its own; a history of pictures begins again where an "
            "observation says `reset`, or in on_reset()"
        )
    return passed("put elsewhere, answers do not hang on what was before")


def time_step(query: PolicyQuery) -> CheckOutcome:
    """Check that the absolute time does not change the answer."""
    differ = apart(query.answer("left"), query.answer("left", LATER))
    if differ > ROUNDING:
        return failed(
            f"the same drive an hour later is answered otherwise (by {differ:.2g}): take steps of "
            "1 / rate_hz, or differences of time_s within an episode"
        )
    return passed("the same drive an hour later: the same answers")


def speed_unit(query: PolicyQuery) -> CheckOutcome:
    """Speeds are plausible on a sidewalk: a unit or time step that is wrong by ten is found."""
    answers = [query.answer(scene, query.plain) for scene in ("straight", "left", "right")]
    fastest = max(one.v_mps for one in answers)
    most = COURIER.v_max_mps
    slowest = min(one.v_mps for one in answers)
    turn = max(abs(one.turn_rad) for one in answers)
    way = "" if answers[0].waypoints is None else f" ({query.manifest.waypoints.in_words})"
    if slowest > _FAST * most:
        return failed(
            f"wants {slowest:.1f} m/s of a robot that drives {most:g}{way}: unit_m or dt_s is off"
        )
    if answers[0].waypoints is None and turn > _SPIN_RADPS:
        return failed(f"wants to turn by {turn:.1f} rad/s: degrees in place of radians?")
    if fastest == 0.0:
        return doubted(
            "stands on an empty sidewalk with the goal ahead: right for a policy that only stands"
        )
    if 0.0 < fastest < _SLOW_MPS:
        return failed(
            f"wants {fastest:.3f} m/s on an empty sidewalk at most{way}: unit_m or dt_s is off"
        )
    if fastest > most:
        return doubted(
            f"wants up to {fastest:.1f} m/s{way}, the robot drives {most:g}: it is always cut"
        )
    return passed(f"{slowest:.2f} to {fastest:.2f} m/s on an empty sidewalk{way}")


def behind(query: PolicyQuery) -> CheckOutcome:
    """Check that it drives ahead on an empty straight sidewalk, neither back nor to the side."""
    one = query.answer("straight", query.plain)
    if one.v_mps < -1e-3:
        return failed(
            f"wants to go back ({one.v_mps:.2f} m/s) on an empty straight sidewalk: x is "
            f"ahead, not y or -x"
        )
    if one.waypoints is not None and abs(one.turn_rad) > _ASIDE_RAD:
        return failed(
            f"goes {one.degrees} on an empty straight sidewalk: x is ahead and y left, not "
            f"the other way"
        )
    others = [scene for scene in SCENES if query.answer(scene).v_mps < -1e-3]
    if others:
        return doubted(f"wants to go back at {', '.join(others)}: the robot stands then")
    return passed(
        "the waypoint that is followed lies ahead"
        if one.waypoints is not None
        else "drives forward"
    )


def constant(query: PolicyQuery) -> CheckOutcome:
    """Check that different observations give different answers."""
    manifest = query.manifest
    if manifest.track == "blind" and manifest.goal == "none":
        return inapplicable("its observations have nothing to which it could respond")
    plain = query.answer("straight")
    others = [query.answer(scene) for scene in SCENES] + [
        query.answer("straight", edit) for edit in query.goals.values()
    ]
    if max(apart(plain, other) for other in others) <= ROUNDING:
        return failed("the same answer to every street and every goal")
    return passed("answers differ with what it is given")


def example(query: PolicyQuery) -> CheckOutcome:
    """Check that the graph of a bundle reproduces the example of its authors."""
    from cosim.policies.onnx.policy import OnnxPolicy, example_differences

    policy = query.policy
    if not isinstance(policy, OnnxPolicy):
        return inapplicable("it is no ONNX bundle")
    if not policy.example.exists():
        return doubted(
            f"{policy.example.name} is missing: this is valid, but it is unknown whether the "
            "graph is the right one"
        )
    try:
        found = example_differences(policy)
    except UsageError as error:
        return failed(str(error))
    if not found:
        return doubted(
            f"{policy.example.name} expects nothing: this is valid, but it is unknown whether "
            "the graph is the right one"
        )
    off = {name: differ for name, differ in found.items() if not differ <= ROUNDING}
    if off:
        return failed(
            ", ".join(f"{name} is off by up to {differ:.2g}" for name, differ in off.items())
        )
    return passed("the graph gives what the bundle's example expects")
