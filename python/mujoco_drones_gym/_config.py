"""Option classes: validation by the simulator, and the names that the paper's package gives their fields."""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

from mujoco_drones_gym import _native


def _same(value: Any) -> Any:
    return value


class Alias(NamedTuple):
    """Another name of a field, with the conversions from the value of the alias and back."""

    field: str
    to_field: Callable[[Any], Any] = _same
    from_field: Callable[[Any], Any] = _same


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
            plain(self, *args, **translated(cls.__name__, kwargs, aliases))

        cls.__init__ = __init__
        for name, alias in aliases.items():
            setattr(cls, name, _property(name, alias))
        return cls

    return decorate


def _property(name: str, alias: Alias) -> property:
    def get(self):
        return alias.from_field(getattr(self, alias.field))

    def set_(self, value):
        setattr(self, alias.field, alias.to_field(value))

    return property(get, set_, doc=f"Another name of `{alias.field}`.")


def translated(owner: str, given: Mapping[str, Any], aliases: Mapping[str, Alias]) -> dict[str, Any]:
    """Replaces aliases among keywords by the fields that they name."""
    fields = {name: value for name, value in given.items() if name not in aliases}
    for name, value in given.items():
        if name not in aliases:
            continue
        alias = aliases[name]
        if alias.field in fields:
            raise TypeError(f"{owner} got {name} and another name of {alias.field}, expected one of them")
        try:
            fields[alias.field] = alias.to_field(value)
        except (TypeError, ValueError):
            raise ValueError(f"{name} is {value!r}, expected a value as for {alias.field}") from None
    return fields


def complete(section: str, options: Mapping[str, Any], names: Mapping[str, str] | None = None) -> dict[str, Any]:
    """Validates the options of a section and adds the defaults of missing options.

    `names` maps the options to the names of fields, which errors then mention.
    """
    try:
        return _native.complete_options(section, dict(options))
    except ValueError as error:
        message = str(error)
        matches = [option for option in names or () if option in message]
        if not matches:
            raise
        # the first option in the message, and the longest of several with the same start
        option = min(matches, key=lambda option: (message.index(option), -len(option)))
        field = names[option]
        if field == option:
            raise
        raise ValueError(f"{field}: {message}") from None
