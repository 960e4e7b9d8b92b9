"""Checks of what is given, and the errors that they raise: got, expected, available."""

import math
import types
import typing
from collections.abc import Callable
from numbers import Integral
from typing import Any, Literal


class ConfigError(ValueError):
    """A configuration value that cannot be used: what was got, what is expected."""


def require(
    condition: bool,
    name: str,
    got: object,
    expected: str,
    error: type[Exception] = ConfigError,
) -> None:
    """Raise the error unless the condition holds."""
    if not condition:
        raise error(f"{name}: got {got!r}, expected {expected}")


def require_choice(
    name: str, got: object, choices: Any, error: type[Exception] = ConfigError
) -> None:
    """Raise the error unless the value is one of the choices, maybe a Literal type."""
    available = typing.get_args(choices) or tuple(choices)
    if got not in available:
        raise error(f"{name}: got {got!r}, available: {', '.join(available)}")


def require_type(
    name: str, got: object, kind: type, error: type[Exception] = ConfigError
) -> None:
    """Raise the error unless the value is of that type."""
    require(isinstance(got, kind), name, got, f"a {kind.__name__}", error)


def require_whole(name: str, got: object, low: int, high: float = math.inf) -> None:
    """Raise ConfigError unless the value is a whole number from `low` to `high`."""
    whole = isinstance(got, Integral) and not isinstance(got, bool)
    expected = f"{low} to {high}" if high < math.inf else f"at least {low}"
    fits = whole and low <= got <= high  # type: ignore[operator]
    require(fits, name, got, f"a whole number, {expected}")


def require_fields(
    config: object, names: str, fits: Callable[[Any], bool], expected: str
) -> None:
    """Raise ConfigError unless each of the fields, named side by side, fits."""
    for name in names.split():
        value = getattr(config, name)
        require(fits(value), name, value, expected)


def require_types(config: object) -> None:
    """Raise ConfigError unless each field has a value of its type."""
    for name, hint in typing.get_type_hints(type(config)).items():
        expected = f"a value of type {hint.__name__ if type(hint) is type else hint}"
        if typing.get_origin(hint) is Literal:
            expected = "one of " + ", ".join(map(repr, typing.get_args(hint)))
        value = getattr(config, name)
        require(_is_a(value, hint), name, value, expected)


def _is_a(value: object, hint: Any) -> bool:
    """Whether a value is of a type: integers are floats, truth is no number."""
    kinds, origin = typing.get_args(hint), typing.get_origin(hint)
    if origin is types.UnionType:
        return any(_is_a(value, kind) for kind in kinds)
    if origin is Literal:
        return value in kinds
    if origin is tuple:  # of any length
        return isinstance(value, tuple) and all(_is_a(v, kinds[0]) for v in value)
    if isinstance(value, bool):
        return hint is bool
    return isinstance(value, (int, float) if hint is float else hint)
