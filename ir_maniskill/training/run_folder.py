"""The folder of a run: its checkpoints, and the record of how it went."""

import csv
import shutil
from collections.abc import Mapping
from pathlib import Path

from torch.utils.tensorboard import SummaryWriter

from ir_maniskill.training.checkpoint import CheckpointError
from ir_maniskill.training.config import TrainConfig, to_json

SPARE_BYTES = 200_000_000
"""Room a run asks for before it starts [byte]: checkpoints and logs."""


class RunFolder:
    """`config.json`, `metrics.csv`, `evaluations.csv`, TensorBoard events, policies."""

    def __init__(self, path: Path, *, resume: bool) -> None:
        """Make or enter the folder.

        Raises:
            CheckpointError: if it holds a run that would be overwritten, cannot be
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

    def begin(self, config: TrainConfig, steps: int) -> None:
        """Write the config, and drop records of steps that will be made again."""
        self._events = SummaryWriter(str(self.path))
        (self.path / "config.json").write_text(to_json(config) + "\n")
        for table in self.path.glob("*.csv"):
            with table.open(newline="") as file:
                rows = [r for r in csv.DictReader(file) if int(r["steps"]) <= steps]
            table.unlink()
            for row in rows:
                _append(table, row)

    def log(self, table: str, steps: int, figures: Mapping[str, float]) -> None:
        """Add a row to the CSV table, and a point to every TensorBoard curve."""
        _append(self.path / f"{table}.csv", {"steps": steps, **figures})
        assert self._events is not None, "begin comes first"
        for name, value in figures.items():
            self._events.add_scalar(name, value, steps)

    def close(self) -> None:
        """Flush the TensorBoard events."""
        if self._events is not None:
            self._events.close()


def _append(table: Path, row: Mapping[str, object]) -> None:
    new = not table.exists()
    with table.open("a", newline="") as file:
        writer = csv.DictWriter(file, list(row))
        if new:
            writer.writeheader()
        writer.writerow(row)
