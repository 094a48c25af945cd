"""Repair signals whose crossings never have green, or too short a green.

Crossings without green get an additional pedestrian phase; short greens are extended.
"""

from __future__ import annotations

import math
import xml.etree.ElementTree as ET
from collections import defaultdict
from collections.abc import Mapping
from typing import Final

from sumo_nets.city.signals import ALL_RED_S, CLEARING_MPS, WALK_S, YELLOW_S
from sumo_nets.net.net_facts import crossing_links, crossing_signals
from sumo_nets.net.signal_plans import (
    GREEN_LETTERS,
    REACTION_S,
    WALK_MPS,
    greens,
    required_green_s,
)

PLAIN_TYPES = ("static", "actuated", "delay_based")
"""Program types that run their phases in order, so that one can be added."""
_SHORTEST_S: Final = 10.0
"""Other greens are not shortened below this duration, seconds."""
_PHASE: Final = frozenset(("duration", "state", "name"))
_LEAVING: Final = frozenset("yYuU")
"""Letters of links that are about to stop or start."""


def repair_signals(root: ET.Element) -> list[str]:
    """Add a phase, in place, for every crossing without green. Return the changes, a sentence
    each."""
    never = crossing_signals(root).never
    links = crossing_links(root)
    lengths = {
        e.get("id"): float(e[0].get("length", "0"))
        for e in root.iter("edge")
        if e.get("id") in never and len(e)
    }
    missing: dict[str, dict[int, float]] = defaultdict(dict)
    for crossing in never:
        signal, link = links[crossing]
        missing[signal][link] = lengths.get(crossing, 0.0)
    mended, left = list[str](), list[str]()
    for logic in root.iter("tlLogic"):
        waiting = missing.get(logic.get("id", ""))
        if waiting:
            (mended if _add_walk(logic, waiting) else left).append(logic.get("id", ""))
    changes = []
    if mended:
        names = ", ".join(dict.fromkeys(mended))
        changes.append(
            f"signals that never let people cross got a walk phase at the end of each cycle: "
            f"{names}"
        )
    if left:
        names = ", ".join(dict.fromkeys(left))
        changes.append(
            f"signals that never let people cross, left as they are (programs of a special "
            f"kind): {names}"
        )
    return changes


def _add_walk(logic: ET.Element, waiting: dict[int, float]) -> bool:
    """Append yellow, all red, walk, and all red until the longest crossing is cleared. Return
    success."""
    phases = logic.findall("phase")
    plain = logic.get("type", "static") in PLAIN_TYPES and not any(
        "next" in phase.attrib for phase in phases
    )
    states = [phase.get("state", "") for phase in phases]
    if not plain or not states or any(len(state) != len(states[0]) for state in states):
        return False
    if max(waiting) >= len(states[0]):
        return False
    longest_m = max(waiting.values())
    stop = "r" * len(states[0])
    walk = "".join("G" if i in waiting else "r" for i in range(len(stop)))
    yellow = "".join("y" if letter in "GgyY" else "r" for letter in states[-1])
    clearing_s = math.ceil(longest_m / CLEARING_MPS)
    rows = [(ALL_RED_S, stop), (max(WALK_S, math.ceil(0.6 * longest_m)), walk), (clearing_s, stop)]
    for duration_s, state in [(YELLOW_S, yellow)] * ("y" in yellow) + rows:
        if duration_s > 0:
            ET.SubElement(logic, "phase", {"duration": str(duration_s), "state": state})
    return True


