"""What is drawn of an episode without an engine: legends, labels, the layout of films, the
minimap."""

from __future__ import annotations

import dataclasses
import itertools

import numpy as np
import pytest
import shapely

from cosim.core.geometry import Pose
from cosim.core.state import People, PersonKind, RobotState, Street
from cosim.place.street_map import StreetMap, Strip
from cosim.report.above import EVENT, PERSON, ROUTE, Sheet
from cosim.report.hud import Layout
from cosim.report.legend import MARGIN_PX, legend
from cosim.report.minimap import MINIMAP_REACH_M, NOSE, RED_SIGNAL, Minimap
from cosim.spec.scenario import City, Scenario

INK = (10, 20, 30)
WORDS = [
    ("conversing-001", INK),
    ("policy orca", INK),
    ("goal after 13 s and so on", (200, 0, 0)),
    ("route", (0, 0, 250)),
]


@pytest.mark.parametrize("width", [140, 200, 514, 2400])
def test_a_legend_fits_below_its_picture(width: int) -> None:
    """However narrow a picture is, no word runs out of it, and every cell is there in its
    colour."""
    image = np.full((40, width, 3), 90, dtype=np.uint8)
    both = legend(image, WORDS)
    band = both[40:]
    assert both.shape[1] == width and (both[:40] == 90).all()
    assert (band[:, -MARGIN_PX:] == 255).all() and (band[-4:] == 255).all()
    for colour in {colour for _, colour in WORDS}:
        assert (band == colour).all(axis=2).any(), colour
    assert len(legend(np.zeros((40, 140, 3), np.uint8), WORDS)) > len(
        legend(np.zeros((40, 2400, 3), np.uint8), WORDS)
    )


def test_labels_do_not_cover_one_another() -> None:
    """Three labels of one place: each keeps all the ink that it had alone, and none lies on the
    ring around it."""
    alone = []
    sheet = Sheet((0.0, 0.0, 40.0, 30.0))
    sheet.dot(np.array([[20.0, 15.0]]), EVENT, 0.9, filled=False)
    ring = (sheet.image == EVENT).all(axis=2)
    for colour in ((250, 0, 0), (0, 0, 250), (0, 90, 0)):
        sheet.text((20.0, 15.0), "e0 conversing", colour, 0.9)
        alone.append(((sheet.image == colour).all(axis=2), colour))
    assert all(ink.sum() > 20 and (sheet.image[ink] == colour).all() for ink, colour in alone)
    assert (sheet.image[ring] == EVENT).all()


def test_labels_stay_in_the_picture() -> None:
    """At the right edge and in a corner a label is drawn whole, as it is in the middle."""
    counts = []
    for place in ((20.0, 15.0), (39.9, 15.0), (39.9, 0.1), (0.1, 29.9)):
        sheet = Sheet((0.0, 0.0, 40.0, 30.0))
        sheet.text(place, "goal", INK)
        counts.append(int((sheet.image == INK).all(axis=2).sum()))
    assert len(set(counts)) == 1 and counts[0] > 8


@pytest.mark.parametrize(
    "size", [(320, 180), (640, 360), (960, 540), (1280, 720), (1920, 1080), (500, 800)]
)
def test_nothing_covers_anything_in_a_film(size: tuple[int, int]) -> None:
    """View, second view, map and bar fill the picture and do not overlap; the second view is
    4:3."""
    layout = Layout.of(*size)
    boxes = [shapely.box(a.x, a.y, a.x + a.width, a.y + a.height) for a in layout]
    assert sum(box.area for box in boxes) == size[0] * size[1]
    assert shapely.union_all(boxes).bounds == (0.0, 0.0, *map(float, size))
    assert not any(a.intersection(b).area for a, b in itertools.combinations(boxes, 2))
    assert layout.second.width * 3 == layout.second.height * 4
    assert layout.view.width > 2 * layout.second.width and layout.map.height > 40


