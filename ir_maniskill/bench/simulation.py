"""Speed of the simulation, beside a peer of ManiSkill's and a bare SAPIEN loop."""

from __future__ import annotations

import os
from contextlib import closing
from typing import Any

import gymnasium as gym
import numpy as np
import torch

from ir_maniskill.bench.report import Measure
from ir_maniskill.bench.timing import Block, Stopwatch, in_turn, timed
from ir_maniskill.environment.vector import make_vec

OURS = "NaoTouchCubeTriangle-v1"
PEER = "mani_skill.envs:UnitreeG1PlaceAppleInBowl-v1"
"""A humanoid task of ManiSkill's; it too looks through two cameras at 128 x 128."""
SIDE = 128
"""Height and width of the pictures that are compared [pixel]."""
EPISODE = 32
"""Steps of an episode of ours."""


def make(task: str, obs_mode: str, shader: str, side: int = SIDE) -> Any:
    """Make one env on the CPU and step it once.

    Args:
        task: Its id.
        obs_mode: "rgb" or "state".
        shader: Shader pack of the cameras.
        side: Height and width of the pictures [pixel].
    """
    cameras = {"width": side, "height": side, "shader_pack": shader}
    env = gym.make(
        task,
        obs_mode=obs_mode,
        num_envs=1,
        sim_backend="physx_cpu",
        render_backend="cpu",
        sensor_configs=cameras if obs_mode == "rgb" else {},
    )
    env.reset(seed=0)
    env.step(actions(env, 1)[0])
    return env


def actions(env: Any, steps: int) -> np.ndarray:
    """Return pinned random actions [T, J]."""
    env.action_space.seed(0)
    return np.stack([env.action_space.sample() for _ in range(steps)])


def stepping(env: Any, steps: int) -> Block:
    """Return a block that times some steps, episode after episode."""
    length = env.spec.max_episode_steps or EPISODE
    plan, done = actions(env, length), length

    def block() -> float:
        nonlocal done
        if done + steps > length:
            env.reset()
            done = 0
        part = plan[done : done + steps]
        done += steps
        return timed(lambda: [env.step(action) for action in part], steps)

    return block


def beside_peer(obs_mode: str, shader: str, seconds: float, goal: float) -> Measure:
    """Compare steps of one env with those of the peer."""
    few = 2 if obs_mode == "rgb" else 50
    with (
        closing(make(OURS, obs_mode, shader)) as ours,
        closing(make(PEER, obs_mode, shader)) as peer,
    ):
        blocks = {"ours": stepping(ours, EPISODE), "peer": stepping(peer, few)}
        time = in_turn(blocks, seconds)
    rgb = obs_mode == "rgb"
    pictures = f", two {SIDE} x {SIDE} pictures" if rgb else ""
    pack = f" ({shader})" if rgb else ""
    return Measure(
        f"{obs_mode}_beside_peer" + (f"_{shader}" if rgb else ""),
        f"steps/s, one process, {obs_mode}{pack}: ours / UnitreeG1",
        time["peer"] / time["ours"],
        goal,
        detail=f"{_ms(time)} a step{pictures}",
    )


def beside_bare_loop(shader: str, seconds: float) -> Measure:
    """Compare steps of one env with SAPIEN doing the same and nothing else."""
    with closing(make(OURS, "rgb", shader)) as env:
        blocks: dict[str, Block] = {
            "ours": stepping(env, EPISODE),
            "bare": BareLoop(env),
        }
        time = in_turn(blocks, seconds)
    return Measure(
        "rgb_beside_bare_loop",
        "steps/s, one process, rgb: ours / bare SAPIEN loop",
        time["bare"] / time["ours"],
        0.8,
        detail=f"{_ms(time)} a step",
    )


class BareLoop:
    """Drives an env's SAPIEN objects as a program without ManiSkill would.

    The joints get the targets that the env gives them for the actions of `stepping`,
    so that the physics is the same; the same two pictures are drawn and fetched.
    """

    def __init__(self, env: Any) -> None:
        """Record the targets of one episode."""
        base, self._env = env.unwrapped, env
        self._substeps = base.sim_freq // base.control_freq
        self._physics, (self._scene,) = base.scene.px, base.scene.sub_scenes
        sensors = base.scene.sensors.values()
        self._cameras = [sensor.camera._render_cameras[0] for sensor in sensors]
        self._joints = [joint._objs[0] for joint in base.agent.controller.joints]
        self._targets: list[list[float]] = []
        env.reset()
        for action in actions(env, EPISODE):
            env.step(action)
            self._targets.append(base.agent.controller.target[0].tolist())

    def __call__(self) -> float:
        """Return the time of a step [s]."""
        self._env.reset()
        return timed(self._episode, EPISODE)

    def _episode(self) -> None:
        for targets in self._targets:
            for joint, target in zip(self._joints, targets, strict=True):
                joint.set_drive_target(target)
            for _ in range(self._substeps):
                self._physics.step()
            self._scene.update_render()
            for camera in self._cameras:
                camera.take_picture()
            for camera in self._cameras:
                camera.get_picture("Color")


