"""The Franka Panda as a `Robot`: one arm, whose one hand is a gripper of two fingers.

Sections: joints, fingers, actuation, posture, the robot.
"""

from __future__ import annotations

import math

import sapien
from mani_skill import PACKAGE_ASSET_DIR
from mani_skill.agents.registration import register_agent

from ir_maniskill.environment.robots.robot import OURS, JointGroup, Robot

# -- Joints: the action's order ----------------------------------------------------

ARM_JOINTS = tuple(f"panda_joint{number}" for number in range(1, 8))
FINGER_JOINTS = ("panda_finger_joint1", "panda_finger_joint2")
"""Slides. The file has the second mimic the first; here each has its own drive, so that
each finger is an action of its own, as NAO's are."""
JOINTS = ARM_JOINTS + FINGER_JOINTS
"""The 9 actuated joints in the order of the action."""

# -- Fingers: the order of the tactile bits ------------------------------------------

HANDS = {"hand": ("LeftFinger", "RightFinger")}
PHALANGES = {"LeftFinger": ("panda_leftfinger",), "RightFinger": ("panda_rightfinger",)}
FINGERTIPS = {
    "LeftFinger": "panda_leftfinger_pad",
    "RightFinger": "panda_rightfinger_pad",
}

# -- Actuation -----------------------------------------------------------------------

ARM = JointGroup(stiffness=1000, damping=100, armature=0.1, delta=0.05)
HAND = JointGroup(stiffness=1000, damping=100, armature=0.1, delta=0.2)

# -- Posture -------------------------------------------------------------------------

HAND_OVER_TABLE = {
    "panda_joint2": -0.36,
    "panda_joint4": -2.22,
    "panda_joint6": 1.86,
    "panda_joint7": math.pi / 4,
}
"""The hand hovering between base and objects, pointing down [rad]."""
REST = {"panda_joint2": -1.2, "panda_joint4": -2.6, "panda_joint6": 1.4}
"""The arm drawn back, away from the table [rad]."""
POSTURES = {"hand_over_table": HAND_OVER_TABLE, "rest": REST}
"""The keyframes, the start of every episode first."""

# -- The robot -----------------------------------------------------------------------

BASE_X, BASE_Z = -0.2, -0.25
"""Place of the base; the shoulder is a third of a meter above it [m]."""


@register_agent()
class Panda(Robot):
    """Franka Panda on a pillar behind the table, with 9 actuated joints."""

    uid = OURS + "panda"
    urdf_path = f"{PACKAGE_ASSET_DIR}/robots/panda/panda_v2.urdf"
    joints = JOINTS
    hands = HANDS
    phalanges = PHALANGES
    fingertips = FINGERTIPS
    postures = POSTURES
    mount = sapien.Pose([BASE_X, 0, BASE_Z])
    stand = 0.2
    solver_iterations = 4
    scale = 1.8
    shoulders = ((BASE_X, 0.0),)
    reach = 0.75

    def drive(self, joint: str) -> JointGroup:
        """Return how a joint is driven: as one of the hand or of the arm."""
        return HAND if joint in FINGER_JOINTS else ARM
