"""Learning curves: how a run got better, drawn from what it logged."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from pathlib import Path

from matplotlib.axes import Axes
from matplotlib.figure import Figure

TRAINING = (
    ("train/success", "episodes touching the named object"),
    ("train/exclusive", "and nothing else"),
    ("train/touching", "steps touching it"),
)
"""Columns of metrics.csv that are shares, and what the legend calls them."""
COLORS = ("#2f6fde", "#22a06b", "#9aa3b2")
"""One for each of TRAINING."""
INK = "#24292f"
"""Axes and text."""


class PlotError(ValueError):
    """A run that cannot be drawn: what was got, what is expected."""


def learning_curve(run: Path, out: Path | None = None) -> Path:
    """Draws success, touch and return over the steps of a run.

    Lines are the exploring policy, dots its evaluations without noise; "it" is the
    object that the sentence names.

    Args:
        run: Folder of the run, with metrics.csv and, after the first evaluation,
            evaluations.csv.
        out: Picture to write; None: learning_curve.png in the folder.

    Raises:
        PlotError: The folder holds no metrics.
    """
    metrics = _read(run / "metrics.csv")
    if not metrics:
        raise PlotError(f"{run}: got no metrics.csv with rows, expected a run's folder")
    table = run / "evaluations.csv"
    evaluations = _read(table) if table.exists() else []
    figure = Figure(figsize=(8.0, 5.6), dpi=150, layout="constrained")
    shares, returns = figure.subplots(2, 1, sharex=True, height_ratios=(2, 1))
    _draw_shares(shares, metrics, evaluations)
    _draw_lines(returns, metrics, "train/return", COLORS[0])
    returns.set_ylabel("Return of an episode")
    returns.set_xlabel("Environment steps")
    for axes in (shares, returns):
        _polish(axes)
    path = out or run / "learning_curve.png"
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path)
    return path


def _read(table: Path) -> list[dict[str, float]]:
    """Reads a table of numbers; [] if it is missing."""
    try:
        with table.open(newline="", encoding="utf-8") as file:
            rows = list(csv.DictReader(file))
        return [{k: float(v) for k, v in row.items()} for row in rows]
    except FileNotFoundError:
        return []
    except (TypeError, ValueError) as error:
        raise PlotError(f"{table}: got {error}, expected a table of numbers") from error


def _draw_shares(
    axes: Axes, metrics: Sequence[dict[str, float]], tests: Sequence[dict[str, float]]
) -> None:
    for (name, label), color in zip(TRAINING, COLORS, strict=True):
        _draw_lines(axes, metrics, name, color, label)
        column = name.replace("train/", "eval/")
        points = [(row["steps"], 100 * row[column]) for row in tests if column in row]
        if points:
            axes.plot(*zip(*points, strict=True), "o", color=color, markersize=6)
    axes.set_ylim(-3, 103)
    axes.set_ylabel("Share [%]")
    axes.plot([], [], "o", color=INK, markersize=6, label="evaluated without noise")
    axes.legend(
        loc="lower left",
        bbox_to_anchor=(-0.01, 1.0),
        ncols=len(TRAINING) + 1,
        frameon=False,
        fontsize=8.5,
        labelcolor=INK,
        handlelength=1.2,
        columnspacing=1.1,
    )


def _draw_lines(
    axes: Axes,
    metrics: Sequence[dict[str, float]],
    column: str,
    color: str,
    label: str | None = None,
) -> None:
    scale = 100 if label else 1
    points = [(row["steps"], scale * row[column]) for row in metrics if column in row]
    if points:
        axes.plot(*zip(*points, strict=True), color=color, linewidth=1.8, label=label)


def _polish(axes: Axes) -> None:
    axes.spines[["top", "right"]].set_visible(False)
    axes.spines[["left", "bottom"]].set_color("#c9ced6")
    axes.tick_params(colors=INK, length=0)
    axes.grid(axis="y", color="#e7eaef", linewidth=0.8)
    axes.set_axisbelow(True)
    axes.xaxis.set_major_formatter(lambda value, _: f"{value / 1000:g} k")
