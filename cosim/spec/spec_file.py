"""Load specs from JSON files, or report all their errors with their places in the file."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Sequence
from contextlib import suppress
from itertools import islice
from pathlib import Path
from types import NoneType, UnionType
from typing import Annotated, Any, Final, Literal, TypeVar, Union, get_args, get_origin

import msgspec

from cosim.core.errors import SpecError, nearest
from cosim.spec.validation import MAX_SHOWN, Ranged, field_error, one_line, rules_of, shown

MAX_BYTES: Final = 1_000_000_000
"""Maximum size of a file in bytes."""
MAX_LISTED_FAULTS: Final = 5
"""Maximum number of errors that a message lists."""
MAX_COUNTED: Final = 1000
"""Maximum number of errors that are counted."""
MAX_FAULT_LETTERS: Final = 400
"""Maximum length of one error in characters."""
_PLACE: Final = re.compile(r" - at `(key in )?\$[^`]*`$")
"""Place that msgspec appends to an error."""
_BYTE: Final = re.compile(r" \(byte (\d+)\)$")
"""Offset that msgspec appends to a syntax error."""
_REFUSED: Final = (msgspec.DecodeError, ValueError, RecursionError)
"""Exceptions of a decoder that refuses a file."""

Spec = TypeVar("Spec", bound=msgspec.Struct)


def read_spec_file(path: Path, kind: type[Spec]) -> Spec:
    """Load the spec of a JSON file.

    Raises SpecError with the file, and the place and valid values of each error, one a line. At
    most MAX_LISTED_FAULTS errors are listed.
    """
    try:
        if path.exists() and not path.is_file():
            raise SpecError(f"{path}: is no file")
        if (size := path.stat().st_size) > MAX_BYTES:
            raise SpecError(f"{path}: holds {size} bytes; at most {MAX_BYTES} are read")
        data = path.read_bytes().removeprefix(b"\xef\xbb\xbf")
    except OSError as error:
        raise SpecError(f"{path}: cannot be read: {error.strerror}") from error
    try:
        return msgspec.json.decode(data, type=kind)
    except _REFUSED as error:
        faults = list(islice(_faults(data, kind, error), MAX_COUNTED))
        raise SpecError(f"{path}: {join_faults(faults)}") from error


def join_faults(faults: Sequence[str], most: int = MAX_LISTED_FAULTS) -> str:
    """Join errors to a message: one as it is; of several, their number and the first `most`, one a
    line."""
    if len(faults) == 1:
        return faults[0]
    count = (
        f"{len(faults)} faults" if len(faults) < MAX_COUNTED else f"{MAX_COUNTED} faults or more"
    )
    which = f"; the first {most}" if len(faults) > most else ""
    return "\n  ".join([f"{count}{which}:", *faults[:most]])


def _faults(data: bytes, kind: Any, error: Exception) -> Iterator[str]:
    """Yield every error of a file that was refused with `error`."""
    if _is_contradiction(error):
        yield f"{error} - at `$`"
        return
    try:
        # json accepts NaN and huge numbers, which msgspec refuses without naming the field.
        tree = json.loads(data)
    except (ValueError, RecursionError):
        yield _syntax_fault(data, error)
        return
    found = False
    for fault in faults_in(tree, kind, "$"):
        found = True
        yield fault
    if not found:
        yield _syntax_fault(data, error)


def _syntax_fault(data: bytes, refused: Exception) -> str:
    """Return why a file is not JSON, and where."""
    error = _syntax_error(data) or refused
    message = str(error)
    if isinstance(error, RecursionError):
        return "is nested too deep: brackets within brackets within brackets"
    if isinstance(error, UnicodeDecodeError):
        return f"is no UTF-8 text, {_position(data, _valid_utf8_bytes(data))}"
    if message == "Input data was truncated":
        return f"JSON ends too early, {_position(data, len(data))}"
    if byte := _BYTE.search(message):
        return f"{message[: byte.start()]}, {_position(data, int(byte[1]))}"
    return message if _PLACE.search(message) else f"{message} - at `$`"


def _syntax_error(data: bytes) -> Exception | None:
    """Return the JSON syntax error of a file, or None."""
    try:
        msgspec.json.decode(data)
    except _REFUSED as error:
        return error
    return None


def _valid_utf8_bytes(data: bytes) -> int:
    """Return the number of leading bytes that are valid UTF-8."""
    try:
        return len(data.decode())
    except UnicodeDecodeError as error:
        return error.start


def _position(data: bytes, byte: int) -> str:
    """Return line and byte of an offset as text."""
    lines = data[:byte].split(b"\n")
    return f"line {len(lines)}, byte {len(lines[-1])} of it"


def faults_in(tree: Any, kind: Any, place: str) -> Iterator[str]:
    """Yield every error of a value for a type: those of its parts, else its own."""
    try:
        msgspec.convert(tree, kind)
        return
    except _REFUSED as error:
        message, whole = str(error), _is_contradiction(error)
    found = False
    for fault in () if whole else _faults_below(tree, bare_type(kind, tree), place):
        found = True
        yield fault
    if found:
        yield from _out_of_range(tree, bare_type(kind, tree), place)
    else:
        if isinstance(tree, str):
            message = message.replace(f"'{tree}'", shown(tree))
        yield (
            f"{one_line(_PLACE.sub('', message), MAX_FAULT_LETTERS)} - at "
            f"`{place}`{_choices(kind, tree)}"
        )


def _is_contradiction(error: Exception) -> bool:
    """Return whether an error is a contradiction between valid parts."""
    return isinstance(error.__cause__, SpecError) and not _PLACE.search(str(error))


def _faults_below(tree: Any, kind: Any, place: str) -> Iterator[str]:
    """Yield the errors of a value's parts; none if its shape is wrong altogether."""
    if isinstance(tree, dict) and isinstance(kind, type) and issubclass(kind, msgspec.Struct):
        fields = {field.encode_name: field for field in msgspec.structs.fields(kind)}
        for name in sorted(tree.keys() - fields.keys() - {kind.__struct_config__.tag_field}):
            yield (
                f"Object contains unknown field `{one_line(name, MAX_SHOWN)}` - at "
                f"`{place}`{_listed(fields, name)}"
            )
        for name, field in fields.items():
            if name in tree:
                yield from faults_in(tree[name], field.type, f"{place}.{name}")
            elif field.required:
                yield f"Object missing required field `{name}` - at `{place}`"
    elif isinstance(tree, dict) and get_origin(kind) is dict:
        for name, item in tree.items():
            yield from faults_in(item, get_args(kind)[1], f"{place}.{one_line(name, MAX_SHOWN)}")
    elif isinstance(tree, list) and get_origin(kind) in (tuple, list):
        parts = get_args(kind) if get_origin(kind) is tuple else (*get_args(kind), ...)
        if parts[-1] is not Ellipsis and len(parts) != len(tree):
            return
        for number, item in enumerate(tree):
            part = parts[0] if parts[-1] is Ellipsis else parts[number]
            yield from faults_in(item, part, f"{place}[{number}]")


