"""Images of `render`, and the window of `render_mode="human"`."""

from __future__ import annotations

import atexit
import time
from typing import Any

import numpy as np
from gymnasium.error import ResetNeeded
from gymnasium.logger import warn

from mujoco_drones_gym import _native
from mujoco_drones_gym._options import camera_of

# drivers of OpenGL release their objects at the end of the process, when no window may draw any more
atexit.register(_native.close_windows)


class Window:
    """Window that shows the flight of an environment in real time. The first reset opens it.

    After the person has closed the window, or its display has disconnected, the flight continues at full speed.

    Args:
        title: Title of the window.
        period: Length of a control step, s.
    """

    def __init__(self, title: str, period: float) -> None:
        self._title = title
        self._period = period
        self._window: _native.Window | None = None
        # True after the end of a window that `close` has not closed
        self._has_ended = False
        # time at which the step that is shown next is due
        self._due = 0.0

    def reset(self, env: _native.Env | _native.Parallel) -> None:
        """Shows the start of an episode, and opens the window if there is none.

        Raises:
            RuntimeError: if no window can be opened; the message says what is missing.
        """
        if self._window is None and not self._has_ended:
            self._window = _native.Window(env, self._title)
            self._due = time.perf_counter()
        else:
            self.step(env)

    def step(self, env: _native.Env | _native.Parallel) -> None:
        """Shows the present state, and waits until real time has reached the time of the flight."""
        self.refresh(env)
        if self._window is not None:
            now = time.perf_counter()
            # a step that is late by more than a period delays the flight, which does not catch up
            self._due = max(self._due + self._period, now - self._period)
            if self._due > now:
                time.sleep(self._due - now)

    def refresh(self, env: _native.Env | _native.Parallel) -> None:
        """Shows the present state."""
        if self._window is not None and not self._window.sync(env):
            self.close()
            self._has_ended = True

    def close(self) -> None:
        """Closes the window. The next reset opens another one."""
        self._has_ended = False
        if self._window is not None:
            self._window.close()
            self._window = None


class Rendering:
    """Images and window of an environment, which sets the attributes in its constructor."""

    render_mode: str | None
    _env: Any
    _window: Window | None
    _camera: str
    _frame_size: tuple[int, int]
    _has_episode: bool

    def render(self, camera_mode: str | None = None) -> np.ndarray | None:
        """Returns an image of the present state, or shows the present state in the window.

        Args:
            camera_mode: "track" (follows the drones), "fpv" (onboard), "fixed", "front" or "top"; None for the option
                `camera`.

        Returns:
            Image, uint8 (height, width, 3). None without a `camera_mode`, if the render mode is "human" or None.
        """
        if not self._has_episode:
            raise ResetNeeded("render was called before the first reset, expected a call of reset first")
        camera = self._camera if camera_mode is None else camera_of("camera_mode", camera_mode)
        if self.render_mode is None and camera_mode is None:
            warn("render was called without a render mode; create the environment with render_mode='rgb_array'")
            return None
        if self._window is not None and camera_mode is None:
            self._window.refresh(self._env)
            return None
        return self._env.render(camera, *self._frame_size)


def render_modes(metadata: dict[str, object], mode: str | None) -> list[str]:
    """Returns the render modes for the metadata of an environment with a render mode.

    The class names every mode, because `gymnasium.make` reads it there. An environment names "human" only if that is
    its render mode: programs such as Gymnasium's `check_env` use every mode that an environment names, and "human"
    needs a display.
    """
    modes = metadata.get("render_modes")
    return [name for name in modes if name != "human" or mode == "human"] if isinstance(modes, (list, tuple)) else []
