"""`cosim bench realism`: people in pictures, and counts of boxes and classes."""

from __future__ import annotations

import json
from pathlib import Path

import msgspec
import numpy as np
import pytest

from cosim.core.geometry import Pose
from cosim.core.state import LABELS, Age, Frame, People, RobotState, Street
from cosim.people.gait import stature_m
from cosim.spec.robot import COURIER
from cosim.spec.scenario import City
from physics.cameras.gl.camera import GlCamera
from physics.cameras.view import robot_shot, shot
from physics.dynamics.world import BulletWorld
from physics.ground.tiles import tiles_within
from physics.people.appearance import companion_of
from scenarios.places.nets import surface_of_place
from scenarios.suites.catalog import load_suite
from scenarios.tools.bench.detectors import (
    DETECTORS,
    FASTEST_DET,
    REAL_HEIGHTS_PX,
    decode_fastest,
)
from scenarios.tools.bench.realism import (
    ALL,
    CAMERA,
    CITY,
    CITY_ROUTES,
    Picture,
    Realism,
    SeenPeople,
    Things,
    count_boxes,
    count_classes,
    heads_with_companions,
    seen_people,
)
from tests.conftest import Cosim
from tests.support.follow_weights import make_weights

BLANK = np.zeros((288, 512), dtype=np.uint8)


class SameName(Things):
    """Names whatever a box shows "thing"."""

    def __init__(self) -> None:
        pass

    def under(self, frame: Frame, box: object) -> str:
        return "thing"


def test_boxes_are_counted() -> None:
    """A box finds one person of each size at most. A box is false where there is no person, except
    on mostly hidden people and on pixels of people."""
    people = np.array([[10, 10, 40, 90], [100, 10, 115, 50], [200, 10, 230, 30], [300, 0, 340, 90]])
    seen = SeenPeople(people.astype(float), np.array([True, True, True, False]))
    labels = BLANK.copy()
    labels[200:280, 400:440] = LABELS["person"]
    boxes = np.array(
        [
            *([12, 12, 41, 88], [9, 8, 42, 95]),  # the first person, twice
            *([300, 0, 338, 92], [400, 200, 440, 280]),  # little is seen; pixels alone
            *([450, 100, 470, 160], [115, 50, 140, 90]),  # no person; a corner of the second
        ],
        dtype=float,
    )
    frame = Frame(np.zeros((288, 512, 3), dtype=np.uint8), labels)
    counts = Realism("here")
    found, false = count_boxes(
        counts, "YOLOX-nano", boxes, Picture(frame, seen, SameName(), (ALL, "fog"))
    )
    assert found.tolist() == [True, False, False, True]
    assert false.tolist() == [False, False, False, False, True, True]
    for condition in (ALL, "fog"):
        got = counts.detected["YOLOX-nano"][condition]
        assert got.people == {"taller than 60 px": [1, 1], "24 to 60 px": [0, 1]}
        assert (got.boxes, got.false) == (6, {"thing": 2})
    none = SeenPeople(np.zeros((0, 4)), np.zeros(0, dtype=bool))
    count_boxes(counts, "YOLOX-nano", boxes[4:5], Picture(frame, none, SameName(), (ALL,)))
    count_boxes(counts, "YOLOX-nano", np.zeros((0, 4)), Picture(frame, seen, SameName(), (ALL,)))
    got = counts.detected["YOLOX-nano"][ALL]
    assert (got.boxes, got.false) == (7, {"thing": 3})
    assert got.people["taller than 60 px"] == [1, 2]
    assert counts.detected["YOLOX-nano"]["night"].boxes == 0
    assert counts.detected["FastestDet"][ALL].boxes == 0


def test_boxes_of_fastest_det_are_decoded() -> None:
    """A certain person in neighbouring cells is one box; other classes and uncertain cells are
    none."""
    output = np.zeros((85, 22, 22), dtype=np.float32)
    output[:, 5, 10] = output[:, 5, 11] = output[:, 20, 3] = output[:, 1, 1] = 0.01
    output[[0, 5], 5, 10] = 0.9
    output[[0, 5], 5, 11] = 0.8  # the same person again
    output[[0, 7], 20, 3] = 0.9  # another class
    output[[0, 5], 1, 1] = 0.6  # unsure
    output[1:3, 5, 10] = output[1:3, 5, 11] = 0.0
    output[1, 5, 11] = np.arctanh(-0.9)
    output[3:5, 5, 10:12] = -2.0
    (box,) = decode_fastest(output, 440, 220)
    middle, size = 0.5 * (box[:2] + box[2:]), box[2:] - box[:2]
    assert middle == pytest.approx([200.0, 50.0]) and size == pytest.approx(
        np.array([440.0, 220.0]) / (1.0 + np.exp(2.0)), rel=1e-5
    )


