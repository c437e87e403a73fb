"""Quadrotor simulation on MuJoCo for Gymnasium, PettingZoo and Stable-Baselines3."""

from mujoco_drones_gym._native import __version__

__all__ = ["__version__"]
