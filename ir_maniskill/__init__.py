"""InstructRobot on ManiSkill: a robot learns by reward to do what a sentence says.

Importing this package registers the robots and every task id, and does nothing else.

    make_vec       envs that step together, on CPU or GPU
    load_policy    a trained policy: `act(obs)`
    train          learn a task
    evaluate       play seeded episodes, and count
    audit          ask whether a policy looks and reads
    record         film a policy
    collect        keep episodes of a policy, for others to learn from
    Experiment     what a task is; `register` makes one known to `gym.make`
    Goal           what a sentence asks for: `Touch`, `Push`, ... or a verb of your own
"""

import ir_maniskill.tasks  # noqa: F401 - registers the tasks
from ir_maniskill.api import audit, collect, evaluate, record
from ir_maniskill.environment.vector import make_vec
from ir_maniskill.experiment import (
    Experiment,
    Jitter,
    TouchObject,
    available,
    touch_instructions,
)
from ir_maniskill.goals import Avoid, Both, Goal, Instruction, Push, Ref, Then, Touch
from ir_maniskill.policy import Policy, load_policy
from ir_maniskill.registration import register
from ir_maniskill.training.train import train

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
    "audit",
    "available",
    "collect",
    "evaluate",
    "load_policy",
    "make_vec",
    "record",
    "register",
    "touch_instructions",
    "train",
]
__version__ = "0.3.0.dev0"
