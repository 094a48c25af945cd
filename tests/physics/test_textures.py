"""Textures: they tile, are equal in every process, take colours, and have every name."""

from __future__ import annotations

import subprocess
import sys
import zlib

import numpy as np
import pytest

from cosim.core.errors import SpecError, UsageError
from physics.ground.materials import PAVINGS
from physics.ground.tiles import SURFACES
from physics.textures.facades import (
    BAY_VARIANTS,
    FRONTS_BY_NAME,
    STREET_STYLES,
    WALL_STYLES,
    facade_layers,
)
from physics.textures.ground import GROUND_RECIPES, SURFACE_LAYERS, ground_layers, layer_of
from physics.textures.layers import Layers, join_layers, linear_to_srgb, srgb_to_linear
from physics.textures.walls import prop_layers, wall_layers

STACKS = (ground_layers, wall_layers, prop_layers, facade_layers)


def rough(picture: np.ndarray, axis: int) -> np.ndarray:
    """Return the mean absolute step between neighbouring rows (or columns), including the last to
    the first."""
    values = picture.astype(float)
    other = tuple(a for a in range(values.ndim) if a != axis)
    return np.asarray(np.abs(values - np.roll(values, -1, axis=axis)).mean(axis=other))


@pytest.mark.parametrize("stack", STACKS[:3], ids=lambda f: f.__name__)
def test_surfaces_have_no_seams(stack: object) -> None:
    """The step over a texture's edge is no larger than the largest one inside."""
    layers: Layers = stack(256)  # type: ignore[operator]
    for name, picture in zip(layers.names, layers.rgba[..., :3], strict=True):
        for axis in (0, 1):
            steps = rough(picture, axis)
            assert steps[-1] <= 1.05 * steps[:-1].max() + 0.5, (name, axis)


def test_textures_are_the_same_in_every_process() -> None:
    """Another process draws the same bytes, and another seed draws others."""
    code = (
        "import zlib\nfrom physics.textures.ground import ground_layers\n"
        "from physics.textures.facades import facade_layers\n"
        "print([zlib.crc32(f(256).rgba) for f in (ground_layers, facade_layers)])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == str(
        [zlib.crc32(f(256).rgba) for f in (ground_layers, facade_layers)]
    )
    assert not np.array_equal(ground_layers(256, 1).rgba, ground_layers(256).rgba)


def test_a_tint_becomes_the_mean_colour() -> None:
    """texture / mean * tint has the tint as its linear mean, for every layer of ground and walls
    without a mask."""
    tint = srgb_to_linear((0.5, 0.4, 0.3))
    for layers in (ground_layers(256), wall_layers(256)):
        albedo = srgb_to_linear(layers.rgba[..., :3] / 255.0) / layers.mean[:, None, None] * tint
        assert np.allclose(albedo.mean(axis=(1, 2)), tint, atol=2e-3)


def test_every_name_in_the_tables_is_a_layer() -> None:
    """Surfaces and wall styles name existing layers, and every surface of the ground has one."""
    for names in SURFACE_LAYERS.values():
        assert set(names) <= set(GROUND_RECIPES)
    walls, facades = set(wall_layers(256).names), set(facade_layers(256).names)
    for style in WALL_STYLES.values():
        assert {*style.walls, *style.roofs} <= walls
        fronts = {
            bay
            for name in style.fronts
            for bay in (FRONTS_BY_NAME[name].between, FRONTS_BY_NAME[name].door)
        }
        assert {
            f"{name}-{k}" for name in (*style.uppers, *fronts) for k in range(BAY_VARIANTS)
        } <= facades
    assert all(1 <= front.every <= 15 for front in FRONTS_BY_NAME.values())
    assert {name for names in STREET_STYLES.values() for name in names} <= set(WALL_STYLES)
    for surface in (*SURFACES, *PAVINGS):
        assert (
            layer_of(surface)
            in SURFACE_LAYERS[surface.split(":")[1] if ":" in surface else surface]
            or "road" in surface
        )
    assert len({layer_of("sidewalk:brick:0", seed) for seed in range(20)}) == len(
        SURFACE_LAYERS["brick"]
    )


def test_colours_are_decoded_by_the_srgb_standard() -> None:
    """sRGB 0.5 is 0.214 linear, and encoding inverts decoding."""
    assert srgb_to_linear((0.0, 0.5, 1.0)) == pytest.approx([0.0, 0.21404, 1.0], abs=1e-4)
    assert linear_to_srgb(srgb_to_linear(np.linspace(0.0, 1.0, 11))) == pytest.approx(
        np.linspace(0.0, 1.0, 11), abs=1e-5
    )


def test_wrong_sizes_and_names_are_refused() -> None:
    """An invalid size, an unknown layer and stacks that do not fit are refused."""
    with pytest.raises(SpecError, match="size_px must be one of 256, 512, 1024, not 100"):
        ground_layers(100)
    with pytest.raises(
        UsageError, match=r"unknown texture layer 'lava'\. Valid choices: .*asphalt,"
    ):
        ground_layers(256).index("lava")
    with pytest.raises(UsageError, match="one size"):
        join_layers(ground_layers(256), wall_layers(512))
    joined = join_layers(ground_layers(256), wall_layers(256))
    assert len(joined) == len(ground_layers(256)) + len(wall_layers(256))
