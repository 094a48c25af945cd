"""What a scenario may ask of its crowd."""

from __future__ import annotations

import msgspec
import pytest

from cosim.core.errors import SpecError
from cosim.spec.scenario import City, CrowdSpec, Scenario, content_hash


def test_a_density_comes_back_from_its_file() -> None:
    """With and without one."""
    for spec in (CrowdSpec(persons=12), CrowdSpec(density=32.5)):
        assert msgspec.json.decode(msgspec.json.encode(spec), type=CrowdSpec) == spec


def test_a_density_that_makes_no_sense_is_refused() -> None:
    """Too many, less than nobody, and a density beside a number of persons."""
    for density in (-1.0, 400.0):
        with pytest.raises(SpecError, match=r"crowd density must be in \[0, 150\] per 1000 m2"):
            CrowdSpec(density=density)
    with pytest.raises(SpecError, match=r"give persons \(20\) or density \(30\), not both"):
        CrowdSpec(persons=20, density=30.0)


def test_shares_that_cannot_be_are_refused() -> None:
    """Shares beyond 0 to 1, more children than groups can take, more elderly than there are
    others."""
    for field in ("groups", "elderly", "children"):
        with pytest.raises(SpecError, match=rf"crowd {field} must be a share in \[0, 1\], not 1.2"):
            CrowdSpec(**{field: 1.2})
    with pytest.raises(
        SpecError,
        match=r"crowd children must be in \[0, groups / 2\] = \[0, 0.1\], not 0.2.*groups of 0.4",
    ):
        CrowdSpec(groups=0.2, children=0.2)
    with pytest.raises(
        SpecError, match=r"crowd elderly must be in \[0, 1 - 2 children\] = \[0, 0.4\], not 0.5"
    ):
        CrowdSpec(groups=0.8, children=0.3, elderly=0.5)


def test_every_field_of_a_scenario_is_in_its_hash() -> None:
    """Defaults too: a default that changes, changes every hash. Clear weather alone is left out."""
    scenario = Scenario(
        id="a",
        suite="s",
        place=City(seed=1),
        seed=2,
        start=(0.0, 0.0, 0.0),
        goal=(9.0, 0.0),
        route=((0.0, 0.0), (9.0, 0.0)),
    )
    tree = msgspec.to_builtins(scenario)
    assert set(tree) == {*Scenario.__struct_fields__} - {"weather"} and set(tree["crowd"]) == set(
        CrowdSpec.__struct_fields__
    )
    assert content_hash(msgspec.convert(tree, Scenario)) == content_hash(scenario)
    assert content_hash(
        msgspec.structs.replace(scenario, crowd=CrowdSpec(groups=0.4))
    ) != content_hash(scenario)
