"""What a user reads of a single environment between its steps."""

from __future__ import annotations

from typing import Any

import numpy as np

from mujoco_drones_gym import _native
from mujoco_drones_gym._options import action_numbers, drone_index
from mujoco_drones_gym._states import DroneStates
from mujoco_drones_gym.wrappers.obstacles import Obstacle


class Readings(DroneStates):
    """States, parameters and images of the drones of an environment."""

    _env: _native.Env
    _has_vision: bool
    NUM_DRONES: int
    SIM_FREQ: int
    NEIGHBOURHOOD_RADIUS: float

    def _states(self) -> np.ndarray:
        return self._env.states()

    def _batteries(self) -> np.ndarray:
        return self._env.batteries()

    @property
    def M(self) -> float:
        """Mass of the first drone in this episode, kg."""
        return self._env.mass()

    @property
    def G(self) -> float:
        """Gravity in this episode, m/s²."""
        return self._env.gravity()

    @property
    def GRAVITY(self) -> float:
        """Weight of the first drone in this episode, N."""
        return self.M * self.G

    @property
    def J(self) -> np.ndarray:
        """Inertia matrix of the first drone in this episode, kg·m², float64 (3, 3)."""
        return np.diag(self._env.drone_params(0)["inertia"])

    @property
    def obstacles(self) -> list[Obstacle]:
        """Obstacles at their present poses, the frames of solid gates included."""
        return [Obstacle._from_options(obstacle) for obstacle in self._env.obstacles()]

    @property
    def time(self) -> float:
        """Simulated time of this episode, s."""
        return self._env.info()["time"]

    @property
    def step_counter(self) -> int:
        """Number of physics steps in this episode."""
        return round(self._env.info()["time"] * self.SIM_FREQ)

    @property
    def rgb(self) -> np.ndarray:
        """Colour images of the onboard cameras, uint8 (N, 48, 64, 4), with `vision_attributes`."""
        return self._vision("rgb")

    @property
    def dep(self) -> np.ndarray:
        """Depth images of the onboard cameras, m, float32 (N, 48, 64), with `vision_attributes`."""
        return self._vision("depth")

    @property
    def seg(self) -> np.ndarray:
        """Indices of the objects in the images of the onboard cameras, int32 (N, 48, 64), with `vision_attributes`."""
        return self._vision("segmentation")[..., 1]

    def _vision(self, name: str) -> np.ndarray:
        if not self._has_vision:
            raise AttributeError("the environment has no images, expected the option vision_attributes=True")
        return self._env.onboard()[name]

    def _getDroneImages(self, nth_drone: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Returns the images of the onboard camera of a drone, also without `vision_attributes`.

        They are colour, uint8 (48, 64, 4), depth in m, float32 (48, 64), and the indices of the objects, int32
        (48, 64).
        """
        drone = drone_index(nth_drone, self.NUM_DRONES)
        images = self._env.onboard()
        return images["rgb"][drone], images["depth"][drone], images["segmentation"][drone, ..., 1]

    def _getDroneStateVector(self, nth_drone: int) -> np.ndarray:
        """Returns the state of a drone, float64 (20,): pos, quat (w, x, y, z), rpy, vel, ang_v, motor speeds (rpm)."""
        return self._env.state(drone_index(nth_drone, self.NUM_DRONES))

    def _getAdjacencyMatrix(self) -> np.ndarray:
        """Returns which drones are within `NEIGHBOURHOOD_RADIUS` of each other, float64 (N, N), 1 on the diagonal."""
        return np.identity(self.NUM_DRONES) + self._env.adjacency(self.NEIGHBOURHOOD_RADIUS)

    def _normalizedActionToRPM(self, action: Any) -> np.ndarray:
        """Returns the motor speeds, rpm, of normalized ones in [-1, 1], an array of the same shape."""
        action = action_numbers("action", action, (self.NUM_DRONES, 4))
        return self._env.rpm_of_normalized(action).reshape(np.shape(action))
