"""Checkpoints: everything a run needs to go on, in one file without pickles.

Both kinds of file are safetensors with a JSON header: a *checkpoint* is complete
(weights, optimizer, random states), a *policy* holds only the weights that act, with 16
bits each. Either opens with `load_policy`, and tells for which task, words and robot it
was trained.
"""

import contextlib
import dataclasses
import json
import random
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from importlib import metadata as packages
from pathlib import Path
from typing import Any

import numpy as np
import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import load as parse_tensors
from safetensors.torch import save as format_tensors
from torch import Tensor

from ir_maniskill import experiment as catalog
from ir_maniskill.agent.agent import Agent, StateSpec
from ir_maniskill.environment.robots.robot import short_name
from ir_maniskill.experiment import Experiment
from ir_maniskill.files import replacing
from ir_maniskill.training.config import TrainConfig, from_data, to_data
from ir_maniskill.training.finite import check_finite

CHECKPOINT, POLICY = "checkpoint", "policy"
"""The kinds of file."""

FORMAT = 2
"""Version of the form of both; that of ir_maniskill 0.1 is 1."""

TRAINING_ONLY = ("critic.", "critic_encoder.", "locator.")
"""Weights that a policy file leaves out."""

MALFORMED = (
    *(SafetensorError, RuntimeError, RecursionError, MemoryError),
    *(ValueError, TypeError, AttributeError, LookupError, ArithmeticError),
)
"""What reading contents that are not as we write them may raise."""


class CheckpointError(RuntimeError):
    """A file that cannot be used, or written: what was got, what is expected."""


class MismatchError(ValueError):
    """A policy was trained for something else: what it knows, what it meets."""


@dataclass(frozen=True)
class Stored:
    """Contents of a checkpoint or policy file."""

    kind: str
    """`CHECKPOINT` or `POLICY`."""
    tensors: dict[str, Tensor]
    """Tensors by name."""
    metadata: dict[str, Any]
    """Plain data: config, spec, task, steps, figures, random states."""


# -- Files -----------------------------------------------------------------------------


def write(path: Path, stored: Stored) -> None:
    """Write the file so that a crash leaves either the old one or the new one.

    Raises:
        CheckpointError: If it cannot be written; the file there before is untouched.
        TrainingDivergedError: If a number in it is not finite; likewise.
    """
    tensors = {k: v.detach().cpu().contiguous() for k, v in stored.tensors.items()}
    check_finite(tensors, "checkpoint", "the learning rate is too high")
    kind = f"ir_maniskill {stored.kind} {FORMAT}"
    header = {"kind": kind, "metadata": json.dumps(stored.metadata)}
    replace(path, format_tensors(tensors, header))


def replace(path: Path, data: bytes) -> None:
    """Put `data` in place of the file, or leave the file as it is if that fails.

    Raises:
        CheckpointError: If it cannot be written; the file there before is untouched.
    """
    try:
        with replacing(path) as aside:
            aside.write_bytes(data)
    except OSError as error:
        raise CheckpointError(str(error)) from error


@contextlib.contextmanager
def writing(path: Path) -> Iterator[None]:
    """Turn whatever keeps `path` from being written into one clear error."""
    try:
        yield
    except OSError as error:
        raise CheckpointError(
            f"cannot write {path}: {error.strerror}; free some space or choose another "
            "folder (what was saved before is intact)"
        ) from error


def read(path: Path) -> Stored:
    """Return the contents of a checkpoint or policy file, in today's form.

    Raises:
        CheckpointError: If the file is missing, foreign, broken, or of a later version.
    """
    path = Path(path)
    if path.exists() and not path.is_file():  # reading a pipe might never end
        raise CheckpointError(f"cannot read {path}: expected a file")
    try:
        with safe_open(path, "pt") as file:  # reads no more than the header
            header = file.metadata() or {}
        owner, kind, version = header.get("kind", "something else 0").rsplit(" ", 2)
        if owner != "ir_maniskill" or kind not in (CHECKPOINT, POLICY):
            raise ValueError(f"its kind is {header.get('kind')!r}")
        metadata = json.loads(header["metadata"])
        if int(version) > FORMAT:
            raise CheckpointError(
                f"{path}: got a file of format {version}, written by ir_maniskill "
                f"{metadata.get('version')}; expected format {FORMAT} at most: upgrade"
            )
        stored = Stored(kind, parse_tensors(path.read_bytes()), metadata)
        if int(version) == 1:
            stored = _from_version_1(stored)
        _require_finite(stored.tensors)
        return stored
    except OSError as error:
        raise CheckpointError(
            f"cannot read {path}: {error.strerror or error}"
        ) from error
    except CheckpointError:
        raise
    except MALFORMED as error:
        raise CheckpointError(
            f"{path}: got a file that is cut short, altered or not ours "
            f"({_brief(error)}); expected a checkpoint or policy of ir_maniskill: "
            "restore it, or train anew"
        ) from error