def test_the_expected_number_of_detections_follows_the_heights() -> None:
    """Heights below the least class count 0, and each other one counts the recall of its class."""
    one = DETECTORS["YOLOX-nano"]
    heights = np.array([10.0, *REAL_HEIGHTS_PX, 300.0])
    assert one.expected(heights) == pytest.approx(sum(one.real_recall) + one.real_recall[-1])
    assert all(len(other.real_recall) == len(REAL_HEIGHTS_PX) for other in DETECTORS.values())


def test_routes_of_each_split_are_in_cities_of_that_split() -> None:
    """No route for tuning is in a held-out city."""
    by_id = {one.id: one for one in load_suite(CITY).scenarios}
    places = {}
    for split, ids in CITY_ROUTES.items():
        assert {by_id[name].split for name in ids} == {split}
        places[split] = {by_id[name].place for name in ids}
    assert not places["val"] & places["test"]


def test_classes_are_compared_by_pixels() -> None:
    """Where the network sees sky on three quarters of the picture and the labels on half, IoU is
    2/3; road and sidewalk are one class."""
    kinds = np.full((128, 256), 10)
    kinds[96:, :128], kinds[96:, 128:] = 0, 1
    labels = np.full((288, 512), LABELS["sky"], dtype=np.uint8)
    labels[144:216], labels[216:] = LABELS["building"], LABELS["sidewalk"]
    counts = Realism("here")
    count_classes(counts, kinds, labels)
    count_classes(counts, kinds, labels)
    assert counts.iou["sky"] == pytest.approx(2 / 3)
    assert counts.iou["walkable"] == 1.0 and counts.iou["building"] == 0.0
    assert counts.recall["sky"] == 1.0 and counts.recall["building"] == 0.0
    assert np.isnan(counts.iou["person"]) and np.isnan(counts.recall["person"])


@pytest.mark.engine
def test_people_are_found_in_the_labels() -> None:
    """Drawn people get boxes of their own height, also one in front of another, and a hidden person
    is not counted."""
    surface = surface_of_place(City(seed=7, size_m=300.0))
    strip = max(
        (one for one in surface.street_map.strips.values() if one.kind == "sidewalk"),
        key=lambda one: one.length_m,
    )
    (x0, y0), (x1, y1) = strip.line[0][:2], strip.line[-1][:2]
    heading = float(np.arctan2(y1 - y0, x1 - x0))
    ahead = np.array([np.cos(heading), np.sin(heading)])
    left = np.array([-ahead[1], ahead[0]])
    foot = np.array([x0, y0]) + 4.0 * ahead
    places = np.array([foot + 5 * ahead + 0.8 * left, foot + 9 * ahead, foot + 9.9 * ahead])
    people = People.of(("a", "b", "c"), places, [heading] * 3, [0.0] * 3, ("stand",) * 3)
    with BulletWorld(surface) as world, GlCamera(world, CAMERA, depth=True) as camera:
        robot: RobotState = world.place(Pose(*foot, heading))
        frame = camera.render(robot, Street(0, people))
        taken = robot_shot(surface, COURIER, CAMERA, robot)
    seen = seen_people(frame, people, taken)
    tall = 2.0 * np.tan(np.radians(CAMERA.fov_deg / 2))
    heights = seen.boxes[:, 3] - seen.boxes[:, 1]
    for k, far_m in ((0, 5.0), (1, 9.0)):
        assert seen.whole[k]
        assert heights[k] == pytest.approx(1.72 * 288 / (tall * far_m), rel=0.15)
    assert 256 - 512 * 0.3 < seen.boxes[0].reshape(2, 2)[:, 0].mean() < 240
    assert len(seen.whole) == 2 or not seen.whole[2]


