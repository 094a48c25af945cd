"""Splats in the gl camera: agreement with a slow reference, and covering of people like the scan's
mesh."""

from __future__ import annotations

import dataclasses
import math
import os
import subprocess
import sys
from pathlib import Path

import msgspec
import numpy as np
import pytest

from cosim.core.geometry import Pose
from cosim.core.state import LABELS, Frame, People, RobotState, Street
from cosim.place.scan import Scan, ScanSun, Splats
from cosim.spec.camera import CameraSpec
from cosim.spec.options import EpisodeOptions
from cosim.spec.run_config import Appearance, RunConfig
from physics.cameras.choice import renderer_of
from physics.cameras.gl import context
from physics.cameras.gl.atlas import Atlas
from physics.cameras.gl.camera import GlCamera
from physics.cameras.gl.splat_layers import splat_pictures
from physics.cameras.gl.splat_sort import (
    CARD,
    PROCESSOR,
    Buffers,
    ShaderSort,
    SplatShaders,
    Tuning,
    read_words,
)
from physics.cameras.gl.splats import SplatDrawing, distance_keys
from physics.cameras.view import shot
from physics.dynamics.world import BulletWorld
from physics.street.scan_surface import ScanSurface
from tests.conftest import PATIENCE_S
from tests.support.splat_scan import (
    AHEAD,
    WALL_X_M,
    covariances,
    drawn,
    drawn_together,
    picture_hash,
    random_splats,
    reference_picture,
    street_scan,
)
from tests.support.tiny_street import tiny_map

pytestmark = [
    pytest.mark.engine,
    pytest.mark.skipif(not context.available(), reason="no OpenGL through EGL here"),
]

LOW = CameraSpec(width=240, height=160, fov_deg=60.0)
APPEARANCES: tuple[Appearance, ...] = ("splats", "mesh")
SUN = ScanSun(azimuth_deg=90.0, elevation_deg=45.0)


def test_splats_agree_with_a_reference_in_float64() -> None:
    """99.9 % of pixels agree within 1/255, and 99 % of the depths within 1 mm. Splats are blobs,
    needles, huge, transparent, opaque, or behind the eye."""
    near, same_m = [], []
    for seed in range(4):
        splats = random_splats(seed)
        found, median = drawn(splats)
        colour, depth = reference_picture(splats, AHEAD)
        near.append(np.abs(found.astype(float) - colour).max(axis=2) <= 1.0 / 255.0)
        same_m.append(np.abs(median - depth) < 1e-3)
        assert (colour[..., 3] < 0.5).mean() > 0.3
    assert np.mean(near) >= 0.999
    assert np.mean(same_m) >= 0.99


def _last(splats: Splats, count: int) -> Splats:
    return Splats(*(getattr(splats, name)[-count:] for name in Splats.__slots__))


@pytest.mark.parametrize("count", [1, 70, 5000])
def test_sorting_in_shaders_changes_no_bit(count: int) -> None:
    """Sorting in shaders, and other work sizes, give the same pictures."""
    splats = random_splats(7, max(count, 300))
    few = _last(splats, count)
    here, card = (drawn(few, tuning=tuning) for tuning in (PROCESSOR, CARD))
    assert np.array_equal(here[0], card[0]) and np.array_equal(here[1], card[1])
    assert (here[0][..., 3] < 1.0).any()


@pytest.mark.parametrize(
    "limits",
    [{}, {"views": 2}, {"splats": 9000}, {"pairs": 20_000}],
    ids=lambda limits: " ".join(limits) or "one pass",
)
def test_views_drawn_together_equal_single_views(limits: dict[str, int]) -> None:
    """Five views at once, one without a splat in view, equal single views bit for bit, in one pass
    or in passes of limited memory."""
    splats = random_splats(7, 3000)
    aims = [(1.0, 0.02, -0.05), (1.0, 0.5, 0.1), (0.0, 0.0, 1.0), (-1.0, 0.0, 0.0), (1.0, 0.0, 0.0)]
    eyes = [(0.0, 0.0, 0.0), (1.0, 0.3, 0.2), (0.0, 0.0, 90.0), (9.0, 0.0, 0.0), (-2.0, 1.0, 0.0)]
    views = [
        shot(eye, tuple(e + a for e, a in zip(eye, aim, strict=True)), (150, 92), 60.0)
        for eye, aim in zip(eyes, aims, strict=True)
    ]
    together = drawn_together(splats, views, CARD._replace(**limits))
    for found, taken in zip(together, views, strict=True):
        alone = drawn(splats, taken, PROCESSOR)
        assert np.array_equal(found[0], alone[0]) and np.array_equal(found[1], alone[1])
    filled = [(colour[..., 3] < 1.0).any() for colour, _ in together]
    assert filled == [True, True, False, True, True]


