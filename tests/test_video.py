import dataclasses
from pathlib import Path

import imageio.v2 as imageio
import numpy as np
import pytest
from PIL import Image

from ir_maniskill.checks import ConfigError
from ir_maniskill.environment.robots.nao import HANDS
from ir_maniskill.evaluation import plots, video
from ir_maniskill.evaluation.evaluate import evaluate_policy
from ir_maniskill.evaluation.video import (
    RIGHT,
    SIZE,
    WRONG,
    Shot,
    draw,
    write_video,
)
from ir_maniskill.goals import Instruction, Ref, Touch


def shot(step=3, right=(), wrong=(), history=((False, False),) * 3):
    gray = np.full((540, 836, 3), 127, np.uint8)
    picture = np.full((64, 32, 3), 200, np.uint8)
    return Shot(
        view=gray,
        cameras={"top_camera": picture, "front_camera": picture},
        instruction="Touch the blue cube.",
        hands=HANDS,
        right=tuple(finger in right for finger in range(6)),
        wrong=tuple(finger in wrong for finger in range(6)),
        step=step,
        total_steps=4,
        score=1.5,
        history=history,
    )


def share(frame, box, color):
    """Return the share of a box that has a color."""
    x, y, width, height = box
    return (frame[y : y + height, x : x + width] == color).all(axis=-1).mean()


