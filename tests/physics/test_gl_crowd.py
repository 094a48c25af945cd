"""People as the gl camera draws them: levels of detail keep the silhouettes, poses are those of the
joints."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import moderngl
import numpy as np
import pytest
from numpy.typing import NDArray

from cosim.core.geometry import Floats
from cosim.core.state import LABELS, People
from physics.cameras.gl import crowd as crowds
from physics.cameras.gl.camera import NOON
from physics.cameras.gl.context import available, context
from physics.cameras.gl.crowd import CrowdDrawing, PeopleSeen
from physics.cameras.gl.lighting import lighting_of
from physics.cameras.gl.shading import SceneBlocks, anchor_of, camera_matrix
from physics.cameras.gl.shots import Shots
from physics.cameras.gl.targets import Target
from physics.cameras.sky import sky_of
from physics.cameras.view import Shot, shot

pytestmark = [pytest.mark.engine, pytest.mark.skipif(not available(), reason="no OpenGL here")]

WIDE = 512, 288


def street(seed: int, count: int = 50) -> People:
    """A busy street before an eye at the origin that looks along x: 3 to 35 m away."""
    rng = np.random.default_rng(seed)
    far = 3.0 + 32.0 * np.sqrt(rng.uniform(0.0, 1.0, count))
    way = rng.uniform(-0.85, 0.85, count)
    doing = rng.choice(["walk", "walk", "walk", "stand", "talk", "stop"], count).tolist()
    pace = np.where([what == "walk" for what in doing], rng.uniform(0.5, 1.8, count), 0.0)
    names = tuple(sorted(f"c{seed * count + i}" for i in range(count)))
    xy = np.column_stack([far * np.cos(way), far * np.sin(way)])
    return People.of(
        names, xy, rng.uniform(-3.0, 3.0, count), pace, tuple(doing), rng.uniform(0.0, 9.0, count)
    )


def flat(xy: Floats) -> Floats:
    return np.zeros(len(xy))


@contextmanager
def drawing(
    crowd: CrowdDrawing, people: People, taken: Shot
) -> Iterator[tuple[NDArray[np.uint8], NDArray[np.uint8]]]:
    gl = context()
    anchor = anchor_of(taken.eye_m)
    crowd.set([PeopleSeen(people, 2.0, flat, shadows=True)], Shots([taken]))
    blocks = SceneBlocks(gl)
    target = Target(gl, taken.size)
    blocks.put(
        0, camera_matrix(taken, anchor), np.eye(4), taken, anchor, lighting_of(sky_of(NOON, 1))
    )
    blocks.upload()
    blocks.bind()
    target.frame.use()
    gl.enable_only(moderngl.DEPTH_TEST | moderngl.CULL_FACE)
    gl.front_face = "cw"
    gl.depth_func = "<"
    target.frame.clear(depth=1.0)
    crowd.draw("colour", shadows=False)
    yield target.read()
    target.release()
    blocks.release()


def mask(crowd: CrowdDrawing, people: People, taken: Shot) -> NDArray[np.bool_]:
    with drawing(crowd, people, taken) as (_, labels):
        return np.asarray(labels == LABELS["person"])


@pytest.fixture
def crowd() -> Iterator[CrowdDrawing]:
    with context() as gl:
        crowd = CrowdDrawing(gl)
        yield crowd
        crowd.release()


def test_levels_of_detail_keep_the_silhouettes(
    crowd: CrowdDrawing, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In pictures of busy streets levels of detail change less than 3 % of the silhouettes'
    pixels."""
    taken = shot((0.0, 0.0, 0.6), (10.0, 0.0, 0.6), WIDE, 75.0)
    scenes = [street(seed) for seed in range(4)]
    levelled = [mask(crowd, people, taken) for people in scenes]
    monkeypatch.setattr(
        crowds, "levels", lambda shots, whose, xy, z_m: np.zeros(len(xy), dtype=np.intp)
    )
    full = [mask(crowd, people, taken) for people in scenes]
    changed = sum(int((a ^ b).sum()) for a, b in zip(levelled, full, strict=True))
    total = sum(int(b.sum()) for b in full)
    print(f"{100 * changed / total:.2f} % of {total} silhouette pixels changed")
    assert changed < 0.03 * total
