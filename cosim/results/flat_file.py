"""Serialize a struct with embedded structs as one flat JSON object."""

from __future__ import annotations

import typing
from collections.abc import Callable, Mapping
from operator import attrgetter
from typing import Any, Generic, TypeVar

import msgspec

_T = TypeVar("_T")


class FlatFile(Generic[_T]):
    """Flat JSON layout of a struct: the fields of the embedded `parts` are keys of the file itself.

    order: keys in file order; a field name, or `KEY=PART.FIELD` if the key differs. Other fields
        follow
    without: fields, as `PART.FIELD`, that the file omits
    defaults: values of optional keys, if the field has another default or none
    fault: function that returns the first fault in a decoded struct, or ""

    `keys` maps each key of the file to `PART.FIELD`, or to `FIELD` of the struct itself.
    """

    def __init__(
        self,
        whole: type[_T],
        parts: Mapping[str, type],
        order: str,
        without: str = "",
        defaults: Mapping[str, Any] | None = None,
        fault: Callable[[_T], str] = lambda _: "",
    ) -> None:
        self._whole = whole
        self._fault = fault
        self._parts = parts
        fields: dict[str, tuple[Any, Any]] = {}
        for part, kind in {"": whole, **parts}.items():
            types = typing.get_type_hints(kind, include_extras=True)
            for field in msgspec.inspect.type_info(kind).fields:  # type: ignore[attr-defined]
                default = msgspec.field(
                    default=field.default, default_factory=field.default_factory
                )  # type: ignore[call-overload]
                fields[f"{part}.{field.name}".lstrip(".")] = types[field.name], default
        paths = [path for path in fields if path not in {*without.split(), *parts}]
        own = {path.rpartition(".")[2]: path for path in paths}
        self.keys = {
            name: path or own[name]
            for name, _, path in (word.partition("=") for word in order.split())
        }
        listed = set(self.keys.values())
        self.keys |= {name: path for name, path in own.items() if path not in listed}
        if len(self.keys) < len(paths):
            raise ValueError(
                f"two fields of {whole.__name__} have one name: list them as KEY=PART.FIELD"
            )
        of_key = {name: (name, *fields[path]) for name, path in self.keys.items()}
        of_key |= {name: (*of_key[name][:2], default) for name, default in (defaults or {}).items()}
        self._shape = msgspec.defstruct(f"{whole.__name__}File", of_key.values(), kw_only=True)

    def flat(self, value: _T) -> dict[str, Any]:
        """Return the values of a struct by file key, in file order."""
        return {name: attrgetter(path)(value) for name, path in self.keys.items()}

    def encode(self, value: _T) -> bytes:
        """Return the JSON of a struct in one line."""
        return msgspec.json.encode(self.flat(value))

    def encode_indented(self, value: _T) -> bytes:
        """Return the indented JSON of a struct, as its file holds it."""
        return msgspec.json.format(self.encode(value), indent=1) + b"\n"

    def decode(self, data: bytes | str) -> _T:
        """Decode the JSON of a file. Raises msgspec.DecodeError, naming the key."""
        read = msgspec.json.decode(data, type=self._shape)
        found: dict[str, dict[str, Any]] = {part: {} for part in ("", *self._parts)}
        for name, path in self.keys.items():
            part, _, field = path.rpartition(".")
            found[part][field] = getattr(read, name)
        value = self._whole(
            **found[""], **{part: kind(**found[part]) for part, kind in self._parts.items()}
        )
        if fault := self._fault(value):
            raise msgspec.ValidationError(fault)
        return value