def _out_of_range(tree: Any, kind: Any, place: str) -> Iterator[str]:
    """Yield the fields of a value that are out of range. Those of a wrong type are reported
    elsewhere."""
    if not (isinstance(tree, dict) and isinstance(kind, type) and issubclass(kind, Ranged)):
        return
    types = {field.name: field.type for field in msgspec.structs.fields(kind)}
    for field, rule in rules_of(kind):
        with suppress(*_REFUSED):
            if field in tree and (
                refusal := field_error(field, rule, msgspec.convert(tree[field], types[field]))
            ):
                yield f"{refusal} - at `{place}`"


def bare_type(kind: Any, tree: Any) -> Any:
    """Return a type without its range and without None. A union of objects is resolved by the
    value's tag."""
    if get_origin(kind) is Annotated:
        return bare_type(get_args(kind)[0], tree)
    if get_origin(kind) in (Union, UnionType):
        for one in get_args(kind):
            config = getattr(one, "__struct_config__", None)
            if config is None or config.tag is None or not isinstance(tree, dict):
                continue
            if tree.get(config.tag_field) == config.tag:
                return one
        some = [one for one in get_args(kind) if one is not NoneType]
        return bare_type(some[0], tree) if len(some) == 1 else kind
    return kind


def _choices(kind: Any, tree: Any) -> str:
    """Return the valid values of a type as text, if they can be listed."""
    bare = bare_type(kind, tree)
    if get_origin(bare) is Literal:
        return _listed(get_args(bare), tree)
    if get_origin(bare) in (Union, UnionType):
        structs = [one for one in get_args(bare) if hasattr(one, "__struct_config__")]
        tag = tree.get(structs[0].__struct_config__.tag_field) if isinstance(tree, dict) else None
        return _listed([one.__struct_config__.tag for one in structs], tag)
    return ""


def _listed(valid: Any, asked: object = None) -> str:
    if not valid:
        return ""
    names = [str(one) for one in valid]
    meant = nearest(asked, names) if isinstance(asked, str) else ""
    return f". Valid choices: {', '.join(names)}" + (f".{meant}" if meant else "")
