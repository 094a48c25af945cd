"""Effects of optics and sensor on a drawn picture, as pure functions of picture and robot state.

In the order of the light: motion blur while the shutter is open, rolling shutter while rows are
read, distortion, vignetting, electron noise, and gain.
"""

from __future__ import annotations

import dataclasses
import math
from functools import lru_cache
from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import NDArray

from cosim.core.errors import SpecError
from cosim.core.state import Frame, RobotState, write_protected_float32
from cosim.spec.camera import CameraSpec, Lens
from cosim.spec.robot import Mount
from physics.textures.layers import LINEAR_OF_SRGB_BYTE, linear_to_srgb

GREY: Final = 0.18
"""Target mean of auto-exposure, linear."""
SAMPLES_MAX: Final = 8
"""Maximum number of averaged shutter samples; there is one for each 1.5 pixels of motion."""

_NONE: Final = Lens()
_DRAWN_MAX: Final = 4096
_OFFSETS: Final = 1 << 18
_FAR_M: Final = 15.0
"""Assumed distance of everything above the ground, the walls of a street, metres."""
_CODES: Final = (linear_to_srgb(np.arange(4097) / 4096.0) * 255.0 + 0.5).astype(np.uint8)
Map = NDArray[np.floating[Any]]


def drawn(spec: CameraSpec) -> CameraSpec:
    """Return the pinhole camera to draw for a camera with a lens.

    It is as sharp in the middle, and wide enough for every pixel.
    Raises SpecError where k1 and k2 fold the picture at this field of view.
    """
    lens = spec.lens
    if lens == _NONE:
        return spec
    if not (lens.k1 or lens.k2):
        return dataclasses.replace(spec, lens=Lens())
    x, y = _rays(spec)
    focal = _focal_px(spec)
    width, height = (2 * math.ceil(float(np.abs(m).max()) * focal + 0.5) for m in (x, y))
    if max(width, height) > _DRAWN_MAX:
        raise SpecError(
            f"lens k1 {lens.k1}, k2 {lens.k2}: a picture of {width} x {height} pixels would "
            f"be drawn for it"
        )
    fov = math.degrees(2.0 * math.atan(0.5 * height / focal))
    return dataclasses.replace(spec, width=width, height=height, fov_deg=fov, lens=Lens())


def through(spec: CameraSpec, frame: Frame, robot: RobotState, seed: int, tick: int) -> Frame:
    """Apply the lens to the frame of `drawn(spec)`. Labels and depth are only warped.

    robot: state for motion blur and skew
    seed, tick: of the noise

    Motion is that of the ground plane and of walls at both sides. People and vehicles blur as if
    they stood still.
    """
    lens = spec.lens
    if lens == _NONE:
        return frame
    source = drawn(spec)
    size = (source.height, source.width)
    if frame.rgb.shape[:2] != size:
        raise SpecError(
            f"the lens needs a frame of {size[1]} x {size[0]} pixels, as drawn(spec) says"
        )
    rgb = frame.rgb
    toned = bool(lens.full_well_e or lens.auto_exposure_ev or lens.vignette)
    labels, depth = frame.labels, frame.depth
    moving = (lens.shutter_s > 0.0 or lens.readout_s > 0.0) and (
        robot.v_mps != 0.0 or robot.w_radps != 0.0
    )
    light: NDArray[np.floating[Any]] | None = None
    if moving or lens.k1 or lens.k2:
        flow = _flow(spec, robot) if moving else None
        moments = _moments(spec, flow)
        read = (np.arange(spec.height, dtype=np.float32)[:, None] + 0.5) / spec.height - 0.5
        read = read * np.float32(lens.readout_s)
        labels = (
            None if labels is None else _moved(labels, spec, source, flow, read, cv2.INTER_NEAREST)
        )
        depth = (
            None if depth is None else _moved(depth, spec, source, flow, read, cv2.INTER_NEAREST)
        )
        if len(moments) == 1:
            rgb = _moved(rgb, spec, source, flow, read, cv2.INTER_LINEAR)
        else:
            linear = LINEAR_OF_SRGB_BYTE[rgb]
            light = np.zeros((spec.height, spec.width, 3), np.float32)
            for moment in moments:
                light += _moved(linear, spec, source, flow, read + moment, cv2.INTER_LINEAR)
            light /= np.float32(len(moments))
    if toned:
        light = _sensed(LINEAR_OF_SRGB_BYTE[rgb] if light is None else light, spec, seed, tick)
    if light is not None:
        rgb = _CODES[
            (np.clip(light, 0.0, 1.0) * np.float32(4096.0) + np.float32(0.5)).astype(np.int16)
        ]
    return Frame(rgb, labels, depth)