@pytest.mark.parametrize("count", [0, 1, 2047, 2048, 100_000])
def test_sorts_in_shaders_equal_those_of_numpy(count: int) -> None:
    """Sums, and pairs sorted stably by 11 bits of their keys, are equal, also with many blocks."""
    rng = np.random.default_rng(count)
    keys = rng.integers(0, 2000, count).astype(np.uint32)
    numbers = np.arange(count, dtype=np.uint32)
    with context.context() as gl:
        shaders, buffers = SplatShaders(gl, CARD), Buffers(gl)
        names = ("keys", "values", "keys next", "values next", "summed")
        held = [buffers.room(name, count + 1) for name in names]
        for buffer, data in zip((held[0], held[1], held[4]), (keys, numbers, keys), strict=True):
            buffer.write(data)
        sort = ShaderSort(shaders, buffers)
        found = sort.sort((held[0], held[1]), (held[2], held[3]), count, 11)
        sort.sums(held[4], count)
        sorted_keys, order = (read_words(gl, buffer, 0, count) for buffer in found)
        sums = read_words(gl, held[4], 0, count + 1)
        buffers.release()
    expected = keys.argsort(kind="stable")
    assert np.array_equal(order, expected) and np.array_equal(sorted_keys, keys[expected])
    assert np.array_equal(sums, np.concatenate([[0], np.cumsum(keys)]))


def test_sums_in_shaders_have_three_levels() -> None:
    """More values than the square of a block are summed."""
    count = 2048 * 2048 + 5
    with context.context() as gl:
        shaders, buffers = SplatShaders(gl, CARD), Buffers(gl)
        values = buffers.room("values", count + 1)
        values.write(np.full(count, 3, dtype=np.uint32))
        ShaderSort(shaders, buffers).sums(values, count)
        sums = read_words(gl, values, 0, count + 1)
        buffers.release()
    assert np.array_equal(sums, 3 * np.arange(count + 1))


def test_huge_splats_fill_a_large_picture() -> None:
    """All pixels have what 150 faint layers let through, though each layer covers thousands of
    tiles."""
    count = 150
    centres = np.tile((20.0, 0.0, 0.0), (count, 1)).astype(np.float32)
    wide = covariances(np.tile(np.eye(3), (count, 1, 1)), np.full((count, 3), 2000.0))
    rgba = np.tile(np.array((255, 255, 255, 3), dtype=np.uint8), (count, 1))
    splats = Splats(centres, wide, rgba, np.zeros(count, dtype=bool))
    taken = shot((0.0, 0.0, 0.0), (1.0, 0.0, 0.0), (1024, 512), 60.0)
    found, _ = drawn(splats, taken)
    assert np.abs(found[..., 3].astype(float) - (1.0 - 3.0 / 255.0) ** count).max() < 1.0 / 255.0


def test_a_tile_may_have_more_splats_than_a_loop_has_iterations() -> None:
    """A splat behind 70,000 small ones is drawn in all pixels around them."""
    count = 70_000
    centres = np.zeros((count + 1, 3), dtype=np.float32)
    centres[:, 0] = 20.0
    centres[count, 0] = 30.0
    sizes = np.full((count + 1, 3), 5e-4)
    sizes[count] = 3.0
    wide = covariances(np.tile(np.eye(3), (count + 1, 1, 1)), sizes)
    rgba = np.full((count + 1, 4), 255, dtype=np.uint8)
    splats = Splats(centres, wide, rgba, np.zeros(count + 1, dtype=bool))
    taken = shot((0.0, 0.0, 0.0), (1.0, 0.05, 0.05), (64, 64), 60.0)
    many, few = drawn(splats, taken)[0], drawn(_last(splats, 101), taken)[0]
    around = (few[..., 3] > 0.2) & (few[..., 3] < 0.6)
    assert around.sum() > 50
    assert np.abs(many.astype(float) - few)[around].max() < 0.01


