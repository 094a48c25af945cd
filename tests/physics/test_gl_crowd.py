"""People as the gl camera draws them: silhouettes at each level of detail, shading, and objects."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

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
from physics.cameras.gl.shading import SceneBlocks
from physics.cameras.gl.shots import Shots
from physics.cameras.gl.targets import Target
from physics.cameras.sky import sky_of
from physics.cameras.view import Shot, shot
from physics.people.appearance import Look
from physics.people.wardrobe import ALL

pytestmark = [pytest.mark.engine, pytest.mark.skipif(not available(), reason="no OpenGL here")]

WIDE = 512, 288


def street(seed: int, count: int = 50, reach_m: float = 35.0) -> People:
    """Return a busy street before an eye at the origin that looks along x, from 3 m away."""
    rng = np.random.default_rng(seed)
    far = 3.0 + (reach_m - 3.0) * np.sqrt(rng.uniform(0.0, 1.0, count))
    way = rng.uniform(-0.85, 0.85, count)
    doing = rng.choice(["walk", "walk", "walk", "stand", "talk", "stop"], count).tolist()
    pace = np.where([action == "walk" for action in doing], rng.uniform(0.5, 1.8, count), 0.0)
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
    shots = Shots([taken])
    crowd.set([PeopleSeen(people, 2.0, flat, shadows=True)], shots)
    blocks = SceneBlocks(gl)
    target = Target(gl, taken.size)
    rows = np.zeros((1, 8, 4), dtype=np.float32)
    rows[0, :7] = lighting_of(sky_of(NOON, 1)).rows()
    none = np.eye(4)[None]
    blocks.set(shots.cameras(), none, none, shots.views(), rows)
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


def near_people(doing: str = "walk") -> People:
    """Return twelve people in two rows, 5 and 8 m away."""
    names = tuple(sorted(f"c{i}" for i in range(12)))
    rows = np.arange(12)
    xy = np.column_stack([5.0 + 3.0 * (rows % 2), 0.75 * (rows - 5.5)])
    pace = np.full(12, 1.3 if doing == "walk" else 0.0)
    return People.of(names, xy, 0.7 * rows, pace, (doing,) * 12, 0.13 * rows)


@pytest.fixture
def crowd() -> Iterator[CrowdDrawing]:
    with context() as gl:
        crowd = CrowdDrawing(gl)
        yield crowd
        crowd.release()


@pytest.mark.parametrize(("count", "reach_m", "share"), [(20, 12.0, 0.03), (50, 35.0, 0.05)])
def test_levels_of_detail_keep_the_silhouettes(
    crowd: CrowdDrawing, monkeypatch: pytest.MonkeyPatch, count: int, reach_m: float, share: float
) -> None:
    """On busy streets levels of detail change less than 3 % of the silhouette pixels of near
    people, and less than 5 % of all."""
    taken = shot((0.0, 0.0, 0.6), (10.0, 0.0, 0.6), WIDE, 75.0)
    scenes = [street(seed, count, reach_m) for seed in range(4)]
    levelled = [mask(crowd, people, taken) for people in scenes]
    monkeypatch.setattr(
        crowds, "levels", lambda shots, whose, xy, z_m: np.zeros(len(xy), dtype=np.intp)
    )
    full = [mask(crowd, people, taken) for people in scenes]
    changed = sum(int((a ^ b).sum()) for a, b in zip(levelled, full, strict=True))
    total = sum(int(b.sum()) for b in full)
    print(f"{100 * changed / total:.2f} % of {total} silhouette pixels changed")
    assert changed < share * total


def test_people_are_neither_black_nor_flat(crowd: CrowdDrawing) -> None:
    """At noon people reflect 0.12 to 0.6 of white on average, and their pixels vary like cloth in
    light and shade."""
    taken = shot((0.0, 0.0, 0.6), (10.0, 0.0, 0.6), WIDE, 75.0)
    with drawing(crowd, near_people(), taken) as (rgb, labels):
        light = rgb[labels == LABELS["person"]] @ (0.2126, 0.7152, 0.0722) / 255.0
    print(f"luminance {light.mean():.3f} +- {light.std():.3f} of {len(light)} pixels")
    assert 0.12 < light.mean() < 0.6 and light.std() > 0.08


@pytest.mark.parametrize(
    ("companion", "higher"), [("umbrella", 1.06), ("wheelchair", 0.5), ("pram", 0.9), ("dog", 0.9)]
)
def test_objects_are_drawn_and_labelled(
    crowd: CrowdDrawing, monkeypatch: pytest.MonkeyPatch, companion: str, higher: float
) -> None:
    """Objects that people push, lead or hold have the label of people. Umbrellas rise over heads,
    and people in wheelchairs sit."""
    taken = shot((0.0, 0.0, 0.6), (10.0, 0.0, 0.6), WIDE, 75.0)
    plain = mask(crowd, near_people(), taken)
    crowds._worn.cache_clear()
    look = crowds.look_of
    variants = {o.family: k for k, o in enumerate(ALL) if o.companion == companion}

    def with_companion(name: str, age: int, *more: Any) -> Look:
        own = look(name, age, *more)
        return dataclasses.replace(own, outfit=variants[ALL[own.outfit].family])

    monkeypatch.setattr(crowds, "look_of", with_companion)
    other = CrowdDrawing(context())
    shown = mask(other, near_people(), taken)
    other.release()
    crowds._worn.cache_clear()
    changed = shown ^ plain
    assert changed.sum() > 0.03 * plain.sum()
    rows = [np.flatnonzero(one.any(axis=1)) for one in (plain, shown)]
    tall = [288 // 2 - int(row.min()) for row in rows]
    assert tall[1] > higher * tall[0] if companion != "wheelchair" else tall[1] < 0.85 * tall[0]
