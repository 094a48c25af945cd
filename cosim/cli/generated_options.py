"""Generate the options of a command from the fields of a config (`cosim.spec.run_config`)."""

from __future__ import annotations

import dataclasses
import inspect
from collections.abc import Callable, Collection, Iterator, Mapping
from functools import wraps
from types import MappingProxyType
from typing import Annotated, Any, NamedTuple, get_type_hints

import typer
from typer.core import TyperCommand

from cosim.spec.run_config import Option, RunConfig, annotations_of, option_of

_NOTHING: Mapping[str, Any] = MappingProxyType({})


class Fields(NamedTuple):
    """Selection of config fields that become options of a command, with overrides.

    only: names of the fields; () for all.
    without: names of fields that keep their defaults and are no options.
    hidden: names of options that the help does not show.
    help, default, flag: replacements of the field's own values, by field name.
    required: names of fields that have no default here.
    panels: whether the help groups the options.
    """

    only: Collection[str] = ()
    without: Collection[str] = ()
    hidden: Collection[str] = ()
    help: Mapping[str, str] = _NOTHING
    default: Mapping[str, Any] = _NOTHING
    flag: Mapping[str, str] = _NOTHING
    required: Collection[str] = ()
    panels: bool = False


class ConfiguredCommand(TyperCommand):
    """Command of a `RunConfig` whose options with a bare value may be named without one."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        options = {
            one.name: option_of(RunConfig, one.name) for one in dataclasses.fields(RunConfig)
        }
        bare = {_flag(name, one): one.bare for name, one in options.items() if one.bare}
        return super().parse_args(ctx, [f"{a}={bare[a]}" if a in bare else a for a in args])


def configured(command: Callable[..., None]) -> Callable[..., None]:
    """Replace a command's parameter `Annotated[Config, Fields(...)]` by options of that config."""
    hints = get_type_hints(command, include_extras=True)
    configs = {
        name: (hint.__origin__, fields)
        for name, hint in hints.items()
        for fields in getattr(hint, "__metadata__", ())
        if isinstance(fields, Fields)
    }

    @wraps(command)
    def expanded(**given: Any) -> None:
        for name, (config, fields) in configs.items():
            taken = {field.name: given.pop(field.name) for field in _option_fields(config, fields)}
            given[name] = config(
                **{field: _as_field_value(value, config, field) for field, value in taken.items()}
            )
        command(**given)

    parameters: list[inspect.Parameter] = []
    for name, one in inspect.signature(command).parameters.items():
        if name in configs:
            parameters += _parameters(*configs[name])
        else:
            parameters.append(
                one.replace(kind=inspect.Parameter.KEYWORD_ONLY, annotation=hints[name])
            )
    expanded.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
    expanded.__annotations__ = {one.name: one.annotation for one in parameters} | {"return": None}
    return expanded


def _option_fields(config: Any, fields: Fields) -> Iterator[dataclasses.Field[Any]]:
    """Yield the fields of a config that are options of the command."""
    for field in dataclasses.fields(config):
        if field.name not in fields.without and (not fields.only or field.name in fields.only):
            yield field


def _as_field_value(value: Any, config: Any, field: str) -> Any:
    """Return the value of an option as its field stores it: repeatable options as a tuple."""
    several = annotations_of(config)[field].__origin__ == tuple[str, ...]
    return tuple(value or ()) if several else value


def _parameters(config: Any, fields: Fields) -> Iterator[inspect.Parameter]:
    hints = annotations_of(config)
    for field in _option_fields(config, fields):
        kind = hints[field.name].__origin__
        option = hints[field.name].__metadata__[0]
        several = kind == tuple[str, ...]
        default = fields.default.get(field.name, None if several else field.default)
        if option.argument or field.name in fields.required:
            default = inspect.Parameter.empty
            kind = _without_none(kind)
        yield inspect.Parameter(
            field.name,
            inspect.Parameter.KEYWORD_ONLY,
            default=default,
            annotation=Annotated[
                list[str] | None if several else kind,
                _typer_parameter(field.name, kind, option, fields),
            ],
        )


def _flag(name: str, option: Option) -> str:
    """Return the name of a field's option on the command line."""
    return option.flag or f"--{name.replace('_', '-')}"


def _without_none(kind: Any) -> Any:
    """Return the type of a required option: `T` for `T | None`."""
    parts = [part for part in getattr(kind, "__args__", ()) if part is not type(None)]
    return parts[0] if len(parts) == 1 else kind


def _typer_parameter(name: str, kind: Any, option: Option, fields: Fields) -> Any:
    """Return typer's option or argument of a field."""
    words = fields.help.get(name, option.help)
    if option.argument:
        return typer.Argument(help=words, metavar=option.metavar)
    flag = fields.flag.get(name) or _flag(name, option)
    own_default = name in fields.default or name in fields.required
    return typer.Option(
        flag,
        help=words,
        metavar=option.metavar,
        min=option.least,
        max=option.most,
        show_default=True if own_default or not option.default else option.default,
        hidden=name in fields.hidden,
        rich_help_panel=option.panel or None if fields.panels else None,
    )
