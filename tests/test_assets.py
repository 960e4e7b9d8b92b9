"""The NAO model says what its fact tables say; its meshes are those of its script."""

import math

import numpy as np
import pytest
import trimesh
import yourdfpy

from ir_maniskill.assets.nao import SOLE_HEIGHT, URDF_PATH, build, facts
from ir_maniskill.environment.robots.nao import FINGER_JOINTS, JOINTS

MESHES = URDF_PATH.parent / "meshes"


def read_facts(table: str, key: str) -> dict[str, dict[str, str]]:
    """Return a fact table by the values of one of its columns."""
    return {row[key]: row for row in facts.read(table)}


def link_frame(link: str, angles: dict[str, float]) -> np.ndarray:
    """Return the frame of a link in the torso's, from the fact table [4, 4]."""
    parents = read_facts("joints", "child_link")
    frame = np.eye(4)
    while link != "torso":
        row = parents[link]
        frame = facts.joint_motion(row, angles.get(row["joint"], 0.0)) @ frame
        link = row["parent_link"]
    return frame


@pytest.fixture(scope="module")
def model() -> yourdfpy.URDF:
    """Return the URDF as an independent library reads it."""
    return yourdfpy.URDF.load(
        str(URDF_PATH), load_meshes=False, build_collision_scene_graph=False
    )


@pytest.fixture(scope="module")
def moving_links(model: yourdfpy.URDF) -> list[str]:
    """Return the links that move, in the order of the joints."""
    return [model.joint_map[name].child for name in JOINTS]


def test_only_the_26_joints_move_and_they_are_in_the_order_of_the_action(model):
    assert tuple(model.joint_map) == JOINTS
    assert {joint.type for joint in model.joint_map.values()} == {"revolute"}
    assert all(joint.mimic is None for joint in model.joint_map.values())
    assert len(model.link_map) == 27
    assert model.base_link == "torso"


@pytest.mark.parametrize("seed", [None, 0, 1, 2, 3])
def test_kinematics_match_the_fact_table(model, moving_links, seed):
    limits = [model.joint_map[name].limit for name in JOINTS]
    angles = np.zeros(len(JOINTS))
    if seed is not None:
        rng = np.random.default_rng(seed)
        angles = rng.uniform([x.lower for x in limits], [x.upper for x in limits])
    by_name = dict(zip(JOINTS, angles.tolist(), strict=True))
    model.update_cfg(by_name)
    for link in moving_links:
        expected = link_frame(link, by_name)
        got = model.get_transform(link, "torso")
        np.testing.assert_allclose(got, expected, atol=1e-4, err_msg=link)


def test_motors_are_those_of_the_fact_table(model):
    for name, row in read_facts("actuation", "joint").items():
        limit = model.joint_map[name].limit
        degrees = [float(row["lower_deg"]), float(row["upper_deg"])]
        found = np.degrees([limit.lower, limit.upper])
        np.testing.assert_allclose(found, degrees, atol=1e-3, err_msg=name)
        assert limit.effort == float(row["effort_nm"]), name
        assert limit.velocity == float(row["velocity_rad_s"]), name


def body(row: dict[str, str]) -> tuple[float, np.ndarray, np.ndarray]:
    """Return a link's mass, center of mass [3] and inertia about that [3, 3]."""
    com = np.array([float(row[f"com_{axis}_m"]) for axis in "xyz"])
    inertia = [[float(row["i" + min(a + b, b + a)]) for a in "xyz"] for b in "xyz"]
    return float(row["mass_kg"]), com, np.array(inertia)


PHALANX = 0.004, np.array([0.00718, 0, 0]), np.diag([1e-7, 1.34371e-7, 1.34371e-7])


def test_arm_links_have_the_mass_of_the_fact_table(model, moving_links):
    table = read_facts("links", "link")
    for link in moving_links:
        finger = "Finger" in link or "Thumb" in link
        mass, com, inertia = PHALANX if finger else body(table[link])
        found = model.link_map[link].inertial
        assert found.mass == pytest.approx(mass, rel=1e-5), link
        np.testing.assert_allclose(found.origin[:3, 3], com, atol=1e-8, err_msg=link)
        np.testing.assert_allclose(found.inertia, inertia, rtol=1e-5, err_msg=link)


