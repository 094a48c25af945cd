"""The driver of a run's policy, wherever that is: in this process, in one of its own, or behind Zenoh."""

from __future__ import annotations

from cosim.episode.driver import Driver, Timer
from cosim.episode.ports import Manifest
from cosim.policies.load import load_policy
from cosim.spec.policy_host import PolicyHost
from scenarios.serving.isolated import isolated_driver


def policy_driver(name: str, host: PolicyHost, timer: Timer | None = None, expected: Manifest | None = None) -> Driver:
    """A policy by its name. expected: its manifest as the run knows it; one elsewhere is only asked who it is without.
    Raises UsageError.

    >>> policy_driver("route", PolicyHost()).manifest.name
    'route'
    """
    if host.isolated:
        return isolated_driver(name, timer, expected, host.run)
    return load_policy(name, timer)


def known_driver(name: str, host: PolicyHost) -> Driver:
    """A policy for who wants to know what it is, before a run asks it: one elsewhere is left at once."""
    driver = policy_driver(name, host)
    driver.close()
    return driver
