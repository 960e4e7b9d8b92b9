"""Checks of configuration values, and the error that they raise."""

import typing
from collections.abc import Callable
from typing import Any, Literal


class ConfigError(ValueError):
    """A configuration value that cannot be used: what was got, what is expected."""


def require(condition: bool, name: str, got: object, expected: str) -> None:
    """Raise ConfigError unless the condition holds."""
    if not condition:
        raise ConfigError(f"{name}: got {got!r}, expected {expected}")


def require_fields(
    config: object, names: str, fits: Callable[[Any], bool], expected: str
) -> None:
    """Raise ConfigError unless each of the fields, named side by side, fits."""
    for name in names.split():
        value = getattr(config, name)
        require(fits(value), name, value, expected)


def require_choices(config: object) -> None:
    """Raise ConfigError unless the fields of Literal types have one of their values."""
    for name, hint in typing.get_type_hints(type(config)).items():
        if typing.get_origin(hint) is Literal:
            choices = typing.get_args(hint)
            expected = "one of " + ", ".join(map(repr, choices))
            require_fields(config, name, choices.__contains__, expected)
