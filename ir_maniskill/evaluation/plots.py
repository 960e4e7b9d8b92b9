"""Learning curves: how runs got better, drawn from what they logged.

Legend: R runs, P points.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import cycle
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ir_maniskill.training.run_folder import whole_rows

TRAINING = (
    ("train/success", "episodes that reach the goal"),
    ("train/exclusive", "and nothing else"),
    ("train/holding", "steps in which it holds"),
)
"""Columns of metrics.csv that are shares, and what the legend calls them."""
COLORS = ("#2f6fde", "#22a06b", "#9aa3b2")
"""One for each of TRAINING."""
CURVE_COLORS = ("#2f6fde", "#d9730d", "#22a06b", "#8250df", "#9aa3b2")
"""Colors of compared curves, in turn."""
COMPARED = (
    ("eval/success", "Success [%]", 100),
    ("eval/exclusive", "Exclusive [%]", 100),
    ("eval/right_fingers", "Fingers on the object", 1),
)
"""Columns of evaluations.csv in which runs are compared, their names and scales."""
INK = "#24292f"
"""Axes and text."""


class PlotError(ValueError):
    """A run that cannot be drawn: what was got, what is expected."""


def learning_curve(run: Path, out: Path | None = None) -> Path:
    """Draw success, touch and return over the steps of a run.

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
    evaluations = _read(run / "evaluations.csv")
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


@dataclass(frozen=True)
class Curve:
    """Runs that differ by chance only, mostly by their seeds."""

    label: str
    """What the legend calls them."""
    runs: Sequence[Sequence[Mapping[str, float]]]
    """Rows of the evaluations.csv of each run."""

    def over_steps(self, column: str) -> tuple[np.ndarray, np.ndarray]:
        """Return all steps evaluated [P] and each run's values there [R, P].

        Between its own evaluations a run is interpolated; before the first and after
        the last it is NaN.
        """
        steps = np.unique([row["steps"] for run in self.runs for row in run])
        values = [
            np.interp(
                steps,
                [row["steps"] for row in run],
                [row[column] for row in run],
                left=np.nan,
                right=np.nan,
            )
            for run in self.runs
        ]
        return steps, np.array(values)


def compare(
    curves: Sequence[Curve], out: Path, title: str, level: float | None = None
) -> Path:
    """Draw ways of learning side by side.

    Each has a line for the mean of its runs and a band for their range, as far as all
    of them reach, and a thin line for every run.

    Args:
        curves: At least one.
        out: Picture to write.
        title: What stands above, the task for instance.
        level: Fingers a step to mark as the paper's; None: no such line.
    """
    figure = Figure(figsize=(8.0, 6.2), dpi=100, layout="constrained")
    panels = figure.subplots(3, 1, sharex=True)
    for axes, (column, name, scale) in zip(panels, COMPARED, strict=True):
        for curve, color in zip(curves, cycle(CURVE_COLORS)):
            _draw_range(axes, curve, column, scale, color)
        axes.set_ylabel(name)
        axes.set_ylim((-3, 103) if scale == 100 else (0, None))
        _polish(axes)
    fingers = panels[-1]
    if level is not None:
        fingers.axhline(level, color=INK, linewidth=1.2, linestyle="--")
        fingers.annotate(
            f"the paper: {level:g}",
            (1, level),
            xycoords=fingers.get_yaxis_transform(),
            xytext=(0, 3),
            textcoords="offset points",
            ha="right",
            color=INK,
            fontsize=8.5,
        )
    fingers.set_xlim(left=0)
    fingers.set_xlabel("Environment steps")
    figure.suptitle(title, color=INK)
    figure.legend(
        *fingers.get_legend_handles_labels(),
        loc="outside lower center",
        ncols=len(curves),
        frameon=False,
        labelcolor=INK,
    )
    out.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(out)
    return out


def _draw_range(
    axes: Axes, curve: Curve, column: str, scale: float, color: str
) -> None:
    steps, values = curve.over_steps(column)
    values = scale * values
    common = np.isfinite(values).all(axis=0)  # steps that every seed has reached
    shared = values[:, common]
    seeds = f"{len(curve.runs)} seed{'s' if len(curve.runs) > 1 else ''}"
    label = f"{curve.label} ({seeds})"
    mean, low, high = shared.mean(axis=0), shared.min(axis=0), shared.max(axis=0)
    axes.plot(steps[common], mean, "o-", color=color, ms=3, label=label)
    axes.fill_between(steps[common], low, high, color=color, alpha=0.18, linewidth=0)
    if len(values) > 1:
        axes.plot(steps, values.T, color=color, linewidth=0.7, alpha=0.6)


def _read(table: Path) -> list[dict[str, float]]:
    """Read a table of numbers; [] if it is missing."""
    try:
        return [{k: float(v) for k, v in row.items()} for row in whole_rows(table)]
    except FileNotFoundError:
        return []
    except ValueError as error:
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
