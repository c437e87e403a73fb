"""Racing through gates."""

from __future__ import annotations

from typing import Any

import numpy as np

from mujoco_drones_gym.envs.base_aviary import BaseAviary

__all__ = ["RaceAviary"]


class RaceAviary(BaseAviary):
    """Drones race through gates.

    Observation, float32 (21 N,), per drone: the twelve numbers of `HoverAviary`, the next gate (m, world frame), and
    the next two gates relative to the drone (m, body frame). Action, float32 (4 N,): normalized motor speeds. Reward
    per drone: + 20 for a gate, a reward for speed and a penalty for the distance from the gate; - 100 for a crash. An
    episode ends with a crash, with the last gate of every drone, and after 30 s.

    With solid, randomized or moving gates, the observation is (27 N,): it ends with the normals of the next two gates
    (body frame).

    Args:
        gates: Centres of the gates, world frame, m, (n, 3); None for those of the track, or the paper's six.
        laps: Number of laps; None for that of the track, or 2.
        track: Track: "figure_eight", "stacked", "oval", a TOML file, or a dict with the keys of such a file: `gates`
            (a list of dicts with `position` and `yaw`), `laps`, `opening`, `solid`, `normals`, `randomization` and
            `motion`. None for the paper's gates, which do not collide.
        options: Options of `BaseAviary`. `num_drones` is 1 by default.
    """

    TASK = "race"

    def __init__(self, *, gates: Any = None, laps: int | None = None, track: Any = None, **options: Any) -> None:
        self._task_options = {"gates": gates, "laps": laps, "track": track}
        super().__init__(**options)

    @property
    def gates(self) -> np.ndarray:
        """Present poses of the gates, float64 (n, 4).

        A pose is the centre (world frame, m) and the yaw of the direction in which drones pass the gate (rad). The
        gates of a track may change in every episode and move during it.
        """
        return self._env.gates()

    @property
    def GATES(self) -> np.ndarray:
        """Centres of the gates of the track, world frame, m, float64 (n, 3)."""
        return np.array(self._env.task_options()["gates"])

    @property
    def NUM_LAPS(self) -> int:
        """Number of laps."""
        return self._env.task_options()["laps"]
