"""Options of an environment, converted for the simulator."""

from __future__ import annotations

import math
import operator
import os
from collections.abc import Mapping
from enum import Enum
from typing import Any, NamedTuple

import numpy as np

from mujoco_drones_gym._config import short
from mujoco_drones_gym.wrappers.obstacles import obstacle_options
from mujoco_drones_gym.wrappers.randomization import randomization_options
from mujoco_drones_gym.wrappers.wind import wind_options

__all__ = [
    "Render",
    "action_numbers",
    "camera_of",
    "check_reset_options",
    "drone_index",
    "flag",
    "integer",
    "native_options",
    "numbers",
    "randomization_options",
    "replace_wind",
    "seed_of",
    "wind_options",
]

#: Names of the cameras of `render`.
CAMERAS = ("track", "fpv", "fixed", "front", "top")

#: Names of points and of lists of points among the options.
_POINTS = ("initial_xyzs", "initial_rpys", "waypoints", "gates")


class Render(NamedTuple):
    """Options of images and files, which are not options of the simulator."""

    mode: str | None
    width: int
    height: int
    camera: str
    output_folder: str | None
    vision_attributes: bool


def _render_mode(mode: Any, gui: Any, has_window: bool) -> str | None:
    """Returns the render mode of the options `render_mode` and `gui`.

    Raises:
        ValueError: for an unknown mode, for two modes that differ, and for a window of an environment without windows.
    """
    modes = ("human", "rgb_array") if has_window else ("rgb_array",)
    if mode is not None and not (isinstance(mode, str) and mode in modes):
        expected = ", ".join(map(repr, modes))
        raise ValueError(f"render_mode is {short(mode)}, expected {expected} or None")
    if not flag("gui", gui):
        return mode
    if not has_window:
        raise ValueError("gui is True, expected an environment of a single agent, such as HoverAviary")
    if mode == "rgb_array":
        raise ValueError("gui is True, expected False with render_mode='rgb_array'")
    return "human"


def native_options(
    task: Any, options: Mapping[str, Any], *, single: bool = False, has_window: bool = False
) -> tuple[str, dict[str, Any], Render]:
    """Splits the options of an environment.

    Args:
        task: Name of the task.
        options: Options by name: plain values, members of enums, config objects.
        single: True for an environment of a single agent, which has `output_folder` and `vision_attributes`.
        has_window: True for an environment that has the render mode "human" and `gui`.

    Returns:
        The name of the task, the options of the simulator as plain values, and those of images and files.
    """
    if not isinstance(task, str):
        raise ValueError(f"task is {short(task)}, expected the name of a task")
    own = dict(options)
    render = Render(
        mode=_render_mode(own.pop("render_mode", None), own.pop("gui", False), has_window),
        width=_pixels("width", own.pop("width", 640)),
        height=_pixels("height", own.pop("height", 480)),
        camera=camera_of("camera", own.pop("camera", "track")),
        output_folder=_folder(own.pop("output_folder", None)),
        vision_attributes=flag("vision_attributes", own.pop("vision_attributes", False)),
    )
    if not single:
        for name in ("output_folder", "vision_attributes"):
            value = getattr(render, name)
            if value:
                raise ValueError(f"{name} is {value!r}, expected an environment of a single agent, such as HoverAviary")
    for name, value in own.items():
        if isinstance(value, Enum):
            own[name] = value.value
        elif isinstance(value, os.PathLike):
            own[name] = os.fspath(value)
    for name in _POINTS:
        if own.get(name) is not None:
            own[name] = _points(name, own[name])
    if own.get("target_heights") is not None:
        own["target_heights"] = numbers("target_heights", own["target_heights"]).reshape(-1).tolist()
    if "obstacles" in own:
        own["obstacles"] = obstacle_options(options["obstacles"])
    if "wind" in own:
        own["wind"] = wind_options(options["wind"])
    if "randomization" in own:
        rate = own.get("ctrl_freq", 48)
        rate = rate if _is_rate(rate) else 48
        own["randomization"] = randomization_options(options["randomization"], rate, own.get("wind"))
    return task, own, render


def replace_wind(target: Any, wind: Mapping[str, Any] | None, randomization: Any, ctrl_freq: float) -> None:
    """Sets the wind of an environment with the functions `set_wind` and `set_randomization` of the simulator.

    Args:
        target: Object that has the functions.
        wind: Section `[wind]`, or None for still air.
        randomization: Option `randomization` of the environment. The wind replaces its default wind.
        ctrl_freq: Control rate, Hz.

    Raises:
        ValueError: next to a range of the wind in the randomization; nothing has changed.
    """
    ranges = randomization_options(randomization, ctrl_freq, wind)
    # the simulator never gets a wind together with a range of the wind
    has_wind = wind is not None and wind["model"] != "none"
    if ranges is not None and has_wind:
        target.set_randomization(ranges)
    target.set_wind(wind)
    if ranges is not None and not has_wind:
        target.set_randomization(ranges)


