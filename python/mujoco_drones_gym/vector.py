"""Batches of environments as Gymnasium vector environments."""

from __future__ import annotations

import importlib
import operator
from collections.abc import Sequence
from functools import cache, cached_property, partial
from typing import Any

import numpy as np
from gymnasium import spaces
from gymnasium.error import ClosedEnvironmentError, ResetNeeded
from gymnasium.logger import warn
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

from mujoco_drones_gym import _layout, _native, _opengl
from mujoco_drones_gym._config import short
from mujoco_drones_gym._options import (
    action_numbers,
    camera_of,
    check_reset_options,
    drone_index,
    flag,
    integer,
    native_options,
    numbers,
    randomization_options,
    replace_wind,
    seed_of,
    wind_options,
)
from mujoco_drones_gym._states import DroneStates

__all__ = ["VectorAviary", "VectorMember"]

_AUTORESET = {
    AutoresetMode.NEXT_STEP: "next_step",
    AutoresetMode.SAME_STEP: "same_step",
    AutoresetMode.DISABLED: "disabled",
}


#: Longest episode, s.
_LONGEST = 39_999_999

#: Names of the reasons why an episode ends; the last entry is that of an episode that has not ended.
_ENDS = np.array([*_native.END_REASONS, None], object)


#: Attributes of a batch that a copy does not have.
_NOT_COPIED = ("_batch", "_images", "_started", "_np_random", "_np_random_seed", "num_threads", "closed")

#: Attributes that a single environment gets from its constructor, apart from those of its class.
SINGLE_ATTRIBUTES = frozenset(
    [
        "NUM_DRONES",
        "SIM_FREQ",
        "CTRL_FREQ",
        "CTRL_TIMESTEP",
        "SIM_TIMESTEP",
        "SIM_STEPS_PER_CTRL",
        "DRONE_MODEL",
        "PHYSICS",
        "OBS_TYPE",
        "ACT_TYPE",
        "HOVER_RPM",
        "MAX_RPM",
        "INIT_XYZS",
        "INIT_RPYS",
        "OUTPUT_FOLDER",
        "NEIGHBOURHOOD_RADIUS",
        "EPISODE_LEN_SEC",
        "KF",
        "KM",
        "L",
        "MAX_THRUST",
        "THRUST2WEIGHT_RATIO",
        "PROP_RADIUS",
        "GND_EFF_COEFF",
        "DRAG_COEFF",
        "MAX_SPEED_KMH",
        "action_type",
        "render_mode",
        "metadata",
        "observation_space",
        "action_space",
    ]
)


@cache
def single_attributes(task: str) -> frozenset[str]:
    """Returns the names of the attributes and methods of the single environments of a task."""
    module = "base" if task in ("base", "multi_agent") else task
    name = "".join(part.capitalize() for part in module.split("_")) + "Aviary"
    cls = getattr(importlib.import_module(f"mujoco_drones_gym.envs.{module}_aviary"), name)
    return SINGLE_ATTRIBUTES | {name for name in dir(cls) if not name.startswith("__")}


def autoreset_mode_of(value: AutoresetMode | str) -> AutoresetMode:
    """Returns the autoreset mode of a member of the enum, of its value ("NextStep") or of its name ("next_step")."""
    if isinstance(value, AutoresetMode):
        return value
    for mode, name in _AUTORESET.items():
        if isinstance(value, str) and value.lower() in (mode.value.lower(), name):
            return mode
    expected = ", ".join(repr(mode.value) for mode in _AUTORESET)
    raise ValueError(f"autoreset_mode is {short(value)}, expected one of {expected}")


class _Closed:
    """Stands in for the batch of a closed environment."""

    def __getattr__(self, name: str) -> Any:
        raise ClosedEnvironmentError("this VectorAviary is closed, expected a new one")


class _Conditions:
    """Wind and randomization of one environment of a batch."""

    def __init__(self, batch: Any, index: int) -> None:
        self.set_wind = partial(batch.set_wind, index)
        self.set_randomization = partial(batch.set_randomization, index)


