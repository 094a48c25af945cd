"""`cosim bench realism`: people in pictures, and how boxes and classes are counted."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from cosim.core.geometry import Pose
from cosim.core.state import LABELS, People, RobotState, Street
from cosim.spec.robot import COURIER
from cosim.spec.scenario import City
from physics.cameras.gl.camera import GlCamera
from physics.cameras.view import robot_shot
from physics.dynamics.world import BulletWorld
from scenarios.places.nets import surface_of_place
from scenarios.tools.bench.realism import (
    CAMERA,
    Realism,
    SeenPeople,
    count_boxes,
    count_classes,
    seen_people,
)
from tests.conftest import Cosim
from tests.support.follow_weights import make_weights

BLANK = np.zeros((288, 512), dtype=np.uint8)


def test_boxes_are_counted() -> None:
    """A box finds one person of each size at most. A box is false where no person is, not on people
    of whom little is seen, nor on pixels of people."""
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
    counts = Realism("here")
    found, false = count_boxes(counts, boxes, seen, labels)
    assert found.tolist() == [True, False, False, True]
    assert false.tolist() == [False, False, False, False, True, True]
    assert counts.people == {"taller than 60 px": [1, 1], "24 to 60 px": [0, 1]}
    assert (counts.detections, counts.false) == (6, 2)
    none = SeenPeople(np.zeros((0, 4)), np.zeros(0, dtype=bool))
    count_boxes(counts, boxes[4:5], none, labels)
    count_boxes(counts, np.zeros((0, 4)), seen, labels)
    assert (counts.detections, counts.false) == (7, 3)
    assert counts.people["taller than 60 px"] == [1, 2]


def test_classes_are_compared_by_pixels() -> None:
    """Half of the picture is sky to both, a quarter to the network alone: IoU 2/3; road and
    sidewalk are one class."""
    kinds = np.full((128, 256), 10)
    kinds[96:, :128], kinds[96:, 128:] = 0, 1
    labels = np.full((288, 512), LABELS["sky"], dtype=np.uint8)
    labels[144:216], labels[216:] = LABELS["building"], LABELS["sidewalk"]
    counts = Realism("here")
    count_classes(counts, kinds, labels)
    count_classes(counts, kinds, labels)
    assert counts.iou["sky"] == pytest.approx(2 / 3)
    assert counts.iou["walkable"] == 1.0 and counts.iou["building"] == 0.0
    assert np.isnan(counts.iou["person"])


@pytest.mark.engine
def test_people_are_found_in_the_labels() -> None:
    """Drawn people get boxes of their own height, also one before the other; one who is hidden
    behind another is not counted."""
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
def test_the_command_counts_and_writes_pictures(cosim: Cosim, tmp_path: Path) -> None:
    """A frame of a city gives a table, a picture and the same numbers as JSON."""
    weights = make_weights(tmp_path)
    out = tmp_path / "out"
    done = cosim(
        *("bench", "realism", "--frames", "1", "--weights", str(weights), "--out", str(out))
    )
    assert done.returncode == 0, done.stderr
    (found,) = json.loads((out / "realism.json").read_text())
    assert found["frames"] == 1 and 0.3 < found["iou"]["walkable"] <= 1.0
    assert len(list(out.glob("*.png"))) == 1
    assert f"{found['iou']['sky']:.2f}" in done.stdout
    refused = cosim("bench", "realism", "--weights", str(tmp_path / "none"))
    assert refused.returncode == 2 and "no folder" in refused.stderr
