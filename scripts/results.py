"""Writes the tables and curves of docs/results from what runs left behind.

    python scripts/results.py runs/a runs/b    # take these runs in, then write
    python scripts/results.py                  # write from what was taken in before

Taking a run in copies its config, its evaluations and its final figures (some kB) to
docs/results/runs, so that the pages can be written anew without the run's folder. The
tables stand between markers in docs/results/README.md and, the short ones, in
README.md; all else there is written by hand, but for the sections that stay away while
nothing has been recorded for them.
"""

from __future__ import annotations

import argparse
import json
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from itertools import groupby, product
from pathlib import Path
from typing import Any

import numpy as np

from ir_maniskill import experiment as catalog
from ir_maniskill.evaluation.plots import Curve, compare
from ir_maniskill.training.config import CONFIGS, TrainConfig, decode, to_json
from ir_maniskill.training.run_folder import whole_rows

Figures = Mapping[str, Any]
Cells = tuple[str, ...]
Pictures = dict[str, dict[str, list["Group"]]]

ROOT = Path(__file__).parent.parent
FOLDER = ROOT / "docs" / "results"
POLICIES = ROOT / "assets" / "policies"
IMAGES = ROOT / "docs" / "images"
PAGES = (FOLDER / "README.md", ROOT / "README.md")
"""Whose marked sections are written here."""

PAPER = {
    "NaoTouchCubeSingle-v1": 2.4,
    "NaoTouchCubeMulti-v1": 5.0,
    "NaoTouchCubeTriangle-v1": 3.1,
}
"""The paper's mean return, read as right fingers a step; the page says why."""
UNCOPIED = (
    *("env_id", "out", "checkpoint_interval"),
    *("sim_backend", "render_backend", "num_workers", "threads"),
)
"""Fields of a config that need not be repeated to repeat a run."""
UNTOLD = (
    *(*UNCOPIED, "seed", "total_steps", "num_envs"),
    *("eval_interval", "eval_episodes", "eval_seed", "stop_at_success"),
)
"""Fields of a config that do not tell one way of learning from another."""
LAYOUTS = ("Single", "Multi", "Triangle", "Shuffled")
"""Order of the tasks on the page."""
SUCCESS, EXCLUSIVE = "eval/success", "eval/exclusive"
NOTHING = "*Nothing has been recorded yet.*"
SHUFFLED = "NaoTouchCubeShuffled-v1"
"""The task whose film and controls the README shows by themselves."""

PAPER_SETTINGS = """\
## The paper's settings

The preset `paper` on the same tasks and in the same scenes: after how many steps a
choosing evaluation first reached the level named, for each seed; *of* says how long the
paper's preset was trained, *ratio* how many times sooner the slowest of our seeds was.
From pictures (`agent.senses vision`, experiment I's) it was trained on a GPU, since an
update takes some ten minutes on two cores; the other run is told all by the simulator's
state in their place."""
ONE_SETTING = """\
## What one setting changes

Runs that change one field more than others, beside those others: each figure in the end
is the lowest over sentences and seeds; then exclusive success of both in the choosing
evaluations after equally many steps."""

OBEYS = 0.95
"""Share of episodes from which a way of learning counts as successful."""


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
    def preset(self) -> str:
        """Name of the preset that it differs least from."""
        return min(CONFIGS, key=lambda name: len(self._changes(name)))

    @property
    def changes(self) -> list[str]:
        """Fields in which it differs from that preset, and their values."""
        changes = sorted(self._changes(self.preset).items())
        return [f"{key} {_plain(value)}" for key, value in changes]

    @property
    def idle(self) -> set[str]:
        """Weights of the dense reward that this run did not feel."""
        weights = self.config["dense_weights"]
        binary = catalog.get(self.task).reward == "binary"
        if self.config["reward_mode"] == "sparse":
            idle = set(weights)
        elif binary and not weights["each_finger"]:
            idle = {"gather", "gather_scale"}
        else:
            idle = set() if weights["gather"] else {"gather_scale"}
        idle |= set() if binary else {"each_finger"}
        return {f"dense_weights.{name}" for name in idle}

    @property
    def label(self) -> str:
        """How it learned: the preset, and what differs from it."""
        return ", ".join([f"`{self.preset}`", *self.changes])

    @property
    def command(self) -> str:
        """How to train it with today's presets."""
        changes = self._changes(self.preset, UNCOPIED).items()
        flags = [f"--out runs/{self.name}"]
        flags += [f"--preset {self.preset}"] if self.preset != "default" else []
        flags += [_flag(key, value) for key, value in changes]
        return " ".join([f"ir-maniskill train {self.task}", *flags])

    def _changes(self, preset: str, untold: Sequence[str] = UNTOLD) -> dict[str, Any]:
        theirs = _flat(asdict(CONFIGS[preset]), untold)
        mine, idle = _flat(self.config, untold).items(), self.idle
        return {k: v for k, v in mine if k not in idle and v != theirs.get(k)}

    def steps_to(self, column: str, level: float) -> int | None:
        """Return after how many steps an evaluation first reached a level."""
        for row in self.evaluations:
            if row[column] >= level:
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
    figures = json.loads(report.read_text())
    for told_above in ("config", "checkpoint"):  # with paths of the machine
        figures.pop(told_above, None)
    seconds = sum(row["time/collect"] + row["time/update"] for row in metrics)
    return Run(
        name=name,
        config={**config, "out": f"runs/{name}"},
        steps=int(metrics[-1]["steps"]),
        minutes=round(seconds / 60, 1),
        evaluations=evaluations,
        report=figures,
    )


