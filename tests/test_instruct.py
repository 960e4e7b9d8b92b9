"""Free scenes and spoken sentences: what holds for all ids and splits."""

from collections import Counter
from collections.abc import Iterator
from itertools import compress

import gymnasium as gym
import numpy as np
import pytest
import torch

import ir_maniskill
from ir_maniskill import experiment as catalog
from ir_maniskill.environment.arguments import instructions_of
from ir_maniskill.environment.layout import layout_of
from ir_maniskill.environment.robots import Nao, Panda
from ir_maniskill.environment.speaker import Speaker, _fits
from ir_maniskill.environment.touch_env import TouchEnv
from ir_maniskill.experiment import (
    Drawn,
    Experiment,
    ExperimentError,
    Spoken,
    scene_of,
)
from ir_maniskill.goals import (
    COLORS,
    SHAPES,
    GoalError,
    Instruction,
    Push,
    Ref,
    Touch,
    left_of,
    other_than,
    right_of,
)
from ir_maniskill.language import (
    HELD_OBJECTS,
    HELD_PAIRS,
    SPLITS,
    Thing,
    handwritten,
    kind_of,
    parse,
    split_of,
)
from ir_maniskill.language.splits import acts_of, refs_of
from ir_maniskill.language.tokens import split_words
from ir_maniskill.tasks import instruct

TASKS = (
    instruct.TOUCH,
    instruct.HAND,
    instruct.PUSH,
    instruct.WHERE,
    instruct.THEN,
    instruct.ALL,
)


@pytest.fixture(scope="module")
def env() -> Iterator[gym.Env]:
    kwargs = {"obs_mode": "state_dict", "render_backend": "none"}
    env = gym.make("NaoInstruct-v1", control_mode="pd_joint_target_delta_pos", **kwargs)
    yield env
    env.close()


def drawn(task: Experiment, split: str, count: int, seed: int = 0) -> list:
    """Return scenes [C], places [C, 2] and instructions of a task's split."""
    task = task.in_split(split)
    speaker = Speaker(task, layout_of(task, Nao))
    streams = [np.random.RandomState(seed + i) for i in range(count)]
    return list(zip(*speaker.draw(streams), strict=True))


# -- Scenes ----------------------------------------------------------------------------


def test_objects_lie_apart_within_reach_and_no_two_are_alike() -> None:
    counts, kinds = set(), np.zeros(24)
    for slot, xy, _ in drawn(instruct.TOUCH, "train", 1000):
        there = slot >= 0
        places = xy[there]
        gaps = np.linalg.norm(places[:, None] - places[None], axis=-1)
        assert (gaps + np.eye(len(places)) >= 0.065).all()
        away = np.linalg.norm(places[:, None] - np.array(Nao.shoulders), axis=-1)
        assert (away.min(axis=1) <= Nao.reach).all()
        assert len(set(slot[there])) == there.sum()
        counts.add(int(there.sum()))
        kinds[slot[there]] += 1
    assert counts == {2, 3, 4, 5}
    assert kinds.min() > 0.6 * kinds.mean()


def test_what_is_drawn_depends_on_the_seed_alone() -> None:
    alone = drawn(instruct.ALL, "train", 1, seed=7)[0]
    among = drawn(instruct.ALL, "train", 9, seed=0)[7]
    assert (alone[0] == among[0]).all() and alone[2] == among[2]


def test_a_push_is_asked_where_the_hand_behind_the_thing_has_room() -> None:
    layout = layout_of(instruct.PUSH, Nao)
    hand = 0.12 - 0.036  # where it begins to push left what lies at y = 0.12
    for room, asked in ((0.061, True), (0.059, False)):
        scene = (
            Thing("red", "cube", 0.19, 0.12),
            Thing("blue", "cube", 0.19, hand - room),
        )
        assert layout.allows(scene)([("push left", 0)]) == asked


# -- Sentences -------------------------------------------------------------------------


def test_what_training_holds_out_is_not_named_beside_either() -> None:
    speaker = Speaker(instruct.ALL, layout_of(instruct.ALL, Nao))
    new, known = sorted(HELD_OBJECTS)[0], ("green", "can")
    assert known not in HELD_OBJECTS
    cases = (known, 0.0, True), (new, 0.0, False), (known, 0.05, False)
    for beside, y, asked in cases:  # the last one lies where training names nothing
        scene = Thing("red", "can", 0.19, 0.12), Thing(*beside, 0.19, y)
        landmark = Ref(*beside)
        for ref in (landmark, Ref(where=right_of(Ref("red", where=left_of(landmark))))):
            goal = Touch(Ref("red", where=other_than(ref)))
            assert speaker.is_true(goal, scene)
            assert speaker.can_ask(goal, scene) == asked


