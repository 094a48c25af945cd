"""Signals that never let people walk: mended by one more phase in which only they go."""

from __future__ import annotations

import math
import xml.etree.ElementTree as ET
from collections import defaultdict

from sumo_nets.city.signals import ALL_RED_S, CLEARING_MPS, WALK_S, YELLOW_S
from sumo_nets.net.netfacts import crossing_links, walks_of

PLAIN_TYPES = ("static", "actuated", "delay_based")
"""Programs that run their phases in turn, so that one can be added."""


def mend_signals(root: ET.Element) -> list[str]:
    """Give every crossing that never has green a phase of its own, in place. What was changed, a sentence each."""
    never = walks_of(root).never
    links = crossing_links(root)
    lengths = {
        e.get("id"): float(e[0].get("length", "0")) for e in root.iter("edge") if e.get("id") in never and len(e)
    }
    at: dict[str, dict[int, float]] = defaultdict(dict)
    for crossing in never:
        signal, link = links[crossing]
        at[signal][link] = lengths.get(crossing, 0.0)
    mended, left = list[str](), list[str]()
    for logic in root.iter("tlLogic"):
        waiting = at.get(logic.get("id", ""))
        if waiting:
            (mended if _add_walk(logic, waiting) else left).append(logic.get("id", ""))
    said = []
    if mended:
        names = ", ".join(dict.fromkeys(mended))
        said.append(f"signals that never let people cross got a walk phase at the end of each cycle: {names}")
    if left:
        names = ", ".join(dict.fromkeys(left))
        said.append(f"signals that never let people cross, left as they are (programs of a special kind): {names}")
    return said


def _add_walk(logic: ET.Element, waiting: dict[int, float]) -> bool:
    """Append: yellow for whoever goes, all red, walk, all red until the longest crossing is cleared."""
    phases = logic.findall("phase")
    plain = logic.get("type", "static") in PLAIN_TYPES and not any("next" in phase.attrib for phase in phases)
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