def _is_rate(rate: Any) -> bool:
    return isinstance(rate, (int, np.integer)) and bool(rate > 0)


def _pixels(name: str, value: Any) -> int:
    if isinstance(value, (int, np.integer)) and not isinstance(value, bool) and 1 <= value <= 8192:
        return int(value)
    raise ValueError(f"{name} is {short(value)}, expected a number of pixels from 1 to 8192")


def camera_of(name: str, value: Any) -> str:
    """Returns the name of a camera."""
    if isinstance(value, str) and value in CAMERAS:
        return value
    raise ValueError(f"{name} is {short(value)}, expected track, fpv, fixed, front or top")


def _folder(value: Any) -> str | None:
    if value is None or (isinstance(value, str) and value == ""):
        return None
    if isinstance(value, (str, os.PathLike)):
        return os.fspath(value)
    raise ValueError(f"output_folder is {short(value)}, expected a path or None")


def flag(name: str, value: Any) -> bool:
    """Returns an option that is True or False."""
    if isinstance(value, (bool, np.bool_)):
        return bool(value)
    raise ValueError(f"{name} is {short(value)}, expected True or False")


def integer(name: str, value: Any, low: int, high: int) -> int:
    """Returns an integer within its bounds. Arrays and tensors of one integer without a shape are integers."""
    try:
        number = operator.index(value)
    except (TypeError, ValueError, RuntimeError):
        number = low - 1
    if not low <= number <= high or isinstance(value, (bool, np.bool_)):
        raise ValueError(f"{name} is {short(value)}, expected an integer from {low} to {high:,}")
    return number


def seed_of(seed: Any) -> int | None:
    """Returns a seed as a plain integer; None for None."""
    return None if seed is None else integer("seed", seed, 0, (1 << 64) - 1)


def drone_index(nth_drone: Any, num_drones: int) -> int:
    """Returns the index of a drone."""
    try:
        index = operator.index(nth_drone)
    except TypeError:
        index = -1
    if not 0 <= index < num_drones:
        expected = f"an index from 0 to {num_drones - 1}"
        raise ValueError(f"drone {short(nth_drone)} does not exist, expected {expected}")
    return index


def check_reset_options(options: Any) -> Mapping[str, Any]:
    """Returns the options of a reset; an empty dict for None."""
    if options is None:
        return {}
    if isinstance(options, Mapping):
        return options
    raise ValueError(f"options is {short(options)}, expected a dict or None")


def action_numbers(name: str, value: Any, shape: tuple[int, ...]) -> Any:
    """Returns an action as an array of numbers; float32 and float64 keep their type, others become float64.

    Args:
        name: Name of the action in errors.
        value: Array, tensor (also one with a gradient) or nested lists of numbers.
        shape: Shape that errors name.
    """
    if type(value) is np.ndarray and value.dtype.char in "fd":
        return value
    try:
        array = np.asarray(value.detach().cpu() if hasattr(value, "detach") else value)
        # numpy has no type for integers of any size: they are objects
        array = array.astype(np.float64, copy=False) if array.dtype.kind in "biuO" else array
        if array.dtype.kind == "f" and (array.ndim > 0 or math.prod(shape) == 1):
            return array
    except (TypeError, ValueError, OverflowError, RuntimeError):
        pass
    raise ValueError(f"{name} is {short(value)}, expected an array of numbers of the shape {shape}")


def numbers(name: str, value: Any) -> np.ndarray:
    """Returns an option of finite numbers as a float64 array."""
    try:
        array = np.asarray(value, np.float64)
    except (TypeError, ValueError, OverflowError, RuntimeError):
        raise ValueError(f"{name} is {short(value)}, expected an array of numbers") from None
    if not np.isfinite(array).all():
        raise ValueError(f"{name} is {short(value)}, expected finite numbers")
    return array


def _points(name: str, value: Any) -> list[list[float]]:
    array = numbers(name, value)
    if array.size == 0 or array.shape[-1:] != (3,) or array.ndim > 2:
        raise ValueError(f"{name} has the shape {array.shape}, expected (n, 3)")
    return array.reshape(-1, 3).tolist()
