"""InstructRobot on ManiSkill: a NAO learns to touch what a sentence names.

Importing this package registers the robot `nao` and every task id, and does
nothing else.
"""

import os
import sys

# Threads of torch that wait for each other must not keep cores busy that simulators or
# other programs need. Its OpenMP library reads this once, when torch is imported.
if "torch" not in sys.modules:
    os.environ.setdefault("OMP_WAIT_POLICY", "passive")

import ir_maniskill.tasks  # noqa: F401 - registers the tasks
from ir_maniskill.environment.vector import make_vec
from ir_maniskill.experiment import (
    Experiment,
    Instruction,
    Jitter,
    TouchObject,
    available,
    touch_instructions,
)
from ir_maniskill.goals import Avoid, Both, Goal, Push, Ref, Then, Touch
from ir_maniskill.policy import Policy, load_policy
from ir_maniskill.registration import register

__all__ = [
    "Avoid",
    "Both",
    "Experiment",
    "Goal",
    "Instruction",
    "Jitter",
    "Policy",
    "Push",
    "Ref",
    "Then",
    "Touch",
    "TouchObject",
    "available",
    "load_policy",
    "make_vec",
    "register",
    "touch_instructions",
]
__version__ = "0.1.0"
