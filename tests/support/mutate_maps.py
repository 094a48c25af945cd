"""Damaged maps, drawn from a seed: typical damage by disks, editors, converters and attackers."""

from __future__ import annotations

import gzip
import random
import re
from collections.abc import Callable

ABSURD = (
    "1e9",
    "-1",
    "0",
    "nan",
    "inf",
    "1e308",
    "-1e-308",
    "999999999999999999999",
    "",
    " ",
    "x y",
    "七",
    "0,0",
    "--",
    "1;2",
)
ELEMENT = re.compile(
    rb"<(\w+)[^<>]*?/>|<(way|edge|node|junction|connection|tlLogic)\b.*?</\2>", re.DOTALL
)
ATTRIBUTE = re.compile(rb' ([A-Za-z_]+)="([^"]*)"')


def bits_flipped(data: bytes, draw: random.Random) -> bytes:
    spoilt = bytearray(data)
    for _ in range(draw.randint(1, 20)):
        spoilt[draw.randrange(len(spoilt))] ^= 1 << draw.randrange(8)
    return bytes(spoilt)


def cut_short(data: bytes, draw: random.Random) -> bytes:
    return data[: draw.randrange(len(data))]


def a_piece_lost(data: bytes, draw: random.Random) -> bytes:
    at = draw.randrange(len(data))
    return data[:at] + data[at + draw.randint(1, 2000) :]


def elements_dropped(data: bytes, draw: random.Random) -> bytes:
    for place in reversed(_some(ELEMENT, data, draw)):
        data = data[: place.start()] + data[place.end() :]
    return data


def elements_doubled(data: bytes, draw: random.Random) -> bytes:
    for place in reversed(_some(ELEMENT, data, draw)):
        data = data[: place.end()] + place[0] * draw.randint(1, 3) + data[place.end() :]
    return data


def elements_swapped(data: bytes, draw: random.Random) -> bytes:
    places = _some(ELEMENT, data, draw)
    if len(places) < 2 or places[0].end() > places[1].start():
        return data
    a, b = places[:2]
    return data[: a.start()] + b[0] + data[a.end() : b.start()] + a[0] + data[b.end() :]


def absurd_values(data: bytes, draw: random.Random) -> bytes:
    return _changed(data, draw, lambda _name, _value: draw.choice(ABSURD).encode())


def every_value_absurd(data: bytes, draw: random.Random) -> bytes:
    """Set all values of one attribute to absurd ones."""
    name = draw.choice(sorted({place[1] for place in ATTRIBUTE.finditer(data)}))
    value = draw.choice(ABSURD).encode()
    return re.sub(rb" " + name + rb'="[^"]*"', b" " + name + b'="' + value + b'"', data)


def attributes_dropped(data: bytes, draw: random.Random) -> bytes:
    for place in reversed(_some(ATTRIBUTE, data, draw)):
        data = data[: place.start()] + data[place.end() :]
    return data


def wrong_references(data: bytes, draw: random.Random) -> bytes:
    names = (
        b"ref",
        b"from",
        b"to",
        b"via",
        b"tl",
        b"junction",
        b"crossingEdges",
        b"incLanes",
        b"linkIndex",
        b"id",
    )
    return _changed(data, draw, lambda name, value: b"nowhere" if name in names else value, names)


def ids_exchanged(data: bytes, draw: random.Random) -> bytes:
    ids = sorted(
        {
            place[2]
            for place in ATTRIBUTE.finditer(data)
            if place[1] in (b"id", b"ref", b"from", b"to")
        }
    )
    return _changed(
        data, draw, lambda _name, _value: draw.choice(ids), (b"id", b"ref", b"from", b"to")
    )


def coordinates_gone(data: bytes, draw: random.Random) -> bytes:
    names = (b"lat", b"lon", b"shape", b"x", b"y", b"netOffset", b"convBoundary", b"projParameter")
    values = (
        b"nan",
        b"nan,nan 1,1",
        b"1e300",
        b"1e300,1e300 0,0",
        b"91",
        b"-181",
        b"inf,0 0,inf",
        b"0,0 0,0 0,0",
        b"1,2,3",
    )
    return _changed(data, draw, lambda _name, _value: draw.choice(values), names)


def absurd_streets(data: bytes, draw: random.Random) -> bytes:
    key = draw.choice(
        (
            "lanes",
            "width",
            "lanes:forward",
            "maxspeed",
            "layer",
            "sidewalk:both:width",
            "turn:lanes",
        )
    )
    value = draw.choice(("1000000000", "1e9", "99999", "-3", "nan", "|" * 5000))
    tag = f'<tag k="highway" v="residential"/><tag k="{key}" v="{value}"/>'.encode()
    data = data.replace(b'<tag k="highway" v="residential"/>', tag, draw.randint(1, 5))
    name = draw.choice((b"width", b"speed", b"length"))
    wide = draw.choice((b"1e9", b"99999", b"-7", b"nan"))
    return re.sub(
        rb"<lane ([^>]*?) " + name + rb'="[^"]*"',
        rb"<lane \1 " + name + b'="' + wide + b'"',
        data,
        count=3,
    )


