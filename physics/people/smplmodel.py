"""A user's own SMPL body and AMASS motions, from .npz files that hold plain arrays: nothing is ever unpickled.

SMPL's axes are x left, y up, z ahead; AMASS turns them so that z is up in the world. Both become ours.
"""

from __future__ import annotations

import zipfile
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from cosim.core.errors import SpecError
from cosim.core.geometry import Floats
from physics.people.body import COATS, SkinnedBody, strongest
from physics.people.captures import Capture
from physics.people.skeleton import INDEX, JOINTS, PARENTS, Skeleton, forward, rodrigues
from physics.world.mesh import smooth_normals

BYTES_MAX: Final = 512 * 2**20
"""The largest file that is read, unpacked; SMPL's own is 40 MB."""
VERTICES_MAX: Final = 200_000
FRAMES_MAX: Final = 200_000

_TO_OURS: Final = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
"""From SMPL's axes to ours."""


@dataclass(frozen=True, slots=True)
class SmplBody:
    """A body from a file: its skeleton, and its mesh in the T pose with four weights per vertex."""

    skeleton: Skeleton
    body: SkinnedBody


@dataclass(frozen=True, slots=True)
class _Motion:
    """A motion from a file. turns: (F, 24, 3, 3) against the T pose; pelvis_m: (F, 3) from where it was at rest,
    beginning above the origin, heading along x."""

    frame_s: float
    turns: Floats
    pelvis_m: Floats


def read_smpl(path: Path, shape: tuple[float, ...] = ()) -> SmplBody:
    """An SMPL model. shape: the first of its shape parameters (beta); none is the mean.

    Fields: v_template (V, 3), weights (V, 24), J_regressor (24, V), f (T, 3), kintree_table (2, 24), and shapedirs
    (V, 3, B) where a shape is asked for. Raises SpecError naming file and field.
    """
    arrays = _Arrays.of(path)
    vertices = arrays.floats("v_template", (None, 3))
    count = len(vertices)
    if not 4 <= count <= VERTICES_MAX:
        raise SpecError(f"{path}: v_template: {count} vertices; it must be 4 to {VERTICES_MAX}")
    weights = arrays.floats("weights", (count, 24))
    regressor = arrays.floats("J_regressor", (24, count))
    faces = arrays.whole("f", (None, 3), count)
    tree = arrays.whole("kintree_table", (2, 24), None)
    if tree[0, 1:].tolist() != list(PARENTS[1:]) or tree[1].tolist() != list(range(24)):
        raise SpecError(f"{path}: kintree_table: not the 24 joints of SMPL in their order")
    if (weights < -1e-6).any() or np.abs(weights.sum(axis=1) - 1.0).max() > 1e-3:
        raise SpecError(f"{path}: weights: each row must be shares that sum to 1")
    if np.abs(regressor.sum(axis=1) - 1.0).max() > 1e-3:
        raise SpecError(f"{path}: J_regressor: each row must sum to 1")
    if shape:
        directions = arrays.floats("shapedirs", (count, 3, None))
        if len(shape) > directions.shape[2]:
            raise SpecError(f"{path}: shapedirs: {directions.shape[2]} directions for a shape of {len(shape)}")
        vertices = vertices + directions[..., : len(shape)] @ np.array(shape)
    return _stood(path, vertices, np.maximum(weights, 0.0), regressor, faces)


def read_motion(path: Path) -> _Motion:
    """An AMASS motion: poses (F, 66 or more), trans (F, 3), mocap_framerate. Raises SpecError naming file and field."""
    arrays = _Arrays.of(path)
    poses = arrays.floats("poses", (None, None))
    frames = len(poses)
    if not 2 <= frames <= FRAMES_MAX:
        raise SpecError(f"{path}: poses: {frames} frames; it must be 2 to {FRAMES_MAX}")
    if poses.shape[1] < 66 or poses.shape[1] % 3:
        raise SpecError(f"{path}: poses: {poses.shape[1]} numbers a frame; it must be 3 for each of 22 or more joints")
    trans = arrays.floats("trans", (frames, 3))
    rate = arrays.floats("mocap_framerate", ())
    if not 1.0 <= float(rate) <= 1000.0:
        raise SpecError(f"{path}: mocap_framerate: {float(rate):g} frames a second; it must be 1 to 1000")
    bends = np.zeros((frames, 24, 3))
    joints = 24 if poses.shape[1] == 72 else 22
    bends[:, :joints] = poses[:, : 3 * joints].reshape(frames, joints, 3)
    turns = rodrigues(bends @ _TO_OURS.T)
    root = rodrigues(bends[:, 0]) @ _TO_OURS.T
    ahead = root[0, :, 0]
    heading = float(np.arctan2(ahead[1], ahead[0]))
    cos, sin = np.cos(heading), np.sin(heading)
    straight = np.array([[cos, sin, 0.0], [-sin, cos, 0.0], [0.0, 0.0, 1.0]])
    turns[:, 0] = straight @ root
    way = (trans - trans[0] * (1.0, 1.0, 0.0)) @ straight.T
    return _Motion(1.0 / float(rate), turns, way)


