"""Measures what networks trained on real streets see in pictures: `cosim bench realism`.

Frames are taken while the oracle drives routes with a crowd. The boxes of detectors and ESPNetv2's
classes are compared with the labels of the same pictures.
"""

from __future__ import annotations

import itertools
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType
from typing import Any, Final, NamedTuple

import cv2
import msgspec
import numpy as np
from numpy.typing import NDArray

from cosim.core.errors import MapError, SpecError, UsageError
from cosim.core.geometry import Floats
from cosim.core.progress import Progress
from cosim.core.state import LABELS, Frame, People, PersonKind
from cosim.people.gait import stature_m
from cosim.policies.follow.networks import ESPNET_GRAPH
from cosim.policies.load import load_policy
from cosim.policies.onnx.graph import Graph
from cosim.policies.onnx.inputs import PictureInput
from cosim.policies.onnx.pictures import picture_tensor
from cosim.spec.camera import CameraSpec
from cosim.spec.options import EpisodeOptions
from cosim.spec.robot import robot_called
from cosim.spec.run_config import Appearance
from cosim.spec.scenario import CrowdSpec, Scenario, Split
from cosim.spec.weather import CLEAR
from physics.cameras.sky import sky_of
from physics.cameras.view import Shot, robot_shot
from physics.ground.tiles import tiles_within
from physics.people.appearance import look_of
from physics.people.wardrobe import ALL as ALL_OUTFITS
from physics.people.wardrobe import season_of
from physics.street.furniture import Prop
from physics.street.surface import Surface, grounded_obstacles
from scenarios.episodes.episode import Episode
from scenarios.places.nets import surface_of_place
from scenarios.suites.catalog import load_suite
from scenarios.suites.sample import suite_on_map
from scenarios.tools.bench.detectors import DETECTORS, network_graph

CITY: Final = "long-horizon"
"""Suite whose routes are driven without a place: generated cities."""
CITY_ROUTES: Final[Mapping[Split, tuple[str, ...]]] = MappingProxyType(
    {
        "val": tuple(f"lh-{seed:03}-00" for seed in (1, 9, 17, 21, 29, 33, 45, 57)),
        "test": tuple(f"lh-{seed}-00" for seed in (7001, 7004, 7006, 7009, 7012, 7015, 7019, 7020)),
    }
)
"""Routes of `CITY` by split. Looks are tuned on val; no tuning uses the cities of test."""
PLACE_SEEDS: Final[Mapping[Split, range]] = MappingProxyType(
    {"val": range(20), "test": range(100, 120)}
)
"""Seeds from which routes on a named place are drawn, by split."""
CAMERA: Final = CameraSpec(512, 288, 60.0, depth=True)
FIRST_S: Final = 2.0
"""Time of a route's first frame in seconds."""
EACH_S: Final = 4.0
"""Seconds between frames."""
ROUTES: Final = 8
"""Least number of routes over which frames are spread."""
SIZES_PX: Final = {"taller than 60 px": (60.0, np.inf), "24 to 60 px": (24.0, 60.0)}
"""Classes of people by the height of what is seen of them, in pixels."""
CONDITIONS: Final[Mapping[str, Callable[[Scenario], bool]]] = MappingProxyType(
    {
        "all": lambda scenario: True,
        "fog": lambda scenario: scenario.light.fog_m is not None,
        "night": lambda scenario: sky_of(scenario.light, 0).lamps > 0.5,
    }
)
"""Conditions of a frame's scenario; boxes are counted for each of them apart."""
ALL: Final = "all"
CLASSES: Final = {
    "person": ((11,), ("person",)),
    "sky": ((10,), ("sky",)),
    "building": ((2,), ("building",)),
    "walkable": ((0, 1), ("road", "sidewalk", "crosswalk", "curb", "ground")),
}
"""Classes of Cityscapes, and labels that mean the same. Networks trained from cars call sidewalks
under the robot road, so both are one class."""
_POLICY: Final = "orca"
_PERSONS: Final = 50
_SAME: Final = 0.5
"""Overlap (IoU) from which a box shows a person."""
_OTHER: Final = 0.3
"""Overlap with all people, and share of pixels of people, below which a box is false."""
_SEEN: Final = 0.7
"""Share of a person's height that must be visible, for the person to count."""
_ADULT_M: Final = 1.7
_APART_M: Final = 0.9
"""Largest distance on the ground between a person and pixels of it, in metres."""
_BODY_M: Final = 0.45
"""The same for the body of a person with a companion, such as an umbrella."""
_PICTURES: Final = 12
"""Number of pictures that are written."""
_STREET_INPUT: Final = PictureInput(
    size=(512, 256), mean=(0.485, 0.456, 0.406), std=(0.229, 0.224, 0.225)
)


