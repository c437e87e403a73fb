"""Controllers: from the state of a drone and a target to motor speeds."""

from mujoco_drones_gym.control.dsl_pid_control import DSLPIDControl
from mujoco_drones_gym.control.geometric_control import GeometricControl
from mujoco_drones_gym.control.pid_control import PIDControl

__all__ = ["DSLPIDControl", "GeometricControl", "PIDControl"]
