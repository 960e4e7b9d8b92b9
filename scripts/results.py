"""Writes the tables and draws the learning curves of docs/results.md.

    python scripts/results.py                            # from what is kept
    python scripts/results.py runs/a runs/b --label ours    # take these runs in first

Taking a run in copies what its curve needs (some kB) to docs/results/runs. The figures
of the shipped policies are those that stand beside them in assets/policies.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterable, Mapping, Sequence
from itertools import groupby
from operator import itemgetter
from pathlib import Path
from typing import Any

from ir_maniskill.evaluation.plots import Curve, compare
from ir_maniskill.training.run_folder import whole_rows

ROOT = Path(__file__).parent.parent
PAGE = ROOT / "docs" / "results.md"
RUNS = ROOT / "docs" / "results" / "runs"
POLICIES = ROOT / "assets" / "policies"

LAYOUTS = ("Single", "Multi", "Triangle", "Shuffled")
TASKS = [
    f"NaoTouch{shape}{name}-v1" for shape in ("Cube", "Button") for name in LAYOUTS
]
"""In the order of the tables."""
COLUMNS = ("eval/success", "eval/exclusive", "eval/right_fingers")
"""Figures of each evaluation that are kept."""
PAPER = dict(zip(TASKS, (2.4, 5.0, 3.1), strict=False))
"""The paper's mean return in experiments I to III, read as fingers a step."""
RATES = ("success", "exclusive")
LEVEL = 0.95
"""Share of episodes from which a task counts as learned."""


Run = dict[str, Any]
"""What is kept of a training: the `name` of its folder, its `task` and `seed`, how it
learned as the legend says it (`label`; runs with one label differ by seed), its `steps`
and `minutes`, evaluations left out, and the `evaluations`' steps and `COLUMNS`."""


# -- Runs ----------------------------------------------------------------------------


def take_in(folder: Path, label: str) -> Run:
    """Return what is to be kept of a finished run."""
    config = json.loads((folder / "config.json").read_text())
    updates = whole_rows(folder / "metrics.csv")
    seconds = sum(float(r["time/collect"]) + float(r["time/update"]) for r in updates)
    return {
        "name": folder.resolve().name,
        "task": config["env_id"],
        "label": label,
        "seed": config["seed"],
        "steps": int(updates[-1]["steps"]),
        "minutes": round(seconds / 60, 1),
        "evaluations": [
            {"steps": int(row["steps"])} | {c: round(float(row[c]), 4) for c in COLUMNS}
            for row in whole_rows(folder / "evaluations.csv")
        ],
    }


def keep(run: Run, folder: Path = RUNS) -> None:
    """Write a run beside the others, one evaluation a line."""
    text = json.dumps(run).replace('{"steps"', '\n {"steps"')
    (folder / f"{run['name']}.json").write_text(text + "\n")


def kept(folder: Path = RUNS) -> list[Run]:
    """Return all runs that were taken in, by task, label and seed."""
    runs = [json.loads(path.read_text()) for path in folder.glob("*.json")]
    return sorted(runs, key=lambda r: (TASKS.index(r["task"]), r["label"], r["seed"]))


def draw(runs: Sequence[Run], folder: Path) -> None:
    """Draw one picture for each task, with one curve for each label."""
    for task, of_task in groupby(runs, itemgetter("task")):
        curves = [
            Curve(label, [run["evaluations"] for run in same])
            for label, same in groupby(of_task, itemgetter("label"))
        ]
        compare(curves, folder / f"{task}.png", title=task, level=PAPER.get(task))


# -- Tables --------------------------------------------------------------------------


def table(head: str, rows: Iterable[Sequence[str]]) -> str:
    """Return a table in Markdown; `head` has its columns between bars."""
    lines = [head.split(" | "), ["---"] * (head.count(" | ") + 1), *rows]
    return "\n".join("| " + " | ".join(cells) + " |" for cells in lines)


def policies_table(policies: Mapping[str, Any], runs: Iterable[Run]) -> str:
    """Return a row for each shipped policy, with its figures' worst over sentences."""
    by_name = {run["name"]: run for run in runs}
    rows = []
    for task, figures in policies.items():
        scores, run = figures["instructions"].values(), by_name[figures["run"]]
        shares = [_share(min(scores, key=itemgetter(name)), name) for name in RATES]
        fingers = min(score["right_fingers"] for score in scores)
        same = figures.get("same_scene")
        shares.append(_share(same, "exclusive") if same else "")
        effort = _thousands(run["steps"]), f"{run['minutes']:.0f}"
        rows.append((f"`{task}`", *shares, f"{fingers:.1f}", *effort))
    head = "task | success | exclusive | same scene | fingers | steps | minutes"
    return table(head, rows)


def sentences_table(policies: Mapping[str, Any]) -> str:
    """Return a row for each sentence of each shipped policy."""
    rows = []
    for task, figures in policies.items():
        for sentence, score in figures["instructions"].items():
            shares = [_share(score, name) for name in RATES]
            held = f"{score['holding']:.0%}", f"{score['right_fingers']:.1f}"
            color = sentence.split()[-2]  # of "Touch the blue cube."
            rows.append((f"`{task}`", color, *shares, *held))
    head = "task | named | success | exclusive | in touch | fingers"
    return table(head, rows)


def paper_table(runs: Iterable[Run]) -> str:
    """Return after how many steps each run of experiment I had learned it."""
    rows = []
    for run in (run for run in runs if run["task"] == TASKS[0]):
        reached = [steps_to(run, f"eval/{name}", LEVEL) for name in RATES]
        fingers = max(row["eval/right_fingers"] for row in run["evaluations"])
        effort = f"{fingers:.1f}", _thousands(run["steps"])
        rows.append((run["label"], str(run["seed"]), *reached, *effort))
    head = "learned with | seed | success after | exclusive after | most fingers | of"
    return table(head, rows)


def steps_to(run: Run, column: str, level: float) -> str:
    """Return after how many steps an evaluation first reached a level."""
    reached = (r["steps"] for r in run["evaluations"] if r[column] >= level)
    return next((_thousands(steps) for steps in reached), "never")


def _share(score: Mapping[str, Any], name: str) -> str:
    low, high = (100 * bound for bound in score[f"{name}_interval"])
    return f"{100 * score[name]:.1f}% [{low:.1f}, {high:.1f}]"


def _thousands(steps: float) -> str:
    return f"{steps / 1000:.0f} k"


# -- The page ------------------------------------------------------------------------


def tables() -> dict[str, str]:
    """Return the text of each marked section of the page."""
    policies = {t: json.loads((POLICIES / f"{t}.json").read_text()) for t in TASKS}
    return {
        "policies": policies_table(policies, kept()),
        "sentences": sentences_table(policies),
        "paper": paper_table(kept()),
    }


def fill(page: str, texts: Mapping[str, str]) -> str:
    """Return the page with new text between its markers."""
    for name, text in texts.items():
        begin, end = f"<!-- begin {name} -->\n", f"\n<!-- end {name} -->"
        before, rest = page.split(begin)
        page = before + begin + text + end + rest.split(end, 1)[1]
    return page


def main() -> None:
    """Take runs in, draw the curves, and write the page's tables."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n", 1)[0])
    parser.add_argument("runs", nargs="*", type=Path, help="folders of finished runs")
    parser.add_argument("--label", default="ours", help="how they learned")
    given = parser.parse_args()
    for folder in given.runs:
        keep(take_in(folder, given.label))
    draw(kept(), PAGE.parent / "results")
    PAGE.write_text(fill(PAGE.read_text(encoding="utf-8"), tables()), "utf-8")


if __name__ == "__main__":
    main()
