"""Quadrotor simulation on MuJoCo for Gymnasium, PettingZoo and Stable-Baselines3.

>>> import gymnasium as gym
>>> import mujoco_drones_gym
>>> env = gym.make("mujoco_drones_gym/Hover-v0")
>>> obs, info = env.reset(seed=1)
>>> obs, reward, terminated, truncated, info = env.step(env.action_space.sample())
"""

from __future__ import annotations

import importlib
from typing import Any

from mujoco_drones_gym import _registration
from mujoco_drones_gym._native import __version__

#: Modules of the names of this package. They are imported when a name is used.
_MODULES = {
    "BaseAviary": "envs.base_aviary",
    "HoverAviary": "envs.hover_aviary",
    "VelocityAviary": "envs.velocity_aviary",
    "MultiHoverAviary": "envs.multi_hover_aviary",
    "FlyThroughAviary": "envs.fly_through_aviary",
    "FormationAviary": "envs.formation_aviary",
    "RaceAviary": "envs.race_aviary",
    "AntipodalAviary": "envs.antipodal_aviary",
    "StabilizeAviary": "envs.stabilize_aviary",
    "TrackAviary": "envs.track_aviary",
    "MultiAgentAviary": "envs.multi_agent_aviary",
    "parallel_env": "envs.multi_agent_aviary",
    "VectorAviary": "vector",
    "DroneModel": "utils.enums",
    "Physics": "utils.enums",
    "ActionType": "utils.enums",
    "ObservationType": "utils.enums",
    "ImageType": "utils.enums",
    "PIDControl": "control",
    "DSLPIDControl": "control",
    "GeometricControl": "control",
    "Policy": "policy",
    "Logger": "utils.logger",
}

#: Names whose modules need pettingzoo.
_OPTIONAL = {"MultiAgentAviary", "parallel_env"}

__all__ = ["__version__", *(name for name in _MODULES if name not in _OPTIONAL)]


def __getattr__(name: str) -> Any:
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(importlib.import_module(f"{__name__}.{_MODULES[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *_MODULES})


_registration.register()
