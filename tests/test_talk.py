"""The live page: what is said and seen, and that no visitor breaks it."""

import dataclasses
import socket
import sys
import time
from contextlib import closing
from pathlib import Path
from threading import Thread

import numpy as np
import pytest
import torch
from browser import CHROMIUM, Browser, wait_for
from hypothesis import given, settings
from hypothesis import strategies as st
from scenes import scene

from ir_maniskill import cli
from ir_maniskill.goals import Both, Instruction, Push, Ref, Then, Touch
from ir_maniskill.language import KINDS, kind_of, parse
from ir_maniskill.language.tokens import VOCABULARY
from ir_maniskill.talk import cards, film, live, meshes
from ir_maniskill.talk.page import Page, side_by_side
from ir_maniskill.talk.players import RANDOM, RandomMotion, fitting
from ir_maniskill.talk.reading import LONGEST, clean, grounded, in_words, read
from ir_maniskill.talk.session import Run, Score, Session
from ir_maniskill.talk.stage import between

RED = "Touch the red cube."
KNOWN = [
    Instruction("Touch the blue cube.", Touch(Ref("blue", "cube"))),
    Instruction(RED, Touch(Ref("red", "cube"))),
]


# -- Reading ---------------------------------------------------------------------------


def heard(text):
    return read(text, KNOWN, scene(), VOCABULARY)


PUSH = "Push the red cube to the left."


@pytest.mark.parametrize(
    ("text", "said", "meaning", "unknown"),
    [
        ("Touch, the RED cube!", RED, "touch the red cube", ()),
        # Other words for what the task asks for are said as its sentence.
        ("please tap the crimson block", RED, "touch the red cube", ()),
        ("Touch the leftmost one.", RED, "touch the red cube", ()),
        (PUSH, PUSH, "push the red cube to the left", ("push", "to", "left")),
    ],
)
def test_a_sentence_is_said_as_the_policy_knows_it(text, said, meaning, unknown):
    reading = heard(text)
    assert (reading.heard, reading.said) == (clean(text), said)
    assert (reading.meaning, reading.unknown) == (meaning, unknown)
    assert reading.objects == (1,)


def test_nonsense_has_no_goal_and_says_what_was_expected():
    reading = heard("Dance!")
    assert reading.goal is None and reading.unknown == ("dance",)
    assert "'dance' as word 1" in reading.meaning and reading.meaning.endswith("...")
    reading = heard("Touch the purple cube.")
    assert reading.goal is None
    assert reading.meaning.startswith("the purple cube fits 0 objects here")