def test_the_torso_carries_all_that_never_moves(model, moving_links):
    bodies = []
    for name, row in read_facts("links", "link").items():
        mass, com, inertia = body(row)
        if name not in moving_links and mass > 1e-5:
            frame = link_frame(name, facts.read_posture())
            turn, place = frame[:3, :3], frame[:3, 3]
            bodies.append((mass, turn @ com + place, turn @ inertia @ turn.T))
    total = sum(mass for mass, _, _ in bodies)
    middle = sum(mass * com for mass, com, _ in bodies) / total
    whole = np.zeros((3, 3))
    for mass, com, inertia in bodies:  # Steiner's theorem
        away = com - middle
        steiner = away @ away * np.eye(3) - np.outer(away, away)
        whole += inertia + mass * steiner
    torso = model.link_map["torso"].inertial
    assert torso.mass == pytest.approx(total, rel=1e-5)
    np.testing.assert_allclose(torso.origin[:3, 3], middle, atol=1e-6)
    np.testing.assert_allclose(torso.inertia, whole, rtol=1e-5, atol=1e-9)


def test_every_inertia_is_that_of_a_real_body(model):
    for name, link in model.link_map.items():
        small, middle, large = np.linalg.eigvalsh(link.inertial.inertia)
        assert small >= 1e-7 * (1 - 1e-9), name
        assert large <= (small + middle) * 1.001, name


@pytest.mark.parametrize("side", ["l", "r"])
def test_the_soles_stand_flat_on_the_ground(side):
    sole = link_frame(f"{side}_sole", facts.read_posture())
    np.testing.assert_allclose(sole[:3, 2], [0, 0, 1], atol=1e-12)
    assert sole[2, 3] == pytest.approx(SOLE_HEIGHT, abs=1e-6)


@pytest.mark.parametrize("side", ["L", "R"])
def test_fingers_curl_at_zero_and_stretch_at_sixty_degrees(model, side):
    tips = [f"{side}Finger13_link", f"{side}Finger23_link"]
    wrist = f"{side.lower()}_wrist"
    reach = {}
    for angle in (0.0, math.radians(60)):
        model.update_cfg({name: angle for name in JOINTS if name[1:] in FINGER_JOINTS})
        along = [model.get_transform(tip, wrist)[:3, 0] for tip in tips]
        reach[angle] = [axis[0] for axis in along]
    curled, stretched = reach.values()
    assert max(curled) < -0.9  # the tip points back to the wrist
    assert min(stretched) > 0.9  # the tip points forward


def test_collision_shapes_are_few_and_simple(model):
    for name, link in model.link_map.items():
        assert len(link.collisions) <= 2, name
        for collision in link.collisions:
            shape = collision.geometry
            assert (shape.box is None) != (shape.sphere is None), name


def test_every_mesh_is_the_scripts_own():
    built = build.meshes()
    assert {path.name for path in MESHES.iterdir()} == set(built)
    for name, content in built.items():
        shipped = trimesh.load(MESHES / name, force="mesh", process=False)
        fresh = trimesh.load(
            trimesh.util.wrap_as_stream(content),
            file_type="glb",
            force="mesh",
            process=False,
        )
        np.testing.assert_array_equal(shipped.faces, fresh.faces, err_msg=name)
        np.testing.assert_allclose(shipped.vertices, fresh.vertices, atol=1e-6)
        np.testing.assert_allclose(shipped.visual.uv, fresh.visual.uv, atol=1e-6)


def test_mirrored_meshes_face_outward():
    for path in MESHES.glob("[lr]_*.glb"):
        mesh = trimesh.load(path, force="mesh")
        outward = np.einsum(
            "ij,ij->i", mesh.triangles_center - mesh.centroid, mesh.face_normals
        )
        assert np.average(outward > 0, weights=mesh.area_faces) > 0.8, path.name
