"""Signal programs of generated nets; netconvert's programs leave some crossings without green.

A program has one stage for each pair of opposite approaches or single approach, and one for
crossings that no other stage serves. During a stage, people cross the arms whose approach waits,
and turning cars yield to them. Each stage ends with red for crossings while cars continue, yellow,
and all red.
"""

from __future__ import annotations

import math
import re
import xml.etree.ElementTree as ET
from collections import defaultdict
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

WALK_S = 8
"""Shortest green of a crossing, seconds."""
CLEARING_MPS = 1.1
"""Walking speed for the clearance time after a crossing's green, m/s."""
START_S = 3
"""A person who starts within this time of green, at CLEARING_MPS, arrives before it ends,
seconds."""
YELLOW_S = 3
"""Duration of yellow, seconds."""
ALL_RED_S = 2
"""Duration of red for all links at the end of a stage, seconds."""
OPPOSITE_RAD = math.radians(38.0)
"""Largest deviation from opposite headings of two approaches that share a stage, radians."""


class Phase(NamedTuple):
    """One phase of a program.

    state: a letter per link, as in SUMO.
    """

    duration_s: int
    state: str


class _Car(NamedTuple):
    """A vehicle link at a signal."""

    link: int
    tail: str
    head: str


class _Zebra(NamedTuple):
    """A crossing link at a signal, and the edges it crosses."""

    link: int
    id: str
    edges: frozenset[str]
    length_m: float


@dataclass(slots=True)
class _Signal:
    """The links that one traffic light controls.

    headings: heading of each approach at its stop line, radians.
    foes: links that conflict with a link.
    yields: links that a link yields to.
    """

    id: str
    cars: list[_Car] = field(default_factory=list)
    zebras: list[_Zebra] = field(default_factory=list)
    headings: dict[str, float] = field(default_factory=dict)
    foes: dict[int, set[int]] = field(default_factory=dict)
    yields: dict[int, set[int]] = field(default_factory=dict)

    @property
    def links(self) -> int:
        return 1 + max([car.link for car in self.cars] + [zebra.link for zebra in self.zebras])


def with_signal_programs(net: bytes, rng: np.random.Generator) -> bytes:
    """Return the net with generated programs in place of netconvert's."""
    programs = {
        signal.id: _program(signal, rng) for signal in _signals(ET.fromstring(net)).values()
    }

    def ours(match: re.Match[bytes]) -> bytes:
        phases = programs.get(match[1].decode())
        if phases is None:
            return match[0]
        offset = int(rng.integers(sum(phase.duration_s for phase in phases)))
        rows = "".join(
            f'        <phase duration="{p.duration_s}" state="{p.state}"/>\n' for p in phases
        )
        head = f'<tlLogic id="{match[1].decode()}" type="static" programID="0" offset="{offset}">\n'
        return f"{head}{rows}    </tlLogic>".encode()

    return re.sub(rb'<tlLogic id="([^"]*)".*?</tlLogic>', ours, net, flags=re.DOTALL)


def signal_faults(net: bytes) -> list[str]:
    """Return the faults of a net's programs, a sentence each: no green, no clearance, conflicts."""
    root = ET.fromstring(net)
    signals = _signals(root)
    faults = []
    for logic in root.iter("tlLogic"):
        signal = signals.get(logic.get("id", ""))
        phases = [
            Phase(round(float(p.get("duration", "0"))), p.get("state", ""))
            for p in logic.iter("phase")
        ]
        if signal is None or any(len(phase.state) < signal.links for phase in phases):
            faults.append(
                f"{logic.get('id')}: the program does not fit the links of the traffic light"
            )
            continue
        for zebra in signal.zebras:
            faults += [
                f"{signal.id}: crossing {zebra.id} {fault}"
                for fault in _walk_faults(signal, zebra, phases)
            ]
        faults += [
            f"{signal.id}: {fault}" for phase in phases for fault in _clashes(signal, phase.state)
        ]
    return faults + [
        f"{name}: no program"
        for name in signals.keys() - {e.get("id") for e in root.iter("tlLogic")}
    ]


def _signals(root: ET.Element) -> dict[str, _Signal]:
    edges = {edge.get("id", ""): edge for edge in root.iter("edge")}
    rows = {j.get("id", ""): j for j in root.iter("junction") if j.get("type") == "traffic_light"}
    signals: dict[str, _Signal] = defaultdict(lambda: _Signal(""))
    for link in root.iter("connection"):
        name = link.get("tl")
        if name is None:
            continue
        signal = signals[name]
        signal.id = name
        tail = link.get("from", "")
        head = link.get("to", "")
        index = int(link.get("linkIndex", "0"))
        # Each signal has one junction, so its link indices equal the rows of `request`.
        if head.startswith(":"):
            crossed = frozenset(edges[head].get("crossingEdges", "").split())
            span = float(edges[head][0].get("length", "0"))
            signal.zebras.append(_Zebra(index, head, crossed, span))
        else:
            signal.cars.append(_Car(index, tail, head))
            if tail not in signal.headings:
                lane = next(
                    lane
                    for lane in edges[tail].iter("lane")
                    if lane.get("index") == link.get("fromLane")
                )
                (x0, y0), (x1, y1) = (
                    [float(v) for v in p.split(",")[:2]] for p in lane.get("shape", "").split()[-2:]
                )
                signal.headings[tail] = math.atan2(y1 - y0, x1 - x0)
    for name, signal in signals.items():
        for request in rows[name].iter("request") if name in rows else ():
            i = int(request.get("index", "0"))
            signal.foes[i], signal.yields[i] = (
                {k for k, bit in enumerate(reversed(request.get(which, ""))) if bit == "1"}
                for which in ("foes", "response")
            )
    return dict(signals)


