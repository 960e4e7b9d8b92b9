"""What a benchmark says: measures with goals, a profile, facts about the machine."""

from __future__ import annotations

import os
import platform
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch

from ir_maniskill.evaluation import evaluate


@dataclass(frozen=True)
class Measure:
    """One line of the table."""

    key: str
    """Short name, for JSON."""
    what: str
    """What is divided by what."""
    value: float
    """The ratio that was measured."""
    goal: float
    """What it should be at least, or at most."""
    at_most: bool = False
    """Whether the goal is an upper limit."""
    detail: str = ""
    """The absolute figures behind it, true for this machine and moment only."""

    @property
    def reached(self) -> bool:
        """Whether the goal is reached."""
        if self.at_most:
            return self.value <= self.goal
        return self.value >= self.goal

    def __str__(self) -> str:
        sign = "<=" if self.at_most else ">="
        verdict = "yes" if self.reached else "no"
        return f"{self.what:56} {self.value:8.2f}  {sign} {self.goal:<5g} {verdict:3}"


@dataclass(frozen=True)
class Machine:
    """Where it was measured."""

    cpu: str
    """Model of the processor."""
    cores: int
    """Cores that this process may use."""
    load: float
    """Processes that were waiting to run, over the last minute, ours included."""
    renderer: str
    """The Vulkan device and its driver."""
    versions: dict[str, str]
    """Versions of Python and of the packages that matter."""

    @classmethod
    def here(cls) -> Machine:
        """Return the facts of this machine."""
        return cls(
            cpu=_cpu_model(),
            cores=len(os.sched_getaffinity(0)),
            load=os.getloadavg()[0],
            renderer=_renderer(),
            versions=evaluate.versions(),
        )

    def __str__(self) -> str:
        versions = ", ".join(f"{k} {v}" for k, v in self.versions.items())
        return (
            f"{self.cores} cores of {self.cpu}, load {self.load:.1f}\n"
            f"{self.renderer}; CUDA: {torch.cuda.is_available()}\n{versions}"
        )


@dataclass(frozen=True)
class Report:
    """All that one run of the benchmark found."""

    machine: Machine
    """Where."""
    measures: tuple[Measure, ...]
    """The table."""
    profile: dict[str, float]
    """Time of each part of one step of one env with pictures [s]."""

    def as_dict(self) -> dict[str, Any]:
        """Return plain data for JSON."""
        rows = [asdict(m) | {"reached": m.reached} for m in self.measures]
        return asdict(self) | {"measures": rows}

    def __str__(self) -> str:
        lines = [str(self.machine), ""]
        for measure in self.measures:
            lines += [str(measure), f"    {measure.detail}"]
        total = sum(self.profile.values())
        lines += ["", f"one step with two pictures: {1e3 * total:.2f} ms, of which"]
        lines += [
            f"    {name:28} {1e3 * part:6.2f} ms  {part / total:4.0%}"
            for name, part in self.profile.items()
        ]
        return "\n".join(lines)


def _cpu_model() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return platform.processor()
    names = [line.split(":")[1].strip() for line in lines if "model name" in line]
    return names[0] if names else platform.machine()


def _renderer() -> str:
    import sapien

    lines = sapien.render.get_device_summary().splitlines()
    return lines[0].removeprefix("GPU:").strip() if lines else "no renderer"