def test_a_picture_depends_on_every_splat() -> None:
    """One splat in another colour gives other bits, and the same splats the same."""
    splats = random_splats(3)
    rgba = splats.rgba.copy()
    visible = 299
    rgba[visible] = (255 - rgba[visible, 0], *rgba[visible, 1:3], 255)
    other = Splats(splats.centres, splats.covariances, rgba, splats.ground)
    assert np.array_equal(drawn(splats)[0], drawn(splats)[0])
    assert not np.array_equal(drawn(splats)[0], drawn(other)[0])


def test_keys_grow_with_the_distance() -> None:
    """Steps are below a thousandth of the distance from 0.25 m on, up to kilometres."""
    far_m = np.geomspace(0.1, 8000.0, 3000).astype(np.float32)
    centres = np.column_stack([far_m, np.zeros_like(far_m), np.zeros_like(far_m)])
    keys = distance_keys(centres, np.zeros(3, dtype=np.float32)).astype(int)
    assert (np.diff(keys) >= 0).all()
    assert (np.diff(keys)[far_m[1:] > 0.26] > 0).all()


def test_the_number_of_threads_changes_no_bit() -> None:
    """A picture by one thread equals one by four."""
    drawing = [
        subprocess.Popen(
            [sys.executable, "-c", "import tests.support.splat_scan as s; print(s.picture_hash())"],
            cwd=Path(__file__).parents[2],
            env={**os.environ, "LP_NUM_THREADS": count},
            stdout=subprocess.PIPE,
            text=True,
        )
        for count in ("1", "4")
    ]
    found = [process.communicate(timeout=PATIENCE_S)[0].strip() for process in drawing]
    assert found == [picture_hash()] * 2


def walkers(count: int) -> Street:
    """Return people in two rows on the street, some of them behind the wall."""
    numbers = np.arange(count)
    xy = np.column_stack([1.0 + 1.5 * numbers, np.where(numbers % 2, 3.0, 0.7)])
    ids = tuple(f"c{i:03d}" for i in range(count))
    return Street(0, People.of(ids, xy, 0.4 * numbers, np.ones(count), ("walk",) * count))


def line_of_people(x_m: float, called: str = "c") -> Street:
    """Return people side by side across x, half of them next to the wall. called: start of ids."""
    y = np.arange(-1.6, 1.7, 0.4)
    ids = tuple(f"{called}{i:03d}" for i in range(len(y)))
    xy = np.column_stack([np.full(len(y), x_m), y])
    doing = ("stand",) * len(y)
    return Street(0, People.of(ids, xy, np.zeros(len(y)), np.zeros(len(y)), doing))


def _picture(scan: Scan, appearance: Appearance, street: Street) -> Frame:
    """Draw the street at the height of a robot's camera, looking along x."""
    world = BulletWorld(ScanSurface(tiny_map(), scan, 0))
    with GlCamera(world, LOW, depth=True, appearance=appearance) as camera:
        return camera.picture((-3.0, 2.0, 0.6), (0.0, 2.0, 0.5), street, size=(240, 160))


def _lowest(frame: Frame) -> np.ndarray:
    """Return the mask of pixels below 0.3 m, by depth and row."""
    rows = (np.arange(160) + 0.5 - 80.0) / 80.0 * math.tan(math.radians(30.0))
    assert frame.depth is not None
    steep = math.atan2(0.1, 3.0)
    down = (rows[:, None] * math.cos(steep) + math.sin(steep)) * frame.depth
    return np.asarray(0.6 - down < 0.3)


def _ground_at(frame: Frame) -> np.ndarray:
    """Return (160, 240, 2) points of the map that the pixels of `_picture` show."""
    taken = shot((-3.0, 2.0, 0.6), (0.0, 2.0, 0.5), (240, 160), LOW.fov_deg)
    right, up, ahead = taken.axes
    across, down = np.meshgrid(
        (np.arange(240) + 0.5) / 120.0 - 1.0, (np.arange(160) + 0.5) / 80.0 - 1.0
    )
    wide, tall = taken.half_picture
    ray = across[..., None] * wide * right - down[..., None] * tall * up + ahead
    assert frame.depth is not None
    return np.asarray((taken.eye_m + frame.depth[..., None] * ray)[..., :2])


