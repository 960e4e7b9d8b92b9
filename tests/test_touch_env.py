"""What every task must do, and what a touch is."""

import dataclasses
import math
import os
import subprocess
import sys
import textwrap
from collections.abc import Iterator
from contextlib import closing

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium.utils.env_checker import check_env
from mani_skill.utils.wrappers.gymnasium import CPUGymWrapper
from trees import leaves

import ir_maniskill
from ir_maniskill import experiment as catalog
from ir_maniskill.environment.robots.nao import JOINTS, Nao
from ir_maniskill.environment.touch_env import CONTACT_OFFSET, TouchEnv
from ir_maniskill.experiment import Jitter
from ir_maniskill.goals import GoalError, Instruction, Ref, Then, Touch

IDS = ir_maniskill.available()[:8]
QUICK = ("NaoTouchButtonMulti-v1", "NaoTouchCubeShuffled-v1")
"""Tasks that stand for all where time is short."""


@pytest.fixture(
    scope="module",
    params=[
        *QUICK,
        *(pytest.param(i, marks=pytest.mark.slow) for i in IDS if i not in QUICK),
    ],
)
def env(request: pytest.FixtureRequest) -> Iterator[gym.Env]:
    """Each task in turn, with the simulator's state and without pictures."""
    env = gym.make(
        request.param,
        obs_mode="state_dict",
        control_mode="pd_joint_target_delta_pos",
        render_backend="none",
    )
    yield env
    env.close()


# -- Conformance over every task -------------------------------------------------------


def test_episodes_start_differently_within_the_jitter(env: gym.Env) -> None:
    experiment = env.unwrapped.experiment
    places = torch.tensor([thing.position for thing in experiment.objects])
    seats, sentences, previous = set(), set(), None
    env.reset(seed=0)
    for _ in range(24):
        obs = leaves(env.reset()[0])
        position = obs["extra/object_position"][0, :, :2]
        distance = torch.cdist(position, places, p=torch.inf)
        assert (distance.min(dim=1).values <= experiment.jitter.position + 1e-6).all()
        assert previous is None or not torch.equal(previous, position)
        seats.add(tuple(distance.argmin(dim=1).tolist()))
        sentences.add(env.unwrapped.get_language_instruction()[0])
        previous = position
    assert len(seats) > 3 if experiment.shuffled else seats == {(0, 1, 2)}
    assert sentences == set(experiment.sentences)


def test_the_sentence_its_tokens_and_its_object_belong_together(env: gym.Env) -> None:
    for index, instruction in enumerate(env.unwrapped.experiment.instructions):
        obs, _ = env.reset(options={"instruction": index})
        assert env.unwrapped.get_language_instruction() == [instruction.text]
        chosen = obs["extra"]["target_object"][0].argmax().item()
        thing = env.unwrapped.experiment.objects[chosen]
        assert instruction.goal == Touch(Ref(thing.color, thing.shape))
        heard = instruction.text.upper().rstrip(".")  # people type as they like
        again, _ = env.reset(options={"instruction": heard})
        assert torch.equal(again["extra"]["instruction"], obs["extra"]["instruction"])
        words = [catalog.VOCABULARY[token] for token in obs["extra"]["instruction"][0]]
        assert words == instruction.text.lower().replace(".", " .").split()
    for wrong in (3, True, 1.5, "Touch the sky.", [0, 0], float):
        with pytest.raises(ValueError, match="instruction: got .* expected an index"):
            env.reset(options={"instruction": wrong})


def test_an_episode_is_finite_and_ends_by_time_alone(env: gym.Env) -> None:
    env.reset(seed=2)
    for step in range(32):
        action = env.action_space.sample()
        obs, reward, terminated, truncated, info = env.step(action)
        assert all(leaf.isfinite().all() for leaf in leaves(obs).values())
        assert reward.isfinite().all()
        assert not terminated.any()
        assert truncated.item() == (step == 31)
        right, wrong = info["right_fingers"], info["wrong_fingers"]
        assert info["success"].item() == (right > 0).item()
        assert 0 <= right <= 6
        assert 0 <= wrong <= 6
        assert info["exclusive_success"].item() == (
            info["success_once"] & ~info["wrong_once"]
        )


