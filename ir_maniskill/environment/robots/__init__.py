"""The Robot module: one file per robot; replacing the robot touches that file only.

Importing registers them.
"""

from ir_maniskill.environment.robots.nao import Nao
from ir_maniskill.environment.robots.panda import Panda
from ir_maniskill.environment.robots.unitree_g1 import UnitreeG1

__all__ = ["Nao", "Panda", "UnitreeG1"]
