"""Square textures of one size, stacked as a texture array.

Albedo of a texel, with linear values (decoded from sRGB; filtering and mip-maps are linear,
GL_SRGB8_ALPHA8):

    surface with a tint:   mix(rgb, rgb / mean * tint, alpha)
    surface without tint:  rgb
    facade over a wall:    rgb + alpha * wall, with premultiplied rgb

Alpha is the fraction of tint in a surface (mortar keeps its colour), or the visible fraction of the
wall behind a facade.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import NDArray

from cosim.core.cache import Arrays, mapped_arrays, sources_hash
from cosim.core.errors import SpecError, UsageError, unknown
from physics.textures.noise import Field, Noise

Rgb = NDArray[np.floating[Any]]
"""(S, S, 3) sRGB image, 0 to 1."""
Colour = tuple[float, float, float]
"""Red, green and blue, 0 to 1."""

SIZES: Final = (256, 512, 1024)
"""Allowed texture sizes in pixels."""

_SOURCES_KEY: Final = sources_hash(Path(__file__).parent)
"""Cache key part: hash of the sources."""


@dataclass(frozen=True, slots=True)
class Layers:
    """Texture layers of one size S. Arrays are read-only.

    names: L unique names
    rgba: (L, S, S, 4) uint8 sRGB, rows from the top
    metres: (L, 2) width and height in the world
    mean: (L, 3) linear mean colour
    finish: (L, S, S, 2) uint8 gloss (mirror reflection of panes) and glow (emitted light at night)
    """

    names: tuple[str, ...]
    rgba: NDArray[np.uint8]
    metres: NDArray[np.float32]
    mean: NDArray[np.float32]
    finish: NDArray[np.uint8] | None = None

    def __len__(self) -> int:
        return len(self.names)

    def index(self, name: str) -> int:
        """Return the index of a layer.

        Raises: UsageError with the valid names
        """
        try:
            return self.names.index(name)
        except ValueError:
            raise unknown("texture layer", name, self.names) from None


@dataclass(frozen=True, slots=True)
class Picture:
    """One layer before it is stacked.

    rgb: (S, S, 3) sRGB
    alpha: (S, S); None is 1
    finish: (S, S, 2) gloss and glow
    """

    rgb: Rgb
    alpha: Field | None = None
    finish: Rgb | None = None


Generator = Callable[[Noise], Picture]


@dataclass(frozen=True, slots=True)
class Recipe:
    """Generator of a layer and the size in metres: the side of a square, or width and height."""

    metres: float | tuple[float, float]
    make: Generator


def stack_layers(kind: str, recipes: Mapping[str, Recipe], size_px: int, seed: int) -> Layers:
    """Return the layers of all recipes from the cache, or generate them.

    kind: name of the stack in the cache

    Each layer has its own random generator, so new layers change no others.
    """
    if size_px not in SIZES:
        raise SpecError(
            f"a texture's size_px must be one of {', '.join(map(str, SIZES))}, not {size_px}"
        )
    arrays = mapped_arrays(
        f"{kind}-{size_px}-{seed}", _SOURCES_KEY, lambda: _generate(recipes, size_px, seed)
    )
    metres = np.array(
        [np.broadcast_to(recipe.metres, 2) for recipe in recipes.values()], np.float32
    )
    metres.flags.writeable = False
    return Layers(tuple(recipes), arrays["rgba"], metres, arrays["mean"], arrays.get("finish"))


def _generate(recipes: Mapping[str, Recipe], size_px: int, seed: int) -> Arrays:
    """Generate all layers."""
    made: dict[str, NDArray[Any]] = {
        "rgba": np.empty((len(recipes), size_px, size_px, 4), np.uint8),
        "mean": np.empty((len(recipes), 3), np.float32),
    }
    for k, (name, recipe) in enumerate(recipes.items()):
        picture = recipe.make(Noise(size_px, (seed, *name.encode())))
        rgb = as_uint8(picture.rgb)
        made["rgba"][k, ..., :3] = rgb
        made["rgba"][k, ..., 3] = 255 if picture.alpha is None else as_uint8(picture.alpha)
        made["mean"][k] = mean_linear(rgb)
        if picture.finish is not None:
            made.setdefault("finish", np.zeros((len(recipes), size_px, size_px, 2), np.uint8))
            made["finish"][k] = as_uint8(picture.finish)
    return made


def join_layers(*stacks: Layers) -> Layers:
    """Return several stacks of one size as one, without finishes.

    Raises: UsageError if sizes differ or names repeat
    """
    names = tuple(name for stack in stacks for name in stack.names)
    if len(set(names)) != len(names) or len({stack.rgba.shape[1] for stack in stacks}) != 1:
        raise UsageError(
            "stacks of textures are joined when they are of one size and share no name"
        )
    arrays = (
        np.concatenate([getattr(stack, field) for stack in stacks])
        for field in ("rgba", "metres", "mean")
    )
    return Layers(names, *arrays)


def srgb_to_linear(srgb: NDArray[np.floating] | Colour) -> NDArray[np.float32]:
    """Decode sRGB values from 0 to 1 (IEC 61966-2-1)."""
    s = np.asarray(srgb, dtype=np.float32)
    return np.where(s <= 0.04045, s / 12.92, ((np.maximum(s, 0.0) + 0.055) / 1.055) ** 2.4).astype(
        np.float32
    )


def linear_to_srgb(value: NDArray[np.floating]) -> NDArray[np.float32]:
    """Encode linear values from 0 to 1 as sRGB (IEC 61966-2-1)."""
    v = np.clip(np.asarray(value, dtype=np.float32), 0.0, 1.0)
    return np.where(v <= 0.0031308, 12.92 * v, 1.055 * v ** (1 / 2.4) - 0.055).astype(np.float32)


LINEAR_OF_SRGB_BYTE: Final = srgb_to_linear(np.arange(256) / 255.0)
"""(256,) linear values of sRGB bytes."""


def as_uint8(values: NDArray[np.floating[Any]]) -> NDArray[np.uint8]:
    """Return values from 0 to 1 as rounded and clipped bytes."""
    return np.asarray(cv2.convertScaleAbs(np.maximum(values, 0.0), alpha=255.0), dtype=np.uint8)


def mean_linear(rgb: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Return the (3,) linear mean of an sRGB image (..., 3)."""
    counts = [cv2.calcHist([rgb], [c], None, [256], [0, 256]).ravel() for c in range(3)]
    return np.array(
        [LINEAR_OF_SRGB_BYTE @ count / count.sum() for count in counts], dtype=np.float32
    )
