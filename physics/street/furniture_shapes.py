"""Low-poly parts and collision shapes of street furniture.

Prop frame: x along the street, y to the left, z up from the foot; the front faces -y. Each function
    takes the size and returns at most about sixty triangles, which limits the time of the software
    renderer.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final, Literal

import numpy as np

from cosim.core.geometry import Floats
from physics.ground.mesh import Mesh, Part, box, disc, frustum, join
from physics.street.tree_shapes import (
    SHRUB_TWIGS,
    SPECIES,
    TREE_TWIGS,
    Crown,
    crown,
    crown_core,
    crown_twigs,
    leafy,
    tree_trunk,
)
from physics.street.vehicles import vehicle_parts
from physics.textures.walls import PANE as GLASS

Size = tuple[float, float, float]
"""Length along the street, depth across it, and height, in metres."""

METAL: Final = (0.24, 0.26, 0.28)
ZINC: Final = (0.52, 0.53, 0.54)
WOOD: Final = (0.52, 0.36, 0.22)
_STONE: Final = (0.62, 0.60, 0.57)
BARK: Final = (0.36, 0.27, 0.20)
LIGHT: Final = (0.93, 0.92, 0.85)
BANDS: Final = (0.90, 0.88, 0.84)
WHITE: Final = (0.92, 0.92, 0.90)
_DARK: Final = (0.10, 0.10, 0.11)
PANE: Final = (0.66, 0.76, 0.80)


@dataclass(frozen=True, slots=True)
class Solid:
    """A collision shape: an upright box or cylinder.

    size_m: length, depth and height; for a cylinder diameter, diameter and height
    at_m: centre on the ground
    """

    shape: Literal["box", "cylinder"]
    size_m: Size
    at_m: tuple[float, float] = (0.0, 0.0)


def upright_solid(size: Size) -> tuple[Solid, ...]:
    """Return a cylinder of the prop's size."""
    return (Solid("cylinder", size),)


def block(size: Size) -> tuple[Solid, ...]:
    """Return a box of the prop's size."""
    return (Solid("box", size),)


def three_walls(size: Size) -> tuple[Solid, ...]:
    """Return the back and side walls of a shelter."""
    length, depth, height = size
    wall = (length, 0.08, height)
    side = (0.08, depth, height)
    ends = [Solid("box", side, (s * 0.5 * (length - 0.08), 0.0)) for s in (-1, 1)]
    return Solid("box", wall, (0.0, 0.5 * (depth - 0.08))), *ends


def table_and_chairs(size: Size) -> tuple[Solid, ...]:
    """Return a cylinder for the table and boxes for two chairs."""
    chairs = [Solid("box", (0.42, 0.42, 0.85), (s * (0.5 * size[0] - 0.21), 0.0)) for s in (-1, 1)]
    return Solid("cylinder", (size[1], size[1], 0.74)), *chairs


def _hoops_at(length: float) -> Floats:
    count = max(round(length / 0.75), 1) + 1
    return np.linspace(-0.5, 0.5, count) * (length - 0.06)


def hoops(size: Size) -> tuple[Solid, ...]:
    """Return a box for each hoop of a bicycle rack."""
    return tuple(
        Solid("box", (0.06, size[1], size[2]), (float(x), 0.0)) for x in _hoops_at(size[0])
    )


def lamp(size: Size) -> tuple[Part, ...]:
    r = 0.5 * size[0]
    h = size[2]
    pole = [
        frustum((r, r), (0.9 * r, 0.9 * r), 0.0, 0.8, 8),
        frustum((0.6 * r, 0.6 * r), (0.4 * r, 0.4 * r), 0.8, h - 0.02, 6),
        box((0.06, 1.3, 0.06), (0.0, 0.6, h - 0.03)),
        box((0.22, 0.6, 0.05), (0.0, 1.3, h + 0.02)),
    ]
    glass = box((0.18, 0.52, 0.06), (0.0, 1.3, h - 0.035), skip=("top",))
    return Part(join(pole), None, "metal-painted"), Part(glass, LIGHT, "lamp")


