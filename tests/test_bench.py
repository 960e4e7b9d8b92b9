"""The benchmark: its arithmetic, and that its blocks do what they are named for."""

import json
import time
from pathlib import Path

import pytest

from ir_maniskill import bench, cli
from ir_maniskill.bench import Report, Row
from ir_maniskill.training.config import CONFIGS


def test_in_turn_alternates_and_takes_medians():
    order, a, b = [], iter([0.5, 9.0, 0.25]), iter([5.0, 2.0, 1.0])

    def block(name, times):
        def run():
            order.append(name)
            return next(times)

        return run

    found = bench.in_turn({"a": block("a", a), "b": block("b", b)}, seconds=0)
    assert found == {"a": 2.0, "b": 0.5}
    assert order == ["a", "b"] * 3


def test_timed_divides_by_the_steps():
    assert 0.005 <= bench.timed(lambda: time.sleep(0.02), steps=4) < 0.1


class FakeEnv:
    """Notes its calls; resets take longer than steps."""

    def __init__(self):
        self.calls = []

    def reset(self):
        time.sleep(0.2)
        self.calls.append("reset")

    def step(self, action):
        self.calls.append(action)


def test_resets_are_not_timed(monkeypatch):
    env = FakeEnv()
    monkeypatch.setattr(bench, "actions", lambda _, steps: list(range(steps)))
    env.spec = type("Spec", (), {"max_episode_steps": 5})
    block = bench.Stepping(env, 2)
    assert max(block(), block(), block()) < 0.05
    assert env.calls == ["reset", 0, 1, 2, 3, "reset", 0, 1]


def test_a_report_is_a_table_and_is_saved_as_json(tmp_path, monkeypatch):
    report = Report({"cpus": 2}, (Row("one env", 300.0, "the peer", 10.0),))
    assert str(report).splitlines()[-1].split() == (
        ["one", "env", "300.0", "the", "peer", "10.0", "30.00"]
    )
    monkeypatch.setattr(bench, "run", lambda seconds, quick: report)
    path = tmp_path / "new" / "bench.json"
    assert cli.run(["bench", "--json", str(path)]) == 0
    read = json.loads(path.read_text())
    assert read["rows"][0]["ratio"] == 30.0 and read["machine"] == {"cpus": 2}


@pytest.mark.render
def test_bare_loop_drives_the_same_motion(multi_env):
    multi_env.reset(seed=0)
    bare = bench.BareLoop(multi_env)
    robot = multi_env.unwrapped.agent.robot
    after_env = robot.get_qpos().clone()
    assert bare() > 0
    # Starts differ by their jitter only: the same targets lead to about the same end.
    assert (robot.get_qpos() - after_env).abs().median() < 0.1


def test_training_is_timed_by_what_it_logs(monkeypatch):
    steps = CONFIGS["default"].ppo.steps_per_update

    def train(task, *, out, total_steps, eval_episodes):
        assert (task, total_steps) == (bench.OURS, 3 * steps)
        rows = ["steps,time/collect,time/update", "1,2,2", "2,4,4", "3,9,9"]
        (Path(out) / "metrics.csv").write_text("\n".join(rows) + "\n")

    monkeypatch.setattr(bench, "train", train)
    (row,) = bench.learning(updates=3)
    assert (row.speed, row.speed_beside) == (steps / 8, steps / 4)  # medians
