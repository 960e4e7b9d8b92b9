"""How fast the project is: steps/s beside something that does the same work.

Absolute speed says more about the machine than about the code. So whatever is compared
takes turns in short blocks, medians are taken, and the ratio is what counts.
"""

from __future__ import annotations

import os
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, closing, contextmanager
from dataclasses import asdict, dataclass
from functools import partial
from itertools import chain
from pathlib import Path
from typing import Any

from tqdm import tqdm

from ir_maniskill import bench_blocks
from ir_maniskill.bench_blocks import (
    BLOCKS,
    ENVS_EACH,
    EPISODE,
    OURS,
    SIDE,
    Block,
    Stepping,
    actions,
    make,
    make_many,
    stepping_many,
    timed,
)
from ir_maniskill.checks import require
from ir_maniskill.evaluation.evaluate import machine, versions

ROOT = Path(__file__).parents[1]
PEER = "mani_skill.envs:UnitreeG1PlaceAppleInBowl-v1"
"""A humanoid task of ManiSkill's; it too looks through two cameras at 128 x 128."""
BARE = "physics and drawing alone"


@dataclass(frozen=True)
class Row:
    """One line of the table."""

    what: str
    """What was measured."""
    speed: float
    """Its speed [steps/s]."""
    beside: str
    """What took turns with it."""
    speed_beside: float
    """The speed of that [steps/s]."""

    @property
    def ratio(self) -> float:
        """How many times as fast it is."""
        return self.speed / self.speed_beside

    def __str__(self) -> str:
        return (
            f"{self.what:42} {self.speed:8.1f}   {self.beside:32} "
            f"{self.speed_beside:8.1f} {self.ratio:7.2f}"
        )


@dataclass(frozen=True)
class Report:
    """All that one run of the benchmark found."""

    machine: dict[str, Any]
    """Where it was measured, and with which versions."""
    rows: tuple[Row, ...]
    """The table."""

    def as_dict(self) -> dict[str, Any]:
        """Return plain data for JSON."""
        rows = [asdict(row) | {"ratio": row.ratio} for row in self.rows]
        return {"machine": self.machine, "rows": rows}

    def __str__(self) -> str:
        facts = ", ".join(f"{name} {fact}" for name, fact in self.machine.items())
        head = f"{'':42} {'steps/s':>8}   {'beside':32} {'steps/s':>8} {'ratio':>7}"
        return "\n".join([facts, "", head, *map(str, self.rows)])


# -- The table -------------------------------------------------------------------------


def run(seconds: float = 10.0, quick: bool = False) -> Report:
    """Measure everything.

    Args:
        seconds: How long each comparison goes on [s].
        quick: Whether to measure as briefly as possible, without the peer, which takes
            long to load.
    """
    require(0 < seconds <= 600, "seconds", seconds, "up to 600")
    seconds = 1.0 if quick else seconds
    jobs = (
        one_env("state", seconds, peer=not quick),
        one_env("rgb", seconds, peer=not quick),
        many_envs(seconds),
        learning(updates=1 if quick else 3),
    )
    rows = tuple(chain.from_iterable(tqdm(jobs, desc="bench")))
    return Report(facts(), rows)


def facts() -> dict[str, Any]:
    """Return where and with what was measured."""
    return {**machine(), "load": round(os.getloadavg()[0], 1), **versions()}


def one_env(obs_mode: str, seconds: float, peer: bool) -> Iterator[Row]:
    """Compare one env with the peer and, with pictures, with SAPIEN alone."""
    with ExitStack() as stack:
        env = stack.enter_context(closing(make(OURS, obs_mode)))
        blocks: dict[str, Block] = {OURS: Stepping(env, EPISODE)}
        if peer:
            other = stack.enter_context(closing(make(PEER, obs_mode)))
            # A block of the peer's pictures takes as long as one of ours: few steps.
            blocks[PEER] = Stepping(other, 2 if obs_mode == "rgb" else EPISODE)
        if obs_mode == "rgb":
            blocks[BARE] = BareLoop(env)
        speed = in_turn(blocks, seconds)
    kind = f"two {SIDE} x {SIDE} pictures" if obs_mode == "rgb" else "state"
    for name in list(blocks)[1:]:
        beside = name.split(":")[-1].removesuffix("-v1")
        yield Row(f"one env, {kind}", speed[OURS], beside, speed[name])


def many_envs(seconds: float) -> Iterator[Row]:
    """Compare a worker process on every core with one."""
    cores = len(os.sched_getaffinity(0))
    total = ENVS_EACH * cores
    with (
        closing(make_many(total, cores)) as envs,
        closing(make_many(ENVS_EACH, 1)) as few,
    ):
        blocks = {"all": stepping_many(envs), "one": stepping_many(few)}
        speed = in_turn(blocks, seconds)
    what = f"{total} envs, {cores} processes, pictures 64 x 32"
    yield Row(what, speed["all"], f"{ENVS_EACH} envs, one process", speed["one"])


def learning(updates: int) -> Iterator[Row]:
    """Compare training with collecting alone, by the times that a run logs."""
    rows = list(bench_blocks.training(updates))
    alone = 1 / statistics.median(collect for collect, _ in rows)
    speed = 1 / statistics.median(map(sum, rows))
    yield Row("training, preset `default`", speed, "its envs and actions alone", alone)


