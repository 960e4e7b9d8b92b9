"""Tensors that Gymnasium's vector wrappers, which are written for NumPy, can use."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor


class HostTensor(Tensor):
    """A tensor in the CPU's memory that NumPy's functions take for an array.

    What torch makes of it, copies and files are plain tensors; what NumPy makes of it
    are arrays. So `RecordEpisodeStatistics` and `NormalizeReward` can wrap our envs.
    """

    __torch_function__ = torch._C._disabled_torch_function_impl  # type: ignore

    def __array_ufunc__(self, ufunc: Any, way: str, *args: Any, **kwargs: Any) -> Any:
        return getattr(ufunc, way)(*_arrays(args), **_arrays(kwargs))

    def __array_function__(
        self, function: Any, types: Any, args: tuple, kwargs: dict[str, Any]
    ) -> Any:
        return function(*_arrays(args), **_arrays(kwargs))

    def __getitem__(self, index: Any) -> Tensor:
        return super().__getitem__(index).as_subclass(HostTensor)

    def __rsub__(self, other: Any) -> Tensor:
        # `1 - done` is NumPy's way to say not; torch refuses to subtract booleans.
        numbers = self.long() if self.dtype == torch.bool else self.as_subclass(Tensor)
        return (other - numbers).as_subclass(HostTensor)

    def __deepcopy__(self, memo: dict) -> Tensor:
        return self.as_subclass(Tensor).__deepcopy__(memo)

    def __reduce_ex__(self, protocol: Any) -> Any:
        return self.as_subclass(Tensor).__reduce_ex__(protocol)


def _arrays(given: Any) -> Any:
    """Return arguments, however nested, with arrays in place of such tensors."""
    if isinstance(given, list | tuple):
        return type(given)(map(_arrays, given))
    if isinstance(given, dict):
        return {name: _arrays(value) for name, value in given.items()}
    return given.numpy() if isinstance(given, HostTensor) else given
