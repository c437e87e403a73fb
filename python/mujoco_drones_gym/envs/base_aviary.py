"""The environment without a task, and the base of the tasks."""

from __future__ import annotations

import math
import os
from collections.abc import Mapping
from copy import deepcopy
from enum import Enum
from typing import Any, ClassVar, NamedTuple

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from gymnasium.error import ResetNeeded

from mujoco_drones_gym import _layout, _native, _opengl
from mujoco_drones_gym._config import short
from mujoco_drones_gym._options import (
    Render,
    action_numbers,
    check_reset_options,
    drone_index,
    native_options,
    randomization_options,
    replace_wind,
    seed_of,
    wind_options,
)
from mujoco_drones_gym._window import Rendering, Window, render_modes
from mujoco_drones_gym.envs._readings import Readings
from mujoco_drones_gym.utils.enums import ActionType, DroneModel, ObservationType, Physics

__all__ = ["BaseAviary"]

#: Functions that a subclass may override to write a task in Python.
_HOOKS = (
    "_preprocessAction",
    "_computeObs",
    "_computeReward",
    "_computeTerminated",
    "_computeTruncated",
    "_computeInfo",
)

#: Attributes that a copy does not have.
_NOT_COPIED = ("_env", "_window", "_np_random", "EPISODE_LEN_SEC")

#: Attributes that a copy has from its options, in which a user's changes are.
_OF_OPTIONS = ("INIT_XYZS", "INIT_RPYS")


class _TaskState(NamedTuple):
    """State of an environment whose task is written in Python."""

    snapshot: _native.Snapshot
    is_over: bool
    last: tuple[float, bool, bool, dict[str, Any]]
    np_random: np.random.Generator
    np_random_seed: int | None


