"""Hover with several drones."""

from __future__ import annotations

from typing import Any

import numpy as np

from mujoco_drones_gym._options import numbers
from mujoco_drones_gym.envs.base_aviary import BaseAviary

__all__ = ["MultiHoverAviary"]


class MultiHoverAviary(BaseAviary):
    """Drones on a line take off, each to its own height.

    Observation, float32 (13 N,), per drone: the twelve numbers of `HoverAviary` and the target height (m). Action,
    float32 (4 N,): normalized motor speeds. Reward: the sum of the drones' rewards of `HoverAviary`, with distances to
    the side from the start of the drone. An episode ends when a drone crashes or rises above 3 m, and after 10 s.

    Args:
        target_heights: Target height of every drone, m, (N,); None for heights evenly spaced from 0.7 m to 1.2 m.
        options: Options of `BaseAviary`. `num_drones` is 2 by default.
    """

    TASK = "multi_hover"

    def __init__(self, *, target_heights: Any = None, **options: Any) -> None:
        self._task_options = {"target_heights": target_heights}
        super().__init__(**options)

    @property
    def TARGET_HEIGHTS(self) -> np.ndarray:
        """Target heights, m, float64 (N,). Setting them has an effect from the next step on."""
        return np.array([self._env.reference(drone)[0][2] for drone in range(self.NUM_DRONES)])

    @TARGET_HEIGHTS.setter
    def TARGET_HEIGHTS(self, heights: Any) -> None:
        self._set_task_option("target_heights", numbers("target_heights", heights).reshape(-1).tolist())
