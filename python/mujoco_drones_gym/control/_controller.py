"""The interface of all controllers."""

from __future__ import annotations

from typing import Any

import numpy as np

from mujoco_drones_gym import _native
from mujoco_drones_gym._config import short
from mujoco_drones_gym.control._airframe import airframe_of

_ZEROS = np.zeros(3)
_ZEROS.setflags(write=False)


# larger numbers overflow in the products of a control law
_MAX = 1e9


def vector(name: str, value: Any, count: int = 3) -> np.ndarray:
    """Returns an argument as a float64 array of some numbers, or raises a ValueError."""
    try:
        array = np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError):
        raise ValueError(f"{name} is {short(value)}, expected {count} numbers") from None
    if array.size != count or array.ndim > 2:
        raise ValueError(f"{name} has the shape {array.shape}, expected ({count},)")
    return array.reshape(count)


def number(name: str, value: Any, expected: str = "a number") -> float:
    """Returns an argument as a float, or raises a ValueError."""
    try:
        return float(value)
    except (TypeError, ValueError):
        raise ValueError(f"{name} is {short(value)}, expected {expected}") from None


def check_sizes(arguments: dict[str, np.ndarray]) -> None:
    """Raises a ValueError for a finite number with which a control law overflows."""
    if np.abs(np.concatenate(list(arguments.values()))).max() <= _MAX:
        return
    for name, array in arguments.items():
        for index, entry in enumerate(array.tolist()):
            # the simulator reports numbers that are not finite
            if _MAX < abs(entry) < np.inf:
                raise ValueError(f"{name}[{index}] is {entry:g}, expected a number from -{_MAX:g} to {_MAX:g}")


class Controller:
    """Tracks a position and a yaw with the motors of one drone.

    A controller has integral terms: use one instance per drone, and call `reset` between episodes.

    Attributes:
        integral_pos_e: Integral of the position errors, world frame, m·s, shape (3,).
        integral_rpy_e: Integral of the attitude errors, body frame, rad·s, shape (3,).
        MASS: Mass of the airframe, kg.
        GRAVITY: Gravity, m/s².
        KF, KM: Thrust and torque coefficients, N/rpm² and N·m/rpm².
        L: Arm length, m.
        J: Inertia, kg·m², shape (3, 3).
        HOVER_RPM, MAX_RPM: Motor speed in hover and maximum motor speed, rpm.
    """

    _KIND = ""

    def __init__(self, env: Any = None, *, drone_model: Any = None):
        self._build(airframe_of(_either(type(self).__name__, env, drone_model)), None)

    def _build(self, airframe: str | dict[str, Any], bandwidths: dict[str, float] | None) -> None:
        self._native = _native.Controller(self._KIND, airframe, bandwidths)
        params, constants = _native.airframe_constants(airframe)
        self.MASS = params["mass"]
        self.GRAVITY = constants["gravity"]
        self.KF = params["thrust_coefficient"]
        self.KM = params["torque_coefficient"]
        self.L = params["arm_length"]
        self.J = np.diag(params["inertia"])
        self.HOVER_RPM = constants["hover_rpm"]
        self.MAX_RPM = constants["max_rpm"]
        self.integral_pos_e, self.integral_rpy_e = self._native.integrals()

    def reset(self) -> None:
        """Clears the integral terms and the setpoint."""
        self._native.reset()
        self.integral_pos_e, self.integral_rpy_e = self._native.integrals()

    def computeControl(
        self,
        control_timestep: float,
        cur_pos: Any,
        cur_quat: Any,
        cur_vel: Any,
        cur_ang_vel: Any,
        target_pos: Any,
        target_rpy: Any = _ZEROS,
        target_vel: Any = _ZEROS,
        target_acc: Any = _ZEROS,
        target_rpy_rates: Any = _ZEROS,
    ) -> tuple[np.ndarray, np.ndarray, float]:
        """Computes the motor speeds for the next control step.

        Args:
            control_timestep: Time since the last call, s.
            cur_pos: Position, world frame, m, shape (3,).
            cur_quat: Attitude, body to world, quaternion (w, x, y, z), shape (4,), of any length; it is normalized.
            cur_vel: Velocity, world frame, m/s, shape (3,).
            cur_ang_vel: Angular velocity, body frame, rad/s, shape (3,).
            target_pos: Target position, world frame, m, shape (3,).
            target_rpy: Target roll, pitch and yaw, rad, shape (3,); only the yaw is used.
            target_vel: Target velocity, world frame, m/s, shape (3,).
            target_acc: Target acceleration, world frame, m/s², shape (3,).
            target_rpy_rates: Target rates of roll, pitch and yaw, rad/s, shape (3,); only the yaw rate is used.

        Returns:
            Motor speeds, rpm, shape (4,); position error (target minus actual), world frame, m, shape (3,); yaw error,
            rad.

        Raises:
            ValueError: for a wrong shape, a number that is not finite or beyond ±1e9, or a quaternion of zeros. The
                integral terms are unchanged.
        """
        native = self._native
        timestep = number("control_timestep", control_timestep, "1e-6 to 10 s")
        arguments = {
            "cur_pos": vector("cur_pos", cur_pos),
            "cur_quat": vector("cur_quat", cur_quat, 4),
            "cur_vel": vector("cur_vel", cur_vel),
            "cur_ang_vel": vector("cur_ang_vel", cur_ang_vel),
            "target_pos": vector("target_pos", target_pos),
            "target_vel": vector("target_vel", target_vel),
            "target_acc": vector("target_acc", target_acc),
            "target_rpy": vector("target_rpy", target_rpy),
            "target_rpy_rates": vector("target_rpy_rates", target_rpy_rates),
        }
        integrals = {
            "integral_pos_e": vector("integral_pos_e", self.integral_pos_e),
            "integral_rpy_e": vector("integral_rpy_e", self.integral_rpy_e),
        }
        check_sizes({**arguments, **integrals})
        *plain, rpy, rates = arguments.values()
        native.set_integrals(*integrals.values())
        output = native.compute(timestep, *plain, float(rpy[2]), float(rates[2]))
        self.integral_pos_e, self.integral_rpy_e = native.integrals()
        return output

    def computeControlFromState(
        self,
        control_timestep: float,
        state: Any,
        target_pos: Any,
        target_rpy: Any = _ZEROS,
        target_vel: Any = _ZEROS,
        target_acc: Any = _ZEROS,
        target_rpy_rates: Any = _ZEROS,
    ) -> tuple[np.ndarray, np.ndarray, float]:
        """Computes the motor speeds from the 20 numbers of a drone's state, shape (20,), as `computeControl` does."""
        return self.computeControl(
            control_timestep, *split(state), target_pos, target_rpy, target_vel, target_acc, target_rpy_rates
        )

    compute_control = computeControl
    compute_control_from_state = computeControlFromState

    def __getstate__(self):
        return {**self.__dict__, "_native": self._native.to_json()}

    def __setstate__(self, state):
        self.__dict__.update(state)
        self._native = _native.Controller.from_json(state["_native"])


