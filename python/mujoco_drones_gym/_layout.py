"""Spaces of observations: the numbers of a task, images, or both."""

from __future__ import annotations

from typing import Any

import numpy as np
from gymnasium import spaces

#: Distance of the far plane of the onboard cameras, m.
FAR = 100.0


def image_space(name: str, shape: tuple[int, ...]) -> spaces.Box:
    """Returns the space of an image part by its name: "rgb", "depth" or "segmentation"."""
    if name == "rgb":
        return spaces.Box(0, 255, shape, np.uint8)
    if name == "depth":
        return spaces.Box(0.0, FAR, shape, np.float32)
    return spaces.Box(-1, np.iinfo(np.int32).max, shape, np.int32)


def observation_space(parts: dict[str, spaces.Box]) -> spaces.Space:
    """Returns the space of an observation with these parts: a Box for a single part, otherwise a Dict."""
    return next(iter(parts.values())) if len(parts) == 1 else spaces.Dict(parts)


def pack(parts: dict[str, Any]) -> Any:
    """Returns the observation with these parts, as `observation_space` describes it."""
    return next(iter(parts.values())) if len(parts) == 1 else parts
