"""Film: what was seen on the page, kept step by step and drawn afterwards.

Drawing a frame takes longer than a step, so that a film drawn live would slow all down.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack, closing
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from ir_maniskill.environment.touch_env import CONTROL_FREQ
from ir_maniskill.evaluation import video
from ir_maniskill.talk.session import Session

LONGEST = 180
"""How much of what was seen is kept, the end [s]."""


@dataclass(frozen=True)
class Moment:
    """One step, as a film needs it."""

    task: str
    """Id of the task."""
    robot: Any
    """Who played."""
    scene: video.Scene
    """Where everything was."""
    shot: video.Shot
    """The frame, but for the human view, and of its history this step alone."""


class Film:
    """Keeps the last minutes of a session."""

    def __init__(self) -> None:
        """Start with nothing."""
        self._moments: list[Moment] = []

    def add(self, session: Session) -> None:
        """Keep the step that was just made."""
        touching = [s for hand in session.lights().values() for s in hand.values()]
        wrong = tuple(state == "wrong" for state in touching)
        shot = video.Shot(
            view=np.empty(0),
            cameras={name: seen.copy() for name, seen in session.pictures().items()},
            instruction=session.reading.heard,
            hands=session.env.agent.hands,
            right=tuple(state in ("right", "touch") for state in touching),
            wrong=wrong,
            step=session.score.steps,
            total_steps=0,
            score=session.score.reward,
            history=((session.score.success, any(wrong)),),
        )
        scene, robot = video.scene_of(session.env), session.env.agent
        self._moments.append(Moment(session.choice.task, robot, scene, shot))
        del self._moments[: -LONGEST * CONTROL_FREQ]

    def write(self, path: Path) -> bool:
        """Draw the film (.mp4, .gif); return whether there was anything to draw."""
        if self._moments:
            video.write_video(path, self._frames(), speed=1.0, hold=0.0)
        return bool(self._moments)

    def _frames(self) -> Iterator[video.Shot]:
        with ExitStack() as opened:
            stages: dict[str, Any] = {}
            for take in self._takes():
                key = f"{take[0].task} {take[0].robot.uid}"
                if key not in stages:
                    stage = closing(video.stage(take[0].task, take[0].robot))
                    stages[key] = opened.enter_context(stage)
                yield from _shots(take, stages[key])

    def _takes(self) -> Iterator[list[Moment]]:
        """Return the moments from one sentence to the next."""
        take: list[Moment] = []
        for moment in self._moments:
            if take and moment.shot.step <= take[-1].shot.step:
                yield take
                take = []
            take.append(moment)
        yield take


def _shots(take: list[Moment], stage: Any) -> Iterator[video.Shot]:
    history: tuple[tuple[bool, bool], ...] = ()
    for moment in take:
        history += moment.shot.history
        yield replace(
            moment.shot,
            view=video.show(stage, moment.scene),
            step=len(history),
            total_steps=len(take),
            history=history,
        )
