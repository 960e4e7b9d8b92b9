"""Videos: what the robot does, what it sees and feels, and what it was told.

A frame is a dark page of 1280 x 720: the human view on the left, over a timeline of the
episode; on the right the two pictures that the policy sees, or the numbers that it has
in their place, a light for every finger, and the counters.
"""

from __future__ import annotations

import errno
import math
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, field
from functools import cache
from itertools import islice, pairwise, takewhile
from pathlib import Path
from typing import Any

import gymnasium as gym
import imageio.v2 as imageio
import imageio_ffmpeg
import numpy as np
import torch
from matplotlib import font_manager
from PIL import Image, ImageDraw, ImageFont
from tqdm import tqdm

from ir_maniskill.environment.robots.robot import Robot
from ir_maniskill.environment.senses import StateStack, cameras, felt
from ir_maniskill.environment.table_scene import view
from ir_maniskill.environment.touch_env import CONTROL_FREQ
from ir_maniskill.evaluation.evaluate import Policy, choose_instructions, threads
from ir_maniskill.files import replacing, require_writable

Box = tuple[int, int, int, int]
"""Left, top, width and height [pixel]."""
Color = tuple[int, int, int]
Scene = tuple[dict[str, Any], torch.Tensor]
"""The simulator's state, and which body is in each slot of the table [1, C]."""

ENDINGS = (".mp4", ".gif")
"""Of the names of films."""
SIZE = (1280, 720)
"""Width and height of a frame [pixel]."""
VIEW: Box = (32, 100, 836, 540)
"""The human view."""
TIMELINE: Box = (32, 664, 836, 24)
"""One cell for each step, below the human view."""
PICTURES: tuple[Box, Box] = ((900, 124, 166, 332), (1082, 124, 166, 332))
"""The policy's pictures; of more cameras the first two."""
NUMBERS: Box = (900, 100, 348, 356)
"""What is observed where there are no pictures."""
HANDS: Box = (900, 480, 348, 128)
"""The touch lights."""
LEGEND = (902, 60)
"""Where the meaning of the colors is told."""
COUNTERS: Box = (900, 624, 348, 64)
"""Step and return."""

PAGE: Color = (18, 20, 24)
CARD: Color = (28, 31, 37)
EDGE: Color = (50, 54, 63)
INK: Color = (238, 240, 244)
FAINT: Color = (136, 143, 155)
DIM: Color = (88, 94, 105)
RIGHT: Color = (64, 210, 128)
WRONG: Color = (242, 84, 84)

VIEWPOINT = ((0.80, 0.30, 0.40), (0.08, 0.0, 0.09))
"""Eye and target of the human view, at NAO's scale [m]."""
SHARPNESS = 1.5
"""How much larger the human view is rendered than shown, for smooth edges."""


@dataclass(frozen=True)
class Shot:
    """What one frame shows."""

    view: np.ndarray
    """Human view [H, W, 3] uint8."""
    cameras: dict[str, np.ndarray]
    """What the policy's cameras see, by their names, each [h, w, 3] uint8."""
    instruction: str
    """The sentence."""
    hands: Mapping[str, tuple[str, ...]]
    """Names of the robot's hands, and of the fingers of each, F in all."""
    right: tuple[bool, ...]
    """Which of the F fingers touch as the sentence asks."""
    wrong: tuple[bool, ...]
    """Which of the F fingers touch as it does not allow."""
    step: int
    """Steps since the episode began."""
    total_steps: int
    """Steps of the whole episode."""
    score: float
    """Sum of the rewards so far."""
    history: tuple[tuple[bool, bool], ...]
    """For each step so far: whether the goal held, and whether there was a foul."""
    numbers: Mapping[str, np.ndarray] = field(default_factory=dict)
    """What is observed, without pictures: each sense's numbers [n]."""


def record(
    policy: Policy,
    env_id: str,
    *,
    episodes: int = 3,
    seed: int = 0,
    frames: int = 3,
    env_kwargs: dict[str, Any] | None = None,
    instructions: Sequence[Any] | None = None,
) -> Iterator[Shot]:
    """Play episodes and yield every step; the arguments are `evaluate_policy`'s.

    In place of envs it takes an id and keyword arguments for `gym.make`: what is filmed
    is one env alone, beside a second one that draws.
    """
    with closing(gym.make(env_id, num_envs=1, **(env_kwargs or {}))) as env:
        base: Any = env.unwrapped
        told = choose_instructions(base.experiment, instructions)
        with closing(stage(env_id, base.agent)) as shown:
            for episode in range(episodes):
                said = told[episode % len(told)]
                options = {} if said is None else {"instruction": said}
                obs, _ = env.reset(seed=seed + episode, options=options)
                yield from _play(policy, env, obs, StateStack(frames), shown)


