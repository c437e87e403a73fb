"""The airframe that a controller or a wind field belongs to."""

from __future__ import annotations

import os
from collections.abc import Mapping
from enum import Enum
from typing import Any


def airframe_of(env: Any) -> str | dict[str, Any]:
    """Returns the airframe of an environment, of a drone model or its name, of a TOML file, or of a dict of parameters.

    None is the Crazyflie 2.x in X configuration. For an environment, the result has the parameters of its first drone
    in the present episode.
    """
    if env is None:
        return "cf2x"
    if isinstance(env, Enum):
        return str(env.value)
    if isinstance(env, (str, os.PathLike)):
        return os.fspath(env)
    if isinstance(env, Mapping):
        return dict(env)
    aviary = getattr(env, "unwrapped", env)
    if hasattr(aviary, "drone_params"):
        return aviary.drone_params(0)
    # an environment with several agents, or a batch, has the arguments of its constructor
    arguments = getattr(aviary, "_arguments", None)
    if isinstance(arguments, Mapping):
        return airframe_of(arguments.get("drone_model"))
    raise TypeError(f"env is {type(env).__name__}, expected an environment, a drone model or None")
