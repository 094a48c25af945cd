"""Malicious suite files: a valid file, changed in one to four places, from a seed. Usage: python -m
tests.support.mutate_suites --drive 200. It continues until so many files were accepted and driven
for two simulated seconds each, and prints the outcomes."""

from __future__ import annotations

import argparse
import copy
import json
import math
import tempfile
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from itertools import count
from pathlib import Path
from random import Random
from typing import Any, Final, Literal, NamedTuple

import msgspec

from cosim.core.errors import SpecError
from cosim.core.state import Command
from cosim.episode.interfaces import Observation
from cosim.spec.manifest import Manifest
from cosim.spec.scenario import City, CrowdSpec, Scenario, Suite, read_suite
from scenarios.events import EVENT_KINDS

Tree = dict[str, Any]

DRIVEN_S: Final = 2.0

NUMBERS: Final = (
    math.nan,
    math.inf,
    -math.inf,
    1e308,
    -1e308,
    9e18,
    1e9,
    -1e9,
    1e-320,
    0,
    -1,
    2**31,
    2**63,
    -(2**63),
    10**30,
    10**400,
    -0.0,
    0.5,
    3.7,
    41,
    1e-9,
    0.01,
    0.1,
    1,
    2,
    3,
    5,
    10,
    20,
    24,
    50,
    60,
    90,
    150,
    200,
    300,
    366,
    500,
    1000,
    3600,
    50_000,
    2**32 - 1,
)
"""Invalid numbers, and the ends of the valid ranges of fields."""
WORDS: Final = (
    "",
    "../../x",
    "/etc/passwd",
    "a\nb",
    "\x1b[31mred",
    "\x00",
    "[/x]",
    "[red]",
    "\u202e",
    "\ud800",
    "e" * 5000,
    "-x",
    ".x",
    "a b",
    "e0",
    "Ünïcode",
    "%s",
    "{0}",
    "nan",
    "city",
    "map",
    "stop",
    "frontal",
    "gesturing",
    "queueing",
)
JUNK: Final = (
    None,
    True,
    False,
    [],
    {},
    [[]],
    {"a": {"b": [1, {"c": None}]}},
    [1, 2, 3],
    [0.0] * 400,
    "text",
    7,
)


def mutated(suite: Tree, seed: int) -> bytes:
    """Return the file of a suite with changes; the same for the same seed."""
    rng = Random(seed)
    tree = copy.deepcopy(suite)
    tree = {
        **tree,
        "scenarios": rng.sample(tree["scenarios"], k=rng.randint(1, len(tree["scenarios"]))),
    }
    if rng.random() < 0.3:
        return _bytes_changed(json.dumps(tree).encode(), rng)
    for _ in range(rng.choice((1, 1, 1, 2, 3, 4))):
        _change(tree, rng)
    return json.dumps(tree).encode()


def _change(tree: Tree, rng: Random) -> None:
    """Change one value or one field of a tree, in place."""
    holder, key = rng.choice(list(_places(tree)))
    change = rng.choice(
        (_nudge, _nudge, _nudge, _number, _number, _word, _junk, _drop, _rename, _double, _swap)
    )
    change(holder, key, rng)


def _places(tree: Any) -> Iterator[tuple[Any, Any]]:
    """Every (holder, key) of a tree; of a long list the first and the last items."""
    keys: Sequence[Any] = (
        list(tree) if isinstance(tree, dict) else range(len(tree)) if isinstance(tree, list) else ()
    )
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
        holder[key] = (
            value * rng.uniform(0.5, 1.5) if rng.random() < 0.5 else value + rng.uniform(-1.0, 1.0)
        )
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
    """Return a file with damage at the level of bytes."""
    at, to = sorted(rng.randrange(len(data)) for _ in range(2))
    deep = rng.choice((b"[", b'{"a":', b'{"scenarios":[')) * 100_000
    noise = rng.randbytes(rng.randint(1, 40))
    changes: tuple[Callable[[], bytes], ...] = (
        lambda: data[:at],
        lambda: data[:at] + data[to:],
        lambda: data[:at] + noise + data[at:],
        lambda: data[:at] + b"\xff\xfe" + data[at:],
        lambda: (
            data[:at]
            + rng.choice((b"null", b"NaN", b"1e999", b"9" * 5000, b'"', b"\\", b",,", b"\x00"))
            + data[at:]
        ),
        lambda: deep,
        lambda: data[:at] + deep + data[at:],
        lambda: data.replace(b'"seed": 0', b'"seed": 0, "seed": 1, "seed": "x"'),
        lambda: data.replace(b'"place": ', b'"place": ' + deep, 1),
        lambda: data.replace(b"[", b" " * 100_000 + b"[", 1),
        lambda: data.decode().encode("utf-16"),
        lambda: b"\xef\xbb\xbf" + data,
        lambda: rng.choice(
            (b"", b"null", b"3", b"[]", b"{}", b'"suite"', data + data, b"[" + data + b"]")
        ),
        lambda: rng.randbytes(200),
    )
    return rng.choice(changes)()