def stage(env_id: str, robot: Robot) -> gym.Env:
    """Make a second scene, to show the first with shadows, large and sharp.

    Lights are a scene's, not a camera's: shadows in the policy's own scene would change
    what it sees.
    """
    camera = {
        "width": round(VIEW[2] * SHARPNESS),
        "height": round(VIEW[3] * SHARPNESS),
        "pose": view(robot.scale, *VIEWPOINT),
        "fov": 0.58,
    }
    env = gym.make(
        env_id,
        num_envs=1,
        robot_uids=type(robot),
        obs_mode="none",
        render_mode="rgb_array",
        enable_shadow=True,
        human_render_camera_configs=camera,
    )
    env.reset(seed=0)
    return env


def scene_of(env: Any) -> Scene:
    """Return what a stage needs to show an env: all but what is said and judged."""
    state = env.get_state_dict()
    del state["task"]
    return state, env.table.slot


def show(stage: Any, scene: Scene) -> np.ndarray:
    """Show a scene on a stage, and return the picture [H, W, 3] uint8."""
    state, slot = scene
    stage.unwrapped.table.put(slice(None), slot)
    stage.unwrapped.set_state_dict(state)
    return _picture(stage.render())


@torch.no_grad()  # no inference mode: what the env keeps must stay changeable
def _play(
    policy: Policy, env: gym.Env, obs: Any, stack: StateStack, stage: gym.Env
) -> Iterator[Shot]:
    """Play the episode that a reset has begun."""
    base: Any = env.unwrapped
    state, total = stack.reset(obs), base.experiment.episode_steps
    right = wrong = [False] * len(base.agent.fingers)
    score = 0.0
    history: tuple[tuple[bool, bool], ...] = ()
    for step in range(total + 1):
        yield Shot(
            view=show(stage, scene_of(base)),
            cameras={
                name: _picture(obs["sensor_data"][name]["rgb"]) for name in cameras(obs)
            },
            instruction=base.get_language_instruction()[0],
            hands=base.agent.hands,
            right=tuple(right),
            wrong=tuple(wrong),
            step=step,
            total_steps=total,
            score=score,
            history=history,
            numbers={} if cameras(obs) else felt(obs),
        )
        if step < total:
            with threads(1):
                action = policy(state)
            obs, reward, _, _, info = env.step(action)
            state, score = stack.push(obs), score + float(reward)
            verdict = base.verdict
            right, wrong = verdict.right[0].tolist(), verdict.wrong[0].tolist()
            history += ((bool(info["success"]), bool(verdict.foul)),)


def _picture(tensor: Any) -> np.ndarray:
    """Return a rendered batch of one as an image [H, W, 3] uint8."""
    return torch.as_tensor(tensor).cpu().numpy()[0]


# -- Drawing -------------------------------------------------------------------------


def draw(shot: Shot) -> np.ndarray:
    """Draw a frame [720, 1280, 3] uint8."""
    page = _page().copy()
    _paste(page, shot.view, VIEW, radius=14)
    canvas = ImageDraw.Draw(page)
    for (name, picture), box in zip(shot.cameras.items(), PICTURES, strict=False):
        _draw_camera(page, name, picture, box)
    if shot.numbers and not shot.cameras:
        _draw_numbers(page, shot.numbers)
    font = _fitting(shot.instruction, LEGEND[0] - 60, 34)
    canvas.text((32, 66), shot.instruction, INK, font, anchor="lm")
    _draw_timeline(canvas, shot)
    _draw_hands(page, shot)
    _draw_counters(canvas, shot)
    return np.asarray(page)


@cache
def _font(size: int) -> Any:
    """Return a font with the letters of most alphabets, which Matplotlib brings."""
    return ImageFont.truetype(font_manager.findfont("DejaVu Sans"), size)


def _fitting(text: str, width: int, size: int) -> Any:
    """Return the largest font up to `size` in which the text is not wider [pixel]."""
    sizes = range(size, 11, -1)
    return _font(next((s for s in sizes if _font(s).getlength(text) <= width), 11))


@cache
def _page() -> Image.Image:
    """Draw what is the same in every frame."""
    page = Image.new("RGB", SIZE, PAGE)
    canvas = ImageDraw.Draw(page)
    canvas.text((33, 24), "INSTRUCTION", FAINT, _font(13))
    for box in (HANDS, COUNTERS):
        _paste_shape(page, box, CARD, radius=10)
    x, y = LEGEND
    for color, text in ((RIGHT, "as the sentence asks"), (WRONG, "not allowed")):
        _paste_shape(page, (x, y, 12, 12), color, radius=6)
        canvas.text((x + 20, y + 6), text, FAINT, _font(13), anchor="lm")
        x += 212
    return page


