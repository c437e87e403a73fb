"""Domain randomization: parameters that are sampled for every episode."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Any

import gymnasium as gym

from mujoco_drones_gym import _native
from mujoco_drones_gym._config import Alias, Fixed, accept_aliases, complete, short
from mujoco_drones_gym.wrappers._base import aviary_of

__all__ = ["DomainRandomizationConfig", "DomainRandomizationWrapper"]

# every group with the paper's ranges
PAPER = {group: {} for group in ("body", "aerodynamics", "actuators", "sensors", "environment", "initial")}
_DEFAULTS = _native.complete_options("randomization", PAPER)

# fields: group and key in the simulator, and the value that changes nothing
_KEYS = {
    "mass_range": ("body", "mass", (1.0, 1.0)),
    "inertia_range": ("body", "inertia", (1.0, 1.0)),
    "arm_length_range": ("body", "arm_length", (1.0, 1.0)),
    "kf_range": ("aerodynamics", "thrust", (1.0, 1.0)),
    "km_range": ("aerodynamics", "torque", (1.0, 1.0)),
    "drag_range": ("aerodynamics", "drag", (1.0, 1.0)),
    "ground_effect_range": ("aerodynamics", "ground", (1.0, 1.0)),
    "downwash_range": ("aerodynamics", "downwash", (1.0, 1.0)),
    "velocity_moment_range": ("aerodynamics", "moment", (1.0, 1.0)),
    "rotational_damping_range": ("aerodynamics", "damping", (1.0, 1.0)),
    "motor_gain_range": ("actuators", "gain", (1.0, 1.0)),
    "motor_constant_range": ("actuators", "max_rpm", (1.0, 1.0)),
    "motor_time_constant_range": ("actuators", "lag", (0.0, 0.0)),
    "action_latency_range": ("actuators", "latency", (0.0, 0.0)),
    "pos_noise_std": ("sensors", "position", 0.0),
    "vel_noise_std": ("sensors", "velocity", 0.0),
    "rpy_noise_std": ("sensors", "attitude", 0.0),
    "ang_vel_noise_std": ("sensors", "angular_velocity", 0.0),
    "sensor_bias": ("sensors", "bias", 0.0),
    "gyro_bias_std": ("sensors", "gyro_bias", None),
    "sensor_latency_range": ("sensors", "latency", (0.0, 0.0)),
    "gravity_range": ("environment", "gravity", (1.0, 1.0)),
    "wind_speed_range": ("environment", "wind", (0.0, 0.0)),
    "init_position": ("initial", "position", 0.0),
    "init_rpy": ("initial", "attitude", 0.0),
    "init_velocity": ("initial", "velocity", 0.0),
    "init_offset": ("initial", "offset", (0.0, 0.0, 0.0)),
}

# names of the options in error messages
_NAMES = {
    f"{prefix}{group}.{key}": name
    for name, (group, key, _) in _KEYS.items()
    for prefix in ("the randomized ", "randomization.")
}


class _Default(tuple):
    """A range that the user has not given."""

    __slots__ = ()


def _default(name: str) -> Any:
    group, key, _ = _KEYS[name]
    value = _DEFAULTS[group].get(key)
    return tuple(value) if isinstance(value, list) else value


def _fixed(value: float) -> tuple[float, float]:
    return (value, value)


def _lower(value: Sequence[float]) -> float:
    return value[0]


# a uniform distribution over ±max has the standard deviation max / √3
_UNIFORM = (lambda std: math.sqrt(3.0) * std, lambda maximum: maximum / math.sqrt(3.0))

ALIASES = {
    "motor_time_constant": Alias("motor_time_constant_range", _fixed, _lower),
    "action_delay_steps": Alias("action_delay_range", _fixed, lambda steps: None if steps is None else steps[0]),
    "init_pos_noise_std": Alias("init_position", *_UNIFORM),
    "init_rpy_noise_std": Alias("init_rpy", *_UNIFORM),
    "init_vel_noise_std": Alias("init_velocity", *_UNIFORM),
}


_FIXED = {
    "acc_bias_std": Fixed(0.0, "observations have no accelerations"),
    "randomize_every_episode": Fixed(True, "the parameters are sampled at every reset"),
}


@accept_aliases(ALIASES, _FIXED)
@dataclass
class DomainRandomizationConfig:
    """Ranges of the parameters that are sampled for every episode. The defaults are the paper's ranges.

    A range is (lowest, highest) of a uniform distribution. None leaves a parameter nominal, and
    `DomainRandomizationConfig.only(...)` leaves all other parameters nominal. Every drone has its own samples, except
    for gravity and wind.

    The names of the paper's package are accepted as well: `motor_time_constant`, `action_delay_steps`,
    `init_pos_noise_std`, `init_rpy_noise_std`, `init_vel_noise_std` (standard deviations of the uniform distributions).

    Raises:
        ValueError: for a range that is not possible.
    """

    mass_range: tuple[float, float] | None = _default("mass_range")
    """Factor on the mass."""
    inertia_range: tuple[float, float] | None = _default("inertia_range")
    """Common factor on all moments of inertia."""
    kf_range: tuple[float, float] | None = _default("kf_range")
    """Factor on the thrust coefficient."""
    km_range: tuple[float, float] | None = _default("km_range")
    """Factor on the torque coefficient."""
    arm_length_range: tuple[float, float] | None = _default("arm_length_range")
    """Factor on the arm length."""
    motor_constant_range: tuple[float, float] | None = _default("motor_constant_range")
    """Factor on the maximum motor speed."""
    drag_range: tuple[float, float] | None = _default("drag_range")
    """Factors on the blade drag: one sample for x and y, one for z."""
    ground_effect_range: tuple[float, float] | None = _default("ground_effect_range")
    """Factor on the ground-effect coefficient."""
    downwash_range: tuple[float, float] | None = _default("downwash_range")
    """Factor on the strength of the wake."""
    velocity_moment_range: tuple[float, float] | None = _default("velocity_moment_range")
    """Factor on the moment of the velocity; (1, 1) by default."""
    rotational_damping_range: tuple[float, float] | None = _default("rotational_damping_range")
    """Factor on the rotational damping; (1, 1) by default."""
    motor_gain_range: tuple[float, float] | None = _default("motor_gain_range")
    """Factor on the speed of each motor, four samples."""
    motor_time_constant_range: tuple[float, float] | None = _default("motor_time_constant_range")
    """Time constant of the lag of the motors, s."""
    action_latency_range: tuple[float, float] | None = _default("action_latency_range")
    """Latency of commands, s."""
    action_delay_range: tuple[float, float] | None = None
    """Latency of commands, control steps; replaces `action_latency_range`."""
    pos_noise_std: float | None = _default("pos_noise_std")
    """Standard deviation of the noise on each observed coordinate, m."""
    vel_noise_std: float | None = _default("vel_noise_std")
    """Standard deviation of the noise on each component of the observed velocity, m/s."""
    rpy_noise_std: float | None = _default("rpy_noise_std")
    """Standard deviation of the noise on the observed roll, pitch and yaw, rad."""
    ang_vel_noise_std: float | None = _default("ang_vel_noise_std")
    """Standard deviation of the noise on each component of the observed angular velocity, rad/s."""
    sensor_bias: float | None = _default("sensor_bias")
    """Ratio of the standard deviation of the bias, sampled once per episode, to that of the noise."""
    gyro_bias_std: float | None = None
    """Standard deviation of the bias of the angular velocity, rad/s; None for `sensor_bias` times the noise."""
    sensor_latency_range: tuple[float, float] | None = _default("sensor_latency_range")
    """Delay of the observed states, s."""
    gravity_range: tuple[float, float] | None = _default("gravity_range")
    """Factor on gravity."""
    wind_speed_range: tuple[float, float] | None = _Default(_default("wind_speed_range"))
    """Speed of a combined wind with a random direction, m/s. The default has no effect in an environment with a wind of
    its own."""
    init_position: float | None = _default("init_position")
    """Maximum change of each initial coordinate, m."""
    init_rpy: float | None = _default("init_rpy")
    """Maximum change of the initial roll, pitch and yaw, rad."""
    init_velocity: float | None = _default("init_velocity")
    """Maximum change of each component of the initial velocity, m/s."""
    init_offset: tuple[float, float, float] | None = _default("init_offset")
    """Shift of the initial positions, world frame, m."""

    def __post_init__(self):
        self._to_options()

    @classmethod
    def only(cls, **ranges: Any) -> DomainRandomizationConfig:
        """Creates a config that samples the given parameters and leaves all others nominal."""
        return cls(**dict.fromkeys(_names_without(cls, ranges)), **ranges)

    def _to_options(self, ctrl_freq: float = 48.0) -> dict[str, Any]:
        """Returns the ranges as the groups of the section `[randomization]`.

        A group whose parameters are all nominal is missing. `ctrl_freq` is the control rate, Hz.
        """
        groups: dict[str, dict[str, Any]] = {}
        changed = set()
        for name, (group, key, nominal) in _KEYS.items():
            value = getattr(self, name)
            if name == "action_latency_range" and self.action_delay_range is not None:
                value = _seconds(self.action_delay_range, ctrl_freq)
            value = tuple(value) if isinstance(value, _Default) else value
            groups.setdefault(group, {})[key] = nominal if value is None else value
            if value is not None and not _equal(value, nominal):
                changed.add(group)
        return complete("randomization", {group: groups[group] for group in groups if group in changed}, _NAMES)


def _names_without(cls: type, given: Mapping[str, Any]) -> list[str]:
    taken = {ALIASES[name].field if name in ALIASES else name for name in given}
    return [field.name for field in fields(cls) if field.name not in taken]


def _equal(value: Any, nominal: Any) -> bool:
    try:
        return tuple(value) == nominal
    except TypeError:
        return value == nominal


def _seconds(steps: Any, ctrl_freq: float) -> list[float]:
    try:
        low, high = steps
        return [low / ctrl_freq, high / ctrl_freq]
    except (TypeError, ValueError):
        raise ValueError(f"action_delay_range is {short(steps)}, expected two numbers of control steps") from None


def dict_options(randomization: Mapping[str, Any], ctrl_freq: float = 48.0) -> dict[str, Any]:
    """Returns the options of a dict of groups, or of fields of a `DomainRandomizationConfig`."""
    own = {*_KEYS, *ALIASES, *_FIXED, "action_delay_range"}
    if any(name in own for name in randomization):
        groups = [name for name in randomization if name in PAPER]
        if groups:
            raise ValueError(f"randomization has {groups[0]} next to fields of a DomainRandomizationConfig")
        return DomainRandomizationConfig(**randomization)._to_options(ctrl_freq)
    return complete("randomization", randomization)


def randomization_options(
    randomization: Any, ctrl_freq: float = 48.0, wind: Mapping[str, Any] | None = None
) -> dict[str, Any] | None:
    """Returns the section `[randomization]` of True (the paper's ranges), False, a `DomainRandomizationConfig`, or a
    dict of groups or of the fields of a `DomainRandomizationConfig`.

    `ctrl_freq` is the control rate, Hz. `wind` is the section `[wind]` of the environment, which replaces a default
    range of the wind.
    """
    if randomization is None or randomization is False:
        return None
    if randomization is True:
        options = complete("randomization", PAPER)
    elif isinstance(randomization, DomainRandomizationConfig):
        options = randomization._to_options(ctrl_freq)
    elif isinstance(randomization, Mapping):
        options = dict_options(randomization, ctrl_freq)
    else:
        expected = "True, False, a DomainRandomizationConfig or a dict of its groups"
        raise ValueError(f"randomization is {short(randomization)}, expected {expected}")
    return options if wind is None or wind["model"] == "none" else _without_wind(randomization, options, wind["model"])


def _without_wind(randomization: Any, options: dict[str, Any], model: str) -> dict[str, Any]:
    """Returns options without the default range of the wind, and raises a ValueError for a range of the user."""
    environment = options.get("environment")
    if environment is None or not environment["wind"][1] > 0.0:
        return options
    name, given = "wind_speed_range", None
    if isinstance(randomization, DomainRandomizationConfig):
        given = randomization.wind_speed_range
    elif isinstance(randomization, Mapping):
        given = randomization.get(name)
        if given is None:
            name, given = "environment.wind", (randomization.get("environment") or {}).get("wind")
    if given is None or isinstance(given, _Default):
        return {**options, "environment": {**environment, "wind": [0.0, 0.0]}}
    raise ValueError(f"{name} is {short(given)}, expected (0, 0), because the environment has a wind ({model})")


def domain_params(aviary: Any) -> dict[str, Any]:
    """Returns the sampled parameters of an environment in the present episode."""
    sampled = aviary.sampled_params()
    if sampled is None:
        return {}
    drones = []
    for index, drone in enumerate(sampled["drones"]):
        params, motors = aviary.drone_params(index), drone["actuators"]
        drones.append(
            {
                "mass": params["mass"],
                "inertia": params["inertia"],
                "arm_length": params["arm_length"],
                "kf": params["thrust_coefficient"],
                "km": params["torque_coefficient"],
                "drag": params["drag_coefficients"],
                "max_rpm": aviary.MAX_RPM * motors["saturation"],
                "motor_gains": motors["gains"],
                "motor_tau": motors["lag"],
                "action_latency": motors["latency"],
                "action_delay": motors["latency"] * aviary.CTRL_FREQ,
                "gyro_bias": drone["bias"][3],
            }
        )
    # of several drones a list
    own = drones[0] if len(drones) == 1 else {name: [drone[name] for drone in drones] for name in drones[0]}
    return {
        **own,
        "gravity": aviary.G,
        "sensor_latency": sampled["sensor_latency"],
        "wind": sampled.get("wind"),
    }


class DomainRandomizationWrapper(gym.Wrapper, gym.utils.RecordConstructorArgs):
    """Samples physical and sensor parameters at every reset. They stay fixed during the episode.

    The seed of a reset determines the samples. They are those of the option `randomization` of the environment.
    `info["domain_params"]` of a reset has the sampled parameters: `mass` (kg), `kf`, `km`, `arm_length` (m), `inertia`,
    `max_rpm`, `motor_tau` (s), `action_latency` (s), `action_delay` (control steps), `motor_gains`, `gyro_bias`
    (rad/s), each a list over the drones if there are several, and `gravity` (m/s²), `sensor_latency` (s), `wind`.

    Args:
        env: Environment of this package, with any wrappers.
        config: A `DomainRandomizationConfig`, a dict of its fields or of the groups of the section `[randomization]`,
            or True for the paper's ranges, the default.
    """

    def __init__(self, env: gym.Env, config: DomainRandomizationConfig | Mapping[str, Any] | bool | None = None):
        gym.utils.RecordConstructorArgs.__init__(self, config=config)
        gym.Wrapper.__init__(self, env)
        self.config = DomainRandomizationConfig() if config is None or config is True else config
        aviary_of(env, type(self).__name__).set_randomization(self.config)
        self._domain_params: dict[str, Any] = {}

    @property
    def domain_params(self) -> dict[str, Any]:
        """Sampled parameters of the episode; empty before the first reset."""
        return dict(self._domain_params)

    @property
    def _current_delay(self) -> int:
        """Latency of commands, rounded to control steps (the name of the paper's package)."""
        delay = self._domain_params.get("action_delay", 0.0)
        return round(max(delay) if isinstance(delay, list) else delay)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None):
        """Samples the parameters and resets the environment."""
        observation, info = self.env.reset(seed=seed, options=options)
        self._domain_params = domain_params(self.unwrapped)
        return observation, {**info, "domain_params": self.domain_params}
