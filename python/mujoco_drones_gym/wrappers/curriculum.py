"""Curricula: environments that become harder as an agent improves."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np

from mujoco_drones_gym import _native
from mujoco_drones_gym._config import Alias, accept_aliases, complete, short

__all__ = ["CurriculumConfig", "CurriculumWrapper"]

_DEFAULTS = _native.complete_options("curriculum", {})

# fields, and their names in the simulator
_NAMES = {
    "metric": "metric",
    "levels": "num_levels",
    "window": "window_size",
    "advance": "threshold_advance",
    "retreat": "threshold_retreat",
    "start_level": "start_level",
    "advance_count": "advance_count",
}
# as errors of the simulator name them
_ERROR_NAMES = {**_NAMES, **{f"curriculum.{name}": field for name, field in _NAMES.items()}}


@accept_aliases({name: Alias(field) for name, field in _NAMES.items() if name != field})
@dataclass
class CurriculumConfig:
    """Settings of a curriculum.

    The names of the simulator are accepted as well: `levels`, `window`, `advance`, `retreat`.

    Raises:
        ValueError: for a setting out of range.
    """

    metric: str = _DEFAULTS["metric"]
    """Metric of an episode: `success_rate`, `reward` (sum of the rewards) or `episode_length` (control steps)."""
    num_levels: int = _DEFAULTS["levels"]
    """Number of levels."""
    window_size: int = _DEFAULTS["window"]
    """Number of episodes in the mean of the metric. The level changes only after this many episodes on it."""
    threshold_advance: float = _DEFAULTS["advance"]
    """Mean at or above which the level increases."""
    threshold_retreat: float | None = None
    """Mean below which the level decreases; None never decreases it."""
    start_level: int = _DEFAULTS["start_level"]
    """Level of the first episode."""
    advance_count: int = _DEFAULTS["advance_count"]
    """Number of successive episodes with a mean at or above the threshold after which the level increases."""

    def __post_init__(self):
        options = self._to_options()
        for name, field in _NAMES.items():
            setattr(self, field, options.get(name))

    def _to_options(self) -> dict[str, Any]:
        """Returns the settings under the names of the simulator."""
        options = {name: getattr(self, field) for name, field in _NAMES.items()}
        return complete("curriculum", options, _ERROR_NAMES)


class CurriculumWrapper(gym.Wrapper, gym.utils.RecordConstructorArgs):
    """Adjusts the difficulty of an environment to the mean of a metric over the last episodes.

    Every reset calls `difficulty_fn(env, level)`, which may change the environment: its target height, its wind and so
    on. `env` is the unwrapped environment, and `level` counts from 0. An episode counts when it is terminated or
    truncated. An episode that a reset interrupts does not count.

    Args:
        env: Environment.
        difficulty_fn: Function of the environment and the level; None changes nothing.
        config: A `CurriculumConfig` or a dict with its fields.
    """

    def __init__(
        self,
        env: gym.Env,
        difficulty_fn: Callable[[Any, int], Any] | None = None,
        config: CurriculumConfig | Mapping[str, Any] | None = None,
    ):
        if config is None:
            config = CurriculumConfig()
        elif isinstance(config, Mapping):
            config = CurriculumConfig(**config)
        elif not isinstance(config, CurriculumConfig):
            raise TypeError(f"config is {short(config)}, expected a CurriculumConfig or a dict of its fields")
        if difficulty_fn is not None and not callable(difficulty_fn):
            expected = "a function of the environment and the level"
            raise TypeError(f"difficulty_fn is {short(difficulty_fn)}, expected {expected}")
        # the function may belong to an object that must not be copied
        gym.utils.RecordConstructorArgs.__init__(
            self, _disable_deepcopy=True, difficulty_fn=difficulty_fn, config=config
        )
        gym.Wrapper.__init__(self, env)
        self.config = config
        self.difficulty_fn = difficulty_fn
        self._curriculum = _native.Curriculum(config._to_options())
        self._reward = 0.0
        self._steps = 0

    @property
    def current_level(self) -> int:
        """Level from 0. A level that is set applies from the next reset."""
        return self._curriculum.level

    @current_level.setter
    def current_level(self, level: int) -> None:
        is_whole = isinstance(level, (int, np.integer)) and not isinstance(level, bool)
        if not is_whole or not 0 <= level < self.config.num_levels:
            expected = f"a whole number from 0 to {self.config.num_levels - 1}"
            raise ValueError(f"current_level is {short(level)}, expected {expected}")
        self._curriculum.restore({**self._curriculum.state(), "level": int(level), "recent": [], "streak": 0})

    @property
    def num_levels(self) -> int:
        """Number of levels."""
        return self.config.num_levels

    def get_stats(self) -> dict[str, Any]:
        """Returns the progress of the curriculum.

        Returns:
            `level`, `num_levels`, `progress` (0 to 1), `metric`, `metric_avg` (mean over the last episodes on this
            level, 0 before the first), `episodes` (number of episodes), `episodes_per_level`, `advances`, `retreats`.
        """
        state, mean = self._curriculum.state(), self._curriculum.mean
        return {
            "level": state["level"],
            "num_levels": self.config.num_levels,
            "progress": self._progress(),
            "metric": self.config.metric,
            "metric_avg": 0.0 if mean is None else mean,
            "episodes": state["episodes"],
            "episodes_per_level": state["episodes_per_level"],
            "advances": state["advances"],
            "retreats": state["retreats"],
        }

    def _progress(self) -> float:
        return self.current_level / max(1, self.config.num_levels - 1)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None):
        """Sets the level up and resets the environment. `info` has `curriculum_level` and `curriculum_progress`."""
        if self.difficulty_fn is not None:
            self.difficulty_fn(self.unwrapped, self.current_level)
        observation, info = self.env.reset(seed=seed, options=options)
        self._reward, self._steps = 0.0, 0
        return observation, self._with_level(info)

    def step(self, action: Any):
        """Steps the environment, and records the episode if it ends. `info` has the level of the next episode."""
        observation, reward, terminated, truncated, info = self.env.step(action)
        self._reward += float(reward)
        self._steps += 1
        if terminated or truncated:
            success = info.get("is_success", info.get("success", False))
            self._curriculum.episode_ended(bool(success), self._reward, self._steps)
        return observation, reward, terminated, truncated, self._with_level(info)

    def _with_level(self, info: dict[str, Any]) -> dict[str, Any]:
        return {**info, "curriculum_level": self.current_level, "curriculum_progress": self._progress()}

    def __getstate__(self):
        return {**self.__dict__, "_curriculum": self._curriculum.state()}

    def __setstate__(self, state):
        self.__dict__.update(state)
        self._curriculum = _native.Curriculum(self.config._to_options())
        self._curriculum.restore(state["_curriculum"])