def nested_deep(data: bytes, draw: random.Random) -> bytes:
    at = draw.choice([place.start() for place in re.finditer(rb"<[a-z]", data)][1:])
    depth = draw.choice((3, 30, 1000, 100_000))
    return (
        data[:at] + b"<a>" * depth + (b"</a>" * depth if draw.random() < 0.7 else b"") + data[at:]
    )


def comments_gone(data: bytes, draw: random.Random) -> bytes:
    bare = re.sub(rb"<!--.*?-->|<\?xml.*?\?>", b"", data, flags=re.DOTALL)
    return bare.replace(b"\n", draw.choice((b"", b"\r\n", b"\n<!-- -- -->\n", b"\n<!-- - -->\n")))


def entities(data: bytes, draw: random.Random) -> bytes:
    bomb = (
        '<!DOCTYPE x [<!ENTITY a "ha">'
        + "".join(
            f'<!ENTITY {b} "{f"&{a};" * 10}">'
            for a, b in zip("abcdefghi", "bcdefghij", strict=True)
        )
        + "]>"
    )
    lure = '<!DOCTYPE x [<!ENTITY a SYSTEM "file:///etc/hostname">]>'
    at = data.find(b"<osm") if b"<osm" in data else data.find(b"<net")
    body = (
        data[at:]
        .replace(b'v="A', b'v="&a;', 2)
        .replace(b'id="1', draw.choice((b'id="&j;', b'id="1')), 1)
    )
    return data[:at] + draw.choice((bomb, lure)).encode() + body


def another_alphabet(data: bytes, draw: random.Random) -> bytes:
    text = data.decode(errors="replace")
    how = draw.choice(("utf-16", "utf-32", "latin-1", "cp037", "\0", "bom"))
    if how == "\0":
        return data.replace(b"\n", b"\0", 3)
    return b"\xef\xbb\xbf" + data if how == "bom" else text.encode(how, errors="replace")


def packed_badly(data: bytes, draw: random.Random) -> bytes:
    packed = gzip.compress(data, 1, mtime=0)
    return draw.choice((bits_flipped, cut_short, a_piece_lost))(packed, draw)


def another_file(data: bytes, draw: random.Random) -> bytes:
    return draw.choice(
        (
            b"",
            b" ",
            b"<",
            b"<osm/>",
            b"<net/>",
            b"{}",
            b"\x1f\x8b",
            b"BZh9",
            b"PK\x03\x04",
            b"\x00" * 500,
            data[::-1],
            b"<osm>" + b" " * 3_000_000 + b"</osm>",
            b"<net>" + data + b"</net>",
            data + data,
            b"GIF89a" + data,
        )
    )


DAMAGES: tuple[Callable[[bytes, random.Random], bytes], ...] = (
    bits_flipped,
    cut_short,
    a_piece_lost,
    elements_dropped,
    elements_doubled,
    elements_swapped,
    absurd_values,
    every_value_absurd,
    attributes_dropped,
    wrong_references,
    ids_exchanged,
    coordinates_gone,
    absurd_streets,
    nested_deep,
    comments_gone,
    entities,
    another_alphabet,
    packed_badly,
    another_file,
)


def damaged(data: bytes, number: int) -> tuple[str, bytes]:
    """Return the kind of damage of this number and the damaged map: kinds take turns, and the rest
    is drawn from the number."""
    draw = random.Random(number)
    damage = DAMAGES[number % len(DAMAGES)]
    return damage.__name__, damage(data, draw)


def _some(pattern: re.Pattern[bytes], data: bytes, draw: random.Random) -> list[re.Match[bytes]]:
    places = list(pattern.finditer(data))
    return sorted(
        draw.sample(places, min(len(places), draw.randint(1, 12))), key=lambda place: place.start()
    )


def _changed(
    data: bytes,
    draw: random.Random,
    value: Callable[[bytes, bytes], bytes],
    names: tuple[bytes, ...] = (),
) -> bytes:
    """Give a few attributes, of these names or of any, other values."""
    places = [place for place in ATTRIBUTE.finditer(data) if not names or place[1] in names]
    for place in sorted(
        draw.sample(places, min(len(places), draw.randint(1, 8))), key=lambda p: -p.start()
    ):
        data = data[: place.start(2)] + value(place[1], place[2]) + data[place.end(2) :]
    return data
