"""Everybody in a street, as it is shown: the crowd that SUMO moves and the people who are put where
they are."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

import numpy as np

from cosim.core.errors import EngineError
from cosim.core.geometry import Floats
from cosim.core.state import Age, Doing, People, PersonKind, frozen, write_protected
from cosim.people.gait import Strides
from cosim.spec.events import Actor
from sumo_nets.crowd.pose_filter import PERSON_STANDS_MPS

_NOWHERE: Final = np.zeros((0, 2))
_NONE: Final = np.zeros(0)


class ShownPeople:
    """Puts crowd and actors into one value, tick after tick of `tick_s`, and counts their
    strides."""

    def __init__(self, tick_s: float) -> None:
        self._strides = Strides(tick_s)
        self._cast: tuple[tuple[str, ...], list[tuple[str, PersonKind, Age]]] | None = None

    def together(
        self,
        cast: list[Actor],
        ages: Mapping[str, Age],
        names: tuple[str, ...] = (),
        xy: Floats = _NOWHERE,
        heading: Floats = _NONE,
        speed: Floats = _NONE,
    ) -> People:
        """cast: the actors. ages: of the crowd. names, xy (N, 2), heading (N,), speed (N,): its
        members, in metres, radians and m/s."""
        if (names, cast_of := [(a.id, a.kind, a.age) for a in cast]) != self._cast:
            self._cast = names, cast_of
            self._names = (*names, *(a.id for a in cast))
            kinds = [*[PersonKind.CROWD] * len(xy), *(a.kind for a in cast)]
            all_ages = [*(ages[name] for name in names), *(a.age for a in cast)]
            self._kind = write_protected(kinds, np.int8)
            self._age = write_protected(all_ages, np.int8)
        doing: list[Doing] = [
            "walk" if walks else "stand" for walks in (speed > PERSON_STANDS_MPS).tolist()
        ]
        places = np.concatenate([xy, places_of(cast)])
        paces = np.concatenate(
            [speed, [a.speed_mps if a.pace_mps is None else a.pace_mps for a in cast]]
        )
        strides, paces = self._strides.update(self._names, places, paces, self._age)
        return People(
            self._names,
            frozen(places),
            frozen(np.concatenate([heading, [a.heading_rad for a in cast]])),
            frozen(np.concatenate([speed, [a.speed_mps for a in cast]])),
            (*doing, *(a.doing for a in cast)),
            frozen(strides),
            frozen(paces),
            self._kind,
            self._age,
        )


def cast_in_order(actors: tuple[Actor, ...], crowd: Mapping[str, Age]) -> list[Actor]:
    """Actors in the order of their ids. Raises EngineError where two have one id, or one that of
    the crowd's."""
    ids = {actor.id for actor in actors}
    if len(ids) != len(actors) or ids & crowd.keys():
        raise EngineError(
            f"actors need unique ids, and none of the crowd's: {[a.id for a in actors]}"
        )
    return sorted(actors, key=lambda actor: actor.id)


def places_of(cast: list[Actor]) -> Floats:
    """Where actors are, (N, 2) metres."""
    return np.array([(a.x_m, a.y_m) for a in cast], dtype=float).reshape(-1, 2)
