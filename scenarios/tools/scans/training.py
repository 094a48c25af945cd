"""Train Gaussian splats from photos, with gsplat's rasterization on a GPU.

Imports PyTorch and gsplat, which are not among the project's requirements.

Colours do not depend on the direction of view, as in an imported scan. The sky is a picture behind
the splats that is not stored. Each photo has a gain and a bias per channel, which average to none.
Lengths are divided by a unit, because learning rates and noise of gsplat's strategy depend on it.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import torch
from gsplat import MCMCStrategy, rasterization
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from torch import Tensor

from cosim.core.geometry import Floats
from physics.scans.read_splats import SH_C0
from physics.scans.write_splats import SPLAT_ROW
from scenarios.tools.scans.photos import Photo, Picture

_RATES: Final = {"means": 1.6e-4, "scales": 5e-3, "quats": 1e-3, "opacities": 5e-2, "sh0": 2.5e-3}
"""Learning rates of the parameters."""
_LAST_RATE: Final = 0.01
"""Learning rate of the means at the end, as a share of the first."""
_START_SHARE: Final = 0.7
"""Largest share of the splats that start at given points; densification adds the others."""
_START_OPACITY: Final = 0.5
_NEAR: Final = 0.03
"""Distance from the eye in units before which nothing is drawn."""
_SSIM_SHARE: Final = 0.2
_DEPTH_WEIGHT: Final = 0.05
_OPACITY_WEIGHT: Final = 0.01
_SCALE_WEIGHT: Final = 0.01
_NEEDLE: Final = 3.0
"""Largest ratio of the longest axis of a splat to its middle one."""
_MIN_OPACITY: Final = 0.01
"""Opacity below which trained splats are dropped."""
_SKY: Final = (32, 96)
"""Rows and columns of the picture of the sky."""
_TOLD_EACH: Final = 500
"""Number of steps between progress messages."""


@dataclass(frozen=True, kw_only=True)
class Settings:
    """Settings of a training.

    most: maximum number of splats.
    minutes: wall-clock limit, after which training ends early.
    """

    steps: int = 7000
    most: int = 500_000
    minutes: float = math.inf
    seed: int = 0
    device: str = "cuda"


@dataclass(frozen=True)
class _Shot:
    """A photo on the device.

    sky: (1, H, W, 2) places of its pixels in the picture of the sky, -1 to 1.
    high: (H, W, 1), 1 for pixels above the horizon.
    depths: (M,) distances of its points along the view, at `pixels` (1, 1, M, 2), -1 to 1.
    """

    rgb: Tensor
    view: Tensor
    intrinsics: Tensor
    sky: Tensor
    high: Tensor
    depths: Tensor
    pixels: Tensor


class Trainer:
    """Splats, sky and exposures in training."""

    def __init__(
        self,
        photos: Sequence[Photo],
        tracked: Floats,
        points: Floats,
        colours: NDArray[np.uint8],
        settings: Settings,
    ) -> None:
        """Place the first splats at points.

        photos: to train on.
        tracked: (K, 3) points to which the photos refer.
        points, colours: (N, 3) places of the first splats, and uint8 colours.
        """
        torch.manual_seed(settings.seed)
        self._rng = np.random.default_rng(settings.seed)
        self._settings = settings
        self._unit = _unit(photos, tracked)
        self._tracked = tracked / self._unit
        # Up in the model's frame: against the mean of the cameras' y axes.
        self._axes = _axes([photo.matrix for photo in photos])
        self._shots = [self._shot(photo) for photo in photos]
        self._params = self._first(points / self._unit, colours)
        self._optimizers = {
            name: torch.optim.Adam([one], lr=_RATES[name], eps=1e-15)
            for name, one in self._params.items()
        }
        device = settings.device
        self._sky = torch.zeros((1, 3, *_SKY), device=device, requires_grad=True)
        self._exposures = torch.zeros((len(photos), 2, 3), device=device, requires_grad=True)
        self._others = torch.optim.Adam(
            [{"params": [self._sky], "lr": 2e-2}, {"params": [self._exposures], "lr": 1e-3}]
        )
        self._strategy = MCMCStrategy(
            cap_max=settings.most,
            refine_start_iter=min(500, settings.steps // 10),
            refine_stop_iter=int(0.8 * settings.steps),
        )
        self._strategy.check_sanity(self._params, self._optimizers)
        self._state = self._strategy.initialize_state()

    def train(self, notice: Callable[[str], None]) -> int:
        """Train all steps, or until the time limit. Returns the number of steps."""
        settings = self._settings
        start = time.monotonic()
        order: list[int] = []
        for step in range(settings.steps):
            if time.monotonic() - start > 60.0 * settings.minutes:
                notice(f"stopped at the time limit, after {step} of {settings.steps} steps")
                return step
            if not order:
                order = self._rng.permutation(len(self._shots)).tolist()
            loss = self._step(step, order.pop())
            if step % _TOLD_EACH == 0:
                seconds = time.monotonic() - start
                count = len(self._params["means"])
                notice(f"step {step}: loss {float(loss):.4f}, {count} splats, {seconds:.0f} s")
        return settings.steps

    def _step(self, step: int, index: int) -> Tensor:
        shot = self._shots[index]
        drawn, depth = self._drawn(shot, torch.rand(3, device=self._settings.device))
        free = self._exposures - self._exposures.mean(dim=0, keepdim=True)
        drawn = drawn * torch.exp(free[index, 0]) + free[index, 1]
        photo = shot.rgb.float() / 255.0
        loss = (1.0 - _SSIM_SHARE) * (drawn - photo).abs().mean()
        loss = loss + _SSIM_SHARE * (1.0 - ssim(drawn, photo))
        loss = loss + _DEPTH_WEIGHT * self._depth_loss(shot, depth)
        params = self._params
        loss = loss + _OPACITY_WEIGHT * torch.sigmoid(params["opacities"]).mean()
        loss = loss + _SCALE_WEIGHT * torch.exp(params["scales"]).mean()
        loss.backward()
        for optimizer in (*self._optimizers.values(), self._others):
            optimizer.step()
            optimizer.zero_grad(set_to_none=True)
        rate = _RATES["means"] * _LAST_RATE ** (step / self._settings.steps)
        self._optimizers["means"].param_groups[0]["lr"] = rate
        self._strategy.step_post_backward(params, self._optimizers, self._state, step, {}, lr=rate)
        with torch.no_grad():
            scales = self._params["scales"]
            middle = scales.median(dim=1, keepdim=True).values
            scales.copy_(torch.minimum(scales, middle + math.log(_NEEDLE)))
        return loss.detach()

    def _depth_loss(self, shot: _Shot, depth: Tensor) -> Tensor:
        """Return the mean difference of inverse depths."""
        if not len(shot.depths):
            return depth.sum() * 0.0
        at = torch.nn.functional.grid_sample(
            depth[None, None], shot.pixels, align_corners=False, padding_mode="border"
        ).flatten()
        return (1.0 / at.clamp(min=_NEAR) - 1.0 / shot.depths).abs().mean()

    def _drawn(self, shot: _Shot, ground: Tensor) -> tuple[Tensor, Tensor]:
        """Return a picture (H, W, 3) before a sky and a ground colour, and depths (H, W)."""
        params = self._params
        height, width = shot.rgb.shape[:2]
        found, alpha, _ = rasterization(
            means=params["means"],
            quats=params["quats"],
            scales=torch.exp(params["scales"]),
            opacities=torch.sigmoid(params["opacities"]),
            colors=(0.5 + SH_C0 * params["sh0"]).clamp(min=0.0),
            viewmats=shot.view[None],
            Ks=shot.intrinsics[None],
            width=width,
            height=height,
            near_plane=_NEAR,
            render_mode="RGB+ED",
            packed=False,
        )
        sky = torch.nn.functional.grid_sample(
            torch.sigmoid(self._sky), shot.sky, align_corners=False, padding_mode="border"
        )[0].permute(1, 2, 0)
        behind = shot.high * sky + (1.0 - shot.high) * ground
        return found[0, ..., :3] + (1.0 - alpha[0]) * behind, found[0, ..., 3]

    def draw(self, photo: Photo) -> NDArray[np.float32]:
        """Return a picture (H, W, 3) from the place of a photo, 0 to 1, without its exposure."""
        with torch.no_grad():
            black = torch.zeros(3, device=self._settings.device)
            drawn, _ = self._drawn(self._shot(photo), black)
        return np.asarray(drawn.clamp(0.0, 1.0).cpu().numpy(), dtype=np.float32)

    def rows(self) -> NDArray[np.void]:
        """Return the splats as rows of a 3DGS .ply file, in the frame of the model."""
        params = {name: one.detach().cpu().numpy() for name, one in self._params.items()}
        seen = 1.0 / (1.0 + np.exp(-params["opacities"])) >= _MIN_OPACITY
        for one in params.values():
            seen &= np.isfinite(one.reshape(len(one), -1)).all(axis=1)
        rows = np.zeros(int(seen.sum()), dtype=SPLAT_ROW)
        for k, name in enumerate("xyz"):
            rows[name] = self._unit * params["means"][seen, k]
            rows[f"f_dc_{k}"] = params["sh0"][seen, k]
            rows[f"scale_{k}"] = params["scales"][seen, k] + math.log(self._unit)
        rows["opacity"] = params["opacities"][seen]
        quats = params["quats"][seen]
        quats = quats / np.sqrt((quats**2).sum(axis=1, keepdims=True))
        for k in range(4):
            rows[f"rot_{k}"] = quats[:, k]
        return rows

    def _first(self, points: Floats, colours: NDArray[np.uint8]) -> dict[str, Any]:
        """Return the parameters of the first splats, as large as their neighbours are far."""
        room = max(1, int(_START_SHARE * self._settings.most))
        if len(points) > room:
            chosen = np.sort(self._rng.choice(len(points), room, replace=False))
            points, colours = points[chosen], colours[chosen]
        near: Floats = np.asarray(cKDTree(points).query(points, k=min(4, len(points)))[0])
        far = near[:, 1:].mean(axis=1)
        size = np.log(np.clip(far, 1e-4, 0.5))
        whole = {
            "means": points,
            "scales": np.repeat(size[:, None], 3, axis=1),
            "quats": np.tile([1.0, 0.0, 0.0, 0.0], (len(points), 1)),
            "opacities": np.full(len(points), math.log(_START_OPACITY / (1.0 - _START_OPACITY))),
            "sh0": (colours / 255.0 - 0.5) / SH_C0,
        }
        return {name: torch.nn.Parameter(self._put(array)) for name, array in whole.items()}

    def _shot(self, photo: Photo) -> _Shot:
        height, width = photo.rgb.shape[:2]
        sky, elevation = _sky_places(photo, self._axes)
        matrix = photo.matrix.copy()
        matrix[:3, 3] /= self._unit
        local = self._tracked[photo.points] @ matrix[:3, :3].T + matrix[:3, 3]
        local = local[local[:, 2] > 2.0 * _NEAR]
        pixels = (local / local[:, 2:]) @ photo.intrinsics.T
        pixels = 2.0 * pixels[:, :2] / (width, height) - 1.0
        return _Shot(
            torch.as_tensor(photo.rgb, device=self._settings.device),
            self._put(matrix),
            self._put(photo.intrinsics),
            self._put(sky)[None],
            self._put(elevation > 0.0)[..., None],
            self._put(local[:, 2]),
            self._put(pixels)[None, None],
        )

    def _put(self, array: NDArray[Any]) -> Tensor:
        return torch.as_tensor(array.astype(np.float32), device=self._settings.device)


def _unit(photos: Sequence[Photo], tracked: Floats) -> float:
    """Return the median distance of the points that photos show, in the model's unit."""
    depths = [
        (tracked[photo.points] @ photo.matrix[2, :3] + photo.matrix[2, 3]) for photo in photos
    ]
    return float(np.median(np.concatenate(depths)))


