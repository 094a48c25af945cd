"""The events that ship: a row for each kind, written in the kind's own file."""

from __future__ import annotations

from types import MappingProxyType
from typing import Final

from cosim.spec.events import EventKinds
from scenarios.events.crossing import PED_CROSSING
from scenarios.events.frontal import FRONTAL
from scenarios.events.lateral import LATERAL
from scenarios.events.overtaking import OVERTAKING
from scenarios.events.standing import CONVERSING, GESTURING, OBSTRUCTING, QUEUEING

_ROWS = (OBSTRUCTING, CONVERSING, QUEUEING, FRONTAL, LATERAL, OVERTAKING, PED_CROSSING, GESTURING)
EVENT_KINDS: Final[EventKinds] = MappingProxyType({kind.name: kind for kind in _ROWS})