class BaseAviary(Rendering, Readings, gym.Env):
    """Drones in one world: motor speeds in, states out. The tasks are subclasses.

    Observation, float32 (20 N,), per drone: position (m), quaternion (w, x, y, z), roll, pitch, yaw (rad), velocity
    (m/s), angular velocity in the body frame (rad/s), and the motor speeds (rpm) of the last step. Action, float32 (4
    N,): motor speeds in [0, `MAX_RPM`] rpm, clipped. The reward is 0, and an episode ends only at `episode_seconds`.

    A task in Python is a subclass that overrides some of `_computeObs`, `_computeReward`, `_computeTerminated`,
    `_computeTruncated`, `_computeInfo`, `_preprocessAction`, `_observationSpace` and `_actionSpace`. It may set
    `EPISODE_LEN_SEC` before or after it calls the constructor of its base. The info of the end of such an episode has
    `end` and `is_success` as well: "completed" if `_computeTerminated` ends it, "time_limit" if `_computeTruncated`
    does, and the info's own `success`. The simulation ends an episode as well: at its time limit, and by the crash
    conditions of the task whose class is extended. Such an end that neither of the two functions reports is a
    truncation, whose `end` is that of the simulation.

    Args:
        drone_model: Airframe: a `DroneModel` or its value, the path of a TOML file, or a dict with the keys of such a
            file.
        num_drones: Number of drones, N; None for the default of the task.
        neighbourhood_radius: Distance within which drones are neighbours, m; None for any distance.
        initial_xyzs: Initial positions, world frame, m, (N, 3); None for the task's.
        initial_rpys: Initial roll, pitch and yaw, rad, (N, 3); None for zeros.
        physics: Physics mode: a `Physics` or its value.
        sim_freq: Physics rate, Hz, a multiple of the control rate.
        ctrl_freq: Control rate, Hz.
        gui: True for the render mode "human".
        obstacles: False, True, an `ObstacleConfig`, a dict with the keys of the section `[obstacles]`, or a list of
            `Obstacle`.
        vision_attributes: True for the attributes `rgb`, `dep` and `seg`, the images of the onboard cameras.
        obs_type: Parts of an observation: an `ObservationType` or its value.
        act_type: Action type: an `ActionType` or its value.
        output_folder: Directory that receives the flight of every episode as CSV files; None for no files.
        render_mode: "rgb_array", with which `render` returns images; "human", with which a window shows the flight in
            real time; or None. The window needs a display.
        episode_seconds: Time limit of an episode, s; None for the task's.
        wind: A `WindConfig`, a dict with the keys of the section `[wind]`, or None for still air.
        randomization: A `DomainRandomizationConfig`, a dict with the groups of the section `[randomization]`, True for
            the paper's ranges, or None.
        engine: "mujoco" or "hybrid", which computes the same flight many times faster; None for "mujoco".
        stream: Index of the random stream of the seed.
        width: Width of the images of `render`, pixels.
        height: Height of the images of `render`, pixels.
        camera: Camera of the images of `render`: "track" (follows the drones), "fpv" (onboard), "fixed", "front" or
            "top".

    Attributes:
        NUM_DRONES: Number of drones, N.
        SIM_FREQ: Physics rate, Hz.
        CTRL_FREQ: Control rate, Hz.
        CTRL_TIMESTEP: Length of a control step, s.
        HOVER_RPM: Motor speed that carries the nominal weight, rpm.
        MAX_RPM: Maximum motor speed, rpm.
        SIM_TIMESTEP: Length of a physics step, s.
        SIM_STEPS_PER_CTRL: Number of physics steps in a control step.
        INIT_XYZS: Initial positions, world frame, m, float64 (N, 3). Changes have an effect from the next reset on.
        INIT_RPYS: Initial roll, pitch and yaw, rad, float64 (N, 3). Changes have an effect from the next reset on.
        EPISODE_LEN_SEC: Time limit of an episode, s. Changes have an effect from the next reset on.
        NEIGHBOURHOOD_RADIUS: Distance within which drones are neighbours, m.
        KF: Thrust coefficient of a rotor, N/rpm².
        KM: Torque coefficient of a rotor, N·m/rpm².
        L: Distance of the motors from the centre, m.
        MAX_THRUST: Thrust of the four rotors at `MAX_RPM`, N.
        THRUST2WEIGHT_RATIO: Maximum thrust over the nominal weight.
        PROP_RADIUS: Radius of a propeller, m.
        GND_EFF_COEFF: Coefficient of the ground effect.
        DRAG_COEFF: Coefficients of the drag along the axes of the body, float64 (3,).
        MAX_SPEED_KMH: Maximum speed of the airframe, km/h.
        action_type: Name of the action type of the simulation. That of `BaseAviary` is "raw_rpm" for `act_type="rpm"`.
        DRONE_MODEL, PHYSICS, OBS_TYPE, ACT_TYPE, OUTPUT_FOLDER: The options.

    Raises:
        ValueError: for an invalid option; the message names it and what is possible.

    Example:
        >>> import numpy as np
        >>> from mujoco_drones_gym import BaseAviary
        >>> env = BaseAviary(num_drones=2)
        >>> obs, info = env.reset(seed=1)
        >>> obs, reward, terminated, truncated, info = env.step(np.full(8, env.HOVER_RPM))
        >>> obs.shape
        (40,)
    """

    metadata: dict[str, Any] = {"render_modes": ["human", "rgb_array"], "render_fps": 48}  # noqa: RUF012

    #: Name of the task in the simulator.
    TASK: ClassVar[str] = "base"

    #: True for a subclass that overrides one of the hooks.
    _has_hooks: ClassVar[bool] = False

    #: True for a subclass that may draw random numbers in an episode.
    _may_draw: ClassVar[bool] = False

    def __init_subclass__(cls, **kwargs: Any) -> None:
        super().__init_subclass__(**kwargs)
        cls._has_hooks = cls._overrides(*_HOOKS)
        cls._may_draw = cls._has_hooks or cls._overrides("reset", "step")

    @classmethod
    def _overrides(cls, *names: str) -> bool:
        return any(getattr(cls, name) is not getattr(BaseAviary, name) for name in names)

    def __init__(
        self,
        *,
        drone_model: DroneModel | str | os.PathLike[str] | Mapping[str, Any] = DroneModel.CF2X,
        num_drones: int | None = None,
        neighbourhood_radius: float | None = math.inf,
        initial_xyzs: Any = None,
        initial_rpys: Any = None,
        physics: Physics | str = Physics.MJC,
        sim_freq: int = 240,
        ctrl_freq: int = 48,
        gui: bool = False,
        obstacles: Any = False,
        vision_attributes: bool = False,
        obs_type: ObservationType | str = ObservationType.KIN,
        act_type: ActionType | str = ActionType.RPM,
        output_folder: str | os.PathLike[str] | None = None,
        render_mode: str | None = None,
        episode_seconds: float | None = None,
        wind: Any = None,
        randomization: Any = None,
        engine: str | None = None,
        stream: int = 0,
        width: int = 640,
        height: int = 480,
        camera: str = "track",
    ) -> None:
        options = {
            "drone_model": drone_model,
            "num_drones": num_drones,
            "neighbourhood_radius": neighbourhood_radius,
            "initial_xyzs": initial_xyzs,
            "initial_rpys": initial_rpys,
            "physics": physics,
            "sim_freq": sim_freq,
            "ctrl_freq": ctrl_freq,
            "gui": gui,
            "obstacles": obstacles,
            "vision_attributes": vision_attributes,
            "obs_type": obs_type,
            "act_type": act_type,
            "output_folder": output_folder,
            "render_mode": render_mode,
            "episode_seconds": episode_seconds,
            "wind": wind,
            "randomization": randomization,
            "engine": engine,
            "stream": stream,
            "width": width,
            "height": height,
            "camera": camera,
        }
        self._build(options, getattr(self, "_task_options", {}))

    def _build(self, options: dict[str, Any], task_options: dict[str, Any]) -> None:
        """Creates the simulation. `task_options` are the options of the task."""
        # a subclass may have set the attribute, or have it as an attribute of the class
        length = getattr(self, "EPISODE_LEN_SEC", None)
        if options["episode_seconds"] is None and length is not None:
            options = {**options, "episode_seconds": _checked_length(length)}
        if options["neighbourhood_radius"] is None:
            options = {**options, "neighbourhood_radius": math.inf}
        self._options = options
        self._task_options = task_options
        env, render = self._simulation()
        self.render_mode = render.mode
        self._env = env
        self._frame_size = (render.width, render.height)
        self._camera = render.camera
        self._has_vision = render.vision_attributes
        self._is_seeded = False
        self._has_episode = False
        self._is_over = True
        self._last: tuple[float, bool, bool, dict[str, Any]] = (0.0, False, False, {})
        constants = env.constants()
        self.NUM_DRONES: int = constants["num_drones"]
        self.SIM_FREQ: int = constants["sim_freq"]
        self.CTRL_FREQ: int = constants["ctrl_freq"]
        self.CTRL_TIMESTEP: float = constants["control_period"]
        self.SIM_TIMESTEP: float = 1.0 / self.SIM_FREQ
        self.SIM_STEPS_PER_CTRL: int = self.SIM_FREQ // self.CTRL_FREQ
        self.DRONE_MODEL = _member(DroneModel, options["drone_model"])
        self.PHYSICS = _member(Physics, options["physics"])
        self.OBS_TYPE = _member(ObservationType, options["obs_type"])
        self.ACT_TYPE = _member(ActionType, options["act_type"])
        self.HOVER_RPM: float = constants["hover_rpm"]
        self.MAX_RPM: float = constants["max_rpm"]
        self.INIT_XYZS: np.ndarray = constants["initial_xyzs"]
        self.INIT_RPYS: np.ndarray = constants["initial_rpys"]
        self._starts = self._present_starts()
        self.OUTPUT_FOLDER: str | None = render.output_folder
        self.NEIGHBOURHOOD_RADIUS = float(options["neighbourhood_radius"])
        self.EPISODE_LEN_SEC: float = constants["episode_steps"] * self.CTRL_TIMESTEP
        self._episode_length = self.EPISODE_LEN_SEC
        airframe = constants["airframe"]
        self.KF: float = airframe["thrust_coefficient"]
        self.KM: float = airframe["torque_coefficient"]
        self.L: float = airframe["arm_length"]
        self.MAX_THRUST: float = 4.0 * self.KF * self.MAX_RPM**2
        self.THRUST2WEIGHT_RATIO: float = airframe["thrust_to_weight"]
        self.PROP_RADIUS: float = airframe["propeller_radius"]
        self.GND_EFF_COEFF: float = airframe["ground_effect_coefficient"]
        self.DRAG_COEFF: np.ndarray = np.array(airframe["drag_coefficients"])
        self.MAX_SPEED_KMH: float = airframe["max_speed"] * 3.6
        self._window = Window(type(self).__name__, self.CTRL_TIMESTEP) if render.mode == "human" else None
        modes = render_modes(self.metadata, render.mode)
        self.metadata = {**self.metadata, "render_modes": modes, "render_fps": self.CTRL_FREQ}
        self.action_type: str = constants["action_type"]
        self.observation_space = self._observationSpace()
        self.action_space = self._actionSpace()

    def _simulation(self) -> tuple[_native.Env, Render]:
        _, native, render = native_options(
            self.TASK, {**self._options, **self._task_options}, single=True, has_window=True
        )
        _opengl.prepare()
        return _native.Env(self.TASK, native, render.output_folder), render

    def _present_starts(self) -> tuple[bytes, bytes]:
        """Returns the numbers of `INIT_XYZS` and `INIT_RPYS`, which a user may have changed."""
        try:
            return np.asarray(self.INIT_XYZS).tobytes(), np.asarray(self.INIT_RPYS).tobytes()
        except ValueError:
            # lists of different lengths, which the constructor refuses
            return b"", b""

    def _changed_options(self) -> dict[str, Any]:
        """Returns the options whose attributes a user has changed since the last reset, with the present values."""
        changed: dict[str, Any] = {}
        if self._present_starts() != self._starts:
            changed.update(initial_xyzs=deepcopy(self.INIT_XYZS), initial_rpys=deepcopy(self.INIT_RPYS))
        length = self.EPISODE_LEN_SEC
        if length is not self._episode_length and _checked_length(length) != self._episode_length:
            changed["episode_seconds"] = float(length)
        return changed

    def _change_options(self, changed: dict[str, Any]) -> None:
        """Replaces the simulation by one with other values of some options."""
        before = self._options
        self._options = {**before, **changed}
        try:
            self._env, _ = self._simulation()
        except Exception:
            self._options = before
            raise
        constants = self._env.constants()
        self.INIT_XYZS, self.INIT_RPYS = constants["initial_xyzs"], constants["initial_rpys"]
        self._starts = self._present_starts()
        self.EPISODE_LEN_SEC = self._episode_length = constants["episode_steps"] * self.CTRL_TIMESTEP
        self._is_seeded = self._has_episode = False

    def reset(self, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Starts an episode.

        Args:
            seed: Seed of every random number; None, with which the random streams continue.
            options: Ignored.

        Returns:
            The observation and the info: `time` (s), `success`, `progress` (0 to 1), `position_error` (m), `crashed`.
        """
        seed = seed_of(seed)
        check_reset_options(options)
        changed = self._changed_options()
        if changed:
            self._change_options(changed)
        super().reset(seed=seed)
        if seed is None and not self._is_seeded:
            seed = int(self.np_random.integers(2**63))
        obs, info = self._env.reset(seed)
        self._is_seeded = self._has_episode = True
        if self._has_hooks:
            self._is_over = False
            self._last = (0.0, False, False, info)
            obs, info = self._computeObs(), self._computeInfo()
        if self._window is not None:
            self._window.reset(self._env)
        return obs, info

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Advances the simulation by one control step.

        Args:
            action: Action of the shape of `action_space`, clipped to its bounds. float64 is taken at full precision.

        Returns:
            The observation, the reward, True if the task has ended the episode, True if the time limit has ended it,
            and the info of `reset`, with `end` and `is_success` in the last step of an episode.

        Raises:
            ValueError: for an action of another size, or with a number that is not finite; nothing has moved.
            gymnasium.error.ResetNeeded: before the first reset and after the end of an episode.
        """
        if self._has_hooks or self._window is not None:
            return self._step_with_hooks(action)
        if type(action) is not np.ndarray or action.dtype.char not in "fd":
            action = action_numbers("action", action, self.action_space.shape)
        return self._env.step(action)

    def _step_with_hooks(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        if self._has_hooks:
            if self._is_over:
                raise ResetNeeded("step was called outside an episode, expected a call of reset first")
            action = self._preprocessAction(action)
        action = action_numbers("action", action, self.action_space.shape)
        obs, reward, terminated, truncated, info = self._env.step(action)
        self._last = (reward, terminated, truncated, info)
        if self._has_hooks:
            terminated, truncated = bool(self._computeTerminated()), bool(self._computeTruncated())
            end = "completed" if terminated else "time_limit"
            if not (terminated or truncated) and "end" in self._last[3]:
                # the simulation has ended the episode, which cannot continue
                truncated, end = True, self._last[3]["end"]
            self._is_over = terminated or truncated
            obs, reward, info = self._computeObs(), float(self._computeReward()), self._computeInfo()
            if self._is_over and isinstance(info, dict):
                success = bool(info.get("success", self._last[3]["success"]))
                info = {**info, "end": info.get("end") or end}
                info.setdefault("is_success", success)
        if self._window is not None:
            self._window.step(self._env)
        return obs, reward, terminated, truncated, info

    def close(self) -> None:
        """Closes the window, and ends the files of the episode in the output folder. The next `reset` opens others."""
        if self._window is not None:
            self._window.close()
        self._env.close()

    def set_wind(self, wind: Any) -> None:
        """Sets the wind from now on, also for later episodes.

        Args:
            wind: A `WindConfig`, a dict with the keys of the section `[wind]`, or None for still air. It replaces the
                default wind of a randomization.

        Raises:
            ValueError: next to a range of the wind in the randomization; nothing has changed.
        """
        replace_wind(self._env, wind_options(wind), self._options["randomization"], self.CTRL_FREQ)
        self._options["wind"] = wind

    def set_randomization(self, randomization: Any) -> None:
        """Sets the parameters that are sampled for every episode from the next reset on.

        Args:
            randomization: A `DomainRandomizationConfig`, a dict of groups, True for the paper's ranges, or None.
        """
        wind = wind_options(self._options["wind"])
        self._env.set_randomization(randomization_options(randomization, self.CTRL_FREQ, wind))
        self._options["randomization"] = randomization

    def _set_task_option(self, name: str, value: Any) -> None:
        if value is None:
            raise ValueError(f"{name} is None, expected a number of metres")
        self._env.set_task_options({name: value})
        self._task_options = {**self._task_options, name: value}

    def sampled_params(self) -> dict[str, Any] | None:
        """Returns the sampled parameters of this episode; None without randomization."""
        return self._env.sampled_params()

    def drone_params(self, nth_drone: int = 0) -> dict[str, Any]:
        """Returns the parameters of a drone's airframe in this episode, with the keys of an airframe file."""
        return self._env.drone_params(drone_index(nth_drone, self.NUM_DRONES))

    def get_state(self) -> Any:
        """Returns the whole state: drones, motors, wind, sensors, task and random streams. It can be pickled.

        The state of a task in Python has the random generator `np_random`, and no attributes that the subclass has
        added.

        Raises:
            gymnasium.error.ResetNeeded: before the first reset.
        """
        if not self._has_episode:
            raise ResetNeeded("get_state was called before the first reset, expected a call of reset first")
        snapshot = self._env.snapshot()
        if not self._may_draw:
            return snapshot
        last, generator = deepcopy((self._last, self.np_random))
        return _TaskState(snapshot, self._is_over, last, generator, self._np_random_seed)

    def set_state(self, state: Any) -> None:
        """Restores a state of `get_state`. Later steps and resets are bit-identical to those after that call.

        Args:
            state: State of this environment, or of one with the same options.

        Raises:
            ValueError: for the state of another kind of environment; nothing has changed.
            TypeError: for an object of another type.
        """
        own = state if isinstance(state, _TaskState) else None
        snapshot = state if own is None else own.snapshot
        if not isinstance(snapshot, _native.Snapshot):
            raise TypeError(f"state is {short(state)}, expected a result of get_state")
        self._env.restore(snapshot)
        self._is_seeded = self._has_episode = True
        info = self._env.info()
        self._is_over, self._last = "end" in info, (0.0, False, False, info)
        if own is not None:
            self._is_over, self._last = own.is_over, deepcopy(own.last)
            self._np_random, self._np_random_seed = deepcopy(own.np_random), own.np_random_seed
        # a later copy of the environment has the options of the restored task
        present = self._env.task_options()
        restored = {name: present[name] for name in self._task_options if present.get(name) is not None}
        self._task_options = {**self._task_options, **restored}

    def observation(self) -> Any:
        """Returns the observation of the present state, as the last `reset`, `step` or `set_state` left it."""
        return self._computeObs()

    def metrics(self) -> dict[str, float]:
        """Returns the scalar metrics of the task by name."""
        return self._env.metrics()

    def reference(self, nth_drone: int = 0) -> tuple[np.ndarray, np.ndarray, float]:
        """Returns the reference of a drone: position (m) and velocity (m/s), each (3,), and yaw (rad), world frame."""
        return self._env.reference(drone_index(nth_drone, self.NUM_DRONES))

    def drone_rewards(self) -> np.ndarray:
        """Returns the rewards of the drones in the last step, float64 (N,). Their sum is the reward of the step."""
        return self._env.drone_rewards()

    def reward_terms(self, nth_drone: int = 0) -> dict[str, float]:
        """Returns the terms of the reward of a drone in the last step by name; their sum is the drone's reward.

        Bonuses are positive, penalties negative. The dict is empty before the first step of an episode, and for an
        environment without a task. The terms of a task in Python are those of the task that its class extends.
        """
        return self._env.reward_terms(drone_index(nth_drone, self.NUM_DRONES))

    def action_of_rpm(self, rpm: Any) -> np.ndarray:
        """Returns the action, float64, that commands motor speeds.

        Args:
            rpm: Motor speeds, rpm, (N, 4).
        """
        return self._env.action_of_rpm(action_numbers("rpm", rpm, (self.NUM_DRONES, 4)))

    def _preprocessAction(self, action: Any) -> Any:
        """Returns the action of the simulator for an action of `step`; in `BaseAviary` motor speeds, rpm, (N, 4)."""
        return action

    def _computeObs(self) -> Any:
        """Returns the observation."""
        return self._env.observation()

    def _computeReward(self) -> float:
        """Returns the reward of the last step."""
        return self._last[0]

    def _computeTerminated(self) -> bool:
        """Returns True if the task has ended the episode."""
        return self._last[1]

    def _computeTruncated(self) -> bool:
        """Returns True if the time limit has ended the episode."""
        return self._last[2]

    def _computeInfo(self) -> dict[str, Any]:
        """Returns the info."""
        return self._last[3]

    def _observationSpace(self) -> spaces.Space:
        low, high = self._env.observation_bounds()
        parts: dict[str, spaces.Box] = {"kin": spaces.Box(low, high, dtype=np.float32)} if low.size else {}
        for name, shape in self._env.image_shapes().items():
            parts[name] = _layout.image_space(name, shape)
        return _layout.observation_space(parts)

    def _actionSpace(self) -> spaces.Space:
        low, high = self._env.action_bounds()
        return spaces.Box(low, high, dtype=np.float32)

    def __getstate__(self) -> dict[str, Any]:
        # a copy has the options of the environment and starts without an episode
        state = {name: value for name, value in self.__dict__.items() if name not in _NOT_COPIED}
        state["_np_random_seed"] = None
        state["_options"] = {**self._options, **self._changed_options()}
        return state

    def __setstate__(self, state: dict[str, Any]) -> None:
        own = dict(state)
        options, task_options = own.pop("_options"), own.pop("_task_options")
        # the hooks of a subclass may read attributes of its own while the simulation is built
        self.__dict__.update(own)
        self._build(options, task_options)
        # a subclass may have replaced attributes of its base, such as the spaces
        replaced = {name: value for name, value in own.items() if not name.startswith("_") and name not in _OF_OPTIONS}
        self.__dict__.update(replaced)


def _member(enum: type[Enum], value: Any) -> Any:
    """Returns the member of an enum with a value; other values, such as the path of an airframe, stay the same."""
    return next((member for member in enum if value in (member, member.value)), value)


def _checked_length(seconds: Any) -> float:
    """Returns the time limit of an episode, s."""
    is_number = isinstance(seconds, (int, float, np.integer, np.floating)) and not isinstance(seconds, bool)
    if is_number and 0.0 < seconds < math.inf:
        return float(seconds)
    raise ValueError(f"EPISODE_LEN_SEC is {short(seconds)}, expected a positive number of seconds")
