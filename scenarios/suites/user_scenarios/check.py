"""Checks that user scenarios can be driven: their places, routes, events and obstacles."""

from __future__ import annotations

from collections.abc import Iterator
from functools import lru_cache

import msgspec

from cosim.core.errors import CosimError, SpecError
from cosim.core.progress import Progress, ignore
from cosim.spec.scenario import Light, Scenario, Suite, event_faults
from cosim.spec.spec_file import join_faults
from physics.cameras.hdri import read_hdri
from scenarios.events import EVENT_KINDS
from scenarios.places.nets import place
from scenarios.suites.fits import misfits
from scenarios.suites.long_horizon import WAY_SPARE_M
from scenarios.suites.obstacles import TO_SPARE_M, prove_gap
from scenarios.suites.reactive import NO_CROWD
from scenarios.suites.user_scenarios.build import build_scenarios, suite_of_own
from scenarios.suites.user_scenarios.read import OwnFile


def own_faults(file: OwnFile, progress: Progress = ignore) -> list[str]:
    """Return all faults of the scenarios of a file, each once, in the order of the scenarios."""
    found: dict[str, None] = {}
    for built in build_scenarios(file, progress):
        faults = built.faults
        if built.scenario is not None and not faults:
            faults = tuple(_faults_on_the_street(built.scenario))
        named = f"scenario '{built.variant.id}': "
        found |= dict.fromkeys(fault.replace(named, "").removeprefix(named) for fault in faults)
    return list(found)


def checked_own(file: OwnFile, progress: Progress = ignore) -> Suite:
    """Return the scenarios of a file, ready to run. Raises SpecError with all faults."""
    if faults := own_faults(file, progress):
        raise SpecError(f"{file.path}: {join_faults(faults, len(faults))}")
    return suite_of_own(file, progress)


def _faults_on_the_street(scenario: Scenario) -> Iterator[str]:
    _, street_map = place(scenario.place)
    yield from event_faults(scenario, EVENT_KINDS)
    try:
        if scenario.light.hdri:
            read_hdri(scenario.light.hdri)
    except SpecError as error:
        yield f"light.hdri: {error}"
    faults = list(misfits([scenario], street_map))
    yield from faults
    if not faults:
        street = msgspec.structs.replace(
            scenario, id="own", suite="own", crowd=NO_CROWD, light=Light()
        )
        yield from _narrow(street)


@lru_cache(maxsize=1024)
def _narrow(street: Scenario) -> tuple[str, ...]:
    """Return where the robot does not fit.

    It needs half a metre to spare at obstacles, and hardly any elsewhere.
    """
    _, street_map = place(street.place)
    try:
        prove_gap(street, street_map, TO_SPARE_M if street.obstacles else 2.0 * WAY_SPARE_M)
    except CosimError as error:
        return (str(error).replace("scenario 'own': ", ""),)
    return ()
