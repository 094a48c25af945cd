"""Verdict: the differences from the shipped results, their cause, and the remedy, as text."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from types import MappingProxyType
from typing import Final, NamedTuple

from cosim.core.clock import Clock
from scenarios.tools.verify.engines import DRIVER
from scenarios.tools.verify.shipped import Results
from scenarios.tools.verify.traces import DIGITS, PARTS, Trace

SAME_LABELS: Final = 0.995
SAME_LEVELS: Final = 12.0
"""Tolerances for another driver of OpenGL: least share of equal labels, and largest difference of
the mean of a block of 8 x 8 pixels, of 255 levels.
"""
_REINSTALL: Final = "pip install --require-hashes -r requirements.lock"


class Finding(NamedTuple):
    """Result of one comparison. part: key of BLAMES; "" if it is as shipped or has its own
    remedy.
    """

    name: str
    fine: bool
    words: str
    part: str = ""


class Blame(NamedTuple):
    """Dependencies of a part.

    engine: task that is checked separately.
    packages: installed packages.
    sources: packages of this project.
    """

    name: str
    engine: str
    packages: tuple[str, ...]
    sources: tuple[str, ...]


_DRAWN_BY: Final = (
    *("physics/cameras", "physics/people", "physics/street", "physics/ground"),
    "physics/dynamics",
)
_OF_PEOPLE: Final = ("scenarios/events", "cosim/people", "scenarios/episodes", "bridge")
_OF_POLICIES: Final = ("cosim/policies", "cosim/people", "cosim/episode")
_OF_THE_CROWD: Final = ("sumo_nets/crowd", "sumo_nets/net", "cosim/people")
_OF_THE_WORLD: Final = ("physics/dynamics", "physics/robots", "physics/street")
BLAMES: Final[Mapping[str, Blame]] = MappingProxyType(
    {
        "policy": Blame("the policy", "C library", ("numpy", "scipy", "shapely"), _OF_POLICIES),
        "events": Blame("our event pedestrians", "numpy", ("numpy", "eclipse-zenoh"), _OF_PEOPLE),
        "crowd": Blame("the crowd", "SUMO", ("libsumo", "eclipse-sumo", "numpy"), _OF_THE_CROWD),
        "robot": Blame("the robot's physics", "PyBullet", ("pybullet", "numpy"), _OF_THE_WORLD),
        "referee": Blame(
            "the referee", "shapely", ("numpy", "shapely"), ("cosim/results", "cosim/place")
        ),
        "metrics": Blame("the metrics", "numpy", ("numpy", "scipy"), ("cosim/results",)),
        "bullet": Blame("the bullet camera", "TinyRenderer", ("pybullet",), _DRAWN_BY),
        "gl": Blame(
            "the gl camera", DRIVER, ("moderngl", "glcontext"), (*_DRAWN_BY, "physics/textures")
        ),
        "textures": Blame(
            "the textures", "numpy", ("numpy", "opencv-python-headless"), ("physics/textures",)
        ),
    }
)


def findings(shipped: Results, here: Results) -> Iterator[Finding]:
    """Yield the comparisons in order: packages, suites, engines, textures, cases."""
    yield from _packages(shipped, here)
    for name, expected in shipped.suites.items():
        found = here.suites.get(name, "missing")
        remedy = f"{found} here, {expected} as shipped: it was edited. Take it as it was shipped"
        yield Finding(f"suite {name}", found == expected, expected if found == expected else remedy)
    for name, expected in shipped.alone.items():
        yield _engine(name, expected, here)
    changed = [
        name for name, expected in shipped.textures.items() if here.textures.get(name) != expected
    ]
    words = f"{len(shipped.textures)} as shipped" if not changed else f"differ: {_few(changed)}"
    yield Finding("textures", not changed, words, "textures" if changed else "")
    for case, trace in here.traces.items():
        yield from _case(case, shipped.traces.get(case), trace, shipped, here)


def _packages(shipped: Results, here: Results) -> Iterator[Finding]:
    others = {
        n: (here.versions.get(n, "none"), v)
        for n, v in shipped.versions.items()
        if here.versions.get(n) != v
    }
    others.pop("arithmetic", None)
    for name, (found, expected) in others.items():
        yield Finding(
            f"package {name}", False, f"{found} here, {expected} as shipped: {_REINSTALL}"
        )
    if not others:
        yield Finding("packages", True, f"{len(shipped.versions) - 1} of the shipped versions")


def _engine(name: str, expected: str, here: Results) -> Finding:
    found = here.alone.get(name)
    if found == expected:
        return Finding(f"{name} alone", True, "as shipped")
    if name != DRIVER:
        return Finding(
            f"{name} alone", False, "gives something else: the engine itself, none of our code"
        )
    if found is None:
        return Finding(
            name,
            True,
            "none here: the gl camera is not verified (`cosim doctor` says what to install)",
        )
    return Finding(
        name, True, f"another one, so pictures by gl may differ a little: {here.renderer}"
    )


def _case(
    case: str, expected: Trace | str | None, found: Trace | str, shipped: Results, here: Results
) -> Iterator[Finding]:
    if isinstance(found, str):
        yield Finding(case, False, f"cannot be run: {found}")
        return
    if not isinstance(expected, Trace) or expected.scenario_hash != found.scenario_hash:
        yield Finding(
            case, False, "is not the scenario that was shipped: take its suite as it was shipped"
        )
        return
    part, tick = first_difference(expected, found)
    if part:
        at = "before it begins" if tick < 0 else f"at {Clock().time_s(tick):.2f} s"
        yield Finding(
            case, False, f"{BLAMES[part].name} first, {at}; what follows hangs on it", part
        )
        return
    if others := [
        name for name, value in expected.measures.items() if found.measures.get(name, "") != value
    ]:
        yield Finding(
            case, False, f"the same to the bit, but not measured so: {_few(others)}", "metrics"
        )
        return
    kinds = [
        _picture(camera, expected, found, shipped, here)
        for camera in expected.pictures
        if camera in found.pictures
    ]
    for camera, fine, words in kinds:
        if not fine:
            yield Finding(
                case,
                False,
                f"the same to the bit, but its picture by {camera} is not: {words}",
                camera,
            )
            return
    seen = ", ".join(f"{camera} {words}" for camera, _, words in kinds)
    ticks = len(found.ticks["robot"]) // DIGITS - 1
    numbers = len(expected.measures)
    yield Finding(case, True, f"{ticks} ticks and {numbers} numbers to the bit; pictures: {seen}")


def first_difference(expected: Trace, found: Trace) -> tuple[str, int]:
    """Return the first part that differs and its tick, -1 before the first one; "" if none
    differs.
    """
    length = max(len(expected.ticks["robot"]), len(found.ticks["robot"]))
    for at in range(0, length, DIGITS):
        for part in PARTS:
            if expected.ticks[part][at : at + DIGITS] != found.ticks[part][at : at + DIGITS]:
                return part, at // DIGITS - 1
    return ("robot", length // DIGITS - 1) if expected.state_hash != found.state_hash else ("", 0)


def _picture(
    camera: str, expected: Trace, found: Trace, shipped: Results, here: Results
) -> tuple[str, bool, str]:
    one, other = expected.pictures[camera], found.pictures[camera]
    if one.hash == other.hash:
        return camera, True, "to the bit"
    labels, levels = one.beside(other)
    words = f"{100.0 * labels:.2f} % of the labels, {levels:.0f} levels of 255"
    engine = BLAMES[camera].engine
    drawn_alike = shipped.alone.get(engine) == here.alone.get(engine)
    return camera, not drawn_alike and labels >= SAME_LABELS and levels <= SAME_LEVELS, words


def blamed(found: list[Finding], shipped: Results, here: Results) -> Iterator[str]:
    """Yield for each differing part its cause and the remedy."""
    for part in dict.fromkeys(one.part for one in found if one.part):
        yield f"{BLAMES[part].name}: {_blame(BLAMES[part], shipped, here)}"


def _blame(of: Blame, shipped: Results, here: Results) -> str:
    others = [
        f"{name} {here.versions.get(name, 'none')} here, {expected} as shipped"
        for name, expected in shipped.versions.items()
        if name in (*of.packages, "arithmetic", "geos") and here.versions.get(name) != expected
    ]
    edited = [
        source for source in of.sources if here.sources.get(source) != shipped.sources.get(source)
    ]
    alike = shipped.alone.get(of.engine) == here.alone.get(of.engine)
    reasons = [
        f"{of.engine} alone gives what it should, so it is ours"
        if alike
        else f"{of.engine} alone gives something else, too",
        *others,
        f"the source of {', '.join(edited)} is not the shipped one" if edited else "",
    ]
    if others or not alike:
        remedy = _REINSTALL
    elif edited:
        remedy = "take the source as it was shipped (`git status`, `git diff`; or install again)"
    else:
        names = ", ".join(of.sources)
        remedy = f"something changes {names} as they run: report it, with the lines above"
    return "; ".join(filter(None, reasons)) + f". Remedy: {remedy}"


def _few(names: list[str]) -> str:
    return ", ".join(names[:4]) + (f" and {len(names) - 4} more" if len(names) > 4 else "")