def keep(run: Run, folder: Path = FOLDER) -> None:
    """Write a run beside the others."""
    path = folder / "runs" / f"{run.name}.json"
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(asdict(run), indent=1) + "\n")


def kept(folder: Path = FOLDER) -> list[Run]:
    """Return all runs that were taken in, each with every field of today's config."""
    runs = []
    for path in sorted((folder / "runs").glob("*.json")):
        run = Run(**json.loads(path.read_text()))
        config = to_json(decode(TrainConfig, run.config))
        runs.append(replace(run, config=json.loads(config)))
    return runs


def _rows(table: Path) -> list[dict[str, float]]:
    return [{k: float(v) for k, v in row.items()} for row in whole_rows(table)]


def _json(path: Path) -> dict[str, Any]:
    return json.loads(path.read_text()) if path.exists() else {}


def _flat(
    config: Mapping[str, Any], untold: Sequence[str], prefix: str = ""
) -> dict[str, Any]:
    """Return all other fields of a config, nested ones with dots in their names."""
    flat: dict[str, Any] = {}
    for key, value in config.items():
        if isinstance(value, Mapping):
            flat |= _flat(value, (), f"{prefix}{key}.")
        elif key not in untold:
            flat[prefix + key] = list(value) if isinstance(value, tuple) else value
    return flat


def _plain(value: Any) -> str:
    return "+".join(map(str, value)) if isinstance(value, list) else str(value)


def _flag(key: str, value: Any) -> str:
    """Return the option of `ir-maniskill train` that sets a field."""
    *group, name = key.replace("_", "-").split(".")
    if isinstance(value, bool):
        return "--" + ".".join([*group, name if value else f"no-{name}"])
    values = value if isinstance(value, list) else [value]
    return " ".join(["--" + ".".join([*group, name]), *map(str, values)])


# -- Groups --------------------------------------------------------------------------


def tasks() -> list[str]:
    """Return all tasks, cubes first, in the order of the paper's experiments."""

    def place(task: str) -> tuple[bool, int]:
        layout = next((i for i, name in enumerate(LAYOUTS) if name in task), -1)
        return "Button" in task, layout

    return sorted(catalog.available(), key=place)


@dataclass(frozen=True)
class Group:
    """Runs of a task that differ by their seeds only."""

    runs: Sequence[Run]
    """At least one, in the order of their seeds."""

    @property
    def task(self) -> str:
        """The task they learned."""
        return self.runs[0].task

    @property
    def label(self) -> str:
        """How they learned."""
        return self.runs[0].label

    @property
    def scores(self) -> list[Figures]:
        """The figures of every seed and sentence."""
        return [s for run in self.runs for s in run.report["instructions"].values()]

    @property
    def effort(self) -> Cells:
        """Seeds, steps and minutes as cells."""
        seeds = ", ".join(str(run.config["seed"]) for run in self.runs)
        steps = _span(f"{run.steps / 1000:.0f}" for run in self.runs)
        return seeds, f"{steps} k", _span(f"{run.minutes:.0f}" for run in self.runs)

    @property
    def episodes(self) -> str:
        """Episodes of each sentence, at least, as a cell."""
        return str(min(score["episodes"] for score in self.scores))

    @property
    def curve(self) -> Curve:
        """Their learning curve."""
        label = self.label.replace("ppo.target_kl None", "fixed step size")
        return Curve(label.replace("`", ""), [r.evaluations for r in self.runs])

    def after(self, steps: float, column: str) -> float:
        """Return the mean over the seeds of a figure at some step of training."""
        values = []
        for rows in self.curve.runs:
            points = [(row["steps"], row[column]) for row in rows]
            values.append(np.interp(steps, *zip(*points, strict=True)))
        return float(np.mean(values))

    def last_step(self) -> float:
        """Return the last step at which every seed was evaluated."""
        return min(run.evaluations[-1]["steps"] for run in self.runs)


