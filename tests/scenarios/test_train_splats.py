"""Training of splats from photos: COLMAP models, photos, the split, and measures."""

from __future__ import annotations

import math
import struct
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from cosim.core.errors import CosimError, MapError
from physics.scans.read_splats import SH_C0, read_splats
from physics.scans.write_splats import SPLAT_ROW, write_splats
from scenarios.tools.scans.colmap import read_model
from scenarios.tools.scans.photos import fitted, psnr_db, read_photos, split
from scenarios.tools.scans.train_splats import main, read_points

WIDTH, HEIGHT = 320, 240
FOCAL = 260.0
RADIAL = 0.08
CENTRE = (WIDTH / 2, HEIGHT / 2)
COUNT = 12


class Model:
    """Cameras on a line that look at a wall of points, in a rotated frame."""

    def __init__(self) -> None:
        rng = np.random.default_rng(3)
        self.turn = Rotation.from_rotvec([0.4, -1.1, 0.7]).as_matrix()
        grid = np.stack(np.meshgrid(np.linspace(-3, 3, 7), np.linspace(-2, 2, 5)), -1)
        wall = np.column_stack([grid.reshape(-1, 2), np.full(35, 6.0)])
        self.points = wall @ self.turn.T
        self.ids = rng.permutation(100)[: len(wall)] + 7
        self.colours = rng.integers(0, 256, (len(wall), 3)).astype(np.uint8)
        self.names = [f"photo {k:02}.jpg" for k in range(COUNT)]
        self.matrices = []
        for k in range(COUNT):
            matrix = np.eye(4)
            matrix[:3, :3] = self.turn.T
            matrix[:3, 3] = (0.2 - 0.04 * k, 0.1, 0.5)
            self.matrices.append(matrix)

    def quaternion(self, k: int) -> list[float]:
        x, y, z, w = Rotation.from_matrix(self.matrices[k][:3, :3]).as_quat()
        return [w, x, y, z]

    def tracked(self, k: int) -> NDArray[np.int64]:
        """Return ids of points; -1 is a pixel without one, as COLMAP writes it."""
        return np.array([*self.ids[k::3], -1])

    def write_binary(self, folder: Path) -> None:
        folder.mkdir(parents=True)
        cameras = struct.pack("<QIiQQ4d", 1, 5, 2, WIDTH, HEIGHT, FOCAL, *CENTRE, RADIAL)
        (folder / "cameras.bin").write_bytes(cameras)
        data = struct.pack("<Q", COUNT)
        for k in reversed(range(COUNT)):
            data += struct.pack("<I7dI", k, *self.quaternion(k), *self.matrices[k][:3, 3], 5)
            data += self.names[k].encode() + b"\0" + struct.pack("<Q", len(self.tracked(k)))
            for number in self.tracked(k):
                data += struct.pack("<ddq", 1.0, 2.0, number)
        (folder / "images.bin").write_bytes(data)
        data = struct.pack("<Q", len(self.ids))
        for number, point, colour in zip(self.ids, self.points, self.colours, strict=True):
            data += struct.pack("<Q3d3BdQ2I", number, *point, *colour, 0.5, 1, 1, 1)
        (folder / "points3D.bin").write_bytes(data)

    def write_text(self, folder: Path) -> None:
        folder.mkdir(parents=True)
        camera = f"# cameras\n5 SIMPLE_RADIAL {WIDTH} {HEIGHT} {FOCAL} {CENTRE[0]} {CENTRE[1]} {RADIAL}\n"
        (folder / "cameras.txt").write_text(camera)
        lines = ["# images"]
        for k in range(COUNT):
            pose = [*self.quaternion(k), *self.matrices[k][:3, 3]]
            lines.append(f"{k} {' '.join(map(repr, map(float, pose)))} 5 {self.names[k]}")
            lines.append(" ".join(f"1.0 2.0 {number}" for number in self.tracked(k)))
        (folder / "images.txt").write_text("\n".join(lines))
        rows = [
            f"{number} {' '.join(map(repr, map(float, point)))} {r} {g} {b} 0.5 1 1"
            for number, point, (r, g, b) in zip(self.ids, self.points, self.colours, strict=True)
        ]
        (folder / "points3D.txt").write_text("\n".join(rows) + "\n")

    def draw(self, folder: Path) -> None:
        """Write photos through the lens: a white dot for each point, and the photo's number as
        grey."""
        folder.mkdir(parents=True)
        lens = np.array([[FOCAL, 0, CENTRE[0] - 0.5], [0, FOCAL, CENTRE[1] - 0.5], [0, 0, 1]])
        for k in range(COUNT):
            picture = np.full((HEIGHT, WIDTH, 3), 4 * k, dtype=np.uint8)
            turned, _ = cv2.Rodrigues(self.matrices[k][:3, :3])
            bent = np.array([RADIAL, 0, 0, 0])
            at, _ = cv2.projectPoints(self.points, turned, self.matrices[k][:3, 3], lens, bent)
            for x, y in at.reshape(-1, 2):
                centre = (round(16 * x), round(16 * y))
                cv2.circle(picture, centre, 48, (255, 255, 255), -1, cv2.LINE_AA, 4)
            cv2.imwrite(str(folder / self.names[k]), picture, [cv2.IMWRITE_JPEG_QUALITY, 98])