def test_what_is_told_to_be_pushed_is_free() -> None:
    push = Instruction("Push that.", Push(Ref("purple"), "left"))
    speaker = Speaker(instruct.ALL, layout_of(instruct.ALL, Nao))
    streams = [np.random.RandomState(seed) for seed in range(20)]
    slots, _, _ = speaker.draw(streams, [push] * len(streams))
    there = [speaker.bodies[i] for i in slots.flatten() if i >= 0]
    pushed = {body.shape for body in there if body.color == "purple"}
    assert pushed == {"cube", "can", "pyramid"}


@pytest.mark.parametrize("task", TASKS, ids=lambda task: task.id)
@pytest.mark.parametrize("split", SPLITS)
def test_sentences_are_of_their_split_and_true_of_their_scene(
    task: Experiment, split: str
) -> None:
    written = {i.text: i.goal for i in handwritten()}
    for slot, xy, said in drawn(task, split, 60):
        speaker = Speaker(task, layout_of(task, Nao))
        scene = speaker._things(slot, xy)
        assert speaker.is_true(said.goal, scene)
        assert kind_of(said.goal) in task.instructions.kinds
        assert written.get(said.text) == said.goal or parse(said.text) == said.goal
        new = split if split in ("objects", "pairs") else "train"
        assert split_of(said.goal) == new
        if split != "objects":
            acts = [(verb, _fits(ref, scene)[0]) for verb, ref in acts_of(said.goal)]
            fits = [ref.resolve(scene_of(scene))[0] for ref in refs_of(said.goal)]
            named = [thing for each in fits for thing in compress(scene, each)]
            assert not {thing[:2] for thing in named} & HELD_OBJECTS
            pairs = {(verb, scene[i].color) for verb, i in acts}
            assert bool(pairs & HELD_PAIRS) == (split == "pairs")
            places = [(scene[i].x, scene[i].y) for _, i in acts]
            held = [task.objects.is_held_out(*place) for place in places]
            # Two hands need things farther apart than the strip is wide.
            some = any if kind_of(said.goal) == "both" else all
            assert some(held) if split == "places" else not any(held)


def test_kinds_are_equally_frequent_though_some_fit_fewer_scenes() -> None:
    said = [kind_of(said.goal) for _, _, said in drawn(instruct.ALL, "train", 1000)]
    assert all(160 < said.count(kind) < 240 for kind in instruct.ALL.instructions.kinds)


def test_training_has_thousands_of_sentences_of_forty_words() -> None:
    texts = {said.text for _, _, said in drawn(instruct.ALL, "train", 1000)}
    assert len(texts) > 900
    known = instruct.ALL.vocabulary
    assert len(known) > 42
    words = {word for text in texts for word in split_words(text)}
    assert len(words) > 60 and words <= set(known)


# -- Episodes --------------------------------------------------------------------------


def test_what_is_not_on_the_table_is_not_simulated(env: gym.Env) -> None:
    env.reset(seed=1)
    base = env.unwrapped
    there = set(base.table.slot.flatten().tolist()) - {-1}
    for index, body in enumerate(base.objects):
        (part,) = body._bodies
        assert part.is_enabled == (index in there)
    scene = base.snapshot()
    empty = scene.color < 0
    assert empty.sum() == 5 - len(there)
    assert not scene.pose[empty].any() and (scene.shape[empty] == -1).all()
    on_table = scene.pose[~empty]
    assert (on_table[:, 2] > 0.03).all() and (on_table[:, 0] > 0.13).all()


def test_objects_stay_where_they_are_put(env: gym.Env) -> None:
    for seed in range(5):
        env.reset(seed=seed, options={"reconfigure": False})
        start = env.unwrapped.snapshot()
        hold = env.unwrapped.agent.get_proprioception()
        for _ in range(3):
            env.step(torch.zeros_like(hold["target"]))
        now = env.unwrapped.snapshot()
        touched = now.contact.any(1)
        assert (now.moved.norm(dim=-1)[~touched] < 2e-3).all(), start.shape


def test_another_sentence_begins_anew_without_a_reset(env: gym.Env) -> None:
    env.reset(seed=2)
    base = env.unwrapped
    for _ in range(4):
        env.step(torch.rand(1, 26) - 0.5)
    place = base.snapshot().pose
    color = list(COLORS)[int(base.snapshot().color[0, 0])]
    shape = SHAPES[int(base.snapshot().shape[0, 0])]
    base.tell(f"Please touch the {color} {shape} with your left hand.")
    (said,) = base.instructions
    assert said.goal == Touch(Ref(color, shape), "left")
    scene = base.snapshot()
    assert torch.equal(scene.start, place) and not base.get_info()["wrong_once"].any()
    assert (env.step(torch.zeros(1, 26))[0]["extra"]["instruction"][0] > 0).sum() > 5