def grouped(runs: Iterable[Run]) -> list[Group]:
    """Return the runs by task and way of learning, presets as they are first."""
    order = tasks()

    def place(run: Run) -> tuple[Any, ...]:
        return order.index(run.task), len(run.changes), run.label

    ordered = sorted(runs, key=lambda run: (*place(run), run.config["seed"]))
    return [Group(list(group)) for _, group in groupby(ordered, key=place)]


def chosen(groups: Iterable[Group], shipped: Mapping[str, Figures]) -> dict[str, Group]:
    """Return for each task the way of learning that the README speaks of.

    It is that of the shipped policy, or, where that names no run that is kept, the one
    that differs least from the preset `default`.
    """
    found: dict[str, Group] = {}
    for group in groups:
        name = shipped.get(group.task, {}).get("run")
        if any(run.name == name for run in group.runs):
            found[group.task] = group
        elif group.runs[0].preset == "default":
            found.setdefault(group.task, group)
    return found


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


def headline_table(groups: Iterable[Group]) -> str:
    """Return one row for each task: each figure's lowest over sentences and seeds."""
    head = (
        *("task", "learned with", "seeds", "steps", "minutes", "episodes a sentence"),
        *("success", "exclusive", "touching", "right fingers"),
    )
    rows = [
        (
            *(f"`{group.task}`", group.label, *group.effort),
            group.episodes,
            *(_lowest(group.scores, name) for name in ("success", "exclusive")),
            *_reached(group)[2:],
        )
        for group in groups
    ]
    return table(head, rows)


def seeds_table(groups: Iterable[Group]) -> str:
    """Return, for every way of learning, the lowest over its sentences and seeds."""
    head = (
        *("task", "learned with", "seeds", "steps", "minutes", "episodes a sentence"),
        *("success", "exclusive", "touching", "right fingers", "paper's level after"),
    )
    rows = [
        (
            *(f"`{group.task}`", group.label, *group.effort),
            group.episodes,
            *_reached(group),
            _steps_to(group, "eval/right_fingers", PAPER.get(group.task)),
        )
        for group in groups
    ]
    return table(head, rows)


def fingers_table(
    policies: Mapping[str, Figures], oracle: Mapping[str, Figures]
) -> str:
    """Return the paper's fingers a step, the shipped policies', and the oracle's."""
    head = ("task", "the paper", "shipped policy", "scripted search, at least")
    rows = []
    for task, level in PAPER.items():
        told = policies.get(task, {}).get("instructions", {})
        ours = [score["right_fingers"] for score in told.values()]
        found = [
            max(goal["right_fingers"] for goal in goals.values())
            for goals in oracle.get(task, {}).get("instructions", {}).values()
        ]
        some = 0 < len(found) < len(ours)
        part = f" ({len(found)} of {len(ours)} sentences)" if some else ""
        rows.append((f"`{task}`", f"{level:g}", _mean(ours), _mean(found) + part))
    return table(head, rows)


def ablations(groups: Sequence[Group]) -> list[list[Group]]:
    """Return each way of learning with all that differ from it in one more field.

    Those with nothing to be compared with are left out.
    """
    found = [
        [base, *(group for group in groups if len(beyond(group, base)) == 1)]
        for base in groups
    ]
    return [each for each in found if len(each) > 1]


def beyond(group: Group, base: Group) -> set[str]:
    """Return what a group changes beyond another that changes all else likewise."""
    (one, *_), (other, *_) = group.runs, base.runs
    if (one.task, one.preset) != (other.task, other.preset):
        return set()
    more, less = set(one.changes), set(other.changes)
    return more - less if more > less else set()


def ablations_table(groups: Sequence[Group]) -> str:
    """Return what one field changes: in the end, and after equally many steps."""
    head = (
        *("task", "changed", "seeds", "steps", "success", "exclusive", "touching"),
        *("right fingers", "exclusive after", "this", "unchanged"),
    )
    rows = []
    for base, *others in ablations(groups):
        for group in (base, *others):
            steps = min(base.last_step(), group.last_step())
            same = [f"{100 * g.after(steps, EXCLUSIVE):.0f}%" for g in (group, base)]
            rows.append(
                (
                    f"`{base.task}`",
                    ", ".join(beyond(group, base)) or f"nothing: {base.label}",
                    *group.effort[:2],
                    *_reached(group),
                    *(f"{steps / 1000:.0f} k", *same),
                )
            )
    return table(head, rows)