def stride_of(motion: _Motion, body: Skeleton) -> Capture:
    """One stride of a walk, from one touch of the left heel to the next. Raises SpecError when there is none.

    The heel touches about when the left ankle is farthest ahead of the right one.
    """
    _, at = forward(motion.turns, motion.pelvis_m, body)
    apart = at[:, INDEX["left_ankle"], 0] - at[:, INDEX["right_ankle"], 0]
    wide = 0.5 * float(apart.max())
    peaks = [
        k for k in range(1, len(apart) - 1) if apart[k] > wide and apart[k] >= apart[k - 1] and apart[k] > apart[k + 1]
    ]
    for first, last in pairwise(peaks):
        if wide > 0.05 and 0.5 < (last - first) * motion.frame_s < 2.5 and apart[first:last].min() < -wide:
            cut = slice(first, last + 1)
            return Capture(motion.frame_s, motion.turns[cut], motion.pelvis_m[cut])
    raise SpecError("the motion holds no whole stride of a walk along its first heading: two touches of the left heel")


def _stood(path: Path, vertices: Floats, weights: Floats, regressor: Floats, faces: NDArray[np.int64]) -> SmplBody:
    """The body in our axes, its soles on the ground."""
    ours = vertices @ _TO_OURS.T
    lowest, highest = float(ours[:, 2].min()), float(ours[:, 2].max())
    if not 0.3 < highest - lowest < 3.0:
        raise SpecError(f"{path}: v_template: {highest - lowest:.2f} m tall; a person in metres is 0.3 to 3")
    ours = ours - (0.0, 0.0, lowest)
    joints, few = strongest(weights)
    made = SkinnedBody(
        ours.astype(np.float32),
        smooth_normals(ours, faces.astype(np.int32)).astype(np.float32),
        faces.astype(np.int32),
        joints,
        few,
        _clothed(weights),
        np.zeros(len(ours), dtype=np.float32),
    )
    return SmplBody(Skeleton(regressor @ ours, highest - lowest), made)


def _clothed(weights: Floats) -> NDArray[np.uint8]:
    """(V,) rows of COATS for a bare body: by the joint that moves a vertex most."""
    coats = {"hip": "bottom", "knee": "bottom", "ankle": "shoes", "foot": "shoes", "pelvis": "bottom"}
    skins = ("head", "neck", "wrist", "hand")
    row = []
    for name in JOINTS:
        part = name.split("_")[-1]
        row.append(COATS.index("skin" if part in skins else coats.get(part, "top")))
    return np.asarray(np.array(row, dtype=np.uint8)[np.argmax(weights, axis=1)])


@dataclass(frozen=True, slots=True)
class _Arrays:
    """The arrays of a .npz file, checked as they are asked for."""

    path: Path
    found: dict[str, NDArray[np.generic]]

    @classmethod
    def of(cls, path: Path) -> _Arrays:
        try:
            with zipfile.ZipFile(path) as packed:
                size = sum(entry.file_size for entry in packed.infolist())
            if size > BYTES_MAX:
                raise SpecError(f"{path}: {size / 2**20:.0f} MB unpacked; at most {BYTES_MAX / 2**20:.0f} MB are read")
            with np.load(path, allow_pickle=False) as file:
                return cls(path, {name: _plain(path, file, name) for name in file.files})
        except SpecError:
            raise
        except (OSError, EOFError, ValueError, zipfile.BadZipFile) as error:
            raise SpecError(f"{path}: not a .npz file of plain arrays: {error}") from error

    def floats(self, name: str, shape: tuple[int | None, ...]) -> Floats:
        """A finite array of floats of a shape; None is any length."""
        values = self._get(name, shape)
        if not np.issubdtype(values.dtype, np.number):
            raise SpecError(f"{self.path}: {name}: {values.dtype} where numbers are needed")
        floats = values.astype(float)
        if not np.isfinite(floats).all():
            raise SpecError(f"{self.path}: {name}: holds values that are not finite")
        return np.asarray(floats)

    def whole(self, name: str, shape: tuple[int | None, ...], below: int | None) -> NDArray[np.int64]:
        """An array of whole numbers of a shape; below: each is at least 0 and below that."""
        values = self._get(name, shape)
        if not np.issubdtype(values.dtype, np.integer):
            raise SpecError(f"{self.path}: {name}: {values.dtype} where whole numbers are needed")
        whole = values.astype(np.int64)
        if below is not None and len(whole) and not 0 <= whole.min() <= whole.max() < below:
            raise SpecError(f"{self.path}: {name}: names vertices that do not exist; there are {below}")
        return whole

    def _get(self, name: str, shape: tuple[int | None, ...]) -> NDArray[np.generic]:
        if name not in self.found:
            raise SpecError(f"{self.path}: no field '{name}'; there are: {', '.join(sorted(self.found)) or 'none'}")
        values = self.found[name]
        if values.ndim != len(shape) or any(n is not None and n != m for n, m in zip(shape, values.shape, strict=True)):
            wanted = " x ".join("any" if n is None else str(n) for n in shape) or "one number"
            raise SpecError(f"{self.path}: {name}: of shape {values.shape}; it must be {wanted}")
        return values


def _plain(path: Path, file: np.lib.npyio.NpzFile, name: str) -> NDArray[np.generic]:
    try:
        values: NDArray[np.generic] = file[name]
    except ValueError as error:
        raise SpecError(
            f"{path}: {name}: holds pickled objects, which are never read: save it as a plain array"
        ) from error
    return values
