"""The settings of a scenario's crowd."""

from __future__ import annotations

import msgspec
import pytest

from cosim.core.errors import SpecError
from cosim.spec.scenario import City, CrowdSpec, Scenario, content_hash


def test_a_crowd_survives_its_file() -> None:
    """A scenario reads back equal with and without a density."""
    for spec in (CrowdSpec(persons=12), CrowdSpec(density=32.5)):
        assert msgspec.json.decode(msgspec.json.encode(spec), type=CrowdSpec) == spec


def test_an_invalid_density_is_refused() -> None:
    """Too high, negative, and a density in addition to a number of persons are refused."""
    for density in (-1.0, 400.0):
        with pytest.raises(SpecError, match=r"crowd density must be in \[0, 150\] per 1000 m2"):
            CrowdSpec(density=density)
    with pytest.raises(SpecError, match=r"give persons \(20\) or density \(30\), not both"):
        CrowdSpec(persons=20, density=30.0)


def test_impossible_shares_are_refused() -> None:
    """They are outside 0 to 1, more children than groups can have, or more elderly people than
    remain."""
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
    """Defaults are included, so that a changed default changes every hash; only clear weather is
    left out."""
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
