"""Separate checks of the foundations: each engine, arithmetic, textures, and the source of each
package.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
import shapely

import cosim
from cosim.core.errors import EngineError
from physics.cameras.driver_check import driver_alone
from physics.dynamics.bullet import bullet_fingerprint
from physics.textures.facades import facade_layers
from physics.textures.ground import ground_layers
from physics.textures.walls import prop_layers, wall_layers
from sumo_nets.net.engine_check import reference_hashes

TOP_FOLDERS: Final = ("cosim", "sumo_nets", "physics", "bridge", "scenarios")
DRIVER: Final = "OpenGL driver"
_STACKS: Final = (ground_layers, wall_layers, prop_layers, facade_layers)
_PX: Final = 256


def engines_alone() -> dict[str, str]:
    """Return hashes of a task for each engine without code of the project.

    The driver is absent if the machine has none. No SUMO may run in this process.
    """
    hashes = {**_arithmetic(), **reference_hashes(), **bullet_fingerprint()}
    try:
        return {**hashes, DRIVER: driver_alone()}
    except EngineError:
        return hashes


def _arithmetic() -> dict[str, str]:
    x = np.linspace(-6.0, 9.0, 10_001)
    with_numpy = [f(x) for f in (np.sin, np.cos, np.exp, np.arctan, np.tanh)]
    with_numpy += [np.hypot(x, x[::-1]), np.arctan2(x, x[::-1]), np.log(np.abs(x) + 0.1)]
    by_libm = [
        f(v) for v in x[::50].tolist() for f in (math.sin, math.cos, math.exp, math.atan, math.tanh)
    ]
    blob = shapely.union_all(shapely.buffer(shapely.points(x[::500], np.sin(x[::500])), 0.7))
    return {
        "numpy": _hash(*with_numpy),
        "C library": _hash(np.array(by_libm)),
        "shapely": _hash(shapely.get_coordinates(blob)),
    }


def textures() -> dict[str, str]:
    """Return a hash of each texture by its name."""
    hashes: dict[str, str] = {}
    for stack in _STACKS:
        layers = stack(_PX)
        for i, name in enumerate(layers.names):
            finish = [] if layers.finish is None else [layers.finish[i]]
            hashes[f"{stack.__name__.removesuffix('_layers')} {name}"] = _hash(
                layers.rgba[i], *finish
            )
    return hashes


def source_hashes(root: Path | None = None) -> dict[str, str]:
    """Return a hash of the source of each package, such as "physics/textures".

    Files outside packages count for their top folder.
    """
    root = Path(cosim.__file__).parents[1] if root is None else root
    sources: dict[str, list[Path]] = {}
    for top in TOP_FOLDERS:
        for path in sorted([*(root / top).rglob("*.py"), *(root / top).rglob("*.urdf")]):
            inside = path.relative_to(root).parts
            sources.setdefault("/".join(inside[: 2 if len(inside) > 2 else 1]), []).append(path)
    return {room: _source_hash(root, paths) for room, paths in sources.items()}


def _source_hash(root: Path, paths: Sequence[Path]) -> str:
    seen = hashlib.blake2b(digest_size=8)
    for path in paths:
        seen.update(path.relative_to(root).as_posix().encode() + b"\0" + path.read_bytes() + b"\0")
    return seen.hexdigest()


def _hash(*arrays: np.ndarray[Any, Any]) -> str:
    seen = hashlib.blake2b(digest_size=8)
    for array in arrays:
        seen.update(np.ascontiguousarray(array).tobytes())
    return seen.hexdigest()