@pytest.fixture(scope="module")
def model() -> Model:
    return Model()


@pytest.fixture
def colmap_folder(model: Model, tmp_path: Path) -> Path:
    """Return a folder as COLMAP makes it, with photos."""
    model.write_binary(tmp_path / "sparse" / "0")
    model.draw(tmp_path / "images")
    return tmp_path


def test_binary_and_text_models_are_read_alike(model: Model, tmp_path: Path) -> None:
    """Both formats give the written poses, points and colours, and each photo its own points."""
    model.write_binary(tmp_path / "a" / "sparse" / "0")
    model.write_text(tmp_path / "b" / "sparse")
    for found in (read_model(tmp_path / "a"), read_model(tmp_path / "b")):
        assert [view.name for view in found.views] == model.names
        assert found.cameras[5].distortion == (RADIAL, 0.0, 0.0, 0.0)
        assert found.cameras[5].focal == (FOCAL, FOCAL)
        np.testing.assert_allclose(found.points, model.points, atol=1e-12)
        np.testing.assert_array_equal(found.colours, model.colours)
        for k, view in enumerate(found.views):
            np.testing.assert_allclose(view.matrix, model.matrices[k], atol=1e-9)
            np.testing.assert_array_equal(view.points, np.arange(len(model.ids))[k::3])


@pytest.mark.parametrize("size", [1000, 160])
def test_photos_are_undistorted_and_scaled(model: Model, colmap_folder: Path, size: int) -> None:
    """In an undistorted photo, points are where its intrinsics and pose project them."""
    photo = read_photos(read_model(colmap_folder), colmap_folder / "images", size)[4]
    assert max(photo.rgb.shape) == min(size, WIDTH)
    local = model.points @ photo.matrix[:3, :3].T + photo.matrix[:3, 3]
    expected = ((local / local[:, 2:]) @ photo.intrinsics.T)[:, :2]
    reach = 5.0 * photo.rgb.shape[1] / WIDTH
    v, u = np.mgrid[0.5 : photo.rgb.shape[0], 0.5 : photo.rgb.shape[1]]
    seen = 0
    for x, y in expected:
        light = np.maximum(photo.rgb[..., 0].astype(float) - 40.0, 0.0)
        light *= np.hypot(u - x, v - y) < reach
        if light.sum() > 0 and reach < x < u.max() - reach and reach < y < v.max() - reach:
            found = ((light * u).sum() / light.sum(), (light * v).sum() / light.sum())
            assert math.dist(found, (x, y)) < 0.25
            seen += 1
    assert seen >= 15


def test_each_eighth_photo_is_held_out(colmap_folder: Path) -> None:
    """The third of each eight remaining photos is held out, and no photo is in both parts."""
    photos = read_photos(read_model(colmap_folder), colmap_folder / "images", 64, ["photo 01.jpg"])
    training, held_out = split(photos)
    assert [photo.name for photo in held_out] == ["photo 03.jpg", "photo 11.jpg"]
    assert len(training) == COUNT - 3
    assert not {photo.name for photo in training} & {photo.name for photo in held_out}
    with pytest.raises(MapError, match="2 photos; at least 3"):
        split(photos[:2])


def test_psnr_is_measured() -> None:
    """An error of 0.1 everywhere is 20 dB; an exposure is fitted away, and a shift of the picture
    is not."""
    photo = np.random.default_rng(1).uniform(0.2, 0.8, (20, 30, 3)).astype(np.float32)
    assert psnr_db(photo + np.float32(0.1), photo) == pytest.approx(20.0, abs=1e-4)
    assert psnr_db(photo, photo) == math.inf
    darker = (0.7 * photo + 0.05).astype(np.float32)
    assert psnr_db(darker, photo) < 20.0 < 100.0 < psnr_db(fitted(darker, photo), photo)
    moved = np.roll(photo, 3, axis=1)
    assert psnr_db(fitted(moved, photo), photo) < 20.0