def exposure_gain(light: NDArray[np.floating[Any]], range_ev: float) -> float:
    """Return the auto-exposure gain of a linear picture (H, W, 3).

    The gain moves the mean to GREY, within +-`range_ev` stops. It depends on this picture alone,
    so that a picture is a function of the state.
    """
    mean = float(light.mean(axis=(0, 1)) @ np.array([0.2126, 0.7152, 0.0722]))
    return float(np.clip(GREY / max(mean, 1e-6), 2.0**-range_ev, 2.0**range_ev))


def _sensed(
    light: NDArray[np.floating[Any]], spec: CameraSpec, seed: int, tick: int
) -> NDArray[np.floating[Any]]:
    """Apply vignetting, sensor noise and gain to linear light. The gain amplifies the noise."""
    lens = spec.lens
    if lens.vignette:
        light = light * _falloff(spec)[..., None]
    gain = exposure_gain(light, lens.auto_exposure_ev) if lens.auto_exposure_ev else 1.0
    if lens.full_well_e:
        start = int(np.random.default_rng([seed, tick]).integers(_OFFSETS))
        noise = _noise(seed, light.size)[start : start + light.size].reshape(light.shape)
        dark = np.float32((lens.read_noise_e / lens.full_well_e) ** 2)
        light = light + np.sqrt(light * np.float32(1.0 / lens.full_well_e) + dark) * noise
    return light * np.float32(gain)


def _moments(spec: CameraSpec, flow: Map | None) -> list[float]:
    """Return the sampling times of an open shutter, centred on 0."""
    if flow is None or not spec.lens.shutter_s:
        return [0.0]
    pixels = float(np.abs(flow).max()) * _focal_px(spec) * spec.lens.shutter_s
    n = min(max(math.ceil(pixels / 1.5), 1), SAMPLES_MAX)
    return [((k + 0.5) / n - 0.5) * spec.lens.shutter_s for k in range(n)]


def _moved(
    picture: NDArray[Any],
    spec: CameraSpec,
    source: CameraSpec,
    flow: Map | None,
    time_s: Map,
    interpolation: int,
) -> NDArray[Any]:
    """Warp a source picture by the lens and motion, each row at its time; `time_s` is (H, 1)."""
    if flow is None:
        one, two = _fixed_maps(spec, source, interpolation)
    else:
        x, y = _rays(spec)
        one, two = _pixels(spec, source, x - flow[..., 0] * time_s, y - flow[..., 1] * time_s)
    return np.asarray(cv2.remap(picture, one, two, interpolation, borderMode=cv2.BORDER_REPLICATE))


def _pixels(spec: CameraSpec, source: CameraSpec, x: Map, y: Map) -> tuple[Map, Map]:
    """Return columns and rows of rays (H, W) in the source picture."""
    focal = np.float32(_focal_px(spec))
    return x * focal + np.float32(0.5 * source.width - 0.5), y * focal + np.float32(
        0.5 * source.height - 0.5
    )


@lru_cache(maxsize=8)
def _fixed_maps(
    spec: CameraSpec, source: CameraSpec, interpolation: int
) -> tuple[NDArray[Any], NDArray[Any]]:
    """Return the lens distortion as OpenCV's fixed-point maps, which are faster to apply."""
    maps: tuple[NDArray[Any], NDArray[Any]] = cv2.convertMaps(
        *_pixels(spec, source, *_rays(spec)),
        cv2.CV_16SC2,
        nninterpolation=interpolation == cv2.INTER_NEAREST,
    )
    return maps


def _focal_px(spec: CameraSpec) -> float:
    return 0.5 * spec.height / math.tan(math.radians(0.5 * spec.fov_deg))


