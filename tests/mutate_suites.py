"""Suite files as an enemy writes them: a sound one, changed in one to four places, from a seed.

    python -m tests.mutate_suites --run 200

drives as many of those that are accepted for two simulated seconds each, in this process, and prints what came of it.
"""

from __future__ import annotations

import copy
import json
import math
from collections.abc import Callable, Iterator, Sequence
from random import Random
from typing import Any, Final

Tree = dict[str, Any]

NUMBERS: Final = (
    math.nan, math.inf, -math.inf, 1e308, -1e308, 9e18, 1e9, -1e9, 1e-320, 0, -1, 2**31, 2**63, -(2**63), 10**30,
    10**400, -0.0, 0.5, 3.7, 41,
)  # fmt: skip
WORDS: Final = (
    "", "../../x", "/etc/passwd", "a\nb", "\x1b[31mred", "\x00", "[/x]", "[red]", "\u202e", "\ud800", "e" * 5000,
    "-x", ".x",
    "a b", "e0", "Ünïcode", "%s", "{0}", "nan", "city", "map", "stop", "frontal", "gesturing", "queueing",
)  # fmt: skip
SCRAPS: Final = (b"null", b"NaN", b"1e999", b"9" * 5000, b'"', b"\\", b",,", b"\x00")
JUNK: Final = (None, True, False, [], {}, [[]], {"a": {"b": [1, {"c": None}]}}, [1, 2, 3], [0.0] * 400, "text", 7)


def mutated(whole: Tree, seed: int) -> bytes:
    """The file of a suite, changed; the same for the same seed."""
    rng = Random(seed)
    tree = copy.deepcopy(whole)
    tree = {**tree, "scenarios": rng.sample(tree["scenarios"], k=rng.randint(1, len(tree["scenarios"])))}
    if rng.random() < 0.3:
        return _bytes_changed(json.dumps(tree).encode(), rng)
    for _ in range(rng.choice((1, 1, 1, 2, 3, 4))):
        _change(tree, rng)
    return json.dumps(tree).encode()


def _change(tree: Tree, rng: Random) -> None:
    """Change one value or one field of a tree, in place."""
    holder, key = rng.choice(list(_places(tree)))
    change = rng.choice((_nudge, _nudge, _nudge, _number, _number, _word, _junk, _drop, _rename, _double, _swap))
    change(holder, key, rng)


def _places(tree: Any) -> Iterator[tuple[Any, Any]]:
    """Every (holder, key) of a tree; of a long list the first and the last items."""
    keys: Sequence[Any] = list(tree) if isinstance(tree, dict) else range(len(tree)) if isinstance(tree, list) else ()
    for key in keys if len(keys) < 8 or isinstance(tree, dict) else [0, 1, len(keys) - 1]:
        yield tree, key
        yield from _places(tree[key])


def _nudge(holder: Any, key: Any, rng: Random) -> None:
    value = holder[key]
    if isinstance(value, bool):
        holder[key] = not value
    elif isinstance(value, int):
        holder[key] = value + rng.randint(-3, 3)
    elif isinstance(value, float):
        holder[key] = value * rng.uniform(0.5, 1.5) if rng.random() < 0.5 else value + rng.uniform(-1.0, 1.0)
    elif isinstance(value, str):
        holder[key] = value + rng.choice("ab01-_")
    elif isinstance(value, list) and value and rng.random() < 0.5:
        value.pop(rng.randrange(len(value)))


def _number(holder: Any, key: Any, rng: Random) -> None:
    numbers = [(holder, key)]
    numbers += [(h, k) for h, k in _places(holder[key]) if isinstance(h[k], int | float)]
    holder, key = rng.choice(numbers)
    holder[key] = rng.choice(NUMBERS)


def _word(holder: Any, key: Any, rng: Random) -> None:
    holder[key] = rng.choice(WORDS)


def _junk(holder: Any, key: Any, rng: Random) -> None:
    holder[key] = copy.deepcopy(rng.choice(JUNK))


def _drop(holder: Any, key: Any, rng: Random) -> None:
    del holder[key]


def _rename(holder: Any, key: Any, rng: Random) -> None:
    if isinstance(holder, dict):
        holder[rng.choice((key + "s", key[:-1], key.upper(), *WORDS))] = holder.pop(key)


def _double(holder: Any, key: Any, rng: Random) -> None:
    if isinstance(holder, list):
        holder.insert(key, copy.deepcopy(holder[key]))


def _swap(holder: Any, key: Any, rng: Random) -> None:
    other = rng.choice(list(holder) if isinstance(holder, dict) else range(len(holder)))
    holder[key], holder[other] = holder[other], holder[key]


def _bytes_changed(data: bytes, rng: Random) -> bytes:
    """A file that is damaged as bytes are."""
    at, to = sorted(rng.randrange(len(data)) for _ in range(2))
    deep = rng.choice((b"[", b'{"a":', b'{"scenarios":[')) * 100_000
    noise = rng.randbytes(rng.randint(1, 40))
    changes: tuple[Callable[[], bytes], ...] = (
        lambda: data[:at],
        lambda: data[:at] + data[to:],
        lambda: data[:at] + noise + data[at:],
        lambda: data[:at] + b"\xff\xfe" + data[at:],
        lambda: (
            data[:at] + rng.choice((b"null", b"NaN", b"1e999", b"9" * 5000, b'"', b"\\", b",,", b"\x00")) + data[at:]
        ),
        lambda: deep,
        lambda: data[:at] + deep + data[at:],
        lambda: data.replace(b'"seed": 0', b'"seed": 0, "seed": 1, "seed": "x"'),
        lambda: data.replace(b'"place": ', b'"place": ' + deep, 1),
        lambda: data.replace(b"[", b" " * 100_000 + b"[", 1),
        lambda: data.decode().encode("utf-16"),
        lambda: b"\xef\xbb\xbf" + data,
        lambda: rng.choice((b"", b"null", b"3", b"[]", b"{}", b'"suite"', data + data, b"[" + data + b"]")),
        lambda: rng.randbytes(200),
    )
    return rng.choice(changes)()
