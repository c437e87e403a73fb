"""The environment without a task, and the base of the tasks."""

from __future__ import annotations

import math
import os
from collections.abc import Mapping
from copy import deepcopy
from enum import Enum
from typing import Any, ClassVar

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from gymnasium.error import ResetNeeded
from gymnasium.logger import warn

from mujoco_drones_gym import _layout, _native, _opengl
from mujoco_drones_gym._options import (
    Render,
    check_render_mode,
    native_options,
    randomization_options,
    wind_options,
)
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

_NOT_COPIED = ("_env", "_viewer", "_np_random")


class BaseAviary(gym.Env):
    """Drones in one world: motor speeds in, states out. The tasks are subclasses.

    Observation, float32 (20 N,), per drone: position (m), quaternion (w, x, y, z), roll, pitch, yaw (rad), velocity
    (m/s), angular velocity in the body frame (rad/s), and the motor speeds (rpm) of the last step. Action, float32 (4
    N,): motor speeds in [0, `MAX_RPM`] rpm, clipped. The reward is 0, and an episode ends only at `episode_seconds`.

    A task in Python is a subclass that overrides some of `_computeObs`, `_computeReward`, `_computeTerminated`,
    `_computeTruncated`, `_computeInfo`, `_preprocessAction`, `_observationSpace` and `_actionSpace`.

    Args:
        drone_model: Airframe: a `DroneModel` or its value, the path of a TOML file, or a dict with the keys of such a
            file.
        num_drones: Number of drones, N; None for the default of the task.
        neighbourhood_radius: Distance within which drones are neighbours, m.
        initial_xyzs: Initial positions, world frame, m, (N, 3); None for the task's.
        initial_rpys: Initial roll, pitch and yaw, rad, (N, 3); None for zeros.
        physics: Physics mode: a `Physics` or its value.
        sim_freq: Physics rate, Hz, a multiple of the control rate.
        ctrl_freq: Control rate, Hz.
        gui: True to show the flight in a window, which needs a display and matplotlib.
        obstacles: False, True, an `ObstacleConfig`, a dict with the keys of the section `[obstacles]`, or a list of
            `Obstacle`.
        vision_attributes: True for the attributes `rgb`, `dep` and `seg`, the images of the onboard cameras.
        obs_type: Parts of an observation: an `ObservationType` or its value.
        act_type: Action type: an `ActionType` or its value.
        output_folder: Directory that receives the flight of every episode as CSV files; None for no files.
        render_mode: "rgb_array", with which `render` returns images, or None.
        episode_seconds: Time limit of an episode, s; None for the task's.
        wind: A `WindConfig`, a dict with the keys of the section `[wind]`, or None for still air.
        randomization: A `DomainRandomizationConfig`, a dict with the groups of the section `[randomization]`, True for
            the paper's ranges, or None.
        engine: "mujoco" or "hybrid", which computes the same flight many times faster; None for "mujoco".
        stream: Index of the random stream of the seed.
        width: Width of the images of `render`, pixels.
        height: Height of the images of `render`, pixels.

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
        EPISODE_LEN_SEC: Time limit of an episode, s.
        NEIGHBOURHOOD_RADIUS: Distance within which drones are neighbours, m.
        KF: Thrust coefficient of a rotor, N/rpm².
        KM: Torque coefficient of a rotor, N·m/rpm².
        L: Distance of the motors from the centre, m.
        DRONE_MODEL, PHYSICS, OBS_TYPE, ACT_TYPE: The options.

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

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": 48}  # noqa: RUF012

    #: Name of the task in the simulator.
    TASK: ClassVar[str] = "base"

    #: True for a subclass that overrides one of the hooks.
    _has_hooks: ClassVar[bool] = False

    def __init_subclass__(cls, **kwargs: Any) -> None:
        super().__init_subclass__(**kwargs)
        cls._has_hooks = any(getattr(cls, name) is not getattr(BaseAviary, name) for name in _HOOKS)

    def __init__(
        self,
        *,
        drone_model: DroneModel | str | os.PathLike[str] | Mapping[str, Any] = DroneModel.CF2X,
        num_drones: int | None = None,
        neighbourhood_radius: float = math.inf,
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
        }
        self._build(options, getattr(self, "_task_options", {}))

    def _build(self, options: dict[str, Any], task_options: dict[str, Any]) -> None:
        """Creates the simulation. `task_options` are the options of the task."""
        self._options = options
        self._task_options = task_options
        env, render = self._simulation()
        self.render_mode = check_render_mode(render.mode)
        self._viewer = None
        if render.gui:
            from mujoco_drones_gym._viewer import Viewer

            self._viewer = Viewer()
        self._env = env
        self._frame_size = (render.width, render.height)
        self._has_vision = render.vision_attributes
        self._is_seeded = False
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
        self.NEIGHBOURHOOD_RADIUS = float(options["neighbourhood_radius"])
        self.EPISODE_LEN_SEC: float = constants["episode_steps"] * self.CTRL_TIMESTEP
        self.KF: float = constants["airframe"]["thrust_coefficient"]
        self.KM: float = constants["airframe"]["torque_coefficient"]
        self.L: float = constants["airframe"]["arm_length"]
        self.metadata = {**self.metadata, "render_fps": self.CTRL_FREQ}
        self._commands_motors: bool = constants["action_type"] == "raw_rpm"
        self.observation_space = self._observationSpace()
        self.action_space = self._actionSpace()

    def _simulation(self) -> tuple[_native.Env, Render]:
        _, native, render = native_options(self.TASK, {**self._options, **self._task_options}, single=True)
        _opengl.prepare()
        return _native.Env(self.TASK, native, render.output_folder), render

    def _present_starts(self) -> tuple[bytes, bytes]:
        """Returns the numbers of `INIT_XYZS` and `INIT_RPYS`, which a user may have changed."""
        try:
            return np.asarray(self.INIT_XYZS).tobytes(), np.asarray(self.INIT_RPYS).tobytes()
        except ValueError:
            # lists of different lengths, which the constructor refuses
            return b"", b""

    def _change_starts(self) -> None:
        """Replaces the simulation by one with the present `INIT_XYZS` and `INIT_RPYS`."""
        before = self._options
        self._options = {**before, "initial_xyzs": deepcopy(self.INIT_XYZS), "initial_rpys": deepcopy(self.INIT_RPYS)}
        try:
            self._env, _ = self._simulation()
        except Exception:
            self._options = before
            raise
        constants = self._env.constants()
        self.INIT_XYZS, self.INIT_RPYS = constants["initial_xyzs"], constants["initial_rpys"]
        self._starts = self._present_starts()
        self._is_seeded = False

    def reset(self, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Starts an episode.

        Args:
            seed: Seed of every random number; None, with which the random streams continue.
            options: Ignored.

        Returns:
            The observation and the info: `time` (s), `success`, `progress` (0 to 1), `position_error` (m), `crashed`.
        """
        if seed is not None:
            seed = _checked_seed(seed)
        if self._present_starts() != self._starts:
            self._change_starts()
        super().reset(seed=seed)
        if seed is None and not self._is_seeded:
            seed = int(self.np_random.integers(2**63))
        obs, info = self._env.reset(seed)
        self._is_seeded = True
        if self._has_hooks:
            self._is_over = False
            self._last = (0.0, False, False, info)
            obs, info = self._computeObs(), self._computeInfo()
        if self._viewer is not None:
            self._viewer.show(self, 0)
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
        if self._has_hooks or self._viewer is not None:
            return self._step_with_hooks(action)
        return self._env.step(action)

    def _step_with_hooks(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        if self._has_hooks:
            if self._is_over:
                raise ResetNeeded("step was called outside an episode, expected a call of reset first")
            action = self._preprocessAction(action)
        obs, reward, terminated, truncated, info = self._env.step(action)
        self._last = (reward, terminated, truncated, info)
        if self._has_hooks:
            terminated, truncated = bool(self._computeTerminated()), bool(self._computeTruncated())
            self._is_over = terminated or truncated
            obs, reward, info = self._computeObs(), float(self._computeReward()), self._computeInfo()
        if self._viewer is not None:
            self._viewer.show(self, 1)
        return obs, reward, terminated, truncated, info

    def render(self, camera_mode: str | None = None) -> np.ndarray | None:
        """Returns an image of the present state.

        Args:
            camera_mode: "track" (the default: follows the drones), "fpv" (onboard), "fixed", "front" or "top".

        Returns:
            Image, uint8 (height, width, 3); None without a render mode.
        """
        if self.render_mode is None and camera_mode is None:
            warn("render was called without a render mode; create the environment with render_mode='rgb_array'")
            return None
        return self._env.render("track" if camera_mode is None else camera_mode, *self._frame_size)

    def close(self) -> None:
        """Closes the window, if there is one."""
        if self._viewer is not None:
            self._viewer.close()
            self._viewer = None

    def set_wind(self, wind: Any) -> None:
        """Sets the wind from now on, also for later episodes.

        Args:
            wind: A `WindConfig`, a dict with the keys of the section `[wind]`, or None for still air. It replaces the
                default wind of a randomization.

        Raises:
            ValueError: next to a range of the wind in the randomization; nothing has changed.
        """
        options = wind_options(wind)
        randomization = self._options["randomization"]
        before, after = (
            randomization_options(randomization, self.CTRL_FREQ, own)
            for own in (wind_options(self._options["wind"]), options)
        )
        # without a moment of two winds
        brings_range = before != after and (options is None or options["model"] == "none")
        if before != after and not brings_range:
            self._env.set_randomization(after)
        self._env.set_wind(options)
        if brings_range:
            self._env.set_randomization(after)
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
        return self._env.drone_params(nth_drone)

    def get_state(self) -> _native.Snapshot:
        """Returns the whole state: drones, motors, wind, sensors, task and random streams. It can be pickled."""
        return self._env.snapshot()

    def set_state(self, state: _native.Snapshot) -> None:
        """Restores a state of `get_state`. Later steps and resets are bit-identical to those after that call.

        Args:
            state: State of this environment, or of one with the same options.

        Raises:
            ValueError: for the state of another kind of environment; nothing has changed.
        """
        self._env.restore(state)
        self._is_seeded = True
        self._is_over = "end" in self._env.info()

    def observation(self) -> Any:
        """Returns the observation of the present state, as the last `reset`, `step` or `set_state` left it."""
        return self._computeObs()

    def metrics(self) -> dict[str, float]:
        """Returns the scalar metrics of the task by name."""
        return self._env.metrics()

    def reference(self, nth_drone: int = 0) -> tuple[np.ndarray, np.ndarray, float]:
        """Returns the reference of a drone: position (m) and velocity (m/s), each (3,), and yaw (rad), world frame."""
        return self._env.reference(nth_drone)

    def drone_rewards(self) -> np.ndarray:
        """Returns the rewards of the drones in the last step, float64 (N,). Their sum is the reward of the step."""
        return self._env.drone_rewards()

    def action_of_rpm(self, rpm: Any) -> np.ndarray:
        """Returns the action, float64, that commands motor speeds.

        Args:
            rpm: Motor speeds, rpm, (N, 4).
        """
        return self._env.action_of_rpm(rpm)

    @property
    def pos(self) -> np.ndarray:
        """Positions, world frame, m, float64 (N, 3)."""
        return self._env.states()[:, 0:3]

    @property
    def quat(self) -> np.ndarray:
        """Attitudes as quaternions (w, x, y, z), body to world frame, float64 (N, 4)."""
        return self._env.states()[:, 3:7]

    @property
    def rpy(self) -> np.ndarray:
        """Roll, pitch and yaw, rad, float64 (N, 3)."""
        return self._env.states()[:, 7:10]

    @property
    def vel(self) -> np.ndarray:
        """Velocities, world frame, m/s, float64 (N, 3)."""
        return self._env.states()[:, 10:13]

    @property
    def ang_v(self) -> np.ndarray:
        """Angular velocities, body frame, rad/s, float64 (N, 3)."""
        return self._env.states()[:, 13:16]

    @property
    def M(self) -> float:
        """Mass of the first drone in this episode, kg."""
        return self._env.mass()

    @property
    def G(self) -> float:
        """Gravity in this episode, m/s²."""
        return self._env.gravity()

    @property
    def GRAVITY(self) -> float:
        """Weight of the first drone in this episode, N."""
        return self.M * self.G

    @property
    def J(self) -> np.ndarray:
        """Inertia matrix of the first drone in this episode, kg·m², float64 (3, 3)."""
        return np.diag(self.drone_params(0)["inertia"])

    @property
    def last_clipped_action(self) -> np.ndarray:
        """Motor speeds of the last step, rpm, float64 (N, 4)."""
        return self._env.states()[:, 16:20]

    @property
    def step_counter(self) -> int:
        """Number of physics steps in this episode."""
        return round(self._env.info()["time"] * self.SIM_FREQ)

    @property
    def rgb(self) -> np.ndarray:
        """Colour images of the onboard cameras, uint8 (N, 48, 64, 4), with `vision_attributes`."""
        return self._vision("rgb")

    @property
    def dep(self) -> np.ndarray:
        """Depth images of the onboard cameras, m, float32 (N, 48, 64), with `vision_attributes`."""
        return self._vision("depth")

    @property
    def seg(self) -> np.ndarray:
        """Indices of the objects in the images of the onboard cameras, int32 (N, 48, 64), with `vision_attributes`."""
        return self._vision("segmentation")[..., 1]

    def _vision(self, name: str) -> np.ndarray:
        if not self._has_vision:
            raise AttributeError("the environment has no images, expected the option vision_attributes=True")
        return self._env.onboard()[name]

    def _getDroneStateVector(self, nth_drone: int) -> np.ndarray:
        """Returns the state of a drone, float64 (20,): pos, quat (w, x, y, z), rpy, vel, ang_v, motor speeds (rpm)."""
        return self._env.state(nth_drone)

    def _getAdjacencyMatrix(self) -> np.ndarray:
        """Returns which drones are within `NEIGHBOURHOOD_RADIUS` of each other, float64 (N, N), 1 on the diagonal."""
        return np.identity(self.NUM_DRONES) + self._env.adjacency(self.NEIGHBOURHOOD_RADIUS)

    def _normalizedActionToRPM(self, action: Any) -> np.ndarray:
        """Returns the motor speeds, rpm, of normalized ones in [-1, 1], an array of the same shape."""
        return self._env.rpm_of_normalized(action).reshape(np.shape(action))

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
        if self._present_starts() != self._starts:
            starts = {"initial_xyzs": self.INIT_XYZS, "initial_rpys": self.INIT_RPYS}
            state["_options"] = {**self._options, **starts}
        return state

    def __setstate__(self, state: dict[str, Any]) -> None:
        own = dict(state)
        self._build(own.pop("_options"), own.pop("_task_options"))
        built = set(self.__dict__)
        self.__dict__.update({name: value for name, value in own.items() if name not in built})


def _member(enum: type[Enum], value: Any) -> Any:
    """Returns the member of an enum with a value; other values, such as the path of an airframe, stay the same."""
    return next((member for member in enum if value in (member, member.value)), value)


def _checked_seed(seed: Any) -> int:
    """Returns a seed as an int, or raises a ValueError."""
    if isinstance(seed, (int, np.integer)) and not isinstance(seed, bool) and 0 <= seed < 2**64:
        return int(seed)
    raise ValueError(f"seed is {seed!r}, expected an integer from 0 to 2^64 - 1")
