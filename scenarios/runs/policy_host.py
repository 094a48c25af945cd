"""The driver of a run's policy, wherever that is: in this process, in one of its own, or behind
Zenoh."""

from __future__ import annotations

from cosim.core.errors import UsageError
from cosim.episode.policy_caller import LOADED_WITHIN_S, Driver, Timer
from cosim.policies.load import REMOTE_SCHEME, load_policy
from cosim.policies.user_module import importable
from cosim.spec.manifest import Manifest
from cosim.spec.options import PolicyHost
from scenarios.runs.isolated_policy import isolated_driver


def policy_driver(
    name: str,
    host: PolicyHost,
    timer: Timer | None = None,
    expected: Manifest | None = None,
    start_s: float = LOADED_WITHIN_S,
) -> Driver:
    """A policy by its name. expected: its manifest as the run knows it; one elsewhere is only asked
    who it is without. start_s: without a timer it may take so long to be loaded, where it is loaded
    in a process of its own. Raises UsageError.

    >>> policy_driver("route", PolicyHost()).manifest.name
    'route'
    """
    name = importable(name)
    if name.startswith(REMOTE_SCHEME):
        from scenarios.runs.remote_policy import remote_driver

        if host.isolated:
            raise UsageError(f"policy '{name}' is elsewhere anyway: leave --isolated out")
        return remote_driver(name, host, timer)
    if host.servers:
        raise UsageError(f"--policy-at goes with --policy {REMOTE_SCHEME}NAME, not with '{name}'")
    if host.isolated:
        return isolated_driver(name, timer, expected, host.run, start_s)
    return load_policy(name, timer, start_s)


def known_driver(
    name: str, host: PolicyHost, jobs: int = 1, start_s: float = LOADED_WITHIN_S
) -> Driver:
    """A policy for who wants to know what it is, before a run asks it: one elsewhere is left at
    once. Raises UsageError when its servers answer for fewer episodes at a time than there are
    jobs."""
    driver = policy_driver(name, host, start_s=start_s)
    driver.close()
    if 0 < driver.at_once < jobs:
        raise UsageError(
            f"policy '{name}' answers for {driver.at_once} episodes at a time, and there are "
            f"{jobs} jobs: serve its class in place of an object, more servers, or take fewer jobs"
        )
    return driver
