"""Camera specs of policies (`CameraSpec`, `Lens`), and their pictures (`CameraPicture`,
`Calibration`)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cosim.core.errors import SpecError
from cosim.core.geometry import Floats
from cosim.spec.robot import Mount, Robot


def flipped(picture: NDArray[Any]) -> NDArray[Any]:
    """Return a picture (H, W, ...) with left and right exchanged."""
    return np.ascontiguousarray(picture[:, ::-1])


@dataclass(frozen=True, slots=True, eq=False)
class Calibration:
    """Camera calibration in OpenCV's convention: x right, y down, z ahead.

    matrix: (3, 3) K in pixels; (0, 0) is the middle of the upper left pixel.
    distortion: (5,) k1, k2, p1, p2, k3 of Brown's model.
    on_robot: (4, 4) transform from the camera's frame to the robot's: x ahead, y left, z up, origin
        on the ground below its middle. It is the camera as mounted on a level robot: it ignores the
        tilt on uneven ground and the motion of a trunk on legs.

    >>> ahead = Calibration(np.eye(3), np.zeros(5), np.eye(4)).on_robot @ [0.0, 0.0, 1.0, 1.0]
    """

    matrix: Floats
    distortion: Floats
    on_robot: Floats

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> NDArray[Any]:
        """Raise TypeError: a calibration is three arrays."""
        raise TypeError(
            "a camera is no array: read .matrix (3, 3), .distortion (5,) or .on_robot (4, 4)"
        )


@dataclass(frozen=True, slots=True, eq=False)
class CameraPicture:
    """Picture of one camera.

    rgb: (H, W, 3) uint8.
    labels: (H, W) uint8 ids of `cosim.core.state.LABELS`, if the spec requests them.
    depth: (H, W) float32 metres along the camera's axis, if the spec requests it.
    camera: its calibration.

    >>> camera = Calibration(np.eye(3), np.zeros(5), np.eye(4))
    >>> CameraPicture(np.zeros((48, 64, 3), np.uint8), None, None, camera).rgb.shape
    (48, 64, 3)
    """

    rgb: NDArray[np.uint8]
    labels: NDArray[np.uint8] | None
    depth: NDArray[np.float32] | None
    camera: Calibration

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> NDArray[Any]:
        """Return `rgb`, (H, W, 3) uint8."""
        return np.array(self.rgb, dtype, copy=copy)


@dataclass(frozen=True, slots=True)
class Lens:
    """Effects of a camera's optics and sensor on a picture; the default has none.

    k1, k2: radial terms of Brown's distortion, in units of the focal length; k1 < 0 is a barrel.
    shutter_s: exposure time, the cause of motion blur.
    readout_s: time from the first row to the last, the cause of rolling-shutter skew.
    full_well_e: electrons of a white pixel; 0 for a sensor without noise.
    read_noise_e: electrons of noise in the dark.
    auto_exposure_ev: maximum correction in stops by metering on the picture itself.
    vignette: 0 (none) to 1 (natural falloff, cos^4 of the angle off the axis).
    """

    k1: float = 0.0
    k2: float = 0.0
    shutter_s: float = 0.0
    readout_s: float = 0.0
    full_well_e: float = 0.0
    read_noise_e: float = 0.0
    auto_exposure_ev: float = 0.0
    vignette: float = 0.0

    def __post_init__(self) -> None:
        ranges = {
            "k1": (-0.5, 0.5),
            "k2": (-0.5, 0.5),
            "shutter_s": (0.0, 0.1),
            "readout_s": (0.0, 0.1),
            "full_well_e": (0.0, 1e6),
            "read_noise_e": (0.0, 1000.0),
            "auto_exposure_ev": (0.0, 4.0),
            "vignette": (0.0, 1.0),
        }
        for field, (low, high) in ranges.items():
            if not low <= getattr(self, field) <= high:
                raise SpecError(
                    f"lens {field} must be in [{low:g}, {high:g}], not {getattr(self, field)}"
                )
        if self.read_noise_e and not self.full_well_e:
            raise SpecError(
                "lens read_noise_e needs full_well_e, the electrons of a white pixel (10000 "
                "is usual)"
            )


@dataclass(frozen=True, slots=True)
class CameraSpec:
    """Camera of a policy: size in pixels, vertical field of view in degrees, and mount.

    mount: name of one of the robot's mounts, whose limits hold for size, field of view and rate. A
        `Mount` of its own, or values beyond the limits, need `EpisodeOptions.own_camera`.
    crop: (x0, y0, x1, y1) in pixels, without x1 and y1: the part of the picture that the policy
        gets.
    depth, labels: whether the policy gets these with each picture. Raises SpecError if the crop is
        not within the picture.

    >>> CameraSpec(width=512, height=288, fov_deg=60.0, crop=(0, 88, 512, 288)).size
    (512, 200)
    """

    width: int = 96
    height: int = 96
    fov_deg: float = 75.0
    mount: str | Mount = "front"
    lens: Lens = Lens()
    crop: tuple[int, int, int, int] | None = None
    depth: bool = False
    labels: bool = False

    def __post_init__(self) -> None:
        if self.crop is None:
            return
        object.__setattr__(self, "crop", tuple(self.crop))
        x0, y0, x1, y1 = self.crop if len(self.crop) == 4 else (0, 0, 0, 0)
        if not (0 <= x0 < x1 <= self.width and 0 <= y0 < y1 <= self.height):
            raise SpecError(
                f"camera crop must be (x0, y0, x1, y1) within {self.width} x {self.height} pixels, "
                f"x0 < x1 and y0 < y1, not {self.crop}"
            )

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of the policy's picture in pixels, after the crop."""
        x0, y0, x1, y1 = self.crop or (0, 0, self.width, self.height)
        return x1 - x0, y1 - y0

    @property
    def in_words(self) -> str:
        """Description for tables."""
        own = "own mount" if isinstance(self.mount, Mount) else self.mount
        crop = "" if self.crop is None else ", crop " + " ".join(map(str, self.crop))
        more = ", lens" * (self.lens != Lens()) + ", depth" * self.depth + ", labels" * self.labels
        return f"{own}, {self.width} x {self.height} px, {self.fov_deg:g} deg{crop}{more}"

    def on(self, robot: Robot) -> Mount:
        """Return the camera's mount on a robot. Raises UsageError with the robot's mounts."""
        return robot.mount(self.mount) if isinstance(self.mount, str) else self.mount
