"""Rows of observations and infos that several processes write and read.

Legend: N envs.
"""

from __future__ import annotations

import mmap
import os
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import IO, Any

import numpy as np
import torch
from torch import Tensor

Tree = dict[str, Any]
"""Nested dicts with tensors or arrays as leaves."""

FOLDER = Path("/dev/shm")
"""Where memory that processes share is made."""


class SharedRows:
    """One record for each of N envs, in memory that several processes map.

    `views` are the records' fields, as nested dicts of arrays [N, ...].
    """

    def __init__(self, descriptor: int, record: np.dtype, num_envs: int) -> None:
        """Map the memory that `reserve` has made, here or in another process."""
        memory = mmap.mmap(descriptor, num_envs * record.itemsize)
        self.views: Tree = _views(np.ndarray(num_envs, record, buffer=memory))

    def write(self, row: int, tree: Tree) -> None:
        """Copy the one row of `tree` to `row`."""
        _write(self.views, row, tree)

    def read(self, name: str) -> Any:
        """Return copies of all rows of a field: a tensor or a tree of them."""
        return map_leaves(lambda view: torch.from_numpy(view.copy()), self.views[name])


def record_of(tree: Tree) -> np.dtype:
    """Return the record that has room for one row of `tree`, whose leaves have one."""
    fields: list[tuple] = []
    for name, value in tree.items():
        if isinstance(value, dict):
            fields.append((name, record_of(value)))
        elif isinstance(value, Tensor | np.ndarray):
            array = _host(value)
            fields.append((name, array.dtype, array.shape[1:]))
    return np.dtype(fields, align=True)


def reserve(size: int) -> IO[bytes]:
    """Return a file in memory without a name: it is gone when the last one closes it.

    Raises:
        OSError: There is not as much memory; the message says what to do.
    """
    try:
        file = tempfile.TemporaryFile(dir=FOLDER)  # noqa: SIM115
        # Reserved now: memory that runs out later kills whoever writes (SIGBUS).
        os.posix_fallocate(file.fileno(), 0, size)
    except OSError as error:
        message = (
            f"{error.strerror}: the envs need {size / 2**20:.1f} MiB of shared memory "
            f"in {FOLDER}; enlarge it (in a container: --shm-size=1g, Docker gives 64 "
            "MiB), or take fewer envs or smaller pictures"
        )
        raise OSError(error.errno, message) from error
    return file


def map_leaves(function: Callable, tree: Any) -> Any:
    """Return the tree with the function's result for each leaf."""
    if isinstance(tree, dict):
        return {name: map_leaves(function, branch) for name, branch in tree.items()}
    return function(tree)


def _views(array: np.ndarray) -> Any:
    names = array.dtype.names
    return array if names is None else {name: _views(array[name]) for name in names}


def _write(views: Tree, row: int, tree: Tree) -> None:
    for name, value in tree.items():
        if isinstance(value, dict):
            _write(views[name], row, value)
        elif isinstance(value, Tensor | np.ndarray):
            views[name][row] = _host(value)[0]


def _host(value: Tensor | np.ndarray) -> np.ndarray:
    # Pictures may be on the GPU that drew them, though physics are on the CPU.
    return value.cpu().numpy() if isinstance(value, Tensor) else value
