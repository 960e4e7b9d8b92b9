"""The command line: ``ir-maniskill tasks | train | evaluate | video | bench | ...``."""

from __future__ import annotations

import argparse
import dataclasses
import io
import logging
import os
import pkgutil
import shlex
import sys
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro
from tyro.conf import Positional, arg, subcommand

from ir_maniskill import api, bench, doctor
from ir_maniskill import experiment as catalog
from ir_maniskill.checks import ConfigError, require, require_choice
from ir_maniskill.environment.robots.robot import Robot, available_robots, short_name
from ir_maniskill.evaluation import dataset, plots, video
from ir_maniskill.evaluation.evaluate import EVALUATION_SEED, write_report
from ir_maniskill.experiment import Drawn, Experiment, Spoken
from ir_maniskill.files import require_writable, write_json
from ir_maniskill.policy import load_policy, shipped
from ir_maniskill.training import distributed
from ir_maniskill.training.config import (
    CONFIGS,
    RenderBackend,
    SimBackend,
    TrainConfig,
    require_same,
)
from ir_maniskill.training.run_folder import interruptible, stored_config
from ir_maniskill.training.train import beginning_with, for_experiment
from ir_maniskill.training.train import run as train

TaskId = Positional[Annotated[str, arg(metavar="[MODULE:]ID")]]


@dataclasses.dataclass(frozen=True)
class Tasks:
    """List the tasks, and the robots that can do them."""

    def run(self) -> None:
        """Print both tables."""
        rows = [("ID", "SENTENCES", "OBJECTS", "REWARD", "SENSES")]
        rows += [_describe(catalog.get(name)) for name in catalog.available()]
        _print_table(rows)
        rows = [("ROBOT", "UID", "ACTIONS", "HANDS AND FINGERS", "SCALE")]
        rows += [_describe_robot(robot) for robot in available_robots().values()]
        _print_table(rows)


@dataclasses.dataclass(frozen=True)
class TrainOptions(TrainConfig):
    """A training configuration whose task is given by place."""

    env_id: TaskId = ""
    """Task to learn, e.g. NaoTouchCubeSingle-v1; MODULE is imported first."""
    out: str = ""
    """Folder of the run; runs/ID if empty."""

    def __post_init__(self) -> None:
        """Refuse values that cannot work, once it is known which task it is."""
        if self.env_id is not tyro.MISSING:
            super().__post_init__()


@dataclasses.dataclass(frozen=True)
class Train:
    """Train an agent."""

    config: Annotated[TrainOptions, arg(name="")]
    preset: Literal["default", "vision", "paper", "listen"] = "default"
    """Which numbers to start from: ours, ours for pictures alone, the paper's, those
    for many sentences (hindsight)."""
    resume: bool = False
    """Go on from the folder's last checkpoint, if there is one, with its own config."""

    def train_config(self) -> TrainConfig:
        """Return the configuration that is asked for."""
        task = catalog.get(self.config.env_id).id
        out = self.config.out or f"runs/{task}"
        return TrainConfig(**{**vars(self.config), "env_id": task, "out": out})

    def run(self) -> None:
        """Train, in this process or as one of torchrun's."""
        config = self.train_config()
        with distributed.group():
            best = train(config, resume=self.resume)
            if distributed.rank() == 0:
                task, file = map(shlex.quote, (self.config.env_id, str(best)))
                print(f"The best policy is in {best}.")
                print(f"Next: ir-maniskill evaluate {task} --checkpoint {file}")


@dataclasses.dataclass(frozen=True)
class _Play:
    """What commands share that play a policy."""

    env_id: TaskId
    """Task, e.g. NaoTouchCubeSingle-v1; MODULE is imported first."""
    checkpoint: Path | None = None
    """Policy or checkpoint file, or the id of a task whose policy ships; None: this
    task's."""
    any_task: bool = False
    """Accept a policy that was trained for another task."""
    seed: int = EVALUATION_SEED
    """Seed of the first episode; episode e starts from seed + e."""

    def policy_file(self) -> Path:
        """Return the file of the policy: the one given, or the shipped one."""
        task = catalog.get(self.env_id).id
        path = self.checkpoint or shipped(task)
        if self.checkpoint is None and not path.is_file():
            raise ConfigError(
                f"no policy for {task}: none was given and none ships with the package "
                f"(looked for {path}). Train one: ir-maniskill train {self.env_id}; "
                f"then add --checkpoint runs/{task}/best.safetensors. Or add "
                "--checkpoint NaoInstruct-v1 --any-task: that policy reads any text"
            )
        return path

    def options(self, *more: str) -> dict[str, Any]:
        """Return the arguments that go to `api` as they are."""
        names = ("any_task", "seed", *more)
        return {name: getattr(self, name) for name in names}


