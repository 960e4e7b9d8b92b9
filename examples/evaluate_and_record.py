"""Evaluate a policy over seeded episodes, and film it.

    python examples/evaluate_and_record.py --checkpoint runs/single/best.safetensors
    python examples/evaluate_and_record.py --task NaoTouchCubeTriangle-v1

Without a checkpoint the policy is one that acts at random: the figure to beat. Any
function from the state s_t to actions in [-1, 1] can stand in its place. The task is
the one that the policy learned, unless another is named.
"""

from contextlib import closing
from pathlib import Path

import torch
import tyro
from torch import Tensor

from ir_maniskill import make_vec
from ir_maniskill.evaluation.evaluate import (
    EVALUATION_SEED,
    evaluate_policy,
    write_report,
)
from ir_maniskill.evaluation.video import record, write_video
from ir_maniskill.training.checkpoint import load_agent
from ir_maniskill.training.config import CONFIGS


def random_policy(state: dict[str, Tensor]) -> Tensor:
    """Return random actions [N, 26]."""
    return 2 * torch.rand(len(state["instruction"]), 26) - 1


def main(
    checkpoint: Path | None = None,
    task: str | None = None,
    episodes: int = 30,
    films: int = 1,
    out: Path = Path("runs/evaluation"),
) -> None:
    """Evaluate, print the figures, and write report.json and video.mp4."""
    policy, config = random_policy, CONFIGS["default"]
    if checkpoint is not None:
        agent, config, _ = load_agent(checkpoint)
        policy = agent.policy
    task = task or config.env_id
    env_kwargs = config.env_kwargs(training=False)
    seed, frames = EVALUATION_SEED, config.frames
    with closing(make_vec(task, min(8, episodes), **env_kwargs)) as envs:
        report = evaluate_policy(
            policy, envs, episodes=episodes, seed=seed, frames=frames, progress=True
        )
    print(report)
    write_report(out / "report.json", report, checkpoint=str(checkpoint))
    steps = record(
        policy, task, episodes=films, seed=seed, frames=frames, env_kwargs=env_kwargs
    )
    write_video(out / "video.mp4", steps)
    print(f"report.json and video.mp4 are in {out}.")


if __name__ == "__main__":
    tyro.cli(main)
