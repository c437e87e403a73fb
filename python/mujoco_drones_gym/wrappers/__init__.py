"""Wind, obstacles, randomization and curricula."""

from mujoco_drones_gym.wrappers.curriculum import CurriculumConfig, CurriculumWrapper
from mujoco_drones_gym.wrappers.obstacles import (
    Obstacle,
    ObstacleConfig,
    ObstacleType,
    generate_obstacles,
    obstacles_to_xml,
)
from mujoco_drones_gym.wrappers.randomization import DomainRandomizationConfig, DomainRandomizationWrapper
from mujoco_drones_gym.wrappers.wind import WindConfig, WindField, WindModel
from mujoco_drones_gym.wrappers.wind_wrapper import WindWrapper

__all__ = [
    "CurriculumConfig",
    "CurriculumWrapper",
    "DomainRandomizationConfig",
    "DomainRandomizationWrapper",
    "Obstacle",
    "ObstacleConfig",
    "ObstacleType",
    "WindConfig",
    "WindField",
    "WindModel",
    "WindWrapper",
    "generate_obstacles",
    "obstacles_to_xml",
]
