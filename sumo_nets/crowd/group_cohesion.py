"""Group cohesion: keep the members of a group together, although SUMO has no groups.

Members share a walk and a speed, so they move together until others or a red light separate them.
Members ahead of the group's middle then slow down, and members behind speed up. Members far ahead
wait, but never on a crossing. On a wide sidewalk, a member who evaded somebody steps back towards
the others if there is room.
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

_TOLERANCE_M: Final = 0.15
"""Smallest deviation from the group's middle that changes a member's speed, metres."""

SPEED_CHANGE_PER_M: Final = 0.3
"""Relative speed change per metre ahead of the group's middle."""

SLOWEST = 0.6
"""Smallest speed of a member, as a share of the group's speed."""
FASTEST = 1.1
"""Largest speed of a member, as a share of the group's speed; it is also limited by PERSON_MPS."""

_STEPS: Final = 20.0
"""Relative speeds are rounded to 1/20 to avoid calls for small changes."""

WAIT_AHEAD_M = 2.0
"""A member farther ahead of the last one waits, metres."""
RESUME_AHEAD_M = 1.4
"""A waiting member continues when the last one is nearer, metres."""

_TOO_WIDE_M: Final = 1.0
"""A member farther to the side of the next one steps closer, metres."""

_SIDE_STEP_M: Final = 0.34
"""Size of a side step: more than half a stripe, so that SUMO continues to the middle of the next
one, metres."""

_FREE_RADIUS_M = 0.9
"""Smallest distance of others from the target of a side step, metres."""
_FREE_AHEAD_M = 6.0
"""Distance ahead that must be free of others for a side step, metres."""

CORNER_WEIGHT: Final = 0.5
"""Factor on distances along the way at corners, where the direction is uncertain."""

_FAR_APART_M: Final = 3.0
"""For members farther apart, possibly around a corner, order follows from the edges of the walk,
metres."""

LOOK_AHEAD: Final = 6
"""Largest number of edges that a person walks between two updates."""

_MOVED_M: Final = 0.1
"""Smallest movement between two updates that defines the group's direction, metres."""


_Place = tuple[float, float]
"""A position or a direction: x, y in metres."""


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


class _Positioned(Protocol):
    """Anything with a position."""

    @property
    def x_m(self) -> float: ...
    @property
    def y_m(self) -> float: ...


