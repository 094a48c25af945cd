"""Labels against looks: except in generated cities, open ground does not look like a sidewalk, nor
a sidewalk like a road."""

from __future__ import annotations

import dataclasses
from collections import Counter

import cv2
import numpy as np
import pytest
import shapely

from cosim.core.cache import Arrays
from cosim.core.geometry import Pose
from cosim.core.state import LABELS, RobotState, Street
from cosim.place.open_ground import GROUND_LOOKS, PLAIN_GROUND, open_ground
from cosim.place.street_map import LAND_KINDS, Feature, StreetMap
from cosim.report.above import Sheet, draw_streets
from cosim.spec.camera import CameraSpec
from physics.cameras.bullet_camera import BulletCamera
from physics.cameras.gl import context
from physics.cameras.gl.camera import GlCamera
from physics.dynamics.world import BulletWorld
from physics.ground.materials import APPEARANCE_OVERRIDES, PAVINGS
from physics.ground.tiles import SURFACES, Key, surface_look
from physics.street.street_surface import StreetSurface
from physics.street.surface import Chunk, Patch, TexturedDetails
from physics.textures.ground import SURFACE_LAYERS, layer_of
from tests.support.tiny_street import KEYS, tiny_map

MIN_DISTANCE = 15.0
"""Minimum distance of two mean colours in CIELAB; 2.3 is just noticeable side by side."""
HOUSE = shapely.box(-60.0, 8.0, -4.0, 16.0)
LOT = shapely.box(5.0, 9.0, 40.0, 30.0)
PARK = shapely.box(-200.0, -100.0, 200.0, -8.0)


def shown_map() -> StreetMap:
    """Return the tiny street with a house at the north-western sidewalk, a parking lot in the
    north-east, and a wood with a pond in the south."""
    features = (
        Feature("building", -32.0, 12.0, 0.0, 6.0, HOUSE),
        Feature("planting", 0.0, -50.0, polygon=PARK),
        Feature("yard", 20.0, 20.0, polygon=LOT),
        Feature("water", 20.0, -20.0, polygon=shapely.box(10.0, -30.0, 30.0, -12.0)),
    )
    return dataclasses.replace(tiny_map(), features=features)


MAP = shown_map()


def lab(rgb: np.ndarray | tuple[float, float, float]) -> np.ndarray:
    """Return (N, 3) CIELAB of (N, 3) sRGB from 0 to 1."""
    flat = np.asarray(rgb, dtype=np.float32).reshape(-1, 1, 3)
    return np.asarray(cv2.cvtColor(flat, cv2.COLOR_RGB2LAB)).reshape(-1, 3)


def is_sidewalk_layer(layer: str) -> bool:
    """Return whether sidewalks have this layer of ground."""
    return layer in {one for name in sidewalk_surfaces() for one in layers_of(name)}


def sidewalk_surfaces() -> list[str]:
    """Return the names of all surfaces that sidewalks have."""
    return [name for name in (*SURFACES, *PAVINGS) if surface_look(name)[0] == "sidewalk"]


def layers_of(name: str) -> set[str]:
    """Return every layer that a surface may show on a map that is no generated city."""
    shown = APPEARANCE_OVERRIDES.get(name, (name,))[0]
    return {layer_of(shown, seed) for seed in range(60)}


def test_sidewalks_roads_and_open_ground_share_no_material_and_no_colour() -> None:
    """No layer of a sidewalk is one of a road, verge or open ground, and its colour is far from
    theirs. Each look of open ground is in the tables of cameras and of maps."""
    others = [
        "road",
        "crossing",
        "verge",
        "ground",
        *(name for name in PAVINGS if name.startswith("verge:")),
    ]
    others += [f"ground:{kind}" for kind in LAND_KINDS if kind != PLAIN_GROUND]
    layers = {name: layers_of(name) for name in (*sidewalk_surfaces(), *others)}
    colours = {name: surface_look(name)[1] for name in (*sidewalk_surfaces(), *others)}
    colours |= {name: colour for name, (_, colour) in APPEARANCE_OVERRIDES.items()}
    colours |= {
        f"ground:{kind}": GROUND_LOOKS[kind].seen for kind in LAND_KINDS if kind != PLAIN_GROUND
    }
    assert set(GROUND_LOOKS) == set(LAND_KINDS)
    assert all(kind in SURFACE_LAYERS for kind in LAND_KINDS if kind != PLAIN_GROUND)
    for one in sidewalk_surfaces():
        for other in others:
            assert not layers[one] & layers[other], (one, other)
            assert np.linalg.norm(lab(colours[one]) - lab(colours[other])) >= MIN_DISTANCE, (
                one,
                other,
            )
    drawn = [look.drawn for look in GROUND_LOOKS.values()]
    assert len(set(drawn)) == len(drawn)


