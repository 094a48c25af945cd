"""Checks of how a policy uses its pictures. Goals contain no turn in any of them."""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from scenarios.tools.policy_check.drives import SCENES, SceneName
from scenarios.tools.policy_check.edits import ALL_BLACK, IN_MIRROR, SWAPPED, Edit, showing
from scenarios.tools.policy_check.outcome import CheckOutcome, doubted, failed, inapplicable, passed
from scenarios.tools.policy_check.query import ROUNDING, Answered, PolicyQuery, apart

_OLDER: Final = 3.0
"""Ratio to the weight of the newest picture above which an older one is taken for the newest."""
_LEFTOVER: Final = 3.0
_CLEAR_RAD: Final = 0.05
_READS_RAD: Final = 0.1
_BRAKES: Final = 0.15
_HARDLY: Final = 0.01
_AGREE: Final = 6.0
"""Largest ratio between the reactions in the street and in its mirror."""
_ASKEW: Final[tuple[SceneName, ...]] = ("left", "right")
_MET: Final[tuple[SceneName, ...]] = ("straight", "person")


def picture_ignored(query: PolicyQuery) -> CheckOutcome:
    """Check that another picture changes the answer."""
    if none := _blind(query):
        return none
    plain = query.answer("straight", query.plain)
    others = [
        query.answer("straight", query.plain, _of(query, scene))
        for scene in SCENES
        if scene != "straight"
    ]
    most = max(
        apart(plain, other) for other in [*others, query.answer("straight", query.plain, ALL_BLACK)]
    )
    if most <= ROUNDING:
        return failed(
            "no picture changes the answer, not even a black one: scaled twice? If it is "
            "blind: camera=None"
        )
    if most < _HARDLY:
        return doubted(
            f"pictures change {100.0 * most:.1g} % of the answer at most: are they "
            f"normalised right?"
        )
    return passed(f"another picture changes {100.0 * most:.0f} % of the answer")


def frame_order(query: PolicyQuery) -> CheckOutcome:
    """Check that the newest picture has more effect than older ones."""
    if none := _blind(query):
        return none
    drive = query.drives["left"]
    other = query.drives["right"].seen
    plain = query.answer("left", query.plain)
    shown = [showing("right", other, (age,)) for age in range(len(drive.seen))]
    weights = np.array([apart(plain, query.answer("left", query.plain, edit)) for edit in shown])
    newest = float(weights[0])
    strongest = int(np.argmax(weights))
    matter = np.flatnonzero(weights > ROUNDING)
    if not len(matter):
        return inapplicable("no single picture changes the answer")
    if newest <= ROUNDING:
        return failed(
            f"the newest picture changes nothing, that of {matter[0]} answers ago does: the "
            "history is read before the picture is added, or in the wrong order"
        )
    if list(matter) == [0]:
        return inapplicable("only the newest picture matters: it has no history")
    said = (
        f"the picture of {strongest} answers ago counts {weights[strongest] / newest:.1f} times as "
        f"much as the newest"
    )
    if weights[strongest] > _OLDER * newest and strongest == matter[-1]:
        return failed(f"{said}: oldest and newest are exchanged")
    if weights[strongest] > 0.5 * (1.0 + _OLDER) * newest:
        return doubted(
            f"{said}: right for a policy that sees motion or has a memory, else the order is wrong"
        )
    return passed(f"the newest picture counts, older ones up to {matter[-1]} answers ago as well")


def colour_order(query: PolicyQuery) -> CheckOutcome:
    """The policy reads the street in its own colours, not better with red and blue exchanged."""
    if none := _blind(query):
        return none
    if (
        max(
            apart(query.answer(s, query.plain), query.answer(s, query.plain, SWAPPED))
            for s in SCENES
        )
        <= ROUNDING
    ):
        return passed("colours do not matter to it")
    said = []
    doubt = False
    for name, least, unit, read in (
        ("turns", _READS_RAD, " rad", _steers),
        ("brakes", _BRAKES, "", _brakes),
    ):
        own = read(query)
        swapped = read(query, SWAPPED)
        if min(swapped) > least and max(own) < min(swapped) / 3.0:
            return failed(
                f"{name} where it should with red and blue exchanged ({min(swapped):.2f}{unit}) "
                f"and hardly as it is ({max(own):.2f}): it takes BGR for RGB"
            )
        doubt |= min(swapped) > least and sum(own) < 0.7 * sum(swapped)
        said.append(
            f"{name} {sum(own) / 2:.2f}{unit}, red and blue exchanged {sum(swapped) / 2:.2f}"
        )
    words = "; ".join(said)
    return (
        doubted(f"{words}: it reads the street better in wrong colours") if doubt else passed(words)
    )


