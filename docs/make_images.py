"""Renders the README's pictures and films from the project's own tasks and policies.

python docs/make_images.py                           # all
python docs/make_images.py tasks NaoTouchCubeMulti-v1  # these
"""

import csv
import io
import textwrap
from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import replace
from functools import partial
from itertools import chain
from pathlib import Path
from typing import Any

import gymnasium as gym
import torch
import tyro
from mani_skill.utils.sapien_utils import look_at
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from PIL import Image, ImageDraw, ImageFont

import ir_maniskill  # noqa: F401 - registers the tasks
from ir_maniskill import experiment as catalog
from ir_maniskill.checks import require_choice
from ir_maniskill.evaluation.evaluate import EVALUATION_SEED
from ir_maniskill.evaluation.plots import style_axes
from ir_maniskill.evaluation.video import Shot, record, write_video
from ir_maniskill.language import SPLITS
from ir_maniskill.policy import load_policy

FOLDER = Path(__file__).parent / "images"
PAGE, INK, FAINT = (18, 20, 24), (238, 240, 244), (150, 156, 168)
GAP = 16
"""Between pictures [pixel]."""
ABOVE = ((0.56, 0.0, 0.62), (0.12, 0.0, 0.05))
NEAR = ((0.60, 0.0, 0.52), (0.13, 0.0, 0.03))
"""Eye and target of the pictures of the tasks, and of the language's scenes [m]."""
LAYOUTS = {
    "Single": "one sentence",
    "Multi": "three sentences",
    "Triangle": "a reward for each finger",
    "Shuffled": "colors change places",
}
"""What tells the tasks apart."""
SHUFFLED = "NaoTouchCubeShuffled-v1"
SPOKEN = "NaoInstruct-v1"
FILMS = (
    *(f"NaoTouchCube{layout}-v1" for layout in LAYOUTS),
    *(f"NaoTouchButton{layout}-v1" for layout in LAYOUTS if layout != "Single"),
    SPOKEN,
)
"""The tasks of which there is a film."""
SCENE, TOLD = (
    2_100_009,
    (
        "Touch the orange cube.",
        "Use your left hand to touch the purple pyramid.",
        "Tap the blue one with your right hand.",
        "Touch the rightmost object.",
        "Touch the cube that is not orange.",
        "Touch the one that is left of the pyramid.",
        "Put a finger on the violet thing please",
        "Touch the green cube and the orange cube at the same time.",
    ),
)
"""Seed of a scene, and what its film tells the policy there, one after the other."""
RUNS = FOLDER.parent / "results" / "runs"
CURVES: dict[tuple[str, str], dict[str, Any]] = {
    ("default", "Cube"): {"color": "#2f6fde", "label": "default (PPO), cubes"},
    ("default", "Button"): {"color": "#9dbcf2", "label": "default (PPO), buttons"},
    ("listen", "Cube"): {"color": "#d9822b", "label": "listen (SAC), cubes"},
    ("listen", "Button"): {"color": "#f0c48a", "label": "listen (SAC), buttons"},
}
"""Presets and shapes whose curves there are in `RUNS`, and how they are drawn."""
FAILURE = (EVALUATION_SEED + 18, 1)
"""Seed and sentence of an episode in which the shipped policy touches a wrong cube."""


def shoot(
    task: str, size: tuple[int, int], seen_from: tuple, seed: int, **kwargs: Any
) -> tuple[Image.Image, str]:
    """Return the human view of an episode's start, and what is said."""
    width, height = size
    camera = {
        "width": 2 * width,  # drawn large and shrunk, for smooth edges
        "height": 2 * height,
        "pose": look_at(*seen_from),
        "fov": 0.56,
    }
    kwargs |= {"render_mode": "rgb_array", "human_render_camera_configs": camera}
    env: Any = gym.make(task, enable_shadow=True, **kwargs)
    with closing(env):
        env.reset(seed=seed)
        if task == SPOKEN:  # objects may lie under the hands
            rest = torch.as_tensor(env.unwrapped.agent.keyframes["rest"].qpos)
            env.unwrapped.agent.robot.set_qpos(rest[None])
        view = Image.fromarray(env.render()[0].cpu().numpy()).resize(size)
        (said,) = env.unwrapped.get_language_instruction()
    return view, said


def label(page: Image.Image, place: tuple[int, int], text: str, size: int) -> None:
    """Write text onto the page, its left middle at `place`."""
    font: Any = ImageFont.load_default(size)
    ink = INK if size > 20 else FAINT
    ImageDraw.Draw(page).text(place, text, ink, font, anchor="lm")


def scenes() -> Image.Image:
    """Return all tasks, a column for each layout."""
    width, height, head = 300, 225, 56
    page = Image.new("RGB", (GAP + 4 * (width + GAP), head + 2 * (height + GAP)), PAGE)
    for column, (layout, said) in enumerate(LAYOUTS.items()):
        left = GAP + column * (width + GAP)
        label(page, (left, 18), layout, 22)
        label(page, (left, 42), said, 14)
        for row, shape in enumerate(("Cube", "Button")):
            task = f"NaoTouch{shape}{layout}-v1"
            seed = 3 if layout == "Shuffled" else 1
            view, _ = shoot(task, (width, height), ABOVE, seed)
            page.paste(view, (left, head + row * (height + GAP)))
    return page


