"""A NAO URDF of the user's own, in the form of the official ones, becomes the robot.

The one used here is made from the tables of facts: all joints and links of the official
description, mimicking fingers, sensor frames, and meshes (boxes) in a ROS package.
"""

import dataclasses
import xml.etree.ElementTree as ET
from collections.abc import Iterator
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
import trimesh

import ir_maniskill
from ir_maniskill import Jitter
from ir_maniskill import experiment as catalog
from ir_maniskill.assets.nao import URDF_PATH, facts
from ir_maniskill.environment.robots.nao import JOINTS
from ir_maniskill.environment.robots.nao_urdf import adapt
from ir_maniskill.environment.robots.robot import RobotError

VARIABLE = "IR_MANISKILL_NAO_URDF"
MESHES = "package://nao_meshes/meshes"
MOMENTS = ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")


def official(folder: Path) -> Path:
    """Write a description with its meshes in another package; return the URDF."""
    meshes = folder / "nao_meshes" / "meshes"
    meshes.mkdir(parents=True)
    phalanx = trimesh.creation.box((0.1436, 0.11, 0.11))  # [dm], as the official ones
    phalanx.apply_translation((0.0718, 0, 0))
    for name in ("phalanx.stl", "phalanx.dae"):
        phalanx.export(meshes / name)
    robot = ET.Element("robot", name="NaoH25V50")
    motor = ET.SubElement(robot, "transmission", name="LShoulderPitch_Transmission")
    ET.SubElement(motor, "joint", name="LShoulderPitch")
    robot.extend(joint(row) for row in facts.read("joints"))
    inertials = {row["link"]: row for row in facts.read("links")}
    ends = ("parent_link", "child_link")
    names = {row[end] for row in facts.read("joints") for end in ends}
    robot.extend(link(name, inertials.get(name)) for name in sorted(names))
    path = folder / "nao_description" / "urdf" / "nao.urdf"
    path.parent.mkdir(parents=True)
    ET.ElementTree(robot).write(path)
    return path


def joint(row: dict[str, str]) -> ET.Element:
    """Return the element of a row of the table of joints."""
    element = ET.Element("joint", name=row["joint"], type=row["type"])
    ET.SubElement(element, "parent", link=row["parent_link"])
    ET.SubElement(element, "child", link=row["child_link"])
    xyz = " ".join(row[f"origin_{axis}_m"] for axis in "xyz")
    rpy = " ".join(row[f"{angle}_rad"] for angle in ("roll", "pitch", "yaw"))
    ET.SubElement(element, "origin", xyz=xyz, rpy=rpy)
    axis = " ".join(row[f"axis_{axis}"] or "0" for axis in "xyz")
    ET.SubElement(element, "axis", xyz=axis)
    if row["lower_rad"]:
        columns = ("lower_rad", "upper_rad", "effort_nm", "velocity_rad_s")
        limit = {column.split("_")[0]: row[column] for column in columns}
        ET.SubElement(element, "limit", limit)
    if row["mimic_joint"]:
        mimic = {"joint": row["mimic_joint"], "multiplier": row["mimic_multiplier"]}
        ET.SubElement(element, "mimic", mimic)
    return element


def link(name: str, row: dict[str, str] | None) -> ET.Element:
    """Return the element of a link, with a mesh if it is one of a finger's."""
    element = ET.Element("link", name=name)
    if row is not None:
        inertial = ET.SubElement(element, "inertial")
        ET.SubElement(inertial, "mass", value=row["mass_kg"])
        ET.SubElement(inertial, "inertia", {key: row[key] for key in MOMENTS})
        com = " ".join(row[f"com_{axis}_m"] for axis in "xyz")
        ET.SubElement(inertial, "origin", xyz=com, rpy="0 0 0")
    if "Finger" in name or "Thumb" in name:
        for tag, kind in (("visual", "dae"), ("collision", "stl")):
            geometry = ET.SubElement(ET.SubElement(element, tag), "geometry")
            mesh = {"filename": f"{MESHES}/phalanx.{kind}", "scale": "0.1 0.1 0.1"}
            ET.SubElement(geometry, "mesh", mesh)
    return element


@pytest.fixture
def urdf(tmp_path: Path) -> Path:
    return official(tmp_path)


