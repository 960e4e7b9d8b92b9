"""Senses: the one list of what is perceived, and the state s_t made of it.

The env observes what these terms measure, `StateStack` stacks them, and the agent's
encoders read those that `AgentConfig.senses` names. To add a sense, call
`register(Term(...))` in a module that worker processes can import. All cameras of the
env that see colors are used.

Legend: N envs, S stacked observations, K cameras, H x W pixels, J joints, F fingers,
C objects, L tokens, B bytes, P privileged numbers.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import torch
from torch import Tensor

from ir_maniskill.checks import require
from ir_maniskill.goals import GoalError
from ir_maniskill.language.tokens import PAD, tokenize

Observation = dict[str, Any]
"""o_t of N envs in an image or state_dict mode, nested as ManiSkill does."""

State = dict[str, Tensor]
"""s_t of N envs by the names of the terms. Those that only the simulator knows are
joined in "privileged" [N, P]."""

Encoder = Literal["language", "vision", "body", "privileged", "none"]
Part = Literal["agent", "extra"]
Info = dict[str, Tensor]
Observer = Callable[[Any, Info], Tensor]


@dataclass(frozen=True)
class Term:
    """One entry of the observation and of the state."""

    name: str
    """Its name in both."""
    encoder: Encoder
    """What reads it: the Language System; the Perceptual System's vision or its body
    senses; "privileged", the same but standardized, for what only the simulator knows;
    "none": a loss only."""
    shape: str
    """What it is for each env, e.g. "J" or "K, H, W, 3"."""
    measure: Observer | None = None
    """Returns it [N, shape] from the env and its info; None: it comes with the robot's
    proprioception, or `read` finds it."""
    sense: str = ""
    """What `AgentConfig.senses` calls it; "" is its name."""
    stacked: bool = False
    """Whether the state has its last S values [N, S, shape], the newest first."""
    part: Part = "extra"
    """Part of the observation it is in; terms of "agent" get no info."""
    asked: bool = False
    """Whether it is observed on request only: `gym.make(ID, observe=(name,))`."""
    read: Callable[[Observation], Tensor | None] | None = None
    """Computes it from an observation; None: it stands there under its name."""

    def find(self, obs: Observation) -> Tensor | None:
        """Return it from an observation; None: it is not there."""
        if self.read is not None:
            return self.read(obs)
        return obs.get(self.part, {}).get(self.name)


def cameras(obs: Observation) -> tuple[str, ...]:
    """Return the names of the K cameras that see colors, in the order of "images".

    The order depends on the names alone: dicts may be sorted on their way here.
    """
    sensors = obs.get("sensor_data", {})
    named = (name for name, seen in sensors.items() if "rgb" in seen)
    return tuple(sorted(named, reverse=True))  # the top camera before the front one


def _images(obs: Observation) -> Tensor | None:
    pictures = [obs["sensor_data"][name]["rgb"] for name in cameras(obs)]
    sizes = {tuple(picture.shape[-3:-1]) for picture in pictures}
    if len(sizes) > 1:
        raise ValueError(
            f"sizes of the cameras {cameras(obs)}: got {sorted(sizes)}, expected one "
            "height and width [pixel] for all; change their configs (sensor_configs)"
        )
    return torch.stack(pictures, dim=1) if pictures else None


def _named_position(obs: Observation) -> Tensor | None:
    """Return the middle of the objects that the sentence asks about [N, 3] [m]."""
    extra = obs["extra"]
    if "object_position" not in extra:
        return None
    named = extra["target_object"][..., None]  # [N, C, 1]
    return (extra["object_position"] * named).sum(1) / named.sum(1).clamp_min(1)


def _touched(_: Any, info: Info) -> Tensor:
    return info["contact"].any(dim=2).float()


def _of_sentence(table: str) -> Observer:
    """Return what finds the active sentence's row of a table [I, ...]."""
    return lambda env, _: getattr(env.instructional_set, table)[env.instruction_index]


def _privileged(name: str, shape: str, measure: Observer, part: Part = "extra") -> Term:
    return Term(name, "privileged", shape, measure, sense="state", part=part)


