"""Reading of scans: meshes, splats, frames and order."""

from __future__ import annotations

import gzip
from pathlib import Path

import numpy as np
import pytest
import trimesh
from PIL import Image

from cosim.core.errors import MapError
from cosim.place.scan import Splats
from physics.scans.bake import split_edges
from physics.scans.frame import Placing, combine, file_matrix, move, move_splats, place
from physics.scans.ordering import order_mesh, order_splats
from physics.scans.read_mesh import read_mesh
from physics.scans.read_splats import RawSplats, read_splats
from physics.scans.sources import read_source
from tests.support.scans import Cloud, gaussian_ply, splat_file, splats_of, spz_file, street

METRES = file_matrix(1.0, "+z", None)


def _cloud() -> Cloud:
    random = np.random.default_rng(1)
    found = splats_of(street(), 500)
    quaternions = random.normal(size=(500, 4))
    quaternions /= np.linalg.norm(quaternions, axis=1)[:, None]
    rgba = random.uniform(0.1, 0.9, (500, 4))
    return Cloud(found.centres, random.uniform(0.02, 0.3, (500, 3)), quaternions, rgba)


def _covariances(cloud: Cloud) -> np.ndarray:
    """Return covariances by scipy's rotations and matrix products."""
    from scipy.spatial.transform import Rotation

    turn = Rotation.from_quat(cloud.quaternions[:, [1, 2, 3, 0]]).as_matrix()
    axes = turn * cloud.scales[:, None, :]
    full = axes @ axes.transpose(0, 2, 1)
    return full[:, [0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]]


@pytest.mark.parametrize(
    ("name", "data", "place_m", "size"),
    [
        ("a.ply", gaussian_ply(_cloud()), 1e-5, 1e-4),
        ("a.ply", gaussian_ply(_cloud(), linear=True), 1e-5, 1e-4),
        ("a.ply.gz", gzip.compress(gaussian_ply(_cloud())), 1e-5, 1e-4),
        ("a.splat", splat_file(_cloud()), 1e-5, 0.1),
        ("a.spz", spz_file(_cloud(), 1), 0.02, 0.15),
        ("a.spz", spz_file(_cloud(), 2), 2e-4, 0.15),
        ("a.spz", spz_file(_cloud(), 3), 2e-4, 0.1),
    ],
    ids=["log", "linear", "gz", "splat", "spz1", "spz2", "spz3"],
)
def test_splats_of_every_format_are_the_same(
    tmp_path: Path, name: str, data: bytes, place_m: float, size: float
) -> None:
    """Centres, covariances, colours and opacities are read as precisely as each format stores
    them."""
    (tmp_path / name).write_bytes(data)
    raw = read_splats(tmp_path / name, read_source(tmp_path / name))
    cloud = _cloud()
    found = move_splats(raw, METRES)
    assert np.abs(found.centres - cloud.centres).max() < place_m
    wanted = _covariances(cloud)
    error = np.abs(found.covariances - wanted).max(axis=1) / np.abs(wanted).max(axis=1)
    assert np.quantile(error, 0.95) < size
    assert np.abs(found.rgba / 255.0 - cloud.rgba).max() < 0.02


def test_other_quaternion_orders_and_harmonics_are_read() -> None:
    """Rotations stored x, y, z, w are read by option, and harmonics above degree 0 are left out."""
    cloud = _cloud()
    extra = tuple(f"f_rest_{k}" for k in range(45))
    raw = read_splats(Path("a.ply"), gaussian_ply(cloud, order="xyzw", extra=extra), "xyzw")
    assert np.abs(raw.quaternions - cloud.quaternions).max() < 1e-6
    assert "harmonics of degree 3 cut to 0" in " ".join(str(one) for one in raw.findings)


