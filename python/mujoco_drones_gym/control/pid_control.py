"""The paper's cascaded PID."""

from __future__ import annotations

from typing import Any

import numpy as np

from mujoco_drones_gym.control._controller import _ZEROS, Cascade, split

__all__ = ["PIDControl"]


class PIDControl(Cascade):
    """Cascaded PID with the paper's gains: position loop, attitude loop, mixer.

    Args:
        env: Environment whose airframe the controller is for, a `DroneModel` or its name, or None for the Crazyflie 2.x
            in X configuration.
        drone_model: Another name of `env`.
    """

    _KIND = "pid"

    def computeControl(
        self,
        control_timestep: float,
        cur_pos: Any,
        cur_quat: Any,
        cur_vel: Any,
        cur_ang_vel: Any,
        target_pos: Any,
        target_rpy: Any = _ZEROS,
        target_vel: Any = _ZEROS,
        target_rpy_rates: Any = _ZEROS,
    ) -> tuple[np.ndarray, np.ndarray, float]:
        """Computes the motor speeds for the next control step.

        Args:
            control_timestep: Time since the last call, s.
            cur_pos: Position, world frame, m, shape (3,).
            cur_quat: Attitude, body to world, quaternion (w, x, y, z), shape (4,), of any length; it is normalized.
            cur_vel: Velocity, world frame, m/s, shape (3,).
            cur_ang_vel: Angular velocity, body frame, rad/s, shape (3,).
            target_pos: Target position, world frame, m, shape (3,).
            target_rpy: Target roll, pitch and yaw, rad, shape (3,); only the yaw is used.
            target_vel: Target velocity, world frame, m/s, shape (3,).
            target_rpy_rates: Target rates of roll, pitch and yaw, rad/s, shape (3,); only the yaw rate is used.

        Returns:
            Motor speeds, rpm, shape (4,); position error (target minus actual), world frame, m, shape (3,); yaw error,
            rad.

        Raises:
            ValueError: for a wrong shape, a number that is not finite or beyond ±1e9, or a quaternion of zeros. The
                integral terms are unchanged.
        """
        return super().computeControl(
            control_timestep, cur_pos, cur_quat, cur_vel, cur_ang_vel, target_pos, target_rpy, target_vel,
            target_rpy_rates=target_rpy_rates,
        )  # fmt: skip

    def computeControlFromState(
        self,
        control_timestep: float,
        state: Any,
        target_pos: Any,
        target_rpy: Any = _ZEROS,
        target_vel: Any = _ZEROS,
        target_rpy_rates: Any = _ZEROS,
    ) -> tuple[np.ndarray, np.ndarray, float]:
        """Computes the motor speeds from the 20 numbers of a drone's state, shape (20,), as `computeControl` does."""
        return self.computeControl(
            control_timestep, *split(state), target_pos, target_rpy, target_vel, target_rpy_rates
        )

    compute_control = computeControl
    compute_control_from_state = computeControlFromState