def edited(path: Path, old: str, new: str) -> Path:
    """Replace a text that must be there."""
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new))
    return path


def numbers(robot: ET.Element, path: str, attribute: str) -> np.ndarray:
    (element,) = robot.findall(path)
    return np.array(element.attrib[attribute].split(), dtype=float)


def test_an_official_description_gets_what_it_leaves_out(urdf: Path) -> None:
    theirs = ET.fromstring(adapt(urdf, str(URDF_PATH)))
    ours = ET.parse(URDF_PATH).getroot()
    assert theirs.find("link[@name='torso']") is not None
    assert theirs.find("link[@name='base_link']") is None  # what the torso hangs on
    assert theirs.find("link[@name='Head']") is not None
    for name in JOINTS:
        at = f"joint[@name='{name}']"
        assert theirs.find(at).get("type") == "revolute"
        values = [("origin", "xyz"), ("origin", "rpy"), ("axis", "xyz")]
        values += [("limit", x) for x in ("lower", "upper", "effort", "velocity")]
        for part, attribute in values:
            got, wanted = (
                numbers(r, f"{at}/{part}", attribute) for r in (theirs, ours)
            )
            np.testing.assert_allclose(got, wanted, atol=2e-5, err_msg=f"{at}/{part}")
    for link, mass in (("LFinger12_link", 0.004), ("torso", 1.04956)):
        assert numbers(theirs, f"link[@name='{link}']/inertial/mass", "value") == mass


def test_limits_of_a_finger_that_has_some_are_kept(urdf: Path) -> None:
    old = '<joint name="LThumb2" type="continuous">'
    new = '<joint name="LThumb2" type="revolute">'
    new += '<limit lower="0" upper="0.5" effort="0.1" velocity="3" />'
    theirs = ET.fromstring(adapt(edited(urdf, old, new), str(URDF_PATH)))
    assert theirs.find("joint[@name='LThumb2']/limit").get("upper") == "0.5"
    assert theirs.find("joint[@name='LThumb1']/limit").get("upper") == "1.0472"


# -- Where files are looked for --------------------------------------------------------


@pytest.mark.parametrize(
    ("variable", "below"), [("ROS_PACKAGE_PATH", ""), ("AMENT_PREFIX_PATH", "share")]
)
def test_meshes_are_found_in_ros_packages(
    urdf: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    variable: str,
    below: str,
) -> None:
    away = tmp_path / "ros" / below
    away.mkdir(parents=True)
    (tmp_path / "nao_meshes").rename(away / "nao_meshes")
    monkeypatch.setenv(variable, f"/nowhere:{tmp_path / 'ros'}")
    theirs = ET.fromstring(adapt(urdf, str(URDF_PATH)))
    names = {mesh.attrib["filename"] for mesh in theirs.iter("mesh")}
    folder = away / "nao_meshes" / "meshes"
    assert names == {str(folder / "phalanx.dae"), str(folder / "phalanx.stl")}


@pytest.mark.parametrize(
    "start",
    [
        "file://localhost{folder}/",
        "model://nao_meshes/meshes/",
        "package://nao_meshes/more%20meshes/",
    ],
)
def test_meshes_are_found_by_urls(urdf: Path, tmp_path: Path, start: str) -> None:
    folder = tmp_path / "nao_meshes" / "meshes"
    (tmp_path / "nao_meshes" / "more meshes").symlink_to(folder)
    edited(urdf, f"{MESHES}/", start.format(folder=folder))
    theirs = ET.fromstring(adapt(urdf, str(URDF_PATH)))
    names = [Path(mesh.attrib["filename"]) for mesh in theirs.iter("mesh")]
    assert all(name.samefile(folder / name.name) for name in names)


def test_missing_files_are_named_once_with_where_they_were_sought(
    urdf: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "nao_meshes" / "meshes" / "phalanx.stl").unlink()
    paint = '<material name="paint"><texture filename="paint.png"/></material><link '
    urdf.write_text(urdf.read_text().replace("<link ", paint, 1))
    monkeypatch.setenv("ROS_PACKAGE_PATH", "/opt/packages")
    with pytest.raises(RobotError) as error:
        adapt(urdf, str(URDF_PATH))
    message = str(error.value)
    assert message.count(f"{MESHES}/phalanx.stl") == 1
    assert "missing files: " in message and "paint.png" in message
    assert "phalanx.dae" not in message
    assert "ROS_PACKAGE_PATH=/opt/packages" in message
    assert str(urdf) in message and str(urdf.parent) in message