def sign(size: Size) -> tuple[Part, ...]:
    """Return a traffic sign (square, disc or triangle) that faces oncoming traffic."""
    h = size[2]
    pole = frustum((0.03, 0.03), (0.03, 0.03), 0.0, h, 6)
    shape = ((4, 0.25 * math.pi), (14, 0.0), (3, 0.0))[round(100.0 * size[0]) % 3]
    middle = (-0.040, 0.0, h - 0.31)
    radius = 0.30 if shape[0] > 4 else 0.34
    back = disc(radius, (0.0, 0.0, 0.0), *shape).moved((0.004, 0.0, 0.0))
    rim = disc(radius, (0.0, 0.0, 0.0), *shape)
    face = disc(0.86 * radius, (0.0, 0.0, 0.0), *shape)
    turn = [disc_.moved((0.0, 0.0, 0.0), math.pi) for disc_ in (rim, face)]
    return (
        Part(join([pole, back.moved(middle)]), ZINC, "metal-brushed"),
        Part(turn[0].moved(middle), WHITE),
        Part(turn[1].moved((middle[0] - 0.006, middle[1], middle[2])), None),
    )


def hydrant(size: Size) -> tuple[Part, ...]:
    r = 0.5 * size[0]
    h = size[2]
    body = [frustum((0.8 * r, 0.8 * r), (0.7 * r, 0.7 * r), 0.0, 0.75 * h, 6)]
    body += [
        frustum((r, r), (0.3 * r, 0.3 * r), 0.75 * h, h, 6),
        box((2.0 * r, 0.1, 0.1), (0.0, 0.0, 0.55 * h)),
    ]
    return (Part(join(body), None),)


def litter_bin(size: Size) -> tuple[Part, ...]:
    r = 0.5 * size[0]
    h = size[2]
    foot = frustum((0.7 * r, 0.7 * r), (0.7 * r, 0.7 * r), 0.0, 0.08, 8)
    lid = [
        frustum((r, r), (0.6 * r, 0.6 * r), 0.92 * h, h, 8),
        frustum((0.8 * r, 0.8 * r), (0.8 * r, 0.8 * r), 0.8 * h, 0.92 * h, 8),
    ]
    drum = frustum((0.85 * r, 0.85 * r), (0.95 * r, 0.95 * r), 0.08, 0.8 * h, 8)
    return Part(drum, None, "metal-painted"), Part(join([foot, *lid]), _DARK)


def park_bench(size: Size) -> tuple[Part, ...]:
    length, depth, h = size
    slats = [
        box((length, 0.25 * depth, 0.05), (0.0, y * depth, 0.45), skip=("bottom",))
        for y in (-0.35, -0.05, 0.25)
    ]
    slats += [
        box((length, 0.04, 0.12), (0.0, 0.5 * depth - 0.05, h - z), skip=("bottom",))
        for z in (0.06, 0.24)
    ]
    legs = [
        box((0.06, depth, 0.42), (s * (0.5 * length - 0.2), 0.0, 0.21), skip=("bottom", "top"))
        for s in (-1, 1)
    ]
    legs += [
        box(
            (0.06, 0.05, h - 0.42),
            (s * (0.5 * length - 0.2), 0.5 * depth - 0.03, 0.5 * (h + 0.3)),
            skip=("top",),
        )
        for s in (-1, 1)
    ]
    return Part(join(slats), None, "planks"), Part(join(legs), METAL)