def _either(owner: str, env: Any, drone_model: Any) -> Any:
    if env is not None and drone_model is not None:
        raise TypeError(f"{owner} got env and drone_model, expected one of them")
    return drone_model if env is None else env


def split(state: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Returns position, quaternion, velocity and angular velocity of the 20 numbers of a drone."""
    state = vector("state", state, 20)
    return state[0:3], state[3:7], state[10:13], state[13:16]


class Cascade(Controller):
    """A position loop around an attitude loop, with gains."""

    def _gain(loop: str, key: str, unit: str):
        def get(self) -> np.ndarray:
            gain = np.array(self._native.gains()[loop][key])
            # a change in place would change this copy
            gain.setflags(write=False)
            return gain

        def set_(self, value) -> None:
            self._set_gain(loop, key, vector("a gain", value).tolist())

        return property(get, set_, doc=f"The {key} gains of the {loop} loop, {unit}, shape (3,), read-only array.")

    def _limit(loop: str, unit: str):
        def get(self) -> float:
            return self._native.gains()[loop]["integral_clamp"]

        def set_(self, value) -> None:
            self._set_gain(loop, "integral_clamp", number("an integral limit", value))

        return property(get, set_, doc=f"Limit of each component of the integral of the {loop} loop, {unit}.")

    P_COEFF_FOR = _gain("position", "proportional", "1/s²")
    I_COEFF_FOR = _gain("position", "integral", "1/s³")
    D_COEFF_FOR = _gain("position", "derivative", "1/s")
    P_COEFF_TOR = _gain("attitude", "proportional", "N·m/rad")
    I_COEFF_TOR = _gain("attitude", "integral", "N·m/(rad·s)")
    D_COEFF_TOR = _gain("attitude", "derivative", "N·m/(rad/s)")
    INTEGRAL_POS_LIMIT = _limit("position", "m·s")
    INTEGRAL_RPY_LIMIT = _limit("attitude", "rad·s")

    del _gain, _limit

    def _set_gain(self, loop: str, key: str, value: Any) -> None:
        gains = self._native.gains()
        gains[loop][key] = value
        self._native.set_gains(gains)

    def setPIDCoefficients(
        self,
        p_coeff_pos: Any = None,
        i_coeff_pos: Any = None,
        d_coeff_pos: Any = None,
        p_coeff_att: Any = None,
        i_coeff_att: Any = None,
        d_coeff_att: Any = None,
    ) -> None:
        """Replaces gains, each of shape (3,); None keeps a gain."""
        for name, value in {
            "P_COEFF_FOR": p_coeff_pos,
            "I_COEFF_FOR": i_coeff_pos,
            "D_COEFF_FOR": d_coeff_pos,
            "P_COEFF_TOR": p_coeff_att,
            "I_COEFF_TOR": i_coeff_att,
            "D_COEFF_TOR": d_coeff_att,
        }.items():
            if value is not None:
                setattr(self, name, value)