@dataclasses.dataclass(frozen=True)
class Evaluate(_Play):
    """Evaluate a policy: success, exclusive success and touch, per instruction."""

    instruction: str | None = None
    """Play this sentence only; None: all of the task's."""
    split: str | None = None
    """What is new in the sentences, if they are spoken: train (nothing), wording,
    objects, pairs or places; None: the task's own, usually train."""
    episodes: int = 100
    """Episodes, spread evenly over the instructions."""
    num_envs: int = 8
    """Scenes simulated side by side; on a CPU the result is the same for any number."""
    sim_backend: SimBackend = "physx_cpu"
    """Where physics is computed, as for `train`."""
    render_backend: RenderBackend = "auto"
    """What draws, as for `train`."""
    json: Path | None = None
    """File to write the report to."""

    def run(self) -> None:
        """Print the report, and write it."""
        policy = load_policy(self.policy_file())
        if self.json is not None:
            require_writable(self.json)
        task = catalog.get(self.env_id).id
        more = ("instruction", "split", "episodes", "num_envs")
        backends = ("sim_backend", "render_backend")
        report = api.evaluate(policy, task, **self.options(*more, *backends))
        print(report)
        if self.json is not None:
            write_report(
                self.json,
                report,
                split=self.split,
                reward_mode=policy.env_kwargs["reward_mode"],
                checkpoint=str(self.checkpoint or task),
                trained_steps=policy.metadata.get("steps"),
                config=dataclasses.asdict(policy.config),
            )


@dataclasses.dataclass(frozen=True)
class Audit(_Play):
    """Ask whether a policy looks, reads, and copes with what is new to it."""

    policy: str | None = None
    """MODULE:FUNCTION from what a vector env observes to actions, to audit instead."""
    episodes: int = 200
    """Episodes of each control and of each split."""
    num_envs: int = 8
    """Scenes simulated side by side."""
    json: Path | None = None
    """File to write the table to."""
    picture: Path | None = None
    """File to draw it to (.png, .pdf, .svg)."""

    def run(self) -> None:
        """Print the table, write and draw it."""
        if self.json is not None:
            require_writable(self.json)
        if self.picture is not None:
            require_writable(self.picture, plots.ENDINGS)
        both = f"{self.policy} and {self.checkpoint}"
        alone = self.policy is None or self.checkpoint is None
        require(alone, "--policy and --checkpoint", both, "one of them")
        policy = _function(self.policy) if self.policy else self.policy_file()
        options = self.options("episodes", "num_envs")
        report = api.audit(policy, catalog.get(self.env_id).id, **options)
        print(report)
        if self.json is not None:
            origin = self.policy or str(self.checkpoint or report.env_id)
            write_report(self.json, report, policy=origin)
        if self.picture is not None:
            plots.bars(report, self.picture)


def _function(name: str) -> Any:
    """Return what "MODULE:FUNCTION" names."""
    sys.path.append(os.getcwd())
    try:
        return pkgutil.resolve_name(name)
    except (ImportError, AttributeError, ValueError) as error:
        raise ConfigError(
            f"--policy: got {name!r}, expected MODULE:FUNCTION that can be imported "
            f"({error})"
        ) from error


@dataclasses.dataclass(frozen=True)
class Video(_Play):
    """Make a video of a policy (.mp4, or .gif)."""

    instruction: str | None = None
    """Play this sentence only; None: all of the task's."""
    out: Path | None = None
    """File to write; None: runs/ID.mp4."""
    episodes: int = 3
    """Episodes; the instructions take turns."""
    speed: float = 0.5
    """How fast to play; 1 is real time."""

    def run(self) -> None:
        """Film the policy."""
        task = catalog.get(self.env_id).id
        out = self.out or Path("runs") / f"{task}.mp4"
        options = self.options("instruction", "episodes", "speed")
        api.record(self.policy_file(), out, task, **options)
        print(f"The video is in {out}.")


