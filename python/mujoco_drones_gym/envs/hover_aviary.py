"""Hover with one drone."""

from __future__ import annotations

from typing import Any

from mujoco_drones_gym.envs.base_aviary import BaseAviary

__all__ = ["HoverAviary"]


class HoverAviary(BaseAviary):
    """A drone takes off and hovers at (0, 0, `target_height`).

    Observation, float32 (12,): position (m), roll, pitch, yaw (rad), velocity (m/s), angular velocity in the body frame
    (rad/s). Action, float32 (4,): normalized motor speeds in [-1, 1], where 0 hovers. Reward: minus the distance in
    height, a tenth of the distance to the side, and small penalties for speed and tilt; + 0.5 within 5 cm of the
    target; - 100 for a crash. An episode ends with a crash (a tilt of more than 90 degrees, contact with the floor
    after the take-off or with an obstacle), above 3 m, and after 10 s.

    Args:
        target_height: Height to hover at, m; None for 1 m.
        options: Options of `BaseAviary`. `num_drones` is 1.
    """

    TASK = "hover"

    def __init__(self, *, target_height: float | None = None, **options: Any) -> None:
        self._task_options = {"target_height": target_height}
        super().__init__(**options)

    @property
    def TARGET_HEIGHT(self) -> float:
        """Height to hover at, m. Setting it has an effect from the next step on."""
        return self._env.task_options()["target_height"]

    @TARGET_HEIGHT.setter
    def TARGET_HEIGHT(self, height: float) -> None:
        self._set_task_option("target_height", height)
