"""Light: valid ranges, and storage in suite files."""

from __future__ import annotations

from pathlib import Path

import pytest

from cosim.core.errors import SpecError
from cosim.spec.scenario import City, Light, Scenario, Suite, read_suite, write_suite


def scenario(light: Light) -> Scenario:
    return Scenario(
        id="s",
        suite="t",
        place=City(seed=1),
        seed=1,
        start=(0.0, 0.0, 0.0),
        goal=(9.0, 0.0),
        route=((0.0, 0.0), (9.0, 0.0)),
        light=light,
    )


@pytest.mark.parametrize(
    ("field", "value", "valid"),
    [
        ("hour", 24.5, "[0, 24]"),
        ("day_of_year", 0, "[1, 366]"),
        ("latitude_deg", float("nan"), "[-90, 90]"),
        ("cloud_cover", 1.1, "[0, 1]"),
        ("fog_m", 0.0, "[10, 50000]"),
        ("exposure_ev", -5.0, "[-4, 4]"),
    ],
)
def test_a_light_out_of_range_is_refused(field: str, value: float, valid: str) -> None:
    """The message names the field, the valid range and the value."""
    with pytest.raises(SpecError) as refused:
        Light(**{field: value})
    assert str(refused.value) == f"light {field} must be in {valid}, not {value}"


def test_a_sky_picture_must_be_a_radiance_file() -> None:
    """Only Radiance files are skies of users."""
    with pytest.raises(
        SpecError, match=r"light hdri must be a Radiance \.hdr file, not 'sky\.exr'"
    ):
        Light(hdri="sky.exr")


def test_light_survives_a_suite_file(tmp_path: Path) -> None:
    """Each scenario is read back with its light, and an invalid light is refused with file and
    field."""
    suite = Suite(name="t", version="1", scenarios=(scenario(Light(hour=20.0, fog_m=80.0)),))
    write_suite(suite, tmp_path / "s.json")
    assert read_suite(tmp_path / "s.json") == suite
    text = (tmp_path / "s.json").read_text()
    assert '"hour":20.0' in text
    (tmp_path / "bad.json").write_text(text.replace('"fog_m":80.0', '"fog_m":-80.0'))
    with pytest.raises(
        SpecError, match=r"bad\.json: light fog_m must be in \[10, 50000\], not -80\.0"
    ):
        read_suite(tmp_path / "bad.json")
