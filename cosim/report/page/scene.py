"""Data of one failure and one place in the page: JSON with short names and integers."""

from __future__ import annotations

import msgspec

Outline = list[int]
"""x, y, x, y ... in centimetres from the scene's origin."""


class Track(msgspec.Struct, frozen=True):
    """Moving body.

    kind: "crowd", "event", "resident", "injected" or "vehicle"
    first: first sample
    at: x, y in centimetres and heading in milliradians for each sample
    size: length and width in centimetres
    doing: (sample, word) at each change of activity
    """

    kind: str
    first: int
    at: list[int]
    size: tuple[int, int] = (60, 60)
    doing: list[tuple[int, str]] = []


class CrossingLight(msgspec.Struct, frozen=True):
    """Light of one crossing.

    states: one letter per sample, g walk, r stop, - unknown.
    """

    line: Outline
    states: str


class DrawnWay(msgspec.Struct, frozen=True):
    """Waypoints projected into a picture, in tenths of pixels from its upper left corner.

    lines: pieces of the line
    points: waypoints inside the picture
    follows: index of the followed one in points, -1 if outside
    """

    lines: list[Outline]
    points: Outline = []
    follows: int = -1


class Pictures(msgspec.Struct, frozen=True):
    """Frames as data URLs.

    at: samples at which they were taken
    ways: projected waypoints for each of the robot's frames
    size: width and height of the robot's frames in pixels
    """

    at: list[int]
    robot: list[str]
    follow: list[str]
    ways: list[DrawnWay]
    size: tuple[int, int]


class Scene(msgspec.Struct, frozen=True):
    """Last seconds before a failure.

    step_s: time between samples
    end_s: time of the last sample in the episode
    robot: x, y (cm), heading (mrad), speed (cm/s), command (cm/s, mrad/s) for each sample
    size: of the robot, cm
    ground: kind and rings of each zone, in drawing order
    hit: index of the track that the robot met, -1 for none
    plans: (sample, outline) at each change of waypoints: robot position at the request, then
        waypoints; empty without waypoints
    follows: index of the followed point in an outline
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
    """Card of the gallery.

    scene: None if the episode could not be replayed
    why: reason for a missing scene
    """

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
    """Place from above.

    image: data URL
    bounds: x0, y0, x1, y1 in metres
    credit: attribution of the map data
    """

    place: str
    image: str
    bounds: tuple[float, float, float, float]
    credit: str = ""


class Spot(msgspec.Struct, frozen=True, kw_only=True):
    """Position of a failure on a place.

    entry: index of its card, -1 without one.
    """

    x_m: float
    y_m: float
    cause: str
    words: str
    entry: int = -1
