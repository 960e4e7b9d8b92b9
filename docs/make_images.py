"""Renders the pictures of the README from the project's own tasks.

python docs/make_images.py
"""

from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from mani_skill.utils.sapien_utils import look_at
from PIL import Image, ImageDraw, ImageFont

import ir_maniskill  # noqa: F401 - registers the tasks

FOLDER = Path(__file__).parent / "images"
PAGE, INK, FAINT = (18, 20, 24), (238, 240, 244), (150, 156, 168)
GAP = 16
"""Between pictures [pixel]."""
CLOSE = ((0.74, 0.34, 0.40), (0.06, 0.0, 0.08))
"""Eye and target of the pictures of the scenes [m]."""


def shoot(task: str, size: tuple[int, int]) -> tuple[Image.Image, list[Image.Image]]:
    """Returns the human view of a task's start, and what the two cameras see."""
    width, height = size
    camera = {
        "width": 2 * width,  # drawn large and shrunk, for smooth edges
        "height": 2 * height,
        "pose": look_at(*CLOSE),
        "fov": 0.56,
    }
    env: Any = gym.make(
        task,
        obs_mode="rgb",
        render_mode="rgb_array",
        enable_shadow=True,
        human_render_camera_configs=camera,
    )
    obs, _ = env.reset(seed=1, options={"instruction": 0})
    view = Image.fromarray(env.render()[0].cpu().numpy()).resize(size)
    eyes = [
        Image.fromarray(obs["sensor_data"][name]["rgb"][0].cpu().numpy())
        for name in ("top_camera", "front_camera")
    ]
    env.close()
    return view, eyes


def label(page: Image.Image, place: tuple[int, int], text: str, size: int) -> None:
    """Writes text onto the page, its left middle at `place`."""
    font: Any = ImageFont.load_default(size)
    ink = INK if size > 20 else FAINT
    ImageDraw.Draw(page).text(place, text, ink, font, anchor="lm")


def hero() -> Image.Image:
    """Returns the triangle scene beside what the policy sees of it."""
    view, eyes = shoot("NaoTouchCubeTriangle-v1", (832, 512))
    page = Image.new("RGB", (GAP + 832 + 2 * (GAP + 256) + GAP, 64 + 512 + GAP), PAGE)
    label(page, (GAP, 32), "“Touch the blue cube.”", 26)
    page.paste(view, (GAP, 64))
    for index, (name, eye) in enumerate(zip(("top", "front"), eyes, strict=True)):
        left = GAP + 832 + GAP + index * (256 + GAP)
        label(page, (left, 46), f"{name} camera", 14)
        page.paste(eye, (left, 64))
    return page


def scenes() -> Image.Image:
    """Returns the four layouts in a row."""
    tasks = [
        f"NaoTouch{shape}{layout}-v1"
        for layout in ("Multi", "Triangle")
        for shape in ("Cube", "Button")
    ]
    width, height = 320, 240
    page = Image.new("RGB", (GAP + 4 * (width + GAP), 40 + height + GAP), PAGE)
    for index, task in enumerate(tasks):
        left = GAP + index * (width + GAP)
        label(page, (left, 22), task, 14)
        page.paste(shoot(task, (width, height))[0], (left, 40))
    return page


def main() -> None:
    """Writes all pictures."""
    FOLDER.mkdir(exist_ok=True)
    for name, page in (("nao.png", hero()), ("tasks.png", scenes())):
        page.quantize(256, dither=Image.Dither.FLOYDSTEINBERG).save(
            FOLDER / name, optimize=True
        )
        print(name, np.asarray(page).shape)


if __name__ == "__main__":
    main()
