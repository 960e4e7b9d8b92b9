"""Film: what was seen on the page, kept step by step and drawn afterwards.

Drawing a frame takes longer than a step, so that a film drawn live would slow all down.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack, closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from torch import Tensor

from ir_maniskill.environment.touch_env import CONTROL_FREQ
from ir_maniskill.evaluation import video
from ir_maniskill.talk.session import Choice, Session

LONGEST = 180
"""How much of what was seen is kept, the end [s]."""


@dataclass(frozen=True)
class Moment:
    """One step, as a film needs it."""

    choice: Choice
    """What was played."""
    state: dict[str, Any]
    """The simulator's state."""
    slot: Tensor
    """Which body is in each slot of the table [1, C]."""
    pictures: dict[str, np.ndarray]
    """What the policy's cameras saw."""
    sentence: str
    """What was typed."""
    lights: tuple[str, ...]
    """What each of the F fingers touches, as `Session.lights` says."""
    step: int
    """Steps since the sentence was said."""
    success: bool
    """Whether the goal held."""
    reward: float
    """Sum of the rewards since then."""


class Film:
    """Keeps the last minutes of a session."""

    def __init__(self) -> None:
        """Start with nothing."""
        self._moments: list[Moment] = []
        self._robots: dict[str, Any] = {}

    def add(self, session: Session) -> None:
        """Keep the step that was just made."""
        lights = session.lights().values()
        state = session.env.get_state_dict()
        del state["task"]  # a film is not judged
        moment = Moment(
            session.choice,
            state,
            session.env.table.slot,
            {name: seen.copy() for name, seen in session.pictures().items()},
            session.reading.heard,
            tuple(state for hand in lights for state in hand.values()),
            session.score.steps,
            session.score.success,
            session.score.reward,
        )
        self._robots[session.choice.robot] = session.env.agent
        self._moments.append(moment)
        del self._moments[: -LONGEST * CONTROL_FREQ]

    def write(self, path: Path) -> int:
        """Draw the film (.mp4, .gif); return how many frames it has."""
        if not self._moments:
            return 0
        return video.write_video(path, self._frames(), speed=1.0, hold=0.0)

    def _frames(self) -> Iterator[video.Snapshot]:
        with ExitStack() as opened:
            stages: dict[str, Any] = {}
            for take in self._takes():
                task, robot = take[0].choice.task, self._robots[take[0].choice.robot]
                key = f"{task} {robot.uid}"
                if key not in stages:
                    stage = closing(video.stage(task, robot))
                    stages[key] = opened.enter_context(stage)
                yield from _shots(take, stages[key], robot.hands)

    def _takes(self) -> Iterator[list[Moment]]:
        """Return the moments from one sentence to the next."""
        take: list[Moment] = []
        for moment in self._moments:
            if take and moment.step <= take[-1].step:
                yield take
                take = []
            take.append(moment)
        yield take


def _shots(take: list[Moment], stage: Any, hands: Any) -> Iterator[video.Snapshot]:
    history: tuple[tuple[bool, bool], ...] = ()
    for moment in take:
        stage.unwrapped.table.put(slice(None), moment.slot)
        stage.unwrapped.set_state_dict(moment.state)
        history += ((moment.success, "wrong" in moment.lights),)
        yield video.Snapshot(
            view=stage.render().cpu().numpy()[0],
            cameras=moment.pictures,
            instruction=moment.sentence,
            hands=hands,
            right=tuple(state in ("right", "touch") for state in moment.lights),
            wrong=tuple(state == "wrong" for state in moment.lights),
            step=len(history),
            total_steps=len(take),
            score=moment.reward,
            history=history,
        )
