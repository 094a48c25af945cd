"""Commands that take the options of another one."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Collection
from copy import copy
from typing import Annotated, Any, TypeVar, get_type_hints

_F = TypeVar("_F", bound=Callable[..., Any])


def taking(like: Callable[..., Any], *, without: Collection[str], hidden: Collection[str] = ()) -> Callable[[_F], _F]:
    """Decorate a command that takes `**asked`: typer gives it the options of `like` there, but for some. hidden: those
    that its help does not show."""

    def decorated(command: _F) -> _F:
        mine, others = inspect.signature(command), inspect.signature(like)
        named = [one for one in mine.parameters.values() if one.kind is not inspect.Parameter.VAR_KEYWORD]
        named += [one for name, one in others.parameters.items() if name not in without]
        types = get_type_hints(like, include_extras=True) | get_type_hints(command, include_extras=True)
        types |= {name: _unshown(types[name]) for name in hidden}
        command.__annotations__ = {one.name: types[one.name] for one in named} | {"return": None}
        only = [one.replace(kind=inspect.Parameter.KEYWORD_ONLY, annotation=types[one.name]) for one in named]
        command.__signature__ = inspect.Signature(only)  # type: ignore[attr-defined]
        return command

    return decorated


def _unshown(annotated: Any) -> Any:
    """The type of an option, not shown in help."""
    option = copy(annotated.__metadata__[0])
    option.hidden = True
    return Annotated[annotated.__origin__, option]
