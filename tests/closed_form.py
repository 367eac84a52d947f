"""An oracle: the equilibrium of an arm that nothing loads, without integrating anything.

The total internal wrench is zero everywhere, so modules do not feel each other; and in a frame that turns with its muscles the
strain of a module is constant. Six equations for the strain, K (xi - xi*) + sum_i F_i [r x t; t] = 0, and one for each tension,
length |p_a'| - rest length = elongation(F, drive), remain per module; the pose at its end is an exponential,
exp(L (xi^ + k e_z^)) Rz(-k L). Holds where all muscles run straight, or turn at one rate k around a rod that looks alike from
all sides.
"""

import numpy as np
from scipy.linalg import expm
from scipy.optimize import root
from scipy.spatial.transform import Rotation

from tca_envs.mechanics import Module, Tendon
from tca_envs.mechanics.laws import elongation
from tca_envs.mechanics.section import balance, cross_matrix


def turn(module: Module) -> float:
    """Rate at which the muscles turn [rad/m]."""
    turns = {muscle.turns for muscle in module.muscles if muscle.offset > 0.0}
    assert len(turns) <= 1
    return 2.0 * np.pi * sum(turns) / module.length


def strain_and_tensions(module: Module, drive: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Solve the equations above at the module's base."""
    route = np.array([muscle.route(module.length, 0.0) for muscle in module.muscles]).reshape(-1, 4)
    rests = [module.rest_length(muscle) for muscle in module.muscles]

    def lengths(strain: np.ndarray) -> np.ndarray:
        u, v = strain[:3], strain[3:]
        paths = [v + np.cross(u, [x, y, 0.0]) + [dx, dy, 0.0] for x, y, dx, dy in route]
        return module.length * np.linalg.norm(np.reshape(paths, (-1, 3)), axis=1)

    def missing(unknown: np.ndarray) -> np.ndarray:
        strain, tension = unknown[:6] / scale, unknown[6:]
        imbalance, _ = balance(module.stiffness, module.reference_strain, route, tension, strain, np.zeros(6))
        gaps = []
        for muscle, rest, length, force, value in zip(module.muscles, rests, lengths(strain), tension, drive, strict=True):
            if isinstance(muscle.law, Tendon):
                gaps.append(force - value)
            else:
                row = muscle.law.parameters()[np.newaxis]
                gaps.append((length - rest - elongation(muscle.law.kind, row, 0, rest, force, value)[0]) / rest)
        return np.concatenate([imbalance / (module.stiffness / scale), gaps])

    scale = np.array([module.length] * 3 + [1.0] * 3)  # makes a curvature an angle
    found = root(missing, np.concatenate([module.reference_strain * scale, np.full(len(rests), 0.01)]), tol=1e-13)
    assert np.abs(missing(found.x)).max() < 1e-10, found.message
    return found.x[:6] / scale, found.x[6:]


def equilibrium(modules: list[Module], drive: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return tip pose (4, 4) and tensions (n,)."""
    pose, tensions, first = np.eye(4), [], 0
    for module in modules:
        last = first + len(module.muscles)
        strain, tension = strain_and_tensions(module, np.asarray(drive)[first:last])
        rate, generator, back = turn(module), np.zeros((4, 4)), np.eye(4)
        generator[:3, :3] = cross_matrix(strain[:3] + np.array([0.0, 0.0, rate]))
        generator[:3, 3] = strain[3:]
        back[:3, :3] = Rotation.from_rotvec([0.0, 0.0, -rate * module.length]).as_matrix()
        pose = pose @ expm(module.length * generator) @ back
        tensions.append(tension)
        first = last
    return pose, np.concatenate(tensions)