def street_mirrored(query: PolicyQuery) -> CheckOutcome:
    """Check that it turns to the mirrored side in a mirrored street."""
    if none := _blind(query) or _aside(query):
        return none
    turns = np.array(
        [[query.answer(s, query.plain, *e).turn_rad for e in ((), (IN_MIRROR,))] for s in SCENES]
    )
    kept = float(np.sqrt(np.mean(turns.sum(axis=1) ** 2))) / 2.0
    follows = float(np.sqrt(np.mean((turns[:, 0] - turns[:, 1]) ** 2))) / 2.0
    said = (
        f"{math.degrees(follows):.0f} deg turn to the other side in a mirror, "
        f"{math.degrees(kept):.0f} deg do not"
    )
    if kept > 2.0 * _CLEAR_RAD and kept > _LEFTOVER * follows:
        return failed(
            f"{said}: it is off to one side by a constant; is y counted from the picture's middle?"
        )
    if kept > _CLEAR_RAD and kept > follows:
        return doubted(f"{said}: right for a policy that keeps to one side")
    return passed(said)


def side(query: PolicyQuery) -> CheckOutcome:
    """Check that it turns farther to the left if the sidewalk leads left than if it leads right."""
    if none := _blind(query) or _aside(query):
        return none
    reads = _steers(query)
    left, right = (query.answer(scene, query.plain) for scene in ("left", "right"))
    said = f"the way leads left: {left.degrees}; right: {right.degrees}"
    if max(reads) < -_CLEAR_RAD and min(reads) > _AGREE * max(reads):
        return failed(
            f"{said}; so in a mirror: the picture or its answer is flipped, or it cannot "
            f"read this street"
        )
    if sum(reads) < 2.0 * _CLEAR_RAD:
        return doubted(
            f"{said}: it does not follow this sidewalk; right for one that follows its goal"
        )
    return passed(said)


def person(query: PolicyQuery) -> CheckOutcome:
    """Check that people in the way change the answer."""
    if none := _blind(query):
        return none
    clear, stands = query.answer("straight", query.plain), query.answer("person", query.plain)
    said = f"empty way: {_words(clear)}; people 3 m ahead: {_words(stands)}"
    if apart(clear, stands) < _HARDLY:
        return doubted(f"{said}: right for a policy that was never shown people")
    return passed(said)


def _steers(query: PolicyQuery, *edits: Edit) -> tuple[float, float]:
    """Return how much farther left the policy turns on a left way than on a right way.

    The second value is the same in a mirror.
    """
    turns = [
        [query.answer(s, query.plain, *more, *edits).turn_rad for s in _ASKEW]
        for more in _both(query)
    ]
    return turns[0][0] - turns[0][1], (turns[1][1] - turns[1][0]) * (1 if _both(query)[1] else -1)


def _brakes(query: PolicyQuery, *edits: Edit) -> tuple[float, float]:
    """Return the share of its speed by which the policy brakes for people, also in a mirror."""
    speeds = [
        [query.answer(s, query.plain, *more, *edits).v_mps for s in _MET] for more in _both(query)
    ]
    first, second = ((clear - stands) / max(abs(clear), 0.1) for clear, stands in speeds)
    return first, second


def _both(query: PolicyQuery) -> tuple[tuple[Edit, ...], tuple[Edit, ...]]:
    """Return the street and its mirror; twice the street if a camera looks aside."""
    return (), () if _aside(query) else (IN_MIRROR,)


def _of(query: PolicyQuery, scene: SceneName) -> Edit:
    return showing(scene, query.drives[scene].seen)


def _words(one: Answered) -> str:
    return f"{one.v_mps:.2f} m/s, {one.degrees}"


def _blind(query: PolicyQuery) -> CheckOutcome | None:
    if query.manifest.camera is None:
        return inapplicable("it has no camera")
    if query.manifest.privileged:
        return inapplicable("it has privileged state and needs no picture")
    return None


def _aside(query: PolicyQuery) -> CheckOutcome | None:
    """Return an outcome if a camera looks aside: in a mirror it sees another street."""
    for seen in query.drives["straight"].seen[-1:]:
        for camera in [seen.camera, *(one.camera for one in seen.pictures.values())]:
            if camera is not None and (
                abs(camera.on_robot[1, 3]) > 0.05 or abs(camera.on_robot[1, 2]) > 0.05
            ):
                return inapplicable("one of its cameras looks aside or is mounted aside")
    return None
