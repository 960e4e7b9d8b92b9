"""Pictures of figures: how a run got better, and what an audit found."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import groupby
from pathlib import Path
from typing import Any, Literal

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ir_maniskill.checks import ConfigError
from ir_maniskill.evaluation.audit import AuditReport
from ir_maniskill.files import replacing, require_writable
from ir_maniskill.training.run_folder import whole_rows

Row = Mapping[str, float]

SHARES = (
    ("success", "episodes that reach the goal", "#2f6fde"),
    ("exclusive", "and nothing else", "#22a06b"),
    ("holding", "steps in which it holds", "#9aa3b2"),
)
"""What metrics.csv and evaluations.csv have shares of, its name and its color."""
ENDINGS = (".png", ".pdf", ".svg")
"""Of the names of pictures."""
INK = "#24292f"
"""Axes and text."""


def learning_curve(run: Path, out: Path | None = None) -> Path:
    """Draw success and return over the steps of a run, and return the picture's file.

    Lines are the exploring policy, dots its evaluations without noise.

    Args:
        run: Folder of the run, with metrics.csv and, after the first evaluation,
            evaluations.csv.
        out: Picture to write; None: learning_curve.png in the folder.

    Raises:
        ValueError: The folder holds no metrics, or `out` is no name of a picture.
    """
    metrics = _read(run / "metrics.csv")
    if not metrics:
        raise ConfigError(
            f"{run}: got no metrics.csv with rows, expected a run's folder"
        )
    evaluations = _read(run / "evaluations.csv")
    figure = Figure(figsize=(8.0, 5.6), dpi=150, layout="constrained")
    shares, returns = figure.subplots(2, 1, sharex=True, height_ratios=(2, 1))
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
    returns.plot(*_points(metrics, "train/return"), color=SHARES[0][2], linewidth=1.8)
    returns.set(ylabel="Return of an episode", xlabel="Environment steps")
    for axes in (shares, returns):
        style_axes(axes, "y")
        axes.spines[["left", "bottom"]].set_color("#c9ced6")
        axes.xaxis.set_major_formatter(lambda value, _: f"{value / 1000:g} k")
    return _save(figure, out or run / "learning_curve.png")


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
    style_axes(axes, "x")
    axes.spines["left"].set_visible(False)
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
        raise ConfigError(
            f"{table}: got {error}, expected a table of numbers"
        ) from error


def _points(
    rows: Sequence[Row], column: str, scale: float = 1
) -> tuple[list[float], list[float]]:
    """Return the steps and the values of the rows that have the column, [P] each."""
    rows = [row for row in rows if column in row]
    return [row["steps"] for row in rows], [scale * row[column] for row in rows]


def style_axes(axes: Axes, grid: Literal["x", "y"]) -> None:
    """Leave of the axes what is needed, with a grid along one of them."""
    axes.spines[["top", "right"]].set_visible(False)
    axes.tick_params(colors=INK, length=0)
    axes.grid(axis=grid, color="#e7eaef", linewidth=0.8)
    axes.set_axisbelow(True)


def _save(figure: Figure, path: Path) -> Path:
    require_writable(path, ENDINGS)
    with replacing(path) as aside:
        figure.savefig(aside)
    return path
