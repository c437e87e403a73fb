"""The environment of this package under other wrappers."""

from __future__ import annotations

from typing import Any

import gymnasium as gym


def aviary_of(env: gym.Env, user: str) -> Any:
    """Returns the environment of this package inside an environment."""
    aviary = getattr(env, "unwrapped", env)
    if not hasattr(aviary, "set_wind"):
        raise TypeError(f"{user} got {type(aviary).__name__}, expected an environment of mujoco_drones_gym")
    return aviary