def light(finger):
    """Return the middle of a finger's light, a few pixels wide."""
    x, y, *_ = video.HANDS
    return (x + 112 + 88 * (finger % 3), y + 22 + 56 * (finger // 3), 4, 4)


@pytest.mark.parametrize(("rows", "columns"), [(64, 32), (48, 48), (30, 60)])
def test_the_policys_pictures_are_shown_whole_and_not_stretched(rows, columns):
    corner = np.full((rows, columns, 3), 200, np.uint8)
    corner[: rows // 2, : columns // 2] = RIGHT
    frame = draw(dataclasses.replace(shot(), cameras={"top_camera": corner}))
    x, y, width, height = video.PICTURES[0]
    ys, xs = np.nonzero((frame[y : y + height, x : x + width] == RIGHT).all(axis=-1))
    assert np.ptp(xs) + 1 == width // 2
    assert np.ptp(ys) + 1 == pytest.approx(width * rows / columns / 2, abs=1)
    assert ys.min() + 2 * (np.ptp(ys) + 1) + ys.min() == pytest.approx(height, abs=2)


@pytest.mark.parametrize("finger", range(6))
def test_a_touching_finger_lights_its_own_lamp_only(finger):
    for color, frame in (
        (RIGHT, draw(shot(right=[finger]))),
        (WRONG, draw(shot(wrong=[finger]))),
    ):
        lit = [share(frame, light(other), color) == 1 for other in range(6)]
        assert lit == [other == finger for other in range(6)]


def lit(count, names):
    """Return the share of the lights' card that is green if `count` fingers touch."""
    right = tuple(index < count for index in range(len(names)))
    shown = {"hands": {"hand": names}, "right": right, "wrong": (False,) * len(names)}
    frame = draw(Shot(**{**vars(shot()), **shown}))
    return share(frame, video.HANDS, RIGHT)


def test_another_robot_has_as_many_lights_as_fingers():
    one = lit(1, ("tip",))
    assert one > 0.005
    assert lit(8, tuple("abcdefgh")) == pytest.approx(8 * one)
    assert lit(0, ("tip",)) == 0


def test_the_timeline_shows_what_each_step_touched():
    history = ((True, False), (False, True), (True, True))
    frame = draw(shot(history=history))
    # One cell is all green, one all red, one half and half; the fourth is to come.
    assert share(frame, video.TIMELINE, RIGHT) == pytest.approx(1.5 / 4, abs=0.02)
    assert share(frame, video.TIMELINE, WRONG) == pytest.approx(1.5 / 4, abs=0.02)


def test_the_view_and_the_pictures_are_shown():
    frame = draw(shot())
    assert (frame.shape, frame.dtype) == ((SIZE[1], SIZE[0], 3), np.uint8)
    assert share(frame, video.VIEW, (127, 127, 127)) > 0.99
    for box in video.PICTURES:
        assert share(frame, box, (200, 200, 200)) > 0.98


def test_a_policy_without_pictures_has_its_numbers_in_their_place():
    numbers = {"touch": np.array([1.0, 0, 0, -0.5, 0, 7])}
    frame = draw(dataclasses.replace(shot(), cameras={}, numbers=numbers))
    x, y, width, height = video.NUMBERS
    card = (frame[y + 26 : y + height, x : x + width] == video.INK).all(axis=-1)
    heights = card.sum(axis=0)[18 + 25 : 18 + 312 : 52]  # in the middle of each bar
    assert heights[0] == heights[5] == pytest.approx(160, abs=2)  # 7 counts as 1
    assert heights[3] == pytest.approx(heights[0] / 2, abs=2)
    assert heights[1] == heights[2] == heights[4] == 1


FILMS = [("a.mp4", (1280, 720)), ("B.MP4", (1280, 720)), ("a.gif", (640, 360))]


@pytest.mark.parametrize("name, size", FILMS)
def test_videos_play_and_hold_their_last_frame(name, size, tmp_path):
    path = tmp_path / "new" / name
    shots = [shot(step=step, right=[step]) for step in range(5)]
    write_video(path, iter(shots), speed=0.5, hold=0.5)
    reader = imageio.get_reader(path)
    frames = [np.asarray(frame) for frame in reader]
    assert {(f.shape[1], f.shape[0]) for f in frames} == {size}
    # GIF merges equal frames into one that lasts longer.
    assert len(frames) == (5 if name.endswith("gif") else 5 + 5)
    facts = reader.get_meta_data()
    if not name.endswith("gif"):  # what every player knows
        assert facts["codec"] == "h264" and facts["pix_fmt"].startswith("yuv420p")
        assert facts["fps"] == 10
    assert not np.array_equal(frames[0], frames[4])


@pytest.mark.parametrize("speed, frames", [(0.7, 12), (2.0, 12), (4.0, 6)])
def test_a_gif_is_as_fast_as_browsers_can_show(speed, frames, tmp_path):
    path = tmp_path / "a.gif"
    shots = [shot(step=0, right=[step % 6]) for step in range(12)]
    write_video(path, shots, speed=speed)
    film = Image.open(path)
    times = []  # [ms]
    for frame in range(film.n_frames):
        film.seek(frame)
        times.append(film.info["duration"])
    assert len(times) == frames and min(times) >= 20
    assert sum(times) == pytest.approx(1000 * 12 / (20 * speed), abs=5)


def test_a_gif_keeps_the_colors_of_small_things(tmp_path):
    blue, red, x = (40, 90, 220), (200, 40, 40), 460
    shade = np.linspace((40, 60, 90), (220, 210, 200), 836).astype(np.uint8)
    shots = []
    for step, color in enumerate((blue, blue, blue, red)):
        view = np.tile(shade, (540, 1, 1))
        view[240:280, x : x + 40] = color
        shots.append(Shot(**{**vars(shot(step=step)), "view": view}))
    write_video(tmp_path / "a.gif", shots)
    frames = list(imageio.get_reader(tmp_path / "a.gif"))
    at = (video.VIEW[1] + 260) // 2, (video.VIEW[0] + x + 20) // 2
    for frame, color in ((frames[0], blue), (frames[-1], red)):
        assert np.abs(np.asarray(frame)[at][:3].astype(int) - color).max() < 12


def test_letters_of_other_alphabets_are_no_boxes():
    heads = []
    for text in ("\u00dc", "\u0416", "\u03a9", "\uffff"):  # the last has no glyph
        shown = Shot(**{**vars(shot()), "instruction": text})
        heads.append(draw(shown)[46:90, 30:80].tobytes())
    assert len(set(heads)) == 4


def test_a_long_sentence_stays_beside_the_legend():
    long = Shot(**{**vars(shot()), "instruction": "Touch the cube. " * 8})
    x, y = video.LEGEND
    here, usual = draw(long), draw(shot())
    assert np.array_equal(
        here[y - 30 : y + 30, x - 4 :], usual[y - 30 : y + 30, x - 4 :]
    )


def test_an_episode_of_more_steps_than_pixels_can_be_drawn():
    steps = 10_000
    whole = shot(step=steps, history=((True, False),) * steps)
    frame = draw(Shot(**{**vars(whole), "total_steps": steps}))
    assert share(frame, video.TIMELINE, RIGHT) > 0.95


@pytest.mark.parametrize("name", ["a.mp4", "a.gif", "A.GIF"])
def test_a_film_that_fails_leaves_the_older_one(name, tmp_path):
    path = tmp_path / name
    path.write_bytes(b"older")

    def broken():
        yield shot()
        raise RuntimeError("the simulation failed")

    with pytest.raises(RuntimeError, match="simulation failed"):
        write_video(path, broken())
    assert path.read_bytes() == b"older"
    assert list(tmp_path.iterdir()) == [path]


def test_a_film_that_ffmpeg_cut_short_is_an_error(tmp_path, monkeypatch):
    path = tmp_path / "a.mp4"
    count = video.imageio_ffmpeg.count_frames_and_secs
    fewer = lambda name: (count(name)[0] - 1, 0.0)  # noqa: E731
    monkeypatch.setattr(video.imageio_ffmpeg, "count_frames_and_secs", fewer)
    with pytest.raises(OSError, match="cannot write .*a.mp4: ffmpeg did not write all"):
        write_video(path, [shot()])
    assert not path.exists()


@pytest.mark.slow
@pytest.mark.render
def test_the_video_shows_the_evaluated_episode(multi_vec, reflex, env_kwargs):
    env_id, seed = "NaoTouchCubeMulti-v1", 20
    told = [Instruction("Grab the red one.", Touch(Ref("red")))]
    shots = list(
        video.record(
            reflex,
            env_id,
            episodes=1,
            seed=seed,
            instructions=told,
            env_kwargs=env_kwargs,
        )
    )
    report = evaluate_policy(
        reflex, multi_vec, episodes=1, seed=seed, instructions=told
    )
    assert [shot.step for shot in shots] == list(range(33))
    assert {shot.instruction for shot in shots} == {told[0].text}
    assert shots[-1].score == pytest.approx(report.overall.mean_return)
    seen = shots[1:]
    assert sum(sum(s.right) for s in seen) == round(32 * report.overall.right_fingers)
    touched = [right for right, _ in shots[-1].history]
    assert np.mean(touched) == pytest.approx(report.overall.holding)
    assert all(
        shot.view.std() > 20 and shot.cameras["top_camera"].std() > 20 for shot in shots
    )


def write_metrics(folder: Path, name: str, rows: list[dict]) -> None:
    lines = [",".join(rows[0])] + [",".join(map(str, row.values())) for row in rows]
    (folder / name).write_text("\n".join(lines) + "\n")


def test_learning_curve_draws_a_run(tmp_path):
    rows = [
        {"steps": 2048 * i, "train/return": i, "train/success": i / 9}
        for i in range(10)
    ]
    write_metrics(tmp_path, "metrics.csv", rows)
    path = plots.learning_curve(tmp_path)
    plain = imageio.imread(path)
    assert path == tmp_path / "learning_curve.png" and plain.shape[1] == 1200
    write_metrics(tmp_path, "evaluations.csv", [{"steps": 4096, "eval/success": 0.5}])
    assert not np.array_equal(imageio.imread(plots.learning_curve(tmp_path)), plain)


def test_learning_curve_of_no_run_or_a_broken_one_says_so(tmp_path):
    with pytest.raises(ConfigError, match=r"no metrics.csv"):
        plots.learning_curve(tmp_path)
    write_metrics(tmp_path, "metrics.csv", [{"steps": 1, "train/return": 1}])
    with pytest.raises(ValueError, match="got curve, expected a name ending in .png"):
        plots.learning_curve(tmp_path, Path("curve"))
    (tmp_path / "metrics.csv").write_text("steps,train/return\n1,many\n")
    with pytest.raises(ConfigError, match="expected a table of numbers"):
        plots.learning_curve(tmp_path)
