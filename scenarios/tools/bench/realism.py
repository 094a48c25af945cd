"""Measures what networks trained on real streets see in pictures: `cosim bench realism`.

Frames are taken while the oracle drives routes with a crowd. YOLOX-nano's people and ESPNetv2's
classes are compared with the labels of the same pictures.
"""

from __future__ import annotations

import itertools
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final, NamedTuple

import cv2
import msgspec
import numpy as np
from numpy.typing import NDArray

from cosim.core.errors import MapError, SpecError
from cosim.core.geometry import Floats
from cosim.core.progress import Progress
from cosim.core.state import LABELS, Frame, People
from cosim.policies.follow.networks import ESPNET_GRAPH, YOLOX_NANO
from cosim.policies.follow.policy import detect_people
from cosim.policies.load import load_policy
from cosim.policies.onnx.graph import Graph
from cosim.policies.onnx.inputs import PictureInput
from cosim.policies.onnx.pictures import picture_tensor
from cosim.policies.onnx.weights import NetworkFile, weights_file
from cosim.spec.camera import CameraSpec
from cosim.spec.options import EpisodeOptions
from cosim.spec.robot import robot_called
from cosim.spec.run_config import Appearance
from cosim.spec.scenario import CrowdSpec, Scenario
from physics.cameras.view import Shot, robot_shot
from scenarios.episodes.episode import Episode
from scenarios.places.nets import surface_of_place
from scenarios.suites.catalog import load_suite
from scenarios.suites.sample import suite_on_map

CITY: Final = "long-horizon"
"""Suite whose routes are driven without a place: generated cities."""
CAMERA: Final = CameraSpec(512, 288, 60.0, depth=True)
EACH_S: Final = 2.0
"""Seconds between frames."""
ROUTES: Final = 5
"""Least number of routes over which frames are spread."""
SIZES_PX: Final = {"taller than 60 px": (60.0, np.inf), "24 to 60 px": (24.0, 60.0)}
"""Classes of people by the height of what is seen of them, in pixels."""
CLASSES: Final = {
    "person": ((11,), ("person",)),
    "sky": ((10,), ("sky",)),
    "building": ((2,), ("building",)),
    "walkable": ((0, 1), ("road", "sidewalk", "crosswalk", "curb", "ground")),
}
"""Classes of Cityscapes, and labels that mean the same. Networks trained from cars call sidewalks
under the robot road, so both are one class."""
_DRIVER: Final = "orca"
_PERSONS: Final = 50
_SAME: Final = 0.5
"""Overlap (IoU) from which a box shows a person."""
_OTHER: Final = 0.3
"""Overlap with all people, and share of pixels of people, below which a box is false."""
_SEEN: Final = 0.7
"""Share of a person's height that must be seen; people of whom less is seen do not count."""
_ADULT_M: Final = 1.7
_APART_M: Final = 0.9
"""Largest distance on the ground between a person and pixels of it, in metres."""
_PICTURES: Final = 12
"""Number of pictures that are written."""
_STREET_INPUT: Final = PictureInput(
    size=(512, 256), mean=(0.485, 0.456, 0.406), std=(0.229, 0.224, 0.225)
)


class SeenPeople(NamedTuple):
    """People in a picture.

    boxes: (N, 4) left, top, right and bottom of their pixels.
    whole: (N,) whether enough of their height is seen.
    """

    boxes: Floats
    whole: NDArray[np.bool_]


@dataclass
class Realism:
    """Counts over the frames of a place.

    people: found and all people by class of size.
    detections, false: boxes, and those without a person.
    common, joined: pixels that network and labels call the same class, and that either calls so.
    """

    place: str
    frames: int = 0
    people: dict[str, list[int]] = field(
        default_factory=lambda: {name: [0, 0] for name in SIZES_PX}
    )
    detections: int = 0
    false: int = 0
    common: Counter[str] = field(default_factory=Counter)
    joined: Counter[str] = field(default_factory=Counter)

    @property
    def iou(self) -> dict[str, float]:
        """Intersection over union of each class, over all frames; NaN if it never occurs."""
        return {
            name: self.common[name] / self.joined[name] if self.joined[name] else float("nan")
            for name in CLASSES
        }


