"""The results page says what the runs' files say."""

import json
import math

import numpy as np
import pytest
import results
from results import ResultsError, Run

from ir_maniskill.training import plots
from ir_maniskill.training.config import CONFIGS, to_json

TRIANGLE = "NaoTouchCubeTriangle-v1"
BLUE = "Touch the blue cube."


def score(success=1.0, exclusive=0.5, touching=0.8, fingers=3.0, episodes=200):
    return {
        "episodes": episodes,
        "success": success,
        "success_interval": [0.9, 1.0],
        "exclusive": exclusive,
        "exclusive_interval": [0.4, 0.6],
        "touching": touching,
        "right_fingers": fingers,
        "wrong_fingers": 0.25,
    }


def make_run(seed=0, preset="default", fingers=(1.0, 3.2), report=None, **changes):
    config = json.loads(to_json(CONFIGS[preset]))
    config |= {"env_id": TRIANGLE, "seed": seed, **changes}
    rows = [
        {"steps": 1000.0 * (i + 1), "eval/right_fingers": f, "eval/exclusive": 0.1 * i}
        for i, f in enumerate(fingers)
    ]
    report = report or {"instructions": {BLUE: score()}}
    return Run(f"{preset}{seed}", config, 2000, 1.5, rows, report)


def write_folder(folder):
    folder.mkdir()
    config = json.loads(to_json(CONFIGS["default"])) | {"env_id": TRIANGLE}
    (folder / "config.json").write_text(json.dumps(config))
    metrics = "steps,time/collect,time/update\n2048,60,30\n4096,60,30\n"
    (folder / "metrics.csv").write_text(metrics)
    evaluations = "steps,eval/exclusive,eval/right_fingers\n4096,0.5,1.25\n"
    (folder / "evaluations.csv").write_text(evaluations)
    (folder / "evaluation.json").write_text(
        json.dumps({"instructions": {BLUE: score(episodes=33)}})
    )


def test_a_runs_folder_is_taken_in_and_kept(tmp_path):
    write_folder(tmp_path / "a")
    run = results.take_in(tmp_path / "a")
    assert (run.name, run.task, run.steps, run.minutes) == ("a", TRIANGLE, 4096, 3.0)
    assert run.evaluations[0]["eval/right_fingers"] == 1.25
    results.keep(run, tmp_path / "page")
    assert results.kept(tmp_path / "page") == [run]


def test_a_report_made_after_training_goes_before_trainings_own(tmp_path):
    write_folder(tmp_path / "a")
    (tmp_path / "a" / "report.json").write_text(
        json.dumps({"instructions": {BLUE: score(episodes=200)}})
    )
    run = results.take_in(tmp_path / "a")
    assert run.report["instructions"][BLUE]["episodes"] == 200


def test_an_unfinished_run_is_refused(tmp_path):
    write_folder(tmp_path / "a")
    (tmp_path / "a" / "evaluation.json").unlink()
    with pytest.raises(ResultsError, match=r"got no evaluation.json, expected"):
        results.take_in(tmp_path / "a")


def test_a_label_is_the_nearest_preset_and_what_differs():
    assert make_run(seed=5, out="runs/x").label == "`default`"
    assert make_run(preset="paper").label == "`paper`"
    agent = json.loads(to_json(CONFIGS["default"]))["agent"]
    blind = agent | {"senses": ["vision", "touch"]}
    run = make_run(reward_mode="sparse", agent=blind)
    assert run.label == "`default`, agent.senses vision+touch, reward_mode sparse"


def test_runs_that_differ_by_seed_only_are_one_group():
    runs = [make_run(seed=1), make_run(preset="paper"), make_run(seed=0)]
    groups = results.grouped(runs)
    seeds = {
        key: [run.config["seed"] for run in group] for key, group in groups.items()
    }
    assert seeds == {(TRIANGLE, "`default`"): [0, 1], (TRIANGLE, "`paper`"): [0]}


