"""The lens: each effect against a hand-computed case, and no effect by default."""

from __future__ import annotations

import math

import numpy as np
import pytest

from cosim.core.errors import SpecError
from cosim.core.geometry import Pose
from cosim.core.state import Frame, RobotState
from cosim.spec.camera import CameraSpec, Lens
from cosim.spec.robot import Mount
from physics.cameras.lens import drawn, exposure_gain, through

STILL = RobotState(Pose(0.0, 0.0, 0.0))
FLAT = Mount((0.0, 0.0, 0.6))


def spec(lens: Lens, width: int = 200, height: int = 100) -> CameraSpec:
    """Return a camera with a focal length of 100 pixels."""
    return CameraSpec(width, height, 2 * math.degrees(math.atan(0.005 * height)), FLAT, lens)


def flat(camera: CameraSpec, value: int) -> Frame:
    return Frame(np.full((camera.height, camera.width, 3), value, np.uint8))


def test_a_default_lens_does_nothing() -> None:
    """The frame and the camera are returned unchanged."""
    camera = spec(Lens())
    frame = flat(camera, 90)
    assert through(camera, frame, STILL, 1, 2) is frame
    assert drawn(camera) is camera


@pytest.mark.parametrize("k1", [-0.1, 0.2])
def test_distortion_follows_the_model_of_brown(k1: float) -> None:
    """A point 0.5 focal lengths off the axis is seen at 0.5 (1 + k1 / 4), with its label and depth
    unmixed."""
    camera = spec(Lens(k1=k1))
    source = drawn(camera)
    at = round(0.5 * source.width + 50 - 0.5)
    rgb = np.zeros((source.height, source.width, 3), np.uint8)
    rgb[:, at - 1 : at + 2] = 255
    labels = np.where(rgb[..., 0] > 0, 7, 2).astype(np.uint8)
    depth = np.where(rgb[..., 0] > 0, 3.0, 9.0).astype(np.float32)
    seen = through(camera, Frame(rgb, labels, depth), STILL, 0, 0)
    assert seen.labels is not None and seen.depth is not None
    assert seen.rgb.shape == (100, 200, 3) and set(np.unique(seen.labels)) == {2, 7}
    row = 0.5 * (seen.rgb[49, :, 0].astype(float) + seen.rgb[50, :, 0])
    off = (row @ np.arange(200)) / row.sum() + 0.5 - 100.0
    exact = (at + 0.5 - 0.5 * source.width) / 100.0
    assert off == pytest.approx(100.0 * exact * (1.0 + k1 * exact**2), abs=0.3)
    assert np.array_equal(seen.depth == 3.0, seen.labels == 7)


def test_a_barrel_is_drawn_wider_and_fills_the_picture() -> None:
    """The drawn camera keeps its focal length and covers the corners, and a pincushion needs
    less."""
    camera = spec(Lens(k1=-0.1))
    source = drawn(camera)
    assert source.width > 200 and source.height > 100 and source.lens == Lens()
    assert 0.5 * source.height / math.tan(math.radians(0.5 * source.fov_deg)) == pytest.approx(
        100.0
    )
    assert drawn(spec(Lens(k1=0.1))).width < 200
    with pytest.raises(SpecError, match="needs a frame of"):
        through(camera, flat(camera, 0), STILL, 0, 0)


def test_a_lens_that_folds_is_refused() -> None:
    """k1 = -0.5 at a wide view has no valid picture, and the message names the terms and the field
    of view."""
    with pytest.raises(
        SpecError, match=r"lens k1 -0\.5, k2 0\.0 fold the picture .* field of view of 53"
    ):
        drawn(spec(Lens(k1=-0.5)))


def test_blur_is_as_long_as_the_turn() -> None:
    """Turning left by 1 rad/s for 0.06 s smears an upright line over 6 pixels around its place and
    keeps its light."""
    camera = spec(Lens(shutter_s=0.06))
    frame = flat(camera, 0)
    frame.rgb[:, 99:101] = 255
    seen = through(camera, frame, RobotState(Pose(0.0, 0.0, 0.0), w_radps=1.0), 0, 0)
    light = (seen.rgb[50, :, 0] / 255.0) ** 2.2
    assert light.sum() == pytest.approx(2.0, abs=0.1)
    middle = (light @ np.arange(200)) / light.sum()
    assert middle == pytest.approx(99.5, abs=0.1)
    spread = (light @ (np.arange(200) - middle) ** 2) / light.sum()
    assert math.sqrt(12.0 * spread) == pytest.approx(math.hypot(6.0, 2.0), rel=0.06)
    assert np.array_equal(through(camera, frame, STILL, 0, 0).rgb, frame.rgb)