def minimap() -> Minimap:
    """A route of 60 m along the x axis, on a sidewalk 4 m wide."""
    line = np.array([[0.0, 0.0], [60.0, 0.0]])
    polygon = shapely.LineString(line).buffer(2.0, cap_style="flat")
    strip = Strip("s", "sidewalk", line, 4.0, polygon, (None, None))
    street_map = StreetMap("made-up", (0.0, -2.0, 60.0, 2.0), {"s": strip}, {}, {}, {})
    scenario = Scenario(
        id="t",
        suite="test",
        place=City(seed=0),
        seed=0,
        start=(0.0, 0.0, 0.0),
        goal=(60.0, 0.0),
        route=((0.0, 0.0), (60.0, 0.0)),
    )
    return Minimap(street_map, scenario, (0.7, 0.55))


def where(image: np.ndarray, colour: tuple[int, int, int]) -> np.ndarray:  # type: ignore[type-arg]
    """(N, 2) columns and rows of the pixels of a colour."""
    return np.argwhere((image == colour).all(axis=2))[:, ::-1]


def test_the_map_shows_who_is_where_and_faces_where() -> None:
    """East is right and north up; event people are orange, others violet, both with a nose; the
    hand that stops is red, between its person and the robot."""
    robot = RobotState(Pose(30.0, 0.0, 0.0))
    xy = [[34.0, 5.0], [36.0, 0.0]]
    doing = ("walk", "stop")
    kind = [PersonKind.CROWD, PersonKind.EVENT]
    people = People.of(("u", "t"), xy, [0.5 * np.pi, np.pi], [1.2, 0.0], doing, kind=kind)  # type: ignore[arg-type]
    image = minimap().picture(robot, Street(0, people), (400, 400), np.array([1.0, 0.0]))
    px = 400 / (2.0 * MINIMAP_REACH_M)
    middle = 200.0 + px * (np.array([30.0, 0.0]) - (34.0, 0.0)) * (1.0, -1.0)
    event, other, hand, nose = (
        where(image, colour) for colour in (EVENT, PERSON, RED_SIGNAL, NOSE)
    )
    assert event.mean(axis=0) == pytest.approx(middle + px * np.array([5.9, 0.0]), abs=3.0)
    assert other.mean(axis=0) == pytest.approx(middle + px * np.array([4.0, -5.1]), abs=3.0)
    assert np.ptp(other[:, 1]) > 1.2 * np.ptp(other[:, 0]) and np.ptp(event[:, 0]) > 1.2 * np.ptp(
        event[:, 1]
    )
    assert nose[:, 0].max() < hand[:, 0].mean() < event[:, 0].min() + 1
    assert nose[:, 0].mean() > middle[0] and len(where(image, ROUTE)) > 400


def test_the_map_follows_its_robot() -> None:
    """The same street ten metres on: what stands on the ground moves by ten metres in the picture,
    to half a pixel."""
    one = minimap()
    people = People.of(("e0",), [[36.0, 1.0]], [0.0], [0.0], ("stand",), kind=PersonKind.EVENT)
    east = np.array([1.0, 0.0])
    shift = []
    for x in (30.0, 32.0):
        image = one.picture(RobotState(Pose(x, 0.0, 0.0)), Street(0, people), (300, 200), east)
        assert image.shape == (200, 300, 3)
        shift.append(where(image, EVENT).mean(axis=0))
    assert shift[0] - shift[1] == pytest.approx((2.0 * 200 / (2.0 * MINIMAP_REACH_M), 0.0), abs=0.5)


def test_a_robot_outside_its_map_has_ground_around_it() -> None:
    """Far off the drawn streets the map is plain, and the robot is in it."""
    lost = dataclasses.replace(RobotState(Pose(30.0, 0.0, 0.0)), pose=Pose(900.0, 0.0, 0.0))
    image = minimap().picture(lost, Street(0), (200, 200), np.array([0.0, 1.0]))
    assert len(where(image, NOSE)) > 4 and not len(where(image, ROUTE))
