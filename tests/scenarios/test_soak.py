"""Long simulation of a place: crowd and traffic around bodies that move anywhere, in another
process."""

from __future__ import annotations

import pytest

from cosim.spec.scenario import CityMap
from scenarios.tools.bench.places import endure

pytestmark = pytest.mark.engine

MAP = "sumo-fkk-in"


def test_a_map_is_simulated_to_the_end() -> None:
    """A net that comes with SUMO is simulated with about the requested persons and cars, and
    progress is reported."""
    shares: list[float] = []
    done = endure(
        CityMap(map=MAP),
        seed=1,
        minutes=0.5,
        progress=lambda _, share=None: shares.append(share or 0.0),
    )
    assert shares == sorted(shares) and shares[-1] == 1.0 and len(shares) > 1
    assert done.reason == "" and done.ticks == 600
    assert done.persons > 40 and done.vehicles > 10
