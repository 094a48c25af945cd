"""Versions of everything that a state hash depends on."""

from __future__ import annotations

from functools import lru_cache
from importlib.metadata import version

PACKAGES = ("sidewalk-cosim", "libsumo", "eclipse-sumo", "pybullet", "eclipse-zenoh", "numpy", "scipy", "shapely")


@lru_cache(maxsize=1)
def versions() -> dict[str, str]:
    """Installed version of each package, by distribution name."""
    return {package: version(package) for package in PACKAGES}
