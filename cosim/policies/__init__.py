"""Policies that ship with the project, by name."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from types import MappingProxyType

from cosim.episode.ports import Policy
from cosim.policies.baselines import Stop, Straight
from cosim.policies.orca import Orca
from cosim.policies.route import Route
from cosim.policies.social_force import SocialForce

POLICIES: Mapping[str, Callable[[], Policy]] = MappingProxyType(
    {"stop": Stop, "straight": Straight, "route": Route, "orca": Orca, "social_force": SocialForce}
)
