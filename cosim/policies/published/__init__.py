"""Published networks.

Networks for pictures are ONNX bundles: manifests, and commands that generate their graphs. Networks
for states are classes, listed in `NETWORK_POLICIES`, that read the published files themselves.
"""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Final

from cosim.policies.published.cadrl import Cadrl
from cosim.policies.published.dsrnn import Dsrnn
from cosim.policies.published.metaurban_ppo import MetaurbanPpo
from cosim.policies.published.network_policy import NetworkPolicy
from cosim.policies.published.sarl import Sarl
from cosim.policies.published.td3_lidar import Td3Lidar

NETWORK_POLICIES: Final[Mapping[str, type[NetworkPolicy]]] = MappingProxyType(
    {one.manifest.name: one for one in (Cadrl, Dsrnn, Sarl, Td3Lidar, MetaurbanPpo)}
)
"""Classes of the policies whose networks take states, by name."""
