"""Access to the states of drones, which single environments, batches and environments of several agents share."""

from __future__ import annotations

import numpy as np


class DroneStates:
    """Parts of the states of all drones.

    `_states` returns the states, float64 (N, 20), and `_batteries` those of the batteries, float64 (N, 3).
    """

    __slots__ = ()

    def _states(self) -> np.ndarray:
        raise NotImplementedError

    def _batteries(self) -> np.ndarray:
        raise NotImplementedError

    @property
    def battery(self) -> np.ndarray:
        """Charge (0 to 1), voltage (V) and current (A) of the batteries, float64 (N, 3); NaN without a battery."""
        return self._batteries()

    @property
    def pos(self) -> np.ndarray:
        """Positions, world frame, m, float64 (N, 3)."""
        return self._states()[:, 0:3]

    @property
    def quat(self) -> np.ndarray:
        """Attitudes as quaternions (w, x, y, z), body to world frame, float64 (N, 4)."""
        return self._states()[:, 3:7]

    @property
    def rpy(self) -> np.ndarray:
        """Roll, pitch and yaw, rad, float64 (N, 3)."""
        return self._states()[:, 7:10]

    @property
    def vel(self) -> np.ndarray:
        """Velocities, world frame, m/s, float64 (N, 3)."""
        return self._states()[:, 10:13]

    @property
    def ang_v(self) -> np.ndarray:
        """Angular velocities, body frame, rad/s, float64 (N, 3)."""
        return self._states()[:, 13:16]

    @property
    def last_clipped_action(self) -> np.ndarray:
        """Motor speeds of the last step, rpm, float64 (N, 4)."""
        return self._states()[:, 16:20]