@pytest.mark.parametrize(
    ("said", "message"),
    [
        (
            "Fetch me a beer.",
            "instruction: got 'Fetch me a beer.' .*got 'fetch'",
        ),
        ("Touch the one.", "expected exactly one"),
        (3.5, "instruction: got 3.5, expected a sentence"),
        (
            ["Touch the cube."] * 2,
            "instruction: got .'Touch the cube.', .* or a list of 1",
        ),
        (Instruction("touch it " * 30, Touch(Ref())), "at most 40 words"),
    ],
)
def test_what_cannot_be_told_changes_nothing(
    env: gym.Env, said: object, message: str
) -> None:
    env.reset(seed=5)
    base = env.unwrapped
    before = base.get_state(), base.instructions
    with pytest.raises(ValueError, match=message):
        base.tell(said)
    assert torch.equal(before[0], base.get_state()) and before[1] == base.instructions


def test_what_a_reset_is_told_is_true_of_its_scene(env: gym.Env) -> None:
    for text in ("Touch the yellow cube.", "Push the orange can to the left."):
        env.reset(seed=3, options={"instruction": text, "reconfigure": False})
        assert env.unwrapped.get_language_instruction() == [text]


def test_a_sentence_that_fits_no_scene_is_refused(
    env: gym.Env, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("ir_maniskill.environment.speaker.SCENES", 20)
    text = "Touch the red cube left of the red cube."
    with pytest.raises(ValueError, match=f"got '{text}', expected what is true"):
        env.reset(options={"instruction": text, "reconfigure": False})


def test_where_no_hand_reaches_nothing_can_be_told(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("ir_maniskill.environment.speaker.SCENES", 20)
    far = ((0.30, 0.36), (-0.3, -0.1))
    task = Experiment("Far-v1", Drawn((1, 2), area=far), Spoken())
    told = [Instruction("Touch the leftmost one.", Touch(Ref(where="leftmost")))]
    with pytest.raises(GoalError, match="got 'Touch the leftmost one.', expected what"):
        Speaker(task, layout_of(task, Nao)).draw([np.random.RandomState(0)], told)


def test_a_robot_with_one_hand_is_told_what_one_hand_can_do() -> None:
    task = instruct.ALL.in_split("wording")
    one, two = (Speaker(task, layout_of(task, robot)) for robot in (Panda, Nao))
    assert 100 < len(one.by_hand) < len(two.by_hand)
    streams = [np.random.RandomState(seed) for seed in range(40)]
    *_, said = one.draw(streams)
    assert not {kind_of(each.goal) for each in said} & {"hand", "both"}


def test_kinds_come_as_often_as_they_are_named() -> None:
    task = instruct.ALL.in_split(kinds=("push", "push", "touch"))
    streams = [np.random.RandomState(seed) for seed in range(90)]
    *_, said = Speaker(task, layout_of(task, Nao)).draw(streams)
    found = Counter(kind_of(each.goal) for each in said)
    assert found.keys() == {"push", "touch"}
    assert 45 < found["push"] < 75  # of 60, give or take 3.4 standard deviations


# -- Bad input -------------------------------------------------------------------------


def test_a_split_that_there_is_not_is_refused() -> None:
    with pytest.raises(ExperimentError, match="split: got 'test', available: train"):
        instruct.ALL.in_split("test")
    with pytest.raises(ExperimentError, match="split: got 'test', available: train"):
        ir_maniskill.make_vec("NaoInstruct-v1", 2, split="test")
    with pytest.raises(ExperimentError, match="split of .*Single.*: got 'places'"):
        catalog.get("NaoTouchCubeSingle-v1").in_split("places")
    with pytest.raises(ExperimentError, match="kind of .*: got 'then', available: t"):
        ir_maniskill.make_vec("NaoInstruct-v1", 2, kinds=("touch", "then"))
    with pytest.raises(ExperimentError, match="kinds of .*Single.*: got .*'touch'"):
        catalog.get("NaoTouchCubeSingle-v1").in_split(kinds=("touch",))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"count": (2, 25)}, "drawn count: got .*, expected .*1 to 24"),
        ({"count": (3, 2)}, "drawn count"),
        ({"count": (2, 12)}, "drawn count: got .* at most . objects in this area"),
        ({"colors": ("pink",)}, "drawn colors: got 'pink'"),
        ({"shapes": ("can", "can")}, "drawn shapes: got .*no two alike"),
        ({"apart": 0.01}, "drawn apart: got 0.01"),
        ({"area": ((0.0, 0.2), (-0.1, 0.1))}, "drawn area: got"),
    ],
)
def test_what_cannot_be_drawn_is_refused(changes: dict, message: str) -> None:
    with pytest.raises(ExperimentError, match=message):
        Drawn(**changes)


