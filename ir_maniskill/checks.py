"""Checks of configuration values, and the error that they raise."""

import typing
from typing import Any


class ConfigError(ValueError):
    """A configuration value that cannot be used: what was got, what is expected."""


def require(condition: bool, name: str, got: object, expected: str) -> None:
    """Raise ConfigError unless the condition holds."""
    if not condition:
        raise ConfigError(f"{name}: got {got!r}, expected {expected}")


def require_choice(name: str, got: str, annotation: Any) -> None:
    """Raise ConfigError unless the value is one of a Literal type."""
    choices = typing.get_args(annotation)
    require(got in choices, name, got, "one of " + ", ".join(map(repr, choices)))
