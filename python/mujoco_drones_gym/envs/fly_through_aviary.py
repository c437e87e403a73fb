"""Waypoints."""

from __future__ import annotations

from typing import Any

import numpy as np

from mujoco_drones_gym.envs.base_aviary import BaseAviary

__all__ = ["FlyThroughAviary"]


class FlyThroughAviary(BaseAviary):
    """Drones visit a list of waypoints in order.

    Observation, float32 (18 N,), per drone: the twelve numbers of `HoverAviary`, the next waypoint (m, world frame) and
    its position relative to the drone (m, body frame). Action, float32 (4 N,): normalized motor speeds. Reward per
    drone: + 10 for a waypoint within 10 cm, a penalty for the distance and for body rates; - 100 for a crash. An
    episode ends with a crash, with the last waypoint of every drone, and after 20 s.

    Args:
        waypoints: Waypoints, world frame, m, (n, 3); None for the paper's five.
        options: Options of `BaseAviary`. `num_drones` is 1 by default.
    """

    TASK = "fly_through"

    def __init__(self, *, waypoints: Any = None, **options: Any) -> None:
        self._task_options = {"waypoints": waypoints}
        super().__init__(**options)

    @property
    def WAYPOINTS(self) -> np.ndarray:
        """Waypoints, world frame, m, float64 (n, 3)."""
        return np.array(self._env.task_options()["waypoints"])
