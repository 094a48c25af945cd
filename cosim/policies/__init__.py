"""Bundled policies."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from types import MappingProxyType

from cosim.episode.interfaces import Policy
from cosim.policies.baselines import Stop, Straight
from cosim.policies.nav.policy import Nav
from cosim.policies.privileged.orca import Orca
from cosim.policies.privileged.orca_hasty import HastyOrca
from cosim.policies.privileged.route import Route
from cosim.policies.privileged.social_force import SocialForce

POLICIES: Mapping[str, Callable[[], Policy]] = MappingProxyType(
    {
        "stop": Stop,
        "straight": Straight,
        "nav": Nav,
        "route": Route,
        "orca": Orca,
        "orca-hasty": HastyOrca,
        "social_force": SocialForce,
    }
)
"""Constructors of the bundled Python policies by name."""
