"""What an episode would have been worth under other sentences."""

import dataclasses

import gymnasium as gym
import pytest
import torch
from scenes import HANDS as FINGERS
from scenes import scene

from ir_maniskill import experiment as catalog
from ir_maniskill.environment.instructional_set import GoalTable
from ir_maniskill.environment.senses import read_text, text_of
from ir_maniskill.goals import Avoid, Both, Instruction, Push, Ref, Then, Touch
from ir_maniskill.snapshot import Snapshot
from ir_maniskill.training.config import CONFIGS
from ir_maniskill.training.hindsight import Hindsight, Pursuit, _in_turns, _order

HANDS = {"left": ("a", "b", "c"), "right": ("d", "e", "f")}
LISTEN = CONFIGS["listen"]
SHUFFLED = catalog.get("NaoTouchCubeShuffled-v1")


def joined(*scenes):
    """Return an episode of one-row snapshots."""
    rows = zip(*(vars(each).values() for each in scenes), strict=True)
    return Snapshot(*(torch.cat(parts) for parts in rows))


def told(*goals):
    return [Instruction(f"Goal {index}.", goal) for index, goal in enumerate(goals)]


def sparse():
    return Hindsight(SHUFFLED, HANDS, None, others=2)


def test_a_touch_of_the_wrong_cube_is_a_right_one_under_another_sentence() -> None:
    # Nothing; two fingers on red; one of the left hand on blue.
    episode = joined(scene(), scene((0, 1), (3, 1)), scene((2, 0)))
    goals = Touch(Ref("blue")), Touch(Ref("red")), Touch(Ref("blue"), "right")
    judged = sparse().judge(episode, told(*goals))
    assert judged.holds.tolist() == [[0, 0, 0], [0, 1, 0], [1, 0, 0]]
    assert judged.fouled.tolist() == [[0, 0, 0], [1, 0, 1], [1, 1, 1]]
    # The task pays 1 a finger, and takes 0.1 for each wrong one.
    expected = [[0, 0, 0], [-0.2, 2, -0.2], [1, -0.1, -0.1]]
    torch.testing.assert_close(judged.reward, torch.tensor(expected))
    blue, red = [0.19, 0.0, 0.05], [0.23, 0.08, 0.05]
    torch.testing.assert_close(judged.named[1, :2], torch.tensor([blue, red]))


def test_what_is_touched_when_an_episode_begins_is_no_foul() -> None:
    judged = sparse().judge(joined(scene((0, 1)), scene()), told(Touch(Ref("blue"))))
    assert not judged.fouled.any()


def test_sequences_go_on_from_what_was_reached_before() -> None:
    goal = Then(Touch(Ref("red")), Then(Touch(Ref("blue")), Touch(Ref("red"))))
    red, blue, none = scene((0, 1)), scene((0, 0)), scene()
    judged = sparse().judge(joined(none, blue, red, blue, none, red), told(goal))
    assert judged.holds.flatten().tolist() == [False] * 5 + [True]
    other = sparse().judge(joined(none, red, none, red), told(goal))
    assert not other.holds.any()


def test_critics_are_told_of_every_kind_of_goal_in_as_many_numbers() -> None:
    blue, red = Ref("blue"), Ref("red")
    goals = (
        Touch(blue),
        Push(red, "left"),
        Both(Touch(blue, "left"), Avoid(red)),
        Then(Touch(red), Push(blue, "away")),
    )
    goal = sparse().judge(joined(scene(), scene((0, 1))), told(*goals)).goal
    assert goal.shape[:2] == (2, 4)
    assert len(torch.unique(goal[0], dim=0)) == 4, "two goals look the same"


@pytest.mark.parametrize("slots", [[2, 0, 1], [1, 2, 0]])
@pytest.mark.parametrize("there", [True, False])
def test_critics_need_not_know_in_which_slots_objects_lie(slots, there) -> None:
    blue, red = Ref("blue"), Ref("red")
    goals = told(Touch(blue), Push(red, "left"), Both(Touch(blue), Avoid(red)))
    places = [(0.19, 0.0, 0.05), (0.23, 0.08, 0.05), (0.2, -0.1, 0.05)]
    start = scene(places=places)
    now = scene((0, 1), moved=(0.0, 0.01, 0.0), which=1, places=places)
    now.velocity[:] = torch.tensor([[0.1], [0.2], [0.3]])
    if not there:
        start.color[:, 2] = now.color[:, 2] = -1
    seen = [sparse().judge(joined(start, now), goals).goal]
    for each in (start, now):  # the same objects, at other indices
        for name in ("pose", "start", "velocity", "color", "shape"):
            vars(each)[name] = vars(each)[name][:, slots]
        vars(each)["contact"] = each.contact[:, :, slots]
    seen.append(sparse().judge(joined(start, now), goals).goal)
    torch.testing.assert_close(*seen)


@pytest.mark.parametrize(
    ("goal", "order"),
    [
        (Touch(Ref("red")), [1, 0, 2]),  # red, then blue, which is nearer than green
        (Touch(Ref("green")), [2, 0, 1]),
        (Both(Touch(Ref("red")), Touch(Ref("green"))), [2, 1, 0]),  # right to left
        (Avoid(Ref("green")), [0, 2, 1]),  # it asks about none
    ],
)
def test_what_is_asked_about_comes_first_then_what_is_near(goal, order) -> None:
    at = scene(places=[(0.19, 0.0, 0.05), (0.23, 0.08, 0.05), (0.2, -0.1, 0.05)])
    one = torch.zeros(1, dtype=torch.int64)
    measure = GoalTable([goal], FINGERS, torch.device("cpu")).deal(one, at).measure(at)
    assert _order(at, measure).tolist() == [order]
    at.color[:, 0] = -1
    assert _order(at, measure).tolist() == [[*(i for i in order if i), 0]]


