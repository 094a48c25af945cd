"""A folder of maps for one module of tests."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from sumo_nets.maps.map_store import maps_folder


@pytest.fixture(scope="module")
def own_cache(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Store maps in a separate folder for the module."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("COSIM_CACHE", str(tmp_path_factory.mktemp("cache")))
        yield


def stored_maps() -> list[str]:
    """Return all names in the folder of maps, including scratch folders."""
    return sorted(p.name for p in maps_folder().iterdir()) if maps_folder().is_dir() else []
