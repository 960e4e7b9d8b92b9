"""Replay: what was seen and done, each frame once, as plain tensors by name.

An episode of T steps is T + 1 rows one after the other; the last one has no step. The
oldest rows make room for the newest. Legend: N rows, S stacked observations.
"""

from __future__ import annotations

import errno
import os
from collections.abc import Mapping
from pathlib import Path
from shutil import disk_usage

import torch
from numpy.lib.format import open_memmap
from torch import Tensor

from ir_maniskill.files import writing

Rows = dict[str, Tensor]
"""Tensors by name [N, ...]."""

EPISODE, AGE, LENGTH = "replay.episode", "replay.age", "replay.length"
"""Of each row: its episode's number (-1: being written), which step of that it is, and
how many there are."""


class Replay:
    """Rows in a ring of limited size, in files that outlive it."""

    def __init__(self, capacity: int, folder: Path) -> None:
        """Have room for that many rows in files, once it is known what is in one."""
        self.capacity = capacity
        self.written = 0
        """Rows written so far, also those that have made room since."""
        self.episodes = 0
        self._folder = folder
        self._rows: Rows = {}

    def __len__(self) -> int:
        return min(self.written, self.capacity)

    @property
    def bytes(self) -> int:
        """Size of all that there is room for [byte]."""
        return sum(rows.nbytes for rows in self._rows.values())

    # -- Writing ---------------------------------------------------------------------

    def add(self, episode: Mapping[str, Tensor]) -> None:
        """Add the T + 1 rows of an episode.

        Raises:
            OSError: The disk is full.
            ValueError: It is longer than the replay.
        """
        count = len(next(iter(episode.values())))
        if count > self.capacity:
            raise ValueError(
                f"replay: got an episode of {count} rows, room for {self.capacity}"
            )
        self._make_room(episode)
        self._require_space(2 * count * self.bytes // self.capacity)
        where = (self.written + torch.arange(count)) % self.capacity
        # Were the process killed here, these rows would belong to no episode.
        self._rows[EPISODE][where] = -1
        for name, rows in episode.items():
            self._rows[name][where] = rows.to(self._rows[name].dtype)
        self._rows[AGE][where] = torch.arange(count)
        self._rows[LENGTH][where] = count - 1
        self._rows[EPISODE][where] = self.episodes
        self.written += count
        self.episodes += 1

    def _make_room(self, like: Mapping[str, Tensor]) -> None:
        """Make the files, all 0, when the first episode tells what a row has."""
        if self._rows:
            return
        self._folder.mkdir(parents=True, exist_ok=True)
        marks = dict.fromkeys((EPISODE, AGE, LENGTH), torch.zeros(1, dtype=torch.int64))
        for name, rows in {**like, **marks}.items():
            shape, kind = (self.capacity, *rows.shape[1:]), rows.numpy().dtype
            made = open_memmap(self._folder / f"{name}.npy", "w+", kind, shape)
            self._rows[name] = torch.from_numpy(made)
        self._rows[EPISODE].fill_(-1)

    def _require_space(self, size: int) -> None:
        """Raise OSError if the disk has less: mapped files would kill the process."""
        if disk_usage(self._folder).free >= size:
            return
        with writing(self._folder):
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    # -- Reading ---------------------------------------------------------------------

    def draw(self, count: int) -> Tensor:
        """Return rows at random that have a next one [count] int64."""
        found = torch.empty(0, dtype=torch.int64)
        while len(found) < count:
            rows = torch.randint(len(self), (2 * count,))
            found = torch.cat([found, rows[self._whole(rows)]])
        return found[:count]

    def _whole(self, rows: Tensor) -> Tensor:
        """Return which rows have a next one, and all of their episode is there [N]."""
        number, age = self._rows[EPISODE], self._rows[AGE][rows]
        ends = rows - age, rows - age + self._rows[LENGTH][rows]
        there = [number[end % self.capacity] == number[rows] for end in ends]
        return (
            there[0] & there[1] & (age < self._rows[LENGTH][rows]) & (number[rows] >= 0)
        )

    def after(self, rows: Tensor) -> Tensor:
        """Return the rows that come next [N]."""
        return (rows + 1) % self.capacity

    def read(
        self,
        name: str,
        rows: Tensor,
        *,
        frames: int | None = None,
        column: Tensor | None = None,
    ) -> Tensor:
        """Return entries of rows [N, ...].

        `column` takes one of each row [N]. `frames` returns the last S up to each row
        [N, S, ...]; before an episode there is nothing: its first row fills the stack.
        """
        if column is not None:
            return self._rows[name][rows, column]
        if frames is None:
            return self._rows[name].index_select(0, rows)
        back = torch.arange(frames).minimum(self._rows[AGE][rows][:, None])  # [N, S]
        index = (rows[:, None] - back) % self.capacity
        return self._rows[name][index]

    # -- Resuming --------------------------------------------------------------------

    def state_dict(self) -> Rows:
        """Return how far it was written; the rows are in the folder."""
        return {"written": torch.tensor([self.written, self.episodes])}

    def load_state_dict(self, tensors: Mapping[str, Tensor]) -> None:
        """Go on with the rows in the folder.

        Raises:
            ValueError: They are not there, or there is room for more or fewer.
        """
        written, episodes = tensors["written"].tolist()
        if not written:
            return
        for path in self._folder.glob("*.npy"):
            self._rows[path.stem] = torch.from_numpy(open_memmap(path, "r+"))
        if not self._rows:
            raise ValueError(f"replay: got nothing in {self._folder}")
        if (got := len(self._rows[EPISODE])) != self.capacity:
            raise ValueError(f"replay: got {got} rows, expected {self.capacity}")
        self.written, self.episodes = written, episodes
        # Rows of a later time than the checkpoint's would pass for those to come.
        self._rows[EPISODE][self._rows[EPISODE] >= episodes] = -1
        if not self._whole(torch.arange(len(self))).any():
            self.written = 0
