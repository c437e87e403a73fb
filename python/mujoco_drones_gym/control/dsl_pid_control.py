"""The paper's PID with a rate-limited setpoint."""

from __future__ import annotations

from mujoco_drones_gym.control._controller import Cascade

__all__ = ["DSLPIDControl"]


class DSLPIDControl(Cascade):
    """Cascade with stiffer gains, a rate-limited setpoint and feed-forward of the target acceleration.

    The setpoint starts at the position and yaw of the drone. It moves to the target at no more than 2 m/s and π rad/s.

    Args:
        env: Environment whose airframe the controller is for, a `DroneModel` or its name, or None for the Crazyflie 2.x
            in X configuration.
        drone_model: Another name of `env`.
    """

    _KIND = "dsl"
