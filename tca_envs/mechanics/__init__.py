"""Physics of the arm: muscles, modules, equilibrium, heating. Knows no Gymnasium."""

from tca_envs.mechanics.arm import Arm, Discretisation
from tca_envs.mechanics.discretisation import discretise
from tca_envs.mechanics.equilibrium import Equilibrium
from tca_envs.mechanics.grid import Grid
from tca_envs.mechanics.gripper import Gripper
from tca_envs.mechanics.laws import TCA, Spring, Tendon
from tca_envs.mechanics.loads import Payload
from tca_envs.mechanics.module import Module
from tca_envs.mechanics.muscle import Muscle
from tca_envs.mechanics.rungs import Rung
from tca_envs.mechanics.solver import compiled

__all__ = [
    "TCA", "Arm", "Discretisation", "Equilibrium", "Grid", "Gripper", "Module", "Muscle", "Payload", "Rung", "Spring", "Tendon",
    "compiled", "discretise",
]  # fmt: skip
