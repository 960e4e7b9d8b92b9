"""The results page says what the runs' files say."""

import json
import math

import pytest
import results
from results import COLUMNS, TASKS

from ir_maniskill.evaluation.plots import Curve


def make_run(task=TASKS[0], label="ours", seed=0, fingers=(1.0, 3.2)):
    """Return a run whose success is 0, 1 and exclusive success 0, 0.5."""
    rows = [
        {"steps": 1000 * (i + 1), **dict(zip(COLUMNS, (i, i / 2, f), strict=True))}
        for i, f in enumerate(fingers)
    ]
    facts = {"name": f"{label}{seed}", "task": task, "label": label, "seed": seed}
    return facts | {"steps": 4096, "minutes": 1.5, "evaluations": rows}


def cells(text, row=0):
    return [cell.strip() for cell in text.splitlines()[2 + row].split("|")[1:-1]]


def score(success=1.0, exclusive=0.5, fingers=3.0):
    return {
        **{"success": success, "success_interval": [success - 0.1, success]},
        **{"exclusive": exclusive, "exclusive_interval": [exclusive - 0.1, exclusive]},
        **{"holding": 0.8, "right_fingers": fingers},
    }


def test_a_finished_run_is_taken_in_and_kept(tmp_path):
    config = {"env_id": TASKS[2], "seed": 5}
    (tmp_path / "config.json").write_text(json.dumps(config))
    metrics = "steps,time/collect,time/update\n2048,60,30\n4096,60,30\n"
    (tmp_path / "metrics.csv").write_text(metrics)
    evaluations = f"steps,other,{','.join(COLUMNS)}\n4096,7,1,0.5,1.25\n"
    (tmp_path / "evaluations.csv").write_text(evaluations)
    run = results.take_in(tmp_path, "ours")
    row = {"steps": 4096, **dict(zip(COLUMNS, (1, 0.5, 1.25), strict=True))}
    expected = {"name": tmp_path.name, "task": TASKS[2], "label": "ours", "seed": 5}
    assert run == expected | {"steps": 4096, "minutes": 3.0, "evaluations": [row]}
    results.keep(run, tmp_path)
    (tmp_path / "config.json").unlink()
    assert results.kept(tmp_path) == [run]


def test_each_figure_is_the_worst_over_sentences():
    told = {"a blue cube.": score(exclusive=0.25), "a red cube.": score(0.9, 0.5, 2.0)}
    policy = {"run": "ours0", "instructions": told, "same_scene": score(exclusive=0.2)}
    text = results.policies_table({TASKS[0]: policy}, [make_run()])
    assert cells(text)[1:] == [
        "90.0% [80.0, 90.0]",
        "25.0% [15.0, 25.0]",
        "20.0% [10.0, 20.0]",
        "2.0",
        "4 k",
        "2",
    ]
    assert cells(results.sentences_table({TASKS[0]: policy}), 1)[1:3] == [
        "red",
        "90.0% [80.0, 90.0]",
    ]


def test_a_level_is_reached_at_the_first_such_evaluation():
    run = make_run(fingers=(1.0, 3.1, 2.0, 3.5))
    assert results.steps_to(run, "eval/right_fingers", 3.1) == "2 k"
    assert results.steps_to(run, "eval/right_fingers", 4) == "never"
    row = cells(results.paper_table([run, make_run(TASKS[1])]))
    assert row == ["ours", "0", "2 k", "3 k", "3.5", "4 k"]


def test_only_what_stands_between_markers_is_written():
    page = "a\n<!-- begin x -->\nold\n<!-- end x -->\nb"
    new = results.fill(page, {"x": r"\1 new"})
    assert new == "a\n<!-- begin x -->\n\\1 new\n<!-- end x -->\nb"
    assert results.fill(new, {"x": r"\1 new"}) == new
    with pytest.raises(ValueError):
        results.fill(page, {"y": ""})


def test_the_page_is_what_the_recorded_files_say():
    """If this fails, run scripts/results.py."""
    page = results.PAGE.read_text(encoding="utf-8")
    assert results.fill(page, results.tables()) == page


def test_seeds_are_compared_at_every_step_that_each_has_reached():
    runs = [
        [{"steps": 0, "y": 0.0}, {"steps": 20, "y": 2.0}],
        [{"steps": 10, "y": 3.0}, {"steps": 20, "y": 4.0}],
    ]
    steps, values = Curve("a", runs).over_steps("y")
    assert steps.tolist() == [0, 10, 20]
    assert values[0].tolist() == [0, 1, 2]
    assert math.isnan(values[1, 0]) and values[1, 1:].tolist() == [3, 4]
