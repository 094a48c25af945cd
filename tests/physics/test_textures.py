"""Textures: they tile, they are the same in every process, colours can be put on them, and every
name is there."""

from __future__ import annotations

import subprocess
import sys
import zlib

import numpy as np
import pytest

from cosim.core.errors import SpecError, UsageError
from physics.ground.materials import PAVINGS
from physics.ground.tiles import SURFACES
from physics.textures.facades import BAY_VARIANTS, DOORS, STREETS, WALL_STYLES, facade_layers
from physics.textures.ground import GROUND_RECIPES, SURFACE_LAYERS, ground_layers, layer_of
from physics.textures.layers import Layers, encoded, joined_layers, linear
from physics.textures.noise import Noise, cells
from physics.textures.surface import basket, courses, herringbone
from physics.textures.walls import prop_layers, wall_layers

STACKS = (ground_layers, wall_layers, prop_layers, facade_layers)


def rough(picture: np.ndarray, axis: int) -> np.ndarray:
    """Mean absolute step between neighbouring rows (or columns), the last to the first included."""
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


def test_a_seam_would_be_seen() -> None:
    """The measure of the test above finds a picture whose edges do not meet."""
    ramp = np.tile(np.arange(64, dtype=np.uint8)[:, None, None], (1, 64, 3))
    assert rough(ramp, 0)[-1] > 10 * rough(ramp, 0)[:-1].max()


def test_textures_are_the_same_in_every_process() -> None:
    """Another process draws the same bytes; another seed draws others."""
    code = (
        "import zlib\nfrom physics.textures.ground import ground_layers\n"
        "from physics.textures.facades import facade_layers\n"
        "print([zlib.crc32(f(256).rgba) for f in (ground_layers, facade_layers)])"
    )
    said = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert said.stdout.strip() == str(
        [zlib.crc32(f(256).rgba) for f in (ground_layers, facade_layers)]
    )
    assert not np.array_equal(ground_layers(256, 1).rgba, ground_layers(256).rgba)


def test_a_tint_becomes_the_mean_colour() -> None:
    """texture / mean * tint has the tint as its linear mean, for every layer of ground and walls
    without a mask."""
    tint = linear((0.5, 0.4, 0.3))
    for layers in (ground_layers(256), wall_layers(256)):
        albedo = linear(layers.rgba[..., :3] / 255.0) / layers.mean[:, None, None] * tint
        assert np.allclose(albedo.mean(axis=(1, 2)), tint, atol=2e-3)


def test_every_name_in_the_tables_is_a_layer() -> None:
    """Surfaces and styles of walls name layers that exist, and every surface of the ground has
    one."""
    for names in SURFACE_LAYERS.values():
        assert set(names) <= set(GROUND_RECIPES)
    walls, facades = set(wall_layers(256).names), set(facade_layers(256).names)
    for style in WALL_STYLES.values():
        assert {*style.walls, *style.roofs} <= walls
        fronts = {bay for name in style.fronts for bay in (DOORS[name].between, DOORS[name].door)}
        assert {
            f"{name}-{k}" for name in (*style.uppers, *fronts) for k in range(BAY_VARIANTS)
        } <= facades
    assert all(1 <= front.every <= 15 for front in DOORS.values())
    assert {name for names in STREETS.values() for name in names} <= set(WALL_STYLES)
    for surface in (*SURFACES, *PAVINGS):
        assert (
            layer_of(surface)
            in SURFACE_LAYERS[surface.split(":")[1] if ":" in surface else surface]
            or "road" in surface
        )
    assert len({layer_of("sidewalk:brick:0", seed) for seed in range(20)}) == len(
        SURFACE_LAYERS["brick"]
    )


def test_a_facade_lets_the_wall_through_where_there_is_no_window() -> None:
    """The middle of a sash window hides the wall, the corner of the bay shows it alone."""
    layers = facade_layers(256)
    sash = layers.rgba[layers.index("sash-0")]
    assert sash[105, 115, 3] == 0 and sash[105, 115, :3].max() > 20
    assert sash[2, 2].tolist() == [0, 0, 0, 255]
    assert layers.finish is not None and layers.finish[layers.index("sash-0"), 105, 115, 0] == 255
    assert layers.metres[0].tolist() == pytest.approx([3.0, 3.2])


@pytest.mark.parametrize(
    ("bond", "area_m2"),
    [
        (courses(256, 1.6, 16, [0.2], [0.0, 0.5]), 0.02),
        (herringbone(256, 1.6, 0.1), 0.02),
        (basket(256, 1.6, 0.1), 0.02),
        (courses(256, 2.4, 6, [0.6], [0.0, 0.5]), 0.24),
    ],
)
def test_bonds_are_laid_of_equal_stones(bond: object, area_m2: float) -> None:
    """Every stone of a bond has the area of one, and no pixel is farther from a joint than half its
    width."""
    ids, edge = bond.id, bond.edge  # type: ignore[attr-defined]
    side_m = 2.4 if area_m2 > 0.1 else 1.6
    counts = np.unique(ids, return_counts=True)[1]
    assert len(counts) == round(side_m**2 / area_m2)
    assert np.allclose(counts * (side_m / 256) ** 2, area_m2, rtol=0.12)
    assert edge.min() >= 0.0 and 0.4 * 0.1 < edge.max() <= 0.5 * (0.4 if area_m2 > 0.1 else 0.1)


def test_cells_meet_over_the_edges() -> None:
    """Scattered cells keep their number over the picture's edge nearly everywhere."""
    found = cells(Noise(256, (1,)), 8)
    assert found.n == 64 and len(np.unique(found.id)) == 64
    assert (
        np.mean(found.id[0] == found.id[-1]) > 0.8
        and np.mean(found.id[:, 0] == found.id[:, -1]) > 0.8
    )


def test_colours_are_decoded_as_the_standard_says() -> None:
    """sRGB 0.5 is 0.214 linear, and encoding undoes decoding."""
    assert linear((0.0, 0.5, 1.0)) == pytest.approx([0.0, 0.21404, 1.0], abs=1e-4)
    assert encoded(linear(np.linspace(0.0, 1.0, 11))) == pytest.approx(
        np.linspace(0.0, 1.0, 11), abs=1e-5
    )


def test_wrong_sizes_and_names_are_told() -> None:
    """A size that is none, an unknown layer and stacks that do not fit are refused."""
    with pytest.raises(SpecError, match="size_px must be one of 256, 512, 1024, not 100"):
        ground_layers(100)
    with pytest.raises(
        UsageError, match=r"unknown texture layer 'lava'\. Valid choices: .*asphalt,"
    ):
        ground_layers(256).index("lava")
    with pytest.raises(UsageError, match="one size"):
        joined_layers(ground_layers(256), wall_layers(512))
    whole = joined_layers(ground_layers(256), wall_layers(256))
    assert len(whole) == len(ground_layers(256)) + len(wall_layers(256))