def test_driving_ahead_blurs_the_ground_and_not_the_horizon() -> None:
    """At 1 m/s from 0.6 m up, ground seen at y below the axis moves down by y^2 / 0.6 focal lengths
    a second."""
    camera = spec(Lens(readout_s=0.1))
    frame = flat(camera, 0)
    frame.rgb[95] = 255
    seen = through(camera, frame, RobotState(Pose(0.0, 0.0, 0.0), v_mps=1.0), 0, 0)
    # Row 95 is y = 0.455, so 0.345 focal lengths a second; it is read 0.0455 s late.
    row = seen.rgb[:, 100, 0].astype(float)
    assert (row @ np.arange(100)) / row.sum() == pytest.approx(
        95.0 + 100.0 * 0.345 * 0.0455, abs=0.4
    )
    assert not seen.rgb[:60].any()


def test_a_rolling_shutter_leans_an_upright_line() -> None:
    """Turning left at 1 rad/s with a readout of 0.1 s, the line is 10 pixels further right in the
    last row."""
    camera = spec(Lens(readout_s=0.1))
    frame = flat(camera, 0)
    frame.rgb[:, 99:101] = 255
    seen = through(camera, frame, RobotState(Pose(0.0, 0.0, 0.0), w_radps=1.0), 0, 0)
    at = [(seen.rgb[k, :, 0] @ np.arange(200.0)) / seen.rgb[k, :, 0].sum() for k in (0, 50, 99)]
    assert at[1] == pytest.approx(99.5, abs=0.2)
    assert at[2] - at[0] == pytest.approx(10.0, abs=0.4)


def test_noise_has_the_deviation_of_electrons() -> None:
    """A flat grey of 400 of 1000 electrons with 15 of read noise deviates by sqrt(400 + 225) = 25
    electrons."""
    value = 169  # sRGB 169 is 0.397 linear
    camera = spec(Lens(full_well_e=1000.0, read_noise_e=15.0))
    seen = [
        through(camera, flat(camera, value), STILL, seed, tick).rgb
        for seed, tick in ((1, 5), (1, 5), (1, 6), (2, 5))
    ]
    light = np.where(
        seen[0] > 10, ((seen[0] / 255.0 + 0.055) / 1.055) ** 2.4, seen[0] / 255.0 / 12.92
    )
    assert light.std() * 1000.0 == pytest.approx(math.sqrt(397.0 + 225.0), rel=0.02)
    assert light.mean() == pytest.approx(0.397, abs=0.002)
    assert np.array_equal(seen[0], seen[1])
    assert not np.array_equal(seen[0], seen[2]) and not np.array_equal(seen[0], seen[3])


def test_auto_exposure_targets_grey_within_its_range() -> None:
    """A picture of 0.09 is doubled to 0.18, one of 0.02 only doubled with a range of one stop, and
    0.18 is unchanged."""
    for mean, gain in ((0.09, 2.0), (0.02, 2.0), (0.18, 1.0), (0.9, 0.5)):
        assert exposure_gain(np.full((4, 4, 3), mean), 1.0) == pytest.approx(gain)
    camera = spec(Lens(auto_exposure_ev=2.0))
    assert through(camera, flat(camera, 85), STILL, 0, 0).rgb[0, 0].tolist() == pytest.approx(
        [118] * 3, abs=1
    )


def test_a_vignette_falls_with_the_fourth_power() -> None:
    """One focal length off the axis, cos^4 of 45 degrees leaves a quarter of the light, and the
    middle keeps all."""
    camera = spec(Lens(vignette=1.0))
    seen = through(camera, flat(camera, 255), STILL, 0, 0).rgb
    assert seen[50, 100, 0] == 255
    assert ((seen[50, 199, 0] / 255.0 + 0.055) / 1.055) ** 2.4 == pytest.approx(0.25, abs=0.01)


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"k1": -0.6}, r"lens k1 must be in \[-0\.5, 0\.5\], not -0\.6"),
        ({"shutter_s": float("nan")}, r"lens shutter_s must be in \[0, 0\.1\], not nan"),
        ({"read_noise_e": 3.0}, "lens read_noise_e needs full_well_e"),
    ],
)
def test_an_invalid_lens_is_refused(wrong: dict[str, float], message: str) -> None:
    """The message names the field, the valid range and the value."""
    with pytest.raises(SpecError, match=message):
        Lens(**wrong)