# -- Modes ----------------------------------------------------------------------------


@pytest.mark.slow
def test_the_defaults_are_the_papers() -> None:
    env = gym.make("ir_maniskill:NaoTouchCubeSingle-v1", obs_mode="rgb")
    obs, _ = env.reset(seed=0)
    for camera in ("top_camera", "front_camera"):
        picture = obs["sensor_data"][camera]["rgb"]
        assert (tuple(picture.shape), picture.dtype) == ((1, 512, 256, 3), torch.uint8)
        assert picture.float().std() > 10  # there is something to see
    assert env.unwrapped.control_mode == "pd_joint_pos"
    assert env.unwrapped.reward_mode == "sparse"
    env.close()


@pytest.mark.parametrize(
    ("mode", "pack", "message"),
    [
        ("rgbd", "unlit", "'rgbd', but the shader pack of .* only rgb;"),
        ("rgb", "unlt", "'unlt', available: .*trivial, unlit"),
    ],
)
def test_shader_packs_that_cannot_draw_are_refused(mode, pack, message) -> None:
    with pytest.raises(ValueError, match=message):
        gym.make(IDS[0], obs_mode=mode, sensor_configs={"shader_pack": pack})


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"num_envs": 2, "sim_backend": "physx_cpu"}, "got 2, .*make_vec"),
        ({"sim_backend": "x"}, "sim_backend: got 'x', expected 'auto' or one of cpu"),
        ({"experiment": "NaoTouchCubeSolo-v1"}, "'NaoTouchCubeSolo-v1', available: N"),
        ({"experiment": None}, "task id: got None, expected a str"),
        ({"num_envs": 0}, "num_envs: got 0, expected a whole number, at least 1"),
        ({"reward_weights": {"hold": -1}}, "reward_weights.hold: got -1"),
        ({"reward_weights": {"held": 1}}, "got {'held': 1}, expected .*hold, approach"),
        ({"reward_weights": 3}, "reward_weights: got 3, expected a dict of some"),
        ({"observe": 3}, "observe: got 3, available"),
        ({"obs_mode": "rgb"}, "obs_mode: got 'rgb' with the render_backend 'none', ex"),
    ],
)
def test_arguments_that_cannot_work_are_refused(wrong: dict, message: str) -> None:
    given = {"experiment": "NaoTouchCubeSingle-v1", "render_backend": None}
    with pytest.raises(ValueError, match=message):
        TouchEnv(**given | wrong)


def test_actions_of_all_kinds_are_taken_and_those_not_finite_refused(
    fixed: gym.Env,
) -> None:
    fixed.reset(seed=0)
    for action in (
        torch.zeros(26, requires_grad=True),
        np.zeros(26)[::-1],
        torch.zeros(1, 26, dtype=torch.bfloat16),
    ):
        obs = fixed.step(action)[0]
        assert not any(leaf.requires_grad for leaf in leaves(obs).values())
    assert fixed.step([0.0] * 26)[4]["elapsed_steps"].item() == 4
    nan = np.full(26, np.nan, np.float32)
    for bad, message in (
        (nan, "expected finite numbers"),
        (torch.full((26,), torch.inf), "expected finite numbers"),
        ({"control_mode": "pd_joint_pos", "action": nan}, "expected finite numbers"),
        ([0.0] * 25, r"got shape \(25,\), expected \(1, 26\)"),
        (torch.zeros(2, 26), r"got shape \(2, 26\)"),
        (np.zeros(26, complex), "got complex numbers"),
        ("left", "got str .*, expected numbers"),
    ):
        with pytest.raises(ValueError, match=message):
            fixed.step(bad)
    assert fixed.step(np.zeros(26))[4]["elapsed_steps"].item() == 5


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"seed": "3"}, "seed: got '3', expected an integer"),
        ({"options": {"reconfigure": "no"}}, "'reconfigure': got 'no', expected True"),
        ({"options": {"instruction": True}}, "instruction: got True"),
        ({"options": {"reset_to_env_states": torch.zeros(1, 9)}}, "{'env_states': ..."),
    ],
)
def test_resets_of_the_wrong_kind_are_refused(
    fixed: gym.Env, wrong: dict, message: str
) -> None:
    fixed.reset(seed=0)
    before = fixed.unwrapped.get_state()
    with pytest.raises(ValueError, match=message):
        fixed.reset(**wrong)
    assert torch.equal(fixed.unwrapped.get_state(), before)