_TERMS = [
    Term("images", "vision", "K, H, W, 3", sense="vision", stacked=True, read=_images),
    Term("proprioception", "body", "J", stacked=True, part="agent"),
    Term("target", "body", "J", stacked=True, part="agent"),
    Term("touch", "body", "F", _touched, stacked=True),
    Term("instruction", "language", "L", _of_sentence("tokens")),
    Term("text", "language", "B", _of_sentence("text"), asked=True),
    _privileged("velocity", "J", lambda env, _: env.agent.joint_velocity(), "agent"),
    _privileged("object_position", "C, 3", lambda env, _: env.table.poses()[..., :3]),
    _privileged("finger_position", "F, 3", lambda env, _: env.agent.finger_position()),
    _privileged("target_object", "C", lambda env, _: env.measure.serves.any(1).float()),
    _privileged("target_finger", "F", lambda env, _: env.measure.serves.any(2).float()),
    _privileged("gap", "1", lambda env, _: env.measure.gap[:, None]),
    _privileged("wrong_once", "1", lambda _, info: info["wrong_once"].float()[:, None]),
    Term("named_position", "none", "3", read=_named_position),
    Term("snapshot", "none", "P", lambda env, _: env.judged().pack(), asked=True),
    Term(
        *("joint_velocity", "none", "J", lambda env, _: env.agent.joint_velocity()),
        asked=True,
    ),
]
_OURS = len(_TERMS)


def available() -> tuple[str, ...]:
    """Return what `AgentConfig.senses` may name."""
    felt = [t for t in _TERMS if t.encoder in ("vision", "body", "privileged")]
    return tuple(dict.fromkeys(t.sense or t.name for t in felt))


def register(term: Term) -> Term:
    """Add a sense, before envs are made; adding it again does nothing.

    Raises:
        ValueError: Its name is taken, or its encoder is not "body" or "privileged".
    """
    if term in _TERMS:
        return term
    if term.name in (t.name for t in _TERMS):
        raise ValueError(f"name of a sense: got {term.name!r}, which is taken")
    if term.encoder not in ("body", "privileged"):
        raise ValueError(
            f"encoder of {term.name!r}: got {term.encoder!r}, expected 'body' or "
            "'privileged'"
        )
    _TERMS.append(term)
    return term


def askable() -> tuple[str, ...]:
    """Return the names of the terms that are observed on request only."""
    return tuple(term.name for term in _TERMS if term.asked)


def require_askable(names: Iterable[str]) -> tuple[str, ...]:
    """Return the names as a tuple.

    Raises:
        ValueError: One is not `askable`.
    """
    asked = tuple(names) if isinstance(names, Iterable) else (names,)
    if isinstance(names, str) or not all(name in askable() for name in asked):
        raise ValueError(f"observe: got {names!r}, available: {askable()}")
    return asked


def registered() -> tuple[Term, ...]:
    """Return the senses that users added, for worker processes to add them too."""
    return tuple(_TERMS[_OURS:])


def observe(env: Any, part: Part, info: Info) -> dict[str, Tensor]:
    """Return one part of an env's observation: what its terms measure."""
    mode = env.obs_mode_struct
    return {
        term.name: _fitting(term, term.measure(env, info), env.num_envs)
        for term in _TERMS
        if term.part == part
        and term.measure is not None
        and (mode.use_state or term.encoder != "privileged")
        and (not term.asked or term.name in env.asked)
    }


def _fitting(term: Term, value: Tensor, envs: int) -> Tensor:
    """Return what a term measured; of one of a user's own, as floats [N, ...]."""
    if term in _TERMS[:_OURS]:
        return value
    rows = isinstance(value, Tensor) and value.ndim > 1 and len(value) == envs
    got = tuple(value.shape) if isinstance(value, Tensor) else value
    expected = f"a tensor [N, {term.shape}] with N = {envs}"
    require(rows, f"sense {term.name!r}", got, expected, ValueError)
    return value.float()


def entries(senses: Iterable[str]) -> dict[str, Encoder]:
    """Return the state's entries that these senses name, and what reads each."""
    found: dict[str, Encoder] = {}
    for sense in senses:
        for term in _TERMS:
            if sense == (term.sense or term.name):
                joined = term.encoder == "privileged"
                found["privileged" if joined else term.name] = term.encoder
    return found


# -- Sentences as tensors --------------------------------------------------------------


TEXT_BYTES = 256
"""Most bytes of a sentence."""