class GroupCohesion:
    """The groups on the street.

    strips: sidewalks and crossings.
    tick_s: duration of a SUMO step, seconds.
    """

    def __init__(self, engine: Sumo, strips: Mapping[str, Strip], tick_s: float) -> None:
        self._engine = engine
        self._strips = strips
        self._tick_s = tick_s
        self._groups: dict[str, _Group] = {}
        self._chords: dict[str, _Place] = {}

    @property
    def groups(self) -> tuple[tuple[str, ...], ...]:
        """The names of the members of each group."""
        return tuple(group.names for name, group in self._groups.items() if name == group.names[0])

    def group_of(self, name: str) -> tuple[str, ...]:
        """Return all members of a person's group, the person included."""
        return self._groups[name].names if name in self._groups else (name,)

    def form(self, names: Sequence[str], mps: float, walk: Sequence[str]) -> None:
        """Form a group that walks at `mps` m/s along the edges of `walk`."""
        if len(names) > 1:
            group = _Group(tuple(names), mps, walk)
            self._groups.update(dict.fromkeys(names, group))

    def remove_absent(self, present: Iterable[str]) -> None:
        """Remove persons that are not present; a last remaining member continues alone."""
        here = set(present)
        for group in [self._groups[name] for name in self._groups if name not in here]:
            for name in group.names:
                self._groups.pop(name, None)
            group.names = tuple(name for name in group.names if name in here)
            if len(group.names) == 1:
                self._set_speed(group, group.names[0], 1.0)
            elif group.names:
                self._groups.update(dict.fromkeys(group.names, group))

    def dissolve(self, name: str) -> tuple[str, ...]:
        """Dissolve a person's group and return its members."""
        names = self.group_of(name)
        for fellow in names:
            self._groups.pop(fellow, None)
        return names

    def update(self, seen: Mapping[str, _Positioned]) -> None:
        """Set the speeds of all groups until the next update.

        seen: positions of people by name.
        """
        for name, group in self._groups.items():
            if name == group.names[0] and all(fellow in seen for fellow in group.names):
                here = {fellow: (seen[fellow].x_m, seen[fellow].y_m) for fellow in group.names}
                self._update_order(here, group)
                if group.way is not None:
                    self._adjust_speeds(group)
                    self._close_gap(here, group, group.way, seen)

    def _adjust_speeds(self, group: _Group) -> None:
        """Slow down or stop members ahead and speed up members behind."""
        last_m, first_m = min(group.ahead_m.values()), max(group.ahead_m.values())
        if first_m - last_m <= _TOLERANCE_M and not group.share:
            return
        middle_m = sum(group.ahead_m.values()) / len(group.ahead_m)
        for name, ahead_m in group.ahead_m.items():
            share = 1.0
            if ahead_m - last_m > (
                RESUME_AHEAD_M if group.share.get(name) == 0.0 else WAIT_AHEAD_M
            ):
                share = 0.0
            elif abs(ahead_m - middle_m) > _TOLERANCE_M:
                share = min(max(1.0 - SPEED_CHANGE_PER_M * (ahead_m - middle_m), SLOWEST), FASTEST)
            if share < 1.0 and self._on_crossing(name):
                share = 1.0
            self._set_speed(group, name, round(_STEPS * share) / _STEPS)

    def _close_gap(
        self,
        here: Mapping[str, _Place],
        group: _Group,
        way: _Place,
        seen: Mapping[str, _Positioned],
    ) -> None:
        """Let one member that is too far to the side in two successive updates step closer, the
        hindmost first."""
        left = sorted((way[0] * y_m - way[1] * x_m, name) for name, (x_m, y_m) in here.items())
        too_wide = [
            (one, other)
            for (low_m, one), (high_m, other) in itertools.pairwise(left)
            if _TOO_WIDE_M < high_m - low_m < _FAR_APART_M
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
            left_m = _SIDE_STEP_M if name == too_wide[0][0] else -_SIDE_STEP_M
            to = (
                here[name][0] + on_m * way[0] - left_m * way[1],
                here[name][1] + on_m * way[1] + left_m * way[0],
            )
            if _is_free(to, way, others) and self._step_aside(name, way, to):
                return

    def _step_aside(self, name: str, way: _Place, to: _Place) -> bool:
        """Move a person sideways while it walks along a sidewalk. Returns whether it was
        possible."""
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

    def _update_order(self, here: Mapping[str, _Place], group: _Group) -> None:
        """Update the group's direction and each member's distance along it."""
        self._advance_walk(group)
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
        if max(ahead_m.values()) - min(ahead_m.values()) > _TOLERANCE_M:
            ahead_m = self._on_one_edge(group.names, group.way) or self._across_edges(
                here, ahead_m, group
            )
        group.ahead_m = ahead_m

    def _on_one_edge(self, names: tuple[str, ...], way: _Place) -> dict[str, float] | None:
        """Return each member's arc length if all are on one sidewalk or crossing, exact even
        during evasion."""
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

    def _across_edges(
        self, here: Mapping[str, _Place], ahead_m: Mapping[str, float], group: _Group
    ) -> dict[str, float]:
        """Estimate who is ahead where the way turns or members are on several edges.

        Nearby members are compared along the group's direction, others by their edges of the walk.
        """
        if max(math.dist(p, q) for p, q in itertools.combinations(here.values(), 2)) < _FAR_APART_M:
            return {name: CORNER_WEIGHT * m for name, m in ahead_m.items()}
        edges = {name: self._edge_index(name, group) for name in here}
        hindmost = [here[name] for name, edge in edges.items() if edge == min(edges.values())]
        return {name: min(math.dist(here[name], place) for place in hindmost) for name in here}

    def _advance_walk(self, group: _Group) -> None:
        """Update the group's position in its walk, from its first member."""
        edge = self._engine.person.getRoadID(group.names[0])
        ahead = group.walk[group.at : group.at + LOOK_AHEAD]
        if edge in ahead:
            group.at += ahead.index(edge)

    def _edge_index(self, name: str, group: _Group) -> float:
        """Return the index in the walk of a person's edge, less a half on corners.

        If the edge occurs several times, the occurrence nearest to the group counts.
        """
        edge = self._engine.person.getRoadID(name)
        half = 0.0
        if edge not in self._strips:
            edge = self._engine.person.getNextEdge(name)
            half = 0.5
        places = [k for k, part in enumerate(group.walk) if part == edge]
        return min(places, key=lambda k: abs(k - group.at), default=group.at) - half

    def _set_speed(self, group: _Group, name: str, share: float) -> None:
        if group.share.get(name, 1.0) != share:
            group.share[name] = share
            if share == 1.0:
                del group.share[name]
            fastest_mps = max(group.mps, min(group.mps * share, PERSON_MPS[1]))
            self._engine.person.setSpeed(name, fastest_mps if share > 1.0 else group.mps * share)


def _is_free(place: _Place, way: _Place, others: list[_Place]) -> bool:
    """Return whether nobody is near a place or ahead of it within _FREE_AHEAD_M."""
    apart = np.array(others).reshape(-1, 2) - place
    ahead = apart @ way
    aside = apart @ (-way[1], way[0])
    behind = np.minimum(ahead, 0.0)
    return not bool(((ahead < _FREE_AHEAD_M) & (np.hypot(behind, aside) < _FREE_RADIUS_M)).any())