def _axes(matrices: Sequence[Floats]) -> Floats:
    """Return rows ahead, left and up: mean directions of the cameras in the model's frame."""
    up = -np.mean([matrix[1, :3] for matrix in matrices], axis=0)
    up /= np.linalg.norm(up)
    ahead = np.mean([matrix[2, :3] for matrix in matrices], axis=0)
    ahead -= up * (ahead @ up)
    size = float(np.linalg.norm(ahead))
    if size < 1e-3:  # all around
        ahead = np.cross(up, np.eye(3)[int(np.argmin(np.abs(up)))])
        size = float(np.linalg.norm(ahead))
    ahead /= size
    return np.stack([ahead, np.cross(up, ahead), up])


def _sky_places(photo: Photo, axes: Floats) -> tuple[Floats, Floats]:
    """Return places of pixels in the picture of the sky (H, W, 2), and elevations in radians."""
    height, width = photo.rgb.shape[:2]
    v, u = np.mgrid[0.5:height, 0.5:width]
    rays = np.stack([u, v, np.ones_like(u)], axis=-1) @ np.linalg.inv(photo.intrinsics).T
    ahead, left, up = np.moveaxis(rays @ photo.matrix[:3, :3] @ axes.T, -1, 0)
    elevation = np.arctan2(up, np.hypot(ahead, left))
    azimuth = np.arctan2(left, ahead)
    places = np.stack([azimuth / np.pi, 4.0 * elevation / np.pi - 1.0], axis=-1)
    return places, elevation