def _shares(x_m: float) -> tuple[float, float, float]:
    """Return shares of the visible pixels of people that show them, of their lowest 0.3 m, and of
    the hidden ones that do not."""
    line = line_of_people(x_m)
    truth = _picture(street_scan(), "mesh", line)
    alone = _picture(street_scan(opacity=0, walled=False), "splats", line)
    seen = _picture(street_scan(), "splats", line)
    assert truth.labels is not None and seen.labels is not None
    visible = truth.labels == LABELS["person"]
    shown = (np.abs(seen.rgb.astype(int) - alone.rgb).max(axis=2) <= 2) & (
        seen.labels == LABELS["person"]
    )
    low = visible & _lowest(truth)
    assert visible.sum() > 200 and low.sum() > 20
    hidden = ~visible & (alone.labels == LABELS["person"])
    return (
        float(shown[visible].mean()),
        float(shown[low].mean()),
        float(1.0 - (seen.labels == LABELS["person"])[hidden].mean()) if hidden.any() else 1.0,
    )


@pytest.mark.parametrize("x_m", [1.0, 4.0, WALL_X_M - 0.4, WALL_X_M + 1.5])
def test_splats_cover_people_where_the_mesh_does(x_m: float) -> None:
    """95 % of the visible pixels of people in front of and behind a wall are shown, also of the
    lowest 0.3 m. 95 % of the hidden ones are not."""
    assert min(_shares(x_m)) >= 0.95


def test_people_behind_a_wall_do_not_show_through_gaps_of_its_splats() -> None:
    """Where a wall of the mesh hides people, other clothes change no pixel, however faint the
    wall's splats are."""
    lines = [line_of_people(WALL_X_M + 1.5, called) for called in "ck"]
    first, second = (_picture(street_scan(opacity=25), "splats", line) for line in lines)
    bare = [_picture(street_scan(opacity=0, walled=False), "splats", line) for line in lines]
    mesh_picture = _picture(street_scan(), "mesh", lines[0])
    assert (
        bare[0].labels is not None
        and bare[1].labels is not None
        and mesh_picture.labels is not None
    )
    hidden = (bare[0].labels == LABELS["person"]) & (bare[1].labels == LABELS["person"])
    hidden &= mesh_picture.labels == LABELS["building"]
    assert hidden.sum() > 200 and (bare[0].rgb != bare[1].rgb)[hidden].any(axis=1).mean() > 0.5
    apart = np.abs(first.rgb.astype(int) - second.rgb).max(axis=2)
    assert (apart[hidden] == 0).mean() > 0.95


def test_without_the_depth_test_splats_cover_everything(monkeypatch: pytest.MonkeyPatch) -> None:
    """The test of covering fails if splats are not limited by the mesh."""
    draw = SplatDrawing.draw

    def unlimited(self: SplatDrawing, *given: object, limited: bool) -> None:
        draw(self, *given, limited=False)  # type: ignore[arg-type]

    monkeypatch.setattr(SplatDrawing, "draw", unlimited)
    assert min(_shares(4.0)) < 0.5