def test_open_ground_follows_land_use_then_neighbours() -> None:
    """A parking lot is a yard, a pond in a wood is water, a bed lies between a sidewalk and its
    house, and the rest is lawn. Generated cities have none."""
    found = dict(open_ground(MAP, shapely.box(-70.0, -40.0, 70.0, 40.0)))
    assert found["yard"].contains(shapely.Point(20.0, 20.0))
    pond, wood, bed, lawn = (
        shapely.Point(*at) for at in ((20, -20), (-20, -20), (-30, 7.2), (50, 12))
    )
    assert found["water"].contains(pond) and not found["planting"].contains(pond)
    assert found["planting"].contains(wood) and found["soil"].contains(bed)
    assert not any(area.contains(lawn) for area in found.values())
    areas = list(found.values())
    assert sum(area.area for area in areas) == pytest.approx(shapely.union_all(areas).area)
    assert (
        open_ground(dataclasses.replace(MAP, planned=True), shapely.box(-70.0, -40.0, 70.0, 40.0))
        == []
    )


def test_maps_from_above_show_the_same_ground_as_cameras() -> None:
    """Where a camera sees a yard, water or a bed, a picture from above has the colour of that
    look."""
    bounds = (-70.0, -40.0, 70.0, 40.0)
    sheet = Sheet(bounds)
    draw_streets(sheet, MAP, shapely.box(*bounds))
    street = StreetSurface(MAP, 1)
    checked = Counter[str]()
    for key in KEYS:
        for patch in street.covers(key):
            corners = patch.mesh.vertices[patch.mesh.triangles]
            kind = patch.name.partition(":")[2]
            for triangle in shapely.polygons(corners[:, :, :2]):
                middle = shapely.buffer(triangle, -0.4)  # off the edge, whose colour is mixed
                if shapely.is_empty(middle) or not shapely.box(*bounds).contains(middle):
                    continue
                for x, y in shapely.get_coordinates(shapely.point_on_surface(middle)).tolist():
                    column, row = (sheet.px(np.array([[x, y]]))[0] // 16).tolist()
                    assert tuple(sheet.image[row, column]) == GROUND_LOOKS[kind].drawn, (kind, x, y)  # type: ignore[index]
                    checked[kind] += 1
    assert {"yard", "water", "planting"} <= set(checked)


class LabelledByLook(StreetSurface):
    """A street whose labels are its looks: "sidewalk" for layers of sidewalks, else "road"."""

    def kept(self, kind: str, key: Key, make: object) -> Arrays:
        return make() if kind == "gl" else super().kept(kind, key, make)  # type: ignore[operator,no-any-return,arg-type]

    def chunk(self, key: Key) -> Chunk:
        chunk = super().chunk(key)
        return dataclasses.replace(chunk, ground=tuple(map(relabelled, chunk.ground)))

    def covers(self, key: Key) -> tuple[Patch, ...]:
        return tuple(map(relabelled, super().covers(key)))

    def finish(self, key: Key) -> TexturedDetails:
        details = super().finish(key)
        return dataclasses.replace(details, laid=tuple(map(relabelled, details.laid)))


def relabelled(patch: Patch) -> Patch:
    return patch._replace(label="sidewalk" if is_sidewalk_layer(patch.layer) else "road")


CAMERAS = [
    pytest.param(
        GlCamera,
        id="gl",
        marks=pytest.mark.skipif(
            not context.available(), reason="no OpenGL through EGL here (see `cosim doctor`)"
        ),
    ),
    pytest.param(BulletCamera, id="bullet"),
]


@pytest.mark.engine
@pytest.mark.parametrize("make", CAMERAS)
def test_walkable_ground_looks_different_from_all_other_ground(
    make: type[GlCamera | BulletCamera],
) -> None:
    """In pictures from an asphalt sidewalk only pixels of sidewalk have its look, and mean colours
    are far apart."""
    spec = CameraSpec(96, 72)
    labels, looks = BulletWorld(StreetSurface(MAP, 4)), BulletWorld(LabelledByLook(MAP, 4))
    poses = [
        Pose(x, y, turn)
        for x, y in ((-40.0, 5.0), (8.0, 5.0), (40.0, -6.5))
        for turn in (-0.7, 0.7)
    ]
    seen = Counter[str]()
    with make(labels, spec) as one, make(looks, spec) as other:
        for pose in poses:
            robot = RobotState(pose, z_m=0.12)
            frame, looked = one.render(robot, Street(0)), other.render(robot, Street(0))
            assert frame.labels is not None and looked.labels is not None
            is_sidewalk = looked.labels == LABELS["sidewalk"]
            near = np.arange(72)[:, None] > 44  # farther off mean colours are those of haze
            means = {}
            for name in ("sidewalk", "ground", "road"):
                here = (frame.labels == LABELS[name]) & (np.arange(72)[:, None] > 38)
                assert (is_sidewalk[here] == (name == "sidewalk")).all(), (name, pose)
                seen[name] += int(here.sum())
                if (here & near).sum() > 60:
                    means[name] = lab(frame.rgb[here & near] / 255.0).mean(axis=0)
            for name in means.keys() - {"sidewalk"}:
                assert np.linalg.norm(means["sidewalk"] - means[name]) >= MIN_DISTANCE, (
                    name,
                    pose,
                )
    assert min(seen.values()) > 500
