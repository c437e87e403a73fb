"""The window of `render_mode="human"`."""

from __future__ import annotations

import atexit
import time

from mujoco_drones_gym import _native

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


def render_modes(metadata: dict[str, object], mode: str | None) -> list[str]:
    """Returns the render modes for the metadata of an environment with a render mode.

    The class names every mode, because `gymnasium.make` reads it there. An environment names "human" only if that is
    its render mode: programs such as Gymnasium's `check_env` use every mode that an environment names, and "human"
    needs a display.
    """
    modes = metadata.get("render_modes")
    return [name for name in modes if name != "human" or mode == "human"] if isinstance(modes, (list, tuple)) else []
