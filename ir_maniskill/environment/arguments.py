"""What envs are given, checked before any env hears of it. Legend: N envs."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from reprlib import repr as short
from typing import Any

import numpy as np
import torch
from mani_skill.envs.utils.system.backend import sim_backend_name_mapping
from torch import Tensor

from ir_maniskill.checks import require
from ir_maniskill.environment.senses import text_of
from ir_maniskill.experiment import Experiment, Spoken
from ir_maniskill.goals import GoalError, Instruction
from ir_maniskill.language import SentenceError, handwritten, parse
from ir_maniskill.language.tokens import split_words, warn_of_unknown

RESET_OPTIONS = ("instruction", "reconfigure", "reset_to_env_states")
"""Names of the options that a reset of all envs takes."""

SEEDS = range(2**32)
"""Seeds of NumPy's random streams, from which ManiSkill draws."""


def simulator_of(sim_backend: str) -> str:
    """Return the first of ManiSkill's names of a backend, without the device.

    "auto" is CUDA where torch sees a device.

    Raises:
        ConfigError: There is no such backend, or no CUDA device.
    """
    names, cuda = sim_backend_name_mapping, torch.cuda.is_available()
    if sim_backend == "auto":
        return "physx_cuda" if cuda else "physx_cpu"
    kind, _, _ = str(sim_backend).partition(":")
    expected = f"'auto' or one of {', '.join(names)}, with a device if need be "
    require(kind in names, "sim_backend", sim_backend, expected + "('cuda:0')")
    fits, expected = cuda or names[kind] == "physx_cpu", "'physx_cpu': torch sees no "
    require(fits, "sim_backend", sim_backend, expected + "CUDA device here")
    return names[kind]


def seeds_of(seed: int | Sequence[int], num_envs: int) -> list[int]:
    """Return the seeds of N envs: seed + i, or those of a sequence.

    Raises:
        ValueError: There are not N of them, or some are out of range or no integers.
    """
    given = _plain(seed)
    seeds = [given + row for row in range(num_envs)] if _whole(given) else given
    each = seeds if isinstance(seeds, list) else []
    if len(each) == num_envs and all(_whole(one) and one in SEEDS for one in each):
        return each
    raise ValueError(
        f"seed: got {short(given)}, expected an integer (env i gets seed + i) or "
        f"{num_envs} of them, so that each env's is from 0 to {SEEDS[-1]}"
    )


def instructions_of(
    given: Any, experiment: Experiment, num_envs: int
) -> list[Instruction]:
    """Return what each env is told: one instruction for all, or N of them.

    Each is an `Instruction`, an index or a sentence of the experiment's own (case and
    full stop do not matter), or another that the instruction language understands.

    Raises:
        ValueError: It is something else, or a sentence that is not understood.
        GoalError: A sentence is too long for what envs observe.
    """
    given, hint = _plain(given), ""
    each = given if isinstance(given, list) else [given] * num_envs
    try:
        found = [_instruction(one, experiment) for one in each]
        if len(found) == num_envs:
            _require_short([one.text for one in found], experiment.max_tokens)
            return found
    except SentenceError as error:
        hint = f" ({error})"
    except LookupError:
        pass
    own = experiment.sentences
    listed = f"an index from 0 to {len(own) - 1}, one of {list(own)}, " if own else ""
    raise ValueError(
        f"instruction: got {short(given)}{hint}, expected {listed}a sentence of the "
        f"instruction language or an Instruction, for all envs or a list of {num_envs}"
    )


def _instruction(given: Any, experiment: Experiment) -> Instruction:
    """Return what is meant; SentenceError or LookupError: nothing."""
    own = experiment.instructions
    if isinstance(own, Spoken):  # those of no grammar are said in one split alone
        own = handwritten() if own.split == "wording" else ()
    if isinstance(given, Instruction):
        return given
    if isinstance(given, str):
        for same in own:
            if _bare(same.text) == _bare(given):
                return same
        told = Instruction(given, parse(given))
        warn_of_unknown(given, experiment.vocabulary)
        return told
    if _whole(given) and given in range(len(experiment.sentences)):
        return own[given]
    raise LookupError


def _require_short(texts: list[str], length: int) -> None:
    for text in texts:
        if len(split_words(text)) > length:
            raise GoalError(
                f"instruction text: got {text!r}, expected at most {length} words and "
                "full stops in this task"
            )
    text_of(texts)  # refuses those of too many bytes


def _bare(sentence: str) -> str:
    """Return a sentence without what may be left out: capitals and the full stop."""
    return sentence.lower().strip().rstrip(".")


