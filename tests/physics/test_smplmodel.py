"""A user's own SMPL body and AMASS motions: read, checked, refused by file and field."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cosim.core.errors import SpecError
from physics.people.body import COATS, body
from physics.people.captures import capture
from physics.people.clips import clips_for
from physics.people.families import skeleton
from physics.people.looks import ALL
from physics.people.skeleton import INDEX, PARENTS, axis_angle, model_pose, rodrigues, skinned
from physics.people.smplmodel import read_motion, read_smpl, stride_of

FROM_OURS = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]])


def model_file(folder: Path, **changes: Any) -> Path:
    """A small file as SMPL's: a bar of four vertices about each joint of our man in the T, in SMPL's axes."""
    rest = skeleton("man").rest_m
    about = 0.03 * np.array([[1.0, 1.0, 1.0], [-1.0, -1.0, 1.0], [-1.0, 1.0, -1.0], [1.0, -1.0, -1.0]])
    vertices = (rest[:, None] + about).reshape(-1, 3) @ FROM_OURS.T - (0.0, 1.1, 0.0)
    first = 4 * np.arange(24)[:, None, None]
    faces = (first + np.array([[0, 1, 2], [0, 3, 1], [0, 2, 3], [1, 3, 2]])).reshape(-1, 3)
    arrays: dict[str, Any] = {
        "v_template": vertices,
        "weights": np.repeat(np.eye(24), 4, axis=0),
        "J_regressor": np.repeat(np.eye(24), 4, axis=1) / 4.0,
        "f": faces.astype(np.uint32),
        "kintree_table": np.array([[2**32 - 1, *PARENTS[1:]], range(24)], dtype=np.uint32),
        "shapedirs": np.ones((96, 3, 2)) * (0.0, 0.1),
    } | changes
    path = folder / "body.npz"
    np.savez(path, **{name: value for name, value in arrays.items() if value is not None})
    return path


def motion_file(folder: Path, **changes: Any) -> Path:
    """The shipped walk, twice, as AMASS stores a motion."""
    walk = capture("walk")
    turns = np.concatenate([walk.turns[:-1], walk.turns])
    ahead = np.concatenate([walk.pelvis_m[:-1], walk.pelvis_m + (walk.pelvis_m[-1] - walk.pelvis_m[0]) * (1, 1, 0)])
    bends = axis_angle(turns) @ FROM_OURS.T
    bends[:, 0] = axis_angle(turns[:, 0] @ FROM_OURS.T)
    arrays: dict[str, Any] = {
        "poses": bends.reshape(len(bends), 72),
        "trans": ahead,
        "mocap_framerate": np.array(30.0),
    } | changes
    path = folder / "walk.npz"
    np.savez(path, **{name: value for name, value in arrays.items() if value is not None})
    return path


def test_a_users_body_walks(tmp_path: Path) -> None:
    """Joints come out where they were, soles at 0, in our axes; our clips stand it up with its arms down."""
    read = read_smpl(model_file(tmp_path))
    lowest = skeleton("man").rest_m[:, 2].min() - 0.03
    assert read.skeleton.rest_m == pytest.approx(skeleton("man").rest_m - (0.0, 0.0, lowest), abs=1e-6)
    assert set(read.body.coat.tolist()) == {COATS.index(name) for name in ("skin", "top", "bottom", "shoes")}
    clips = clips_for(read.skeleton)
    shown = skinned(read.body.vertices, read.body.joints, read.body.weights, clips.matrices[clips.gestures["stand"][0]])
    wrist = shown[4 * INDEX["left_wrist"] :][:4].mean(axis=0)
    assert wrist[1] < 0.4 and wrist[2] < 1.0


def test_a_shape_moves_the_body(tmp_path: Path) -> None:
    """The second shape parameter of the test file moves every vertex alike; a third is refused."""
    plain, shaped = (read_smpl(model_file(tmp_path), shape) for shape in ((), (0.0, 1.0)))
    moved = np.asarray(shaped.body.vertices - plain.body.vertices)
    assert moved[:, :2] == pytest.approx(0.1, abs=1e-6)
    with pytest.raises(SpecError, match=r"body\.npz: shapedirs: 2 directions for a shape of 3"):
        read_smpl(model_file(tmp_path), (0.0, 0.0, 1.0))


def test_an_amass_walk_is_taken_over(tmp_path: Path) -> None:
    """The shipped walk comes back from its AMASS form, a stride is found in it, and gaits are made of it."""
    motion = read_motion(motion_file(tmp_path))
    walk = capture("walk")
    assert motion.frame_s == pytest.approx(1.0 / 30.0)
    inner = list(range(1, 24))
    assert motion.turns[:20, inner] == pytest.approx(walk.turns[:20, inner], abs=1e-6)
    up = rodrigues(axis_angle(motion.turns[0, 0]))[2, 2]
    assert up > 0.98 and motion.pelvis_m[-1, 0] == pytest.approx(2.48, abs=0.1)
    man = skeleton("man")
    stride = stride_of(motion, man)
    assert 36 <= len(stride.turns) <= 40
    clips = clips_for(man, stride)
    made = body(ALL[0], 1)
    assert np.isfinite(clips.matrices).all() and len(made.triangles)
    assert model_pose(0.0) == pytest.approx(np.tile(np.eye(3), (24, 1, 1)))


@pytest.mark.parametrize(
    ("field", "value", "said"),
    [
        ("v_template", None, r"body\.npz: no field 'v_template'; there are: J_regressor, f"),
        ("v_template", np.zeros((96, 2)), r"body\.npz: v_template: of shape \(96, 2\); it must be any x 3"),
        ("v_template", np.zeros((96, 3)), r"v_template: 0\.00 m tall; a person in metres"),
        ("weights", np.full((96, 24), np.nan), r"weights: holds values that are not finite"),
        ("weights", np.full((96, 24), 1.0), r"weights: each row must be shares that sum to 1"),
        ("J_regressor", np.zeros((24, 5)), r"J_regressor: of shape \(24, 5\); it must be 24 x 96"),
        ("f", np.array([[0, 1, 96]]), r"f: names vertices that do not exist; there are 96"),
        ("f", np.array([[0.0, 1.0, 2.0]]), r"f: float64 where whole numbers are needed"),
        ("kintree_table", np.zeros((2, 24), dtype=int), r"kintree_table: not the 24 joints of SMPL"),
        ("extra", np.array([{"a": 1}], dtype=object), r"extra: holds pickled objects, which are never read"),
    ],
)
def test_broken_bodies_are_named(tmp_path: Path, field: str, value: Any, said: str) -> None:
    """A file that is no SMPL body is refused by file and field."""
    with pytest.raises(SpecError, match=said):
        read_smpl(model_file(tmp_path, **{field: value}))


@pytest.mark.parametrize(
    ("field", "value", "said"),
    [
        ("trans", None, r"walk\.npz: no field 'trans'"),
        ("poses", np.zeros((5, 10)), r"poses: 10 numbers a frame"),
        ("poses", np.zeros((1, 72)), r"poses: 1 frames; it must be 2 to"),
        ("mocap_framerate", np.array(0.0), r"mocap_framerate: 0 frames a second"),
        ("trans", np.zeros((3, 3)), r"trans: of shape \(3, 3\); it must be 77 x 3"),
    ],
)
def test_broken_motions_are_named(tmp_path: Path, field: str, value: Any, said: str) -> None:
    """A file that is no AMASS motion is refused by file and field; so is one that is no .npz, and one without steps."""
    with pytest.raises(SpecError, match=said):
        read_motion(motion_file(tmp_path, **{field: value}))


def test_what_is_no_archive_is_named(tmp_path: Path) -> None:
    """A text file is refused by name, and a motion that stands has no stride."""
    path = tmp_path / "text.npz"
    path.write_text("hello")
    with pytest.raises(SpecError, match=r"text\.npz: not a \.npz file"):
        read_smpl(path)
    still = read_motion(motion_file(tmp_path, poses=np.zeros((77, 72)), trans=np.zeros((77, 3))))
    with pytest.raises(SpecError, match="no whole stride"):
        stride_of(still, skeleton("man"))