def measure_realism(
    places: Sequence[str],
    frames: int,
    appearance: Appearance,
    weights: Path | None,
    out: Path | None,
    progress: Progress,
) -> list[Realism]:
    """Return the counts of each place; "" is generated cities.

    frames: number of frames of each place, fewer if its routes are too short.
    weights: folder of both networks, by default as for the policy `follow`.
    out: folder for pictures with boxes, and for all counts as realism.json.
    """
    street, people = (_graph(one, weights) for one in (ESPNET_GRAPH, YOLOX_NANO))
    found = []
    for place in places:
        name = place or CITY
        counts = Realism(name)
        each = max(1, frames // _PICTURES)
        for picture, seen in _frames(place, frames, appearance, progress):
            boxes = detect_people(picture.rgb, people)
            judged = count_boxes(counts, boxes, seen, picture.labels)
            count_classes(counts, street_kinds(picture.rgb, street), picture.labels)
            if out is not None and counts.frames % each == 0:
                _write(out, f"{name}-{counts.frames:03}.png", picture.rgb, boxes, seen, judged)
            counts.frames += 1
            progress(f"{name}: {counts.frames} frames", counts.frames / frames)
        found.append(counts)
    if out is not None:
        (out / "realism.json").write_bytes(
            msgspec.json.format(msgspec.json.encode([as_json(one) for one in found]), indent=1)
        )
    return found


def as_json(one: Realism) -> dict[str, Any]:
    """Return the counts of a place as values of JSON."""
    return {
        "place": one.place,
        "frames": one.frames,
        "people": {name: {"found": a, "of": b} for name, (a, b) in one.people.items()},
        "detections": one.detections,
        "false": one.false,
        "iou": one.iou,
    }


def count_boxes(
    counts: Realism, boxes: Floats, seen: SeenPeople, labels: NDArray[np.uint8] | None
) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Count detected boxes (M, 4). Returns who is found (N,), and which boxes are false (M,)."""
    assert labels is not None
    overlap = _overlaps(seen.boxes, boxes)
    found = np.zeros(len(seen.boxes), dtype=bool)
    free = np.ones(len(boxes), dtype=bool)
    for at in np.argsort(-overlap, axis=None, kind="stable"):
        who, box = divmod(int(at), len(boxes))
        if overlap[who, box] < _SAME:
            break
        if free[box] and not found[who]:
            found[who], free[box] = True, False
    heights = seen.boxes[:, 3] - seen.boxes[:, 1]
    for name, (least, most) in SIZES_PX.items():
        rows = seen.whole & (heights >= least) & (heights < most)
        counts.people[name][0] += int((rows & found).sum())
        counts.people[name][1] += int(rows.sum())
    nearest = overlap.max(axis=0, initial=0.0)
    false = np.array(
        [
            bool(nearest[k] < _OTHER and _share(labels == LABELS["person"], box) < _OTHER)
            for k, box in enumerate(boxes)
        ],
        dtype=bool,
    )
    counts.detections += len(boxes)
    counts.false += int(false.sum())
    return found, false


def count_classes(
    counts: Realism, kinds: NDArray[np.integer[Any]], labels: NDArray[np.uint8] | None
) -> None:
    """Count pixels. kinds: (128, 256) classes of Cityscapes; labels: (H, W) of the picture."""
    assert labels is not None
    rows, columns = (
        ((np.arange(n) + 0.5) * side / n).astype(int)
        for n, side in zip(kinds.shape, labels.shape, strict=True)
    )
    there = labels[rows][:, columns]
    for name, (theirs, ours) in CLASSES.items():
        network = np.isin(kinds, theirs)
        exact = np.isin(there, [LABELS[label] for label in ours])
        counts.common[name] += int((network & exact).sum())
        counts.joined[name] += int((network | exact).sum())


def street_kinds(rgb: NDArray[np.uint8], network: Graph) -> NDArray[np.intp]:
    """Return (128, 256) classes of Cityscapes in a picture (H, W, 3)."""
    tensor = picture_tensor(rgb, _STREET_INPUT).transpose(2, 0, 1)[None]
    scores = network.ask({"picture": np.ascontiguousarray(tensor, np.float32)}, ["scores"])
    return np.asarray(scores["scores"][0].argmax(axis=0))


def seen_people(frame: Frame, people: People, taken: Shot) -> SeenPeople:
    """Return the people in a picture, by their pixels' places on the ground."""
    assert frame.labels is not None and frame.depth is not None
    height, width = frame.labels.shape
    v, u = np.nonzero(frame.labels == LABELS["person"])
    if not len(v) or not len(people.xy):
        return SeenPeople(np.zeros((0, 4)), np.zeros(0, dtype=bool))
    wide, tall = taken.half_picture
    depth = frame.depth[v, u].astype(float)
    aside = (2.0 * (u + 0.5) / width - 1.0) * wide * depth
    up = (1.0 - 2.0 * (v + 0.5) / height) * tall * depth
    right, above, ahead = taken.axes
    at = taken.eye_m + aside[:, None] * right + up[:, None] * above + depth[:, None] * ahead
    away = np.hypot(*(at[:, None, :2] - people.xy[None]).transpose(2, 0, 1))
    owner = away.argmin(axis=1)
    near = away.min(axis=1) < _APART_M
    boxes = []
    whole = []
    for k in np.unique(owner[near]):
        mine = near & (owner == k)
        left, top, right_px, bottom = u[mine].min(), v[mine].min(), u[mine].max(), v[mine].max()
        boxes.append((left, top, right_px + 1.0, bottom + 1.0))
        expected = _ADULT_M / (2.0 * tall * float(np.median(depth[mine]))) * height
        whole.append(bottom + 1.0 - top >= _SEEN * expected)
    return SeenPeople(np.array(boxes, dtype=float).reshape(-1, 4), np.array(whole, dtype=bool))


def _graph(network: NetworkFile, weights: Path | None) -> Graph:
    """Return a network's graph. Raises UsageError if its file is missing or differs."""
    beside = () if weights is None else (weights,)
    path = weights_file("follow", network.name, network.facts, network.source, beside)
    network.check(path, path.read_bytes())
    return Graph(path)


def _frames(
    place: str, frames: int, appearance: Appearance, progress: Progress
) -> Iterator[tuple[Frame, SeenPeople]]:
    """Yield pictures while routes of a place are driven, the same number on each."""
    left = frames
    each = -(-frames // ROUTES)
    for scenario in _scenarios(place):
        for one in itertools.islice(_driven(scenario, appearance, progress), min(each, left)):
            left -= 1
            yield one
        if left <= 0:
            return


def _scenarios(place: str) -> Iterator[Scenario]:
    """Yield routes with a crowd: of a suite, or drawn on a place; short ones where it is small."""
    if not place:
        yield from load_suite(CITY).scenarios[::4]
        return
    for seed in range(4 * ROUTES):
        try:
            yield from suite_on_map("long-horizon", place, seed, 1).scenarios
        except (SpecError, MapError):
            for one in suite_on_map("unit", place, seed, 1).scenarios:
                yield msgspec.structs.replace(
                    one, crowd=CrowdSpec(persons=_PERSONS), ends_on_failure=False
                )


def _driven(
    scenario: Scenario, appearance: Appearance, progress: Progress
) -> Iterator[tuple[Frame, SeenPeople]]:
    driver = load_policy(_DRIVER)
    surface = surface_of_place(scenario.place)
    robot_model = robot_called(scenario.robot)
    options = EpisodeOptions(appearance=appearance)
    progress(f"starting {scenario.id}")
    with (
        Episode(scenario, driver.manifest, options) as episode,
        episode.eyes(CAMERA) as camera,
    ):
        driver.reset(episode.id, episode.seed)
        observation = episode.reset()
        next_s = 0.0
        while not episode.over:
            if episode.time_s >= next_s:
                next_s = episode.time_s + EACH_S
                robot, street = episode.moment.robot, episode.moment.street
                frame = camera.render(robot, street)
                taken = robot_shot(surface, robot_model, CAMERA, robot)
                yield frame, seen_people(frame, street.people, taken)
            observation = episode.advance(driver.act(observation))


def _overlaps(one: Floats, other: Floats) -> Floats:
    """Return (N, M) intersections over unions of boxes (N, 4) and (M, 4)."""
    low = np.maximum(one[:, None, :2], other[None, :, :2])
    high = np.minimum(one[:, None, 2:], other[None, :, 2:])
    common = np.prod(np.maximum(high - low, 0.0), axis=2)
    areas = [np.prod(boxes[:, 2:] - boxes[:, :2], axis=1) for boxes in (one, other)]
    return np.asarray(common / np.maximum(areas[0][:, None] + areas[1][None] - common, 1e-9))


def _share(mask: NDArray[np.bool_], box: Floats) -> float:
    """Return the share of a box's pixels that are set."""
    left, top, right, bottom = np.rint(np.maximum(box, 0.0)).astype(int)
    part = mask[top:bottom, left:right]
    return float(part.mean()) if part.size else 0.0


def _write(
    out: Path,
    name: str,
    rgb: NDArray[np.uint8],
    boxes: Floats,
    seen: SeenPeople,
    judged: tuple[NDArray[np.bool_], NDArray[np.bool_]],
) -> None:
    """Write a picture: people found are green, missed blue, not counted grey, false boxes red."""
    found, false = judged
    least = min(low for low, _ in SIZES_PX.values())
    counted = seen.whole & (seen.boxes[:, 3] - seen.boxes[:, 1] >= least)
    drawn = cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR)
    for box, one, counts in zip(seen.boxes, found, counted, strict=True):
        colour = (0, 200, 0) if one else (255, 120, 0) if counts else (128, 128, 128)
        cv2.rectangle(drawn, *_corners(box), colour, 1)
    for box in boxes[false]:
        cv2.rectangle(drawn, *_corners(box), (0, 0, 255), 1)
    out.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(out / name), drawn)


def _corners(box: Floats) -> tuple[tuple[int, int], tuple[int, int]]:
    left, top, right, bottom = np.rint(box).astype(int).tolist()
    return (left, top), (right - 1, bottom - 1)