# -- Beside another revision -----------------------------------------------------------


def against(revision: str, seconds: float = 10.0) -> Report:
    """Compare this tree with another revision, in processes that take turns.

    Args:
        revision: What git calls it.
        seconds: How long each comparison goes on, five turns at least [s].

    Raises:
        ValueError: There is no such revision, or this is no clone of the repository.
        RuntimeError: One of them cannot do what is compared.
    """
    rows = []
    with checkout(revision) as (tree, blocks), ExitStack() as stack:
        ours, theirs = [stack.enter_context(side(t, blocks)) for t in (ROOT, tree)]
        for name in tqdm(BLOCKS, desc="bench"):
            turns = {"ours": partial(ours, name), "theirs": partial(theirs, name)}
            speed = in_turn(turns, seconds, least=5)
            rows.append(Row(name, speed["ours"], revision, speed["theirs"]))
    return Report(facts(), tuple(rows))


@contextmanager
def checkout(revision: str) -> Iterator[tuple[Path, Path]]:
    """Check a revision out for a while; return where, and what makes its blocks."""
    git = ["git", "-C", str(ROOT), "worktree"]
    with tempfile.TemporaryDirectory() as folder:
        tree = Path(folder) / "tree"
        add = [*git, "add", "--detach", str(tree), revision]
        done = subprocess.run(add, capture_output=True, text=True)
        expected = f"a revision in a clone of the repository: {done.stderr.strip()}"
        require(done.returncode == 0, "against", revision, expected)
        try:
            for name in ("assets", "tasks"):  # 0.1 was installed with them elsewhere
                if not (inner := tree / "ir_maniskill" / name).exists():
                    inner.symlink_to(tree / name)
            # Beside it, since a program's folder is searched for modules first.
            yield tree, Path(shutil.copy(Path(bench_blocks.__file__), folder))
        finally:
            subprocess.run([*git, "remove", "--force", str(tree)], capture_output=True)


@contextmanager
def side(tree: Path, blocks: Path) -> Iterator[Callable[[str], float]]:
    """Return what times a step of a block, by its name, in a process of that tree."""
    with subprocess.Popen(
        [sys.executable, str(blocks)],
        cwd=tree,  # its worker processes look for modules there first
        env=os.environ | {"PYTHONPATH": str(tree)},
        stdin=(pipe := subprocess.PIPE),
        stdout=pipe,
        stderr=subprocess.DEVNULL,
        text=True,
    ) as process:
        assert process.stdin is not None and process.stdout is not None
        ask, answers = process.stdin, process.stdout

        def seconds(name: str) -> float:
            print(name, file=ask, flush=True)
            answer = answers.readline()
            try:
                return float(answer)
            except ValueError:
                raise RuntimeError(f"{name}: {answer or 'the process died'}") from None

        yield seconds


# -- Timing ----------------------------------------------------------------------------


def in_turn(
    blocks: Mapping[str, Block], seconds: float, least: int = 3
) -> dict[str, float]:
    """Run the blocks in turn and return the median speed of each [steps/s].

    Whatever else runs on the machine slows all of them alike, so that ratios stay.

    Args:
        blocks: What to compare, by name.
        seconds: How long to go on.
        least: How often every block runs at least.
    """
    samples: dict[str, list[float]] = {name: [] for name in blocks}
    end = time.perf_counter() + seconds
    while min(map(len, samples.values())) < least or time.perf_counter() < end:
        for name, block in blocks.items():
            samples[name].append(block())
    return {name: 1 / statistics.median(times) for name, times in samples.items()}


# -- What a step costs at least --------------------------------------------------------


class BareLoop:
    """A block that drives an env's SAPIEN objects as a program without ManiSkill would.

    The joints get the targets that the env gives them for the actions of `Stepping`,
    so that the physics is the same; the same two pictures are drawn and fetched.
    """

    def __init__(self, env: Any) -> None:
        """Record the targets of one episode."""
        base, self._env = env.unwrapped, env
        self._substeps = base.sim_freq // base.control_freq
        self._physics, (self._scene,) = base.scene.px, base.scene.sub_scenes
        sensors = base.scene.sensors.values()
        self._cameras = [sensor.camera._render_cameras[0] for sensor in sensors]
        self._joints = [joint._objs[0] for joint in base.agent.controller.joints]
        self._targets: list[list[float]] = []
        env.reset()
        for action in actions(env, EPISODE):
            env.step(action)
            self._targets.append(base.agent.controller.target[0].tolist())

    def __call__(self) -> float:
        """Return the time of a step [s]."""
        self._env.reset()
        return timed(self._episode, EPISODE)

    def _episode(self) -> None:
        for targets in self._targets:
            for joint, target in zip(self._joints, targets, strict=True):
                joint.set_drive_target(target)
            for _ in range(self._substeps):
                self._physics.step()
            self._scene.update_render()
            for camera in self._cameras:
                camera.take_picture()
            for camera in self._cameras:
                camera.get_picture("Color")
