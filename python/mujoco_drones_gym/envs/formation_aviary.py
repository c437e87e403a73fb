"""Formation flight."""

from __future__ import annotations

from mujoco_drones_gym.envs.base_aviary import BaseAviary

__all__ = ["FormationAviary"]


class FormationAviary(BaseAviary):
    """Drones keep a formation on a circle while its centre moves along a closed path.

    Observation, float32 (18 N,), per drone: the twelve numbers of `HoverAviary`, the drone's slot in the formation, and
    the slot minus the position (m, world frame). Action, float32 (4 N,): normalized motor speeds. Reward: minus the
    distances of the drones from their slots, minus half the errors of the distances between them; - 100 for each crash.
    An episode ends with a crash and after 30 s.

    Args:
        options: Options of `BaseAviary`. `num_drones` is 3 by default.
    """

    TASK = "formation"