def test_an_option_that_is_mistyped_is_told_of(fixed: gym.Env) -> None:
    with pytest.warns(UserWarning, match="'instructon' not known here, only instruct"):
        fixed.reset(options={"instructon": 1})


# -- Touch ----------------------------------------------------------------------------


@pytest.fixture(scope="module")
def fixed() -> Iterator[gym.Env]:
    """The triangle without any jitter, driven by absolute targets."""
    still = dataclasses.replace(
        catalog.get("NaoTouchCubeTriangle-v1"),
        id="FixedTriangle-v1",
        jitter=Jitter(0, 0, 0),
    )
    ir_maniskill.register(still)
    env = gym.make(
        "FixedTriangle-v1",
        obs_mode="state_dict",
        render_backend="none",
        max_episode_steps=1000,
    )
    yield env
    env.close()


def hold(env: gym.Env, steps: int = 12, **joints: float) -> tuple[dict, float, dict]:
    """Hold joints at a target, all others at the start; return the last step."""
    target = np.zeros(26, np.float32)
    joints = {"LShoulderPitch": -0.1, "RShoulderPitch": -0.1} | joints
    for name, value in joints.items():
        target[JOINTS.index(name)] = value
    for _ in range(steps):
        obs, reward, _, _, info = env.step(target)
    return obs, reward.item(), info


BLUE, RED, GREEN = 0, 1, 2
PRESS = {"LShoulderPitch": 0.10, "LShoulderRoll": -0.1}


def test_without_jitter_the_scene_is_the_papers_fixed_one(fixed: gym.Env) -> None:
    a, b = (fixed.reset(seed=seed, options={"instruction": 0})[0] for seed in (1, 2))
    assert all(torch.equal(x, leaves(b)[path]) for path, x in leaves(a).items())
    expected = [[0.19, 0.0, 0.05], [0.23, 0.08, 0.05], [0.23, -0.08, 0.05]]
    torch.testing.assert_close(a["extra"]["object_position"][0], torch.tensor(expected))


def test_pressing_a_finger_on_the_named_cube_is_felt_and_rewarded(
    fixed: gym.Env,
) -> None:
    fixed.reset(seed=0, options={"instruction": RED})
    obs, reward, info = hold(fixed)
    assert not obs["extra"]["touch"].any()
    assert reward == 0
    obs, reward, info = hold(fixed, **PRESS)
    touching = obs["extra"]["touch"][0]
    assert touching[:3].any()  # left fingers
    assert not touching[3:].any()
    assert info["success"].item()
    assert reward == pytest.approx(touching.sum().item())
    obs, reward, info = hold(fixed, LShoulderPitch=-0.3)  # lift the hand
    assert not obs["extra"]["touch"].any()
    assert reward == 0
    assert not info["success"].item()
    assert info["success_once"].item()
    assert info["exclusive_success"].item()


def test_touching_a_wrong_cube_is_penalized(fixed: gym.Env) -> None:
    fixed.reset(seed=0, options={"instruction": GREEN})
    obs, reward, info = hold(fixed, **PRESS)
    fingers = obs["extra"]["touch"].sum().item()
    assert fingers >= 1
    assert reward == pytest.approx(-0.1 * fingers)
    assert info["wrong_once"].item()
    assert not info["success_once"].item()


