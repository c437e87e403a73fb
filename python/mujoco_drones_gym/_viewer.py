"""Window that shows a flight."""

from __future__ import annotations

import os
import sys
from typing import Any

#: Frames per second of the window.
_RATE = 24


class Viewer:
    """Window with the view "track" of an environment.

    Raises:
        ValueError: on a machine without a display.
        ImportError: without matplotlib.
    """

    def __init__(self) -> None:
        has_display = sys.platform != "linux" or os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
        if not has_display:
            raise ValueError(
                "gui is True, expected False on a machine without a display; render_mode='rgb_array' returns images"
            )
        try:
            import matplotlib.pyplot as plt
        except ImportError:
            raise ImportError("gui=True needs matplotlib: pip install 'mujoco-drones-gym[viz]'") from None
        self._plt = plt
        self._figure: Any = None
        self._image: Any = None
        self._steps = 0

    def show(self, env: Any, steps: int) -> None:
        """Shows the state of an environment after a number of further control steps; 0 at the start of an episode."""
        self._steps = self._steps + steps if steps else 0
        if self._steps % max(1, env.CTRL_FREQ // _RATE):
            return
        frame = env.render("track")
        if self._figure is None:
            self._figure, axes = self._plt.subplots(num=type(env).__name__)
            axes.set_axis_off()
            self._image = axes.imshow(frame)
            self._plt.show(block=False)
        self._image.set_data(frame)
        self._figure.canvas.draw_idle()
        self._figure.canvas.flush_events()

    def close(self) -> None:
        """Closes the window."""
        if self._figure is not None:
            self._plt.close(self._figure)
            self._figure = None