class Ahead:
    """Drives straight ahead without a camera."""

    manifest = Manifest("ahead", camera=None)

    def reset(self, scenario_id: str, seed: int) -> None:
        """Keeps no state."""

    def act(self, observation: Observation) -> Command:
        return Command(1.2, 0.0)


class Outcome(NamedTuple):
    """Outcome of a file. words: of the refusal, or why the episode crashed."""

    seed: int
    what: Literal["refused", "does not fit its place", "driven", "crashed", "raw error"]
    words: str = ""


def outcomes(suite_tree: Tree, folder: Path, seeds: Iterator[int]) -> Iterator[Outcome]:
    """Yield the outcome of each file; of an accepted one the first changed scenario is driven."""
    from scenarios.suites.fits import check_places

    unchanged = msgspec.convert(suite_tree, Suite).scenarios
    path = folder / "mutated.json"
    for seed in seeds:
        path.write_bytes(mutated(suite_tree, seed))
        try:
            suite = read_suite(path, EVENT_KINDS)
        except SpecError as error:
            yield Outcome(seed, "refused", str(error))
            continue
        try:
            check_places(suite, suite.scenarios)
        except SpecError as error:
            yield Outcome(seed, "does not fit its place", str(error))
            continue
        yield _driven(
            next((s for s in suite.scenarios if s not in unchanged), suite.scenarios[0]), seed
        )


def _driven(scenario: Scenario, seed: int) -> Outcome:
    from scenarios.episodes.run_episode import run_episode

    outcome = run_episode(msgspec.structs.replace(scenario, time_limit_s=DRIVEN_S), Ahead())
    record = outcome.record
    if record.status != "crashed":
        return Outcome(seed, "driven", record.state_hash)
    raw = record.reason.partition(":")[0].isidentifier()
    return Outcome(seed, "raw error" if raw else "crashed", f"{record.reason}\n{outcome.traceback}")


def small_suite(city: City) -> Tree:
    """Return the file of a suite in a small city: a long way, and short ones with people who talk,
    cross and stop the robot."""
    from cosim.place.walk_graph import WalkGraph
    from scenarios.places.nets import place
    from scenarios.suites import long_horizon, reactive

    _, street_map = place(city)
    graph = WalkGraph(street_map)
    kinds = ("conversing", "ped_crossing", "gesturing")
    drawn = [long_horizon.build_long_horizon(city, street_map, graph, 1, "long")]
    drawn += [
        reactive.build_reactive(EVENT_KINDS[kind], city, street_map, graph, 1, kind)
        for kind in kinds
    ]
    few = CrowdSpec(persons=6, radius_m=40.0, vehicles=2)
    scenarios = [msgspec.structs.replace(s, crowd=few) for s in drawn]
    return json.loads(
        msgspec.json.encode(Suite(name="small", version="1", scenarios=tuple(scenarios)))
    )  # type: ignore[no-any-return]


def main() -> None:
    """Drive the requested number of accepted files. Exit code 1 if any crashed."""
    parser = argparse.ArgumentParser(prog="python -m tests.support.mutate_suites")
    parser.add_argument("--drive", type=int, default=200, help="how many accepted ones are driven")
    parser.add_argument("--from-seed", type=int, default=0)
    asked = parser.parse_args()
    seen: Counter[str] = Counter()
    with tempfile.TemporaryDirectory() as folder:
        for fate in outcomes(
            small_suite(City(seed=1, size_m=500.0)), Path(folder), count(asked.from_seed)
        ):
            seen[fate.what] += 1
            if fate.what in ("crashed", "raw error"):
                print(f"seed {fate.seed}: {fate.what}: {fate.words}", flush=True)
            if sum(seen[what] for what in ("driven", "crashed", "raw error")) >= asked.drive:
                break
            if sum(seen.values()) % 100 == 0:
                print(dict(seen), flush=True)
    print(dict(seen))
    raise SystemExit(1 if seen["raw error"] + seen["crashed"] else 0)


if __name__ == "__main__":
    main()
