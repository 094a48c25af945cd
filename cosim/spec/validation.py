"""Ranges of the fields of a spec, declared where the field is, and the check of all of them at
once.

class Fence(Ranged, frozen=True, kw_only=True):
    length_m: Annotated[float, Within(0.1, 100)]

Fence(length_m=9e18)    # SpecError: fence length_m must be in [0.1, 100], not 9e+18
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Sequence
from functools import cache
from itertools import chain
from typing import Any, Final, NamedTuple, Protocol, get_type_hints

import msgspec

from cosim.core.errors import SpecError

_NAME: Final = re.compile(r"[A-Za-z0-9_][A-Za-z0-9._-]{0,99}")
MOST_SHOWN: Final = 60
"""Letters of a value that a message repeats."""


class Rule(Protocol):
    """What the value of a field must be."""

    def refusal(self, field: str, value: Any) -> str:
        """What is wrong with a value, a sentence that begins with the field's name; "" if nothing
        is."""


class Within(NamedTuple):
    """A finite number from low to high, both included unless `above`: then low itself is out of
    range."""

    low: float
    high: float
    above: bool = False
    words: str = "must be in {range}, not {value}"

    def refusal(self, field: str, value: float) -> str:
        if self.low <= value <= self.high and not (self.above and value == self.low):
            return ""
        return f"{field} {self.words.format(range=self, value=_in_few_digits(value))}"

    def __str__(self) -> str:
        low, high = (str(end) if isinstance(end, int) else f"{end:g}" for end in self[:2])
        return f"{'(' if self.above else '['}{low}, {high}]"


class Points(NamedTuple):
    """Points whose coordinates are finite numbers from low to high."""

    low: float
    high: float

    def refusal(self, field: str, value: Sequence[Sequence[float]]) -> str:
        if all(self.low <= number <= self.high for number in chain.from_iterable(value)):
            return ""
        number = Within(*self)
        told = (
            number.refusal(f"{field}[{i}][{k}]", x)
            for i, point in enumerate(value)
            for k, x in enumerate(point)
        )
        return next(filter(None, told))


class Counted(NamedTuple):
    """How many items there may be."""

    fewest: int
    most: int

    def refusal(self, field: str, value: Sequence[object]) -> str:
        if self.fewest <= len(value) <= self.most:
            return ""
        return f"{field} must hold {self.fewest} to {self.most}, not {len(value)}"


class Text(NamedTuple):
    """Words on one line, of so many letters at most."""

    most: int

    def refusal(self, field: str, value: str) -> str:
        if len(value) <= self.most and value.isprintable():
            return ""
        return (
            f"{field} must be at most {self.most} letters and no control characters, not "
            f"{shown(value)}"
        )


class Named(NamedTuple):
    """A name that can stand in paths and keys. what: it names."""

    what: str

    def refusal(self, field: str, value: str) -> str:
        if _NAME.fullmatch(value):
            return ""
        return (
            f"{field} {shown(value)} cannot name {self.what}: use 1 to 100 of A-Z a-z 0-9 . _ -, "
            f"no . or - in front"
        )


WHERE_M: Final = Within(-10_000_000, 10_000_000)
"""A coordinate; on maps that keep those of their UTM zone they are millions."""
HEADING_RAD: Final = Within(-2 * math.pi, 2 * math.pi)
ALONG_M: Final = Within(0, 20_000)
"""An arc length of a route."""
SEED: Final = Within(0, 2**32 - 1)


class Ranged(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A spec whose fields keep their ranges and do not contradict each other.

    Raises SpecError with every field that is out of its range; where none is, with every
    contradiction.
    """

    def __post_init__(self) -> None:
        faults = self._out_of_range() or [*filter(None, self.contradictions())]
        if faults:
            raise SpecError("; ".join(faults))

    def _out_of_range(self) -> list[str]:
        told = (
            refusal_of(field, rule, getattr(self, field)) for field, rule in rules_of(type(self))
        )
        return [self.called + refusal for refusal in told if refusal]

    @property
    def called(self) -> str:
        """What comes before a field's name in a message."""
        return f"{type(self).__name__.lower()} "

    def contradictions(self) -> Iterator[str]:
        """What fields in their ranges may not be together, one message each; "" is none."""
        return iter(())


@cache
def rules_of(kind: type[Ranged]) -> tuple[tuple[str, Rule], ...]:
    """The rules of a spec, field by field, in the order of the fields."""
    hints = get_type_hints(kind, include_extras=True)
    return tuple(
        (name, rule)
        for name in kind.__struct_fields__
        for rule in getattr(hints[name], "__metadata__", ())
    )


def refusal_of(field: str, rule: Rule, value: Any) -> str:
    """What a rule says of the value of a field; nothing where none is given."""
    return "" if value is None else rule.refusal(field, value)


def shown(value: object) -> str:
    """A value as messages repeat it: on one line, quoted if it is text, cut if it is long."""
    return (
        f"'{printable(value, MOST_SHOWN)}'"
        if isinstance(value, str)
        else printable(repr(value), MOST_SHOWN)
    )


def printable(text: str, most: int) -> str:
    """Text on one line, cut to so many letters: what would end a line, steer a terminal or cannot
    be encoded is written as an escape."""
    line = (
        text
        if text.isprintable()
        else "".join(c if c.isprintable() else ascii(c)[1:-1] for c in text)
    )
    return line if len(line) <= most else f"{line[:most]}..."


def _in_few_digits(value: float) -> float:
    """A number that can be written in a few digits: a whole one that is huge as a power of ten, or
    as infinite."""
    try:
        return value if abs(value) < 10**18 else float(value)
    except OverflowError:
        return math.inf if value > 0 else -math.inf