@dataclasses.dataclass(frozen=True)
class Record(_Play):
    """Record episodes of a policy, for others to learn from."""

    seed: int = dataset.DATASET_SEED
    """Seed of the first episode; episode e starts from seed + e."""
    instruction: str | None = None
    """Play this sentence only; None: all of the task's."""
    format: dataset.Format = "maniskill"
    """Trajectories that ManiSkill replays (.h5), or a LeRobotDataset."""
    out: Path | None = None
    """Folder to write to, new or empty; None: runs/ID-FORMAT."""
    episodes: int = 100
    """Episodes to play."""
    failures: bool = False
    """Keep those without success, or with a foul, too."""
    height: int = 256
    """Of a LeRobotDataset's pictures, twice their width [pixel]."""

    def run(self) -> None:
        """Play and keep."""
        task = catalog.get(self.env_id).id
        out = self.out or Path("runs") / f"{task}-{self.format}"
        options = self.options("instruction", "episodes", "failures", "height")
        kept = api.collect(self.policy_file(), out, task, form=self.format, **options)
        print(f"{kept} of {self.episodes} episodes are in {out}.")
        if kept < self.episodes:
            print("The others missed the goal, or had a foul; --failures keeps all.")


@dataclasses.dataclass(frozen=True)
class Talk:
    """Open a page to talk to a robot: type a sentence, watch it do as told."""

    env_id: TaskId = "NaoInstruct-v1"
    """Task whose scene it is; MODULE is imported first."""
    checkpoint: Path | None = None
    """Policy or checkpoint file, or the id of a task whose policy ships; None: one that
    ships, if it fits."""
    policy: bool = True
    """Whether a policy moves the robot; --no-policy: random motion."""
    robot: str = "nao"
    """Who does it: nao, g1, panda."""
    host: str = "127.0.0.1"
    """Address to listen at; 0.0.0.0 lets everybody in your network talk to it."""
    port: int = 8080
    """Port to listen at, or the next one that is free."""
    record: Path | None = None
    """Film to write in the end (.mp4, .gif), of the last three minutes."""
    seed: int = EVALUATION_SEED
    """Seed of the first scene."""

    def run(self) -> None:
        """Keep the page open until Ctrl-C."""
        try:
            from ir_maniskill.talk import live  # viser is an extra
            from ir_maniskill.talk.session import Session
        except ModuleNotFoundError as error:
            if error.name != "viser":
                raise
            raise ConfigError(
                "talk: got no module 'viser', expected it installed: "
                "pip install 'ir-maniskill[talk]'"
            ) from None
        if self.record is not None:
            require_writable(self.record, video.ENDINGS)
        live.run(
            Session(
                catalog.get(self.env_id).id,
                robot=self.robot,
                checkpoint=self.checkpoint,
                policy=self.policy,
                seed=self.seed,
            ),
            self.host,
            self.port,
            self.record,
        )


@dataclasses.dataclass(frozen=True)
class Curve:
    """Draw the learning curve of a run (.png, .pdf, .svg)."""

    folder: Positional[Annotated[Path, arg(metavar="FOLDER")]]
    """Folder of the run."""
    out: Path | None = None
    """File to write; None: learning_curve.png in that folder."""

    def run(self) -> None:
        """Draw it."""
        out = plots.learning_curve(self.folder, self.out)
        print(f"The learning curve is in {out}.")


@dataclasses.dataclass(frozen=True)
class Bench:
    """Measure how fast everything is, beside its peers, on this machine."""

    json: Path | None = None
    """File to write the figures to."""
    seconds: float = 10.0
    """How long each comparison goes on [s]."""
    quick: bool = False
    """Measure as briefly as possible, and without ManiSkill's humanoid task."""

    def run(self) -> None:
        """Print the table, and write it."""
        if self.json is not None:
            require_writable(self.json)
        report = bench.run(self.seconds, self.quick)
        print(report)
        if self.json is not None:
            write_json(self.json, report.as_dict())


@dataclasses.dataclass(frozen=True)
class Doctor:
    """Say whether this machine can render, and what to install if not."""

    def run(self) -> int:
        """Print the diagnosis and return the exit code."""
        return doctor.main([])


def main(arguments: Sequence[str]) -> None:
    """Run the command line and exit with its code.

    The code is 0 if all went well, 1 if the doctor found a fault, 2 for a request that
    cannot be carried out, and 130 after Ctrl-C, SIGTERM or a terminal that is closed.
    """
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):  # a terminal may know ASCII alone
            stream.reconfigure(errors="backslashreplace")
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    warnings.filterwarnings("ignore", module=r"(mani_skill|sapien|gymnasium)\b.*")
    with interruptible():
        code = run(arguments)
    sys.exit(code)


