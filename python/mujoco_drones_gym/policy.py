"""Policies trained by `aviary train`."""

from __future__ import annotations

import os
from collections.abc import Mapping
from typing import Any

import numpy as np

from mujoco_drones_gym import _native

__all__ = ["Policy"]


class Policy:
    """A trained policy: a function from observations to actions.

    ```python
    policy = Policy.load("out/policy.safetensors")
    action = policy(observation)
    ```

    Create one with `Policy.load`. A policy that was trained per drone (`info["per_drone"]`) maps the observation of
    each drone to the action of this drone, for any number of drones.

    A recurrent policy (`memory_size > 0`) has a memory of the earlier observations of an episode, which the caller
    keeps between the steps. Without a state, every drone begins with an empty memory:

    ```python
    state = None
    while not done:
        action, state = policy.predict(observation, state)
    ```

    Attributes:
        info: Metadata: `task`, `drone`, `action_type`, `ctrl_freq` and so on.
        observation_size: Number of entries of an observation, or of that of one drone.
        action_size: Number of entries of an action, or of that of one drone.
        memory_size: Number of entries of the memory, or of that of one drone; 0 for a policy without memory.
    """

    def __init__(self, native: _native.Policy):
        self._native = native
        self.info: dict[str, Any] = native.info()
        self.observation_size: int = native.observation_size
        self.action_size: int = native.action_size
        self.memory_size: int = native.memory_size

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> Policy:
        """Reads a policy from a file, such as `policy.safetensors`.

        Raises:
            OSError: if the system cannot read the file, for example FileNotFoundError.
            ValueError: if the file is not a policy.
        """
        return cls(_native.Policy(os.fspath(path)))

    def __call__(self, observation: Any) -> Any:
        """Returns the deterministic actions for observations. A recurrent policy needs `predict`.

        Args:
            observation: Observation or observations, shape (..., n). Of a dict with images, the entry `kin` counts. A
                dict of agents gives a dict of their actions.

        Returns:
            Actions, float32, shape (..., m), within the bounds of the action space.

        Raises:
            ValueError: for a wrong shape, and for a recurrent policy.
        """
        if self.memory_size:
            raise ValueError("the policy is recurrent, expected `predict`, which takes and returns its state")
        return self._act(observation, None, None)[0]

    def _act(self, observation: Any, state: Any, episode_start: Any) -> tuple[Any, Any]:
        """Returns the actions, and the next state of a recurrent policy."""
        if isinstance(observation, Mapping):
            if "kin" in observation:
                return self._act(observation["kin"], state, episode_start)
            states = {} if state is None else state
            acted = {
                agent: self._act(
                    own,
                    states.get(agent),
                    episode_start.get(agent) if isinstance(episode_start, Mapping) else episode_start,
                )
                for agent, own in observation.items()
            }
            actions = {agent: action for agent, (action, _) in acted.items()}
            return actions, {agent: own for agent, (_, own) in acted.items()} if self.memory_size else None
        observation = np.asarray(observation, dtype=np.float64)
        size, per_drone = self.observation_size, self.info["per_drone"]
        last = observation.shape[-1] if observation.ndim else 0
        if last == 0 or (last % size if per_drone else last != size):
            expected = f"a multiple of {size}" if per_drone else size
            raise ValueError(f"observation has the shape {observation.shape}, expected (..., n) with n {expected}")
        drones = last // size
        memory_shape = (*observation.shape[:-1], drones * self.memory_size)
        if state is None or not self.memory_size:
            memory = np.zeros(memory_shape, dtype=np.float32)
        else:
            memory = np.array(state, dtype=np.float32)
            if memory.shape != memory_shape:
                raise ValueError(f"state has the shape {memory.shape}, expected {memory_shape}")
        if self.memory_size and episode_start is not None:
            memory[np.broadcast_to(np.asarray(episode_start, dtype=bool), memory_shape[:-1])] = 0.0
        actions, memory = self._native.act(
            np.ascontiguousarray(observation).reshape(-1), np.ascontiguousarray(memory).reshape(-1)
        )
        actions = actions.reshape((*observation.shape[:-1], drones * self.action_size))
        return actions, memory.reshape(memory_shape) if self.memory_size else None

    def predict(
        self,
        observation: Any,
        state: Any = None,
        episode_start: Any = None,
        deterministic: bool = True,
    ) -> tuple[Any, Any]:
        """Returns the actions and the next state, as models of Stable-Baselines3 do.

        The actions are always deterministic.

        Args:
            observation: As for a call.
            state: State that the last step of the episode has returned, of the shape (..., drones · memory_size); None
                for empty memories. A policy without memory ignores it.
            episode_start: Mask of the observations that begin an episode, whose memories are cleared; shape (...).

        Returns:
            Actions, and the next state; None for a policy without memory.

        Raises:
            ValueError: for a wrong shape.
        """
        return self._act(observation, state, episode_start)

    def check(self, env: Any) -> None:
        """Checks that the policy can fly an environment, or a vector environment.

        Raises:
            ValueError: if the sizes of observation or action differ.
        """
        spaces = [
            getattr(env, f"single_{kind}_space", None) or getattr(env, f"{kind}_space")
            for kind in ("observation", "action")
        ]
        observation, action = spaces
        observation = observation["kin"] if hasattr(observation, "spaces") else observation
        drones = getattr(getattr(env, "unwrapped", env), "NUM_DRONES", 1) if self.info["per_drone"] else 1
        own = (drones * self.observation_size, drones * self.action_size)
        theirs = (observation.shape[-1], action.shape[-1])
        if own != theirs:
            raise ValueError(
                f"the policy has {own[0]} observations and {own[1]} actions ({self.info['action_type']}), "
                f"the environment {theirs[0]} and {theirs[1]}"
            )

    def __repr__(self) -> str:
        return f"<Policy {self.info['task']}: {self.observation_size} observations, {self.action_size} actions>"

    def __reduce__(self):
        return _from_bytes, (self._native.to_bytes(),)


def _from_bytes(data: bytes) -> Policy:
    return Policy(_native.Policy.from_bytes(data))
