"""Together: how the members of a group stay together, though SUMO's walkers know no groups.

They have one walk and one speed, so SUMO moves them alike until somebody comes in the way, or a
light turns red between them. Then who is ahead of the group's middle walks a little slower and who
lags a little faster, and who is far ahead waits, but never on a crossing. Who walks behind a slower
fellow changes stripes, so the group comes abreast again. On a wide sidewalk who has evaded somebody
steps back to its fellows, where there is room.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Final, Protocol

import numpy as np

from cosim.core.geometry import heading_to_sumo
from cosim.place.street_map import Strip
from sumo_nets.crowd.group_sampling import PERSON_MPS
from sumo_nets.crowd.proxy import KEEP_ROUTE, MATCH_M, ROUND_THE_CORNER_M
from sumo_nets.engine import Sumo

_SLACK_M: Final = 0.15
"""Nobody cares to be so little ahead or behind."""

SLOWER_PER_M: Final = 0.3
"""Share of the speed by which somebody slows down for each metre ahead of the group's middle."""

SLOWEST = 0.6
FASTEST = 1.1
"""Shares of the group's speed within which its members vary; nobody hurries beyond the fastest
walkers' speed."""

_STEPS: Final = 20.0
"""Shares change in twentieths: small changes are not worth a call."""

WAIT_M = 2.0
GO_M = 1.4
"""Who is so far ahead of the last waits, until the last is nearer than GO_M."""

_BESIDE_M: Final = 1.0
"""Who is farther to the side of the next fellow steps nearer."""

_STEP_M: Final = 0.34
"""A step to the side: more than half a stripe, so that SUMO leads on to the middle of the next
one."""

_ROOM_M = 0.9
_AHEAD_M = 6.0
"""Nobody steps to the side where somebody would be so near, or comes towards it from so far
ahead."""

ROUGHLY: Final = 0.5
"""On corners, where the way turns, what lies between fellows along it counts by this much."""

_APART_M: Final = 3.0
"""Of fellows farther apart, who may be round a corner, the edges that they walk on say who is
ahead."""

LOOK_AHEAD: Final = 6
"""Nobody walks over so many edges between two looks."""

_MOVED_M: Final = 0.1
"""Who has moved less since the last look does not say where the group goes."""


_Place = tuple[float, float]
"""Where somebody is or where a way leads: x, y in metres."""


@dataclass(slots=True)
class _Group:
    names: tuple[str, ...]
    mps: float
    walk: Sequence[str]
    at: int = 0
    way: _Place | None = None
    wide: bool = False
    was: Mapping[str, _Place] = field(default_factory=dict)
    ahead_m: dict[str, float] = field(default_factory=dict)
    share: dict[str, float] = field(default_factory=dict)


class _Standing(Protocol):
    """Where somebody is."""

    @property
    def x_m(self) -> float: ...
    @property
    def y_m(self) -> float: ...


