"""Physics of the arm: muscles, modules, equilibrium, heating. Knows no Gymnasium."""

from tca_envs.mechanics.arm import Arm, Discretisation, Grid, Module, Payload
from tca_envs.mechanics.discretisation import discretise
from tca_envs.mechanics.equilibrium import Equilibrium, Rung
from tca_envs.mechanics.gripper import Gripper
from tca_envs.mechanics.muscle import TCA, Muscle, Spring, Tendon

__all__ = [
    "TCA", "Arm", "Discretisation", "Equilibrium", "Grid", "Gripper", "Module", "Muscle", "Payload", "Rung", "Spring", "Tendon",
    "discretise",
]  # fmt: skip
