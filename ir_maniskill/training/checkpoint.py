"""Checkpoints: everything a run needs to go on, in one file without pickles.

Both kinds of file are safetensors with a JSON header: a *checkpoint* is complete
(weights, optimizer, random states), a *policy* holds only the weights that act, with 16
bits each. Either tells for which task, words and robot it was trained.
"""

import dataclasses
import json
from collections.abc import Mapping
from dataclasses import dataclass
from importlib import metadata as packages
from pathlib import Path
from textwrap import shorten
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import load as parse_tensors
from safetensors.torch import save as format_tensors
from torch import Tensor

from ir_maniskill import experiment as catalog
from ir_maniskill.agent.agent import Agent, StateSpec
from ir_maniskill.experiment import Experiment
from ir_maniskill.files import replacing
from ir_maniskill.training.algorithm import under
from ir_maniskill.training.config import TrainConfig, from_data, to_data
from ir_maniskill.training.finite import check_finite, not_finite

CHECKPOINT, POLICY = "checkpoint", "policy"
"""The kinds of file."""

FORMAT = 2
"""Version of the form of both."""

TRAINING_ONLY = ("critic.", "critic_encoder.", "locator.")
"""Weights that a policy file leaves out."""

MALFORMED = (
    *(SafetensorError, RuntimeError, RecursionError, MemoryError),
    *(ValueError, TypeError, AttributeError, LookupError, ArithmeticError),
)
"""What reading contents that are not as we write them may raise."""


class CheckpointError(RuntimeError):
    """A file or folder that cannot be used: what was got, what is expected."""


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
    """Plain data: config, spec, task, steps, figures."""


# -- Files -----------------------------------------------------------------------------


def write(path: Path, stored: Stored) -> None:
    """Write the file so that a crash leaves either the old one or the new one.

    Raises:
        OSError: If it cannot be written; the file there before is untouched.
        TrainingDivergedError: If a number in it is not finite; likewise.
    """
    tensors = {k: v.detach().cpu().contiguous() for k, v in stored.tensors.items()}
    check_finite(tensors, "checkpoint", "the learning rate is too high")
    kind = f"ir_maniskill {stored.kind} {FORMAT}"
    header = {"kind": kind, "metadata": json.dumps(stored.metadata)}
    with replacing(path) as aside:
        aside.write_bytes(format_tensors(tensors, header))


def read(path: Path) -> Stored:
    """Return the contents of a checkpoint or policy file.

    Raises:
        CheckpointError: It is missing, foreign, broken, or of another version.
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
        if int(version) != FORMAT:
            raise CheckpointError(
                f"{path}: got a file of format {version}, written by ir_maniskill "
                f"{metadata.get('version', '0.1')}; expected format {FORMAT}: use that "
                "version, or train anew"
            )
        stored = Stored(kind, parse_tensors(path.read_bytes()), metadata)
        if broken := not_finite(stored.tensors):
            raise ValueError(f"{', '.join(broken)} is not finite")
        return stored
    except CheckpointError:
        raise
    except OSError as error:
        raise CheckpointError(
            f"cannot read {path}: {error.strerror or error}"
        ) from error
    except MALFORMED as error:
        raise CheckpointError(
            f"{path}: got a file that is cut short, altered or not ours "
            f"({shorten(str(error), 300)}); expected a checkpoint or policy of "
            "ir_maniskill: restore it, or train anew"
        ) from error


# -- Policies --------------------------------------------------------------------------


def describe(agent: Agent, config: TrainConfig, **facts: object) -> dict[str, Any]:
    """Return the metadata of every file; words and robot are in the config."""
    resolved = dataclasses.replace(config, agent=agent.config)
    known = config.env_id in catalog.available()
    return {
        "version": packages.version("ir-maniskill"),
        "config": to_data(resolved),
        "spec": dataclasses.asdict(agent.spec),
        "task": task_facts(catalog.get(config.env_id)) if known else {},
        **facts,
    }


def acting(agent: Agent) -> dict[str, Tensor]:
    """Return an agent's weights by name, but for those that only learning needs."""
    weights = agent.state_dict().items()
    return {k: v for k, v in weights if not k.startswith(TRAINING_ONLY)}


def save_policy(
    path: Path,
    agent: Agent,
    config: TrainConfig,
    *,
    steps: int,
    evaluation: Mapping[str, Any],
) -> None:
    """Write the weights that act, and how the agent was trained.

    Beside them stand the environment `steps` that took, and its figures as plain data.
    """
    learned = dict(agent.named_parameters())
    weights = {  # what is counted or measured keeps all its bits
        name: weight.half() if name in learned else weight
        for name, weight in acting(agent).items()
    }
    facts = describe(agent, config, steps=steps, evaluation=dict(evaluation))
    write(path, Stored(POLICY, weights, facts))


def load_agent(path: Path | str) -> tuple[Agent, TrainConfig, dict[str, Any]]:
    """Return the agent of a policy or checkpoint file, its config and its metadata.

    The agent of a policy file has no critic: use `agent.policy`.

    Raises:
        CheckpointError: If the file is none of ours, or does not fit its own config.
    """
    stored = read(Path(path))
    complete = stored.kind == CHECKPOINT
    weights = under("agent", stored.tensors) if complete else stored.tensors
    try:
        config = from_data(stored.metadata["config"])
        spec = StateSpec.from_data(stored.metadata["spec"])
        # On "meta" a wrong size in the file takes no memory.
        with torch.device("meta"):
            agent = Agent(config.agent, spec, policy_only=not complete)
        weights = {
            k: v.float() if v.is_floating_point() else v for k, v in weights.items()
        }
        agent.load_state_dict(weights, assign=True)
    except MALFORMED as error:
        raise CheckpointError(
            f"{path}, written by ir_maniskill {stored.metadata.get('version')}: its "
            "weights and its config do not belong together "
            f"({shorten(str(error), 300)}); expected a file of this version, and the "
            "module to be imported that registers its language encoder and senses"
        ) from error
    return agent.eval(), config, stored.metadata


def task_facts(experiment: Experiment) -> dict[str, Any]:
    """Return a task as plain data, without its id and words."""
    aside = ("id", "senses", "vocabulary")
    return {k: _plain(v) for k, v in vars(experiment).items() if k not in aside}


def _plain(value: Any) -> Any:
    """Return dataclasses as dicts of fields that differ from their defaults."""
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


# -- Random generators -----------------------------------------------------------------


def random_state() -> dict[str, Tensor]:
    """Return the state of torch's generators: nothing else here draws unseeded."""
    tensors = {"random.torch": torch.get_rng_state()}
    if torch.cuda.is_available():
        tensors["random.cuda"] = torch.cuda.get_rng_state()
    return tensors


def set_random_state(tensors: Mapping[str, Tensor]) -> None:
    """Put the generators back to what `random_state` returned."""
    torch.set_rng_state(tensors["random.torch"])
    if torch.cuda.is_available() and "random.cuda" in tensors:
        torch.cuda.set_rng_state(tensors["random.cuda"])