def processes(shader: str, seconds: float, envs_each: int = 8) -> Measure:
    """Compare as many worker processes as there are cores with one.

    Each has as many envs as in a training with default settings on two cores.
    """
    cores = len(os.sched_getaffinity(0))
    plan = torch.rand(EPISODE, cores * envs_each, 26) * 2 - 1
    kwargs: dict[str, Any] = {
        "obs_mode": "rgb",
        "sensor_configs": {"width": 32, "height": 64, "shader_pack": shader},
        "sim_backend": "physx_cpu",
    }
    with (
        closing(make_vec(OURS, envs_each, num_workers=1, **kwargs)) as one,
        closing(make_vec(OURS, cores * envs_each, num_workers=cores, **kwargs)) as many,
    ):
        blocks = {
            name: _stepping_all(envs, plan[:, : envs.num_envs])
            for name, envs in (("one", one), ("all", many))
        }
        time = in_turn(blocks, seconds)  # of one step of one env
    return Measure(
        "processes",
        f"steps/s, {cores} processes / {cores} x one process",
        time["one"] / time["all"] / cores,
        0.85,
        detail=f"{_ms(time)} a step; {envs_each} envs a process, rgb 64 x 32",
    )


def _stepping_all(envs: Any, plan: torch.Tensor) -> Block:
    envs.reset(seed=0)

    def block() -> float:
        return timed(
            lambda: [envs.step(action) for action in plan], plan[..., 0].numel()
        )

    return block


def resets(shader: str, seconds: float) -> Measure:
    """Compare a reset of an episode with a step."""
    with closing(make(OURS, "rgb", shader)) as env:
        blocks = {
            "reset": lambda: timed(lambda: [env.reset() for _ in range(8)], 8),
            "step": stepping(env, EPISODE),
        }
        time = in_turn(blocks, seconds)
    value = time["reset"] / time["step"]
    what = "time: reset of an episode / step"
    return Measure("reset", what, value, 5, at_most=True, detail=_ms(time))


def profile(shader: str, seconds: float) -> dict[str, float]:
    """Return the time that each part of a step takes, pictures included [s].

    Pictures are drawn in the background: "fetch" is the wait for what is not yet done.
    """
    watch = Stopwatch()
    with closing(make(OURS, "rgb", shader)) as env:
        base = env.unwrapped
        watch.watch(base.scene, "step", "physics")
        watch.watch(base.agent, "set_action", "control")
        watch.watch(base, "_contact_force", "contacts")
        watch.watch(base, "evaluate", "what contacts mean")
        watch.watch(base, "_get_obs_agent", "observation: joints")
        watch.watch(base, "_get_obs_extra", "observation: touch, sentence")
        watch.watch(base, "get_reward", "reward")
        watch.watch(base.scene, "update_render", "render: update")
        for name, sensor in base.scene.sensors.items():
            watch.watch(sensor, "capture", f"render: draw {name}")
        fetch = base._fetch_color

        def watched(sensor: Any) -> Any:
            with watch.part(f"render: fetch {sensor.config.uid}"):
                return fetch(sensor)

        base._fetch_color = watched
        plan, steps = actions(env, EPISODE), 0

        def block() -> float:
            nonlocal steps
            before = dict(watch.seconds)
            env.reset()
            watch.seconds = before  # a reset is no part of a step
            for action in plan:
                with watch.part("Python, all the rest"):
                    env.step(action)
            steps += EPISODE
            return 0.0

        block()
        watch.seconds, steps = {}, 0
        in_turn({"episode": block}, seconds)
    each = {name: total / steps for name, total in watch.seconds.items()}
    return dict(sorted(each.items(), key=lambda item: -item[1]))


def _ms(times: dict[str, float]) -> str:
    return ", ".join(f"{name} {1e3 * time:.2f} ms" for name, time in times.items())