def _require_finite(tensors: Mapping[str, Tensor]) -> None:
    for name, tensor in tensors.items():
        if tensor.is_floating_point() and not tensor.isfinite().all():
            raise ValueError(f"{name} is not finite")


def _brief(error: Exception) -> str:
    """Return the message in one line of bearable length."""
    line = " ".join(str(error).split())
    return line if len(line) < 300 else line[:300] + "..."


# -- Files of 0.1 ----------------------------------------------------------------------


def _from_version_1(stored: Stored) -> Stored:
    """Return what 0.1 wrote in today's form; its policy acts as before."""
    tensors = _dequantized(stored.tensors)
    metadata = json.loads(json.dumps(stored.metadata))
    agent, old = metadata["config"]["agent"], metadata["spec"]
    agent["language_length"] = old["tokens"]
    prefix = "agent." if stored.kind == CHECKPOINT else ""
    gain = tensors.pop(f"{prefix}actor.posture_gain", None)
    if gain is not None:  # it changed as training went on
        agent |= {"posture_gain": float(gain), "posture_gain_final": None}
    frames, joints, fingers = old["frames"], old["joints"], old["fingers"]
    shapes = {
        "instruction": [old["tokens"]],
        "proprioception": [frames, joints],
        "target": [frames, joints],
        "touch": [frames, fingers],
    }
    if old["cameras"]:
        shapes["images"] = [
            frames,
            *(old[k] for k in ("cameras", "height", "width")),
            3,
        ]
    if old["privileged"]:
        shapes["privileged"] = [old["privileged"]]
    metadata["spec"] = {"shapes": shapes, "actions": old["actions"]}
    return Stored(stored.kind, tensors, metadata)


