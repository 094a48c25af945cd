"""What a scenario may ask of its crowd."""

from __future__ import annotations

import msgspec
import pytest

from cosim.errors import SpecError
from cosim.scenario import CrowdSpec


def test_a_crowd_without_density_does_not_mention_it() -> None:
    """Specs written before there were densities keep their bytes, and so their hashes; a density comes back."""
    assert b"density" not in msgspec.json.encode(CrowdSpec(persons=12))
    dense = CrowdSpec(density=32.5)
    assert msgspec.json.decode(msgspec.json.encode(dense), type=CrowdSpec) == dense


def test_a_density_that_makes_no_sense_is_refused() -> None:
    """Too many, less than nobody, and a density beside a number of persons."""
    for density in (-1.0, 400.0):
        with pytest.raises(SpecError, match=r"crowd density must be in \[0, 150\] per 1000 m2"):
            CrowdSpec(density=density)
    with pytest.raises(SpecError, match=r"give persons \(20\) or density \(30\), not both"):
        CrowdSpec(persons=20, density=30.0)
