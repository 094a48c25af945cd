"""The sky: position, brightness and colour of the sun, and users' pictures."""

from __future__ import annotations

import math
from pathlib import Path

import cv2
import numpy as np
import pytest

from cosim.core.errors import SpecError
from cosim.spec.scenario import Light
from physics.cameras.sky import LUMINANCE, directions, irradiance, sky_of
from physics.cameras.sun import sun_direction

ASSETS = Path(__file__).parents[3] / "shared" / "assets" / "hdri"
UP = np.array([0.0, 0.0, 1.0])


def luminance(colour: np.ndarray) -> float:
    return float(colour @ LUMINANCE)


@pytest.mark.parametrize("latitude", [0.0, 30.0, 48.0, -35.0])
def test_the_equinox_sun_stands_at_90_degrees_less_the_latitude(latitude: float) -> None:
    """On day 81 at noon the sun is in the south of the northern hemisphere, and it rises due
    east."""
    noon, morning = sun_direction(12.0, 81, latitude), sun_direction(6.0, 81, latitude)
    assert math.degrees(math.asin(noon[2])) == pytest.approx(90.0 - abs(latitude), abs=1e-6)
    assert noon[0] == pytest.approx(0.0, abs=1e-12)
    assert noon[1] == pytest.approx(-math.sin(math.radians(latitude)), abs=1e-12)
    assert morning == pytest.approx([1.0, 0.0, 0.0], abs=1e-12)


def test_midsummer_follows_the_tilt_of_the_earth() -> None:
    """On day 172 at 48 N noon is at 90 - 48 + 23.45 degrees, and sunrise at cos w = -tan(48)
    tan(23.45), 4.08 h solar time."""
    assert math.degrees(math.asin(sun_direction(12.0, 172, 48.0)[2])) == pytest.approx(
        65.45, abs=0.01
    )
    rise_h = (
        12.0
        - math.degrees(math.acos(-math.tan(math.radians(48.0)) * math.tan(math.radians(23.45))))
        / 15.0
    )
    assert rise_h == pytest.approx(4.08, abs=0.01)
    assert sun_direction(rise_h, 172, 48.0)[2] == pytest.approx(0.0, abs=1e-3)
    assert np.linalg.norm(sun_direction(9.3, 40, 61.0)) == pytest.approx(1.0)


def test_a_uniform_sky_lights_any_surface_to_one() -> None:
    """Radiance 1 everywhere lights any white surface to 1; from above only, a wall gets half."""
    rows = 64
    ones = np.ones((rows, 2 * rows, 3), np.float32)
    above = np.where(directions(rows)[..., 2:] > 0.0, ones, 0.0)
    assert irradiance(ones, UP) == pytest.approx([1.0] * 3, rel=2e-3)
    assert irradiance(above, UP) == pytest.approx([1.0] * 3, rel=2e-3)
    assert irradiance(above, np.array([1.0, 0.0, 0.0])) == pytest.approx([0.5] * 3, rel=2e-3)


def test_the_brightest_pixel_is_at_the_sun() -> None:
    """The brightest pixel of a clear sky is in the direction of the sun."""
    sky = sky_of(Light(hour=9.0, cloud_cover=0.0))
    rows = len(sky.radiance)
    row, column = np.unravel_index(int(np.argmax(sky.radiance @ LUMINANCE)), (rows, 2 * rows))
    u = 0.5 - math.atan2(sky.sun[1], sky.sun[0]) / (2 * math.pi)
    v = 0.5 - math.asin(sky.sun[2]) / math.pi
    assert abs(row - v * rows) < 1.5 and abs(column - u * 2 * rows) < 1.5
    assert directions(rows)[row, column] @ sky.sun > 0.999


@pytest.mark.parametrize("cover", [0.0, 0.6, 1.0])
@pytest.mark.parametrize("hour", [0.0, 4.5, 12.0, 20.0])
def test_every_sky_is_finite_and_exposed(hour: float, cover: float) -> None:
    """Radiance is never negative, and a grey card in the open is neither black nor white."""
    sky = sky_of(Light(hour=hour, cloud_cover=cover), seed=3)
    assert np.isfinite(sky.radiance).all() and sky.radiance.min() >= 0.0
    card = 0.4 * (sky.ambient[0] + sky.sun_colour * max(float(sky.sun[2]), 0.0)) * sky.exposure
    filmic = np.clip(card * (2.51 * card + 0.03) / (card * (2.43 * card + 0.59) + 0.14), 0.0, 1.0)
    assert 0.04 < luminance(filmic) < 0.75


