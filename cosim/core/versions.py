"""Versions of everything that can change the bits of an episode or its pictures.

SUMO moves people and vehicles (libsumo) and builds the nets (netconvert, of eclipse-sumo), PyBullet moves the robot,
the director's answers come over Zenoh; numpy, scipy and shapely, with the GEOS inside it, compute places, people and
routes; how sines and exponentials are rounded is up to the C library, to numpy and to the kind of processor, and is
told as a hash of what they answer here. An imported OSM town is read by osmium. Pictures are drawn by moderngl in a
context of glcontext, and filtered by OpenCV.

Not here, because they only carry or show what was computed: msgspec, pandas, PyAV, rich, typer.
"""

from __future__ import annotations

import platform
from functools import lru_cache
from importlib.metadata import PackageNotFoundError, version

from cosim.core.arithmetic import arithmetic

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

ENGINES = {"SUMO": "libsumo", "PyBullet": "pybullet", "Zenoh": "eclipse-zenoh", "moderngl": "moderngl"}
"""Name for humans -> distribution."""


@lru_cache(maxsize=1)
def versions() -> dict[str, str]:
    """Version of each package by distribution name, of `geos` as shapely loaded it, and the `arithmetic` of
    this machine (`cosim.core.arithmetic`). Machines of which all of it is the same simulate the same to the bit."""
    import shapely

    found = {package: version(package) for package in RECORDED_PACKAGES}
    return {**found, "geos": shapely.geos_version_string, "arithmetic": arithmetic()}


def versions_in_words() -> str:
    """Versions of the project, Python and the engines, for humans; nothing is imported to find them."""
    engines = ", ".join(f"{name} {_installed(package)}" for name, package in ENGINES.items())
    return f"cosim {_installed('sidewalk-cosim')}, Python {platform.python_version()}\n{engines}"


def _installed(package: str) -> str:
    try:
        return version(package)
    except PackageNotFoundError:
        return "missing"
