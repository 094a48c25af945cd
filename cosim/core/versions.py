"""Versions and floating-point behaviour of everything that affects an episode's bits."""

from __future__ import annotations

import hashlib
import math
import platform
from functools import lru_cache
from importlib.metadata import PackageNotFoundError, version

import numpy as np

_ARGUMENT_COUNT = 4096
"""Number of arguments for each function. Implementations that differ at all do so for about one in
some hundred."""


@lru_cache(maxsize=1)
def arithmetic() -> str:
    """Return a hash of the results of elementary functions for fixed arguments.

    It takes 6 ms, once in a process.
    """
    share = (
        np.arange(1, _ARGUMENT_COUNT + 1, dtype=np.uint64)
        * np.uint64(2654435761)
        % np.uint64(1 << 32)
        / 2.0**32
    )
    other = np.roll(share, 1)
    angle = (share - 0.5) * 40.0
    ratio = 2.0 * share - 1.0
    power = (share - 0.5) * 20.0
    large = share * 100.0
    unary = (
        (math.sin, np.sin, angle),
        (math.cos, np.cos, angle),
        (math.tan, None, angle),
        (math.atan, np.arctan, angle),
        (math.asin, np.arcsin, ratio),
        (math.acos, np.arccos, ratio),
        (math.exp, np.exp, power),
        (math.log, np.log, large),
    )
    binary = ((math.atan2, np.arctan2), (math.hypot, np.hypot), (math.pow, np.power))
    bits = hashlib.blake2b(digest_size=8)
    for scalar, array, arguments in unary:
        bits.update(np.array([scalar(value) for value in arguments.tolist()]).tobytes())
        if array is not None:
            bits.update(array(arguments).tobytes())
    for scalar_2, array_2 in binary:
        pairs = zip(large.tolist(), other.tolist(), strict=True)
        bits.update(np.array([scalar_2(one, two) for one, two in pairs]).tobytes())
        bits.update(array_2(large, other).tobytes())
    return bits.hexdigest()


RECORDED_PACKAGES = (
    "sidewalk-cosim",
    "libsumo",
    "eclipse-sumo",
    "pybullet",
    "eclipse-zenoh",
    "numpy",
    "scipy",
    "shapely",
    "osmium",
    "moderngl",
    "glcontext",
    "opencv-python-headless",
)
"""Distributions whose versions are recorded with every episode."""

ENGINES = {
    "SUMO": "libsumo",
    "PyBullet": "pybullet",
    "Zenoh": "eclipse-zenoh",
    "moderngl": "moderngl",
}
"""Distribution of each engine, by the engine's name."""


@lru_cache(maxsize=1)
def versions() -> dict[str, str]:
    """Return the version of each package, of `geos`, and the `arithmetic` hash of this machine.

    Machines with equal values simulate the same bits.
    """
    import shapely

    found = {package: version(package) for package in RECORDED_PACKAGES}
    return {**found, "geos": shapely.geos_version_string, "arithmetic": arithmetic()}


def versions_in_words() -> str:
    """Return the versions of project, Python and engines as text, without importing the engines."""
    engines = ", ".join(f"{name} {_installed(package)}" for name, package in ENGINES.items())
    return f"cosim {_installed('sidewalk-cosim')}, Python {platform.python_version()}\n{engines}"


def _installed(package: str) -> str:
    try:
        return version(package)
    except PackageNotFoundError:
        return "missing"
