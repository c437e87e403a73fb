"""Wind in an environment."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import gymnasium as gym

from mujoco_drones_gym.wrappers._base import aviary_of
from mujoco_drones_gym.wrappers.wind import WindConfig, WindModel, wind_options

__all__ = ["WindWrapper"]


class WindWrapper(gym.Wrapper, gym.utils.RecordConstructorArgs):
    """Sets the wind of an environment.

    The wind acts in every physics step of the simulation, as with the option `wind` of the environment: both give the
    same flight. Each drone has independent gusts and turbulence. The seed of a reset determines the wind.

    Args:
        env: Environment of this package, with any wrappers.
        config: A `WindConfig` or a dict with its fields; Dryden turbulence by default.
        wind_config: Another name of `config`.
    """

    def __init__(
        self,
        env: gym.Env,
        config: WindConfig | Mapping[str, Any] | None = None,
        *,
        wind_config: WindConfig | Mapping[str, Any] | None = None,
    ):
        if config is not None and wind_config is not None:
            raise TypeError("WindWrapper got config and wind_config, expected one of them")
        config = wind_config if config is None else config
        if config is None:
            config = WindConfig(WindModel.DRYDEN)
        elif not isinstance(config, WindConfig):
            config = WindConfig(**wind_options(config))
        gym.utils.RecordConstructorArgs.__init__(self, config=config)
        gym.Wrapper.__init__(self, env)
        self.wind_config = config
        aviary_of(env, type(self).__name__).set_wind(config)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None):
        """Resets the environment and restarts the wind. `info["wind_config"]` has the settings of the wind."""
        observation, info = self.env.reset(seed=seed, options=options)
        return observation, {**info, "wind_config": self.wind_config._to_options()}
