"""Writes the tables and curves of docs/results from what runs left behind.

    python scripts/results.py runs/a runs/b    # take these runs in, then write
    python scripts/results.py                  # write from what was taken in before

Taking a run in copies its config, its evaluations and its final figures (some kB) to
docs/results/runs, so that the page can be written anew without the run's folder. The
tables stand between markers in docs/results/README.md; all else there is written by
hand.
"""

from __future__ import annotations

import argparse
import csv
import json
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from ir_maniskill import experiment as catalog
from ir_maniskill.training.config import CONFIGS
from ir_maniskill.training.plots import Curve, compare

ROOT = Path(__file__).parent.parent
FOLDER = ROOT / "docs" / "results"
POLICIES = ROOT / "assets" / "policies"

PAPER = {
    "NaoTouchCubeSingle-v1": 2.4,
    "NaoTouchCubeMulti-v1": 5.0,
    "NaoTouchCubeTriangle-v1": 3.1,
}
"""The paper's mean return, read as right fingers a step; the page says why."""
UNTOLD = (
    *("env_id", "out", "seed", "total_steps", "num_envs", "num_workers", "threads"),
    *("eval_interval", "eval_episodes", "eval_seed", "checkpoint_interval"),
    "stop_at_success",
)
"""Fields of a config that do not tell one way of learning from another."""
LAYOUTS = ("Single", "Multi", "Triangle", "Shuffled")
"""Order of the tasks on the page."""
NOTHING = "*Nothing has been recorded yet.*"

Figures = Mapping[str, Any]


class ResultsError(ValueError):
    """A folder that is no finished run: what was got, what is expected."""


@dataclass(frozen=True)
class Run:
    """What is kept of a training run."""

    name: str
    """Name of its folder."""
    config: dict[str, Any]
    """Its config.json."""
    steps: int
    """Environment steps made."""
    minutes: float
    """Time spent collecting and learning, evaluations left out [min]."""
    evaluations: list[dict[str, float]]
    """Rows of evaluations.csv."""
    report: dict[str, Any]
    """The best policy's figures on scenes it was not chosen by."""

    @property
    def task(self) -> str:
        """The task it learned."""
        return str(self.config["env_id"])

    @property
    def label(self) -> str:
        """How it learned: the nearest preset, and what differs from it."""
        mine = _flat(self.config)
        changes = {
            name: {k: v for k, v in mine.items() if v != _flat(asdict(config)).get(k)}
            for name, config in CONFIGS.items()
        }
        preset = min(changes, key=lambda name: len(changes[name]))
        told = [f"{k} {_plain(v)}" for k, v in sorted(changes[preset].items())]
        return ", ".join([f"`{preset}`", *told])

    def steps_to(self, fingers: float) -> int | None:
        """Return after how many steps an evaluation first had that many fingers."""
        for row in self.evaluations:
            if row["eval/right_fingers"] >= fingers:
                return int(row["steps"])
        return None


# -- Reading -------------------------------------------------------------------------


def take_in(folder: Path) -> Run:
    """Return what is to be kept of a run's folder.

    `report.json`, written by `ir-maniskill evaluate --json`, goes before the figures
    that training itself ends with.

    Raises:
        ResultsError: A file is missing.
    """
    reports = [folder / "report.json", folder / "evaluation.json"]
    report = next((path for path in reports if path.exists()), reports[-1])
    tables = [folder / "metrics.csv", folder / "evaluations.csv"]
    for path in (folder / "config.json", *tables, report):
        if not path.exists():
            raise ResultsError(f"{folder}: got no {path.name}, expected a finished run")
    metrics, evaluations = map(_rows, tables)
    name = folder.resolve().name
    config = json.loads((folder / "config.json").read_text())
    seconds = sum(row["time/collect"] + row["time/update"] for row in metrics)
    return Run(
        name=name,
        config={**config, "out": f"runs/{name}"},
        steps=int(metrics[-1]["steps"]),
        minutes=round(seconds / 60, 1),
        evaluations=evaluations,
        report=json.loads(report.read_text()),
    )


def keep(run: Run, folder: Path = FOLDER) -> None:
    """Write a run beside the others."""
    path = folder / "runs" / f"{run.name}.json"
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(asdict(run), indent=1) + "\n")


def kept(folder: Path = FOLDER) -> list[Run]:
    """Return all runs that were taken in."""
    paths = sorted((folder / "runs").glob("*.json"))
    return [Run(**json.loads(path.read_text())) for path in paths]


def _rows(table: Path) -> list[dict[str, float]]:
    with table.open(newline="") as file:
        return [{k: float(v) for k, v in row.items()} for row in csv.DictReader(file)]


