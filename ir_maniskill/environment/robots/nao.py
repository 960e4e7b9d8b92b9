"""The NAO humanoid as a `Robot` (paper, Sec. III-A and III-C).

Sections: joints, fingers, actuation, posture, collision, the robot.
"""

from __future__ import annotations

import os
import tempfile
from pathlib import Path
from typing import Any

from mani_skill.agents.registration import register_agent

from ir_maniskill.assets.nao import URDF_PATH, facts
from ir_maniskill.environment.robots.nao_urdf import adapt
from ir_maniskill.environment.robots.robot import JointGroup, Robot

# -- Joints: the action's order, all left then all right --------------------------

ARM_JOINTS = ("ShoulderPitch", "ShoulderRoll", "ElbowYaw", "ElbowRoll", "WristYaw")
FINGER_JOINTS = (
    "Finger11",
    "Finger12",
    "Finger13",
    "Finger21",
    "Finger22",
    "Finger23",
    "Thumb1",
    "Thumb2",
)
JOINTS = tuple(side + joint for side in "LR" for joint in ARM_JOINTS + FINGER_JOINTS)
"""The 26 actuated joints in the order of the action."""

# -- Fingers: the order of the tactile bits ----------------------------------------

HANDS = {
    "left": ("LFinger1", "LFinger2", "LThumb"),
    "right": ("RFinger1", "RFinger2", "RThumb"),
}
"""The hands and their fingers, in the order of the tactile bits."""
FINGERTIPS = {
    "LFinger1": "LFinger13_link",
    "LFinger2": "LFinger23_link",
    "LThumb": "LThumb2_link",
    "RFinger1": "RFinger13_link",
    "RFinger2": "RFinger23_link",
    "RThumb": "RThumb2_link",
}
"""The last link of each finger."""


def _mirrored(part: str) -> tuple[str, float]:
    """Return the joint or finger on the other side, and the sign of its angle there."""
    side, name = "RL"["LR".index(part[0])], part[1:]
    if name.startswith("Finger"):  # the first is the outer one left, the inner right
        name = f"Finger{3 - int(name[6])}{name[7:]}"
    return side + name, -1.0 if name.endswith(("Roll", "Yaw")) else 1.0


MIRROR = {part: _mirrored(part) for part in (*JOINTS, *FINGERTIPS)}

# -- Actuation -----------------------------------------------------------------------

ARM = JointGroup(stiffness=20.0, damping=2.0, armature=1e-2, delta=0.2)
HAND = JointGroup(stiffness=2.0, damping=0.1, armature=1e-3, delta=0.2)

# -- Posture -------------------------------------------------------------------------

HANDS_OVER_TABLE = {
    **{"LShoulderPitch": -0.13, "RShoulderPitch": -0.13},
    **facts.read_posture(),
}
"""Hands hovering over the objects; head and legs, which are never driven [rad]."""

REST = {
    "LShoulderPitch": 1.40,
    "LShoulderRoll": 0.15,
    "LElbowYaw": -1.20,
    "LElbowRoll": -0.40,
    "RShoulderPitch": 1.40,
    "RShoulderRoll": -0.15,
    "RElbowYaw": 1.20,
    "RElbowRoll": 0.40,
}
"""Arms hanging at the sides [rad]."""

POSTURES = {"hands_over_table": HANDS_OVER_TABLE, "rest": REST}
"""The keyframes, the start of every episode first."""

# -- Collision -----------------------------------------------------------------------

ARM_BIT = {"L": 0, "R": 1}
"""An arm never collides with itself."""
TORSO_BIT = {"L": 2, "R": 3}
"""The torso, with head and legs, never collides with the upper arms, which are always
close to it; forearms and hands do collide with it and with the other arm."""
UPPER_ARM = ("Shoulder", "Bicep", "Elbow")
LOWER_ARM = ("ForeArm", "_wrist", "_gripper", "Finger", "Thumb")

# -- The robot -----------------------------------------------------------------------

OUR_URDF = str(URDF_PATH)
"""The model that ships with the package."""
URDF_VARIABLE = "IR_MANISKILL_NAO_URDF"
"""Environment variable that names a NAO URDF to use instead of ours."""


@register_agent()
class Nao(Robot):
    """NAO V5 with a fixed torso and 26 actuated joints: arms, hands and fingers.

    The model is ours, or, if the environment variable `IR_MANISKILL_NAO_URDF` names a
    file or a subclass sets `urdf_path`, an official NAO URDF as `nao_urdf` reads it.
    """

    uid = "nao"
    urdf_path = OUR_URDF
    joints = JOINTS
    hands = HANDS
    fingertips = FINGERTIPS
    postures = POSTURES
    mirror = MIRROR
    shoulders = ((0.0, 0.098), (0.0, -0.098))
    reach = 0.255
    solver_iterations = 4

    def drive(self, joint: str) -> JointGroup:
        """Return how a joint is driven: as one of the hand or of the arm."""
        return HAND if joint[1:] in FINGER_JOINTS else ARM

    def _load_articulation(self, initial_pose: Any = None) -> None:
        if self.urdf_path == OUR_URDF:
            self.urdf_path = os.environ.get(URDF_VARIABLE) or OUR_URDF
        if self.urdf_path == OUR_URDF:
            self.postures = {  # legs, torso and head of our model have no joints
                name: {joint: angles[joint] for joint in JOINTS if joint in angles}
                for name, angles in POSTURES.items()
            }
            super()._load_articulation(initial_pose)
            return
        given = Path(self.urdf_path)
        with tempfile.TemporaryDirectory() as folder:
            self.urdf_path = str(Path(folder) / "nao.urdf")
            Path(self.urdf_path).write_text(adapt(given, OUR_URDF), encoding="utf-8")
            super()._load_articulation(initial_pose)
        self.urdf_path = str(given)

    def collision_bits(self, link: str) -> tuple[int, ...]:
        """Return the bits of a link; links that share one never collide."""
        side, part = link[0].upper(), link[1:]
        if part.startswith(UPPER_ARM):
            return ARM_BIT[side], TORSO_BIT[side]
        if part.startswith(LOWER_ARM):
            return (ARM_BIT[side],)
        return tuple(TORSO_BIT.values())
