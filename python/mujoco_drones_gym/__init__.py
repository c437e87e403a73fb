"""Quadrotor simulation on MuJoCo for Gymnasium, PettingZoo and Stable-Baselines3.

>>> import gymnasium as gym
>>> import mujoco_drones_gym
>>> env = gym.make("mujoco_drones_gym/Hover-v0")
>>> obs, info = env.reset(seed=1)
>>> obs, reward, terminated, truncated, info = env.step(env.action_space.sample())
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

from mujoco_drones_gym import _registration
from mujoco_drones_gym._native import __version__

if TYPE_CHECKING:
    from mujoco_drones_gym.control import DSLPIDControl, GeometricControl, PIDControl
    from mujoco_drones_gym.envs import (
        AntipodalAviary,
        BaseAviary,
        FlyThroughAviary,
        FormationAviary,
        HoverAviary,
        MultiHoverAviary,
        RaceAviary,
        StabilizeAviary,
        TrackAviary,
        VelocityAviary,
    )
    from mujoco_drones_gym.envs.multi_agent_aviary import MultiAgentAviary as MultiAgentAviary
    from mujoco_drones_gym.envs.multi_agent_aviary import parallel_env as parallel_env
    from mujoco_drones_gym.policy import Policy
    from mujoco_drones_gym.utils.enums import ActionType, DroneModel, ImageType, ObservationType, Physics
    from mujoco_drones_gym.utils.logger import Logger
    from mujoco_drones_gym.vector import VectorAviary

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

#: Modules and packages that are imported when they are used.
_SUBMODULES = ("control", "envs", "policy", "sb3", "utils", "vector", "wrappers")

# `from mujoco_drones_gym import *` works without pettingzoo, which MultiAgentAviary and parallel_env need
__all__ = [
    "ActionType",
    "AntipodalAviary",
    "BaseAviary",
    "DSLPIDControl",
    "DroneModel",
    "FlyThroughAviary",
    "FormationAviary",
    "GeometricControl",
    "HoverAviary",
    "ImageType",
    "Logger",
    "MultiHoverAviary",
    "ObservationType",
    "PIDControl",
    "Physics",
    "Policy",
    "RaceAviary",
    "StabilizeAviary",
    "TrackAviary",
    "VectorAviary",
    "VelocityAviary",
    "__version__",
]


def __getattr__(name: str) -> Any:
    if name in _SUBMODULES:
        return importlib.import_module(f"{__name__}.{name}")
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(importlib.import_module(f"{__name__}.{_MODULES[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *_MODULES, *_SUBMODULES})


_registration.register()