def test_a_frame_turns_scales_and_moves_splats() -> None:
    """Covariances follow the matrix: A C A' for the whole similarity, computed in another way."""
    cloud = _cloud()
    raw = RawSplats(cloud.centres, cloud.scales, cloud.quaternions, np.zeros((500, 4), np.uint8))
    matrix = combine(
        ((1, 0, 0, 3), (0, 1, 0, 4), (0, 0, 1, 5), (0, 0, 0, 1)), file_matrix(2.5, "-y", None)
    )
    found = move_splats(raw, matrix)
    a = np.array(matrix)[:3, :3]
    assert np.linalg.det(a) == pytest.approx(2.5**3)
    assert found.centres == pytest.approx(cloud.centres @ a.T + [3, 4, 5], abs=1e-4)
    assert np.linalg.norm(a @ [0, -1, 0] - [0, 0, 2.5]) < 1e-12
    full = _covariances(cloud)[:, [0, 1, 2, 1, 3, 4, 2, 4, 5]].reshape(-1, 3, 3)
    wanted = (a @ full @ a.T)[:, [0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]]
    assert found.covariances == pytest.approx(wanted, abs=1e-5)


def test_a_far_scan_gets_a_local_origin_and_true_north() -> None:
    """UTM coordinates become metres around a local origin, turned from grid to true north."""
    low, high = np.array([391_000.0, 5_819_900.0, 30.0]), np.array([391_100.0, 5_820_100.0, 45.0])
    matrix, origin = place(low, high, Placing(crs="EPSG:25833"))
    assert origin is not None
    assert (origin.latitude_deg, origin.longitude_deg) == pytest.approx(
        (52.5192, 13.3943), abs=1e-4
    )
    north = move(np.array([[391_050.0, 5_820_100.0, 30.0]]), matrix)[0]
    # 1.606 degrees west of the zone's middle: grid north is 1.274 degrees west of true north.
    assert np.degrees(np.arctan2(north[0], north[1])) == pytest.approx(-1.274, abs=0.01)
    assert np.hypot(*north[:2]) == pytest.approx(100.0, abs=0.05)
    assert north[2] == 0.0


@pytest.mark.parametrize("ending", ["glb", "ply", "obj"])
def test_meshes_of_every_format_are_the_same(tmp_path: Path, ending: str) -> None:
    """Vertices, triangles and vertex colours are equal in each format."""
    wanted = street()
    path = tmp_path / f"a.{ending}"
    wanted.mesh().export(path)
    raw = read_mesh(path, path.read_bytes(), 1.0)
    one, two = (
        order_mesh(v.astype(np.float32), t, c)
        for v, t, c in (
            (raw.vertices, raw.triangles, raw.colours),
            (wanted.vertices, wanted.triangles, wanted.colours),
        )
    )
    assert np.abs(one.vertices - two.vertices).max() < 1e-5
    assert (one.triangles == two.triangles).all()
    assert np.abs(one.colours.astype(int) - two.colours).max() <= 1


def test_colours_of_gltf_are_linear_unless_its_program_writes_srgb(tmp_path: Path) -> None:
    """A byte of 55 is sRGB 128 by the specification; trimesh writes sRGB."""
    mesh = street().mesh()
    mesh.visual.vertex_colors = np.full((len(mesh.vertices), 4), 55, np.uint8)
    path = tmp_path / "a.glb"
    mesh.export(path)
    data = path.read_bytes()
    assert read_mesh(path, data, 1.0).colours[0].tolist() == [55, 55, 55]
    assert read_mesh(path, data, 1.0, "linear").colours[0].tolist() == [128, 128, 128]