def rivals(groups: Sequence[Group]) -> dict[str, tuple[list[Group], list[Group]]]:
    """Return for each task the ways of our presets and those nearest to `paper`.

    Of ours they may differ in how long prices grow. Tasks with only one of both have
    nothing to compare and are left out.
    """
    found = {}
    for task in tasks():
        own = [group for group in groups if group.task == task]
        papers = [group for group in own if group.runs[0].preset == "paper"]
        ours = [
            group
            for group in own
            if group not in papers
            and all(c.startswith("lenient_steps") for c in group.runs[0].changes)
        ]
        if ours and papers:
            found[task] = (ours, papers)
    return found


def paper_table(groups: Sequence[Group]) -> str:
    """Return how many steps our presets and the paper's take to the same levels."""
    head = ("task", "level", "ours", "after", "the paper's", "after", "of", "ratio")
    rows = []
    for task, (all_ours, papers) in rivals(groups).items():
        share = f"in {100 * OBEYS:.0f}% of episodes"
        levels = [(SUCCESS, OBEYS, f"success {share}")]
        levels += [(EXCLUSIVE, OBEYS, f"exclusive {share}")]
        if task in PAPER:
            text = f"{PAPER[task]:g} right fingers a step, the paper's"
            levels.append(("eval/right_fingers", PAPER[task], text))
        for theirs, ours, (column, level, text) in product(papers, all_ours, levels):
            rows.append(
                (
                    *(f"`{task}`", text),
                    *(ours.label, _steps_to(ours, column, level)),
                    *(theirs.label, _steps_to(theirs, column, level)),
                    *(theirs.effort[1], _sooner(ours, theirs, column, level)),
                )
            )
    return table(head, rows)


def _sooner(ours: Group, theirs: Group, column: str, level: float) -> str:
    """Return how many times sooner the slowest of ours is than the first of theirs."""
    here = [n for run in ours.runs if (n := run.steps_to(column, level))]
    there = [n for run in theirs.runs if (n := run.steps_to(column, level))]
    if len(here) < len(ours.runs):
        return ""
    bound = "" if there else "more than "
    first = min(there or [run.steps for run in theirs.runs])
    return f"{bound}{first / max(here):.1f}"


def scenes_table(policies: Mapping[str, Figures]) -> str:
    """Return how often each shipped policy obeys all sentences in the same scene."""
    head = ("task", "scenes", "all sentences", "worst pair of sentences")
    rows = [
        (
            *(f"`{task}`", str(same["scenes"]), _share(same, "exclusive")),
            _lowest(same["pairs"], "exclusive"),
        )
        for task, same in (
            (task, figures["same_scene"])
            for task, figures in policies.items()
            if "same_scene" in figures
        )
    ]
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


def _share(score: Figures, name: str) -> str:
    low, high = score[f"{name}_interval"]
    return f"{100 * score[name]:.1f}% [{100 * low:.1f}, {100 * high:.1f}]"


def _lowest(scores: Iterable[Figures], name: str) -> str:
    return _share(min(scores, key=lambda score: score[name]), name)


def _worst(scores: Iterable[Figures], name: str) -> str:
    return f"{100 * min(score[name] for score in scores):.1f}%"


def _reached(group: Group) -> Cells:
    """Return four cells, each the lowest over sentences and seeds."""
    shares = ("success", "exclusive", "touching")
    fingers = min(score["right_fingers"] for score in group.scores)
    return (*(_worst(group.scores, name) for name in shares), f"{fingers:.2f}")


def _mean(values: Sequence[float]) -> str:
    return f"{np.mean(values):.2f}" if values else ""


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


def _steps_to(group: Group, column: str, level: float | None) -> str:
    """Return after how many steps each seed reached the level."""
    if level is None:
        return ""
    steps = [run.steps_to(column, level) for run in group.runs]
    if not any(steps):
        return "never"
    return ", ".join("never" if n is None else f"{n / 1000:.0f} k" for n in steps)


# -- Page ----------------------------------------------------------------------------


def pictures(groups: Sequence[Group], shipped: Mapping[str, Figures]) -> Pictures:
    """Return what to draw: the curves in each picture, by section and name."""
    main = {task: [group] for task, group in chosen(groups, shipped).items()}
    found = rivals(groups).items()
    both = {f"{task}-paper": ours + papers for task, (ours, papers) in found}
    one: dict[str, list[Group]] = {}
    for task, each in groupby(ablations(groups), key=lambda each: each[0].task):
        one |= {f"{task}-ablations{n or ''}": pair for n, pair in enumerate(each)}
    return {"curves": main, "paper": both, "ablations": one}


