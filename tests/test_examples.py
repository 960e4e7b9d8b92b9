"""Every example runs as a user would run it; training ones with tiny budgets."""

import os
import re
import runpy
import subprocess
import sys
from pathlib import Path

import pytest

from ir_maniskill import available

EXAMPLES = Path(__file__).parents[1] / "examples"
TINY = """
import runpy, sys
from dataclasses import replace
import ir_maniskill.training.train as loop
from ir_maniskill.training.config import CONFIGS, PPOConfig
loop.FINAL_EPISODES = 1
small = dict(num_envs=2, num_workers=1, eval_episodes=1, ppo=PPOConfig(rollouts=2,
             epochs=1, minibatch=None), camera_height=32, camera_width=16)
for name, config in CONFIGS.items():
    CONFIGS[name] = replace(config, **small)
sys.argv = sys.argv[1:]
runpy.run_path(sys.argv[0], run_name="__main__")
"""
"""Runs an example with its arguments, with presets that take seconds."""


def run(folder: Path, *command: str) -> str:
    """Returns what the command prints; it must end well."""
    done = subprocess.run(
        [sys.executable, "-W", "ignore", *command],
        cwd=folder,
        env={**os.environ, "OMP_NUM_THREADS": "1"},
        capture_output=True,
        text=True,
        timeout=180,
    )
    assert done.returncode == 0, done.stderr[-3000:]
    return done.stdout


def script(name: str) -> str:
    return str(EXAMPLES / name)


def test_every_example_says_how_to_run_it() -> None:
    names = sorted(path.name for path in EXAMPLES.glob("*.py"))
    assert names == [
        "custom_experiment.py",
        "evaluate_and_record.py",
        "random_actions.py",
        "train.py",
        "vector_envs.py",
    ]
    for name in names:
        text = (EXAMPLES / name).read_text()
        assert f"python examples/{name}" in text
        assert 'if __name__ == "__main__":' in text


def test_custom_experiment_takes_less_than_forty_lines() -> None:
    assert len((EXAMPLES / "custom_experiment.py").read_text().splitlines()) < 40


def test_train_knows_the_three_experiments_of_the_paper() -> None:
    example = runpy.run_path(script("train.py"))
    assert set(example["TASKS"].values()) <= set(available())
    for experiment in ("single", "multi", "triangle"):
        for preset in ("default", "paper"):
            config = example["configure"](experiment, preset, None, None)
            assert experiment in config.env_id.lower()
            assert config.total_steps == example["STEPS"][experiment]
            assert config.out == f"runs/{experiment}"


@pytest.mark.render
@pytest.mark.slow
def test_random_actions_leave_a_film(tmp_path: Path) -> None:
    out = run(tmp_path, script("random_actions.py"), "--episodes", "1")
    assert re.match(r"Touch the (blue|red|green) cube\. +(not )?touched", out)
    assert len(list(tmp_path.glob("runs/random_actions/*.mp4"))) == 1


def test_custom_experiment_can_be_stepped(tmp_path: Path) -> None:
    out = run(tmp_path, script("custom_experiment.py"))
    assert "lemon" in out
    assert -2 < float(out.split("dense reward:")[1]) < 2


@pytest.mark.render
def test_vector_envs_finish_two_episodes_each(tmp_path: Path) -> None:
    out = run(tmp_path, script("vector_envs.py"), "--num-envs", "2")
    assert len(re.findall(r"\d of 2 touched", out)) == 2
    assert "'images': (2, 3, 2, 64, 32, 3)" in out


@pytest.mark.render
@pytest.mark.slow
def test_training_then_evaluating_its_policy(tmp_path: Path) -> None:
    out = run(tmp_path, "-c", TINY, script("train.py"), "single", "--steps", "64")
    policy = tmp_path / "runs" / "single" / "best.safetensors"
    assert str(policy.relative_to(tmp_path)) in out and policy.is_file()
    arguments = ("--checkpoint", str(policy), "--episodes", "1")
    out = run(tmp_path, script("evaluate_and_record.py"), *arguments)
    assert re.search(r"Touch the blue cube\. +1 ", out)
    for name in ("report.json", "video.mp4"):
        assert (tmp_path / "runs" / "evaluation" / name).stat().st_size > 1000