_NAMES: Final = {number: name for name, number in LABELS.items()}
_PROP_M: Final = 3.0
"""Largest distance on the ground between a prop's place and its pixels, in metres."""
_CROWN_M: Final = 2.0
"""Height in metres above a tree's foot from which it is a crown."""
_TREE: Final = "tree"


class SeenPeople(NamedTuple):
    """People in a picture.

    boxes: (N, 4) left, top, right and bottom of their pixels.
    whole: (N,) whether enough of their height is seen.
    """

    boxes: Floats
    whole: NDArray[np.bool_]


@dataclass
class Detections:
    """Counts of one detector's boxes.

    people: numbers of found and of all people, by class of size.
    expected: how many real people of the same heights would be found.
    boxes: number of boxes.
    false: boxes without a person, by what they show (`Things.under`).
    """

    people: dict[str, list[int]] = field(
        default_factory=lambda: {name: [0, 0] for name in SIZES_PX}
    )
    expected: dict[str, float] = field(default_factory=lambda: dict.fromkeys(SIZES_PX, 0.0))
    boxes: int = 0
    false: Counter[str] = field(default_factory=Counter)


@dataclass
class Realism:
    """Counts over the frames of a place in a weather; "clear" is each scenario's own.

    frames: number of frames of each condition.
    detected: counts by detector and condition.
    common, joined, labelled: pixels that network and labels call the same class, that either
        calls so, and that the labels call so.
    """

    place: str
    split: Split = "val"
    weather: str = CLEAR
    frames: Counter[str] = field(default_factory=Counter)
    detected: dict[str, dict[str, Detections]] = field(
        default_factory=lambda: {
            name: {condition: Detections() for condition in CONDITIONS} for name in DETECTORS
        }
    )
    common: Counter[str] = field(default_factory=Counter)
    joined: Counter[str] = field(default_factory=Counter)
    labelled: Counter[str] = field(default_factory=Counter)

    @property
    def called(self) -> str:
        """Name of place, split and weather, for columns and files."""
        return called(self.place, self.split, self.weather)

    @property
    def iou(self) -> dict[str, float]:
        """Intersection over union of each class, over all frames; NaN if it never occurs."""
        return {name: _ratio(self.common[name], self.joined[name]) for name in CLASSES}

    @property
    def recall(self) -> dict[str, float]:
        """Share of each class's pixels that the network calls so; NaN if it never occurs."""
        return {name: _ratio(self.common[name], self.labelled[name]) for name in CLASSES}


class Picture(NamedTuple):
    """A frame with what the simulation knows about it.

    things: names what a box shows
    conditions: those of `CONDITIONS` that hold
    """

    frame: Frame
    seen: SeenPeople
    things: Things
    conditions: tuple[str, ...]


