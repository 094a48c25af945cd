"""Looks of streets: crowns of twigs with gaps, decals, and transparent glass."""

from __future__ import annotations

import math

import numpy as np
import pytest
import shapely

from cosim.core.state import LABELS, Frame, Street
from cosim.spec.camera import CameraSpec
from cosim.spec.scenario import City
from physics.cameras.gl import context
from physics.cameras.gl.camera import GlCamera
from physics.cameras.gl.street import StreetDrawing
from physics.dynamics.world import BulletWorld
from physics.ground.tiles import tiles_touching
from physics.street.furniture import KINDS, PROP_VARIANTS, Prop, parts_of
from physics.street.street_surface import StreetSurface
from physics.textures.decals import decal_layers
from physics.textures.walls import CUT_OUT, prop_layers
from scenarios.places.nets import place

needs_gl = pytest.mark.skipif(
    not context.available(), reason="no OpenGL through EGL here (see `cosim doctor`)"
)
SPEC = CameraSpec(width=256, height=192)


@pytest.fixture(scope="module")
def world() -> BulletWorld:
    _, street_map = place(City(seed=1, size_m=500.0))
    return BulletWorld(StreetSurface(street_map, 1))


def first_prop(world: BulletWorld, kind: str) -> Prop:
    surface = world.surface
    assert isinstance(surface, StreetSurface)
    area = shapely.box(*surface.street_map.bounds)
    props = surface.standing(area)
    return next(prop for prop in props if prop.kind == kind)


def view_of(camera: GlCamera, prop: Prop, away_m: float, up_m: float) -> Frame:
    """Return a picture of a prop from its front."""
    turn = prop.heading_rad - 0.5 * math.pi
    eye = (prop.x_m + away_m * math.cos(turn), prop.y_m + away_m * math.sin(turn), 1.2)
    return camera.picture(eye, (prop.x_m, prop.y_m, up_m), Street(0), None, (256, 192))


def test_twigs_stay_above_heads_and_within_the_crown() -> None:
    """At every distance a tree has twigs with gaps, between the clear height and its top."""
    for variant in range(PROP_VARIANTS):
        for look in range(len(KINDS["tree"].paints)):
            crown = parts_of("tree", variant, look)[1].mesh.vertices[:, 2]
            counts = []
            for detail in ("near", "far"):
                twigs = parts_of("tree", variant, look, detail)[-1]  # type: ignore[arg-type]
                assert twigs.cover in CUT_OUT and twigs.spots is not None
                assert crown.min() - 1e-9 <= twigs.mesh.vertices[:, 2].min()
                assert twigs.mesh.vertices[:, 2].max() <= crown.max() + 1e-9
                assert twigs.spots.min() >= 0.0 and twigs.spots.max() <= 1.0
                counts.append(len(twigs.mesh))
            assert crown.min() > 2.1 and counts[0] > counts[1]
    layers = prop_layers(256)
    shares = [(layers.rgba[layers.index(name), ..., 3] > 115).mean() for name in CUT_OUT]
    assert min(shares) > 0.25 and max(shares) < 0.75


def test_decals_lie_on_roads_and_sidewalks(world: BulletWorld) -> None:
    """Decals lie 4 mm above the ground, with their middle on a street."""
    surface = world.surface
    assert isinstance(surface, StreetSurface)
    middle = shapely.Point(first_prop(world, "tree").x_m, first_prop(world, "tree").y_m)
    found = set()
    for key in tiles_touching(middle.buffer(40.0)):
        for decal in surface.finish(key).decals:
            at = decal.mesh.vertices
            assert np.allclose(at[:, 2] - surface.heights(at[:, :2]), 0.004, atol=0.002)
            assert decal.opacity.min() >= 0.0 and decal.opacity.max() <= 1.0
            found.add(decal.layer)
    assert len(found) >= 6 and found <= set(decal_layers(256).names)


@needs_gl
@pytest.mark.engine
@pytest.mark.parametrize("drawing", ["draw_decals", "draw_panes"])
def test_decals_and_glass_are_blended(
    drawing: str, world: BulletWorld, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Decals change neither labels nor depth; glass has its own, and shows what is behind it."""
    prop = first_prop(world, "shelter" if drawing == "draw_panes" else "tree")
    with GlCamera(world, SPEC, depth=True) as camera:
        drawn = view_of(camera, prop, 5.0, 1.0)
        monkeypatch.setattr(StreetDrawing, drawing, lambda *_, **__: None)
        bare = view_of(camera, prop, 5.0, 1.0)
    assert drawn.labels is not None and bare.labels is not None
    assert drawn.depth is not None and bare.depth is not None
    changed = (drawn.rgb != bare.rgb).any(axis=2)
    assert changed.mean() > 0.001
    if drawing == "draw_decals":
        assert np.array_equal(drawn.labels, bare.labels)
        assert np.array_equal(drawn.depth, bare.depth)
        return
    pane = drawn.depth < bare.depth - 0.01
    assert pane.mean() > 0.05 and (drawn.labels[pane] == LABELS["prop"]).all()
    assert np.corrcoef(drawn.rgb[pane].ravel(), bare.rgb[pane].ravel())[0, 1] > 0.7


@needs_gl
@pytest.mark.engine
def test_a_crown_has_gaps_that_show_what_is_behind(world: BulletWorld) -> None:
    """The box around a crown's pixels also has pixels that are farther than the tree."""
    tree = first_prop(world, "tree")
    away_m = 7.0
    with GlCamera(world, SPEC, depth=True) as camera:
        seen = view_of(camera, tree, away_m, 0.7 * tree.size_m[2])
    assert seen.labels is not None and seen.depth is not None
    near = (seen.labels == LABELS["prop"]) & (seen.depth < away_m + 3.0)
    rows, columns = np.nonzero(near[:96])
    box = near[rows.min() : rows.max() + 1, columns.min() : columns.max() + 1]
    edges = (box[:, 1:] != box[:, :-1]).sum(axis=1)
    assert 0.2 < box.mean() < 0.95 and edges.max() >= 6
