"""Timing that survives a busy machine: short blocks in turn, medians, ratios."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any

Block = Callable[[], float]
"""Does a little work and returns how long a unit of it took [s]."""


def in_turn(blocks: Mapping[str, Block], seconds: float) -> dict[str, float]:
    """Run the blocks in turn and return the median of each [s].

    Whatever else runs on the machine slows all of them alike, so that ratios stay.

    Args:
        blocks: What to compare.
        seconds: How long to go on; every block runs at least three times.
    """
    samples: dict[str, list[float]] = {name: [] for name in blocks}
    end = time.perf_counter() + seconds
    rounds = 0
    while rounds < 3 or time.perf_counter() < end:
        for name, block in blocks.items():
            samples[name].append(block())
        rounds += 1
    return {name: statistics.median(values) for name, values in samples.items()}


def timed(work: Callable[[], Any], units: int = 1) -> float:
    """Return how long a unit of this work takes [s]."""
    start = time.perf_counter()
    work()
    return (time.perf_counter() - start) / units


class Stopwatch:
    """Splits wall time among named parts; time in a nested part counts there only.

    Attributes:
        seconds: Time spent in each part so far [s].
    """

    def __init__(self) -> None:
        """Start with no parts."""
        self.seconds: dict[str, float] = {}
        self._open: list[str] = []
        self._since = 0.0

    @contextmanager
    def part(self, name: str) -> Iterator[None]:
        """Count the time until the end of the `with` block as `name`."""
        self._switch()
        self._open.append(name)
        try:
            yield
        finally:
            self._switch()
            self._open.pop()

    def watch(self, owner: Any, method: str, name: str) -> None:
        """Count the time in a method of this object as `name`, from now on."""
        original = getattr(owner, method)

        def watched(*args: Any, **kwargs: Any) -> Any:
            with self.part(name):
                return original(*args, **kwargs)

        setattr(owner, method, watched)

    def _switch(self) -> None:
        """Book the time since the last switch to the innermost open part."""
        now = time.perf_counter()
        if self._open:
            name = self._open[-1]
            self.seconds[name] = self.seconds.get(name, 0.0) + now - self._since
        self._since = now