def tree(size: Size, paint: int) -> tuple[Part, ...]:
    """Return a tree; `paint` selects the species."""
    species = SPECIES[paint % len(SPECIES)]
    whole = crown(species, size[2])
    leaves = leafy(species, whole)
    core = crown_core(leaves)
    stem = tree_trunk(species, size[2], 0.5 * size[0])
    parts = [
        Part(stem, BARK, "bark"),
        Part(whole.mesh, None, species.cover, whole.shade, detail="plain"),
    ]
    for distance, look in TREE_TWIGS.items():
        twigs = crown_twigs(leaves, *look)
        parts.append(Part(core.mesh, None, species.cover, core.shade, detail=distance))
        parts.append(
            Part(twigs.mesh, None, species.leaves, twigs.shade, detail=distance, spots=twigs.spots)
        )
    return tuple(parts)


def planter(size: Size) -> tuple[Part, ...]:
    length, depth, h = size
    tub = box((length, depth, 0.55 * h), (0.0, 0.0, 0.275 * h), skip=("bottom",))
    wide, narrow = (0.46 * length, 0.46 * depth), (0.3 * length, 0.25 * depth)
    shrub = frustum(wide, narrow, 0.55 * h, h, 8)
    shade = np.interp(shrub.vertices[:, 2], (0.55 * h, h), (0.6, 1.0))
    parts = [Part(tub, _STONE, "stone"), Part(shrub, None, "hedge", detail="plain")]
    core = crown_core(Crown(shrub, shade))
    for distance, look in SHRUB_TWIGS.items():
        twigs = crown_twigs(Crown(shrub, shade), *look)
        parts.append(Part(core.mesh, None, "hedge", core.shade, detail=distance))
        parts.append(
            Part(twigs.mesh, None, "leaves-small", twigs.shade, detail=distance, spots=twigs.spots)
        )
    return tuple(parts)


def bollard(size: Size) -> tuple[Part, ...]:
    r = 0.5 * size[0]
    h = size[2]
    post = frustum((r, r), (0.85 * r, 0.85 * r), 0.0, h, 6)
    band = frustum((r, r), (r, r), 0.78 * h, 0.9 * h, 6)
    return Part(post, None, "metal-painted"), Part(band, BANDS)


def rack(size: Size) -> tuple[Part, ...]:
    _, depth, h = size
    bars = []
    for x in _hoops_at(size[0]).tolist():
        bars += [
            box((0.05, 0.05, h), (x, s * (0.5 * depth - 0.03), 0.5 * h), skip=("bottom", "top"))
            for s in (-1, 1)
        ]
        bars.append(box((0.05, depth, 0.05), (x, 0.0, h - 0.025), skip=("bottom", "left", "right")))
    return (Part(join(bars), None, "metal-brushed"),)


def scooter(size: Size) -> tuple[Part, ...]:
    """Return a scooter. Its stem and bar are thinner and brighter where textures are drawn.

    Detectors of people take a broad dark T over two wheels for a person.
    """
    length, depth, h = size
    front = 0.5 * length - 0.12
    deck = box((length - 0.4, 0.16, 0.06), (0.0, 0.0, 0.17))
    wheels = [
        box((0.22, 0.06, 0.22), (x, 0.0, 0.11), skip=("bottom", "top")) for x in (front, -front)
    ]

    def stem(wide: float) -> Mesh:
        bar = box((wide, wide, h - 0.1), (front - 0.06, 0.0, 0.5 * h + 0.05), skip=("bottom",))
        return bar.tilted(-0.1, (front, 0.0, 0.1))

    bar = box((0.05, depth, 0.04), (front - 0.14, 0.0, h))
    thin = [stem(0.035), box((0.03, 0.8 * depth, 0.025), (front - 0.14, 0.0, h))]
    return (
        Part(join([deck, stem(0.05)]), None, detail="plain"),
        Part(join([bar, *wheels]), _DARK, detail="plain"),
        Part(deck, None, detail="textured"),
        Part(join(wheels), _DARK, detail="textured"),
        Part(join(thin), ZINC, "metal-brushed", detail="textured"),
    )