def tokens_of(
    sentences: Sequence[str], vocabulary: tuple[str, ...], length: int
) -> Tensor:
    """Return the token ids of sentences, padded to a length [I, L] int64."""
    return _padded([tokenize(s, vocabulary) for s in sentences], length, torch.int64)


def text_of(sentences: Sequence[str], length: int = TEXT_BYTES) -> Tensor:
    """Return the UTF-8 bytes of sentences, padded with 0 to a length [I, B] uint8.

    So text goes wherever tensors do: between processes, into replays and recordings.

    Raises:
        GoalError: A sentence has more bytes.
    """
    rows = [list(sentence.encode()) for sentence in sentences]
    for sentence, row in zip(sentences, rows, strict=True):
        if len(row) > length:
            got = f"{sentence[:40]!r}... of {len(row)} bytes"
            raise GoalError(f"instruction text: got {got}, expected at most {length}")
    return _padded(rows, length, torch.uint8)


def read_text(rows: Tensor) -> list[str]:
    """Return the sentences that `text_of` wrote."""
    return [row.tobytes().rstrip(b"\0").decode() for row in rows.cpu().numpy()]


def _padded(rows: list[list[int]], length: int, dtype: torch.dtype) -> Tensor:
    return torch.tensor([r + [PAD] * (length - len(r)) for r in rows], dtype=dtype)


# -- The state -------------------------------------------------------------------------


def flatten(obs: Observation) -> State:
    """Return one observation o_t as a flat dict of the terms it has.

    Raises:
        ConfigError: It is no dict.
    """
    expected = "a dict of tensors: another obs_mode, such as 'rgb' or 'state_dict'"
    require(isinstance(obs, Mapping), "observation", type(obs).__name__, expected)
    state, privileged = {}, []
    for term in _TERMS:
        value = term.find(obs)
        if value is not None and term.encoder == "privileged":
            privileged.append(value.flatten(1))
        elif value is not None:
            state[term.name] = value
    if privileged:
        state["privileged"] = torch.cat(privileged, dim=1)
    return state


def felt(obs: Observation) -> dict[str, Any]:
    """Return the body's and the privileged numbers of the first env [n] each."""
    read = {t.name for t in _TERMS if t.encoder == "body"} | {"privileged"}
    state = flatten(obs)
    return {
        name: state[name][0].flatten().numpy(force=True)
        for name in state
        if name in read
    }


class StateStack:
    """Turns observations into states s_t = [o_t, o_{t-1}, o_{t-2}] (Sec. III-A).

    At the start of an episode the first observation fills the whole stack.
    """

    def __init__(self, frames: int = 3) -> None:
        """Start with no history.

        Args:
            frames: Number of stacked observations S.
        """
        self.frames = frames
        self._state: State = {}

    def reset(self, obs: Observation) -> State:
        """Start a new history in every env and return its state.

        Args:
            obs: The observation after a reset of all envs.
        """
        self._state = flatten(obs)
        for name in stacked(self._state):
            self._state[name] = self._repeat(self._state[name])
        return dict(self._state)

    def push(self, obs: Observation, done: Tensor | None = None) -> State:
        """Add an observation and return the state.

        Args:
            obs: The newest observation; where `done`, the first of a new episode.
            done: Envs whose history starts anew [N] bool; none if left out.
        """
        self._state = self.peek(obs, done)
        return dict(self._state)

    def peek(self, obs: Observation, done: Tensor | None = None) -> State:
        """Return the state that `push` would give, and change nothing.

        Args:
            obs: E.g. the final observation of an episode.
            done: As for `push`.
        """
        state = flatten(obs)
        for name in stacked(state):
            newest = state[name]
            stack = torch.cat([newest[:, None], self._state[name][:, :-1]], dim=1)
            if done is not None and done.any():
                stack[done] = self._repeat(newest[done])
            state[name] = stack
        return state

    def _repeat(self, value: Tensor) -> Tensor:
        """Fill a stack with one observation: [N, ...] -> [N, S, ...]."""
        return value[:, None].repeat_interleave(self.frames, dim=1)


def stacked(state: State) -> list[str]:
    """Return the entries of a state that hold the last S observations [N, S, ...]."""
    return [term.name for term in _TERMS if term.stacked and term.name in state]
