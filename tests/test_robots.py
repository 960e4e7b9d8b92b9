"""Every robot does every task: what they ask of any robot is asked of all of ours."""

import math
from collections.abc import Iterator
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
import sapien
import torch
from mani_skill.agents.registration import REGISTERED_AGENTS
from mani_skill.sensors.camera import CameraConfig

import ir_maniskill
from ir_maniskill import Experiment, TouchObject
from ir_maniskill import experiment as catalog
from ir_maniskill.environment import table_scene
from ir_maniskill.environment.robots import Nao, Panda, UnitreeG1
from ir_maniskill.environment.robots.robot import (
    JointGroup,
    Robot,
    RobotError,
    robot_class,
)
from ir_maniskill.environment.robots.urdf import read_motors
from ir_maniskill.environment.touch_env import TouchEnv
from ir_maniskill.evaluation.video import VIEW, VIEWPOINT
from ir_maniskill.experiment import OBJECT_SIZE, ExperimentError

TASK = "NaoTouchCubeTriangle-v1"
ROBOTS = {"nao": Nao, "g1": UnitreeG1, "panda": Panda}
ABSOLUTE, DELTA = "pd_joint_pos", "pd_joint_target_delta_pos"
FAST = {"obs_mode": "state_dict", "render_backend": "none"}
SEEN = {"width": 64, "height": 128, "shader_pack": "trivial"}


@pytest.fixture(
    scope="module", params=[(r, m) for r in ROBOTS for m in (ABSOLUTE, DELTA)]
)
def env(request: pytest.FixtureRequest) -> Iterator[TouchEnv]:
    """The paper's triangle without pictures, for each robot in either control mode."""
    robot, mode = request.param
    env = gym.make(TASK, robot_uids=robot, control_mode=mode, **FAST)
    yield env.unwrapped
    env.close()


def holding(env: TouchEnv) -> np.ndarray:
    """Return the action that leaves the targets where they are."""
    target = env.agent.get_proprioception()["target"][0].numpy()
    return target if env.control_mode == ABSOLUTE else np.zeros_like(target)


# -- Body ------------------------------------------------------------------


def test_an_action_a_joint_and_a_bit_a_finger(env: TouchEnv) -> None:
    obs, _ = env.reset(seed=0)
    joints, fingers = len(env.agent.joints), env.agent.fingers
    assert env.action_space.shape == (joints,)
    assert obs["agent"]["proprioception"].shape == (1, joints)
    assert obs["extra"]["touch"].shape == (1, len(fingers))
    assert len(set(fingers)) == len(fingers) == sum(map(len, env.agent.hands.values()))
    for finger, links in zip(fingers, env.agent.finger_links, strict=True):
        assert any(link._bodies[0].collision_shapes for link in links), finger


def test_nothing_vibrates_while_the_start_is_held(env: TouchEnv) -> None:
    for seed in range(2):
        env.reset(seed=seed)
        before = env.agent.finger_position()
        for step in range(40):  # 2 s
            obs = env.step(holding(env))[0]
            if step >= 20:
                assert obs["agent"]["velocity"].abs().max() < 1e-3  # [rad/s]
        assert (env.agent.finger_position() - before).abs().max() < 0.003  # [m]


@pytest.mark.slow
@pytest.mark.parametrize("task", [TASK, "NaoInstruct-v1"])
@pytest.mark.parametrize("robot", ROBOTS)
def test_two_thousand_random_actions_break_no_limit(robot: str, task: str) -> None:
    env = gym.make(task, robot_uids=robot, control_mode=DELTA, **FAST).unwrapped
    env.reset(seed=0)
    exact = 15 if task == TASK else env.agent.solver_iterations
    assert env.agent.robot._objs[0].solver_position_iterations == exact
    low, high = env.agent.robot.get_qlimits()[0].T  # [J]
    slides = [env.agent._motors[j.name].slides for j in env.agent.robot.active_joints]
    slack = torch.where(torch.tensor(slides), 0.002, math.radians(2))  # 2 mm, 2 degrees
    random = np.random.default_rng(0)
    for step in range(2_000):
        if step % 32 == 0:
            env.reset()
        env.step(random.uniform(-1, 1, env.action_space.shape).astype(np.float32))
        qpos = env.agent.robot.get_qpos()[0]
        assert qpos.isfinite().all()
        assert ((qpos >= low - slack) & (qpos <= high + slack)).all()
    env.close()