class VectorMember(DroneStates):
    """One environment of a `VectorAviary`, for reading its state and changing its wind, randomization and targets.

    It keeps attributes of your own. An attribute of a single environment that a batch cannot change is an
    AttributeError.

    Args:
        env: The vector environment.
        index: Index of the environment in it.
    """

    __slots__ = ("_env", "_index")

    def __init__(self, env: VectorAviary, index: int) -> None:
        object.__setattr__(self, "_env", env)
        object.__setattr__(self, "_index", index)

    def __getattr__(self, name: str) -> Any:
        # called for names that the class does not have
        if not name.startswith("__") and name not in self.__slots__:
            attributes = self._env._attributes.get(self._index, {})
            if name in attributes:
                return attributes[name]
        raise AttributeError(f"an environment of a VectorAviary has no attribute {name!r}")

    def __setattr__(self, name: str, value: Any) -> None:
        own = getattr(type(self), name, None)
        if isinstance(own, property) and own.fset:
            object.__setattr__(self, name, value)
            return
        if own is not None or name in single_attributes(self._env.task):
            expected = "expected an option of VectorAviary, TARGET_HEIGHT, TARGET_HEIGHTS, or an attribute of your own"
            raise AttributeError(f"the attribute {name!r} of an environment cannot be set, {expected}")
        self._env._attributes.setdefault(self._index, {})[name] = value

    def _changed(self, name: str) -> Any:
        """Returns the present value of an option that can be changed."""
        changes = self._env._changes.get(self._index, {})
        return changes[name] if name in changes else self._env._arguments.get(name)

    def _note(self, name: str, value: Any) -> None:
        """Keeps the changed value of an option for copies of the batch."""
        self._env._changes.setdefault(self._index, {})[name] = value

    def _set_target(self, name: str, value: Any) -> None:
        if value is None:
            raise ValueError(f"{name} is None, expected a number of metres")
        self._env._batch.set_task_options(self._index, {name: value})
        self._note(name, value)

    @property
    def observation_space(self) -> spaces.Space:
        """Observation space of one environment."""
        return self._env.single_observation_space

    @property
    def action_space(self) -> spaces.Space:
        """Action space of one environment."""
        return self._env.single_action_space

    @property
    def render_mode(self) -> str | None:
        """Render mode of the vector environment."""
        return self._env.render_mode

    @property
    def metadata(self) -> dict[str, Any]:
        """Metadata of the vector environment."""
        return self._env.metadata

    @property
    def spec(self) -> Any:
        """Specification of the vector environment."""
        return self._env.spec

    @property
    def NUM_DRONES(self) -> int:
        """Number of drones."""
        return self._env.NUM_DRONES

    @property
    def SIM_FREQ(self) -> int:
        """Physics rate, Hz."""
        return self._env.SIM_FREQ

    @property
    def CTRL_FREQ(self) -> int:
        """Control rate, Hz."""
        return self._env.CTRL_FREQ

    @property
    def CTRL_TIMESTEP(self) -> float:
        """Length of a control step, s."""
        return self._env.CTRL_TIMESTEP

    @property
    def action_type(self) -> str:
        """Name of the action type."""
        return self._env.action_type

    @property
    def HOVER_RPM(self) -> float:
        """Motor speed that carries the nominal weight, rpm."""
        return self._env.HOVER_RPM

    @property
    def MAX_RPM(self) -> float:
        """Maximum motor speed, rpm."""
        return self._env.MAX_RPM

    @property
    def TARGET_HEIGHT(self) -> float:
        """Height to hover at, m, in `hover`. Setting it has an effect from the next step on."""
        options = self._env._batch.task_options(self._index)
        if options.get("target_height") is None:
            raise AttributeError("the task has no target height")
        return options["target_height"]

    @TARGET_HEIGHT.setter
    def TARGET_HEIGHT(self, height: float) -> None:
        self._set_target("target_height", height)

    @property
    def TARGET_HEIGHTS(self) -> np.ndarray:
        """Target heights, m, float64 (N,), in `multi_hover` and `multi_agent`.

        Setting them has an effect from the next step on.
        """
        if self._env.task not in ("multi_hover", "multi_agent"):
            raise AttributeError("the task has no target heights")
        return np.array([self.reference(drone)[0][2] for drone in range(self.NUM_DRONES)])

    @TARGET_HEIGHTS.setter
    def TARGET_HEIGHTS(self, heights: Any) -> None:
        self._set_target("target_heights", numbers("target_heights", heights).reshape(-1).tolist())

    @property
    def unwrapped(self) -> VectorMember:
        """This environment."""
        return self

    def _states(self) -> np.ndarray:
        return np.stack([self._getDroneStateVector(drone) for drone in range(self.NUM_DRONES)])

    def _batteries(self) -> np.ndarray:
        return self._env._batch.battery(self._index)

    def _getDroneStateVector(self, nth_drone: int) -> np.ndarray:
        """Returns the state of a drone, float64 (20,): pos, quat (w, x, y, z), rpy, vel, ang_v, motor speeds (rpm)."""
        return self._env._batch.state(self._index, drone_index(nth_drone, self.NUM_DRONES))

    def drone_params(self, nth_drone: int = 0) -> dict[str, Any]:
        """Returns the parameters of a drone's airframe in this episode, with the keys of an airframe file."""
        return self._env._batch.drone_params(self._index, drone_index(nth_drone, self.NUM_DRONES))

    def reference(self, nth_drone: int = 0) -> tuple[np.ndarray, np.ndarray, float]:
        """Returns the reference of a drone: position (m) and velocity (m/s), each (3,), and yaw (rad), world frame."""
        return self._env._batch.reference(self._index, drone_index(nth_drone, self.NUM_DRONES))

    def info(self) -> dict[str, Any]:
        """Returns the info of the environment, as `step` of a single environment returns it."""
        return self._env._batch.info(self._index)

    def metrics(self) -> dict[str, float]:
        """Returns the scalar metrics of the task by name."""
        return self._env._batch.metrics(self._index)

    def set_wind(self, config: Any) -> None:
        """Sets the wind from now on, also for later episodes.

        Args:
            config: A `WindConfig`, a dict with the keys of the TOML files, or None for still air. It replaces the
                default wind of a randomization.

        Raises:
            ValueError: next to a range of the wind in the randomization; nothing has changed.
        """
        target = _Conditions(self._env._batch, self._index)
        replace_wind(target, wind_options(config), self._changed("randomization"), self._env.CTRL_FREQ)
        self._note("wind", config)

    def set_randomization(self, randomization: Any) -> None:
        """Sets the parameters that are sampled for every episode from the next reset on.

        Args:
            randomization: A `DomainRandomizationConfig`, a dict of groups, True for the paper's ranges, or None.
        """
        ranges = randomization_options(randomization, self._env.CTRL_FREQ, wind_options(self._changed("wind")))
        self._env._batch.set_randomization(self._index, ranges)
        self._note("randomization", randomization)

    def _restore(self, changes: dict[str, Any]) -> None:
        """Applies the changes of another environment."""
        if "wind" in changes or "randomization" in changes:
            # without ranges, which may not be next to a wind
            self.set_randomization(None)
            self.set_wind(changes.get("wind", self._changed("wind")))
            self.set_randomization(changes.get("randomization", self._env._arguments.get("randomization")))
        for name in ("target_height", "target_heights"):
            if name in changes:
                self._set_target(name, changes[name])

    def render(self, camera_mode: str | None = None) -> np.ndarray | None:
        """Returns a frame of the environment, uint8 (height, width, 3), if the render mode is "rgb_array".

        Args:
            camera_mode: "track", "fpv", "fixed", "front" or "top"; None for the option `camera`.
        """
        return self._env._frame(self._index, camera_mode)

    def close(self) -> None:
        """Does nothing: the vector environment owns the simulation."""

    def has_wrapper_attr(self, name: str) -> bool:
        """Returns True if the environment has an attribute."""
        return hasattr(self, name)

    def get_wrapper_attr(self, name: str) -> Any:
        """Returns an attribute."""
        return getattr(self, name)

    def set_wrapper_attr(self, name: str, value: Any, *, force: bool = True) -> bool:
        """Sets an attribute."""
        setattr(self, name, value)
        return True