def test_touching_the_table_is_nothing(fixed: gym.Env) -> None:
    fixed.reset(seed=0, options={"instruction": RED})
    obs, reward, info = hold(fixed, 20, LShoulderPitch=0.30, LShoulderRoll=0.75)
    heights = obs["extra"]["finger_position"][0, :3, 2]
    assert heights.min() < 0.03 + 0.02  # a fingertip is down on the table
    contacts = fixed.unwrapped.scene.get_contacts()
    names = {body.entity.name for c in contacts for body in c.bodies}
    assert any(name.startswith(("LFinger", "LThumb")) for name in names)
    assert not obs["extra"]["touch"].any()
    assert reward == 0
    assert not info["wrong_once"].item()


def test_a_reset_forgets_the_touches_of_the_last_episode(fixed: gym.Env) -> None:
    fixed.reset(seed=0, options={"instruction": RED})
    *_, last = hold(fixed, **PRESS)
    obs, info = fixed.reset()
    assert not obs["extra"]["touch"].any()
    assert not info["success_once"].any()
    assert last["success_once"].all()  # what was told of it stays
    assert last["elapsed_steps"].tolist() == [12]


def test_asking_again_changes_nothing_and_a_state_has_no_touches(
    fixed: gym.Env,
) -> None:
    base = fixed.unwrapped
    fixed.reset(seed=0, options={"instruction": GREEN})
    clean = base.get_state_dict()
    *_, pressed = hold(fixed, **PRESS)
    assert pressed["wrong_once"].item()
    base.set_state_dict(clean)  # PhysX still holds the contacts of the last step
    for _ in range(2):
        base.get_obs()
        info = base.get_info()
        assert not info["contact"].any()
        assert not info["wrong_once"].any()
    *_, again = hold(fixed, **PRESS)
    assert again["wrong_once"].item()
    assert base.get_info()["wrong_fingers"] == again["wrong_fingers"]


def test_a_stage_that_was_just_reached_counts_from_the_next_step(
    fixed: gym.Env,
) -> None:
    red = Touch(Ref("red"))
    twice = Instruction("Once, and once more.", Then(red, red))
    fixed.reset(seed=0, options={"instruction": twice})
    for _ in range(20):
        *_, info = hold(fixed, steps=1, **PRESS)
        if fixed.unwrapped.judged().stage.item():
            break
    again = fixed.unwrapped.get_info()
    assert again["contact"].any() and not again["success"] and not info["success"]
    *_, info = hold(fixed, steps=1, **PRESS)
    assert info["success"].item()


def test_what_was_told_in_an_earlier_episode_is_not_restored(fixed: gym.Env) -> None:
    base = fixed.unwrapped
    own = Instruction("Go to it.", Touch(Ref("red")))  # of no language
    fixed.reset(seed=0, options={"instruction": own})
    fixed.reset()
    state, said = base.get_state_dict(), base.get_language_instruction()
    fixed.reset(seed=1)  # in a scene built anew, where nothing has been told
    base.set_state_dict(state)
    assert base.get_language_instruction() == said


def test_a_touch_between_two_steps_counts(fixed: gym.Env) -> None:
    base = fixed.unwrapped
    fixed.reset(seed=0, options={"instruction": RED})
    hold(fixed, **PRESS)
    seen, update = [], base._touch.update

    def watch() -> None:
        if not seen:  # only the first substep finds contacts
            update()
        seen.append(base._touch.read().any().item())

    base._touch.update = watch
    *_, info = hold(fixed, 1, **PRESS)
    base._touch.update = update
    assert seen == [True] * 5
    assert info["success"].item()


def test_a_pressed_cube_stays_pressed_in_the_physics_of_spoken_tasks(
    fixed: gym.Env,
) -> None:
    physics = {"solver_position_iterations": Nao.solver_iterations}
    physics["contact_offset"] = CONTACT_OFFSET
    env = gym.make(
        fixed.spec.id,
        obs_mode="state_dict",
        render_backend="none",
        sim_config={"scene_config": physics},
    )
    env.reset(seed=0, options={"instruction": RED})
    hold(env, **PRESS)
    base = env.unwrapped
    start, before = base.table.poses(), base.agent.robot.get_qpos().clone()
    for _ in range(40):  # 2 s
        *_, info = hold(env, 1, **PRESS)
        assert info["success"].item()
        assert (base.agent.robot.get_qpos() - before).abs().max() < 0.002  # [rad]
    moved = base.table.poses() - start
    assert moved[..., :3].norm(dim=-1).max() < 0.002  # [m]
    env.close()