def test_a_texture_is_baked_to_vertices(tmp_path: Path) -> None:
    """Edges are split to 0.1 m without gaps, and vertices have the colour of the texture."""
    pixels = np.zeros((64, 64, 3), np.uint8)
    pixels[:32], pixels[32:] = (255, 0, 0), (0, 0, 255)
    quad = trimesh.Trimesh(
        [[0, 0, 0], [4, 0, 0], [4, 4, 0], [0, 4, 0]], [[0, 1, 2], [0, 2, 3]], process=False
    )
    quad.visual = trimesh.visual.TextureVisuals(
        uv=[[0, 0], [1, 0], [1, 1], [0, 1]], image=Image.fromarray(pixels)
    )
    path = tmp_path / "a.glb"
    quad.export(path)
    raw = read_mesh(path, path.read_bytes(), 1.0)
    lower, upper = raw.vertices[:, 1] < 1.9, raw.vertices[:, 1] > 2.1
    assert (raw.colours[lower] == (0, 0, 255)).all()
    assert (raw.colours[upper] == (255, 0, 0)).all()
    assert trimesh.Trimesh(raw.vertices, raw.triangles).area == pytest.approx(16.0)
    sides = raw.vertices[raw.triangles] - raw.vertices[np.roll(raw.triangles, 1, axis=1)]
    assert np.linalg.norm(sides, axis=2).max() <= 0.1


def test_split_edges_leave_no_gap() -> None:
    """A closed body stays closed and has the same volume."""
    box = trimesh.creation.box((3.0, 0.4, 1.1))
    values, triangles = split_edges(np.asarray(box.vertices), np.asarray(box.faces), 0.25)
    after = trimesh.Trimesh(values, triangles, process=False)
    assert after.is_watertight
    assert after.volume == pytest.approx(box.volume)


def test_the_order_in_the_files_changes_no_bit() -> None:
    """Meshes and splats are the same arrays after any shuffle of rows, corners and vertices."""
    random = np.random.default_rng(2)
    wanted = street()
    vertices = wanted.vertices.astype(np.float32)
    rows = random.permutation(len(vertices))
    triangles = np.argsort(rows)[wanted.triangles[random.permutation(len(wanted.triangles))]]
    one = order_mesh(vertices, wanted.triangles, wanted.colours)
    two = order_mesh(vertices[rows], np.roll(triangles, 1, axis=1), wanted.colours[rows])
    for name in ("vertices", "triangles", "colours"):
        assert (getattr(one, name) == getattr(two, name)).all()
    cloud = _cloud()
    cloud.centres[100:400] = cloud.centres[0]  # equal codes: their bytes decide
    splats = []
    for order in (np.arange(500), random.permutation(500)):
        raw = read_splats(Path("a.ply"), gaussian_ply(cloud.taken(order)))
        splats.append(order_splats(move_splats(raw, METRES)))
    for name in Splats.__slots__:
        assert (getattr(splats[0], name) == getattr(splats[1], name)).all()


@pytest.mark.parametrize(
    ("name", "data", "words"),
    [
        ("a.spz", b"NGSP\x04\x00\x00\x00" + bytes(32), "version 4, packed with zstd"),
        ("a.spz", spz_file(_cloud(), 3)[:-400], "cut off or damaged"),
        ("a.splat", splat_file(_cloud())[:-7], "no multiple of 32"),
        ("a.ply", gaussian_ply(_cloud())[:-7], "promises 500 splats of 56 bytes.*enough for 499"),
        ("a.ply", gaussian_ply(_cloud()).replace(b"rot_3", b"twist"), "rot_3 are missing"),
        (
            "a.ply",
            b"ply\nformat ascii 1.0\nelement vertex 0\nproperty float f_dc_0\nend_header\n",
            "only binary_little_endian",
        ),
        (
            "a.ply",
            b"ply\nformat binary_little_endian 1.0\nelement chunk 1\nproperty float min_x\n"
            b"element vertex 1\nproperty uint packed_position\nend_header\n",
            "compressed .ply of",
        ),
        ("a.ply", b"solid nothing", "not a .ply file"),
    ],
    ids=["zstd", "cut-spz", "cut-splat", "cut-ply", "names", "ascii", "supersplat", "other"],
)
def test_splats_that_cannot_be_read_are_refused(name: str, data: bytes, words: str) -> None:
    """The message names the file, the fault and the remedy."""
    with pytest.raises(MapError, match=f"{name}.*{words}"):
        read_splats(Path(name), data)
