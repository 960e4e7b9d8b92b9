"""Checkpoints: everything a run needs to go on, in one file without pickles.

Both kinds of file are safetensors with a JSON header: a *checkpoint* is complete
(weights, optimizer, normalizers, random states), a *policy* holds only the weights that
act. Either opens with `load_policy`.
"""

import contextlib
import dataclasses
import hashlib
import json
import os
import random
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from safetensors import SafetensorError
from safetensors.torch import load as parse_tensors
from safetensors.torch import save as format_tensors
from torch import Tensor

from ir_maniskill.agent.agent import Agent, StateSpec
from ir_maniskill.environment.state import State
from ir_maniskill.training.config import TrainConfig, decode, from_data, to_data
from ir_maniskill.training.finite import check_finite
from ir_maniskill.training.quantize import dequantize, quantize

CHECKPOINT = "ir_maniskill checkpoint 1"
POLICY = "ir_maniskill policy 1"

TRAINING_ONLY = ("critic.", "critic_encoder.", "locator.")
"""Weights that a policy file leaves out."""


MALFORMED = (
    *(SafetensorError, RuntimeError, RecursionError, MemoryError),
    *(ValueError, TypeError, AttributeError, LookupError, ArithmeticError),
)
"""What reading contents that are not as we write them may raise."""

LONGEST_HEADER = 100_000_000
"""Longest header that safetensors itself accepts [byte]."""


class CheckpointError(RuntimeError):
    """A file that cannot be used, or written: what was got, what is expected."""


@dataclass(frozen=True)
class Stored:
    """Contents of a checkpoint or policy file."""

    kind: str
    """`CHECKPOINT` or `POLICY`."""
    tensors: dict[str, Tensor]
    """Tensors by name."""
    metadata: dict[str, Any]
    """Plain data: config, spec, steps, figures, and in checkpoints random states."""


def write(path: Path, stored: Stored) -> None:
    """Write the file so that a crash leaves either the old one or the new one.

    Raises:
        CheckpointError: If it cannot be written; the file there before is untouched.
        TrainingDivergedError: If a number in it is not finite; likewise.
    """
    tensors = {k: v.detach().cpu().contiguous() for k, v in stored.tensors.items()}
    check_finite(tensors, "checkpoint", "the learning rate is too high")
    text = json.dumps(stored.metadata)
    header = {"kind": stored.kind, "metadata": text, "digest": _digest(tensors, text)}
    replace(path, format_tensors(tensors, header))


def replace(path: Path, data: bytes) -> None:
    """Put `data` in place of the file, or leave the file as it is if that fails.

    Raises:
        CheckpointError: If it cannot be written; the file there before is untouched.
    """
    aside = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        with writing(path), aside.open("wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
            aside.replace(path)
    except CheckpointError:
        with contextlib.suppress(OSError):
            aside.unlink(missing_ok=True)
        raise
    _sync_folder(path.parent)


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
    """Return the contents of a checkpoint or policy file.

    Raises:
        CheckpointError: If the file is missing, foreign, cut short or altered.
    """
    path = Path(path)
    if path.exists() and not path.is_file():  # reading a pipe might never end
        raise CheckpointError(f"cannot read {path}: expected a file")
    try:
        header = _header(path)
        data = path.read_bytes()
        tensors = parse_tensors(data)
        if _digest(tensors, header["metadata"]) != header["digest"]:
            raise ValueError("its contents do not match their checksum")
        _require_finite(tensors)
        return Stored(header["kind"], tensors, json.loads(header["metadata"]))
    except OSError as error:
        raise CheckpointError(f"cannot read {path}: {error.strerror}") from error
    except MALFORMED as error:
        raise CheckpointError(
            f"{path}: got a file that is cut short, altered or not ours "
            f"({_brief(error)}); expected {CHECKPOINT!r} or {POLICY!r}: restore it, or "
            "train anew"
        ) from error


def _header(path: Path) -> dict[str, str]:
    """Return the metadata of a safetensors file of ours: 8 bytes of length, then JSON.

    Whatever the file is, little of it is read.
    """
    with path.open("rb") as file:
        size = os.fstat(file.fileno()).st_size
        length = int.from_bytes(file.read(8), "little")
        if not 2 <= length <= min(size - 8, LONGEST_HEADER):
            raise ValueError(f"{size} bytes, with a header of {length}")
        header = json.loads(file.read(length))["__metadata__"]
    if header.get("kind") not in (CHECKPOINT, POLICY):
        raise ValueError(f"its kind is {header.get('kind')!r}")
    return header


def _require_finite(tensors: Mapping[str, Tensor]) -> None:
    for name, tensor in tensors.items():
        if tensor.is_floating_point() and not tensor.isfinite().all():
            raise ValueError(f"{name} is not finite")


def _digest(tensors: Mapping[str, Tensor], text: str) -> str:
    digest = hashlib.sha256(text.encode())
    for name in sorted(tensors):
        tensor = tensors[name]
        digest.update(f"{name} {tensor.dtype} {tuple(tensor.shape)}".encode())
        digest.update(tensor.reshape(-1).view(torch.uint8).numpy().tobytes())
    return digest.hexdigest()


def _sync_folder(folder: Path) -> None:
    """Make the renaming itself durable (a no-op where folders cannot be synced)."""
    with contextlib.suppress(OSError):
        descriptor = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)


def describe(agent: Agent, config: TrainConfig, **facts: object) -> dict[str, Any]:
    """Return the metadata that every file carries."""
    resolved = dataclasses.replace(config, agent=agent.config)
    return {
        "config": to_data(resolved),
        "spec": dataclasses.asdict(agent.spec),
        "env_id": config.env_id,
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
    states: State | None = None,
) -> None:
    """Write the weights that act, with where they come from and how good they are.

    Args:
        path: File to write.
        agent: The learner.
        config: How it was trained.
        steps: Environment steps it was trained for.
        evaluation: Figures of its evaluation, plain data.
        states: What it has seen [N, ...], to store few bits a weight (`quantize`), such
            that it acts there much as before; None: all bits.
    """
    weights = {
        name: weight
        for name, weight in agent.state_dict().items()
        if not name.startswith(TRAINING_ONLY)
    }
    if states is not None:
        weights = quantize(agent, weights, states)
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
        gain = stored.tensors.pop("actor.posture_gain", None)
        if gain is not None:  # in version 0.1 it changed as training went on
            changed = {"posture_gain": float(gain), "posture_gain_final": None}
            stored.metadata["config"]["agent"] |= changed
        config = from_data(stored.metadata["config"])
        spec = decode(StateSpec, stored.metadata["spec"])
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
    weights = dequantize(
        _under("agent", stored.tensors) if complete else stored.tensors
    )
    lists = (config.agent.hidden, config.agent.vision_channels)
    if max(config.agent.language_layers, *map(len, lists)) > len(weights):
        raise ValueError("more layers than weights")
    with torch.device("meta"):
        agent = Agent(config.agent, spec, policy_only=not complete)
    agent.load_state_dict(weights, assign=True)
    return agent


def _brief(error: Exception) -> str:
    """Return the message in one line of bearable length."""
    line = " ".join(str(error).split())
    return line if len(line) < 300 else line[:300] + "..."


def _under(prefix: str, tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Return the tensors named `prefix.` something, without that prefix."""
    start = prefix + "."
    return {k.removeprefix(start): v for k, v in tensors.items() if k.startswith(start)}


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
