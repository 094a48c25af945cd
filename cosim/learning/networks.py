"""Table of the networks that `cosim train` trains, named as in `settings.NETWORK_DEFAULTS`."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Final

from cosim.learning.kind import Network
from cosim.learning.sidewalk import SIDEWALK
from cosim.learning.small import SMALL

NETWORKS: Final[Mapping[str, Network]] = MappingProxyType({"small": SMALL, "sidewalk": SIDEWALK})
