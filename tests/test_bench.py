"""The benchmark: its arithmetic, and that its blocks do what they are named for."""

import itertools
import json
import time
from pathlib import Path
from types import SimpleNamespace

import pytest

from ir_maniskill import cli
from ir_maniskill.bench import simulation
from ir_maniskill.bench.report import Machine, Measure, Report
from ir_maniskill.bench.run import save
from ir_maniskill.bench.timing import Stopwatch, in_turn, timed

MACHINE = Machine("a processor", 2, 0.5, "a renderer", {"python": "3.11"})


def test_in_turn_alternates_and_takes_medians():
    order, a, b = [], iter([1.0, 9.0, 2.0]), iter([5.0, 4.0, 6.0])

    def block(name, values):
        def run():
            order.append(name)
            return next(values)

        return run

    found = in_turn({"a": block("a", a), "b": block("b", b)}, seconds=0)
    assert found == {"a": 2.0, "b": 5.0}
    assert order == ["a", "b"] * 3


def test_timed_divides_by_the_units():
    assert 0.005 <= timed(lambda: time.sleep(0.02), units=4) < 0.1


def test_stopwatch_counts_nested_time_once(monkeypatch):
    clock = iter([0.0, 1.0, 4.0, 6.0])  # outer begins, inner begins, ends, outer ends
    monkeypatch.setattr(time, "perf_counter", lambda: next(clock))
    watch = Stopwatch()
    with watch.part("outer"), watch.part("inner"):
        pass
    assert watch.seconds == {"outer": 1.0 + 2.0, "inner": 3.0}


def test_stopwatch_watches_a_method():
    class Worker:
        def work(self, value):
            return 2 * value

    watch, worker = Stopwatch(), Worker()
    watch.watch(worker, "work", "working")
    assert worker.work(3) == 6
    assert watch.seconds["working"] > 0


def test_the_profile_leaves_resets_out(monkeypatch):
    def work(*_):
        pass

    scene = SimpleNamespace(step=work, update_render=work, sensors={})
    agent = SimpleNamespace(set_action=work)
    names = "evaluate get_reward _contact_force _get_obs_agent _get_obs_extra"
    methods = dict.fromkeys([*names.split(), "_fetch_color"], work)
    base = SimpleNamespace(scene=scene, agent=agent, **methods)
    env = SimpleNamespace(
        unwrapped=base,
        reset=lambda: base.evaluate(),
        step=lambda _: base.evaluate(),
        close=work,
    )
    monkeypatch.setattr(simulation, "make", lambda *_: env)
    monkeypatch.setattr(simulation, "actions", lambda _, steps: range(steps))
    clock = itertools.count(0.0)  # a second passes between two looks
    monkeypatch.setattr(time, "perf_counter", lambda: next(clock))
    found = simulation.profile("trivial", seconds=0)
    assert found == {"Python, all the rest": 2.0, "what contacts mean": 1.0}


def test_measures_know_whether_the_goal_is_reached():
    assert Measure("k", "w", 30, 30).reached
    assert not Measure("k", "w", 29, 30).reached
    assert Measure("k", "w", 4, 5, at_most=True).reached
    assert not Measure("k", "w", 6, 5, at_most=True).reached


def test_report_is_saved_as_json(tmp_path):
    report = Report(MACHINE, (Measure("k", "w", 2.0, 1.0),), {"physics": 0.001})
    save(report, tmp_path / "new" / "bench.json")
    read = json.loads((tmp_path / "new" / "bench.json").read_text())
    assert read["measures"][0]["value"] == 2.0
    assert read["measures"][0]["reached"] is True
    assert read["machine"]["cores"] == 2
    assert "physics" in str(report)


def test_machine_facts_are_there():
    machine = Machine.here()
    assert machine.cores >= 1
    assert machine.versions["sapien"]


@pytest.mark.render
def test_bare_loop_drives_the_same_motion(multi_env):
    multi_env.reset(seed=0)
    bare = simulation.BareLoop(multi_env)
    robot = multi_env.unwrapped.agent.robot
    after_env = robot.get_qpos().clone()
    assert bare() > 0
    # Starts differ by their jitter only: the same targets lead to about the same end.
    assert (robot.get_qpos() - after_env).abs().median() < 0.1


def test_command_line_reads_its_options():
    command = cli.parse(["bench", "--seconds", "2", "--quick", "--json", "b.json"])
    assert command == cli.Bench(json=Path("b.json"), seconds=2.0, quick=True)


def test_command_line_refuses_impossible_durations(capsys):
    assert cli.run(["bench", "--seconds", "0"]) == 2
    assert "--seconds: got 0" in capsys.readouterr().err