class _Members(Sequence):
    """The environments of a `VectorAviary`, which has no reference to them: dropping it frees its memory at once."""

    def __init__(self, env: VectorAviary) -> None:
        self._env = env

    def __len__(self) -> int:
        return self._env.num_envs

    def __getitem__(self, index: Any) -> Any:
        if isinstance(index, slice):
            return [self[i] for i in range(*index.indices(len(self)))]
        index = operator.index(index)
        index += len(self) if index < 0 else 0
        if not 0 <= index < len(self):
            raise IndexError(f"environment {index} does not exist, expected an index from 0 to {len(self) - 1}")
        return VectorMember(self._env, index)


class VectorAviary(VectorEnv):
    """Environments of one task that step together on all cores.

    Environment i is bit-identical to the single environment with the same options, `stream=i`, `engine="hybrid"` and
    the same seed, for any number of threads. A step releases the GIL.

    Args:
        task: Name of the task, such as "hover".
        num_envs: Number of environments, M.
        autoreset_mode: Time of the reset after the end of an episode: a member of `AutoresetMode`, or its value or its
            name as a string.
        num_threads: Number of threads; 0 selects as many as the machine has cores and the environments keep busy.
        copy: True if `reset` and `step` return new arrays. Otherwise they return the same arrays every time: views of
            the buffers of the batch, which the next step overwrites.
        on_fault: "error" if an environment that fails (an action that is not finite, a state that diverges) raises an
            error, "truncate" if it ends the episode of the environment with the reward 0.
        max_episode_steps: Time limit of an episode, control steps, instead of the shorter or longer one of the task or
            of `episode_seconds`; None for that one.
        device: "cpu", "gpu", or "gpu:" and the number or a part of the name of an adapter. On a GPU the environments
            are in its memory and have fewer options; arrays are copied between it and the host. The random numbers and
            the rounding differ from those of the CPU. `envs` gives access to states alone. A package has a GPU back
            end if it was built with the feature `gpu`.
        options: Options of the single environment: `num_drones`, `physics`, `obs_type`, `act_type`, `wind`, ...

    Example:
        >>> import numpy as np
        >>> from mujoco_drones_gym import VectorAviary
        >>> env = VectorAviary("hover", 64)
        >>> obs, infos = env.reset(seed=1)
        >>> obs, rewards, terminations, truncations, infos = env.step(np.zeros((64, 4), np.float32))
        >>> obs.shape, rewards.shape
        ((64, 12), (64,))
    """

    def __init__(
        self,
        task: str,
        num_envs: int = 1,
        *,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        num_threads: int = 0,
        copy: bool = True,
        on_fault: str = "error",
        max_episode_steps: int | None = None,
        device: str = "cpu",
        **options: Any,
    ) -> None:
        self._arguments = dict(
            options,
            task=task,
            num_envs=num_envs,
            device=device,
            autoreset_mode=autoreset_mode,
            num_threads=num_threads,
            copy=copy,
            on_fault=on_fault,
            max_episode_steps=max_episode_steps,
        )
        self.autoreset_mode = autoreset_mode_of(autoreset_mode)
        count = integer("num_envs", num_envs, 1, 1 << 24)
        threads = integer("num_threads", num_threads, 0, 1024)
        if max_episode_steps is not None:
            rate = options.get("ctrl_freq", 48)
            most = _LONGEST * (rate if isinstance(rate, (int, np.integer)) and rate > 0 else 48)
            max_episode_steps = integer("max_episode_steps", max_episode_steps, 1, most)
        if not isinstance(on_fault, str):
            raise ValueError(f'on_fault is {short(on_fault)}, expected "error" or "truncate"')
        if not isinstance(device, str):
            raise ValueError(f'device is {short(device)}, expected "cpu", "gpu" or "gpu:" and an adapter')
        self.device = device
        self.copy = flag("copy", copy)
        task, native, render = native_options(task, options)
        if device.startswith("gpu") and render.mode is not None:
            raise ValueError(f"render_mode is {render.mode!r}, expected None with device={device!r}")
        self.render_mode = render.mode
        self._frame_size = (render.width, render.height)
        self._camera = render.camera
        _opengl.prepare()
        mode = _AUTORESET[self.autoreset_mode]
        batch = _native.Batch(task, native, count, threads, mode, on_fault, max_episode_steps, self.copy, device)
        self._batch: Any = batch
        # attributes of single environments that the caller has set
        self._attributes: dict[int, dict[str, Any]] = {}
        # options of single environments that the caller has changed
        self._changes: dict[int, dict[str, Any]] = {}
        self.num_envs = count
        self.task = task
        # the environments that have started an episode
        self._started = np.zeros(count, np.bool_)
        constants = batch.constants()
        self.num_threads: int = constants["num_threads"]
        self.NUM_DRONES: int = constants["num_drones"]
        self.SIM_FREQ: int = constants["sim_freq"]
        self.CTRL_FREQ: int = constants["ctrl_freq"]
        self.CTRL_TIMESTEP: float = constants["control_period"]
        self.HOVER_RPM: float = constants["hover_rpm"]
        self.MAX_RPM: float = constants["max_rpm"]
        #: Name of the action type.
        self.action_type: str = constants["action_type"]
        self.max_episode_steps: int = constants["episode_steps"]
        self.metadata = {
            "render_modes": ["rgb_array"] if device == "cpu" else [],
            "render_fps": self.CTRL_FREQ,
            "autoreset_mode": self.autoreset_mode,
        }
        low, high = batch.observation_bounds()
        boxes = {"kin": spaces.Box(low, high, dtype=np.float32)} if low.size else {}
        # the arrays of the images are the same in every step
        self._images: dict[str, np.ndarray] = batch.images()
        for name, image in self._images.items():
            boxes[name] = _layout.image_space(name, image.shape[1:])
        self._has_numbers = "kin" in boxes
        self.single_observation_space = _layout.observation_space(boxes)
        low, high = batch.action_bounds()
        self.single_action_space = spaces.Box(low, high, dtype=np.float32)

    @cached_property
    def observation_space(self) -> spaces.Space:
        """Space of the observations of all environments."""
        return batch_space(self.single_observation_space, self.num_envs)

    @cached_property
    def action_space(self) -> spaces.Space:
        """Space of the actions of all environments."""
        return batch_space(self.single_action_space, self.num_envs)

    @property
    def envs(self) -> Sequence[VectorMember]:
        """The environments, for reading their states and changing their wind."""
        return _Members(self)

    def reset(
        self,
        *,
        seed: int | Sequence[int | None] | None = None,
        options: dict[str, Any] | None = None,
    ) -> tuple[Any, dict[str, Any]]:
        """Starts an episode in every environment.

        Args:
            seed: A seed, of which every environment uses its own random stream; a seed or None for every environment;
                or None, with which the random streams continue.
            options: `{"reset_mask": mask}` resets the environments that the mask, an array or a list of bool (M,),
                selects.

        Returns:
            The observations, (M, ...), and an empty dict.
        """
        mask = check_reset_options(options).get("reset_mask")
        selected = np.ones(self.num_envs, np.bool_) if mask is None else self._checked_mask(mask)
        seeds = _checked_seed(seed)
        numbers = self._batch.reset(self._seeds_of_reset(seeds, selected), None if mask is None else selected)
        self._started |= selected
        if not isinstance(seeds, list):
            super().reset(seed=seeds)
        return self._observed(numbers), {}

    def _seeds_of_reset(self, seeds: Any, selected: np.ndarray) -> Any:
        """Returns the seeds of a reset, in which environments that start for the first time have one."""
        new = selected & ~self._started
        if isinstance(seeds, int) or not new.any() or (seeds is not None and len(seeds) != self.num_envs):
            return seeds
        if seeds is not None and all(seed is not None for seed in seeds):
            return seeds
        drawn = int(self.np_random.integers(2**63))
        if seeds is None and np.array_equal(new, selected):
            return drawn
        given = [None] * self.num_envs if seeds is None else seeds
        return [drawn if seed is None and is_new else seed for seed, is_new in zip(given, new.tolist(), strict=True)]

    def step(self, actions: Any) -> tuple[Any, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Advances every environment by one control step.

        Args:
            actions: Actions, (M, ...), clipped to the bounds of the action space. The batch takes float64 in full
                precision.

        Returns:
            The observations (M, ...), the rewards, float32 (M,), the terminations and truncations, bool (M,), and the
            infos. Where an episode has ended, the infos hold `success`, `end`, `is_success`, `time`, `progress`,
            `position_error` and `crashed` of its last step (`NEXT_STEP`, `DISABLED`), or `final_obs` and `final_info`,
            which holds them (`SAME_STEP`), each with the mask of the environments, `_success` and so on.
        """
        if type(actions) is not np.ndarray or actions.dtype.char not in "fd":
            actions = action_numbers("actions", actions, (self.num_envs, *self.single_action_space.shape))
        (numbers, rewards, terminations, truncations), ended = self._batch.step(actions)
        infos = self._end_infos() if ended else {}
        return self._observed(numbers), rewards, terminations, truncations, infos

    def render(self) -> tuple[np.ndarray, ...] | None:
        """Returns a frame of every environment, uint8 (height, width, 3), if the render mode is "rgb_array"."""
        if self.render_mode is None:
            self._frame(0)
            return None
        return tuple(self._frame(index) for index in range(self.num_envs))

    def close_extras(self, **kwargs: Any) -> None:
        """Ends the threads and frees the environments. Arrays that `step` has returned stay valid."""
        self._batch = _Closed()

    def states(self) -> np.ndarray:
        """Returns the present states of all drones, float64 (M, N, 20).

        The numbers of a drone are its position, quaternion (w, x, y, z), roll, pitch and yaw, velocity, angular
        velocity in the body frame, and the motor speeds (rpm) of the last step.
        """
        return self._batch.states()

    def batteries(self) -> np.ndarray:
        """Returns charge (0 to 1), voltage (V) and current (A) of all batteries, float64 (M, N, 3).

        They are NaN without a battery.
        """
        return self._batch.batteries()

    def reward_terms(self) -> dict[str, np.ndarray]:
        """Returns the terms of the rewards of the last step by name.

        Bonuses are positive, penalties negative, and the sum of all terms is the reward. A term is an array, float64
        (M,) for one drone and (M, N) for several. It is NaN for an environment that has not made a step in its present
        episode, such as one that `SAME_STEP` has reset. The dict is empty if no environment has made one.
        """
        terms = self._batch.reward_terms()
        return {name: term[:, 0] for name, term in terms.items()} if self.NUM_DRONES == 1 else terms

    def sampled_params(self) -> dict[str, np.ndarray]:
        """Returns the sampled parameters of the present episodes by name; an empty dict without randomization.

        The names are those of `sampled_params` of a single environment, with dots for groups (`actuators.lag`). A
        parameter is an array, float64 (M, N), or (M, N, ...) if it has several numbers. Parameters of a whole
        environment, such as `gravity`, are equal for its drones. The numbers of an environment without randomization
        are NaN.
        """
        return self._batch.sampled_params()

    def faults(self) -> dict[int, str]:
        """Returns the errors of the environments that failed in the last step, by the index of the environment."""
        return dict(self._batch.faults())

    def call(self, name: str, *args: Any, **kwargs: Any) -> tuple[Any, ...]:
        """Calls a method of every environment, or returns its attribute."""
        values = (getattr(env, name) for env in self.envs)
        return tuple(value(*args, **kwargs) if callable(value) else value for value in values)

    def get_attr(self, name: str) -> tuple[Any, ...]:
        """Returns an attribute of every environment."""
        return self.call(name)

    def set_attr(self, name: str, values: Any) -> None:
        """Sets an attribute of every environment: to the entries of a list or tuple, or to one value."""
        if not isinstance(values, (list, tuple)):
            values = [values] * self.num_envs
        if len(values) != self.num_envs:
            raise ValueError(f"values has {len(values)} entries, expected one per environment: {self.num_envs}")
        for env, value in zip(self.envs, values, strict=True):
            setattr(env, name, value)

    def _observed(self, numbers: np.ndarray) -> Any:
        """Returns the observations with these numbers of the tasks."""
        if not self._images:
            return numbers
        if not self.copy:
            return self._pack(numbers, self._images)
        return self._pack(numbers, {name: image.copy() for name, image in self._images.items()})

    def _pack(self, numbers: np.ndarray, images: dict[str, np.ndarray]) -> Any:
        # the dict is a new one, so that the caller may change it
        return _layout.pack({"kin": numbers, **images} if self._has_numbers else dict(images))

    def _end_infos(self) -> dict[str, Any]:
        """Returns the infos of a step in which an episode has ended."""
        indices, successes, ends, _ = self._batch.ends()
        if not indices.size:
            return {}
        count = self.num_envs
        mask = np.zeros(count, np.bool_)
        mask[indices] = True
        success = np.zeros(count, np.bool_)
        success[indices] = successes
        end = np.empty(count, object)
        end[indices] = _ENDS[ends]
        infos = {"success": success, "_success": mask, "end": end, "_end": mask.copy()}
        infos.update(is_success=success.copy(), _is_success=mask.copy())
        names = ("time", "progress", "position_error", "crashed")
        for name, values in zip(names, self._batch.final_infos(indices), strict=True):
            infos[name] = np.zeros(count, values.dtype)
            infos[name][indices] = values
            infos[f"_{name}"] = mask.copy()
        if self.autoreset_mode is not AutoresetMode.SAME_STEP:
            return infos
        final = np.empty(count, object)
        rows = self._batch.final_observations(indices)
        if not self._images:
            for index, row in zip(indices.tolist(), rows, strict=True):
                final[index] = row
        else:
            for index, row in zip(indices.tolist(), rows, strict=True):
                images = self._batch.final_images(index)
                final[index] = self._pack(row, images)
        return {"final_obs": final, "_final_obs": mask.copy(), "final_info": infos, "_final_info": mask.copy()}

    def _frame(self, index: int, camera_mode: str | None = None) -> np.ndarray | None:
        if not self._started[index]:
            raise ResetNeeded("render was called before the first reset, expected a call of reset first")
        camera = self._camera if camera_mode is None else camera_of("camera_mode", camera_mode)
        if self.render_mode is None and camera_mode is None:
            warn("render was called without a render mode; create the environment with render_mode='rgb_array'")
            return None
        return self._batch.render(index, camera, *self._frame_size)

    def _checked_mask(self, given: Any) -> np.ndarray:
        try:
            mask = np.asarray(given)
        except (TypeError, ValueError, RuntimeError):
            mask = np.asarray(None)
        if mask.dtype != np.bool_:
            raise ValueError(f"options['reset_mask'] is {short(given)}, expected an array of bool")
        if mask.shape != (self.num_envs,):
            raise ValueError(f"options['reset_mask'] has the shape {mask.shape}, expected ({self.num_envs},)")
        if not mask.any():
            raise ValueError("options['reset_mask'] selects no environment, expected at least one True")
        return mask

    def __getstate__(self) -> dict[str, Any]:
        # a copy has the options of the batch and starts without an episode
        state = {name: value for name, value in self.__dict__.items() if name not in _NOT_COPIED}
        state["_attributes"] = {index: dict(own) for index, own in self._attributes.items()}
        return state

    def __setstate__(self, state: dict[str, Any]) -> None:
        own = dict(state)
        changes = own.pop("_changes")
        VectorAviary.__init__(self, **own["_arguments"])
        self.__dict__.update(own)
        for index, changed in changes.items():
            self.envs[index]._restore(changed)


def _checked_seed(seed: Any) -> Any:
    """Returns a seed, or a list of seeds, as plain integers."""
    if isinstance(seed, (list, tuple)) or np.ndim(seed) > 0:
        return [seed_of(one) for one in seed]
    return seed_of(seed)


# Entry points of the registered ids, by the name of the task.
make_hover_vec = partial(VectorAviary, "hover")
make_velocity_vec = partial(VectorAviary, "velocity")
make_multi_hover_vec = partial(VectorAviary, "multi_hover")
make_fly_through_vec = partial(VectorAviary, "fly_through")
make_formation_vec = partial(VectorAviary, "formation")
make_race_vec = partial(VectorAviary, "race")
make_antipodal_vec = partial(VectorAviary, "antipodal")
make_stabilize_vec = partial(VectorAviary, "stabilize")
make_track_vec = partial(VectorAviary, "track")
