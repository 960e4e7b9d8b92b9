"""Learning curves: how runs got better, drawn from what they logged.

Legend: R runs, P points.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import cycle, groupby
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ir_maniskill.evaluation.audit import AuditReport
from ir_maniskill.files import replacing
from ir_maniskill.training.run_folder import whole_rows

Row = Mapping[str, float]

SHARES = (
    ("success", "episodes that reach the goal", "#2f6fde"),
    ("exclusive", "and nothing else", "#22a06b"),
    ("holding", "steps in which it holds", "#9aa3b2"),
)
"""What metrics.csv and evaluations.csv have shares of, its name and its color."""
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
    """Draw success and return over the steps of a run, and return the picture's file.

    Lines are the exploring policy, dots its evaluations without noise.

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
    shares, returns = _panels(figure, heights=(2, 1))
    dots: dict[str, Any] = {"marker": "o", "linestyle": "", "markersize": 6}
    for name, label, color in SHARES:
        line = _points(metrics, f"train/{name}", 100)
        shares.plot(*line, color=color, linewidth=1.8, label=label)
        shares.plot(*_points(evaluations, f"eval/{name}", 100), color=color, **dots)
    shares.plot([], [], color=INK, label="evaluated without noise", **dots)
    shares.set(ylim=(-3, 103), ylabel="Share [%]")
    shares.legend(
        loc="lower left",
        bbox_to_anchor=(-0.01, 1.0),
        ncols=len(SHARES) + 1,
        frameon=False,
        fontsize=8.5,
        labelcolor=INK,
        handlelength=1.2,
        columnspacing=1.1,
    )
    line = _points(metrics, "train/return")
    returns.plot(*line, color=CURVE_COLORS[0], linewidth=1.8)
    returns.set_ylabel("Return of an episode")
    return _save(figure, out or run / "learning_curve.png")


@dataclass(frozen=True)
class Curve:
    """Runs that differ by chance only, mostly by their seeds."""

    label: str
    """What the legend calls them."""
    runs: Sequence[Sequence[Row]]
    """Rows of the evaluations.csv of each run."""

    def over_steps(self, column: str) -> tuple[np.ndarray, np.ndarray]:
        """Return all steps evaluated [P] and each run's values there [R, P].

        Between its own evaluations a run is interpolated; before the first and after
        the last it is NaN.
        """
        steps = np.unique([row["steps"] for run in self.runs for row in run])
        curves = (_points(run, column) for run in self.runs)
        values = [np.interp(steps, *c, left=np.nan, right=np.nan) for c in curves]
        return steps, np.array(values)


def compare(
    curves: Sequence[Curve], out: Path, title: str, level: float | None = None
) -> Path:
    """Draw ways of learning side by side, and return the picture's file.

    Each has a line for the mean of its runs and a band for their range, as far as all
    of them reach, and a thin line for every run.

    Args:
        curves: At least one.
        out: Picture to write.
        title: What stands above, the task for instance.
        level: Fingers a step to mark as the paper's; None: no such line.
    """
    figure = Figure(figsize=(8.0, 6.2), dpi=100, layout="constrained")
    panels = _panels(figure, heights=(1, 1, 1))
    for axes, (column, name, scale) in zip(panels, COMPARED, strict=True):
        for curve, color in zip(curves, cycle(CURVE_COLORS)):
            _draw_range(axes, curve, column, scale, color)
        axes.set(ylabel=name, ylim=(-3, 103) if scale == 100 else (0, None))
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
    figure.suptitle(title, color=INK)
    figure.legend(
        *fingers.get_legend_handles_labels(),
        loc="outside lower center",
        ncols=len(curves),
        frameon=False,
        labelcolor=INK,
    )
    return _save(figure, out)


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


def bars(report: AuditReport, out: Path) -> Path:
    """Draw an audit: success pale, exclusive success dark, the intervals of that.

    Args:
        report: The table.
        out: Picture to write.

    Returns:
        The picture's file.
    """
    rows = report.rows
    figure = Figure((8.0, 0.9 + 0.24 * len(rows)), dpi=150, layout="constrained")
    axes = figure.subplots()
    groups = [name for name, _ in groupby(rows, lambda row: row.group)]
    at = [-i - 0.7 * groups.index(row.group) for i, row in enumerate(rows)]
    for name, color, height in (
        ("success", "#c6d8f7", 0.8),
        ("exclusive", "#2f6fde", 0.4),
    ):
        rates = [getattr(row, name) for row in rows]
        share = np.array([rate.value for rate in rates])
        low, high = np.array([rate.interval for rate in rates]).T
        error = 100 * np.clip([share - low, high - share], 0, None)
        axes.barh(at, 100 * share, height, color=color, label=name)
        if name == "exclusive":
            axes.errorbar(100 * share, at, xerr=error, fmt="none", ecolor=INK, lw=0.9)
    axes.set_yticks(at, [row.name for row in rows], fontsize=8, color=INK)
    axes.set(xlim=(0, 101), xlabel="Episodes, 95% interval of exclusive success [%]")
    axes.spines[["top", "right", "left"]].set_visible(False)
    axes.tick_params(colors=INK, length=0)
    axes.grid(axis="x", color="#e7eaef", linewidth=0.8)
    axes.set_axisbelow(True)
    figure.suptitle(f"{report.env_id}, {report.episodes} episodes a row", color=INK)
    figure.legend(
        loc="outside lower center", ncols=2, frameon=False, labelcolor=INK, fontsize=8
    )
    return _save(figure, out)


def _read(table: Path) -> list[Row]:
    """Read a table of numbers; [] if it is missing."""
    try:
        return [{k: float(v) for k, v in row.items()} for row in whole_rows(table)]
    except FileNotFoundError:
        return []
    except ValueError as error:
        raise PlotError(f"{table}: got {error}, expected a table of numbers") from error


def _points(
    rows: Sequence[Row], column: str, scale: float = 1
) -> tuple[list[float], list[float]]:
    """Return the steps and the values of the rows that have the column, [P] each."""
    rows = [row for row in rows if column in row]
    return [row["steps"] for row in rows], [scale * row[column] for row in rows]


def _panels(figure: Figure, heights: Sequence[int]) -> list[Axes]:
    """Return axes over the same steps, one below the other."""
    panels = figure.subplots(len(heights), 1, sharex=True, height_ratios=heights)
    for axes in panels:
        axes.spines[["top", "right"]].set_visible(False)
        axes.spines[["left", "bottom"]].set_color("#c9ced6")
        axes.tick_params(colors=INK, length=0)
        axes.grid(axis="y", color="#e7eaef", linewidth=0.8)
        axes.set_axisbelow(True)
        axes.xaxis.set_major_formatter(lambda value, _: f"{value / 1000:g} k")
    panels[-1].set_xlabel("Environment steps")
    return list(panels)


def _save(figure: Figure, path: Path) -> Path:
    with replacing(path) as aside:
        figure.savefig(aside)
    return path
