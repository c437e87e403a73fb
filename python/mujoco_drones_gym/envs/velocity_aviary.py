"""Velocity tracking."""

from __future__ import annotations

from mujoco_drones_gym.envs.base_aviary import BaseAviary

__all__ = ["VelocityAviary"]


class VelocityAviary(BaseAviary):
    """Drones track a velocity and a yaw rate that are sampled for every episode.

    Observation, float32 (16 N,), per drone: the twelve numbers of `HoverAviary`, the target velocity (m/s, world frame)
    and the target yaw rate (rad/s). Action, float32 (4 N,): normalized motor speeds. Reward per drone: minus the error
    of the velocity, a tenth of the error of the yaw rate, and a penalty for tilt; + 0.5 while the error is below 5
    cm/s; - 100 for a crash. An episode ends with a crash and after 10 s.

    Args:
        options: Options of `BaseAviary`. `num_drones` is 1 by default.
    """

    TASK = "velocity"