def _json(path: Path) -> dict[str, Any]:
    return json.loads(path.read_text()) if path.exists() else {}


def _flat(config: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Return the telling fields of a config, nested ones with dots in their names."""
    flat: dict[str, Any] = {}
    for key, value in config.items():
        if isinstance(value, Mapping):
            flat |= _flat(value, f"{prefix}{key}.")
        elif prefix or key not in UNTOLD:
            flat[prefix + key] = list(value) if isinstance(value, tuple) else value
    return flat


def _plain(value: Any) -> str:
    return "+".join(map(str, value)) if isinstance(value, list) else str(value)


# -- Tables --------------------------------------------------------------------------


def table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return a table in Markdown, or a line that says that there is nothing."""
    body = ["| " + " | ".join(row) + " |" for row in rows]
    top = [
        "| " + " | ".join(head) + " |",
        "| " + " | ".join("---" for _ in head) + " |",
    ]
    return "\n".join([*top, *body]) if body else NOTHING


def shipped_table(policies: Mapping[str, Figures]) -> str:
    """Return what each shipped policy reaches, sentence by sentence."""
    head = (
        *("task", "steps", "sentence", "episodes", "success", "exclusive"),
        *("touching", "right fingers", "wrong fingers"),
    )
    rows = [
        (
            *(f"`{task}`", f"{figures['steps'] / 1000:.0f} k", sentence),
            str(score["episodes"]),
            _share(score, "success"),
            _share(score, "exclusive"),
            f"{100 * score['touching']:.1f}%",
            f"{score['right_fingers']:.2f}",
            f"{score['wrong_fingers']:.3f}",
        )
        for task, figures in policies.items()
        for sentence, score in figures["instructions"].items()
    ]
    return table(head, rows)


def limit_table(oracle: Mapping[str, Figures], policies: Mapping[str, Figures]) -> str:
    """Return what the oracle finds, and the shipped policies' share of it."""
    head = (
        *("task", "sentence", "scenes", "oracle: exclusive", "most fingers at once"),
        *("fingers a step", "policy", "ratio", "touching", "policy", "ratio"),
    )
    rows = []
    for task, figures in oracle.items():
        scores = policies.get(task, {}).get("instructions", {})
        for sentence, goals in figures["instructions"].items():
            # Either goal's plans are plans for the other, too.
            many = max(goals.values(), key=lambda goal: goal["right_fingers"])
            soon = max(goals.values(), key=lambda goal: goal["touching"])
            score = scores.get(sentence)
            rows.append(
                (
                    *(f"`{task}`", sentence, str(many["episodes"])),
                    f"{100 * min(many['exclusive'], soon['exclusive']):.0f}%",
                    f"{many['most_fingers']:.1f}",
                    *_ratio(many["right_fingers"], score, "right_fingers", 1),
                    *_ratio(soon["touching"], score, "touching", 100),
                )
            )
    return table(head, rows)


def seeds_table(runs: Sequence[Run]) -> str:
    """Return, for every way of learning, what its worst seed and sentence reach."""
    head = (
        *("task", "learned with", "seeds", "steps", "minutes", "episodes a sentence"),
        *("success", "exclusive", "touching", "right fingers", "paper's level after"),
    )
    rows = []
    for (task, label), group in grouped(runs).items():
        scores = [s for run in group for s in run.report["instructions"].values()]
        rows.append(
            (
                *(f"`{task}`", label),
                ", ".join(str(run.config["seed"]) for run in group),
                _span(f"{run.steps / 1000:.0f}" for run in group) + " k",
                _span(f"{run.minutes:.0f}" for run in group),
                str(min(score["episodes"] for score in scores)),
                *(_worst(scores, name) for name in ("success", "exclusive")),
                _worst(scores, "touching"),
                f"{min(score['right_fingers'] for score in scores):.2f}",
                _reached(group, PAPER.get(task)),
            )
        )
    return table(head, rows)


def controls_table(controls: Mapping[str, Figures]) -> str:
    """Return what each policy reaches when something is taken from it."""
    head = ("task", "control", "episodes", "success", "exclusive", "touching")
    rows = [
        (
            *(f"`{task}`", name, str(score["episodes"])),
            _share(score, "success"),
            _share(score, "exclusive"),
            f"{100 * score['touching']:.1f}%",
        )
        for task, figures in controls.items()
        for name, score in figures["controls"].items()
    ]
    return table(head, rows)


def tasks() -> list[str]:
    """Return all tasks, cubes first, in the order of the paper's experiments."""

    def place(task: str) -> tuple[bool, int]:
        layout = next((i for i, name in enumerate(LAYOUTS) if name in task), -1)
        return "Button" in task, layout

    return sorted(catalog.available(), key=place)


def grouped(runs: Iterable[Run]) -> dict[tuple[str, str], list[Run]]:
    """Return the runs by task and way of learning, each group by seed."""
    order = tasks()
    groups: dict[tuple[str, str], list[Run]] = {}
    for run in sorted(runs, key=lambda run: (order.index(run.task), run.label)):
        groups.setdefault((run.task, run.label), []).append(run)
    for group in groups.values():
        group.sort(key=lambda run: run.config["seed"])
    return groups


def _share(score: Figures, name: str) -> str:
    low, high = score[f"{name}_interval"]
    return f"{100 * score[name]:.1f}% [{100 * low:.1f}, {100 * high:.1f}]"


def _worst(scores: Iterable[Figures], name: str) -> str:
    return f"{100 * min(score[name] for score in scores):.1f}%"


def _span(numbers: Iterable[str]) -> str:
    """Return "a" or "a to b", the least and the largest."""
    ordered = sorted(set(numbers), key=float)
    return " to ".join(dict.fromkeys((ordered[0], ordered[-1])))


def _ratio(
    limit: float, score: Figures | None, name: str, scale: float
) -> tuple[str, str, str]:
    """Return the limit, the policy's figure and their ratio as cells."""
    unit, digits = ("%", 1) if scale == 100 else ("", 2)
    bound = f"{scale * limit:.{digits}f}{unit}"
    if score is None:
        return bound, "", ""
    reached = f"{scale * score[name]:.{digits}f}{unit}"
    return bound, reached, f"{score[name] / limit:.2f}"


def _reached(group: Sequence[Run], level: float | None) -> str:
    """Return after how many steps each seed reached the paper's level."""
    if level is None:
        return ""
    steps = [run.steps_to(level) for run in group]
    return ", ".join("not" if n is None else f"{n / 1000:.0f} k" for n in steps)


# -- Page ----------------------------------------------------------------------------


def draw(runs: Sequence[Run], folder: Path) -> list[str]:
    """Draw the curves of every task and return the pictures' names."""
    groups, names = grouped(runs), []
    for task in dict.fromkeys(task for task, _ in groups):
        curves = [
            Curve(label.replace("`", ""), [run.evaluations for run in group])
            for (other, label), group in groups.items()
            if other == task
        ]
        names.append(f"{task}.png")
        compare(curves, folder / names[-1], level=PAPER.get(task))
    return names


def sections(folder: Path = FOLDER, policies: Path = POLICIES) -> dict[str, str]:
    """Return the text of each marked section of the page."""
    runs = kept(folder)
    shipped = _ordered({path.stem: _json(path) for path in policies.glob("*.json")})
    learned = dict.fromkeys(task for task, _ in grouped(runs))
    pictures = [f"![Learning curves of {task}]({task}.png)" for task in learned]
    oracle, controls = (
        _ordered(_json(folder / f"{name}.json")) for name in ("oracle", "controls")
    )
    return {
        "shipped": shipped_table(shipped),
        "limit": limit_table(oracle, shipped),
        "seeds": seeds_table(runs),
        "curves": "\n\n".join(pictures) or NOTHING,
        "controls": controls_table(controls),
    }


def _ordered(figures: Mapping[str, Figures]) -> dict[str, Figures]:
    return {task: figures[task] for task in tasks() if task in figures}


def fill(page: str, texts: Mapping[str, str]) -> str:
    """Return the page with new text between its markers.

    Raises:
        ResultsError: A section has no markers in the page.
    """
    for name, text in texts.items():
        begin, end = f"<!-- begin {name} -->", f"<!-- end {name} -->"
        pattern = re.compile(f"{re.escape(begin)}.*?{re.escape(end)}", re.DOTALL)
        new = f"{begin}\n{text}\n{end}"
        page, count = pattern.subn(lambda _, new=new: new, page)  # type: ignore[misc]
        if count != 1:
            raise ResultsError(f"page: got {count} sections {begin}, expected one")
    return page


def main() -> None:
    """Take runs in, draw the curves, and write the page's tables."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n", 1)[0])
    parser.add_argument("runs", nargs="*", type=Path, help="folders of finished runs")
    for folder in parser.parse_args().runs:
        keep(take_in(folder))
    draw(kept(), FOLDER)
    page = FOLDER / "README.md"
    page.write_text(fill(page.read_text(encoding="utf-8"), sections()), "utf-8")


if __name__ == "__main__":
    main()