def ssim(one: Tensor, other: Tensor) -> Tensor:
    """Return the mean structural similarity of two pictures (H, W, 3), 0 to 1."""
    at = torch.arange(11, dtype=torch.float32, device=one.device) - 5.0
    window = torch.exp(-(at**2) / (2.0 * 1.5**2))
    window = window / window.sum()

    def blurred(picture: Tensor) -> Tensor:
        kernel = window.view(1, 1, 1, 11)
        rows = torch.nn.functional.conv2d(picture, kernel, padding=(0, 5))
        return torch.nn.functional.conv2d(rows, kernel.transpose(2, 3), padding=(5, 0))

    a, b = (picture.permute(2, 0, 1)[:, None] for picture in (one, other))
    mean_a, mean_b = blurred(a), blurred(b)
    spread_a = blurred(a * a) - mean_a**2
    spread_b = blurred(b * b) - mean_b**2
    common = blurred(a * b) - mean_a * mean_b
    c1, c2 = 0.01**2, 0.03**2
    similar = (2.0 * mean_a * mean_b + c1) * (2.0 * common + c2)
    return (similar / ((mean_a**2 + mean_b**2 + c1) * (spread_a + spread_b + c2))).mean()


def pictures_beside(photo: Picture, drawn: NDArray[np.float32]) -> Picture:
    """Return a photo and a drawing of it side by side, (H, 2 W, 3)."""
    right = np.rint(np.clip(drawn, 0.0, 1.0) * 255.0).astype(np.uint8)
    return np.concatenate([photo, right], axis=1)
