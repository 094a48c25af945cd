"""Versions of everything that a state hash depends on."""

from __future__ import annotations

import platform
from functools import lru_cache
from importlib.metadata import PackageNotFoundError, version

PACKAGES = ("sidewalk-cosim", "libsumo", "eclipse-sumo", "pybullet", "eclipse-zenoh", "numpy", "scipy", "shapely")

ENGINES = {"SUMO": "libsumo", "PyBullet": "pybullet", "Zenoh": "eclipse-zenoh", "moderngl": "moderngl"}
"""Name for humans -> distribution."""


@lru_cache(maxsize=1)
def versions() -> dict[str, str]:
    """Installed version of each package, by distribution name."""
    return {package: version(package) for package in PACKAGES}


def in_words() -> str:
    """Versions of the project, Python and the engines, for humans; nothing is imported to find them."""
    engines = ", ".join(f"{name} {_installed(package)}" for name, package in ENGINES.items())
    return f"cosim {_installed('sidewalk-cosim')}, Python {platform.python_version()}\n{engines}"


def _installed(package: str) -> str:
    try:
        return version(package)
    except PackageNotFoundError:
        return "missing"