def test_drawn_objects_need_spoken_sentences() -> None:
    told = (Instruction("Push.", Push(Ref(), "left")),)
    with pytest.raises(ExperimentError, match="instructions: got .*expected Spoken"):
        Experiment("Mine-v1", Drawn(), told)
    with pytest.raises(ExperimentError, match="kind: got 'sing', available: touch"):
        Spoken(("sing",))


CUBES = catalog.get("NaoTouchCubeTriangle-v1").objects


def test_the_language_can_be_spoken_over_objects_that_lie_fixed() -> None:
    task = Experiment("Mine-v1", CUBES, Spoken(("touch", "where")))
    for slot, _, said in drawn(task, "train", 20):
        assert slot.tolist() == [0, 1, 2] and kind_of(said.goal) in ("touch", "where")
    one = Speaker(
        task := Experiment("Mine-v1", CUBES, Spoken()), layout_of(task, Panda)
    )
    *_, said = one.draw([np.random.RandomState(seed) for seed in range(40)])
    assert not any("hand" in verb for i in said for verb, _ in acts_of(i.goal))


def test_sentences_written_by_hand_are_said_where_they_can_be_true(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    few = Experiment("Mine-v1", Drawn(colors=("red", "blue")), Spoken())
    texts = {i.text for i in handwritten()}
    said = [i for *_, i in drawn(few, "wording", 40)]
    spoken = [i.text for i in said]  # as a state has them
    assert instructions_of(spoken, few.in_split("wording"), 40) == said
    assert 10 < sum(i.text in texts for i in said) < 30
    assert {ref.color for i in said for ref in i.goal.refs} <= {"red", "blue", None}
    # "Touch the only cube there is." is never true of three cubes.
    monkeypatch.setattr("ir_maniskill.environment.speaker.SCENES", 40)
    assert len(drawn(Experiment("Mine-v1", CUBES, Spoken()), "wording", 40)) == 40


# -- Vectors, senses and splits of all ids ---------------------------------------------


def test_spaces_do_not_depend_on_the_split() -> None:
    kwargs = {"obs_mode": "state_dict", "render_backend": "none"}
    spaces = []
    for split in ("train", "places"):
        env = gym.make("NaoInstruct-v1", split=split, **kwargs)
        spaces.append(env.observation_space)
        obs, _ = env.reset(seed=0)
        assert obs["extra"]["instruction"].shape == (1, Spoken.MAX_TOKENS)
        assert env.unwrapped.experiment.instructions.split == split
        env.close()
    assert spaces[0] == spaces[1]


def test_a_task_is_played_in_its_own_split_unless_told_otherwise(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setitem(
        catalog.CATALOG,
        "Mine-v1",
        Experiment("Mine-v1", Drawn(), Spoken(split="places")),
    )
    kwargs = {"experiment": "Mine-v1", "render_backend": "none"}
    for split, played in ((None, "places"), ("train", "train")):
        env = TouchEnv(split=split, obs_mode="state_dict", **kwargs)
        assert env.experiment.instructions.split == played
        env.close()


def test_a_vector_plays_what_single_envs_play() -> None:
    kwargs = {"obs_mode": "state_dict", "render_backend": "none"}
    envs = ir_maniskill.make_vec("NaoInstruct-v1", 3, split="pairs", **kwargs)
    try:
        obs, _ = envs.reset(seed=11)
        said = envs.call("get_language_instruction")
        alone = gym.make("NaoInstruct-v1", split="pairs", **kwargs)
        first, _ = alone.reset(seed=13)
        assert said[2] == alone.unwrapped.get_language_instruction()
        row = {k: v[2] for k, v in obs["extra"].items()}
        assert all(torch.equal(row[k], first["extra"][k][0]) for k in row)
        alone.close()
        envs.reset(seed=1, options={"instruction": "Touch the yellow can."})
        assert envs.call("get_language_instruction")[1] == ["Touch the yellow can."]
        with pytest.raises(ValueError, match="got 'Sing.' .*'sing' as word"):
            envs.reset(options={"instruction": "Sing."})
    finally:
        envs.close()