def measure_realism(
    places: Sequence[str],
    splits: Sequence[Split],
    weathers: Sequence[str],
    frames: int,
    appearance: Appearance,
    weights: Path | None,
    out: Path | None,
    progress: Progress,
) -> list[Realism]:
    """Return the counts of each place, split and weather; the place "" is generated cities.

    frames: number of frames of each, fewer if its routes are too short.
    weights: folder of the networks' files, by default as for the policy `follow`.
    out: folder for pictures with boxes, and for all counts as realism.json.
    """
    street = network_graph(ESPNET_GRAPH, weights)
    graphs = {name: network_graph(one.file, weights) for name, one in DETECTORS.items()}
    found = []
    for place, split, weather in itertools.product(places, splits, weathers):
        counts = Realism(place or CITY, split, weather)
        each = max(1, frames // _PICTURES)
        name = counts.called.replace(", ", "-")
        options = EpisodeOptions(appearance=appearance, weather=weather)
        for picture in _pictures(place, split, frames, options, progress):
            number = counts.frames[ALL]
            rgb, labels = picture.frame.rgb, picture.frame.labels
            counts.frames.update(picture.conditions)
            for detector, graph in graphs.items():
                boxes = DETECTORS[detector].detect(rgb, graph)
                judged = count_boxes(counts, detector, boxes, picture)
                if out is not None and number % each == 0:
                    path = out / f"{name}-{number:03}-{detector}.png"
                    _write(path, rgb, boxes, picture.seen, judged)
            count_classes(counts, street_kinds(rgb, street), labels)
            progress(f"{name}: {number + 1} frames", (number + 1) / frames)
        found.append(counts)
    if out is not None:
        out.mkdir(parents=True, exist_ok=True)
        (out / "realism.json").write_bytes(
            msgspec.json.format(msgspec.json.encode([as_json(one) for one in found]), indent=1)
        )
    return found


def called(place: str, split: str, weather: str) -> str:
    """Return the name of a place's counts; a clear day is not named."""
    return ", ".join([place, split] + [weather] * (weather != CLEAR))


def as_json(one: Realism) -> dict[str, Any]:
    """Return the counts of a place as values of JSON."""
    return {
        "place": one.place,
        "split": one.split,
        "weather": one.weather,
        "frames": dict(one.frames),
        "detected": {
            name: {
                condition: {
                    "people": {
                        size: {"found": a, "expected": got.expected[size], "of": b}
                        for size, (a, b) in got.people.items()
                    },
                    "boxes": got.boxes,
                    "false": dict(got.false.most_common()),
                }
                for condition, got in by_condition.items()
                if one.frames[condition]
            }
            for name, by_condition in one.detected.items()
        },
        "iou": one.iou,
        "recall": one.recall,
    }


def read_realism(path: Path) -> list[dict[str, Any]]:
    """Read the counts of another run, as written to realism.json. Raises UsageError."""
    try:
        found = msgspec.json.decode(path.read_bytes())
        for one in found:
            figures_of(one)
    except OSError as error:
        raise UsageError(f"--compare {path}: cannot be read: {error.strerror}") from error
    except (msgspec.DecodeError, TypeError, KeyError, AttributeError) as error:
        raise UsageError(
            f"--compare {path}: is no realism.json of `cosim bench realism --out FOLDER`"
        ) from error
    return list(found)


def figures_of(one: Mapping[str, Any]) -> dict[str, str]:
    """Return the rows of a place's table, in order, from its values of JSON."""
    rows = {"frames": str(one["frames"][ALL])}
    for name, by_condition in one["detected"].items():
        for condition, got in by_condition.items():
            where = name if condition == ALL else f"{name}, {condition}"
            for size, people in got["people"].items():
                rows[f"{where}: people {size}, found"] = _share_of(people["found"], people["of"])
                rows[f"{where}: people {size}, if real"] = _share_of(
                    round(people["expected"]), people["of"]
                )
            rows[f"{where}: false boxes"] = _share_of(sum(got["false"].values()), got["boxes"])
    for what, word in (("iou", "IoU"), ("recall", "recall")):
        for name, value in one[what].items():
            rows[f"ESPNetv2: {word} of {name}"] = "" if value is None else f"{value:.2f}"
    for name, by_condition in one["detected"].items():
        wrong = by_condition[ALL]["false"]
        rows |= {f"{name}: false on {what}": str(wrong[what]) for what in sorted(wrong)}
    return rows


def _ratio(part: int, whole: int) -> float:
    return part / whole if whole else float("nan")


def _share_of(part: int, whole: int) -> str:
    return f"{part} of {whole}" + (f" ({part / whole:.2f})" if whole else "")


class Things:
    """Names what a box in a picture shows: a label, or the kind of street furniture."""

    def __init__(self, surface: Surface, scenario: Scenario, taken: Shot) -> None:
        self._surface = surface
        self._taken = taken
        self._obstacles = grounded_obstacles(scenario.obstacles, surface)

    def under(self, frame: Frame, box: Floats) -> str:
        """Return the most frequent label in a box's inner part (4,); for props their kind.

        A tree is its crown where the box's middle is `_CROWN_M` above its foot.
        """
        assert frame.labels is not None
        left, top, right, bottom = _inner(box, frame.labels.shape)
        inner = frame.labels[top:bottom, left:right]
        label = _NAMES[int(np.bincount(inner.ravel(), minlength=1).argmax())]
        if label != "prop":
            return label
        v, u = np.nonzero(inner == LABELS["prop"])
        at = np.median(_on_map(frame, self._taken, v + top, u + left), axis=0)
        near = self._nearest(at)
        if near is None:
            return label
        prop, foot_m = near
        return "crown" if prop.kind == _TREE and at[2] - foot_m > _CROWN_M else prop.kind

    def _nearest(self, at: Floats) -> tuple[Prop, float] | None:
        """Return the prop nearest to a point (3,) of the map and the height of its foot."""
        x, y = float(at[0]), float(at[1])
        keys = tiles_within(x, y, _PROP_M)
        props = [*self._obstacles, *(one for key in keys for one in self._surface.chunk(key).props)]
        if not props:
            return None
        away = [float(np.hypot(prop.x_m - x, prop.y_m - y)) for prop, _ in props]
        best = int(np.argmin(away))
        return props[best] if away[best] < _PROP_M else None


def count_boxes(
    counts: Realism, detector: str, boxes: Floats, picture: Picture
) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Count detected boxes (M, 4). Returns found people (N,) and false boxes (M,), as booleans."""
    seen, labels = picture.seen, picture.frame.labels
    assert labels is not None
    found, overlap = _matched(seen.boxes, boxes)
    nearest = overlap.max(axis=0, initial=0.0)
    false = np.array(
        [
            bool(nearest[k] < _OTHER and _share(labels == LABELS["person"], box) < _OTHER)
            for k, box in enumerate(boxes)
        ],
        dtype=bool,
    )
    under = Counter(picture.things.under(picture.frame, box) for box in boxes[false])
    heights = seen.boxes[:, 3] - seen.boxes[:, 1]
    for condition in picture.conditions:
        got = counts.detected[detector][condition]
        for name, (least, most) in SIZES_PX.items():
            rows = seen.whole & (heights >= least) & (heights < most)
            got.people[name][0] += int((rows & found).sum())
            got.people[name][1] += int(rows.sum())
            got.expected[name] += DETECTORS[detector].expected(heights[rows])
        got.boxes += len(boxes)
        got.false += under
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
        counts.labelled[name] += int(exact.sum())


def street_kinds(rgb: NDArray[np.uint8], network: Graph) -> NDArray[np.intp]:
    """Return (128, 256) classes of Cityscapes in a picture (H, W, 3)."""
    tensor = picture_tensor(rgb, _STREET_INPUT).transpose(2, 0, 1)[None]
    scores = network.run({"picture": np.ascontiguousarray(tensor, np.float32)}, ["scores"])
    return np.asarray(scores["scores"][0].argmax(axis=0))


def seen_people(
    frame: Frame, people: People, taken: Shot, heads_m: Floats | None = None
) -> SeenPeople:
    """Return the people in a picture, by their pixels' places on the ground.

    heads_m: (N,) heights of their heads, as by `heads_with_companions`
    """
    assert frame.labels is not None and frame.depth is not None
    height = frame.labels.shape[0]
    v, u = np.nonzero(frame.labels == LABELS["person"])
    if not len(v) or not len(people.xy):
        return SeenPeople(np.zeros((0, 4)), np.zeros(0, dtype=bool))
    tall = taken.half_picture[1]
    depth = frame.depth[v, u].astype(float)
    at = _on_map(frame, taken, v, u)
    away = np.hypot(*(at[:, None, :2] - people.xy[None]).transpose(2, 0, 1))
    owner = away.argmin(axis=1)
    near = away.min(axis=1) < _APART_M
    boxes = []
    whole = []
    for k in np.unique(owner[near]):
        mine = near & (owner == k)
        if heads_m is not None and np.isfinite(heads_m[k]):
            body = mine & (at[:, 2] < heads_m[k]) & (away[:, k] < _BODY_M)
            mine = body if body.any() else mine
        left, top, right_px, bottom = u[mine].min(), v[mine].min(), u[mine].max(), v[mine].max()
        boxes.append((left, top, right_px + 1.0, bottom + 1.0))
        expected = _ADULT_M / (2.0 * tall * float(np.median(depth[mine]))) * height
        whole.append(bottom + 1.0 - top >= _SEEN * expected)
    return SeenPeople(np.array(boxes, dtype=float).reshape(-1, 4), np.array(whole, dtype=bool))


def heads_with_companions(people: People, surface: Surface, scenario: Scenario) -> Floats:
    """Return (N,) heights on the map of the heads of people with a companion, others infinite.

    Umbrellas, prams, dogs and bicycles are labelled person, but detectors box people alone.
    """
    light, rain = scenario.light, scenario.conditions.rain_mm_h > 0.0
    season = season_of(light.day_of_year, light.latitude_deg)
    heads = np.full(len(people.ids), np.inf)
    for k, name in enumerate(people.ids):
        age, crowd = int(people.age[k]), int(people.kind[k]) == PersonKind.CROWD.value
        outfit = ALL_OUTFITS[look_of(name, age, surface.seed, season, rain, crowd).outfit]
        if outfit.companion not in ("", "wheelchair"):
            heads[k] = surface.heights(people.xy[k : k + 1])[0] + stature_m(name, age)
    return heads


def _on_map(frame: Frame, taken: Shot, v: NDArray[np.intp], u: NDArray[np.intp]) -> Floats:
    """Return (N, 3) points of the map that pixels in rows `v` and columns `u` show."""
    assert frame.depth is not None
    height, width = frame.depth.shape
    wide, tall = taken.half_picture
    depth = frame.depth[v, u].astype(float)
    aside = (2.0 * (u + 0.5) / width - 1.0) * wide * depth
    up = (1.0 - 2.0 * (v + 0.5) / height) * tall * depth
    right, above, ahead = taken.axes
    return np.asarray(
        taken.eye_m + aside[:, None] * right + up[:, None] * above + depth[:, None] * ahead
    )


def _pictures(
    place: str, split: Split, frames: int, options: EpisodeOptions, progress: Progress
) -> Iterator[Picture]:
    """Yield pictures while routes of a place are driven, the same number on each."""
    left = frames
    each = -(-frames // ROUTES)
    for scenario in _scenarios(place, split):
        for one in itertools.islice(_driven(scenario, options, progress), min(each, left)):
            left -= 1
            yield one
        if left <= 0:
            return


def _scenarios(place: str, split: Split) -> Iterator[Scenario]:
    """Yield routes with a crowd: of a suite, or drawn on a place; short ones where it is small."""
    if not place:
        by_id = {one.id: one for one in load_suite(CITY).scenarios}
        yield from (by_id[name] for name in CITY_ROUTES[split])
        return
    for seed in PLACE_SEEDS[split]:
        try:
            yield from suite_on_map("long-horizon", place, seed, 1).scenarios
        except (SpecError, MapError):
            for one in suite_on_map("unit", place, seed, 1).scenarios:
                yield msgspec.structs.replace(
                    one, crowd=CrowdSpec(persons=_PERSONS), ends_on_failure=False
                )


def _driven(scenario: Scenario, options: EpisodeOptions, progress: Progress) -> Iterator[Picture]:
    caller = load_policy(_POLICY)
    surface = surface_of_place(scenario.place)
    robot_model = robot_called(scenario.robot)
    scenario = options.apply_to(scenario)
    if options.weather != CLEAR and surface.scan is not None:
        raise UsageError(
            f"--weather {options.weather}: scanned places are drawn in the light of their scan: "
            f"leave it out, or leave --place out"
        )
    conditions = tuple(
        name
        for name, holds in CONDITIONS.items()
        if name == ALL or (options.weather == CLEAR and holds(scenario))
    )
    progress(f"starting {scenario.id}")
    with (
        Episode(scenario, caller.manifest, options) as episode,
        episode.eyes(CAMERA) as camera,
    ):
        caller.reset(episode.id, episode.seed)
        observation = episode.reset()
        next_s = FIRST_S
        while not episode.over:
            if episode.time_s >= next_s:
                next_s = episode.time_s + EACH_S
                robot, street = episode.moment.robot, episode.moment.street
                frame = camera.render(robot, street)
                taken = robot_shot(surface, robot_model, CAMERA, robot)
                heads_m = heads_with_companions(street.people, surface, scenario)
                seen = seen_people(frame, street.people, taken, heads_m)
                yield Picture(frame, seen, Things(surface, scenario, taken), conditions)
            observation = episode.advance(caller.act(observation))


def _matched(people: Floats, boxes: Floats) -> tuple[NDArray[np.bool_], Floats]:
    """Match people (N, 4) with boxes (M, 4), the largest overlap first.

    Returns which people are found (N,), and all overlaps (N, M).
    """
    overlap = _overlaps(people, boxes)
    found = np.zeros(len(people), dtype=bool)
    free = np.ones(len(boxes), dtype=bool)
    for at in np.argsort(-overlap, axis=None, kind="stable"):
        who, box = divmod(int(at), len(boxes))
        if overlap[who, box] < _SAME:
            break
        if free[box] and not found[who]:
            found[who], free[box] = True, False
    return found, overlap


def _inner(box: Floats, shape: tuple[int, ...]) -> tuple[int, int, int, int]:
    """Return the middle two thirds of a box (4,) inside a picture, at least one pixel."""
    left, top, right, bottom = np.asarray(box, dtype=float).tolist()
    aside, down = (right - left) / 6.0, (bottom - top) / 6.0
    x0 = min(max(int(left + aside), 0), shape[1] - 1)
    y0 = min(max(int(top + down), 0), shape[0] - 1)
    return x0, y0, max(int(right - aside), x0 + 1), max(int(bottom - down), y0 + 1)


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
    path: Path,
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
    path.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(path), drawn)


def _corners(box: Floats) -> tuple[tuple[int, int], tuple[int, int]]:
    left, top, right, bottom = np.rint(box).astype(int).tolist()
    return (left, top), (right - 1, bottom - 1)
