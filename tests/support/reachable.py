"""Everything that can be reached from a value, and parts of it that a policy must not have."""

from __future__ import annotations

import gc
import weakref
from collections.abc import Iterator, Mapping
from types import BuiltinFunctionType, FunctionType, ModuleType

import numpy as np
from shapely.geometry.base import BaseGeometry

from cosim.core.geometry import Polyline, Pose
from cosim.core.state import People, RobotState, Street, Vehicles
from cosim.episode.interfaces import Privileged
from cosim.episode.loop import Moment
from cosim.spec.events import Event
from cosim.spec.scenario import City, CityMap, Scenario

_PRIVILEGED = (
    Scenario,
    City,
    CityMap,
    Event,
    Privileged,
    Moment,
    Street,
    People,
    Vehicles,
    RobotState,
    Pose,
    Polyline,
    BaseGeometry,
    np.random.Generator,
    np.random.BitGenerator,
)


def reached(root: object) -> Iterator[object]:
    """Yield attributes, slots, items, keys, closures, defaults, weak references and viewed arrays,
    each once. Types, modules and globals of functions are left out."""
    found = {id(root): root}
    coming = [root]
    while coming:
        one = coming.pop()
        yield one
        if isinstance(one, FunctionType):
            below: list[object] = [
                one.__closure__,
                one.__defaults__,
                one.__kwdefaults__,
                one.__dict__,
            ]
        else:
            below = list(gc.get_referents(one))
        if isinstance(one, np.ndarray):
            below += [one.base, one.tolist() if one.dtype == object else None]
        if isinstance(one, memoryview):
            below.append(one.obj)
        if isinstance(one, Mapping):
            below += [*one.keys(), *one.values()]
        if isinstance(one, weakref.ref):
            below.append(one())
        for each in below:
            if isinstance(each, type | ModuleType | BuiltinFunctionType) or id(each) in found:
                continue
            found[id(each)] = each
            coming.append(each)


def leaks(root: object, scenario: Scenario, now: Moment) -> list[str]:
    """Return reachable values that only the simulator knows: values of its types, names, and
    numbers of a map."""
    names = {
        scenario.id,
        scenario.suite,
        scenario.place.name,
        *now.street.people.ids,
        *now.street.vehicles.ids,
    }
    names |= {name for event in scenario.events for name in (*event.names, event.kind)}
    pose = now.robot.pose
    route = scenario.route_line
    numbers = {
        pose.x_m,
        pose.y_m,
        now.route_s_m,
        route.length_m,
        float(scenario.seed),
        *scenario.goal,
    }
    numbers |= {event.route_s_m for event in scenario.events} | {
        *now.street.people.xy.ravel().tolist()
    }
    numbers |= {*route.points.ravel().tolist()}
    known = np.array(sorted(number for number in numbers if number != round(number)))
    found = []
    for one in reached(root):
        if isinstance(one, _PRIVILEGED):
            found.append(f"a {type(one).__name__}")
        elif isinstance(one, str) and (
            one in names or any(name in one for name in names if len(name) > 2)
        ):
            found.append(f"the text {one!r}")
        elif isinstance(one, float) and one in known:
            found.append(f"the number {one}")
        elif (
            isinstance(one, np.ndarray)
            and one.dtype.kind == "f"
            and np.isin(one.astype(float), known).any()
        ):
            found.append(f"an array of {one.shape} with a number of the map")
    return found
