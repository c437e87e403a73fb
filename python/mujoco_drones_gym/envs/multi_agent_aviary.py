"""Environments with one agent per drone, for PettingZoo."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from gymnasium import spaces
from gymnasium.error import ResetNeeded
from pettingzoo import ParallelEnv

from mujoco_drones_gym import _layout, _native, _opengl
from mujoco_drones_gym._config import short
from mujoco_drones_gym._options import (
    action_numbers,
    check_reset_options,
    drone_index,
    native_options,
    randomization_options,
    replace_wind,
    seed_of,
    wind_options,
)
from mujoco_drones_gym._states import DroneStates
from mujoco_drones_gym._window import Rendering, Window, render_modes

__all__ = ["MultiAgentAviary", "parallel_env"]

#: Attributes that a copy does not have.
_NOT_COPIED = ("_env", "_window", "_has_episode", "_stepped", "agents")


class MultiAgentAviary(Rendering, DroneStates, ParallelEnv):
    """A task in which every drone is an agent with its own observation, action, reward and end.

    The agents are `drone0`, `drone1`, ... An agent leaves when its episode ends. Its drone stays in the simulation with
    its motors off, or hovers if it has completed its part of the task.

    Args:
        num_drones: Number of drones; default that of the task.
        task: Name of the task; default the paper's `multi_agent`, in which every drone hovers at its own height.
        options: Options of the single environment: `physics`, `obs_type`, `act_type`, `wind`, `render_mode`, ...

    Example:
        >>> from mujoco_drones_gym import MultiAgentAviary
        >>> env = MultiAgentAviary(num_drones=3)
        >>> obs, infos = env.reset(seed=1)
        >>> actions = {agent: env.action_space(agent).sample() for agent in env.agents}
        >>> obs, rewards, terminations, truncations, infos = env.step(actions)
        >>> obs["drone0"].shape
        (13,)
    """

    def __init__(self, num_drones: int | None = None, *, task: str = "multi_agent", **options: Any) -> None:
        self._arguments = dict(options, num_drones=num_drones, task=task)
        if num_drones is not None:
            options["num_drones"] = num_drones
        task, native, render = native_options(task, options, has_window=True)
        self.render_mode = render.mode
        self._frame_size = (render.width, render.height)
        self._camera = render.camera
        _opengl.prepare()
        self._env = _native.Parallel(task, native)
        self._has_episode = False
        self.task = task
        constants = self._env.constants()
        self.NUM_DRONES: int = constants["num_drones"]
        self.SIM_FREQ: int = constants["sim_freq"]
        self.CTRL_FREQ: int = constants["ctrl_freq"]
        self.CTRL_TIMESTEP = 1.0 / self.CTRL_FREQ
        self.HOVER_RPM: float = constants["hover_rpm"]
        self.MAX_RPM: float = constants["max_rpm"]
        #: Name of the action type.
        self.action_type: str = constants["action_type"]
        # the agents of the last step
        self._stepped: list[str] = []
        self._window = Window(type(self).__name__, self.CTRL_TIMESTEP) if render.mode == "human" else None
        self.metadata = {
            "name": f"{task}_v0",
            "render_modes": render_modes({"render_modes": ["human", "rgb_array"]}, render.mode),
            "render_fps": self.CTRL_FREQ,
            "is_parallelizable": True,
        }
        self.possible_agents: list[str] = self._env.possible_agents
        self.agents: list[str] = []
        self.observation_spaces = {agent: self._observation_space(agent) for agent in self.possible_agents}
        self.action_spaces = {
            agent: spaces.Box(*self._env.action_bounds(agent), dtype=np.float32) for agent in self.possible_agents
        }
        self.state_space = spaces.Box(-np.inf, np.inf, (12 * self.NUM_DRONES,), np.float32)

    def _observation_space(self, agent: str) -> spaces.Space:
        low, high = self._env.observation_bounds(agent)
        parts = {"kin": spaces.Box(low, high, dtype=np.float32)} if low.size else {}
        for name, shape in self._env.image_shapes(agent).items():
            parts[name] = _layout.image_space(name, tuple(shape))
        return _layout.observation_space(parts)

    def observation_space(self, agent: str) -> spaces.Space:
        """Returns the observation space of an agent, the same object every time."""
        return self.observation_spaces[agent]

    def action_space(self, agent: str) -> spaces.Space:
        """Returns the action space of an agent, the same object every time."""
        return self.action_spaces[agent]

    def reset(
        self, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Any], dict[str, dict[str, Any]]]:
        """Starts an episode with all agents.

        Args:
            seed: Seed of every random stream; None, with which the random streams continue.
            options: Ignored.

        Returns:
            The observations and the infos by agent.
        """
        seed = seed_of(seed)
        check_reset_options(options)
        if seed is None and not self._has_episode:
            seed = int(np.random.default_rng().integers(2**63))
        observations, infos = self._env.reset(seed)
        self.agents = self._env.agents
        self._has_episode = True
        self._stepped = []
        if self._window is not None:
            self._window.reset(self._env)
        return self._packed(observations), infos

    def step(
        self, actions: dict[str, Any]
    ) -> tuple[dict[str, Any], dict[str, float], dict[str, bool], dict[str, bool], dict[str, dict[str, Any]]]:
        """Advances the environment by one control step.

        Args:
            actions: An action for every live agent, clipped to the bounds of its action space.

        Returns:
            The observations, rewards, terminations, truncations and infos by agent, for every agent that was live
            before the step. Five empty dicts if no agent was live and none acts.
        """
        if not isinstance(actions, Mapping):
            raise ValueError(f"actions is {short(actions)}, expected a dict with an action for every live agent")
        if not self.agents:
            if not self._has_episode:
                raise ResetNeeded("step was called on a new environment, expected a call of reset first")
            if actions:
                raise ResetNeeded("step was called after the end of the episode, expected a call of reset first")
            return {}, {}, {}, {}, {}
        own = {}
        for agent, action in actions.items():
            if agent not in self.action_spaces:
                name = agent if isinstance(agent, str) else short(agent)
                expected = f"one for each of: {', '.join(self.agents)}"
                raise ValueError(f"unexpected action for the agent `{name}`, expected {expected}")
            own[agent] = action_numbers(f"action of {agent}", action, self.action_spaces[agent].shape)
        try:
            observations, rewards, terminations, truncations, infos = self._env.step(own)
        finally:
            self.agents = self._env.agents
        self._stepped = list(rewards)
        if self._window is not None:
            self._window.step(self._env)
        return self._packed(observations), rewards, terminations, truncations, infos

    def state(self) -> np.ndarray:
        """Returns the states of all drones, float32 (12 N,).

        The numbers of a drone are its position (m), roll, pitch and yaw (rad), velocity (m/s), and angular velocity in
        the body frame (rad/s).
        """
        return self._env.state().astype(np.float32)

    def close(self) -> None:
        """Ends the episode, and closes the window, if there is one. The next `reset` opens another one."""
        self.agents = []
        if self._window is not None:
            self._window.close()

    def set_wind(self, wind: Any) -> None:
        """Sets the wind from now on, also for later episodes.

        Args:
            wind: A `WindConfig`, a dict with the keys of the section `[wind]`, or None for still air. It replaces the
                default wind of a randomization.

        Raises:
            ValueError: next to a range of the wind in the randomization; nothing has changed.
        """
        replace_wind(self._env, wind_options(wind), self._arguments.get("randomization"), self.CTRL_FREQ)
        self._arguments["wind"] = wind

    def set_randomization(self, randomization: Any) -> None:
        """Sets the parameters that are sampled for every episode from the next reset on.

        Args:
            randomization: A `DomainRandomizationConfig`, a dict of groups, True for the paper's ranges, or None.
        """
        wind = wind_options(self._arguments.get("wind"))
        self._env.set_randomization(randomization_options(randomization, self.CTRL_FREQ, wind))
        self._arguments["randomization"] = randomization

    def sampled_params(self) -> dict[str, Any] | None:
        """Returns the sampled parameters of this episode; None without randomization."""
        return self._env.sampled_params()

    def metrics(self) -> dict[str, float]:
        """Returns the scalar metrics of the task by name."""
        return self._env.metrics()

    def reward_terms(self, agent: str) -> dict[str, float]:
        """Returns the terms of the reward of an agent in the last step by name; their sum is the reward of the agent.

        Bonuses are positive, penalties negative. The dict is empty before the first step of an episode, and for an
        agent that has left before the last step.
        """
        if agent not in self.possible_agents:
            expected = f"one of {', '.join(self.possible_agents)}"
            raise ValueError(f"agent is {short(agent)}, expected {expected}")
        return self._env.reward_terms(self.possible_agents.index(agent)) if agent in self._stepped else {}

    def drone_params(self, nth_drone: int = 0) -> dict[str, Any]:
        """Returns the parameters of a drone's airframe in this episode, with the keys of an airframe file."""
        return self._env.drone_params(drone_index(nth_drone, self.NUM_DRONES))

    def _states(self) -> np.ndarray:
        return self._env.states()

    def _batteries(self) -> np.ndarray:
        return self._env.batteries()

    @property
    def M(self) -> float:
        """Mass of the first drone in this episode, kg."""
        return self._env.constants()["mass"]

    @property
    def G(self) -> float:
        """Gravity in this episode, m/s²."""
        return self._env.constants()["gravity"]

    def _getDroneStateVector(self, nth_drone: int) -> np.ndarray:
        """Returns the state of a drone, float64 (20,): pos, quat (w, x, y, z), rpy, vel, ang_v, motor speeds (rpm)."""
        return self._states()[drone_index(nth_drone, self.NUM_DRONES)]

    def _packed(self, observations: dict[str, dict[str, Any]]) -> dict[str, Any]:
        return {agent: _layout.pack(parts) for agent, parts in observations.items()}

    def __getstate__(self) -> dict[str, Any]:
        # a copy has the options of the environment and starts without an episode
        return {name: value for name, value in self.__dict__.items() if name not in _NOT_COPIED}

    def __setstate__(self, state: dict[str, Any]) -> None:
        own = dict(state)
        MultiAgentAviary.__init__(self, **own.pop("_arguments"))
        self.__dict__.update(own)


def parallel_env(task: str = "multi_agent", **options: Any) -> MultiAgentAviary:
    """Creates the environment of a task with one agent per drone.

    Args:
        task: Name of the task, such as "antipodal".
        options: Options of `MultiAgentAviary`.
    """
    return MultiAgentAviary(task=task, **options)
