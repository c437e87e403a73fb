"""Coming to rest."""

from __future__ import annotations

from mujoco_drones_gym.envs.base_aviary import BaseAviary

__all__ = ["StabilizeAviary"]


class StabilizeAviary(BaseAviary):
    """Drones come to rest from a random motion.

    Observation, float32 (12 N,): the twelve numbers of `HoverAviary` per drone. Action, float32 (4 N,): normalized
    motor speeds. Reward per drone: penalties for velocity, angular velocity and tilt; + 0.5 at rest; - 100 for a crash.
    An episode ends with a crash and after 10 s.

    Args:
        options: Options of `BaseAviary`. `num_drones` is 1 by default.
    """

    TASK = "stabilize"
