"""A folder of maps that belongs to one module of tests."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from sumo_nets.maps.map_store import maps_folder


@pytest.fixture(scope="module")
def own_cache(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Maps are kept in a folder of this module's own."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("COSIM_CACHE", str(tmp_path_factory.mktemp("cache")))
        yield


def kept() -> list[str]:
    """Everything in the folder of maps, scratch folders included."""
    return sorted(p.name for p in maps_folder().iterdir()) if maps_folder().is_dir() else []