class Together:
    """The groups on the street.

    strips: the sidewalks and crossings. tick_s: a step of SUMO.
    """

    def __init__(self, engine: Sumo, strips: Mapping[str, Strip], tick_s: float) -> None:
        self._engine = engine
        self._strips = strips
        self._tick_s = tick_s
        self._groups: dict[str, _Group] = {}
        self._chords: dict[str, _Place] = {}

    @property
    def groups(self) -> tuple[tuple[str, ...], ...]:
        """The names of those who walk together."""
        return tuple(group.names for name, group in self._groups.items() if name == group.names[0])

    def fellows(self, name: str) -> tuple[str, ...]:
        """Everybody who walks with somebody, who is among them."""
        return self._groups[name].names if name in self._groups else (name,)

    def join(self, names: Sequence[str], mps: float, walk: Sequence[str]) -> None:
        """From now on these walk together, at `mps` m/s, along the edges of `walk`."""
        if len(names) > 1:
            group = _Group(tuple(names), mps, walk)
            self._groups.update(dict.fromkeys(names, group))

    def forget(self, present: Iterable[str]) -> None:
        """Whoever is not present has left; who is left alone walks on alone."""
        here = set(present)
        for group in [self._groups[name] for name in self._groups if name not in here]:
            for name in group.names:
                self._groups.pop(name, None)
            group.names = tuple(name for name in group.names if name in here)
            if len(group.names) == 1:
                self._walk(group, group.names[0], 1.0)
            elif group.names:
                self._groups.update(dict.fromkeys(group.names, group))

    def leave(self, name: str) -> tuple[str, ...]:
        """Everybody who walks with somebody, who is among them; they are no group any more."""
        names = self.fellows(name)
        for fellow in names:
            self._groups.pop(fellow, None)
        return names

    def keep(self, seen: Mapping[str, _Standing]) -> None:
        """Everybody's speed for the time until the next look. seen: where (x_m, y_m) people are."""
        for name, group in self._groups.items():
            if name == group.names[0] and all(fellow in seen for fellow in group.names):
                here = {fellow: (seen[fellow].x_m, seen[fellow].y_m) for fellow in group.names}
                self._order(here, group)
                if group.way is not None:
                    self._pull(group)
                    self._close(here, group, group.way, seen)

    def _pull(self, group: _Group) -> None:
        """Make the speeds of who is ahead and who lags."""
        last_m, first_m = min(group.ahead_m.values()), max(group.ahead_m.values())
        if first_m - last_m <= _SLACK_M and not group.share:
            return
        middle_m = sum(group.ahead_m.values()) / len(group.ahead_m)
        for name, ahead_m in group.ahead_m.items():
            share = 1.0
            if ahead_m - last_m > (GO_M if group.share.get(name) == 0.0 else WAIT_M):
                share = 0.0
            elif abs(ahead_m - middle_m) > _SLACK_M:
                share = min(max(1.0 - SLOWER_PER_M * (ahead_m - middle_m), SLOWEST), FASTEST)
            if share < 1.0 and self._on_crossing(name):
                share = 1.0
            self._walk(group, name, round(_STEPS * share) / _STEPS)

    def _close(
        self, here: Mapping[str, _Place], group: _Group, way: _Place, seen: Mapping[str, _Standing]
    ) -> None:
        """Let one who walks too far to the side, and did before, step nearer to its fellows; of two
        the hindmost."""
        left = sorted((way[0] * y_m - way[1] * x_m, name) for name, (x_m, y_m) in here.items())
        too_wide = [
            (one, other)
            for (low_m, one), (high_m, other) in itertools.pairwise(left)
            if _BESIDE_M < high_m - low_m < _APART_M
            and 0.0 not in (group.share.get(one), group.share.get(other))
        ]
        before = group.wide
        group.wide = bool(too_wide)
        if not too_wide or not before:
            return
        group.wide = False
        others = [(p.x_m, p.y_m) for name, p in seen.items() if name not in here]
        for name in sorted(too_wide[0], key=lambda name: (group.ahead_m[name], name)):
            on_m = self._tick_s * group.mps * group.share.get(name, 1.0)
            left_m = _STEP_M if name == too_wide[0][0] else -_STEP_M
            to = (
                here[name][0] + on_m * way[0] - left_m * way[1],
                here[name][1] + on_m * way[1] + left_m * way[0],
            )
            if _is_free(to, way, others) and self._step(name, way, to):
                return

    def _step(self, name: str, way: _Place, to: _Place) -> bool:
        """A step to the side, while walking along a sidewalk."""
        person = self._engine.person
        strip = self._strips.get(person.getRoadID(name))
        if strip is None or strip.kind != "sidewalk" or person.getSpeed(name) < _MOVED_M:
            return False
        length_m = self._engine.lane.getLength(f"{strip.id}_0")
        margin_m = strip.width_m + ROUND_THE_CORNER_M
        if not margin_m < person.getLanePosition(name) < length_m - margin_m:
            return False
        person.moveToXY(
            name, "", *to, heading_to_sumo(math.atan2(way[1], way[0])), KEEP_ROUTE, MATCH_M
        )
        return True

    def _on_crossing(self, name: str) -> bool:
        strip = self._strips.get(self._engine.person.getRoadID(name))
        return strip is not None and strip.kind == "crossing"

    def _order(self, here: Mapping[str, _Place], group: _Group) -> None:
        """Where the group goes, and how far along that way each is."""
        self._come_to(group)
        x_m = y_m = 0.0
        for name, (now_x_m, now_y_m) in here.items():
            was_x_m, was_y_m = group.was.get(name, (now_x_m, now_y_m))
            if abs(now_x_m - was_x_m) + abs(now_y_m - was_y_m) > _MOVED_M:
                x_m, y_m = x_m + now_x_m - was_x_m, y_m + now_y_m - was_y_m
        group.was = here
        far_m = math.hypot(x_m, y_m)
        if far_m > _MOVED_M:
            group.way = (x_m / far_m, y_m / far_m)
        if group.way is None:
            return
        ahead_m = {n: group.way[0] * p[0] + group.way[1] * p[1] for n, p in here.items()}
        if max(ahead_m.values()) - min(ahead_m.values()) > _SLACK_M:
            ahead_m = self._along(group.names, group.way) or self._round_a_corner(
                here, ahead_m, group
            )
        group.ahead_m = ahead_m

    def _along(self, names: tuple[str, ...], way: _Place) -> dict[str, float] | None:
        """How far along its line each is, if all are on one sidewalk or crossing: exact even where
        somebody evades."""
        person = self._engine.person
        edges = {person.getRoadID(name) for name in names}
        if len(edges) > 1 or (edge := edges.pop()) not in self._strips:
            return None
        if edge not in self._chords:
            shape = self._engine.lane.getShape(f"{edge}_0")
            self._chords[edge] = (shape[-1][0] - shape[0][0], shape[-1][1] - shape[0][1])
        chord = self._chords[edge]
        sign = 1.0 if chord[0] * way[0] + chord[1] * way[1] > 0.0 else -1.0
        return {name: sign * person.getLanePosition(name) for name in names}

    def _round_a_corner(
        self, here: Mapping[str, _Place], ahead_m: Mapping[str, float], group: _Group
    ) -> dict[str, float]:
        """Who is ahead by how much where the way turns, or on several edges: roughly, but by the
        walk if APART_M."""
        if max(math.dist(p, q) for p, q in itertools.combinations(here.values(), 2)) < _APART_M:
            return {name: ROUGHLY * m for name, m in ahead_m.items()}
        edges = {name: self._edge(name, group) for name in here}
        hindmost = [here[name] for name, edge in edges.items() if edge == min(edges.values())]
        return {name: min(math.dist(here[name], place) for place in hindmost) for name in here}

    def _come_to(self, group: _Group) -> None:
        """Note how far on its walk the group is, by one of it."""
        edge = self._engine.person.getRoadID(group.names[0])
        ahead = group.walk[group.at : group.at + LOOK_AHEAD]
        if edge in ahead:
            group.at += ahead.index(edge)

    def _edge(self, name: str, group: _Group) -> float:
        """How many edges of the walk somebody has come, and a half on corners; where it comes
        twice, near the group."""
        edge = self._engine.person.getRoadID(name)
        half = 0.0
        if edge not in self._strips:
            edge = self._engine.person.getNextEdge(name)
            half = 0.5
        places = [k for k, part in enumerate(group.walk) if part == edge]
        return min(places, key=lambda k: abs(k - group.at), default=group.at) - half

    def _walk(self, group: _Group, name: str, share: float) -> None:
        if group.share.get(name, 1.0) != share:
            group.share[name] = share
            if share == 1.0:
                del group.share[name]
            fastest_mps = max(group.mps, min(group.mps * share, PERSON_MPS[1]))
            self._engine.person.setSpeed(name, fastest_mps if share > 1.0 else group.mps * share)


def _is_free(place: _Place, way: _Place, others: list[_Place]) -> bool:
    """Whether nobody is near a place, nor in the way for AHEAD_M from there on."""
    apart = np.array(others).reshape(-1, 2) - place
    ahead = apart @ way
    aside = apart @ (-way[1], way[0])
    behind = np.minimum(ahead, 0.0)
    return not bool(((ahead < _AHEAD_M) & (np.hypot(behind, aside) < _ROOM_M)).any())
