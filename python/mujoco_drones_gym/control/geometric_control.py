"""Geometric control on SE(3)."""

from __future__ import annotations

from typing import Any

from mujoco_drones_gym.control._airframe import airframe_of
from mujoco_drones_gym.control._controller import Controller, _either

__all__ = ["GeometricControl"]


class GeometricControl(Controller):
    """Geometric tracking control on SE(3) for aggressive trajectories.

    `integral_pos_e` is the acceleration that the integral causes, m/s². `integral_rpy_e` stays zero.

    Args:
        env: Environment whose airframe the controller is for, a `DroneModel` or its name, or None for the Crazyflie 2.x
            in X configuration.
        drone_model: Another name of `env`.
        horizontal: Frequency of the position loop along world x and y, rad/s; 5 by default.
        vertical: Frequency of the position loop along world z, rad/s; 11 by default.
        tilt: Frequency of the attitude loop about body x and y, rad/s; 18 by default.
        yaw: Frequency of the attitude loop about body z, rad/s; 10 by default.
        integral: Gain of the integral, relative to the cube of the frequency of its axis, 0 to 1; 0 by default.

    An airframe whose motors have time constants or a latency has smaller default frequencies.
    """

    _KIND = "geometric"

    def __init__(
        self,
        env: Any = None,
        *,
        drone_model: Any = None,
        horizontal: float | None = None,
        vertical: float | None = None,
        tilt: float | None = None,
        yaw: float | None = None,
        integral: float | None = None,
    ):
        bandwidths = {"horizontal": horizontal, "vertical": vertical, "tilt": tilt, "yaw": yaw, "integral": integral}
        self._build(airframe_of(_either(type(self).__name__, env, drone_model)), bandwidths)