def test_critics_and_the_acting_teacher_are_told_the_same_of_a_sequence() -> None:
    then = Then(Touch(Ref("red")), Touch(Ref("blue")))
    hindsight = sparse()
    hindsight._listed = tuple(told(then))  # both are touched in the same step
    rows = [scene(), *(scene((0, 1), (1, 0), stage=stage) for stage in (1, 2))]
    pursuit, text = Pursuit(hindsight, 1), text_of(["Goal 0."])
    looks = [pursuit.look(row, text) for row in rows]
    judged = hindsight.judge(joined(*rows), told(then))
    assert judged.fouled[:, 0].tolist() == [False, True, True]
    torch.testing.assert_close(torch.cat(looks), judged.goal[:, 0])


def test_a_listed_task_is_judged_under_its_own_sentences() -> None:
    hindsight = Hindsight(SHUFFLED, HANDS, None, others=8)
    found = hindsight.find(scene(), SHUFFLED.sentences[1], 8)
    assert hindsight.sentences == 3
    assert found[0].text == SHUFFLED.sentences[1]
    assert {each.text for each in found} == set(SHUFFLED.sentences)
    read = hindsight.read(found, {"instruction": 7})
    assert read["instruction"].shape == (3, 7)


def test_spoken_sentences_are_read_as_they_are_and_loosely() -> None:
    torch.manual_seed(0)
    hindsight = Hindsight.of(dataclasses.replace(LISTEN, env_id="NaoInstruct-v1"), 4)
    plain = "Could you touch the object that is green with your left hand?"
    read = hindsight.read([hindsight.said(plain)] * 100, {"text": 200})["text"]
    said = read_text(read)
    assert 30 < said.count(plain) < 70
    assert all("green" in text and "left hand" in text for text in said)


def test_the_goal_of_a_sentence_written_by_hand_is_known() -> None:
    hindsight = Hindsight.of(dataclasses.replace(LISTEN, env_id="NaoInstruct-v1"), 4)
    assert hindsight.said("toch the blu cube").goal == Touch(Ref("blue", "cube"))


def test_sentences_that_came_true_are_preferred() -> None:
    torch.manual_seed(0)
    hindsight = Hindsight.of(dataclasses.replace(LISTEN, env_id="NaoInstruct-v1"), 4)
    episode = joined(scene(), scene((0, 1)), scene((0, 1)))  # red is touched
    chosen = found = 0
    for _ in range(50):
        told, judged = hindsight.choose(episode, "Touch the blue one.")
        assert told[0].text == "Touch the blue one."
        chosen += int(judged.holds.any(dim=0).sum())
        any_of_them = hindsight.find(scene(), "Touch the blue one.", 4)
        found += int(hindsight.judge(episode, any_of_them).holds.any(dim=0).sum())
    assert chosen > 1.5 * found > 0


def test_what_came_true_takes_turns_by_what_it_asks_the_rarest_first() -> None:
    red, can = Ref("red"), Ref("red", "can")
    touches = [Touch(red), Touch(can), Both(Touch(red), Avoid(can)), Touch(red, "left")]
    found = told(*touches, Push(can, "away"), Push(red, "away"), Push(can, "left"))
    fulfilled = torch.tensor([True, True, True, False, True, True, True])
    order = _in_turns(found, fulfilled)
    assert set(order[:2]) == {2, 6}  # one of a kind each
    touch, push = {0, 1}, {4, 5}
    for turn in (set(order[2:4]), set(order[4:])):
        assert len(turn & touch) == len(turn & push) == 1


@pytest.mark.parametrize("task", ["NaoTouchCubeShuffled-v1", "NaoInstruct-v1"])
def test_an_episode_is_judged_as_the_env_judged_it(task) -> None:
    env = gym.make(
        task,
        obs_mode="none",
        control_mode="pd_joint_target_delta_pos",
        reward_mode="dense",
        reward_weights=dataclasses.asdict(LISTEN.reward_weights),
        render_backend="none",
    )
    base, generator = env.unwrapped, torch.Generator().manual_seed(0)
    hindsight = Hindsight.of(dataclasses.replace(LISTEN, env_id=task), others=4)
    pursuit, touched = Pursuit(hindsight, 1), 0
    for seed in range(3):
        env.reset(seed=seed)
        scenes, rewards, ends = [base.snapshot()], [], []
        text = text_of(base.get_language_instruction())
        pursuit.forget([0])
        looks = [pursuit.look(base.snapshot(), text)]
        for _ in range(32):
            action = 2 * torch.rand(26, generator=generator) - 1
            _, reward, _, _, info = env.step(action)
            scenes.append(base.snapshot())
            looks.append(pursuit.look(base.snapshot(), text))
            rewards.append(reward)
            ends.append((info["success"], info["wrong_once"]))
            touched += int(info["contact"].any())
        rows = Snapshot.unpack(joined(*scenes).pack(), hindsight.fingers)
        (said,) = base.get_language_instruction()
        found, judged = hindsight.choose(rows, said)
        assert found[0].goal == base.instructions[0].goal
        assert len(found) == hindsight.sentences
        torch.testing.assert_close(judged.reward[1:, 0], torch.cat(rewards))
        holds, wrong = (torch.cat(column) for column in zip(*ends, strict=True))
        assert judged.holds[1:, 0].equal(holds)
        assert judged.fouled[1:, 0].equal(wrong)
        torch.testing.assert_close(torch.cat(looks), judged.goal[:, 0])
    env.close()
    assert touched > 0, "nothing was judged"