def instruct() -> Image.Image:
    """Return scenes of the instruction language, a row for each split."""
    width, height, columns, text = 300, 200, 4, 44
    rows = len(SPLITS)
    size = (GAP + columns * (width + GAP), rows * (24 + height + text + GAP))
    page = Image.new("RGB", size, PAGE)
    for row, split in enumerate(SPLITS):
        top = row * (24 + height + text + GAP)
        label(page, (GAP, top + 12), split, 16)
        for column in range(columns):
            left = GAP + column * (width + GAP)
            seed, kwargs = columns * row + column, {"split": split}
            view, said = shoot(SPOKEN, (width, height), NEAR, seed, **kwargs)
            page.paste(view, (left, top + 24))
            for line, words in enumerate(textwrap.wrap(said, 44)[:3]):
                label(page, (left, top + 24 + height + 10 + 15 * line), words, 13)
    return page


def curves() -> Image.Image:
    """Return the evaluations of trainings, over steps and over minutes."""
    figure = Figure((4 * len(LAYOUTS), 6), dpi=100, layout="constrained")
    grid = figure.subplots(2, len(LAYOUTS), sharey=True)
    for column, layout in zip(grid.T, LAYOUTS, strict=True):
        for axes, unit in zip(column, ("steps", "minutes"), strict=True):
            axes.set(title=layout, xlabel=unit, ylim=(-3, 103))
            style_axes(axes, "y")
            for (preset, shape), style in CURVES.items():
                runs = f"{preset}-NaoTouch{shape}{layout}-v1*.csv"  # a file for a seed
                for rows in (csv.DictReader(path.open()) for path in RUNS.glob(runs)):
                    at = [(float(row[unit]), float(row["exclusive"])) for row in rows]
                    x, y = zip(*at, strict=True)
                    axes.plot(x, [100 * share for share in y], "o-", ms=3, **style)
            axes.set_xlim(left=0)
            if unit == "steps":
                axes.xaxis.set_major_formatter(lambda value, _: f"{value / 1000:g} k")
    for axes in grid[:, 0]:
        axes.set_ylabel("exclusive success [%]")
    lines = [Line2D([], [], marker="o", ms=3, **style) for style in CURVES.values()]
    figure.legend(handles=lines, loc="outside upper center", ncols=len(lines))
    figure.savefig(picture := io.BytesIO())
    return Image.open(picture).convert("RGB")


def save(make: Callable[[], Image.Image], path: Path) -> None:
    """Write a picture, small."""
    page = make().quantize(256, dither=Image.Dither.FLOYDSTEINBERG)
    page.save(path, optimize=True)


def film(task: str, path: Path) -> None:
    """Write a film of the shipped policy, told every sentence in the same scene."""
    told: Any = range(len(catalog.get(task).sentences))
    seed = EVALUATION_SEED
    if task == SPOKEN:
        told, seed = TOLD, SCENE
    shots = (episode(task, said, seed) for said in told)
    write_video(path, chain.from_iterable(shots))


def episode(
    task: str, told: int | str, seed: int = EVALUATION_SEED, act: Any = None
) -> Iterator[Shot]:
    """Play one episode with the shipped policy, or with `act` in its place."""
    policy = load_policy(task)
    return record(
        act or policy.agent.policy,
        task,
        episodes=1,
        seed=seed,
        frames=policy.config.frames,
        env_kwargs=policy.env_kwargs,
        instructions=[told],
    )


def failure(path: Path) -> None:
    """Write a film of an episode in which the shipped policy fails."""
    seed, told = FAILURE
    write_video(path, episode(SHUFFLED, told, seed))


def training(path: Path) -> None:
    """Write a film of what training begins with, noise, and of what it leads to."""
    torch.manual_seed(0)
    noise = partial(episode, act=lambda _: torch.randn(1, 26).clamp(-1, 1))
    shots = [
        replace(shot, instruction=f"{said}: {shot.instruction}")
        for said, play in (("Before training", noise), ("After", episode))
        for shot in play(SHUFFLED, 1)
    ]
    write_video(path, shots)


def main(
    names: tyro.conf.Positional[tuple[str, ...]] = (), folder: Path = FOLDER
) -> None:
    """Write pictures and films into a folder: those that are named, or all."""
    pictures = {
        name: partial(save, make)
        for name, make in (
            ("tasks", scenes),
            ("instruct", instruct),
            ("curves", curves),
        )
    }
    films = {task: partial(film, task) for task in FILMS}
    films |= {"failure": failure, "training": training}
    for name in names:
        require_choice("name", name, pictures | films)
    folder.mkdir(exist_ok=True, parents=True)
    for name in names or pictures | films:
        path = folder / f"{name}.{'png' if name in pictures else 'gif'}"
        (pictures | films)[name](path)
        print(path, f"{path.stat().st_size / 1e6:.2f} MB")


if __name__ == "__main__":
    tyro.cli(main)
