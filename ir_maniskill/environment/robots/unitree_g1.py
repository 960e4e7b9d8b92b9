"""The Unitree G1 humanoid as a `Robot`: its upper body with three-fingered hands.

The description is ManiSkill's, in which the legs are fixed; the waist is held.
Sections: joints, fingers, actuation, posture, collision, the robot.
"""

from __future__ import annotations

import sapien
from mani_skill import PACKAGE_ASSET_DIR
from mani_skill.agents.registration import register_agent

from ir_maniskill.assets.nao import SOLE_HEIGHT
from ir_maniskill.environment.robots.robot import OURS, JointGroup, Robot

# -- Joints: the action's order, all left then all right --------------------------

SIDES = ("left", "right")
SHOULDER_JOINTS = ("shoulder_pitch", "shoulder_roll", "shoulder_yaw")
ARM_JOINTS = (*SHOULDER_JOINTS, "elbow_pitch", "elbow_roll")
FINGER_JOINTS = ("three", "four", "five", "six", "zero", "one", "two")
JOINTS = tuple(
    f"{side}_{joint}_joint" for side in SIDES for joint in ARM_JOINTS + FINGER_JOINTS
)
"""The 24 actuated joints in the order of the action."""

# -- Fingers: named as NAO's, in the order of the tactile bits -----------------------

LINKS = {
    "Finger1": ("three", "four"),
    "Finger2": ("five", "six"),
    "Thumb": ("one", "two"),
}
"""What the file calls the links of a finger, without their side."""
HANDS = {side: tuple(side[0].upper() + name for name in LINKS) for side in SIDES}
PHALANGES = {
    side[0].upper() + finger: tuple(f"{side}_{link}_link" for link in links)
    for side in SIDES
    for finger, links in LINKS.items()
}

FINGERTIPS = {finger: links[-1] for finger, links in PHALANGES.items()}

# -- Actuation -----------------------------------------------------------------------

ARM = JointGroup(stiffness=100, damping=10, armature=3e-2, delta=0.1, speed=8)
HAND = JointGroup(stiffness=2, damping=0.2, armature=2e-3, delta=0.2, speed=8)
"""The file's speeds of 53 and 23 rad/s break the fingers' limits at a hit."""

# -- Posture -------------------------------------------------------------------------

LEFT_OVER_TABLE = {
    "shoulder_pitch": -0.19,
    "shoulder_roll": 0.83,
    "shoulder_yaw": -0.33,
    "elbow_pitch": 0.06,
    "elbow_roll": 0.71,
    "three": -0.35,
    "four": -0.35,
    "five": -0.35,
    "six": -0.35,
    "one": 0.3,
    "two": 0.4,
}
"""The left hand hovering over the objects, palm down [rad]."""
HANDS_OVER_TABLE = {
    f"{side}_{joint}_joint": angle if side == "left" or "pitch" in joint else -angle
    for side in SIDES
    for joint, angle in LEFT_OVER_TABLE.items()
}
POSTURES = {"hands_over_table": HANDS_OVER_TABLE, "rest": {}}
"""The keyframes, the start of every episode first; at rest the arms hang down."""

# -- Collision -----------------------------------------------------------------------

ARM_BIT = {"left": 0, "right": 1}
"""An arm never collides with itself."""
TORSO_BIT = {"left": 2, "right": 3}
"""The torso never collides with the upper arms."""

# -- The robot -----------------------------------------------------------------------

SCALE = 2.0
SHOULDER_X, SHOULDER_Y, SOLE = 0.06, 0.154, -0.755
"""Place of the shoulders, and height of the soles below the pelvis, the root [m]."""


@register_agent()
class UnitreeG1(Robot):
    """Unitree G1, standing, with 24 actuated joints: arms, hands and fingers."""

    uid = OURS + "g1"
    urdf_path = f"{PACKAGE_ASSET_DIR}/robots/g1_humanoid/g1_simplified_upper_body.urdf"
    joints = JOINTS
    hands = HANDS
    phalanges = PHALANGES
    fingertips = FINGERTIPS
    postures = POSTURES
    mount = sapien.Pose([SHOULDER_X, 0, SCALE * SOLE_HEIGHT - SOLE])
    rebound = 1.0
    solver_iterations = 10
    scale = SCALE
    shoulders = ((SHOULDER_X, SHOULDER_Y), (SHOULDER_X, -SHOULDER_Y))
    reach = 0.48

    def drive(self, joint: str) -> JointGroup:
        """Return how a joint is driven: as one of the hand or of the arm."""
        return HAND if joint.split("_")[1] in FINGER_JOINTS else ARM

    def collision_bits(self, link: str) -> tuple[int, ...]:
        """Return the bits of a link; links that share one never collide."""
        side, _, part = link.partition("_")
        if side == "torso":
            return tuple(TORSO_BIT.values())
        if side not in SIDES:
            return ()
        arm, torso = ARM_BIT[side], TORSO_BIT[side]
        return (arm, torso) if part.startswith("shoulder") else (arm,)