@pytest.mark.engine
def test_boxes_of_people_exclude_umbrellas() -> None:
    """In rain, the box of a person with an umbrella ends near the head, as detectors' boxes do."""
    surface = surface_of_place(City(seed=7, size_m=300.0))
    strip = max(
        (one for one in surface.street_map.strips.values() if one.kind == "sidewalk"),
        key=lambda one: one.length_m,
    )
    (x0, y0), (x1, y1) = strip.line[0][:2], strip.line[-1][:2]
    heading = float(np.arctan2(y1 - y0, x1 - x0))
    at = np.array([x0, y0]) + 9.0 * np.array([np.cos(heading), np.sin(heading)])
    name = next(
        name
        for name in (f"a{k}" for k in range(50))
        if companion_of(name, surface.seed, True) == "umbrella"
    )
    scenario = load_suite(CITY).scenarios[0].in_weather("rain")
    people = People.of((name,), at[None], [heading], [0.0], ("stand",))
    heads_m = heads_with_companions(people, surface, scenario)
    with (
        BulletWorld(surface) as world,
        GlCamera(world, CAMERA, depth=True, weather=scenario.conditions) as camera,
    ):
        robot: RobotState = world.place(Pose(x0, y0, heading))
        frame = camera.render(robot, Street(0, people))
        taken = robot_shot(surface, COURIER, CAMERA, robot)
    with_umbrella = seen_people(frame, people, taken).boxes[0]
    (box,) = seen_people(frame, people, taken, heads_m).boxes
    metre = (box[3] - box[1]) / stature_m(name, Age.ADULT)
    assert heads_m[0] == pytest.approx(surface.heights(at[None])[0] + stature_m(name, Age.ADULT))
    assert box[3] == with_umbrella[3] and with_umbrella[1] < box[1] - 0.15 * metre
    assert box[2] - box[0] < with_umbrella[2] - with_umbrella[0]


@pytest.mark.engine
def test_what_a_false_box_shows_is_named() -> None:
    """Boxes on a tree's crown, on its trunk and on the sky have different names."""
    surface = surface_of_place(City(seed=7, size_m=300.0))
    tree, foot_m = next(
        (prop, z)
        for key in tiles_within(150.0, 150.0, 150.0)
        for prop, z in surface.chunk(key).props
        if prop.kind == "tree" and np.hypot(prop.x_m - 150.0, prop.y_m - 150.0) < 120.0
    )
    eye = np.array([tree.x_m - 8.0, tree.y_m, foot_m + 1.5])
    taken = shot(eye, eye + np.array([1.0, 0.0, 0.25]), (512, 288), 60.0)
    with BulletWorld(surface) as world, GlCamera(world, CAMERA, depth=True) as camera:
        frame = camera.picture(eye, taken.target_m, Street(0), size=taken.size, fov_deg=60.0)
    scenario = load_suite(CITY).scenarios[0]
    things = Things(surface, msgspec.structs.replace(scenario, obstacles=()), taken)

    def at(height_m: float) -> np.ndarray:
        right, above, ahead = taken.axes
        ray = np.array([tree.x_m, tree.y_m, foot_m + height_m]) - eye
        wide, tall = taken.half_picture
        u = 256.0 * (1.0 + ray @ right / (ray @ ahead) / wide)
        v = 144.0 * (1.0 - ray @ above / (ray @ ahead) / tall)
        return np.array([u - 3.0, v - 3.0, u + 3.0, v + 3.0])

    assert things.under(frame, at(1.0)) == "tree"
    assert things.under(frame, at(4.0)) == "crown"
    assert things.under(frame, np.array([0.0, 0.0, 12.0, 6.0])) in ("sky", "building")


@pytest.mark.engine
def test_the_command_counts_and_writes_pictures(cosim: Cosim, tmp_path: Path) -> None:
    """A frame of a city gives a table, a picture of each detector and weather, and JSON."""
    weights = make_weights(tmp_path, FASTEST_DET)
    out = tmp_path / "out"
    before = tmp_path / "before.json"
    common = ("bench", "realism", "--frames", "1", "--weights", str(weights))
    done = cosim(*common, "--out", str(out), "--weather", "clear", "--weather", "night")
    assert done.returncode == 0, done.stderr
    found, dark = json.loads((out / "realism.json").read_text())
    assert (found["weather"], dark["weather"]) == ("clear", "night")
    assert "long-horizon, val, night" in " ".join(done.stdout.split())
    assert found["frames"] == {"all": 1} and 0.3 < found["iou"]["walkable"] <= 1.0
    assert set(found["detected"]) == {"YOLOX-nano", "FastestDet"} and found["split"] == "val"
    assert len(list(out.glob("*.png"))) == 4
    assert f"{found['iou']['sky']:.2f}" in done.stdout
    before.write_text("[{}]")
    refused = cosim(*common, "--compare", str(before))
    assert refused.returncode == 2 and "is no realism.json" in refused.stderr
    refused = cosim(*common, "--split", "held-out")
    assert refused.returncode == 2 and "Valid choices: test, val" in refused.stderr
    refused = cosim(*common, "--weather", "hail")
    assert refused.returncode == 2 and "Valid choices: clear, dusk" in refused.stderr
    refused = cosim("bench", "realism", "--weights", str(tmp_path / "none"))
    assert refused.returncode == 2 and "no folder" in refused.stderr