@lru_cache(maxsize=8)
def _rays(spec: CameraSpec) -> tuple[Map, Map]:
    """Return (H, W) x (right) and y (down) of the ray of each lens pixel, in focal lengths.

    D. C. Brown, Photogrammetric Engineering 37 (1971): r' = r (1 + k1 r^2 + k2 r^4), solved for r
    by Newton's method.
    """
    focal = _focal_px(spec)
    x, y = np.meshgrid(
        (np.arange(spec.width) + 0.5 - 0.5 * spec.width) / focal,
        (np.arange(spec.height) + 0.5 - 0.5 * spec.height) / focal,
    )
    k1, k2 = spec.lens.k1, spec.lens.k2
    if k1 or k2:
        bent = np.hypot(x, y)
        r = bent.copy()
        for _ in range(30):
            r -= (r * (1.0 + k1 * r**2 + k2 * r**4) - bent) / (
                1.0 + 3.0 * k1 * r**2 + 5.0 * k2 * r**4
            )
        out = np.linspace(0.0, float(np.abs(r).max()) if np.isfinite(r).all() else 1e3, 200)
        if np.any(1.0 + 3.0 * k1 * out**2 + 5.0 * k2 * out**4 <= 0.0):
            raise SpecError(
                f"lens k1 {k1}, k2 {k2} fold the picture over itself within a field of view "
                f"of {spec.fov_deg:g} deg at "
                f"{spec.width} x {spec.height}: give a narrower fov_deg or terms nearer to 0"
            )
        scale = np.where(bent > 1e-9, r / np.maximum(bent, 1e-9), 1.0)
        x, y = x * scale, y * scale
    return write_protected_float32(x), write_protected_float32(y)


@lru_cache(maxsize=2)
def _noise(seed: int, size: int) -> Map:
    """Return normal noise of a scenario; each picture takes `size` values at its own offset."""
    return write_protected_float32(
        np.random.default_rng([seed, 0x1E45]).standard_normal(size + _OFFSETS, dtype=np.float32)
    )


@lru_cache(maxsize=8)
def _falloff(spec: CameraSpec) -> Map:
    """Return (H, W) transmitted light: 1 in the middle, cos^4 of the off-axis angle at a vignette
    of 1.
    """
    x, y = _rays(spec)
    return write_protected_float32(1.0 - spec.lens.vignette * (1.0 - (1.0 + x**2 + y**2) ** -2.0))


@lru_cache(maxsize=8)
def _flows(spec: CameraSpec) -> tuple[Map, Map]:
    """Return the optical flow (H, W, 2) in focal lengths per second, per m/s ahead and per rad/s
    left.

    H. C. Longuet-Higgins and K. Prazdny, Proc. R. Soc. B 208 (1980), over a ground plane and walls
    at _FAR_M.
    """
    x, y = (m.astype(float) for m in _rays(spec))
    assert isinstance(spec.mount, Mount), (
        "a camera's mount is known once it sits on its robot: CameraSpec.on"
    )
    down, side = math.radians(spec.mount.pitch_down_deg), math.radians(spec.mount.yaw_left_deg)
    x_m, y_m, z_m = spec.mount.at_m
    near = np.maximum((y * math.cos(down) + math.sin(down)) / max(z_m, 0.05), 1.0 / _FAR_M)
    level = np.array([0.0, -math.sin(down), math.cos(down)])
    right = np.array([1.0, 0.0, 0.0])
    ahead = math.cos(side) * level + math.sin(side) * right
    left = math.sin(side) * level - math.cos(side) * right
    up = np.array([0.0, -math.cos(down), -math.sin(down)])
    swing = -y_m * ahead + x_m * left
    rays = np.stack([x, y, np.ones_like(x)], axis=-1)
    flows = []
    for speed, turn in ((ahead, np.zeros(3)), (swing, up)):
        moved = -speed * near[..., None] - np.cross(turn, rays)
        flows.append(write_protected_float32(moved[..., :2] - rays[..., :2] * moved[..., 2:]))
    return flows[0], flows[1]


def _flow(spec: CameraSpec, robot: RobotState) -> Map:
    ahead, turn = _flows(spec)
    return ahead * np.float32(robot.v_mps) + turn * np.float32(robot.w_radps)
