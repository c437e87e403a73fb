"""Option classes: validation by the simulator, and the names that the paper's package gives their fields."""

from __future__ import annotations

import functools
import re
from collections.abc import Callable, Mapping
from enum import Enum
from typing import Any, NamedTuple

from mujoco_drones_gym import _native


def _same(value: Any) -> Any:
    return value


class Alias(NamedTuple):
    """Another name of a field, with the conversions from the value of the alias and back."""

    field: str
    to_field: Callable[[Any], Any] = _same
    from_field: Callable[[Any], Any] = _same
    expected: str | None = None
    """Text of errors about a value that `to_field` does not accept."""


class Fixed(NamedTuple):
    """A name of the paper's package for a setting that has one possible value here."""

    value: Any
    reason: str


def accept_aliases(aliases: Mapping[str, Alias], fixed: Mapping[str, Fixed] | None = None) -> Callable[[type], type]:
    """Makes a dataclass accept other names of its fields, as keywords and as attributes.

    It also accepts settings that are fixed, with the value that they have.
    """
    fixed = fixed or {}

    def decorate(cls: type) -> type:
        plain = cls.__init__

        @functools.wraps(plain)
        def __init__(self, *args, **kwargs):
            for name in fixed.keys() & kwargs.keys():
                value = kwargs.pop(name)
                if value is not None and value != fixed[name].value:
                    raise ValueError(f"{name} is {value!r}, expected {fixed[name].value!r}: {fixed[name].reason}")
            fields = translated(cls.__name__, kwargs, aliases)
            try:
                plain(self, *args, **fields)
            except ValueError as error:
                raise ValueError(with_aliases(str(error), kwargs, aliases)) from None

        cls.__init__ = __init__
        for name, alias in aliases.items():
            setattr(cls, name, _property(name, alias))
        return cls

    return decorate


def _property(name: str, alias: Alias) -> property:
    def get(self):
        return alias.from_field(getattr(self, alias.field))

    def set_(self, value):
        setattr(self, alias.field, _converted(name, alias, value))

    return property(get, set_, doc=f"Another name of `{alias.field}`.")


def _converted(name: str, alias: Alias, value: Any) -> Any:
    try:
        return alias.to_field(value)
    except (TypeError, ValueError, ArithmeticError):
        expected = alias.expected or f"a value as for {alias.field}"
        raise ValueError(f"{name} is {short(value)}, expected {expected}") from None


def short(value: Any) -> str:
    """Returns the text of a value in an error: one line of at most 80 characters."""
    text = " ".join(repr(value).split())
    return text if len(text) <= 80 else text[:79] + "…"


def translated(owner: str, given: Mapping[str, Any], aliases: Mapping[str, Alias]) -> dict[str, Any]:
    """Replaces aliases among keywords by the fields that they name."""
    fields = {name: value for name, value in given.items() if name not in aliases}
    for name, value in given.items():
        if name not in aliases:
            continue
        alias = aliases[name]
        if alias.field in fields:
            raise TypeError(f"{owner} got {name} and another name of {alias.field}, expected one of them")
        fields[alias.field] = _converted(name, alias, value)
    return fields


def with_aliases(message: str, given: Mapping[str, Any], aliases: Mapping[str, Alias]) -> str:
    """Returns an error about fields with the names that the user has given."""
    for name, alias in aliases.items():
        if name not in given or not re.search(rf"(?<!\w){alias.field}\b", message):
            continue
        if alias.to_field is _same:
            message = re.sub(rf"(?<![\w.])(\w+\.)?{alias.field}\b", name, message)
        elif not re.match(rf"{name}\b", message):
            message = f"{name} is {short(given[name])}: {message}"
    return message


#: Options whose values are names.
_ENUMS = ("model", "filter", "kind", "shape", "metric")


def _with_names(options: Any) -> Any:
    """Returns options whose names are strings, so that an error about a name lists the names that are possible."""
    if isinstance(options, (list, tuple)):
        return [_with_names(entry) for entry in options]
    if not isinstance(options, Mapping):
        return options
    plain = {}
    for name, value in options.items():
        if name in _ENUMS and value is not None:
            value = value.value if isinstance(value, Enum) else value
            value = value if isinstance(value, str) else short(value)
        elif name == "custom":
            value = _with_names(value)
        plain[name] = value
    return plain


def complete(section: str, options: Mapping[str, Any], names: Mapping[str, str] | None = None) -> dict[str, Any]:
    """Validates the options of a section and adds the defaults of missing options.

    `names` maps the options, as errors of the simulator name them, to the names of fields.
    """
    try:
        return _native.complete_options(section, _with_names(options))
    except ValueError as error:
        message = str(error)
        if found := re.match(rf"({section}\.(\w+) is )(sequence|map)(,.*)", message):
            message = found[1] + short(options[found[2]]) + found[4]
        # the longest of several names with the same start
        for option in sorted(names or (), key=len, reverse=True):
            message = re.sub(rf"(?<![\w.`]){re.escape(option)}(?![\w.`])", names[option], message)
        raise ValueError(message) from None
