"""Robots: what a task moves. One file per robot, every number with its unit and source."""

from tca_envs.robots.robot import CUT_OFF, TOLERANCE, Limits, Posture, RingGripper, Robot, Stage

__all__ = ["CUT_OFF", "TOLERANCE", "Limits", "Posture", "RingGripper", "Robot", "Stage"]
