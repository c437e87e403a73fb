"""Policies of `aviary train`, and of other trainers in ONNX."""

from __future__ import annotations

import math
import operator
import os
from collections.abc import Mapping, Sequence
from enum import Enum
from typing import Any

import numpy as np
from gymnasium.logger import warn

from mujoco_drones_gym import _native
from mujoco_drones_gym._config import short
from mujoco_drones_gym._options import integer

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
        # file and declarations of an ONNX file
        self._onnx: tuple[bytes, dict[str, Any], Any] | None = None
        self.info: dict[str, Any] = native.info()
        self.observation_size: int = native.observation_size
        self.action_size: int = native.action_size
        self.memory_size: int = native.memory_size

    @classmethod
    def load(
        cls,
        path: str | os.PathLike[str],
        *,
        task: str | None = None,
        drone_model: Any = None,
        act_type: Any = None,
        sim_freq: int | None = None,
        ctrl_freq: int | None = None,
        observation_indices: str | Sequence[int] | None = None,
        action_range: str | None = None,
        action_output: str | None = None,
    ) -> Policy:
        """Reads a policy from a file: `policy.safetensors` of `aviary train`, or an ONNX file (.onnx).

        The keywords declare what the graph of an ONNX file is trained for, as those of `aviary play` do. The graph has
        one input for observations, (rows, entries), and an output for actions, (rows, components). Each further input
        is a memory, whose next value is the further output at the same place. A file of `Policy.export` has this
        information in its metadata and needs no keywords.

        Args:
            path: Path of the file.
            task: Task, such as "hover"; None for that of the metadata.
            drone_model: Airframe, as for environments, on which the bounds of some actions depend; None for that of
                the metadata, or "cf2x".
            act_type: Action type; None for that of the metadata, or "rpm".
            sim_freq: Physics rate, Hz; None for that of the metadata, or 240.
            ctrl_freq: Control rate, Hz; None for that of the metadata, or 48.
            observation_indices: Entries of the observation that are inputs of the graph, in its order: indices, or a
                text such as "6-8,0-5"; None for those of the metadata, or all of them.
            action_range: "space" if the outputs are actions, "unit" if they are scaled from [-1, 1] to the bounds of
                the actions; None for that of the metadata, or "space".
            action_output: Name of the output that is the action; None for that of the metadata, or the first output.

        Raises:
            OSError: if the system cannot read the file, for example FileNotFoundError.
            ValueError: if the file is not a policy, or does not fit its declarations.
        """
        path = os.fspath(path)
        declarations = {
            "task": _text("task", task),
            "drone": _drone_name(drone_model),
            "action_type": _text("act_type", act_type),
            "sim_freq": None if sim_freq is None else integer("sim_freq", sim_freq, 1, 1_000_000),
            "ctrl_freq": None if ctrl_freq is None else integer("ctrl_freq", ctrl_freq, 1, 1_000_000),
            "observation_indices": _indices(observation_indices),
            "action_range": _text("action_range", action_range),
            "action_output": _text("action_output", action_output),
        }
        if not path.lower().endswith(".onnx"):
            names = {"action_type": "act_type", "drone": "drone_model"}
            for name, value in declarations.items():
                if value is not None:
                    option = names.get(name, name)
                    raise ValueError(f"{option} is {short(value)}, expected None for a file that is not ONNX")
            return cls(_native.Policy(path))
        with open(path, "rb") as file:
            content = file.read()
        try:
            return _from_onnx(content, declarations, _airframe(drone_model), cls)
        except ValueError as error:
            message = str(error)
            is_of_file = message.startswith(("not a policy in ONNX", "task is None"))
            raise ValueError(f"{path}: {message}" if is_of_file else message) from None

    def export(
        self,
        out: str | os.PathLike[str],
        format: str,
        weights: str = "float32",
        *,
        name: str | None = None,
        drone_model: Any = None,
    ) -> list[str]:
        """Writes the policy in the format of another program, as `aviary export` does.

        Normalization and bounds of the actions are part of all formats.

        Args:
            out: Directory ("c", "crazyflie") or file ("onnx", "safetensors").
            format: "c" for a header and a source file in C99, "crazyflie" for an application for the firmware of a
                Crazyflie, which flies a policy of the task `hover`, "onnx", or "safetensors".
            weights: "float32", or "int8" for weights that are rounded to eight bits, with one scale per neuron. A
                file in the format "safetensors" with "int8" has the rounded weights in single precision.
            name: Name in the C code, in lower snake case; None for the task and `_policy`.
            drone_model: Airframe of the format "crazyflie", as for environments; None for the policy's.

        Returns:
            The paths of the files.

        Raises:
            OSError: if a file cannot be written; none of the files has changed.
            ValueError: for an unknown format, and for a policy that the format cannot represent.
        """
        out = os.fspath(out)
        for option, value, possible in (("format", format, _FORMATS), ("weights", weights, _WEIGHTS)):
            if not isinstance(value, str) or value not in possible:
                raise ValueError(f"{option} is {short(value)}, expected one of {', '.join(map(repr, possible))}")
        is_code = format in ("c", "crazyflie")
        if name is not None and not is_code:
            raise ValueError(f"name is {short(name)}, expected None with format={format!r}: the file has no C code")
        if drone_model is not None and format != "crazyflie":
            raise ValueError(f"drone_model is {short(drone_model)}, expected None with format={format!r}")
        if format == "onnx" and weights != "float32":
            raise ValueError(f"weights is {weights!r}, expected 'float32' with format='onnx'")
        if (format == "onnx") != out.lower().endswith(".onnx") and not is_code:
            ending = "a name that ends in .onnx" if format == "onnx" else "another name than that of an ONNX file"
            raise ValueError(f"out is {short(out)}, expected {ending} with format={format!r}")
        files = self._native.export(format, weights, _text("name", name), _airframe(drone_model))
        return _write({os.path.join(out, path) if path else out: content for path, content in files})

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
        if last == 0 or not self._fits(last, last // size if per_drone else 1):
            expected = f"a multiple of {size}" if per_drone else self._expected_size()
            raise ValueError(f"observation has the shape {observation.shape}, expected (..., n) with n {expected}")
        drones = last // size if per_drone else 1
        memory_shape = (*observation.shape[:-1], drones * self.memory_size)
        if state is None or not self.memory_size:
            memory = np.zeros(memory_shape, dtype=np.float32)
        else:
            memory = np.array(state, dtype=np.float32)
            if memory.shape != memory_shape:
                raise ValueError(f"state has the shape {memory.shape}, expected {memory_shape}")
        if self.memory_size and episode_start is not None:
            memory[np.broadcast_to(np.asarray(episode_start, dtype=bool), memory_shape[:-1])] = 0.0
        rows = math.prod(observation.shape[:-1]) * drones
        actions, memory = self._native.act(
            np.ascontiguousarray(observation).reshape(-1), np.ascontiguousarray(memory).reshape(-1), rows
        )
        actions = actions.reshape((*observation.shape[:-1], drones * self.action_size))
        return actions, memory.reshape(memory_shape) if self.memory_size else None

    def _fits(self, size: int, drones: int) -> bool:
        """Returns True if the policy reads observations of a size."""
        if self._native.selects_entries and not self.info["per_drone"]:
            return size >= self.observation_size
        return size == drones * self.observation_size

    def _expected_size(self) -> str:
        return f"{self.observation_size} or more" if self._native.selects_entries else str(self.observation_size)

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
        """Checks that the policy can fly an environment: a single one, a batch, or one with an agent per drone.

        Another control rate than that of the training is a warning. Task, airframe and conditions may differ.

        Raises:
            ValueError: if the sizes of observation or action or the action types differ.
        """
        agents = getattr(env, "possible_agents", None)
        if agents is None:
            observation, action = (
                getattr(env, f"single_{kind}_space", None) or getattr(env, f"{kind}_space")
                for kind in ("observation", "action")
            )
        else:
            observation, action = env.observation_space(agents[0]), env.action_space(agents[0])
        if hasattr(observation, "spaces"):
            observation = observation.spaces.get("kin")
        drones = _constant(env, "NUM_DRONES") or 1 if self.info["per_drone"] and agents is None else 1
        own = (drones * self.observation_size, drones * self.action_size)
        # images are no numbers
        observed = observation.shape[0] if observation is not None and len(observation.shape) == 1 else 0
        theirs = (observed, int(np.prod(action.shape)))
        expected, action_type = self.info["action_type"], _constant(env, "action_type")
        if not self._fits(observed, drones) or own[1] != theirs[1] or action_type not in (None, expected):
            raise ValueError(
                f"the policy has {own[0]} observations and {own[1]} actions ({expected}), "
                f"the environment {theirs[0]} and {theirs[1]} ({action_type or 'of any type'})"
            )
        rate = _constant(env, "CTRL_FREQ")
        if rate not in (None, self.info["ctrl_freq"]):
            warn(f"the policy has a control rate of {self.info['ctrl_freq']} Hz, the environment {rate} Hz")

    def __repr__(self) -> str:
        return f"<Policy {self.info['task']}: {self.observation_size} observations, {self.action_size} actions>"

    def __reduce__(self):
        if self._onnx is not None:
            return _from_onnx, (*self._onnx, type(self))
        return _from_bytes, (self._native.to_bytes(), type(self))


#: Formats and weights of `Policy.export`.
_FORMATS = ("c", "crazyflie", "onnx", "safetensors")
_WEIGHTS = ("float32", "int8")


def _from_bytes(data: bytes, cls: type[Policy] = Policy) -> Policy:
    return cls(_native.Policy.from_bytes(data))


def _from_onnx(data: bytes, declarations: dict[str, Any], airframe: Any, cls: type[Policy]) -> Policy:
    policy = cls(_native.Policy.from_onnx(data, declarations, airframe))
    policy._onnx = (data, declarations, airframe)
    return policy


def _text(name: str, value: Any) -> str | None:
    """Returns a string, the value of an enum, or None."""
    value = value.value if isinstance(value, Enum) else value
    if value is None or isinstance(value, str):
        return value
    raise ValueError(f"{name} is {short(value)}, expected a string")


def _airframe(drone_model: Any) -> Any:
    """Returns an airframe for the simulator: a name, a path or a dict."""
    if isinstance(drone_model, Enum):
        return drone_model.value
    if isinstance(drone_model, os.PathLike):
        return os.fspath(drone_model)
    if drone_model is None or isinstance(drone_model, (str, Mapping)):
        return drone_model
    raise ValueError(f"drone_model is {short(drone_model)}, expected a name, a TOML file or a dict")


def _drone_name(drone_model: Any) -> str | None:
    """Returns the name of an airframe."""
    airframe = _airframe(drone_model)
    return None if airframe is None else _native.airframe_constants(airframe)[0]["name"]


def _indices(value: Any) -> str | None:
    """Returns indices as text."""
    if value is None or isinstance(value, str):
        return value
    try:
        return ",".join(str(operator.index(index)) for index in value)
    except TypeError:
        expected = "numbers from 0, or a text such as '6-8,0-5'"
        raise ValueError(f"observation_indices is {short(value)}, expected {expected}") from None


def _constant(env: Any, name: str) -> Any:
    """Returns an attribute of an environment under its wrappers, or of the first environment of a batch.

    It is None for an environment that is not of this package.
    """
    aviary = getattr(env, "unwrapped", env)
    # the batch of an SB3VecEnv
    aviary = getattr(aviary, "venv", aviary)
    if hasattr(aviary, name):
        return getattr(aviary, name)
    try:
        return aviary.get_attr(name)[0]
    except (AttributeError, TypeError):
        return None


def _write(files: Mapping[str, bytes]) -> list[str]:
    """Writes files, all of them or none, and returns their paths."""
    unfinished: dict[str, str] = {}
    try:
        for path, content in files.items():
            os.makedirs(os.path.dirname(path) or ".", exist_ok=True)
            temporary = f"{path}.{os.getpid()}.part"
            with open(temporary, "wb") as file:
                unfinished[path] = temporary
                file.write(content)
        for path in list(unfinished):
            os.replace(unfinished[path], path)
            del unfinished[path]
    finally:
        for temporary in unfinished.values():
            os.remove(temporary)
    return list(files)