def test_what_is_typed_is_brought_onto_one_line():
    assert clean(" a\tb\n\x07c \ud800 ") == "a b c"
    assert clean("é" * 1000) == "é" * (LONGEST // 2)


@pytest.mark.parametrize(
    "goal, words",
    [
        (Touch(Ref("red"), "left"), "touch the red cube with the left hand"),
        (Push(Ref(where="nearest"), "away"), "push the blue cube away"),
        (
            Then(Touch(Ref("red")), Both(Touch(Ref("blue")), Touch(Ref("green")))),
            "touch the red cube, then touch the blue cube and touch the green button",
        ),
    ],
)  # fmt: skip
def test_goals_are_told_in_plain_words(goal, words):
    assert in_words(grounded(goal, scene())) == words


# -- The session -----------------------------------------------------------------------


@pytest.fixture(scope="module")
def opened():
    with_policy = Session("NaoTouchCubeTriangle-v1", seed=3)
    yield with_policy
    with_policy.close()


@pytest.fixture
def session(opened):
    if (
        opened.choice.task != "NaoTouchCubeTriangle-v1"
        or opened.choice.policy == RANDOM
    ):
        opened.choose(task="NaoTouchCubeTriangle-v1", policy="NaoTouchCubeTriangle-v1")
    opened.seed = 2
    opened.new_scene()
    return opened


def go_on(session, steps):
    for _ in range(steps):
        session.step()


def lit(session):
    return {s for hand in session.lights().values() for s in hand.values()} - {""}


@pytest.mark.render
def test_it_does_as_told_and_then_as_told_next(session):
    session.tell(RED)
    go_on(session, 50)  # longer than an episode of 32
    assert session.score.success and session.score.steps == 50
    assert lit(session) == {"right"}
    before = session.poses()
    session.tell("please tap the green block")
    assert np.array_equal(session.poses(), before)  # no reset
    assert session.score == Score() and session.reading.said == "Touch the green cube."
    # From where the hands are now, this policy obeys in about half of the scenes.
    done = False
    for _ in range(60):
        session.step()
        done |= "right" in lit(session)
    assert session.score.steps == 60 and session.score.success_once == done


@pytest.mark.render
def test_what_is_not_understood_is_heard_but_not_judged(session):
    session.tell("dance!")
    assert session.reading.goal is None and session.reading.said == "dance!"
    go_on(session, 40)
    assert not session.score.success and session.score.wrong == 0
    assert lit(session) <= {"touch"}


@pytest.mark.render
def test_nothing_said_changes_nothing(session):
    before = session.reading
    for text in ("", "   ", "...", "\n\x00"):
        session.tell(text)
        assert session.reading is before and "Nothing was said" in session.note


@pytest.mark.render
@settings(max_examples=25)
@given(text=st.text() | st.text("touch red.<>&é 、🤖", min_size=50, max_size=400))
def test_no_text_breaks_it(opened, text):
    opened.tell(text)
    opened.step()
    card = cards.sentence_card(opened.reading, opened.score)
    assert len(opened.reading.said.encode()) <= LONGEST
    assert cards.escape(opened.reading.heard[:20]) in card or opened.reading.unknown


@pytest.mark.render
def test_a_sentence_longer_than_the_policy_reads_is_cut(session):
    session.tell("please " * 12 + "touch the green cube with your left hand.")
    assert session.reading.said == "please " * 12 + "touch the green cube"
    assert session.reading.goal == Touch(Ref("green", "cube"), "left")


@pytest.mark.render
def test_a_dragged_object_stays_where_it_is_put_and_is_no_push(session):
    session.tell("Push the blue cube to the left.")
    x, _, z = session.scene.position[0, 0].tolist()
    session.drag(0, x, 0.25)
    go_on(session, 3)
    assert session.scene.position[0, 0].tolist() == pytest.approx(
        [x, 0.25, z], abs=2e-3
    )
    session.drop()
    go_on(session, 1)
    assert session.held is None and not session.score.success_once
    assert session.scene.moved[0, 0].norm() < 0.005


@pytest.mark.render
def test_an_object_can_not_be_dragged_off_the_table_or_into_another(session):
    session.drag(0, 9.0, 9.0)
    assert session.held[1:] == pytest.approx((0.38, 0.32))
    there = session.scene.position[0, 1].tolist()
    session.drag(0, there[0] + 0.03, there[1])
    assert session.held[1:] == pytest.approx((0.38, 0.32))


@pytest.mark.render
def test_a_reset_brings_back_the_scene_and_a_new_scene_another(session):
    session.tell("Touch the green cube.")
    start = session.poses()
    session.new_scene()
    other = session.poses()
    session.tell(RED)
    go_on(session, 5)
    session.reset()
    assert np.allclose(session.poses(), other, atol=1e-6)
    assert not np.allclose(other, start, atol=1e-3)
    assert session.reading.heard == RED and session.score.steps == 0


@pytest.mark.render
@pytest.mark.parametrize(
    "wanted", [{"policy": "/etc/passwd"}, {"task": "antigravity:x"}, {"robot": "hal"}]
)
def test_what_is_not_there_is_refused_and_all_stays(session, wanted):
    before, env = session.choice, session.env
    session.choose(**wanted)
    assert repr(*wanted.values()) in session.note and "antigravity" not in sys.modules
    assert session.choice == before and session.env is env


@pytest.mark.render
def test_where_no_policy_fits_chance_moves_the_robot(session):
    session.choose(robot="panda")
    start = session.poses()
    go_on(session, 10)
    assert session.choice.policy == RANDOM and session.reading.unknown == ()
    assert np.abs(session.poses() - start).max() > 0.01
    session.tell("Touch the red cube with your right hand.")
    session.step()
    assert session.reading.goal is None and "right" in session.reading.meaning
    session.choose(robot="nao")
    assert session.choice.policy == "NaoTouchCubeTriangle-v1"


@pytest.mark.render
def test_a_policy_of_the_language_is_told_what_is_said(session):
    session.choose(task="NaoInstruct-v1")
    assert session.choice.policy == "NaoInstruct-v1"
    players = fitting("NaoInstruct-v1", "nao", Path("NaoInstruct-v1"))
    assert players[0] == "NaoInstruct-v1" and len({*players}) == len(players)
    *examples, _ = session.examples()
    assert {kind_of(parse(text)) for text in examples} <= set(KINDS) - {"then"}
    session.tell("Tap the crimson one")
    assert session.reading.said == "Tap the crimson one"
    assert session.reading.guesses == ("crimson as red",)
    session.tell("la " * 60)
    assert session.reading.said == "la " * 39 + "la"
    session.step()


@pytest.mark.render
def test_a_run_of_an_experiment_says_each_sentence_once(session):
    session.experiment("NaoTouchCubeMulti-v1")
    said = [session.reading.said]
    while not session.run.over:
        session.step()
        said += [session.reading.said] * (session.reading.said != said[-1])
    assert tuple(said) == session.run.sentences and len(said) == 3
    assert session.run.reached == (True, True, True)
    assert session.choice.policy == "NaoTouchCubeMulti-v1"
    session.tell(RED)
    assert session.run is None


def test_random_motion_is_gentle_and_repeats_itself():
    a, b = RandomMotion(26, seed=1), RandomMotion(26, seed=1)
    actions = torch.cat([a.act(None, "") for _ in range(500)])
    assert torch.equal(torch.cat([b.act(None, "") for _ in range(500)]), actions)
    assert actions.abs().max() <= 1 and 0.2 < actions[100:].std() < 0.3
    assert (actions[1:] - actions[:-1]).std() < 0.15


# -- What is shown ---------------------------------------------------------------------


def test_what_is_typed_is_never_markup():
    nasty = "<script>alert(1)</script> <img src=x onerror=alert(1)>"
    reading = dataclasses.replace(heard(nasty), said=nasty, meaning=nasty)
    shown = cards.sentence_card(reading, Score()) + cards.note_card(nasty, nasty)
    shown += cards.run_card(Run((nasty,)))
    assert "<script" not in shown and "<img" not in shown


def test_the_card_tells_what_came_of_a_sentence():
    reading = heard(RED)
    assert "not yet" in cards.sentence_card(reading, Score())
    shown = cards.sentence_card(reading, Score(success_once=True, wrong=1, steps=60))
    assert "was reached" in shown and "1 wrong touch<" in shown and "3 s" in shown
    run = cards.run_card(Run(("a", "b"), (True, False)))
    assert "1 of 2 reached" in run and "✓" in run and "✗" in run


def test_pictures_stand_in_the_middle_of_a_row():
    row = side_by_side([np.full((64, 32, 3), 255, np.uint8)])
    assert row.shape == (224, 366, 3)
    assert (row[:, 127:239] == 255).all() and (row[:, :127] < 255).all()
    wide = np.full((64, 64, 3), 255, np.uint8)
    row = side_by_side([wide, 0 * wide])  # each has half of the row
    high = (row[:, 0] == 255).all(axis=1).sum()
    assert (row == 255).all(axis=2).sum() == high**2 > 170**2


def test_a_coarser_mesh_has_no_flat_triangles():
    vertices = np.array([[0, 0, 0], [0.0001, 0, 0], [0.1, 0, 0], [0, 0.1, 0]])
    faces = np.array([[0, 1, 2], [0, 2, 3], [1, 2, 3]])
    kept, left = meshes.coarser(vertices, faces)
    assert len(kept) == 3 and len(left) == 2
    assert set(map(tuple, kept[left[0]].round(2))) == {
        (0, 0, 0),
        (0.1, 0, 0),
        (0, 0.1, 0),
    }


@pytest.mark.render
def test_all_that_is_seen_is_sent_as_glb(session):
    bodies = session.bodies
    assert {"torso", "scene-0_room", "scene-0_red cube"} <= {b.name for b in bodies}
    assert all(meshes.glb(body)[:4] == b"glTF" for body in bodies)


def test_the_clock_says_when_the_machine_is_too_slow(monkeypatch):
    now = 100.0
    monkeypatch.setattr(live.time, "perf_counter", lambda: now)
    clock = live.Clock()
    assert clock.due
    now = 100.03  # a step of 30 ms leaves 20 ms until the next one
    clock.tick(1.0)
    assert not clock.due
    now = 100.051
    assert clock.due
    for _ in range(60):
        now += 0.1
        clock.tick(1.0)
        assert clock.due
    assert clock.pace(1.0) == "10 of 20 steps a second: as fast as this machine can"
    assert clock.pace(0.5) == "10 of 10 steps a second"


def test_between_two_steps_bodies_move_evenly():
    before = np.array([[0.0, 0, 0, 1, 0, 0, 0]])
    now = np.array([[2.0, 0, 0, -np.cos(0.4), 0, 0, -np.sin(0.4)]])
    half = [[1, 0, 0, -np.cos(0.2), 0, 0, -np.sin(0.2)]]
    assert np.allclose(between(before, now, 0.5), half)
    assert np.allclose(between(before, now, 1.0), now)


# -- The page --------------------------------------------------------------------------


@pytest.fixture
def page(session):
    shown = Page(session, "127.0.0.1", 8765)
    yield shown
    shown.close()


@pytest.mark.render
def test_wishes_wait_for_the_simulators_thread(page, session):
    page._wish(session.tell, "Touch the green cube.")
    page._wish(session.drag, 0, 0.2, 0.25)
    assert session.reading.heard != "Touch the green cube." and session.held is None
    assert page.obey() and not page.obey()
    assert session.reading.heard == "Touch the green cube." and session.held[0] == 0


@pytest.mark.render
def test_a_wish_that_fails_ends_nothing(page, session):
    page._wish(session.drag, 99, 0.2, 0.2)
    page._wish(session.tell, "Touch the green cube.")
    assert page.obey() and session.reading.heard == "Touch the green cube."
    page._set_speed(float("nan"))
    page._set_speed(100.0)
    assert page.speed == 2.0


@pytest.mark.render
def test_the_page_listens_here_alone_and_shares_nothing(page):
    assert page.address.startswith("http://127.0.0.1:")
    assert page.server.request_share_url() is None
    with socket.create_connection(("127.0.0.1", page.server.get_port()), 2) as line:
        line.sendall(b"GET /../../../../etc/passwd HTTP/1.1\r\nHost: x\r\n\r\n")
        assert b"root:" not in line.recv(65536)


def test_where_nobody_can_listen_there_is_no_page():
    with pytest.raises(ValueError, match="port: got 65536, expected a whole number"):
        Page(None, "127.0.0.1", 65536)
    with pytest.raises(ValueError, match="host: got '192.0.2.1', expected an address"):
        Page(None, "192.0.2.1", 8080)


@pytest.mark.render
def test_bodies_are_drawn_on_their_way(page, session):
    go_on(session, 2)
    page.stage.show(session, lasts=1000.0)
    page.stage._shown -= 250.0
    page.stage.draw()
    drawn = [page.stage._bodies[body.name].position for body in session.bodies]
    quarter = between(session.before, session.now, 0.25)[:, :3]
    assert not np.allclose(drawn, session.now[:, :3], atol=1e-3)
    assert np.allclose(drawn, quarter, atol=1e-4)


@pytest.mark.render
def test_nothing_moves_while_nobody_watches(page, session):
    live.keep_going(page, until=time.perf_counter() + 0.3)
    assert session.score.steps == 0


# -- The film --------------------------------------------------------------------------


@pytest.mark.render
@pytest.mark.slow
def test_what_was_seen_becomes_a_film(session, tmp_path):
    kept = film.Film()
    for sentence in (RED, "Touch the blue cube."):
        session.tell(sentence)
        for _ in range(4):
            session.step()
            kept.add(session)
    shots = list(kept._frames())
    assert [shot.instruction for shot in shots] == [RED] * 4 + [
        "Touch the blue cube."
    ] * 4
    assert [(shot.step, shot.total_steps) for shot in shots[4:]] == [
        (n, 4) for n in (1, 2, 3, 4)
    ]
    assert kept.write(tmp_path / "film.mp4")
    assert (tmp_path / "film.mp4").stat().st_size > 5000


# -- The command -----------------------------------------------------------------------


def test_without_viser_one_line_says_what_to_install(monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "viser", None)
    for name in ("live", "page", "stage"):
        monkeypatch.delitem(sys.modules, f"ir_maniskill.talk.{name}")
    monkeypatch.delattr("ir_maniskill.talk.live")
    assert cli.run(["talk"]) == 2
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert "pip install 'ir-maniskill[talk]'" in line


# -- A real browser --------------------------------------------------------------------


def pixel(page, point):
    """Return where the only visitor's browser draws a point of the world."""
    (client,) = page.server.get_clients().values()
    camera = client.camera
    ahead = camera.look_at - camera.position
    ahead = ahead / np.linalg.norm(ahead)
    right = np.cross(ahead, camera.up_direction)
    right /= np.linalg.norm(right)
    to = np.asarray(point) - camera.position
    scale = camera.image_height / 2 / np.tan(camera.fov / 2) / (to @ ahead)
    x, y = to @ right, to @ np.cross(right, ahead)
    return camera.image_width / 2 + scale * x, camera.image_height / 2 - scale * y


@pytest.mark.render
@pytest.mark.slow
@pytest.mark.skipif(CHROMIUM is None, reason="there is no Chromium")
def test_in_a_browser_it_does_as_told(session):
    with closing(Page(session, "127.0.0.1", 8770)) as page:
        visit = Thread(target=lambda: found.append(visited(page)))
        found: list[dict] = []
        visit.start()
        while visit.is_alive():
            live.keep_going(page, until=time.perf_counter() + 0.5)
        live.keep_going(page, until=time.perf_counter() + 2)
    (seen,) = found  # else the visit failed, and its thread said why
    assert seen["moved"] > 0.02 and seen["lights"] == {"right"}
    assert seen["dragged"] > 0.02 and session.held is None
    assert "not understood" in seen["nonsense"] and "<i>twice</i>" in seen["nonsense"]
    assert all(
        address.startswith(("data:", "blob:", page.address))
        for address in seen["asked"]
    )


def visited(page):
    """Visit the page as a person would, and return what was seen there."""
    session, seen = page.session, {}
    start = session.poses()  # nothing moves before somebody looks
    with closing(Browser(page.address)) as browser:
        wait_for(lambda: "wrong touch" in browser.text())

        def say(text):
            browser.click_on("document.querySelector('form input')")
            browser.press("a", 65, modifiers=2)
            browser.type(text)
            time.sleep(0.5)
            browser.press("Enter", 13, text="\r")
            wait_for(lambda: session.reading.heard == text)

        say(RED)
        wait_for(lambda: session.score.success)
        seen["lights"] = lit(session)
        seen["moved"] = np.abs(session.poses() - start)[:, :3].max()
        wait_for(lambda: "success" in browser.text())
        place = session.scene.position[0, 2].numpy()
        x, y = pixel(page, place)
        drag(browser, x, y)
        browser.mouse("mouseReleased", x - 48, y + 48)
        wait_for(lambda: session.held is None)
        seen["dragged"] = np.linalg.norm(session.scene.position[0, 2].numpy() - place)
        say("dance <i>twice</i>")
        wait_for(lambda: "not understood" in browser.text())
        seen["nonsense"] = browser.text()
        seen["asked"] = browser.seen
        drag(browser, *pixel(page, session.scene.position[0, 2].numpy()))
        wait_for(lambda: session.held is not None)
    return seen  # the browser is closed while it holds the object


def drag(browser, x, y):
    """Drag what is drawn at a place, and do not let go of it."""
    browser.mouse("mouseMoved", x, y, buttons=0)
    browser.mouse("mousePressed", x, y)
    for step in range(1, 9):
        browser.mouse("mouseMoved", x - 6 * step, y + 6 * step)
        time.sleep(0.1)