def test_dense_reward_grows_as_the_hand_comes_near() -> None:
    env = gym.make(
        "NaoTouchCubeTriangle-v1",
        obs_mode="none",
        reward_mode="normalized_dense",
        render_backend="none",
    )
    env.reset(seed=0, options={"instruction": RED})
    far = hold(env, LShoulderPitch=-0.5, RShoulderPitch=-0.5)[1]
    near = hold(env)[1]
    on_it = hold(env, **PRESS)[1]
    assert 0 <= far < near < on_it <= 1
    env.close()


def test_the_named_object_costs_by_its_own_speed() -> None:
    env = gym.make(
        "NaoTouchCubeTriangle-v1",
        obs_mode="none",
        reward_mode="dense",
        render_backend="none",
        reward_weights={"speed": 2.0},
    ).unwrapped
    env.reset(seed=0, options={"instruction": RED})

    def reward() -> float:
        return env.compute_dense_reward({}, None, env.evaluate()).item()

    still = reward()
    env.objects[BLUE].set_linear_velocity(torch.tensor([[0.1, 0.0, 0.0]]))
    assert reward() == pytest.approx(still, abs=1e-6)
    env.objects[RED].set_linear_velocity(torch.tensor([[0.1, 0.1, 0.1]]))
    assert reward() == pytest.approx(still - 2.0 * math.sqrt(0.03), abs=1e-6)
    env.close()


# -- At home in its ecosystem ---------------------------------------------------------


def test_after_a_reset_that_failed_a_step_is_refused() -> None:
    kwargs = {"obs_mode": "state", "render_backend": "none"}
    with closing(gym.make("NaoTouchCubeSingle-v1", **kwargs)) as env:
        with pytest.raises(GoalError, match="objects that fit"):
            env.reset(options={"instruction": "Touch the purple cube."})
        with pytest.raises(RuntimeError, match="the last reset failed; reset"):
            env.step(env.action_space.sample())
        env.reset(seed=0)
        env.step(env.action_space.sample())
    for use in (env.reset, lambda: env.step(None), lambda: env.unwrapped.tell(0)):
        with pytest.raises(RuntimeError, match="this env is closed: make a new one"):
            use()


@pytest.mark.slow
@pytest.mark.render
@pytest.mark.parametrize("obs_mode", ["state", "rgb"])
def test_gymnasiums_checker_accepts_the_cpu_wrapper(obs_mode: str) -> None:
    env = gym.make("NaoTouchButtonSingle-v1", obs_mode=obs_mode)
    # Left out: what makes the env anew from its spec, since ManiSkill's time limit
    # wrapper does not record its arguments.
    check_env(CPUGymWrapper(env), skip_render_check=True, skip_close_check=True)
    env.close()


@pytest.mark.slow
def test_without_vulkan_there_is_one_clear_error_and_state_modes_work() -> None:
    script = """
        import gymnasium as gym, ir_maniskill
        task = "NaoTouchButtonSingle-v1"
        env = gym.make(task, obs_mode="state", render_backend="none")
        env.reset(seed=0)
        env.step(env.action_space.sample())
        try:
            gym.make(task, obs_mode="rgb")
        except RuntimeError as error:
            print(error)
    """
    nowhere = {"VK_DRIVER_FILES": "/nowhere", "VK_ICD_FILENAMES": "/nowhere"}
    done = subprocess.run(
        [sys.executable, "-c", textwrap.dedent(script)],
        env=os.environ | nowhere,
        capture_output=True,
        text=True,
        check=True,
    )
    assert "expected a Vulkan device" in done.stdout
    assert "To render:" in done.stdout