def test_written_splats_are_read_by_the_importer(tmp_path: Path) -> None:
    """Places, sizes, colours and opacities are read back."""
    rng = np.random.default_rng(2)
    rows = np.zeros(50, dtype=SPLAT_ROW)
    for name in SPLAT_ROW.names or ():
        rows[name] = rng.normal(-1.0, 0.5, 50)
    path = tmp_path / "splats.ply"
    write_splats(rows, path)
    found = read_splats(path, path.read_bytes())
    np.testing.assert_array_equal(found.centres[:, 1], rows["y"])
    np.testing.assert_allclose(found.scales[:, 2], np.exp(rows["scale_2"]), rtol=1e-6)
    opacity = 255.0 / (1.0 + np.exp(-rows["opacity"]))
    colour = 255.0 * np.clip(0.5 + SH_C0 * rows["f_dc_0"], 0.0, 1.0)
    np.testing.assert_allclose(found.rgba[:, [0, 3]], np.stack([colour, opacity], 1), atol=0.6)


def _cut(folder: Path) -> None:
    path = folder / "sparse" / "0" / "images.bin"
    path.write_bytes(path.read_bytes()[:-100])


def _other_camera(folder: Path) -> None:
    path = folder / "sparse" / "0" / "cameras.bin"
    path.write_bytes(struct.pack("<QIiQQ4d", 1, 5, 8, WIDTH, HEIGHT, 1, 2, 3, 4))


def _without_photo(folder: Path) -> None:
    (folder / "images" / "photo 02.jpg").unlink()


def _small_photo(folder: Path) -> None:
    cv2.imwrite(str(folder / "images" / "photo 02.jpg"), np.zeros((60, 80, 3), np.uint8))


def _without_model(folder: Path) -> None:
    (folder / "sparse" / "0" / "points3D.bin").unlink()


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (_cut, "images.bin: is cut off or damaged"),
        (_other_camera, "camera model number 8 is not read; .*colmap image_undistorter"),
        (_without_photo, "photo 02.jpg: is missing"),
        (_small_photo, "photo 02.jpg: is 80 x 60 pixels, and its camera 320 x 240"),
        (_without_model, "holds no COLMAP model"),
    ],
)
def test_bad_models_are_refused(colmap_folder: Path, spoil: object, words: str) -> None:
    """The error names the file, what is wrong, and the remedy."""
    assert callable(spoil)
    spoil(colmap_folder)
    with pytest.raises(CosimError, match=words):
        read_photos(read_model(colmap_folder), colmap_folder / "images", 64)


def test_a_missing_package_is_named_with_its_installation(colmap_folder: Path) -> None:
    """Without gsplat the error has the command that installs it, after the inputs are checked."""
    with pytest.raises(SystemExit, match=r"gsplat cannot be imported: pip install torch gsplat=="):
        main([str(colmap_folder), str(colmap_folder / "out"), "--size", "64"])
    with pytest.raises(SystemExit, match=r"--leave-out 07\.jpg: not in the model"):
        main([str(colmap_folder), str(colmap_folder / "out"), "--leave-out", "07.jpg"])
    assert not (colmap_folder / "out").exists()


def test_dense_points_are_read(tmp_path: Path) -> None:
    """Places and colours are read from a file like COLMAP's fused.ply, and a truncated file is
    refused."""
    row = np.dtype([("p", "<f4", 3), ("n", "<f4", 3), ("c", "u1", 3)])
    rows = np.zeros(9, dtype=row)
    rows["p"], rows["c"] = np.arange(27).reshape(9, 3), np.arange(27).reshape(9, 3)
    names = ("x", "y", "z", "nx", "ny", "nz")
    head = ["ply", "format binary_little_endian 1.0", "element vertex 9"]
    head += [f"property float {name}" for name in names]
    head += [f"property uchar {name}" for name in ("red", "green", "blue")]
    data = "\n".join([*head, "end_header", ""]).encode() + rows.tobytes()
    (tmp_path / "fused.ply").write_bytes(data)
    at, colours = read_points(tmp_path / "fused.ply")
    np.testing.assert_array_equal(at, rows["p"])
    np.testing.assert_array_equal(colours, rows["c"])
    (tmp_path / "fused.ply").write_bytes(data[:-5])
    with pytest.raises(MapError, match="promises 9 points"):
        read_points(tmp_path / "fused.ply")
