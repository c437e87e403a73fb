"""Swapping places across a circle."""

from __future__ import annotations

from mujoco_drones_gym.envs.base_aviary import BaseAviary

__all__ = ["AntipodalAviary"]


class AntipodalAviary(BaseAviary):
    """Drones on a circle fly to the opposite points without coming closer to each other than a safety radius.

    Observation, float32 (18 N,), per drone: the twelve numbers of `HoverAviary`, the goal and the goal minus the
    position (m, world frame). Action, float32 (4 N,): normalized motor speeds. The task is intended for the action type
    `VEL`.

    Args:
        options: Options of `BaseAviary`.
    """

    TASK = "antipodal"
