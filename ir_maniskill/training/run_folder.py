"""The folder of a run: its checkpoints, and the record of how it went."""

import contextlib
import csv
import fcntl
import io
import logging
import os
import shutil
import signal
import threading
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path

from torch.utils.tensorboard import SummaryWriter

from ir_maniskill.training import checkpoint
from ir_maniskill.training.checkpoint import CheckpointError, Stored
from ir_maniskill.training.config import TrainConfig, to_json

log = logging.getLogger(__name__)

SPARE_BYTES = 200_000_000
"""Room a run asks for before it starts [byte]: checkpoints and logs."""

STOPPING = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
"""What asks a training to stop."""


class RunFolder:
    """`config.json`, `metrics.csv`, `evaluations.csv`, TensorBoard events, policies."""

    def __init__(self, path: Path, *, resume: bool) -> None:
        """Make or enter the folder.

        Raises:
            CheckpointError: If it holds a run that would be overwritten, cannot be
                written to, or its disk is nearly full.
        """
        self.path = path
        self.last = path / "last.safetensors"
        """The newest complete checkpoint."""
        self.best = path / "best.safetensors"
        """The policy with the best evaluation so far."""
        if self.last.exists() and not resume:
            raise CheckpointError(
                f"{path} already holds a run: resume it, or choose another folder"
            )
        self._require_room()
        self._reserve = path / ".reserve.tmp"
        self._lock: int | None = None
        self._events: SummaryWriter | None = None

    def _require_room(self) -> None:
        try:
            self.path.mkdir(parents=True, exist_ok=True)
            probe = self.path / ".probe"
            probe.write_bytes(b"0")
            probe.unlink()
        except OSError as error:
            raise CheckpointError(
                f"cannot write to {self.path}: {error.strerror}; choose another folder"
            ) from error
        free = shutil.disk_usage(self.path).free
        if free < SPARE_BYTES:
            raise CheckpointError(
                f"{self.path}: got {free / 1e6:.0f} MB of free space, expected "
                f"{SPARE_BYTES / 1e6:.0f} MB; free some, or choose another folder"
            )

    def begin(self, config: TrainConfig, steps: int) -> int:
        """Write the config, and drop records of steps that will be made again.

        Returns:
            The steps of the last evaluation recorded; 0 if there is none.

        Raises:
            CheckpointError: If another training is using the folder.
        """
        self._take()
        for leftover in self.path.glob(".*.tmp"):  # of a process that was killed
            leftover.unlink()
        self._events = SummaryWriter(str(self.path), purge_step=steps + 1)
        text = to_json(config) + "\n"
        checkpoint.replace(self.path / "config.json", text.encode())
        self._cut("metrics", steps)
        return self._cut("evaluations", steps)

    def _cut(self, name: str, steps: int) -> int:
        """Drop the rows after `steps` of a table; return the steps of the last kept."""
        table = self.path / f"{name}.csv"
        if not table.exists():
            return 0
        rows = [row for row in whole_rows(table) if int(row["steps"]) <= steps]
        checkpoint.replace(table, _format(rows, header=True))
        return int(rows[-1]["steps"]) if rows else 0

    def _take(self) -> None:
        """Hold the folder until this process ends or calls `close`."""
        folder = os.open(self.path, os.O_RDONLY)
        try:
            fcntl.flock(folder, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            os.close(folder)
            raise CheckpointError(
                f"{self.path} is in use by another training; wait until it ends, or "
                "choose another folder"
            ) from None
        except OSError:
            log.warning("%s: cannot be locked; train there only once", self.path)
        self._lock = folder

    def save(self, snapshot: Stored) -> None:
        """Write the newest checkpoint, and reserve room for the next one."""
        checkpoint.write(self.last, snapshot)
        size = self.last.stat().st_size
        if snapshot.metadata["steps"] == 0:
            size *= 3  # the optimizer's two averages are still to come
        with contextlib.suppress(OSError), self._reserve.open("ab") as file:
            os.posix_fallocate(file.fileno(), 0, size + 2**20)

    def save_at_last(self, snapshot: Stored) -> None:
        """Write the checkpoint of a run that has to stop, on a full disk too."""
        with _undisturbed():
            self._reserve.unlink(missing_ok=True)
            checkpoint.write(self.last, snapshot)
        log.warning(
            "stopped at step %d: resume goes on there", snapshot.metadata["steps"]
        )

    def log(self, table: str, steps: int, figures: Mapping[str, float]) -> None:
        """Add a row to the CSV table, and a point to every TensorBoard curve."""
        path = self.path / f"{table}.csv"
        with checkpoint.writing(path), path.open("ab") as file:
            row = {"steps": steps, **figures}
            file.write(_format([row], header=file.tell() == 0))
            for name, value in figures.items():
                assert self._events is not None, "begin comes first"
                self._events.add_scalar(name, value, steps)

    def close(self) -> None:
        """Flush the TensorBoard events, and give up what was held."""
        if self._events is not None:
            with contextlib.suppress(OSError):  # the tables have all that they have
                self._events.close()
        if self._lock is not None:
            self._reserve.unlink(missing_ok=True)
            os.close(self._lock)
            self._lock = None


@contextlib.contextmanager
def _undisturbed() -> Iterator[None]:
    """Ignore a second Ctrl-C, or what a job scheduler sends to make sure."""
    if threading.current_thread() is not threading.main_thread():
        yield  # signals are not ours to handle
        return
    handlers = {s: signal.signal(s, signal.SIG_IGN) for s in STOPPING}
    try:
        yield
    finally:
        for number, handler in handlers.items():
            signal.signal(number, handler)


def whole_rows(table: Path) -> list[dict[str, str]]:
    """Return the rows of a CSV table but those that were cut short."""
    with table.open(newline="", errors="replace") as file:
        lines = [line for line in file if line.endswith("\n")]
    rows = csv.DictReader(lines)
    return [row for row in rows if None not in row and None not in row.values()]


def _format(rows: Iterable[Mapping[str, object]], *, header: bool) -> bytes:
    """Return the lines of a CSV table."""
    text = io.StringIO(newline="")
    for row in rows:
        writer = csv.DictWriter(text, list(row))
        if header:
            writer.writeheader()
            header = False
        writer.writerow(row)
    return text.getvalue().encode()
