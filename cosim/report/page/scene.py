"""What the page shows of one failure, and of one place, as it travels there: JSON of short names
and whole numbers."""

from __future__ import annotations

import msgspec

Outline = list[int]
"""x, y, x, y ... in centimetres from the scene's origin."""


class Track(msgspec.Struct, frozen=True):
    """Somebody who moves. first: the sample at which it begins; at: x, y in centimetres and heading
    in milliradians for each sample. kind: "crowd", "event", "resident", "injected" or "vehicle";
    size: length and width in centimetres; doing: (sample, word) where what it does changes."""

    kind: str
    first: int
    at: list[int]
    size: tuple[int, int] = (60, 60)
    doing: list[tuple[int, str]] = []


class CrossingLight(msgspec.Struct, frozen=True):
    """The light of one crossing. states: a letter for each sample, g where one may walk, r where
    not, - unknown."""

    line: Outline
    states: str


class DrawnWay(msgspec.Struct, frozen=True):
    """The way ahead in a picture, in tenths of its pixels from its upper left corner: pieces of a
    line; of waypoints those that are in the picture; the number of the followed one among these, -1
    if it is not."""

    lines: list[Outline]
    points: Outline = []
    follows: int = -1


class Pictures(msgspec.Struct, frozen=True):
    """Frames as data URLs, and the samples at which they were taken. ways: that of each of the
    robot's; size: theirs, width and height in pixels."""

    at: list[int]
    robot: list[str]
    follow: list[str]
    ways: list[DrawnWay]
    size: tuple[int, int]


class Scene(msgspec.Struct, frozen=True):
    """The last seconds before a failure. step_s: between samples; end_s: of the last one, in the
    episode's time.

    robot: x, y (cm), heading (mrad), speed (cm/s), command (cm/s, mrad/s) for each sample. ground:
    pairs of what it is and its rings, drawn in turn. hit: the number of the track that the robot
    met, -1 for none. size: of the robot, cm. plans: (sample, outline) where the waypoints change
    that are followed: where the robot was when it was asked, and these; empty where there are none.
    follows: which point of an outline is followed.
    """

    step_s: float
    end_s: float
    robot: list[int]
    size: tuple[int, int]
    tracks: list[Track]
    signals: list[CrossingLight]
    ground: list[tuple[str, list[Outline]]]
    route: Outline
    goal: tuple[int, int]
    pictures: Pictures
    hit: int = -1
    plans: list[tuple[int, Outline]] = []
    follows: int = 0


class Entry(msgspec.Struct, frozen=True, kw_only=True):
    """One card of the gallery. scene: absent where the episode could not be shown again; why says
    so then."""

    label: str
    suite: str
    scenario: str
    kind: str
    event: str
    place: str
    light: str
    cause: str
    reason: str
    at_s: float
    scene: Scene | None = None
    why: str = ""


class PlacePicture(msgspec.Struct, frozen=True, kw_only=True):
    """A place from above. image: data URL; bounds: x0, y0, x1, y1 in metres; credit: of the map's
    data."""

    place: str
    image: str
    bounds: tuple[float, float, float, float]
    credit: str = ""


class Spot(msgspec.Struct, frozen=True, kw_only=True):
    """Where something went wrong on a place. entry: the number of its card, -1 without one."""

    x_m: float
    y_m: float
    cause: str
    words: str
    entry: int = -1
