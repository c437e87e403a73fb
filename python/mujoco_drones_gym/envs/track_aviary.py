"""Tracking a moving point."""

from __future__ import annotations

from mujoco_drones_gym.envs.base_aviary import BaseAviary

__all__ = ["TrackAviary"]


class TrackAviary(BaseAviary):
    """Drones follow points that move on a circle.

    Observation, float32 (18 N,), per drone: the twelve numbers of `HoverAviary`, the position of the point relative to
    the drone (m, world frame) and its velocity (m/s). Action, float32 (4 N,): normalized motor speeds. Reward per
    drone: penalties for the distance from the point, the difference of the velocities and tilt; + 0.5 within 5 cm; -
    100 for a crash. An episode ends with a crash, more than 2 m from the point, and after 10 s.

    Args:
        options: Options of `BaseAviary`. `num_drones` is 1 by default.
    """

    TASK = "track"
