"""Declarative ranges of the fields of a spec, checked together.

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
"""Names that are valid in paths and keys."""
MAX_SHOWN: Final = 60
"""Maximum length of a value in a message, in characters."""


class Rule(Protocol):
    """Rule for the value of a field."""

    def refusal(self, field: str, value: Any) -> str:
        """Return the error of a value as a sentence that starts with the field's name; "" if it is
        valid."""


class Within(NamedTuple):
    """Finite number from low to high, both included. `above` excludes low."""

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
    """Points with finite coordinates from low to high."""

    low: float
    high: float

    def refusal(self, field: str, value: Sequence[Sequence[float]]) -> str:
        if all(self.low <= number <= self.high for number in chain.from_iterable(value)):
            return ""
        number = Within(*self)
        refusals = (
            number.refusal(f"{field}[{i}][{k}]", x)
            for i, point in enumerate(value)
            for k, x in enumerate(point)
        )
        return next(filter(None, refusals))


class ItemCount(NamedTuple):
    """Range of the number of items."""

    fewest: int
    most: int

    def refusal(self, field: str, value: Sequence[object]) -> str:
        if self.fewest <= len(value) <= self.most:
            return ""
        return f"{field} must hold {self.fewest} to {self.most}, not {len(value)}"


class Text(NamedTuple):
    """One line of text with a maximum length in characters."""

    most: int

    def refusal(self, field: str, value: str) -> str:
        if len(value) <= self.most and value.isprintable():
            return ""
        return (
            f"{field} must be at most {self.most} letters and no control characters, not "
            f"{shown(value)}"
        )


class PathName(NamedTuple):
    """Name that is valid in paths and keys.

    what: thing that it names, for the message.
    """

    what: str

    def refusal(self, field: str, value: str) -> str:
        if _NAME.fullmatch(value):
            return ""
        return (
            f"{field} {shown(value)} cannot name {self.what}: use 1 to 100 of A-Z a-z 0-9 . _ -, "
            f"no . or - in front"
        )


COORDINATE_M: Final = Within(-10_000_000, 10_000_000)
"""Range of a coordinate in metres. On maps in UTM coordinates they are millions."""
HEADING_RAD: Final = Within(-2 * math.pi, 2 * math.pi)
"""Range of a heading in radians."""
ARC_LENGTH_M: Final = Within(0, 20_000)
"""Range of an arc length of a route in metres."""
SEED: Final = Within(0, 2**32 - 1)
"""Range of a scenario's seed."""


class Ranged(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Base class of specs with ranges and consistency checks.

    Raises SpecError with every field out of range or, if there are none, with every contradiction.
    """

    def __post_init__(self) -> None:
        faults = self._out_of_range() or [*filter(None, self.contradictions())]
        if faults:
            raise SpecError("; ".join(faults))

    def _out_of_range(self) -> list[str]:
        refusals = (
            field_error(field, rule, getattr(self, field)) for field, rule in rules_of(type(self))
        )
        return [self.prefix + refusal for refusal in refusals if refusal]

    @property
    def prefix(self) -> str:
        """Prefix of field names in messages."""
        return f"{type(self).__name__.lower()} "

    def contradictions(self) -> Iterator[str]:
        """Yield an error for each contradiction between valid fields; "" is ignored."""
        return iter(())


@cache
def rules_of(kind: type[Ranged]) -> tuple[tuple[str, Rule], ...]:
    """Return the rules of a spec's fields, in the order of the fields."""
    hints = get_type_hints(kind, include_extras=True)
    return tuple(
        (name, rule)
        for name in kind.__struct_fields__
        for rule in getattr(hints[name], "__metadata__", ())
    )


def field_error(field: str, rule: Rule, value: Any) -> str:
    """Return the error of a field's value; "" if it is valid or None."""
    return "" if value is None else rule.refusal(field, value)


def shown(value: object) -> str:
    """Return a value for a message: on one line, quoted if it is text, cut if it is long."""
    return (
        f"'{one_line(value, MAX_SHOWN)}'"
        if isinstance(value, str)
        else one_line(repr(value), MAX_SHOWN)
    )


def one_line(text: str, most: int) -> str:
    """Return text on one line, cut to `most` characters, with unprintable ones escaped."""
    line = (
        text
        if text.isprintable()
        else "".join(c if c.isprintable() else ascii(c)[1:-1] for c in text)
    )
    return line if len(line) <= most else f"{line[:most]}..."


def _in_few_digits(value: float) -> float:
    """Convert a huge integer to a float, so that few digits are printed."""
    try:
        return value if abs(value) < 10**18 else float(value)
    except OverflowError:
        return math.inf if value > 0 else -math.inf
