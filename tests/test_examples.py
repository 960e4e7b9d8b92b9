"""Every example runs as a user would run it."""

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from ir_maniskill import load_policy

EXAMPLES = Path(__file__).parents[1] / "examples"
TINY = """
import runpy, sys
from dataclasses import replace
import ir_maniskill.training.runner as loop
import ir_maniskill.evaluation.video as video
from ir_maniskill.training.config import CONFIGS, PPOConfig, SACConfig
loop.FINAL_EPISODES, video.SHARPNESS = 2, 0.1
small = dict(num_envs=2, num_workers=1, eval_episodes=2, ppo=PPOConfig(64, 1, None),
             sac=SACConfig(random_steps=64, batch=8), camera_height=32, camera_width=16)
for name, config in CONFIGS.items():
    CONFIGS[name] = replace(config, **small)
sys.argv = sys.argv[1:]
runpy.run_path(sys.argv[0], run_name="__main__")
"""
"""Runs an example with its arguments, with presets and films that take seconds."""


def run(folder: Path, *command: str) -> str:
    """Return what the command prints; it must end well."""
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


@pytest.mark.render
@pytest.mark.slow
def test_vector_envs_finish_two_episodes_each(tmp_path: Path) -> None:
    out = run(tmp_path, script("vector_envs.py"), "--num-envs", "2")
    assert len(re.findall(r"\d of 2 touched", out)) == 2
    assert "'images': (2, 3, 2, 64, 32, 3)" in out


@pytest.mark.render
@pytest.mark.slow
def test_maniskills_ppo_layout_trains(tmp_path: Path) -> None:
    arguments = ("--iterations", "2", "--steps", "32")
    out = run(tmp_path, script("maniskill_ppo.py"), *arguments)
    assert len(re.findall(r"step \d+: mean reward \S+, \d of 1 episodes", out)) == 2


@pytest.mark.render
@pytest.mark.slow
def test_stable_baselines3_trains(tmp_path: Path) -> None:
    pytest.importorskip("stable_baselines3", reason="needs the extra `sb3`")
    arguments = ("--steps", "256", "--rollout", "128", "--episodes", "1")
    out = run(tmp_path, script("sb3_ppo.py"), *arguments)
    assert re.search(r"total_timesteps +\| 256 ", out)
    assert re.search(r"\d of 1 episodes touched", out)
    assert (tmp_path / "runs" / "sb3_ppo.zip").stat().st_size > 1000


@pytest.mark.render
@pytest.mark.slow
def test_a_policy_is_trained_evaluated_and_filmed(tmp_path: Path) -> None:
    arguments = ("--steps", "64", "--episodes", "1")
    out = run(tmp_path, "-c", TINY, script("train.py"), *arguments)
    assert re.search(r"Touch the blue cube\. +1 ", out)
    folder = tmp_path / "runs" / "NaoTouchCubeSingle-v1"
    for name in ("best.safetensors", "film.mp4"):
        assert (folder / name).stat().st_size > 1000 and name in out


@pytest.mark.render
@pytest.mark.slow
def test_a_task_is_learned_from_scratch_or_from_another_policy(tmp_path: Path) -> None:
    command = ("-c", TINY, script("pretrained.py"), "--steps", "128")
    run(tmp_path, *command)
    out = run(tmp_path, *command, "--init-from", "NaoInstruct-v1")
    assert re.search(r"Press the crimson bell\. +1 .*\nGrab the navy tin\. +1 ", out)
    assert "best policy is in runs/pretrained/best.safetensors" in out
    before, scratch, begun = (
        load_policy(name).agent.actor.layers[0].weight
        for name in (
            "NaoInstruct-v1",
            tmp_path / "runs/scratch",
            tmp_path / "runs/pretrained",
        )
    )
    assert (begun - before).norm() < 0.1 * before.norm()
    assert (scratch - before).norm() > 0.5 * before.norm()


# -- The notebook ----------------------------------------------------------------------

CELLS = """
import json, sys
from IPython.core.interactiveshell import InteractiveShell
shell = InteractiveShell.instance()
for cell in json.loads(open(NOTEBOOK).read())["cells"]:
    if cell["cell_type"] == "code":
        source = "".join(cell["source"]).replace("_000", "")
        done = shell.run_cell(source.replace("episodes=3", "episodes=1"))
        done.raise_error()
        print("shown:", type(done.result).__name__)
"""
"""Runs the cells of a notebook with tiny budgets, and says what each shows."""


@pytest.mark.render
@pytest.mark.slow
def test_the_notebook_runs(tmp_path: Path) -> None:
    notebook = EXAMPLES / "quickstart.ipynb"
    cells = f"NOTEBOOK = {str(notebook)!r}\n{CELLS}"
    (tmp_path / "cells.py").write_text(cells)
    out = run(tmp_path, "-c", TINY, "cells.py")
    shown = re.findall(r"^shown: (\w+)", out, re.M)
    assert shown == ["Image", "Image", "NoneType", "Video", "NoneType", "Image"]
    assert out.count("touched: True, and nothing else: True") == 3
    assert "The best policy, of step" in out


def test_the_notebook_is_small_and_has_no_outputs() -> None:
    text = (EXAMPLES / "quickstart.ipynb").read_text()
    cells = json.loads(text)["cells"]
    assert len(text) < 10_000
    assert all(cell.get("outputs", []) == [] for cell in cells)
