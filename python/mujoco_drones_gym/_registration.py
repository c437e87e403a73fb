"""Ids of the environments for `gymnasium.make` and `gymnasium.make_vec`."""

from __future__ import annotations

import gymnasium as gym

#: Tasks with an id, by the name in the id.
IDS = {
    "Hover": "hover",
    "Velocity": "velocity",
    "MultiHover": "multi_hover",
    "FlyThrough": "fly_through",
    "Formation": "formation",
    "Race": "race",
    "Antipodal": "antipodal",
    "Stabilize": "stabilize",
    "Track": "track",
}


def register() -> None:
    """Registers the ids, such as `mujoco_drones_gym/Hover-v0`. An environment truncates its episodes by itself."""
    for name, task in IDS.items():
        gym.register(
            id=f"mujoco_drones_gym/{name}-v0",
            entry_point=f"mujoco_drones_gym.envs.{task}_aviary:{name}Aviary",
            vector_entry_point=f"mujoco_drones_gym.vector:make_{task}_vec",
        )
