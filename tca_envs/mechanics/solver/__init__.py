"""The solver: compiled kernels, and the few functions by which the rest of the package calls them."""

from tca_envs.mechanics.solver.batch import (
    REPORT,
    Lanes,
    Linearisation,
    Model,
    Problem,
    linearise,
    prepare,
    solve,
)
from tca_envs.mechanics.solver.cache import compiled

__all__ = ["REPORT", "Lanes", "Linearisation", "Model", "Problem", "compiled", "linearise", "prepare", "solve"]