def _draw_camera(page: Image.Image, name: str, picture: np.ndarray, box: Box) -> None:
    """Draw what a camera sees, as large as fits into the middle of a box."""
    x, y, width, height = box
    rows, columns, _ = picture.shape
    scale = min(width / columns, height / rows)
    wide, high = round(columns * scale), round(rows * scale)
    x, y = x + (width - wide) // 2, y + (height - high) // 2
    _paste(page, picture, (x, y, wide, high), radius=10)
    canvas, title = ImageDraw.Draw(page), name.replace("_", " ").upper()
    canvas.text((x + 1, y - 10), title, FAINT, _font(12), anchor="ls")
    size = "{} x {}".format(*picture.shape)  # height x width
    canvas.text((x + wide, y - 10), size, DIM, _font(12), anchor="rs")


def _draw_numbers(page: Image.Image, numbers: Mapping[str, np.ndarray]) -> None:
    """Draw a row of bars for each sense, as high as its numbers, at most 1."""
    x, y, width, height = NUMBERS
    _paste_shape(page, NUMBERS, CARD, radius=10)
    canvas = ImageDraw.Draw(page)
    half = height / len(numbers) / 2
    for row, (name, values) in enumerate(numbers.items()):
        top, step = y + 2 * half * row, (width - 36) / len(values)
        canvas.text((x + 18, top + 10), name.upper(), FAINT, _font(12))
        canvas.text((x + width - 18, top + 10), f"{len(values)}", DIM, _font(12), "ra")
        zero, high = top + half + 12, half - 18
        for column, value in enumerate(np.clip(values, -1, 1)):
            left, end = x + 18 + column * step, zero - high * value
            bar = (left, min(zero, end), left + step - 2, max(zero, end))
            canvas.rectangle(bar, INK)


@cache
def _mask(width: int, height: int, radius: int) -> Image.Image:
    """Draw a rounded rectangle large, and shrink it for smooth corners."""
    large = Image.new("L", (4 * width, 4 * height))
    area = (0, 0, 4 * width - 1, 4 * height - 1)
    ImageDraw.Draw(large).rounded_rectangle(area, 4 * radius, 255)
    return large.resize((width, height), Image.Resampling.LANCZOS)


def _paste(page: Image.Image, array: np.ndarray, box: Box, radius: int) -> None:
    """Paste a picture into a box of its shape."""
    x, y, width, height = box
    picture = Image.fromarray(np.ascontiguousarray(array))
    if picture.size != (width, height):
        small = picture.width < width  # what a policy sees stays as coarse as it is
        method = Image.Resampling.NEAREST if small else Image.Resampling.LANCZOS
        picture = picture.resize((width, height), method)
    page.paste(picture, (x, y), _mask(width, height, radius))


def _paste_shape(page: Image.Image, box: Box, color: Color, radius: int) -> None:
    x, y, width, height = box
    page.paste(color, (x, y, x + width, y + height), _mask(width, height, radius))


def _draw_timeline(canvas: ImageDraw.ImageDraw, shot: Shot) -> None:
    """Draw one cell a step: green above if the goal holds, red below if a foul."""
    x, y, width, height = TIMELINE
    total = shot.total_steps
    gap = 3 if total <= 100 else 0
    cell = (width + gap) / total
    for step in range(total):
        left, end = round(x + step * cell), round(x + (step + 1) * cell) - gap - 1
        if end < left:  # more steps than pixels: the next one takes its place
            continue
        upper = lower = CARD
        if step < len(shot.history):
            right, wrong = shot.history[step]
            upper = RIGHT if right else WRONG if wrong else EDGE
            lower = WRONG if wrong else upper
        middle = y + height // 2
        canvas.rectangle((left, y, end, middle), upper)
        canvas.rectangle((left, middle, end, y + height - 1), lower)