# -- What else may be missing ----------------------------------------------------------


@pytest.mark.parametrize(
    ("old", "new", "named"),
    [
        ('<joint name="LElbowYaw" type', '<joint name="Elbow" type', "LElbowYaw"),
        ('<link name="LFinger12_link">', '<link name="x">', "LFinger12_link"),
        ('<link name="torso">', '<link name="trunk">', "torso"),
        (
            '<parent link="LFinger11_link"',
            '<parent link="trunk"',
            "LFinger12, LFinger13",
        ),
        ('<child link="RForeArm" />', "", "RElbowRoll.*missing <child>"),
        ('value="1.04956"', 'value="nan"', "torso.*got 'nan', expected a finite"),
        ('upper="2.08567"', 'upper="-3"', "'LShoulderPitch'.*upper=\"-3\".*lower < up"),
        ("<robot ", "<sdf", "not XML"),
    ],
)
def test_what_is_missing_or_wrong_is_named(
    urdf: Path, old: str, new: str, named: str
) -> None:
    with pytest.raises(RobotError, match=f"{urdf.name}.*{named}"):
        adapt(edited(urdf, old, new), str(URDF_PATH))


def test_a_declaration_need_not_come_first(urdf: Path) -> None:
    declared = f'\ufeff \n<?xml version="1.0" encoding="utf-8"?>{urdf.read_text()}'
    urdf.write_text(declared, encoding="utf-8")
    assert adapt(urdf, str(URDF_PATH)).startswith("<robot")


def test_a_missing_file_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(VARIABLE, "/nowhere/nao.urdf")
    with pytest.raises(RobotError, match=r"/nowhere/nao.urdf: no such file"):
        gym.make("NaoTouchCubeSingle-v1", obs_mode="state", render_backend="none")


# -- The robot in a task ---------------------------------------------------------------


@pytest.fixture
def env(urdf: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[gym.Env]:
    """The triangle without jitter, with the user's NAO."""
    still = dataclasses.replace(
        catalog.get("NaoTouchCubeTriangle-v1"),
        id="UsersTriangle-v1",
        jitter=Jitter(0, 0, 0),
    )
    ir_maniskill.register(still)
    monkeypatch.setenv(VARIABLE, str(urdf))
    small = {"width": 32, "height": 64, "shader_pack": "trivial"}
    env = gym.make("UsersTriangle-v1", obs_mode="rgb+state_dict", sensor_configs=small)
    yield env
    env.close()


@pytest.mark.render
def test_the_users_nao_acts_and_feels_like_ours(env: gym.Env) -> None:
    agent = env.unwrapped.agent
    obs, _ = env.reset(seed=0, options={"instruction": 1})  # red, on the left
    assert agent.urdf_path.endswith("nao_description/urdf/nao.urdf")
    assert env.action_space.shape == (26,)
    target = np.zeros(26, np.float32)
    for side in "LR":
        target[JOINTS.index(f"{side}ShoulderPitch")] = -0.1
    target[JOINTS.index("LFinger12")] = 0.8
    for _ in range(10):
        obs = env.step(target)[0]
    felt = obs["agent"]["proprioception"][0]
    assert felt[JOINTS.index("LFinger12")] == pytest.approx(0.8, abs=0.02)
    assert felt[JOINTS.index("LFinger11")].abs() < 0.02  # no mimic
    assert not obs["extra"]["touch"].any()
    target[JOINTS.index("LShoulderPitch")] = 0.1
    target[JOINTS.index("LShoulderRoll")] = -0.1
    for _ in range(12):
        obs, reward, _, _, info = env.step(target)
    assert obs["extra"]["touch"][0, :3].any()
    assert not obs["extra"]["touch"][0, 3:].any()
    assert info["success"].item()
    assert reward.item() >= 1
    again, _ = env.reset(seed=0)  # builds the scene anew
    assert again["agent"]["proprioception"].isfinite().all()
    assert obs["sensor_data"]["front_camera"]["rgb"].float().std() > 10