def test_hands_start_above_the_table_near_the_objects_and_free(env: TouchEnv) -> None:
    scale = env.agent.scale
    for seed in range(3):
        obs, _ = env.reset(seed=seed)
        tips = obs["extra"]["finger_position"][0]  # [F, 3]
        things = obs["extra"]["object_position"][0]  # [C, 3]
        assert tips[:, 2].min() > scale * (table_scene.TABLE_TOP + 0.02)
        assert torch.cdist(tips, things).amin(dim=1).max() < scale * 0.12
        env.step(holding(env))
        links = {link.name for link in env.agent.robot._objs[0].links}
        for contact in env.scene.px.get_contacts():
            depth = min((point.separation for point in contact.points), default=1)
            bodies = {body.name for body in contact.bodies}
            assert depth > 0 or not bodies & links, bodies


def test_everything_is_as_large_as_the_robot_says(env: TouchEnv) -> None:
    env.reset(seed=0)
    scale, experiment = env.agent.scale, env.experiment
    for thing, actor in zip(experiment.objects, env.objects, strict=True):
        shape = actor._bodies[0].collision_shapes[0]
        np.testing.assert_allclose(shape.half_size, scale * OBJECT_SIZE / 2)
        place = actor.pose.p[0, :2] / scale
        np.testing.assert_allclose(place, thing.position, atol=0.0101)
    positions = torch.stack([actor.pose.p for actor in env.objects], dim=1)
    scene = env.snapshot()  # goals are measured at NAO's scale
    np.testing.assert_allclose(scene.position * scale, positions, rtol=1e-5)
    np.testing.assert_allclose(scene.start, scene.pose, atol=1e-6)


# -- Reach ------------------------------------------------------------------


@pytest.mark.parametrize("robot", ROBOTS.values())
def test_all_tasks_are_within_reach(robot: type[Robot]) -> None:
    for task in catalog.available():
        robot.require_reach(catalog.get(task))


@pytest.mark.parametrize(
    ("robot", "far"),  # scale x (distance + sqrt(2) cm of jitter)
    [
        (Nao, "0.314"),  # 0.30 + 0.014
        (UnitreeG1, "0.570"),  # |0.60 - 0.06, 0.196 - 0.154| + 0.028
        (Panda, "0.786"),  # |0.54 + 0.20, 0.1764| + 0.025
    ],
)
def test_what_is_out_of_reach_is_refused(robot: type[Robot], far: str) -> None:
    thing = TouchObject("red", (0.30, 0.098))
    task = Experiment("Far-v1", (thing,), ir_maniskill.touch_instructions([thing]))
    with pytest.raises(ExperimentError, match=f"red cube at .*: {far} m .*{robot.uid}"):
        robot.require_reach(task)


# -- Names ------------------------------------------------------------------