def run(arguments: Sequence[str]) -> int:
    """Carry out one command and return its exit code."""
    try:
        command = parse(arguments)
        code = command.run() or 0
        sys.stdout.flush()
        return code
    except KeyboardInterrupt:
        return 130
    except BrokenPipeError:  # who reads has seen enough, as `head` has
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    except (ValueError, RuntimeError, OSError) as error:
        print(f"ir-maniskill: error: {_in_one_line(error)}", file=sys.stderr)
        return 2


def _in_one_line(error: Exception) -> str:
    """Return an error's message, without a traceback that a worker sent along."""
    message = str(error) or type(error).__name__
    head, _, trace = message.partition("Traceback")
    if not trace:
        return message
    told = trace.rpartition("\n  ")[2].partition("\n")[2]  # after the last frame
    return f"{head.strip()} {told.strip()}"


def parse(arguments: Sequence[str]) -> Any:
    """Return the command that the arguments ask for.

    A preset gives the defaults of the other options of `train`, hence the look ahead.
    A run that is resumed gives them itself, and a policy to begin with gives some, once
    it is known which one it is.
    """
    ahead = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    ahead.add_argument("--preset", nargs="?")
    preset = ahead.parse_known_args(list(arguments))[0].preset
    require_choice("--preset", preset or "default", CONFIGS)
    defaults = CONFIGS[preset or "default"]
    command = _parse(arguments, defaults)
    if not isinstance(command, Train):
        return command
    policy = command.config.init_from
    if not (command.resume or policy):
        return command
    config = command.train_config()  # its module may register what the policy has
    stored = stored_config(Path(config.out)) if command.resume else None
    if stored is None or preset is not None:
        command = _parse(arguments, beginning_with(policy, defaults))
    if stored is None:
        return command
    if preset is not None:  # it is given as much as single numbers are
        given = for_experiment(command.train_config(), catalog.get(config.env_id))
        require_same(stored, given)
    return _parse(arguments, stored)


def _parse(arguments: Sequence[str], defaults: TrainConfig) -> Any:
    """Return the command, with defaults for what `train` is not told."""
    numbers = {**vars(defaults), "env_id": tyro.MISSING, "out": ""}
    default = Train(TrainOptions(**numbers))
    commands = (
        Tasks
        | Annotated[Train, subcommand("train", default=default)]
        | Evaluate
        | Audit
        | Video
        | Record
        | Talk
        | Curve
        | Bench
        | Doctor
    )
    description = "InstructRobot: a robot learns to do what a sentence says."
    return tyro.cli(
        commands, args=list(arguments), prog="ir-maniskill", description=description
    )


# -- Tables --------------------------------------------------------------------------


def _print_table(rows: Sequence[tuple[str, ...]]) -> None:
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    for row in rows:
        cells = (cell.ljust(width) for cell, width in zip(row, widths, strict=True))
        print("  ".join(cells).rstrip())


def _describe_robot(robot: type[Robot]) -> tuple[str, str, str, str, str]:
    """Return the row of a robot in the table of robots."""
    hands = (f"{hand}: {', '.join(fingers)}" for hand, fingers in robot.hands.items())
    name, joints = short_name(robot.uid), str(len(robot.joints))
    return name, robot.uid, joints, "; ".join(hands), f"{robot.scale:g}"


def _describe(experiment: Experiment) -> tuple[str, str, str, str, str]:
    """Return the row of an experiment in the table of tasks."""
    drawn, spoken = experiment.objects, experiment.instructions
    if isinstance(drawn, Drawn):
        low, high = drawn.count
        things = f"{low} to {high} of {len(drawn.pool)}; anywhere in reach"
    else:
        colors = ", ".join(thing.color for thing in drawn)
        things = f"{colors}; {'shuffled' if experiment.shuffled else 'in place'}"
    if isinstance(spoken, Spoken):
        said, level = f"the language: {', '.join(spoken.kinds)}", "the goal's level"
    else:
        said = spoken[0].text + f" (+{len(spoken) - 1})" * (len(spoken) > 1)
        level = "+1 per finger"
    reward = {"binary": "+1 if touched", "per_finger": level}
    penalty = (
        f", -{experiment.wrong_penalty:g} wrong" if experiment.wrong_penalty else ""
    )
    return (
        experiment.id,
        said,
        things,
        reward[experiment.reward] + penalty,
        ", ".join(experiment.senses),
    )
