"""Environments, one class per task."""

from __future__ import annotations

from typing import Any

from mujoco_drones_gym.envs.antipodal_aviary import AntipodalAviary
from mujoco_drones_gym.envs.base_aviary import BaseAviary
from mujoco_drones_gym.envs.fly_through_aviary import FlyThroughAviary
from mujoco_drones_gym.envs.formation_aviary import FormationAviary
from mujoco_drones_gym.envs.hover_aviary import HoverAviary
from mujoco_drones_gym.envs.multi_hover_aviary import MultiHoverAviary
from mujoco_drones_gym.envs.race_aviary import RaceAviary
from mujoco_drones_gym.envs.stabilize_aviary import StabilizeAviary
from mujoco_drones_gym.envs.track_aviary import TrackAviary
from mujoco_drones_gym.envs.velocity_aviary import VelocityAviary

__all__ = [
    "AntipodalAviary",
    "BaseAviary",
    "FlyThroughAviary",
    "FormationAviary",
    "HoverAviary",
    "MultiHoverAviary",
    "RaceAviary",
    "StabilizeAviary",
    "TrackAviary",
    "VelocityAviary",
]


def __getattr__(name: str) -> Any:
    # needs pettingzoo
    if name in ("MultiAgentAviary", "parallel_env"):
        from mujoco_drones_gym.envs import multi_agent_aviary

        return getattr(multi_agent_aviary, name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