def test_robots_have_short_names_that_leave_others_alone(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    for name, robot in ROBOTS.items():
        assert all(robot_class(known) is robot for known in (name, robot.uid, robot))
    assert not issubclass(REGISTERED_AGENTS["panda"].agent_cls, Robot)
    for unknown in ("unitree_g1", "moon"):
        with pytest.raises(RobotError, match=f"got '{unknown}'.*nao, .*panda"):
            robot_class(unknown)
    monkeypatch.setitem(REGISTERED_AGENTS, "g1", REGISTERED_AGENTS["nao"])
    assert robot_class("g1") is ROBOTS["nao"]  # somebody's own


# -- Pictures ------------------------------------------------------------------


@pytest.mark.render
@pytest.mark.parametrize("robot", ROBOTS)
def test_cameras_see_the_hands_and_all_objects(robot: str) -> None:
    modes = {"obs_mode": "rgb+segmentation", "sensor_configs": SEEN}
    with gym.make(TASK, robot_uids=robot, **modes) as made:
        env = made.unwrapped
        obs, _ = env.reset(seed=1)
        pixels = [
            np.bincount(
                obs["sensor_data"][name]["segmentation"].flatten(), minlength=99
            )
            for name in ("top_camera", "front_camera")
        ]
        by_name = {thing.name: i for i, thing in env.segmentation_id_map.items()}
        for thing in env.experiment.objects:
            assert min(count[by_name[thing.name]] for count in pixels) > 20
        for fingers in env.agent.hands.values():
            first = env.agent.fingers.index(fingers[0])
            hand = env.agent.finger_links[first : first + len(fingers)]
            ids = [by_name[link.name] for links in hand for link in links]
            assert max(count[ids].sum() for count in pixels) > 10
        bodies = [*env.agent.robot.links, *env.objects]
        points = np.array([body.pose.p[0].numpy() for body in bodies])
        over_table = points[points[:, 2] > env.agent.scale * table_scene.TABLE_TOP]
        for camera in (
            table_scene.video_camera(env.agent.scale),
            film(env.agent.scale),
        ):
            assert edge(camera, over_table) < 0.95


def film(scale: float) -> CameraConfig:
    """Return the camera of a film."""
    pose = table_scene.view(scale, *VIEWPOINT)
    return CameraConfig("film", pose, VIEW[2], VIEW[3], fov=0.58)


def edge(camera: CameraConfig, points: np.ndarray) -> float:
    """Return how far from a picture's middle the points are at most; 1 is the edge."""
    local = camera.pose.inv().sp.to_transformation_matrix()
    x, y, z = local[:3, :3] @ points.T + local[:3, 3:]  # forward, left, up
    high = math.tan(camera.fov / 2)
    wide = high * camera.width / camera.height
    assert (x > 0).all()
    return max(abs(z / x).max() / high, abs(y / x).max() / wide)


# -- A robot of one's own --------------------------------------------------------------

BOX = "<collision><geometry><box size='0.02 0.02 0.1'/></geometry></collision>"
MESH = BOX.replace("box size='0.02 0.02 0.1'", "mesh filename='x' scale='1 -1 1'")
INERTIAL = (
    "<inertial><mass value='0.1'/><inertia ixx='1e-3' iyy='1e-3' izz='1e-3' ixy='0' "
    "ixz='0' iyz='0'/></inertial>"
)
LIMIT = "<limit lower='-1' upper='1' effort='5' velocity='5'/>"


def link(name: str, shape: str = BOX) -> str:
    return f"<link name='{name}'>{INERTIAL}{shape}</link>"


def joint(
    name: str, parent: str, child: str, more: str = LIMIT, kind="revolute"
) -> str:
    """Return a joint a hand's width above its parent, about y."""
    ends = f"<parent link='{parent}'/><child link='{child}'/>"
    origin = "<origin xyz='0 0 0.1'/><axis xyz='0 1 0'/>"
    return f"<joint name='{name}' type='{kind}'>{ends}{origin}{more}</joint>"


ARM = link("base", "") + link("arm") + joint("lift", "base", "arm")
TIPS = (
    link("tip_1")
    + joint("bend_1", "arm", "tip_1")
    + link("tip_2")
    + joint("bend_2", "tip_1", "tip_2", LIMIT + "<mimic joint='bend_1'/>")
)


def written(folder: Path, *parts: str) -> str:
    path = folder / "stick.urdf"
    path.write_text(f"<robot name='stick'>{''.join(parts)}</robot>")
    return str(path)


def stick(path: str, **changes: object) -> type[Robot]:
    """Return a robot with one arm and one finger that are described there."""

    class Stick(Robot):
        uid = "stick"
        urdf_path = path
        joints = ("lift", "bend_1", "bend_2")
        hands = {"hand": ("tip",)}  # noqa: RUF012
        fingertips = {"tip": "tip_2"}  # noqa: RUF012
        postures = {"start": {"lift": 0.5}}  # noqa: RUF012
        shoulders = ((0.0, 0.0),)
        reach = 1.0

        def drive(self, joint: str) -> JointGroup:
            return JointGroup(20, 2, 1e-2, 0.2)

    for name, value in changes.items():
        setattr(Stick, name, value)
    return Stick


def made(robot: type[Robot]) -> TouchEnv:
    return gym.make(TASK, robot_uids=robot, **FAST).unwrapped


def test_a_joint_that_is_not_driven_is_held_and_one_that_mimics_is_free(
    tmp_path: Path,
) -> None:
    loose = link("flag") + joint("spin", "arm", "flag", kind="continuous", more="")
    path = written(tmp_path, ARM, TIPS, loose)
    postures = {"start": {"lift": 0.0, "spin": 0.5}}
    env = made(stick(path, postures=postures, mount=sapien.Pose([0, 0, 1])))
    env.reset(seed=0)
    action = np.array([0, 0, 0.8], np.float32)
    for _ in range(20):
        obs = env.step(action)[0]
    felt = obs["agent"]["proprioception"][0]
    np.testing.assert_allclose(felt, action, atol=0.02)
    assert obs["agent"]["velocity"].shape == (1, 3)
    flag = env.agent.robot.links_map["flag"].pose.sp
    np.testing.assert_allclose(flag.p, [0, 0, 1.2], atol=0.01)
    np.testing.assert_allclose(flag.rpy, [0, 0.5, 0], atol=0.02)
    env.close()


@pytest.mark.parametrize(
    ("part", "named"),
    [
        (joint("bend_1", "arm", "tip", more=""), "'bend_1'.*<limit />"),
        (joint("bend_1", "arm", "tip", kind="continuous"), "'bend_1'.*'continuous'"),
        (joint("bend_1", "arm", "tip", LIMIT.replace("5", "0")), 'effort="0"'),
        (joint("bend_1", "arm", "tip", LIMIT.replace("-1", "2")), 'lower="2"'),
        (
            joint("bend_1", "arm", "tip", "<limit effort='x'/>"),
            "'bend_1'.*effort=\"x\"",
        ),
        (joint("bend", "arm", "tip"), "missing joints: bend_1.*lift, bend"),
        (link("arm"), "link 'arm': got two"),
        (joint("lift", "arm", "tip"), "joint 'lift': got two"),
        (link("flag", BOX.replace("0.02 0.02 0.1", "0")), "link 'flag': <box> size"),
        (link("flag", BOX.replace("box size", "cone size")), "'flag': <geom.*got cone"),
        (link("flag", "<collision><geometry/></collision>"), "'flag': <geom.*nothing"),
        (
            link("flag", BOX.replace("box size='0.02 0.02 0.1'", "sphere radius='0'")),
            "'flag': <sphere> radius",
        ),
        (link("flag", MESH), "link 'flag': <mesh> scale.*mirror"),
        (link("flag", MESH.replace("1 -1 1", "1")), "got '1', expected three numbers"),
        (link("flag", MESH.replace("1 -1", "1 1").replace("'x'", "''")), "'filename'"),
        (link("flag").replace("1e-3", "0"), "'flag': <inertial>.* of inertia 0 0 0"),
        (link("flag").replace("value='0.1'", "value='-1'"), "got a mass of -1 kg"),
        (link(""), "a <link> has no name"),
        (joint("spin", "arm", "tip").replace("0 1 0", "0 0 0"), "'spin': <axis>"),
        ("<link>", "not XML"),
    ],
)
def test_what_a_file_lacks_is_named(tmp_path: Path, part: str, named: str) -> None:
    path = Path(written(tmp_path, ARM, link("tip"), part))
    with pytest.raises(RobotError, match=f"stick.urdf: .*{named}"):
        read_motors(path, ("lift", "bend_1"))


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({"fingertips": {}}, r"finger 'tip' .*\(\), .*available: .*tip_2"),
        ({"fingertips": {"tip": "tip_9"}}, "finger 'tip' .*tip_9.*available: .*tip_2"),
        ({"phalanges": {"tip": ("palm",)}}, "finger 'tip' .*palm.*available: .*tip_2"),
        ({"hands": {"hand": ("thumb",)}}, r"finger 'thumb' .*\(\).*available: .*tip_2"),
        ({"shoulders": ()}, r"shoulders of .*'stick': got \(\), .* \('hand',\)"),
    ],
)
def test_a_hand_or_finger_that_lacks_something_is_named(
    tmp_path: Path, changes: dict[str, object], named: str
) -> None:
    with pytest.raises(RobotError, match=named):
        made(stick(written(tmp_path, ARM, TIPS), **changes))


def test_a_finger_that_cannot_feel_is_named(tmp_path: Path) -> None:
    numb = TIPS.replace(BOX, "")
    with pytest.raises(RobotError, match="stick.urdf.* 'tip' .*tip_1, tip_2.*feels no"):
        made(stick(written(tmp_path, ARM, numb)))
    (tmp_path / "tip.stl").write_text("solid tip, or so it says")
    mesh = "<collision><geometry><mesh filename='tip.stl'/></geometry></collision>"
    broken = TIPS.replace(BOX, mesh, 1)
    with pytest.raises(RobotError, match="stick.urdf: .*cannot be made: tip_1;"):
        made(stick(written(tmp_path, ARM, broken)))
