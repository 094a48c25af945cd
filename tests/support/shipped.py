"""Shipped suites, each loaded once in a process on first use."""

from __future__ import annotations

from functools import cache

from cosim.spec.scenario import Scenario, Suite
from scenarios.suites.catalog import SUITES, load_suite


@cache
def shipped(name: str) -> Suite:
    """Return a suite by its name."""
    return load_suite(name)


def long_ways() -> tuple[Scenario, ...]:
    """Return the scenarios of `long-horizon`."""
    return shipped("long-horizon").scenarios


def all_shipped() -> list[Scenario]:
    """Return the scenarios of all suites."""
    return [scenario for name in SUITES for scenario in shipped(name).scenarios]
