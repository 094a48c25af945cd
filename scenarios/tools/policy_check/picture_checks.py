"""Checks of how a policy uses its pictures. Goals contain no turn in any of them."""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from scenarios.tools.policy_check.drives import SCENES, SceneName
from scenarios.tools.policy_check.edits import ALL_BLACK, IN_MIRROR, SWAPPED, Edit, showing
from scenarios.tools.policy_check.outcome import CheckOutcome, doubted, failed, inapplicable, passed
from scenarios.tools.policy_check.query import ROUNDING, Answered, Asker, apart

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


def picture_ignored(asker: Asker) -> CheckOutcome:
    """Another picture, another answer."""
    if none := _blind(asker):
        return none
    plain = asker.answer("straight", asker.plain)
    others = [
        asker.answer("straight", asker.plain, _of(asker, scene))
        for scene in SCENES
        if scene != "straight"
    ]
    most = max(
        apart(plain, other) for other in [*others, asker.answer("straight", asker.plain, ALL_BLACK)]
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


def frame_order(asker: Asker) -> CheckOutcome:
    """The newest picture counts: it is not confused with an older one."""
    if none := _blind(asker):
        return none
    drive = asker.drives["left"]
    other = asker.drives["right"].seen
    plain = asker.answer("left", asker.plain)
    shown = [showing("right", other, (age,)) for age in range(len(drive.seen))]
    weights = np.array([apart(plain, asker.answer("left", asker.plain, edit)) for edit in shown])
    newest = float(weights[0])
    oldest = int(np.argmax(weights))
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
        f"the picture of {oldest} answers ago counts {weights[oldest] / newest:.1f} times as "
        f"much as the newest"
    )
    if weights[oldest] > _OLDER * newest:
        return failed(f"{said}: oldest and newest are exchanged")
    if weights[oldest] > 0.5 * (1.0 + _OLDER) * newest:
        return doubted(f"{said}: right for a policy that sees motion, else the order is wrong")
    return passed(f"the newest picture counts, older ones up to {matter[-1]} answers ago as well")


def colour_order(asker: Asker) -> CheckOutcome:
    """The policy reads the street in its own colours, not better with red and blue exchanged."""
    if none := _blind(asker):
        return none
    if (
        max(
            apart(asker.answer(s, asker.plain), asker.answer(s, asker.plain, SWAPPED))
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
        own = read(asker)
        swapped = read(asker, SWAPPED)
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


def street_mirrored(asker: Asker) -> CheckOutcome:
    """In a mirrored street it turns to the mirrored side."""
    if none := _blind(asker) or _aside(asker):
        return none
    turns = np.array(
        [[asker.answer(s, asker.plain, *e).turn_rad for e in ((), (IN_MIRROR,))] for s in SCENES]
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


def side(asker: Asker) -> CheckOutcome:
    """The policy turns farther to the left if the sidewalk leads left than if it leads right."""
    if none := _blind(asker) or _aside(asker):
        return none
    reads = _steers(asker)
    left, right = (asker.answer(scene, asker.plain) for scene in ("left", "right"))
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


def person(asker: Asker) -> CheckOutcome:
    """People in the way change the answer."""
    if none := _blind(asker):
        return none
    clear, stands = asker.answer("straight", asker.plain), asker.answer("person", asker.plain)
    said = f"empty way: {_words(clear)}; people 3 m ahead: {_words(stands)}"
    if apart(clear, stands) < _HARDLY:
        return doubted(f"{said}: right for a policy that was never shown people")
    return passed(said)


def _steers(asker: Asker, *edits: Edit) -> tuple[float, float]:
    """Return how much farther left the policy turns on a left way than on a right way.

    The second value is the same in a mirror.
    """
    turns = [
        [asker.answer(s, asker.plain, *more, *edits).turn_rad for s in _ASKEW]
        for more in _both(asker)
    ]
    return turns[0][0] - turns[0][1], (turns[1][1] - turns[1][0]) * (1 if _both(asker)[1] else -1)


def _brakes(asker: Asker, *edits: Edit) -> tuple[float, float]:
    """Return the share of its speed by which the policy brakes for people, also in a mirror."""
    speeds = [
        [asker.answer(s, asker.plain, *more, *edits).v_mps for s in _MET] for more in _both(asker)
    ]
    first, second = ((clear - stands) / max(abs(clear), 0.1) for clear, stands in speeds)
    return first, second


def _both(asker: Asker) -> tuple[tuple[Edit, ...], tuple[Edit, ...]]:
    """Return the street and its mirror; twice the street if a camera looks aside."""
    return (), () if _aside(asker) else (IN_MIRROR,)


def _of(asker: Asker, scene: SceneName) -> Edit:
    return showing(scene, asker.drives[scene].seen)


def _words(one: Answered) -> str:
    return f"{one.v_mps:.2f} m/s, {one.degrees}"


def _blind(asker: Asker) -> CheckOutcome | None:
    if asker.manifest.camera is None:
        return inapplicable("it has no camera")
    if asker.manifest.privileged:
        return inapplicable("it has privileged state and needs no picture")
    return None


def _aside(asker: Asker) -> CheckOutcome | None:
    """Return an outcome if a camera looks aside: in a mirror it sees another street."""
    for seen in asker.drives["straight"].seen[-1:]:
        for camera in [seen.camera, *(one.camera for one in seen.pictures.values())]:
            if camera is not None and (
                abs(camera.on_robot[1, 3]) > 0.05 or abs(camera.on_robot[1, 2]) > 0.05
            ):
                return inapplicable("one of its cameras looks aside or stands aside")
    return None