def _dequantized(stored: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Return weights that 0.1 stored as whole numbers of 4 or 8 bits, and all others.

    Beside the numbers [O, I] stand the scales of their rows [O]; two numbers of 4 bits
    share a byte.
    """
    weights: dict[str, Tensor] = {}
    for name, tensor in stored.items():
        scale = stored.get(name + ".scale")
        if scale is not None:
            if tensor.dtype == torch.uint8:
                pairs = torch.stack([tensor & 15, tensor >> 4], dim=2).flatten(1)
                tensor = pairs.to(torch.int8) - 8
            tensor = tensor * scale[:, None]
        if name.removesuffix(".scale") not in stored or not name.endswith(".scale"):
            weights[name] = tensor
    return weights


# -- Policies --------------------------------------------------------------------------


def describe(agent: Agent, config: TrainConfig, **facts: object) -> dict[str, Any]:
    """Return the metadata that every file carries.

    Words, the longest sentence and the robot are in the config.
    """
    resolved = dataclasses.replace(config, agent=agent.config)
    known = config.env_id in catalog.available()
    return {
        "version": packages.version("ir-maniskill"),
        "config": to_data(resolved),
        "spec": dataclasses.asdict(agent.spec),
        "env_id": config.env_id,
        "task": task_facts(catalog.get(config.env_id)) if known else {},
        "seed": config.seed,
        **facts,
    }


def save_policy(
    path: Path,
    agent: Agent,
    config: TrainConfig,
    *,
    steps: int,
    evaluation: Mapping[str, Any],
) -> None:
    """Write the weights that act, with where they come from and how good they are.

    Args:
        path: File to write.
        agent: The learner.
        config: How it was trained.
        steps: Environment steps it was trained for.
        evaluation: Figures of its evaluation, plain data.
    """
    learned = dict(agent.named_parameters())
    weights = {  # what is counted or measured keeps all its bits
        name: weight.half() if name in learned else weight
        for name, weight in agent.state_dict().items()
        if not name.startswith(TRAINING_ONLY)
    }
    facts = describe(agent, config, steps=steps, evaluation=dict(evaluation))
    write(path, Stored(POLICY, weights, facts))


def load_policy(path: Path | str) -> tuple[Agent, TrainConfig, dict[str, Any]]:
    """Return the agent of a policy or checkpoint file, its config and its metadata.

    The agent of a policy file has no critic: use `agent.policy`.

    Raises:
        CheckpointError: If the file is none of ours, or does not fit its own config.
    """
    stored = read(Path(path))
    try:
        config = from_data(stored.metadata["config"])
        spec = StateSpec.from_data(stored.metadata["spec"])
        agent = _agent(config, spec, stored)
    except MALFORMED as error:
        raise CheckpointError(
            f"{path}: its weights and its config do not belong together "
            f"({_brief(error)}); expected a file of this version of ir_maniskill"
        ) from error
    return agent.eval(), config, stored.metadata


def _agent(config: TrainConfig, spec: StateSpec, stored: Stored) -> Agent:
    """Return the agent with the stored weights.

    Sizes that the file claims take no memory before they are known to be right.
    """
    complete = stored.kind == CHECKPOINT
    weights = {
        name.removeprefix("agent."): weight.float()
        if weight.is_floating_point()
        else weight
        for name, weight in stored.tensors.items()
        if name.startswith("agent.") or not complete
    }
    with torch.device("meta"):
        agent = Agent(config.agent, spec, policy_only=not complete)
    agent.load_state_dict(weights, assign=True)
    return agent


# -- What a policy was trained for -----------------------------------------------------


def task_facts(experiment: Experiment) -> dict[str, Any]:
    """Return what a task consists of as plain data, but for its id and words."""
    aside = ("id", "senses", "vocabulary")
    return {k: _plain(v) for k, v in vars(experiment).items() if k not in aside}


def _plain(value: Any) -> Any:
    """Return dataclasses as dicts of what is not as usual, tuples as lists."""
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    if not dataclasses.is_dataclass(value):
        return value if isinstance(value, str | int | float | None) else repr(value)
    unusual = {
        field.name: _plain(found)
        for field in dataclasses.fields(value)
        if (found := getattr(value, field.name)) != field.default
    }
    return {"is": type(value).__name__, **unusual}


def require_match(
    config: TrainConfig,
    metadata: Mapping[str, Any],
    experiment: Experiment,
    robot: str | None = None,
    *,
    any_task: bool = False,
) -> None:
    """Raise unless a policy can do the task with the robot.

    Args:
        config: How it was trained, and
        metadata: what its file says, both of `load_policy`.
        experiment: The task.
        robot: What `robot_uids` takes; None: not told, or the policy's own.
        any_task: Accept another task, if it has the same words.

    Raises:
        MismatchError: Naming all that is different.
    """
    words = config.agent.vocabulary
    pairs: dict[str, tuple[Any, Any]] = {}
    if words != experiment.vocabulary:
        pairs["vocabulary"] = words, experiment.vocabulary
    if robot is not None and short_name(robot) != short_name(config.robot):
        pairs["robot"] = config.robot, robot
    if not any_task:
        if config.env_id != experiment.id:
            pairs["task"] = config.env_id, experiment.id
        else:
            then, now = metadata.get("task", {}), task_facts(experiment)
            pairs |= {k: (then[k], now.get(k)) for k in then if then[k] != now.get(k)}
    if pairs:
        told = (_difference(name, *pair) for name, pair in pairs.items())
        raise MismatchError(
            f"policy trained for {config.env_id} does not fit {experiment.id}: "
            + "; ".join(told)
        )


def _difference(name: str, got: Any, expected: Any) -> str:
    """Return what differs; of long lists only the first place that does."""
    lists = isinstance(got, list | tuple) and isinstance(expected, list | tuple)
    if lists and len(got) == len(expected):
        place = next(i for i, item in enumerate(got) if item != expected[i])
        name, got, expected = f"{name}[{place}]", got[place], expected[place]
    return f"{name}: got {got!r}, expected {expected!r}"


# -- Random generators -----------------------------------------------------------------


def random_state() -> tuple[dict[str, Tensor], dict[str, Any]]:
    """Return the state of every random generator this process uses."""
    tensors = {"random.torch": torch.get_rng_state()}
    if torch.cuda.is_available():
        tensors["random.cuda"] = torch.cuda.get_rng_state()
    name, keys, *rest = np.random.get_state()
    tensors["random.numpy"] = torch.from_numpy(np.asarray(keys).astype(np.int64))
    version, state, gauss = random.getstate()
    return tensors, {"numpy": [name, *rest], "python": [version, list(state), gauss]}


def set_random_state(tensors: Mapping[str, Tensor], plain: Mapping[str, Any]) -> None:
    """Put every random generator back to what `random_state` returned."""
    torch.set_rng_state(tensors["random.torch"])
    if torch.cuda.is_available() and "random.cuda" in tensors:
        torch.cuda.set_rng_state(tensors["random.cuda"])
    name, *rest = plain["numpy"]
    keys = tensors["random.numpy"].numpy().astype(np.uint32)
    np.random.set_state((name, keys, *rest))
    version, state, gauss = plain["python"]
    random.setstate((version, tuple(state), gauss))