def draw(wanted: Pictures, folder: Path) -> None:
    """Draw the curves."""
    for name, groups in (pair for part in wanted.values() for pair in part.items()):
        curves = [group.curve for group in groups]
        compare(curves, folder / f"{name}.png", level=PAPER.get(groups[0].task))


def films(folder: Path = IMAGES) -> str:
    """Return the films of shipped policies that there are, two in a row.

    They stand in a table of HTML, in which the last may take a row of its own.
    """
    image = '<code>{0}</code><br><img src="docs/images/{0}.gif" width="400" alt="{0}">'
    shown = [
        image.format(task)
        for task in tasks()
        if task != SHUFFLED and (folder / f"{task}.gif").is_file()
    ]
    rows = []
    for first in range(0, len(shown), 2):
        pair = shown[first : first + 2]
        cell = "<td>" if len(pair) == 2 else '<td colspan="2" align="center">'
        rows.append("<tr>" + "".join(f"{cell}{film}</td>" for film in pair) + "</tr>")
    return "\n".join(["<table>", *rows, "</table>"]) if rows else NOTHING


def section(intro: str, body: str, names: Iterable[str]) -> str:
    """Return a section with its heading, or nothing if it has nothing to show."""
    return "" if body == NOTHING else "\n\n".join([intro, body, *_curves(names)])


def _curves(names: Iterable[str]) -> list[str]:
    return [f"![Learning curves: {name}]({name}.png)" for name in names]


def sections(folder: Path = FOLDER, policies: Path = POLICIES) -> dict[str, str]:
    """Return the text of each marked section of the pages."""
    groups, shipped = grouped(kept(folder)), shipped_figures(policies)
    oracle, controls = (
        _ordered(_json(folder / f"{name}.json")) for name in ("oracle", "controls")
    )
    drawn = pictures(groups, shipped)
    commands = [f"    {run.command}" for group in groups for run in group.runs]
    return {
        "headline": headline_table(chosen(groups, shipped).values()),
        "films": films(),
        "looks": controls_table({k: v for k, v in controls.items() if k == SHUFFLED}),
        "fingers": fingers_table(shipped, oracle),
        "shipped": shipped_table(shipped),
        "scenes": scenes_table(shipped),
        "limit": limit_table(oracle, shipped),
        "curves": "\n\n".join(_curves(drawn["curves"])) or NOTHING,
        "seeds": seeds_table(groups),
        "paper": section(PAPER_SETTINGS, paper_table(groups), drawn["paper"]),
        "ablations": section(ONE_SETTING, ablations_table(groups), drawn["ablations"]),
        "controls": controls_table(controls),
        "commands": "\n".join(commands) or NOTHING,
    }


def shipped_figures(policies: Path = POLICIES) -> dict[str, Figures]:
    """Return the figures of the shipped policies."""
    return _ordered({path.stem: _json(path) for path in policies.glob("*.json")})


def _ordered(figures: Mapping[str, Figures]) -> dict[str, Figures]:
    return {task: figures[task] for task in tasks() if task in figures}


def fill(page: str, texts: Mapping[str, str]) -> str:
    """Return the page with new text between its markers.

    Raises:
        ResultsError: A marked section has no text, or a marker no end.
    """
    for name in re.findall(r"<!-- begin (\w+) -->", page):
        begin, end = f"<!-- begin {name} -->", f"<!-- end {name} -->"
        if name not in texts or page.count(begin) != 1 or end not in page:
            raise ResultsError(
                f"page: got {begin}, expected it once, before {end}, with one of the "
                f"names {', '.join(texts)}"
            )
        pattern = re.compile(f"{re.escape(begin)}.*?{re.escape(end)}", re.DOTALL)
        new = "\n".join(filter(None, (begin, texts[name], end)))
        page = pattern.sub(lambda _, new=new: new, page)  # type: ignore[misc]
    return page


def main() -> None:
    """Take runs in, draw the curves, and write the pages' tables."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n", 1)[0])
    parser.add_argument("runs", nargs="*", type=Path, help="folders of finished runs")
    for folder in parser.parse_args().runs:
        keep(take_in(folder))
    draw(pictures(grouped(kept()), shipped_figures()), FOLDER)
    texts = sections()
    for page in PAGES:
        page.write_text(fill(page.read_text(encoding="utf-8"), texts), "utf-8")


if __name__ == "__main__":
    main()
