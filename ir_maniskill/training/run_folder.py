"""The folder of a run: its checkpoints, and the record of how it went."""

import contextlib
import csv
import fcntl
import io
import json
import logging
import os
import signal
import threading
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from torch.utils.tensorboard import SummaryWriter

from ir_maniskill.checks import ConfigError
from ir_maniskill.files import replacing, require_writable, write_json, writing
from ir_maniskill.training import checkpoint
from ir_maniskill.training.checkpoint import CheckpointError, Stored
from ir_maniskill.training.config import TrainConfig, from_data, to_data

log = logging.getLogger(__name__)

STOPPING = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
"""What asks a training to stop."""


class RunFolder:
    """`config.json`, `metrics.csv`, `evaluations.csv`, TensorBoard events, policies."""

    def __init__(self, path: Path, *, resume: bool) -> None:
        """Make or enter the folder, and hold it until `close`.

        Raises:
            CheckpointError: If another training is using it, or it holds a run that
                would be overwritten.
            OSError: If it cannot be written to.
        """
        self.path = path
        self.last = path / "last.safetensors"
        """The newest complete checkpoint."""
        self.best = path / "best.safetensors"
        """The policy with the best evaluation so far."""
        self._lock: int | None = None
        self._events: SummaryWriter | None = None
        self._enter()
        if self.last.exists() and not resume:
            self.close()
            raise CheckpointError(
                f"{path} already holds a run: resume it, or choose another folder"
            )

    def _enter(self) -> None:
        """Lock the folder for this process, and check that it can be written to."""
        require_writable(self.path / ".probe")
        self._lock = os.open(self.path, os.O_RDONLY)
        try:
            fcntl.flock(self._lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            self.close()
            raise CheckpointError(
                f"{self.path} is in use by another training; wait until it ends, or "
                "choose another folder"
            ) from None
        except OSError:
            log.warning("%s: cannot be locked; train there only once", self.path)

    def __getstate__(self) -> dict[str, Any]:
        """Return what other ranks get: the paths, but not the lock."""
        return {**vars(self), "_lock": None, "_events": None}

    def read_last(self) -> Stored | None:
        """Return the last checkpoint, if any; CheckpointError: it is broken."""
        if not self.last.exists():
            return None
        stored = checkpoint.read(self.last)
        if stored.kind != checkpoint.CHECKPOINT:
            expected = "expected a complete checkpoint to resume from"
            raise CheckpointError(f"{self.last}: got a policy, {expected}")
        return stored

    def begin(self, config: TrainConfig, steps: int) -> int:
        """Write the config, and drop records of steps that will be repeated.

        Returns:
            The steps of the last evaluation recorded; 0 if there is none.
        """
        for leftover in self.path.glob(".[0-9]*.*"):  # of a process that was killed
            leftover.unlink()
        self._events = SummaryWriter(str(self.path), purge_step=steps + 1)
        write_json(self.path / "config.json", to_data(config))
        self._cut("metrics", steps)
        # The evaluation of what a run begins with is made again, and without the best
        # policy the last one is, to have one.
        again = steps == 0 or not self.best.exists()
        return self._cut("evaluations", steps - again)

    def _cut(self, name: str, steps: int) -> int:
        """Drop the rows after `steps` of a table; return the steps of the last kept."""
        table = self.path / f"{name}.csv"
        if not table.exists():
            return 0
        try:
            rows = [row for row in whole_rows(table) if int(row["steps"]) <= steps]
        except (KeyError, ValueError) as error:
            raise CheckpointError(
                f"{table}: got {error}, expected a column `steps` of whole numbers; "
                "mend it, or move it away"
            ) from error
        self.write(table.name, _format(list(rows[0]) if rows else [], rows))
        return int(rows[-1]["steps"]) if rows else 0

    def write(self, name: str, data: bytes) -> None:
        """Replace a file of the folder; if that fails, the old one stays."""
        with replacing(self.path / name) as aside:
            aside.write_bytes(data)

    def save_at_last(self, snapshot: Stored) -> None:
        """Write the checkpoint of a run that has to stop."""
        with _handled(STOPPING, signal.SIG_IGN):  # such as a second Ctrl-C
            checkpoint.write(self.last, snapshot)
        steps = snapshot.metadata["steps"]
        log.warning("stopped at step %d: resume goes on there", steps)

    def forget(self) -> None:
        """Leave no run behind, as nothing was learned yet."""
        for path in (self.last, self.path / "config.json"):
            path.unlink(missing_ok=True)

    def log(self, table: str, steps: int, figures: Mapping[str, float]) -> None:
        """Add a row to the CSV table, and a point to every TensorBoard curve.

        A figure that is new gets a column, in which earlier rows have "nan".
        """
        path, row = self.path / f"{table}.csv", {"steps": steps, **figures}
        rows = whole_rows(path) if path.exists() else []
        columns = list(rows[0]) if rows else []
        if row.keys() - set(columns):
            columns = list(dict.fromkeys([*columns, *row]))
            self.write(path.name, _format(columns, rows))
        with writing(path), path.open("ab") as file:
            file.write(_format(columns, [row], header=False))
            for name, value in figures.items():
                assert self._events is not None, "begin comes first"
                self._events.add_scalar(name, value, steps)

    def close(self) -> None:
        """Flush the TensorBoard events, and unlock the folder."""
        if self._events is not None:
            with contextlib.suppress(OSError):  # the tables have all that they have
                self._events.close()
        if self._lock is not None:
            os.close(self._lock)
            self._lock = None


def interruptible() -> contextlib.AbstractContextManager[None]:
    """Let whatever asks a program to end interrupt it, as Ctrl-C does."""
    # nohup has SIGHUP ignored, which it stays.
    deadly = [s for s in STOPPING if signal.getsignal(s) is signal.SIG_DFL]
    return _handled(deadly, signal.default_int_handler)


@contextlib.contextmanager
def _handled(numbers: Iterable[signal.Signals], handler: Any) -> Iterator[None]:
    """Have signals handled otherwise meanwhile; only the main thread can."""
    main = threading.current_thread() is threading.main_thread()
    before = {n: signal.signal(n, handler) for n in numbers if main}
    try:
        yield
    finally:
        for number, old in before.items():
            signal.signal(number, old)


def stored_config(folder: Path) -> TrainConfig | None:
    """Return the config of the run in a folder, if any; ConfigError: it is broken."""
    path = folder / "config.json"
    if not path.exists():
        return None
    try:
        return from_data(json.loads(path.read_text()))
    except ValueError as error:  # also of what is no JSON
        raise ConfigError(f"{path}: {error}") from error


def whole_rows(table: Path) -> list[dict[str, str]]:
    """Return the complete rows of a CSV table; a crash may have cut the last one."""
    with table.open(newline="", encoding="utf-8", errors="replace") as file:
        lines = [line for line in file if line.endswith("\n")]
    rows = csv.DictReader(lines)
    return [row for row in rows if None not in row and None not in row.values()]


def _format(
    columns: Sequence[str], rows: Iterable[Mapping[str, object]], *, header: bool = True
) -> bytes:
    """Return the lines of a CSV table."""
    text = io.StringIO(newline="")
    writer = csv.DictWriter(text, columns, restval="nan")
    if header and columns:
        writer.writeheader()
    writer.writerows(rows)
    return text.getvalue().encode()