def test_daylight_falls_under_clouds_at_dusk_and_at_night() -> None:
    """Overcast leaves a sixth to a third of noon's light, dusk less than a hundredth, and night
    only lamps."""

    def open_ground(light: Light) -> float:
        sky = sky_of(light)
        return luminance(sky.ambient[0] + sky.sun_colour * max(float(sky.sun[2]), 0.0))

    noon, late = (
        open_ground(Light(hour=12.0, cloud_cover=0.0)),
        open_ground(Light(hour=18.0, cloud_cover=0.0)),
    )
    closed, dusk, night = (
        open_ground(Light(hour=h, cloud_cover=c)) for h, c in ((12.0, 1.0), (20.3, 0.0), (0.0, 0.0))
    )
    assert 0.75 < noon < 1.1 and 0.2 < late / noon < 0.6
    assert 1 / 6 < closed / noon < 1 / 3
    assert 1e-4 < dusk / noon < 1e-2 and 1e-4 < night / noon < 1e-3
    assert sky_of(Light(hour=0.0)).lamps == 1.0 and sky_of(Light(hour=12.0)).lamps == 0.0


def test_fog_leaves_five_percent_of_contrast_at_its_visibility() -> None:
    """Thick fog also removes the sun's shadows and greys the sky."""
    sky = sky_of(Light(fog_m=60.0, cloud_cover=0.0))
    assert math.exp(-sky.fog_per_m * 60.0) == pytest.approx(0.05)
    assert sky.fog_colour.max() / sky.fog_colour.min() < 1.3
    assert luminance(sky.sun_colour) < 0.05 * luminance(sky_of(Light(cloud_cover=0.0)).sun_colour)


def test_exposure_follows_the_stops() -> None:
    """One stop more doubles the exposure and changes nothing else."""
    plain = sky_of(Light())
    brighter = sky_of(Light(exposure_ev=1.0))
    assert brighter.exposure == pytest.approx(2.0 * plain.exposure)
    assert np.array_equal(plain.radiance, brighter.radiance)


def write_sky_picture(path: Path, rows: int = 128, columns: int = 256) -> np.ndarray:
    """Write a grey sky with a sun of 9 pixels at 30 degrees over the north."""
    sky = np.full((rows, columns, 3), 0.5, np.float32)
    sky[rows // 3 - 1 : rows // 3 + 2, columns // 4 - 1 : columns // 4 + 2] = 80.0
    assert cv2.imwrite(str(path), sky)
    return sky


def test_the_sun_of_a_users_picture_is_extracted(tmp_path: Path) -> None:
    """The sun is at the brightest spot, and its light is removed from the ambient light."""
    path = tmp_path / "sky.hdr"
    write_sky_picture(path)
    sky = sky_of(Light(hdri=str(path)))
    assert sky.sun == pytest.approx([0.0, math.cos(math.pi / 6), 0.5], abs=0.06)
    assert luminance(sky.ambient[0] + sky.sun_colour * sky.sun[2]) == pytest.approx(1.0, rel=1e-3)
    # Nine pixels of 79.5 more than the sky, each (pi / 128)^2 cos 30 deg of a sphere, over pi; the
    # sky gives 0.5.
    light = 9 * 79.5 * (math.pi / 128) ** 2 * math.cos(math.pi / 6) / math.pi
    assert (
        luminance(sky.sun_colour) == pytest.approx(light / (0.5 + 0.5 * light), rel=0.02)
        and sky.shadows
    )


def test_broken_pictures_are_named(tmp_path: Path) -> None:
    """Missing, invalid, truncated, square and black pictures have different messages, each with its
    file."""
    path = tmp_path / "sky.hdr"
    light = Light(hdri=str(path))

    def refusal() -> str:
        sky_of.cache_clear()
        with pytest.raises(SpecError) as error:
            sky_of(light)
        assert str(path) in str(error.value)
        return str(error.value)

    assert "does not exist" in refusal()
    path.write_bytes(b"PNG")
    assert "is no Radiance picture" in refusal()
    path.write_bytes(b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y 32 +X 64\n\x02\x02")
    assert "cannot be decoded" in refusal()
    write_sky_picture(path, 256, 256)
    assert "is 256 x 256 pixels" in refusal()
    cv2.imwrite(str(path), np.zeros((32, 64, 3), np.float32))
    assert "black above the horizon" in refusal()


@pytest.mark.skipif(not ASSETS.is_dir(), reason="the shared HDRI skies are not here")
@pytest.mark.parametrize("name", ["kiara_1_dawn_1k", "potsdamer_platz_1k", "venice_sunset_1k"])
def test_photographed_skies_load(name: str) -> None:
    """Real panoramas give a sun above the horizon and finite light."""
    sky = sky_of(Light(hdri=str(ASSETS / f"{name}.hdr")))
    assert (
        sky.sun[2] > 0.0
        and np.isfinite(sky.radiance).all()
        and sky.radiance.shape == (512, 1024, 3)
    )