def test_the_papers_level_is_reached_at_the_first_such_evaluation():
    run = make_run(fingers=(1.0, 3.1, 2.0, 3.5))
    assert run.steps_to(3.1) == 2000 and run.steps_to(4) is None


def test_the_worst_seed_and_sentence_count():
    weak = {"instructions": {BLUE: score(exclusive=0.25), "b": score(fingers=2.0)}}
    text = results.seeds_table([make_run(0), make_run(1, fingers=(1, 2), report=weak)])
    row = [cell.strip() for cell in text.splitlines()[2].split("|")[1:-1]]
    assert row[2] == "0, 1"
    assert row[6:] == ["100.0%", "25.0%", "80.0%", "2.00", "2 k, not"]


def test_the_policy_is_compared_with_the_limit_of_its_sentence():
    goal = {"episodes": 10, "exclusive": 1.0, "most_fingers": 6.0}
    goals = {
        "fingers": goal | {"right_fingers": 4.0, "touching": 0.8},
        "touching": goal | {"right_fingers": 2.0, "touching": 1.0},
    }
    oracle = {TRIANGLE: {"instructions": {BLUE: goals}}}
    shipped = {TRIANGLE: {"instructions": {BLUE: score()}}}
    cells = results.limit_table(oracle, shipped).splitlines()[2].split(" | ")
    assert cells[5:] == ["4.00", "3.00", "0.75", "100.0%", "80.0%", "0.80 |"]
    assert "0.75" not in results.limit_table(oracle, {})
    del goals["touching"]
    cells = results.limit_table(oracle, shipped).splitlines()[2].split(" | ")
    assert cells[8:] == ["80.0%", "80.0%", "1.00 |"]


def test_only_what_stands_between_markers_is_written():
    page = "a\n<!-- begin x -->\nold\n<!-- end x -->\nb"
    new = results.fill(page, {"x": r"\1 new"})
    assert new == "a\n<!-- begin x -->\n\\1 new\n<!-- end x -->\nb"
    assert results.fill(new, {"x": r"\1 new"}) == new
    with pytest.raises(ResultsError, match="got 0 sections"):
        results.fill(page, {"y": ""})


def test_the_page_is_what_the_recorded_files_say():
    """If this fails, run scripts/results.py."""
    page = (results.FOLDER / "README.md").read_text(encoding="utf-8")
    assert results.fill(page, results.sections()) == page


def test_seeds_are_averaged_at_every_step_that_each_has_reached():
    runs = [
        [{"steps": 0, "y": 0.0}, {"steps": 20, "y": 2.0}],
        [{"steps": 10, "y": 3.0}, {"steps": 20, "y": 4.0}],
    ]
    steps, values = plots.Curve("a", runs).over_steps("y")
    assert steps.tolist() == [0, 10, 20]
    assert values[0].tolist() == [0, 1, 2]
    assert math.isnan(values[1, 0]) and values[1, 1:].tolist() == [3, 4]


def test_curves_are_drawn_for_each_task(tmp_path):
    names = results.draw([make_run(0), make_run(1), make_run(preset="paper")], tmp_path)
    assert names == [f"{TRIANGLE}.png"]
    one = (tmp_path / names[0]).read_bytes()
    results.draw([make_run(0)], tmp_path)
    assert (tmp_path / names[0]).read_bytes() != one


def test_the_band_reaches_from_the_worst_seed_to_the_best(tmp_path, monkeypatch):
    drawn = []

    def remember(axes, steps, low, high, **_):
        drawn.append((low, high))

    monkeypatch.setattr(plots.Axes, "fill_between", remember)
    runs = [make_run(0).evaluations, make_run(1, fingers=(2.0, 2.2)).evaluations]
    plots.compare([plots.Curve("a", runs)], tmp_path / "a.png", level=3.1)
    low, high = drawn[1]
    assert np.allclose(low, [1.0, 2.2]) and np.allclose(high, [2.0, 3.2])