def _draw_hands(page: Image.Image, shot: Shot) -> None:
    """Draw a row of lights for each hand, in the order of the robot's fingers."""
    x, y, _, _ = HANDS
    canvas = ImageDraw.Draw(page)
    hands = shot.hands
    touches = zip(shot.right, shot.wrong, strict=True)
    for row, (hand, fingers) in enumerate(hands.items()):
        top = y + 14 + row * min(56, 112 // len(hands))
        canvas.text((x + 18, top + 14), hand.upper(), FAINT, _font(13))
        for column, name in enumerate(titles(fingers)):
            right, wrong = next(touches)
            color = WRONG if wrong else RIGHT if right else EDGE
            left = x + 84 + column * min(88, 218 // max(len(fingers) - 1, 1))
            _draw_light(page, (left, top), name, color)


def titles(fingers: tuple[str, ...]) -> list[str]:
    """Return names without what all have in front, "LFinger1" as "Finger 1"."""
    letters = zip(*fingers, strict=False)
    same = list(takewhile(lambda column: len(set(column)) == 1, letters))
    front = len(same) if len(fingers) > 1 else 0
    return [re.sub(r"(?<=[a-z])(?=[A-Z\d])", " ", name[front:]) for name in fingers]


def _draw_light(
    page: Image.Image, place: tuple[int, int], name: str, color: Color
) -> None:
    """Draw a light with its name; it glows unless its color is that of an edge."""
    left, top = place
    lit = color != EDGE
    if lit:
        red, green, blue = ((c + 2 * d) // 3 for c, d in zip(color, CARD, strict=True))
        _paste_shape(page, (left + 14, top - 5, 32, 32), (red, green, blue), 16)
    _paste_shape(page, (left + 20, top + 1, 20, 20), color, 10)
    text, ink = (left + 30, top + 29), INK if lit else FAINT
    ImageDraw.Draw(page).text(text, name, ink, _font(12), anchor="mt")


def _draw_counters(canvas: ImageDraw.ImageDraw, shot: Shot) -> None:
    x, y, width, _ = COUNTERS
    seconds = shot.step / CONTROL_FREQ
    columns = (
        ("STEP", f"{shot.step} / {shot.total_steps}"),
        ("TIME", f"{seconds:.2f} s"),
        ("RETURN", f"{shot.score:.1f}"),
    )
    for index, (title, value) in enumerate(columns):
        left = x + 18 + index * width // 3
        canvas.text((left, y + 12), title, FAINT, _font(12))
        canvas.text((left, y + 30), value, INK, _font(20))


# -- Files ---------------------------------------------------------------------------


def write_video(
    path: Path,
    shots: Iterable[Shot],
    *,
    speed: float = 0.5,
    hold: float = 1.0,
    total: int | None = None,
) -> None:
    """Draw what `record` yields into an mp4, or a small GIF.

    Args:
        path: The file; its name ends in .mp4 or .gif.
        shots: At least one.
        speed: 1 is real time.
        hold: How long the last frame of an episode stays [s].
        total: How many shots to expect, for the progress bar.

    Raises:
        ValueError: Of another name.
        OSError: It cannot be written.
    """
    require_writable(path, ENDINGS)
    rate = CONTROL_FREQ * speed

    def frames() -> Iterator[np.ndarray]:
        for shot in tqdm(shots, "film", total, leave=False, unit=" frames"):
            frame, last = draw(shot), shot.step == shot.total_steps
            yield from [frame] * (1 + round(hold * rate) * last)

    write = _write_gif if path.suffix.lower() == ".gif" else _write_mp4
    with replacing(path) as aside:
        write(aside, frames(), rate)


def _write_mp4(path: Path, frames: Iterable[np.ndarray], rate: float) -> None:
    """Write H.264 with 4:2:0 colors, which every player knows."""
    writer: Any = imageio.get_writer(
        path,
        format="FFMPEG",
        fps=rate,
        codec="libx264",
        pixelformat="yuv420p",
        quality=None,
        output_params=["-crf", "20", "-preset", "medium", "-movflags", "+faststart"],
    )
    written = 0
    with closing(writer):  # used as a context by itself, an error would leave it open
        for frame in frames:
            writer.append_data(frame)
            written += 1
    # ffmpeg says nothing of a disk that was full; a film that is cut has fewer frames.
    if imageio_ffmpeg.count_frames_and_secs(str(path))[0] != written:
        raise OSError(errno.EIO, "ffmpeg did not write all frames")


def _write_gif(path: Path, frames: Iterable[np.ndarray], rate: float) -> None:
    """Write half the size, with one palette for all frames, to stay small.

    Browsers show no frame for less than 1/50 s, and times are in 1/100 s.
    """
    size, smooth = (SIZE[0] // 2, SIZE[1] // 2), Image.Resampling.LANCZOS
    every = math.ceil(rate / 50)
    shown = islice(frames, 0, None, every)
    images = [Image.fromarray(frame).resize(size, smooth) for frame in shown]
    ends = [round(100 * every * n / rate) for n in range(len(images) + 1)]  # [1/100 s]
    some = [
        np.asarray(image) for image in (images[0], images[len(images) // 2], images[-1])
    ]
    # The octree keeps small things of a color of their own, such as a cube, apart; the
    # median cut merges them into what is large.
    montage = Image.fromarray(np.concatenate(some))
    palette = montage.quantize(128, method=Image.Quantize.FASTOCTREE)
    plain = Image.Dither.NONE
    images = [image.quantize(palette=palette, dither=plain) for image in images]
    images[0].save(
        path,
        save_all=True,
        append_images=images[1:],
        duration=[10 * (end - start) for start, end in pairwise(ends)],
        loop=0,
        optimize=True,
    )
