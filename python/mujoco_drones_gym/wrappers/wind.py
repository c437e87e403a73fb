"""Wind models and their settings."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from enum import Enum
from typing import Any

import numpy as np

from mujoco_drones_gym import _native
from mujoco_drones_gym._config import Alias, Fixed, accept_aliases, complete, short, translated, with_aliases
from mujoco_drones_gym.control._airframe import airframe_of
from mujoco_drones_gym.control._controller import check_sizes, number, vector

__all__ = ["WindConfig", "WindField", "WindModel"]


class WindModel(Enum):
    """Wind models."""

    NONE = "none"
    """Still air."""
    CONSTANT = "constant"
    """Air that moves at a constant velocity."""
    GUST = "gust"
    """Forces of random start times, directions and amplitudes."""
    DRYDEN = "dryden"
    """Dryden turbulence."""
    SINUSOIDAL = "sinusoidal"
    """Force that oscillates at a constant angular frequency."""
    COMBINED = "combined"
    """All four."""


_DEFAULTS = _native.complete_options("wind", {})

# these also act in still air or on a sampled wind
_INDEPENDENT = ("still_air_drag", "filter", "air_density", "drag_area")

# the paper's package counts gusts in steps of 240 Hz
_STEP = 1.0 / 240.0

ALIASES = {
    "constant_wind": Alias("velocity", lambda wind: (0.0, 0.0, 0.0) if wind is None else wind, np.array),
    "gust_intensity": Alias("gust_force"),
    "gust_duration_steps": Alias("gust_duration", lambda steps: steps * _STEP, lambda seconds: seconds / _STEP),
    "gust_probability": Alias("gust_rate", lambda share: share / _STEP, lambda rate: rate * _STEP),
    "turbulence_intensity": Alias("turbulence"),
    "sinusoidal_amplitude": Alias("sinusoidal_force"),
    "sinusoidal_period": Alias(
        "sinusoidal_frequency",
        lambda period: 2.0 * math.pi / period,
        lambda frequency: 2.0 * math.pi / frequency if frequency else math.inf,
        "a positive period in s",
    ),
    "drag_coefficient": Alias("drag_area"),
}


_FIXED = {
    "altitude": Fixed(None, "the turbulence depends on the height of the drone"),
    "airspeed": Fixed(None, "the turbulence depends on the airspeed of the drone"),
}


@accept_aliases(ALIASES, _FIXED)
@dataclass
class WindConfig:
    """Settings of the wind, with the keys of the section `[wind]` of a configuration file.

    The names of the paper's package are accepted as well: `constant_wind` (`velocity`), `gust_intensity`
    (`gust_force`), `gust_duration_steps` (`gust_duration`, in steps of 1/240 s), `gust_probability` (`gust_rate`, per
    step of 1/240 s), `turbulence_intensity` (`turbulence`), `sinusoidal_amplitude` (`sinusoidal_force`),
    `sinusoidal_period` (of `sinusoidal_frequency`, s) and `drag_coefficient` (`drag_area`).

    Raises:
        ValueError: for a setting out of range.
    """

    model: WindModel = WindModel.NONE
    """Wind model, or its name."""
    velocity: tuple[float, float, float] = tuple(_DEFAULTS["velocity"])
    """Velocity of the constant wind, world frame, m/s. Its horizontal direction is the longitudinal axis of the
    turbulence."""
    gust_force: float = _DEFAULTS["gust_force"]
    """Maximum amplitude of a gust, N."""
    turbulence: float = _DEFAULTS["turbulence"]
    """Mean wind speed 20 feet (6 m) above the ground, m/s. The vertical standard deviation of the turbulence is a
    tenth of it."""
    sinusoidal_force: float = _DEFAULTS["sinusoidal_force"]
    """Amplitude of the sinusoidal force, N."""
    sinusoidal_frequency: float = _DEFAULTS["sinusoidal_frequency"]
    """Angular frequency of the sinusoidal force, rad/s."""
    gust_duration: float = _DEFAULTS["gust_duration"]
    """Duration of a gust, s."""
    gust_rate: float = _DEFAULTS["gust_rate"]
    """Average number of gusts per second without a gust."""
    filter: str = _DEFAULTS["filter"]
    """Spectra of the turbulence: `first_order` or `mil_f_8785c`."""
    air_density: float = _DEFAULTS["air_density"]
    """Density of the air, kg/m³."""
    drag_area: float | None = None
    """Drag area C_d·A of every drone, m²; None for that of the airframe."""
    still_air_drag: bool = _DEFAULTS["still_air_drag"]
    """True to apply the drag law in still air as well."""

    def __post_init__(self):
        if self.velocity is None:
            self.velocity = (0.0, 0.0, 0.0)
        options = complete("wind", asdict(self))
        self.model = WindModel(options["model"])
        self.velocity = tuple(options["velocity"])

    def _to_options(self) -> dict[str, Any]:
        """Returns the settings as the keys of the section `[wind]`."""
        return complete("wind", asdict(self))


def wind_options(wind: Any) -> dict[str, Any] | None:
    """Returns the section `[wind]` of a `WindConfig`, a model or its name, a dict of settings, or None."""
    if wind is None:
        return None
    if isinstance(wind, WindConfig):
        return wind._to_options()
    if isinstance(wind, (str, WindModel)):
        return complete("wind", {"model": wind})
    if isinstance(wind, Mapping):
        given = translated("wind", wind, ALIASES)
        try:
            options = complete("wind", given)
        except ValueError as error:
            raise ValueError(with_aliases(str(error), wind, ALIASES)) from None
        if given.get("model") is None and any(
            value is not None and name not in _INDEPENDENT for name, value in given.items()
        ):
            raise ValueError(f"wind has no model, expected one of {', '.join(model.value for model in WindModel)}")
        return options
    raise ValueError(f"wind is {short(wind)}, expected a WindConfig, a dict of its settings or None")


class WindField:
    """Wind at one drone, outside an environment.

    A wind field can be pickled and copied. The copy continues with the forces of the original.

    Args:
        config: Settings of the wind: a `WindConfig`, a model or its name, or a dict of settings; still air by default.
        env: Environment, drone model or airframe whose drag area applies; a Crazyflie by default.
        seed: Seed of the random numbers; a random one by default.
    """

    def __init__(
        self,
        config: WindConfig | WindModel | str | Mapping[str, Any] | None = None,
        *,
        env: Any = None,
        seed: int | None = None,
    ):
        if config is None:
            config = WindConfig()
        elif not isinstance(config, WindConfig):
            config = WindConfig(**wind_options(config))
        self.config = config
        self._airframe = airframe_of(env)
        self._rng = np.random.default_rng()
        self.reset(seed)

    def reset(self, seed: int | None = None) -> None:
        """Restarts the wind, from a seed or with the next random numbers."""
        if seed is None:
            start = int(self._rng.integers(2**63))
        elif isinstance(seed, (int, np.integer)) and not isinstance(seed, bool) and 0 <= seed < 2**64:
            start = int(seed)
        else:
            raise ValueError(f"seed is {short(seed)}, expected an integer from 0 to 2^64 - 1")
        field = _native.WindField(self.config._to_options(), self._airframe, start)
        if seed is not None:
            self._rng = np.random.default_rng(start)
        self._field = field

    def get_force(self, dt: float, position: np.ndarray, velocity: np.ndarray) -> np.ndarray:
        """Advances the wind by `dt` seconds and returns the force on the drone.

        Args:
            dt: Length of the physics step, s.
            position: Position of the drone, world frame, m, shape (3,). The turbulence depends on the height.
            velocity: Velocity of the drone, world frame, m/s, shape (3,).

        Returns:
            Force, world frame, N, shape (3,).

        Raises:
            ValueError: for an argument of another shape, that is not finite or beyond ±1e9; the wind has not advanced.
        """
        return self._advance(dt, position, velocity)[0]

    def _advance(self, dt, position, velocity):
        arguments = {"position": vector("position", position), "velocity": vector("velocity", velocity)}
        check_sizes(arguments)
        return self._field.advance(number("dt", dt), *arguments.values())

    def __getstate__(self):
        return {**self.__dict__, "_field": self._field.to_json()}

    def __setstate__(self, state):
        self.__dict__.update(state)
        self._field = _native.WindField.from_json(state["_field"])