def extend_greens(root: ET.Element) -> list[str]:
    """Extend too short greens of crossings, in place. Return the changes, a sentence each.

    Phases and their states are unchanged, so no conflict is added. Seconds are taken from long
    phases of the same program if possible; otherwise the cycle gets longer. Only fixed programs are
    changed.
    """
    needs = _required_green_s(root)
    switched = any(element.tag.startswith("WAUT") for element in root)
    programs: dict[str, list[ET.Element]] = defaultdict(list)
    for logic in root.iter("tlLogic"):
        programs[logic.get("id", "")].append(logic)
    changed = list[str]()
    grown = list[float]()
    left = list[str]()
    crossings = 0
    longest_s = 0.0
    for signal, wanted in needs.items():
        plans = [(logic, _durations_s(logic)) for logic in programs[signal]]
        short = {link for logic, _ in plans for link in _short_links(logic, wanted)}
        if not short:
            continue
        made = (
            []
            if switched
            else [_lengthened(logic, durations, wanted) for logic, durations in plans if durations]
        )
        if len(made) < len(plans) or None in made:
            left.append(signal)
            continue
        for (logic, before), after in zip(plans, made, strict=True):
            for phase, duration_s in zip(logic.findall("phase"), after or (), strict=True):
                phase.set("duration", f"{duration_s:g}")
            grown.append(sum(after or ()) - sum(before or ()))
            longest_s = max(
                longest_s, *(b - a for a, b in zip(before or (), after or (), strict=True))
            )
        changed.append(signal)
        crossings += len(short)
    changes = []
    if changed:
        longer = [more for more in grown if more > 0.0]
        cycles = (
            f"{len(longer)} cycles are up to {max(longer):g} s longer"
            if longer
            else "no cycle is longer"
        )
        changes.append(
            f"green too short to walk at {WALK_MPS:g} m/s after {REACTION_S:g} s: longer for "
            f"{crossings} crossings of {len(changed)} signals, by up to {longest_s:g} s; {cycles}"
        )
    if left:
        names = ", ".join(left[:4]) + (" ..." if len(left) > 4 else "")
        changes.append(
            f"green too short to walk at {len(left)} signals, left as it is (not a fixed "
            f"program): {names}"
        )
    return changes


def _required_green_s(root: ET.Element) -> dict[str, dict[int, float]]:
    """Return the seconds of green that each crossing needs, by signal and link."""
    lengths_m = {
        e.get("id", ""): float(e[0].get("length", "0")) for e in root.iter("edge") if len(e)
    }
    needs: dict[str, dict[int, float]] = defaultdict(dict)
    for crossing, (signal, link) in crossing_links(root).items():
        need_s = required_green_s(lengths_m.get(crossing, 0.0))
        needs[signal][link] = max(need_s, needs[signal].get(link, 0.0))
    return dict(needs)


def _durations_s(logic: ET.Element) -> list[float] | None:
    """Return the durations of a fixed program, seconds; None for others."""
    phases = logic.findall("phase")
    states = {len(phase.get("state", "")) for phase in phases}
    if (
        logic.get("type") != "static"
        or len(states) != 1
        or any(set(phase.attrib) - _PHASE for phase in phases)
    ):
        return None
    if any(child.tag not in ("phase", "param") for child in logic):
        return None
    try:
        durations = [float(phase.get("duration", "")) for phase in phases]
    except ValueError:
        return None
    return durations if all(0.0 <= d < math.inf for d in durations) else None


def _short_links(logic: ET.Element, wanted: Mapping[int, float]) -> list[int]:
    """Return the links of a program with too short a green, as far as durations can be read."""
    phases = logic.findall("phase")
    try:
        durations = [float(phase.get("duration", "")) for phase in phases]
    except ValueError:
        return []
    states = [phase.get("state", "") for phase in phases]
    return [
        link
        for link, need_s in wanted.items()
        if any(sum(durations[p] for p in run) < need_s - 1e-6 for run in greens(states, link))
    ]


def _lengthened(
    logic: ET.Element, durations: list[float], wanted: Mapping[int, float]
) -> list[float] | None:
    """Return durations with sufficient greens; None if a green cannot be extended."""
    states = [phase.get("state", "") for phase in logic.findall("phase")]
    runs = [(run, need_s) for link, need_s in wanted.items() for run in greens(states, link)]
    after = list(durations)
    for run, need_s in runs:
        lack_s = need_s - sum(after[p] for p in run)
        if lack_s > 1e-6:
            steady = [p for p in run if not _LEAVING & set(states[p])]
            if not steady:
                return None
            after[max(steady, key=lambda p: after[p])] += math.ceil(lack_s - 1e-6)
    surplus_s = sum(after) - sum(durations)
    spare = [
        p
        for p, state in enumerate(states)
        if GREEN_LETTERS & set(state) and not _LEAVING & set(state)
    ]
    for p in sorted(spare, key=lambda p: -after[p]):
        room_s = min(
            [
                after[p] - _SHORTEST_S,
                *(sum(after[k] for k in run) - need_s for run, need_s in runs if p in run),
            ]
        )
        cut_s = min(surplus_s, math.floor(room_s + 1e-6))
        if cut_s > 0:
            after[p] -= cut_s
            surplus_s -= cut_s
    return after