def options_of(
    options: dict[str, Any], experiment: Experiment, num_envs: int
) -> list[dict[str, Any]]:
    """Return the reset options of each of N envs.

    "instruction" is as for `instructions_of`, "reconfigure" a bool for all envs;
    "reset_to_env_states" holds trees or arrays of N rows or of one.

    Raises:
        ValueError: There is another option, or a value cannot be used.
    """
    require_names(options, RESET_OPTIONS)
    require_reset(options)
    dealt = {
        name: _deal(name, value, experiment, num_envs)
        for name, value in options.items()
    }
    return [{name: dealt[name][row] for name in dealt} for row in range(num_envs)]


def require_names(options: Any, allowed: Sequence[str]) -> None:
    """Raise ValueError if there is an option that is not allowed."""
    _require_dict(options)
    unknown = [name for name in options if name not in allowed]
    if unknown:
        raise ValueError(f"reset options: got {unknown}, expected some of {allowed}")


def require_reset(options: Any) -> None:
    """Raise ValueError if options are of the wrong kind or exclude each other.

    Of names that are not known, which wrappers may have use for, it only warns.
    """
    _require_dict(options)
    unknown = sorted(map(repr, options.keys() - {*RESET_OPTIONS, "env_idx"}))
    if unknown:
        known = ", ".join(RESET_OPTIONS)
        text = f"reset options: {', '.join(unknown)} not known here, only {known}"
        warnings.warn(text, stacklevel=3)
    rebuilt = options.get("reconfigure", False)
    if not isinstance(_plain(rebuilt), bool):
        raise ValueError(
            f"reset option 'reconfigure': got {short(rebuilt)}, expected True or False"
        )
    told, state = options.get("instruction"), options.get("reset_to_env_states")
    if told is not None and state is not None:
        raise ValueError(
            f"reset options: got 'reset_to_env_states' and instruction {short(told)}, "
            "expected one: a state has its instruction, which `tell` can change after"
        )
    states = state.get("env_states") if isinstance(state, dict) else None
    part = isinstance(states, dict) and "task" not in states
    if "reset_to_env_states" in options and (states is None or part):
        raise ValueError(
            f"reset option 'reset_to_env_states': got {short(state)}, expected "
            "{'env_states': ...} with what get_state or get_state_dict returned"
        )


def _require_dict(options: Any) -> None:
    if not isinstance(options, dict):
        raise ValueError(f"reset options: got {short(options)}, expected a dict")


def action_of(action: Any, shape: tuple[int, ...]) -> Tensor:
    """Return an action of N envs, or of one, of any kind of numbers as float32.

    Raises:
        ValueError: It has another shape than [N, J], or [J] of one env, or is no
            numbers.
    """
    try:  # of what is no tensor a copy: strides may be negative
        plain = action if isinstance(action, Tensor) else np.array(action)
        given = torch.as_tensor(plain).detach()
    except (TypeError, ValueError, RuntimeError) as error:
        got = f"{type(action).__name__} ({error})"
        raise ValueError(f"action: got {got}, expected numbers {shape}") from None
    if given.is_complex():
        raise ValueError(f"action: got complex numbers, expected real ones {shape}")
    if given.shape != shape and (1, *given.shape) != shape:
        raise ValueError(f"action: got shape {tuple(given.shape)}, expected {shape}")
    return given.float()


def _deal(name: str, value: Any, experiment: Experiment, num_envs: int) -> list:
    """Return the value of an option for each of N envs."""
    if name == "instruction" and value is not None:
        return instructions_of(value, experiment, num_envs)
    if name != "reset_to_env_states":
        return [value] * num_envs
    return [_row(name, value, row, num_envs) for row in range(num_envs)]


def _row(what: str, states: Any, row: int, num_envs: int) -> Any:
    """Return one env's row [1, ...] of nested arrays that have N rows, or one."""
    if isinstance(states, dict):
        return {
            name: _row(f"{what}[{name!r}]", value, row, num_envs)
            for name, value in states.items()
        }
    if isinstance(states, Tensor):
        states = states.detach().cpu()
    array = np.asarray(states)
    if array.dtype.kind in "biuf" and array.ndim > 1 and len(array) in (1, num_envs):
        return array[row % len(array)][None]
    raise ValueError(
        f"reset option {what}: got {array.dtype} of shape {array.shape}, expected "
        f"numbers with {num_envs} rows, one for each env, or a single one for all"
    )


def _plain(given: Any) -> Any:
    """Return NumPy's and torch's numbers as Python's, and sequences as lists."""
    if isinstance(given, list | tuple | range):
        return [_plain(one) for one in given]
    numbers = isinstance(given, Tensor | np.ndarray | np.generic)
    return given.tolist() if numbers else given


def _whole(given: Any) -> bool:
    return isinstance(given, int) and not isinstance(given, bool)