@pytest.mark.parametrize("tuning", [PROCESSOR, CARD], ids=["processor", "card"])
def test_a_batch_of_scans_equals_single_cameras(
    tuning: Tuning, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Two scanned places and four robots at once equal single cameras bit for bit."""
    scans = [street_scan(sun=SUN), street_scan(noise_m=0.02)]
    worlds = [BulletWorld(ScanSurface(tiny_map(), scans[k], 0)) for k in (0, 0, 0, 1)]
    poses = (Pose(-3.0, 2.0, 0.0), Pose(-1.0, 1.0, 0.1), Pose(0.0, 3.0, -0.2), Pose(2.0, 0.5, 0.3))
    robots = [RobotState(pose) for pose in poses]
    spec = CameraSpec(width=96, height=64)
    single = []
    for world, robot in zip(worlds, robots, strict=True):
        with GlCamera(world, spec) as camera:
            single.append(camera.render(robot, walkers(4)))
    with context.context() as gl:
        drawing = SplatDrawing(gl, tuning)
        monkeypatch.setattr(splat_pictures(gl), "drawing", drawing)
    with Atlas(spec) as atlas:
        keys = [atlas.join(world) for world in worlds]
        order = (3, 1, 0, 2)
        seen = [(keys[k], robots[k], walkers(4)) for k in order]
        found = atlas.render(seen) + atlas.render(seen[:1])
    for frame, k in zip(found, (*order, order[0]), strict=True):
        assert np.array_equal(frame.rgb, single[k].rgb)
        assert np.array_equal(frame.labels, single[k].labels)  # type: ignore[arg-type]
    with context.context():
        drawing.release()


def test_labels_and_depth_are_those_of_the_mesh() -> None:
    """Where both draw the mesh or people, up to 10 m away, 97 % of the labels and 95 % of the
    depths agree within 10 cm."""
    street = walkers(6)
    splats, mesh = (_picture(street_scan(noise_m=0.004), look, street) for look in APPEARANCES)
    assert splats.labels is not None and splats.depth is not None and mesh.depth is not None
    assert (splats.labels == mesh.labels).mean() >= 0.97
    near = mesh.depth < 10.0
    assert (np.abs(splats.depth - mesh.depth)[near] < 0.1).mean() >= 0.95
    person = splats.labels == LABELS["person"]
    assert (np.abs(splats.depth - mesh.depth)[person] < 0.01).mean() >= 0.99


@pytest.mark.parametrize("sun", [SUN, None], ids=["sun", "contact"])
def test_people_darken_the_splats_around_their_feet(sun: ScanSun | None) -> None:
    """A person has a shadow away from the sun, or below it without a known sun, and on all sides of
    its feet. People behind a wall darken no street in front of it."""
    scan = street_scan(sun=sun)
    full_street = walkers(2)
    empty, full, behind = (
        _picture(scan, "splats", street)
        for street in (walkers(0), full_street, line_of_people(WALL_X_M + 2.0))
    )
    ground = (full.labels == LABELS["sidewalk"]) & (empty.labels == LABELS["sidewalk"])
    darker = empty.rgb.astype(int).sum(axis=2) - full.rgb.astype(int).sum(axis=2)
    shadow = ground & (darker > 30)
    assert 26 < shadow.sum() < 1500
    assert np.abs(darker[ground & ~shadow]).max() <= 30
    middle_m = 3.0 + (1.0 if sun is None else 0.4)
    at_m = full.depth[shadow].mean()  # type: ignore[index]
    assert at_m == pytest.approx(middle_m, abs=1.2)
    near = np.s_[120:]
    assert np.array_equal(behind.rgb[near], empty.rgb[near])
    away_m = _ground_at(full)[None] - full_street.people.xy[:, None, None]
    at_feet = [ground & (np.hypot(*one.T).T < 0.25) for one in away_m]
    assert min(darker[one].mean() for one in at_feet) > 5.0


def test_exposure_brightens_only_people() -> None:
    """One stop more leaves the splats unchanged."""
    scan = street_scan(sun=SUN)
    brighter = dataclasses.replace(scan, facts=msgspec.structs.replace(scan.facts, exposure_ev=1.0))
    one, other = (_picture(s, "splats", walkers(2)) for s in (scan, brighter))
    assert one.labels is not None
    person, ground = (one.labels == LABELS[name] for name in ("person", "sidewalk"))
    assert other.rgb[person].mean() > 1.15 * one.rgb[person].mean()
    ground[:110] = False  # far ground lets some sky through
    assert np.abs(one.rgb[ground].astype(int) - other.rgb[ground]).mean() < 0.5


def test_the_appearance_is_part_of_the_renderer() -> None:
    """Records distinguish pictures of meshes from those of splats, and only the gl camera has
    both."""
    names = [renderer_of("gl", look) for look in APPEARANCES]
    assert names[0] == renderer_of("gl") != names[1]
    assert renderer_of("bullet", "mesh") == renderer_of("bullet")
    assert EpisodeOptions.from_config(RunConfig(appearance="mesh")).appearance == "mesh"
