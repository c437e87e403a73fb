"""Airframes that several tests fly."""

from mujoco_drones_gym import _native

_CRAZYFLIE = {**_native.airframe_constants("cf2x")[0]}
_MOTORS = {"speed_at_zero": 1500.0, "speed_per_volt": 5800.0}

#: Crazyflie with a law from duty to speed and a constant voltage.
AIRFRAME_WITH_DUTY = {**_CRAZYFLIE, "motors": {**_MOTORS, "voltage": 3.7}}

#: Crazyflie with a battery that a few seconds of hover empty.
AIRFRAME_WITH_BATTERY = {
    **_CRAZYFLIE,
    "torque_coefficient": 1.9e-12,
    "motors": _MOTORS,
    "battery": {"capacity": 0.004, "resistance": 0.12, "efficiency": 0.4, "idle_current": 0.1},
}
