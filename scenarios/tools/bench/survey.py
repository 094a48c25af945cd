"""Generated cities as they are in the end, furniture included: counted, measured and checked,
several at a time."""

from __future__ import annotations

import multiprocessing
import resource
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from typing import NamedTuple

from cosim.core.errors import EngineError
from cosim.spec.scenario import City
from physics.street.clearance import clear_width, on_driveways
from physics.street.furniture import footprints
from physics.street.placement import props_of
from sumo_nets.city.census import LEAST_CLEAR_M, Census, census
from sumo_nets.city.store import city_net
from sumo_nets.net.snapshot import street_map_of


class Survey(NamedTuple):
    """A city with its furniture. side_m: the least free width on any sidewalk, around its middle.
    props: how many. faults: what breaks the promises of a city. memory_mib: the largest of its
    process so far."""

    seed: int
    census: Census
    side_m: float
    props: int
    faults: tuple[str, ...]
    memory_mib: float


def survey(city: City) -> Survey:
    """Count and measure a city on its final geometry."""
    net = city_net(city)
    place = street_map_of(net)
    props = props_of(place, city.seed)
    found = census(net, place, list(footprints(props)))
    sidewalks = [strip for strip in place.strips.values() if strip.kind == "sidewalk"]
    widths = clear_width(sidewalks, props)
    tightest = min(widths, key=lambda strip: widths[strip][0])
    faults = list(found.faults)
    if (side_m := widths[tightest][0]) < LEAST_CLEAR_M:
        faults.append(f"sidewalk {tightest} is only {side_m:.2f} m wide beside what stands on it")
    if blocked := on_driveways(sidewalks, props):
        faults.append(f"{len(blocked)} props stand on driveways: {', '.join(blocked[:3])}")
    memory_mib = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0
    return Survey(city.seed, found, side_m, len(props), tuple(faults), memory_mib)


def surveys(cities: Sequence[City], jobs: int) -> Iterator[Survey]:
    """Surveys in the order of the cities, each as soon as it and those before it are done; `jobs`
    processes."""
    if jobs == 1:
        yield from map(survey, cities)
        return
    with ProcessPoolExecutor(jobs, multiprocessing.get_context("spawn")) as pool:
        try:
            yield from pool.map(survey, cities)
        except BrokenProcessPool as error:
            raise EngineError(
                "a process that surveyed cities has died: with fewer --jobs it may have "
                "memory enough"
            ) from error
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            raise
