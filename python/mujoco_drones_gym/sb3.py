"""Batches of environments for Stable-Baselines3."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from gymnasium.vector import AutoresetMode
from stable_baselines3.common.vec_env import VecEnv

from mujoco_drones_gym._options import seed_of
from mujoco_drones_gym.vector import VectorAviary, VectorMember

__all__ = ["SB3VecEnv"]


class SB3VecEnv(VecEnv):
    """A `VectorAviary` as a `VecEnv` of Stable-Baselines3.

    An environment whose episode has ended starts the next one in the same step. Its info holds the last observation of
    the old episode as `terminal_observation`, `TimeLimit.truncated`, and the info of its last step: `time`, `success`,
    `progress`, `position_error`, `crashed`, `end` and `is_success`. `reset_infos` has the infos of the last `reset`.

    Args:
        task: Name of the task, such as "hover".
        num_envs: Number of environments, M.
        options: Options of `VectorAviary` except `autoreset_mode` and `copy`.

    Example:
        >>> from stable_baselines3 import PPO
        >>> from mujoco_drones_gym.sb3 import SB3VecEnv
        >>> model = PPO("MlpPolicy", SB3VecEnv("hover", 8), n_steps=64).learn(512)
    """

    def __init__(self, task: str, num_envs: int = 1, **options: Any) -> None:
        for name in ("autoreset_mode", "copy"):
            if name in options:
                raise TypeError(f"SB3VecEnv has no option {name!r}: Stable-Baselines3 determines it")
        self.venv = VectorAviary(task, num_envs, autoreset_mode=AutoresetMode.SAME_STEP, copy=True, **options)
        self._actions: np.ndarray | None = None
        super().__init__(self.venv.num_envs, self.venv.single_observation_space, self.venv.single_action_space)
        self.metadata = {**self.venv.metadata, **self.metadata}

    def seed(self, seed: int | None = None) -> Sequence[int | None]:
        """Sets the seed of the next reset. Every environment uses its own random stream of it.

        Returns:
            The seed, once per environment.
        """
        if seed is None:
            seed = int(np.random.randint(0, np.iinfo(np.uint32).max, dtype=np.uint32))
        self._seeds = [seed_of(seed)] * self.num_envs
        return self._seeds

    def reset(self) -> Any:
        """Starts an episode in every environment and returns the observations, (M, ...)."""
        seeds = self._seeds
        observations, _ = self.venv.reset(seed=seeds[0] if len(set(seeds)) == 1 else seeds)
        # the environments of a GPU have no infos
        has_infos = self.venv.device == "cpu"
        self.reset_infos = [env.info() if has_infos else {} for env in self.venv.envs]
        self._reset_seeds()
        self._reset_options()
        return observations

    def step_async(self, actions: np.ndarray) -> None:
        """Sets the actions, (M, ...), of the next `step_wait`."""
        self._actions = actions

    def step_wait(self) -> tuple[Any, np.ndarray, np.ndarray, list[dict[str, Any]]]:
        """Advances every environment by one control step.

        Returns:
            The observations (M, ...), the rewards, float32 (M,), the ends of episodes, bool (M,), and an info per
            environment.
        """
        observations, rewards, terminations, truncations, ends = self.venv.step(self._actions)
        infos: list[dict[str, Any]] = [{"TimeLimit.truncated": False} for _ in range(self.num_envs)]
        if ends:
            last = ends["final_obs"]
            # plain numbers instead of scalars of numpy
            final = {name: values.tolist() for name, values in ends["final_info"].items() if not name.startswith("_")}
            for i in np.flatnonzero(ends["_final_obs"]).tolist():
                infos[i] = {
                    "TimeLimit.truncated": bool(truncations[i] and not terminations[i]),
                    "terminal_observation": last[i],
                    **{name: values[i] for name, values in final.items()},
                }
        return observations, rewards, terminations | truncations, infos

    def close(self) -> None:
        """Ends the threads and frees the environments."""
        self.venv.close()

    def get_images(self) -> Sequence[np.ndarray | None]:
        """Returns a frame of every environment, uint8 (height, width, 3)."""
        return self.venv.render() or [None] * self.num_envs

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        """Returns an attribute of environments."""
        return [getattr(env, attr_name) for env in self._targets(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        """Sets an attribute of environments."""
        for env in self._targets(indices):
            setattr(env, attr_name, value)

    def env_method(self, method_name: str, *method_args: Any, indices: Any = None, **method_kwargs: Any) -> list[Any]:
        """Calls a method of environments and returns the results."""
        return [getattr(env, method_name)(*method_args, **method_kwargs) for env in self._targets(indices)]

    def env_is_wrapped(self, wrapper_class: Any, indices: Any = None) -> list[bool]:
        """Returns False for every environment: the environments of a batch have no wrappers."""
        return [False for _ in self._targets(indices)]

    def _targets(self, indices: Any) -> list[VectorMember]:
        return [self.venv.envs[int(index)] for index in self._get_indices(indices)]

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_actions": None}
