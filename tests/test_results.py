"""The results page says what the runs' files say."""

import json
import math

import numpy as np
import pytest
import results
from results import ResultsError, Run

from ir_maniskill import cli
from ir_maniskill.evaluation import plots
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
    shares = [{"eval/success": float(i), "eval/exclusive": 0.1 * i} for i in range(4)]
    rows = [
        {"steps": 1000.0 * (i + 1), "eval/right_fingers": f, **shares[i]}
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


def assert_trains_again(run):
    """Assert that the run's command trains what it was, but for what it never felt."""
    config = json.loads(to_json(cli.parse(run.command.split()[1:]).config))
    for each in (config, want := json.loads(json.dumps(run.config))):
        each |= dict.fromkeys(results.UNCOPIED)
        each["dense_weights"] |= {name.split(".")[1]: None for name in run.idle}
    assert config == want


@pytest.mark.parametrize("run", results.kept(), ids=lambda run: run.name)
def test_the_command_of_a_recorded_run_trains_it_again(run):
    assert_trains_again(run)
    assert f"train {run.task} --out runs/{run.name}" in run.command


def test_a_command_can_turn_off_what_the_preset_has_and_start_from_the_papers():
    assert_trains_again(make_run(preset="paper", stop_at_success=0.5))
    run = changed(3, film=False, hidden=[20, 10])
    assert_trains_again(run)
    assert run.command.endswith("--seed 3 --agent.no-film --agent.hidden 20 10")


def test_runs_that_differ_by_seed_only_are_one_group():
    runs = [make_run(seed=1), make_run(preset="paper"), make_run(seed=0)]
    groups = results.grouped(runs)
    assert [(group.label, group.effort[0]) for group in groups] == [
        ("`default`", "0, 1"),
        ("`paper`", "0"),
    ]


def test_a_level_is_reached_at_the_first_such_evaluation():
    run = make_run(fingers=(1.0, 3.1, 2.0, 3.5))
    assert run.steps_to("eval/right_fingers", 3.1) == 2000
    assert run.steps_to("eval/right_fingers", 4) is None


def weak():
    return {"instructions": {BLUE: score(exclusive=0.25), "b": score(fingers=2.0)}}


def cells(text, row=0):
    return [cell.strip() for cell in text.splitlines()[2 + row].split("|")[1:-1]]


def test_the_worst_seed_and_sentence_count():
    runs = [make_run(0), make_run(1, fingers=(1, 2), report=weak())]
    row = cells(results.seeds_table(results.grouped(runs)))
    assert row[2] == "0, 1"
    assert row[6:] == ["100.0%", "25.0%", "80.0%", "2.00", "2 k, never"]
    row = cells(results.headline_table(results.grouped(runs)))
    assert row[:5] == [f"`{TRIANGLE}`", "`default`", "0, 1", "2 k", "2"]
    assert row[7:] == ["25.0% [40.0, 60.0]", "80.0%", "2.00"]


def test_the_readme_speaks_of_what_ships_or_else_of_what_is_nearest_the_default():
    groups = results.grouped([make_run(0), make_run(1, reward_mode="sparse")])
    default, sparse = groups
    assert results.chosen(groups, {}) == {TRIANGLE: default}
    shipped = {TRIANGLE: {"run": sparse.runs[0].name}}
    assert results.chosen(groups, shipped) == {TRIANGLE: sparse}
    assert results.chosen([sparse], {}) == {TRIANGLE: sparse}
    assert results.chosen(results.grouped([make_run(preset="paper")]), {}) == {}


def changed(seed, **agent):
    config = json.loads(to_json(CONFIGS["default"]))["agent"]
    return make_run(seed, agent=config | agent)


def test_ablations_are_the_runs_that_differ_from_others_in_one_field():
    far = make_run(8, fingers=(1, 1, 1, 1), reward_mode="sparse")
    both = changed(7, film=False, auxiliary_weight=0.0)
    groups = results.grouped(
        [make_run(0), both, changed(3, film=False), far, make_run(4, "paper")]
    )
    found, further = results.ablations(groups)
    changes = [group.runs[0].changes for group in found]
    assert changes == [[], ["agent.film False"], ["reward_mode sparse"]]
    assert [results.beyond(group, further[0]) for group in further] == [
        set(),
        {"agent.auxiliary_weight 0.0"},
    ]
    text = results.ablations_table(groups)
    # Exclusive success grows by 0.1 every 1000 steps; the default stops at 2000.
    assert cells(text, 0)[1] == "nothing: `default`" and cells(text, 2)[3] == "2 k"
    assert cells(text, 2)[-3:] == ["2 k", "10%", "10%"]
    assert results.ablations(results.grouped([changed(3, film=False)])) == []
    assert results.ablations(results.grouped([make_run(0)])) == []


def test_presets_are_compared_by_the_steps_to_the_same_levels():
    paper, blind = (
        make_run(0, "paper", (0, 0, 3.2)),
        make_run(0, "paper", (0, 3.2), camera_width=16),
    )
    ours = [make_run(0), make_run(1, fingers=(3.1, 0))]
    groups = results.grouped([*ours, paper, blind, changed(2, film=False)])
    text = results.paper_table(groups)
    assert cells(text, 2)[2:] == [
        "`default`",
        "2 k, 1 k",
        "`paper`",
        "3 k",
        "2 k",
        "1.5",
    ]
    assert cells(text, 0)[2:6] == ["`default`", "2 k, 2 k", "`paper`", "2 k"]
    assert cells(text, 1)[3] == cells(text, 1)[5] == "never"
    assert cells(text, 1)[-1] == ""
    assert cells(text, 5)[4:6] == ["`paper`, camera_width 16", "2 k"]
    assert len(text.splitlines()) == 2 + 2 * 3
    assert results.rivals(groups[:1]) == results.rivals(groups[1:]) == {}


def test_where_the_papers_preset_never_gets_there_its_steps_are_a_bound():
    groups = results.grouped([make_run(0), make_run(0, "paper", (0, 0, 0, 0))])
    assert cells(results.paper_table(groups), 2)[5:] == [
        "never",
        "2 k",
        "more than 1.0",
    ]


def test_a_policy_is_told_every_sentence_in_the_same_scene():
    pairs = [score(exclusive=0.75), score(exclusive=0.5)]
    same = score(exclusive=0.25) | {"scenes": 8, "pairs": pairs}
    text = results.scenes_table({TRIANGLE: {"same_scene": same}, "other": {}})
    assert cells(text)[1:] == ["8", "25.0% [40.0, 60.0]", "50.0% [40.0, 60.0]"]
    assert len(text.splitlines()) == 3


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


def test_fingers_are_means_over_sentences_and_the_oracles_its_best_plans():
    goals = {name: {"right_fingers": f} for name, f in (("a", 4.0), ("b", 2.0))}
    oracle = {TRIANGLE: {"instructions": {BLUE: goals}}}
    told = {BLUE: score(), "b": score(fingers=2.0)}
    shipped = {TRIANGLE: {"instructions": told}}
    text = results.fingers_table(shipped, oracle)
    assert cells(text, 2)[1:] == ["3.1", "2.50", "4.00 (1 of 2 sentences)"]
    assert cells(text, 0)[1:] == ["2.4", "", ""]
    del told["b"]
    text = results.fingers_table(shipped, oracle)
    assert cells(text, 2)[2:] == ["3.00", "4.00"]


def test_the_films_that_there_are_stand_two_in_a_row(tmp_path):
    for name in ("CubeSingle", "CubeMulti", "CubeShuffled", "ButtonMulti"):
        (tmp_path / f"NaoTouch{name}-v1.gif").touch()
    first, last = results.films(tmp_path).splitlines()[1:-1]
    assert "CubeSingle" in first and "CubeMulti" in first and first.count("<td") == 2
    assert "ButtonMulti" in last and last.count('<td colspan="2"') == 1
    assert results.films(tmp_path / "none") == results.NOTHING


def test_a_section_without_records_stays_away_with_its_heading():
    nothing = results.table(("a",), [])
    assert results.section("## Heading", nothing, []) == ""
    text = results.section("## Heading", "| a |", ["b"])
    assert text == "## Heading\n\n| a |\n\n![Learning curves: b](b.png)"
    page = "a\n<!-- begin x -->\nold\n<!-- end x -->\n"
    assert results.fill(page, {"x": ""}) == "a\n<!-- begin x -->\n<!-- end x -->\n"


def test_only_what_stands_between_markers_is_written():
    page = "a\n<!-- begin x -->\nold\n<!-- end x -->\nb"
    new = results.fill(page, {"x": r"\1 new", "y": ""})
    assert new == "a\n<!-- begin x -->\n\\1 new\n<!-- end x -->\nb"
    assert results.fill(new, {"x": r"\1 new"}) == new
    for wrong in (page + page, page.replace("end", "and"), page.replace("x", "z")):
        with pytest.raises(ResultsError, match="expected it once"):
            results.fill(wrong, {"x": ""})


@pytest.mark.parametrize("path", results.PAGES, ids=lambda path: str(path.parent.name))
def test_a_page_is_what_the_recorded_files_say(path):
    """If this fails, run scripts/results.py."""
    page = path.read_text(encoding="utf-8")
    assert results.fill(page, results.sections()) == page


def test_the_pages_have_all_sections():
    pages = "".join(path.read_text(encoding="utf-8") for path in results.PAGES)
    assert all(f"<!-- begin {name} -->" in pages for name in results.sections())


def test_every_picture_of_the_pages_is_there():
    groups, shipped = results.grouped(results.kept()), results.shipped_figures()
    for names in results.pictures(groups, shipped).values():
        assert all((results.FOLDER / f"{name}.png").is_file() for name in names)


def test_seeds_are_averaged_at_every_step_that_each_has_reached():
    runs = [
        [{"steps": 0, "y": 0.0}, {"steps": 20, "y": 2.0}],
        [{"steps": 10, "y": 3.0}, {"steps": 20, "y": 4.0}],
    ]
    steps, values = plots.Curve("a", runs).over_steps("y")
    assert steps.tolist() == [0, 10, 20]
    assert values[0].tolist() == [0, 1, 2]
    assert math.isnan(values[1, 0]) and values[1, 1:].tolist() == [3, 4]


def test_curves_are_drawn_for_each_comparison(tmp_path):
    runs = [make_run(0), make_run(1), make_run(preset="paper"), changed(3, film=False)]
    wanted = results.pictures(results.grouped(runs), {})
    results.draw(wanted, tmp_path)
    names = [f"{TRIANGLE}{end}.png" for end in ("", "-ablations", "-paper")]
    assert {path.name for path in tmp_path.iterdir()} == set(names)
    pictures = {(tmp_path / name).read_bytes() for name in names}
    assert len(pictures) == 3


def test_every_seed_has_a_line_of_its_own(tmp_path, monkeypatch):
    drawn = []
    monkeypatch.setattr(
        plots.Axes, "plot", lambda axes, x, y, *_, **__: drawn.append(y)
    )
    runs = [make_run(0).evaluations, make_run(1, fingers=(2.0, 2.2)).evaluations]
    plots.compare([plots.Curve("a", runs)], tmp_path / "a.png")
    mean, seeds = drawn[2:]
    assert np.allclose(mean, [1.5, 2.7]) and np.allclose(seeds, [[1, 2], [3.2, 2.2]])


def test_mean_and_band_end_with_the_first_seed_that_does(tmp_path, monkeypatch):
    lines, bands = [], []
    monkeypatch.setattr(plots.Axes, "plot", lambda _, x, *__, **___: lines.append(x))
    monkeypatch.setattr(
        plots.Axes, "fill_between", lambda _, x, *__, **___: bands.append(x)
    )
    runs = [make_run(0, fingers=(1.0, 3.2, 3.0)), make_run(1)]
    curve = plots.Curve("a", [run.evaluations for run in runs])
    plots.compare([curve], tmp_path / "a.png")
    mean, seeds = lines[:2]
    assert mean.tolist() == bands[0].tolist() == [1000, 2000]
    assert seeds.tolist() == [1000, 2000, 3000]


def test_the_band_reaches_from_the_worst_seed_to_the_best(tmp_path, monkeypatch):
    drawn = []

    def remember(axes, steps, low, high, **_):
        drawn.append((low, high))

    monkeypatch.setattr(plots.Axes, "fill_between", remember)
    runs = [make_run(0).evaluations, make_run(1, fingers=(2.0, 2.2)).evaluations]
    plots.compare([plots.Curve("a", runs)], tmp_path / "a.png", level=3.1)
    low, high = drawn[1]
    assert np.allclose(low, [1.0, 2.2]) and np.allclose(high, [2.0, 3.2])
