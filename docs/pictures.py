"""Draw the picture of the README: python docs/pictures.py writes docs/arm.png (needs the extra `train` for matplotlib)."""

from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize

from tca_envs import presets

STATES = [(25, 25, 25), (150, 25, 25), (150, 90, 25), (150, 150, 150)]
"""Temperatures of the three TCAs [degC]."""


def tube(poses: np.ndarray, radius: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the surface x, y, z [mm] of a round body along poses (k, 4, 4)."""
    angle = np.linspace(0.0, 2.0 * np.pi, 25)
    ring = radius * np.stack([np.cos(angle), np.sin(angle), np.zeros_like(angle)], axis=1)
    surface = np.einsum("kij,aj->kai", poses[:, :3, :3], ring) + poses[:, None, :3, 3]
    return tuple(1e3 * surface.transpose(2, 0, 1))


def plate(half: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the surface x, y, z [mm] of the plate that holds the arm."""
    x, y = np.meshgrid([-half, half], [-half, half])
    return x, y, np.full_like(x, -0.5)


def main() -> None:
    """Write docs/arm.png."""
    arm = presets.bending_arm()
    s = np.linspace(0.0, arm.length, 60)
    norm, colours = Normalize(25.0, 150.0), plt.get_cmap("plasma")
    figure, axes = plt.subplots(
        1, len(STATES), figsize=(10.0, 3.4), subplot_kw={"projection": "3d", "computed_zorder": False}, layout="constrained"
    )
    for axis, state in zip(axes, STATES, strict=True):
        equilibrium = arm.equilibrium(state)
        poses = equilibrium.poses(s)
        axis.plot_surface(*tube(poses, presets.BODY_DIAMETER / 2.0), color="0.8", alpha=0.55, linewidth=0, zorder=1)
        for muscle, temperature in zip(arm.muscles, state, strict=True):
            offset = muscle.offset * np.array([np.cos(muscle.angle), np.sin(muscle.angle), 0.0])
            path = 1e3 * (poses[:, :3, 3] + poses[:, :3, :3] @ offset)
            axis.plot(*path.T, color=colours(0.85 * norm(temperature)), lw=4, zorder=2, solid_capstyle="round")
        tip, down = poses[-1, :3, 3], poses[-1, :3, 2]
        hanging = 1e3 * np.array([tip, tip + 0.024 * down])
        axis.plot(*hanging.T, color="0.35", lw=2.5, ls=(0, (1, 0.8)), zorder=1)
        sideways = 1e3 * float(np.hypot(*tip[:2]))
        tension = 1e3 * equilibrium.tensions.max()
        axis.set_title(
            f"{state[0]} / {state[1]} / {state[2]} °C\ntip {sideways:.1f} mm aside, {1e3 * tip[2]:.1f} mm down\n"
            f"largest tension {tension:.0f} mN",
            fontsize=9,
        )
        axis.set(xlim=(-12, 34), ylim=(-23, 23), zlim=(72, -3))
        axis.set_box_aspect((46, 46, 72), zoom=1.3)
        axis.view_init(elev=12, azim=-70)
        axis.plot_surface(*plate(12.0), color="0.25", linewidth=0, zorder=3)
        axis.set_axis_off()
    bar = figure.colorbar(
        ScalarMappable(norm, plt.matplotlib.colors.ListedColormap(colours(np.linspace(0, 0.85, 256)))),
        ax=axes,
        shrink=0.7,
        pad=0.01,
    )
    bar.set_label("temperature [°C]", fontsize=9)
    path = Path(__file__).with_name("arm.png")
    figure.savefig(path, dpi=140)
    print(f"wrote {path.name}")


if __name__ == "__main__":
    main()