def _stages(signal: _Signal) -> list[set[str]]:
    """Group the approaches: opposite ones in pairs, best pair first, the others alone."""
    names = list(signal.headings)
    pairs = sorted(
        (
            abs(
                abs(math.remainder(signal.headings[a] - signal.headings[b], 2.0 * math.pi))
                - math.pi
            ),
            a,
            b,
        )
        for i, a in enumerate(names)
        for b in names[i + 1 :]
    )
    stages: list[set[str]] = []
    for off, a, b in pairs:
        if (
            off < OPPOSITE_RAD
            and not any({a, b} & stage for stage in stages)
            and not _deadlock(signal, {a, b})
        ):
            stages.append({a, b})
    return stages + [{name} for name in names if not any(name in stage for stage in stages)]


def _deadlock(signal: _Signal, approaches: set[str]) -> bool:
    """Return whether two cars from these approaches would wait for each other, as at some bent
    main roads."""
    links = {car.link for car in signal.cars if car.tail in approaches}
    return any(
        i in signal.yields.get(k, ()) for i in links for k in signal.yields.get(i, set()) & links
    )


def _program(signal: _Signal, rng: np.random.Generator) -> list[Phase]:
    stages = _stages(signal)
    walks = [[z for z in signal.zebras if not z.edges & stage] for stage in stages]
    left_out = [z for z in signal.zebras if not any(z in walk for walk in walks)]
    if left_out:
        stages.append(set())
        walks.append(left_out)
    phases: list[Phase] = []
    for stage, walking in zip(stages, walks, strict=True):
        span = max((zebra.length_m for zebra in walking), default=0.0)
        clear_s = math.ceil(span / CLEARING_MPS)
        # A late starter must still arrive within the green.
        walk_s = max(WALK_S, clear_s + START_S)
        cars = [car for car in signal.cars if car.tail in stage]
        state = _green(signal, cars, walking)
        if not cars:
            phases += [Phase(walk_s, state), Phase(clear_s, "r" * signal.links)]
            continue
        phases.append(Phase(max(walk_s, int(rng.integers(16, 27))), state))
        rest_s = clear_s - YELLOW_S - ALL_RED_S
        if rest_s > 0:
            phases.append(
                Phase(rest_s, _with_letters(state, {zebra.link: "r" for zebra in walking}))
            )
        phases.append(
            Phase(YELLOW_S, _with_letters("r" * signal.links, {car.link: "y" for car in cars}))
        )
        phases.append(Phase(ALL_RED_S, "r" * signal.links))
    return phases


def _green(signal: _Signal, cars: list[_Car], walking: list[_Zebra]) -> str:
    """Return a stage's state; links that must yield to another green link have "g"."""
    going = {car.link for car in cars} | {zebra.link for zebra in walking}
    letters = {car.link: "g" if signal.yields.get(car.link, set()) & going else "G" for car in cars}
    return _with_letters("r" * signal.links, letters | {zebra.link: "G" for zebra in walking})


def _with_letters(state: str, letters: dict[int, str]) -> str:
    return "".join(letters.get(i, letter) for i, letter in enumerate(state))


def _walk_faults(signal: _Signal, zebra: _Zebra, phases: list[Phase]) -> list[str]:
    walks = "".join(phase.duration_s * phase.state[zebra.link] for phase in phases)
    if not {"G", "g"} & set(walks) or not set(walks) - {"G", "g"}:
        return ["never changes between walk and stop"]
    # Rotate the cycle to start in the second in which the walk ends.
    shift = next(t for t in range(len(walks)) if walks[t - 1] in "Gg" and walks[t] not in "Gg")
    walks = walks[shift:] + walks[:shift]
    faults = []
    shortest = min(len(run) for run in re.findall("[Gg]+", walks))
    if shortest < WALK_S:
        faults.append(f"has {shortest} s of green")
    for car in signal.cars:
        if not {car.tail, car.head} & zebra.edges:
            continue
        cycle = "".join(phase.duration_s * phase.state[car.link] for phase in phases)
        cycle = cycle[shift:] + cycle[:shift]
        starts = [t for t in range(len(cycle)) if cycle[t] in "Gg" and cycle[t - 1] == "r"]
        for start in starts:
            since = start - max((t + 1 for t in range(start) if walks[t] in "Gg"), default=0)
            if walks[start] == "r" and since < zebra.length_m / CLEARING_MPS:
                faults.append(f"is cleared for {since} s, {zebra.length_m:.1f} m long")
        if any(
            w in "Gg" and (c == "G" or (car.tail in zebra.edges and c != "r"))
            for w, c in zip(walks, cycle, strict=True)
        ):
            faults.append(f"and link {car.link} have green at once")
    return faults


def _clashes(signal: _Signal, state: str) -> list[str]:
    """Return conflicting links that are green together although neither yields, or both do."""
    going = [car for car in signal.cars if state[car.link] in "Gg"]
    return [
        f"links {a.link} and {b.link} clash in {state}"
        for i, a in enumerate(going)
        for b in going[i + 1 :]
        if b.link in signal.foes.get(a.link, ())
        and _yields(signal, a, b, state) == _yields(signal, b, a, state)
    ]


def _yields(signal: _Signal, car: _Car, other: _Car, state: str) -> bool:
    return state[car.link] == "g" and other.link in signal.yields[car.link]
