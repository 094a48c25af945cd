"""Stored tiles: tiles that are read equal tiles that are made."""

from __future__ import annotations

import ast
import dataclasses
import os
from importlib.metadata import packages_distributions
from pathlib import Path

import numpy as np
import pytest
import shapely

from cosim.core import cache as cache_module
from cosim.core.errors import EngineError
from cosim.place.street_map import StreetMap
from cosim.place.terrain import Terrain
from cosim.spec.scenario import City
from physics.cameras.gl.context import available
from physics.ground.tiles import tile_at, tile_bounds, tiles_within
from physics.street import street_surface
from physics.street import tile_cache as kept_tiles
from physics.street.street_surface import StreetSurface
from scenarios.places.nets import place, surface_of_place
from tests.conftest import ROOT
from tests.support import episode_order

CITY = City(seed=1, size_m=500.0)


@pytest.fixture
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return a cache with all entries of the tests' own, except tiles."""
    place(CITY)
    folder = tmp_path / "cache"
    folder.mkdir()
    for held in cache_module.cache_folder().iterdir():
        if held.name != "tiles" and not held.name.startswith("."):
            (folder / held.name).symlink_to(held.resolve())
    monkeypatch.setenv("COSIM_CACHE", str(folder))
    return folder


def forbid_making_tiles(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let every attempt to make a tile fail."""

    def fails(*_: object, **__: object) -> None:
        raise EngineError("a tile was made")

    for maker in ("build_tile", "land_covers", "frontage_covers", "tile_markings"):
        monkeypatch.setattr(street_surface, maker, fails)
    monkeypatch.setattr(street_surface.PropPlacement, "in_tile", fails)


def hilly(street_map: StreetMap) -> StreetMap:
    heights = np.random.default_rng(1).uniform(0.0, 3.0, (30, 30)).astype(np.float32)
    return dataclasses.replace(
        street_map, terrain=Terrain(-50.0, -50.0, 25.0, heights)
    ).with_input_hash("hilly")


def equal(first: object, second: object) -> bool:
    """Return whether two values are the same to the bit, with their arrays and shapes."""
    if type(first) is not type(second):
        return False
    if isinstance(first, np.ndarray):
        assert isinstance(second, np.ndarray)
        same_layout = (first.dtype, first.shape, first.flags.c_contiguous) == (
            second.dtype,
            second.shape,
            second.flags.c_contiguous,
        )
        return same_layout and first.tobytes() == second.tobytes()
    if isinstance(first, shapely.Geometry):
        return shapely.to_wkb(first) == shapely.to_wkb(second)
    if isinstance(first, dict):
        return [*first] == [*second] and all(map(equal, first.values(), second.values()))  # type: ignore[call-overload,attr-defined]
    if isinstance(first, list | tuple):
        return len(first) == len(second) and all(map(equal, first, second))  # type: ignore[arg-type]
    if dataclasses.is_dataclass(first):
        names = [field.name for field in dataclasses.fields(first)]
        return all(equal(getattr(first, name), getattr(second, name)) for name in names)
    return repr(first) == repr(second)


@pytest.mark.parametrize("ground", ["flat", "rough", "hilly"])
def test_stored_tiles_equal_made_ones(
    cache: Path, monkeypatch: pytest.MonkeyPatch, ground: str
) -> None:
    """Meshes, heights, houses, props and covers equal those of a map without stored tiles to the
    bit."""
    street_map = place(CITY)[1]
    street_map = hilly(street_map) if ground == "hilly" else street_map
    roughness = 0.6 if ground == "rough" else 0.0
    unstored = dataclasses.replace(street_map)
    assert street_map.input_hash and not unstored.input_hash
    keys = tiles_within(250.0, 250.0, 15.0)
    made = StreetSurface(unstored, 3, roughness)
    tiles = [made._built(key) for key in keys]
    wanted = [(tile.parts, tile.low, tile.crossings, tile.relief) for tile in tiles]
    chunks, finishes = [made.chunk(key) for key in keys], [made.finish(key) for key in keys]
    points = [
        np.random.default_rng(0).uniform(tile_bounds(key)[:2], tile_bounds(key)[2:], (300, 2))
        for key in keys
    ]
    heights = [tile.height(xy) for tile, xy in zip(tiles, points, strict=True)]
    assert sum(len(chunk.buildings) for chunk in chunks) and sum(
        len(chunk.props) for chunk in chunks
    )

    first = StreetSurface(street_map, 3, roughness)
    for key in keys:
        first.chunk(key)
    with monkeypatch.context() as patch:
        forbid_making_tiles(patch)
        stored = StreetSurface(street_map, 3, roughness)
        read = [stored.tile(key) for key in keys]
        assert equal([(tile.parts, tile.low, tile.crossings, tile.relief) for tile in read], wanted)
        assert equal([stored.chunk(key) for key in keys], chunks)
        assert equal([stored.heights(xy) for xy in points], heights)
    assert equal([stored.finish(key) for key in keys], finishes)


def test_stored_tiles_belong_to_one_place_seed_and_roughness(cache: Path) -> None:
    """Another seed, another roughness and a changed map do not use them."""
    street_map = place(CITY)[1]
    key = tile_at(250.0, 250.0)
    for surface in (
        StreetSurface(street_map, 3),
        StreetSurface(street_map, 4),
        StreetSurface(street_map, 3, 0.5),
    ):
        surface.tile(key)
    StreetSurface(dataclasses.replace(street_map, lanes={}), 3).tile(key)
    assert len([*(cache / "tiles").iterdir()]) == 3


def test_the_key_of_a_tile_covers_all_its_sources() -> None:
    """Modules that tiles import are in the hashed folders, or in the list of packages."""
    files = [path for room in kept_tiles._SOURCE_FOLDERS[2:5] for path in room.rglob("*.py")]
    bodies = {"bodies.py", "bullet.py", "drive.py", "gltf.py", "movers.py", "world.py"}
    trees = [ast.parse(path.read_text()) for path in files if path.name not in bodies]
    names = {
        node.module or ""
        for tree in trees
        for node in ast.walk(tree)
        if isinstance(node, ast.ImportFrom)
    }
    names |= {
        a.name
        for tree in trees
        for node in ast.walk(tree)
        if isinstance(node, ast.Import)
        for a in node.names
    }
    rooms = {".".join(room.relative_to(ROOT).parts) for room in kept_tiles._SOURCE_FOLDERS}
    ours = {name for name in names if name.startswith(("cosim.", "physics."))}
    assert {name for name in ours if not {name, name.rpartition(".")[0]} & rooms} <= {
        "cosim.spec.scenario",
        "cosim.spec.obstacle",
    }
    tops = {name.partition(".")[0] for name in names - ours} & packages_distributions().keys() - {
        "cosim",
        "physics",
    }
    packages = {package for top in tops for package in packages_distributions()[top]}
    assert packages - {"msgspec"} <= set(cache_module._ARRAY_PACKAGES)


@pytest.mark.engine
@pytest.mark.skipif(not available(), reason="no OpenGL through EGL here (see `cosim doctor`)")
def test_an_episode_is_the_same_with_stored_tiles(
    cache: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """State hash and pictures are equal when no tile is made, and when some are made again after
    files are lost."""
    scenario, manifest = next(iter(episode_order.drawn()))
    assert manifest.camera is not None

    def driven() -> str:
        surface_of_place.cache_clear()
        return episode_order.hash_of(scenario, manifest)

    made = driven()
    files = sorted(path for path in (cache / "tiles").rglob("*") if path.is_file())
    assert {path.name.partition("_")[0] for path in files} == {"ground", "things", "gl"}
    with monkeypatch.context() as patch:
        forbid_making_tiles(patch)
        assert driven() == made
    for path in files[::2]:
        path.unlink()
    os.truncate(files[1], 100)
    assert driven() == made