def cafe(size: Size) -> tuple[Part, ...]:
    length, depth, _ = size
    post = box((0.08, 0.08, 0.71), (0.0, 0.0, 0.355), skip=("bottom", "top"))
    table = [frustum((0.5 * depth, 0.5 * depth), (0.5 * depth, 0.5 * depth), 0.71, 0.74, 6), post]
    chairs = []
    for s in (-1, 1):
        x = s * (0.5 * length - 0.21)
        chairs.append(box((0.40, 0.40, 0.08), (x, 0.0, 0.43), skip=("bottom",)))
        back = "back" if s > 0 else "front"
        chairs.append(box((0.04, 0.40, 0.85), (x + s * 0.18, 0.0, 0.425), skip=("bottom", "top")))
        chairs.append(
            box((0.04, 0.36, 0.40), (x - s * 0.16, 0.0, 0.2), skip=("bottom", "top", back))
        )
    return Part(join(table), METAL), Part(join(chairs), None)


def shelter(size: Size) -> tuple[Part, ...]:
    length, depth, h = size
    roof = box((length + 0.2, depth + 0.1, 0.1), (0.0, 0.0, h))
    seat = box((length - 1.0, 0.35, 0.06), (0.0, 0.5 * depth - 0.3, 0.48), skip=("back", "front"))
    panes = [
        box(
            (length, 0.05, h - 0.3),
            (0.0, 0.5 * depth - 0.03, 0.5 * h + 0.05),
            skip=("top", "front", "back"),
        )
    ]
    panes += [
        box(
            (0.05, depth, h - 0.1),
            (s * 0.5 * (length - 0.05), 0.0, 0.5 * h - 0.05),
            skip=("top", "bottom"),
        )
        for s in (-1, 1)
    ]
    front, back = 0.03 - 0.5 * depth, 0.5 * depth - 0.03
    ends = [s * 0.5 * (length - 0.06) for s in (-1, 1)]
    posts = [(x, y) for x in ends for y in (front, back)]
    posts.append((0.0, back))
    frame = [
        box((0.06, 0.06, h - 0.05), (x, y, 0.5 * h - 0.025), skip=("top", "bottom"))
        for x, y in posts
    ]
    rail = box((length, 0.05, 0.05), (0.0, back, 0.22), skip=("front", "back", "bottom"))
    return (
        Part(join([roof, seat]), None),
        Part(join([*frame, rail]), METAL, detail="textured"),
        Part(join(panes), PANE, GLASS),
    )


def boxes(size: Size) -> tuple[Part, ...]:
    length, depth, h = size
    skip = ("bottom",)
    low = box((0.55 * length, depth, 0.6 * h), (-0.225 * length, 0.0, 0.3 * h), skip)
    other = box(
        (0.42 * length, 0.8 * depth, 0.45 * h), (0.29 * length, -0.05 * depth, 0.225 * h), skip
    )
    high = box((0.4 * length, 0.7 * depth, 0.4 * h), (-0.2 * length, 0.0, 0.8 * h), skip).moved(
        (0.0, 0.0, 0.0), 0.12
    )
    return (Part(join([low, other, high]), None),)


def fence(size: Size) -> tuple[Part, ...]:
    length, depth, h = size
    mesh = [box((length, 0.04, 0.62 * h), (0.0, 0.0, 0.6 * h))]
    feet = [
        box((0.25, depth, 0.12), (s * (0.5 * length - 0.3), 0.0, 0.06), skip=("bottom",))
        for s in (-1, 1)
    ]
    posts = [
        box((0.06, 0.06, h), (s * (0.5 * length - 0.3), 0.0, 0.5 * h), skip=("bottom", "top"))
        for s in (-1, 1)
    ]
    # Detectors of people take a bright panel between white posts for a person.
    return (
        Part(join(mesh), None, "wood-upright"),
        Part(join([*feet, *posts]), WHITE, detail="plain"),
        Part(join([*feet, *posts]), ZINC, "metal-brushed", detail="textured"),
    )


def car(size: Size) -> tuple[Part, ...]:
    return vehicle_parts("hatchback", size[0], size[1])
