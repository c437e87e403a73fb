"""Logs of flights: a CSV file per drone and plots."""

from __future__ import annotations

import os
import re
from datetime import datetime
from typing import Any

import numpy as np

from mujoco_drones_gym import _native
from mujoco_drones_gym._config import short
from mujoco_drones_gym.wrappers._base import aviary_of

__all__ = ["Logger", "read_flight"]

# of the 20 numbers of a drone to the columns x … wz, roll … yaw, rpm0 … rpm3 of a flight log
_ORDER = [0, 1, 2, 3, 4, 5, 6, 10, 11, 12, 13, 14, 15, 7, 8, 9, 16, 17, 18, 19]

_CONTROL_COLUMNS = [
    *("x_ref", "y_ref", "z_ref", "vx_ref", "vy_ref", "vz_ref"),
    *("roll_ref", "pitch_ref", "yaw_ref", "wx_ref", "wy_ref", "wz_ref"),
]

_PANELS = [
    ("position, m", slice(0, 3), ("x", "y", "z")),
    ("attitude, rad", slice(7, 10), ("roll", "pitch", "yaw")),
    ("velocity, m/s", slice(10, 13), ("vx", "vy", "vz")),
    ("motor speeds, rpm", slice(16, 20), ("0", "1", "2", "3")),
]


class Logger:
    """Collects the states of drones during a flight, and saves and plots them.

    ```python
    logger = Logger(num_drones=1, logging_freq=48, output_folder="out")
    logger.log(drone=0, timestamp=t, state=env._getDroneStateVector(0))
    logger.save_to_csv()
    logger.plot()
    ```

    Args:
        num_drones: Number of drones.
        logging_freq: Number of rows per second and drone, Hz; the time step of rows without a timestamp.
        output_folder: Directory of the files, created when the first file is written.
        duration_sec: Expected duration, s; any duration fits.
        logging_freq_hz: Another name of `logging_freq`.
        colab: True to save plots and not to show them, the default of `plot`.
    """

    def __init__(
        self,
        num_drones: int = 1,
        logging_freq: float = 48,
        output_folder: str | os.PathLike[str] = "results",
        duration_sec: float = 0,
        *,
        logging_freq_hz: float | None = None,
        colab: bool = True,
    ):
        frequency = logging_freq if logging_freq_hz is None else logging_freq_hz
        if isinstance(num_drones, bool) or not isinstance(num_drones, (int, np.integer)) or num_drones < 1:
            raise ValueError(f"num_drones is {num_drones!r}, expected a whole number from 1")
        if not isinstance(frequency, (int, float, np.number)) or not 0 < frequency < 1e6:
            raise ValueError(f"logging_freq is {frequency!r}, expected a positive number of rows per second")
        if not isinstance(output_folder, (str, os.PathLike)):
            raise ValueError(f"output_folder is {output_folder!r}, expected the path of a directory")
        self.NUM_DRONES = int(num_drones)
        self.LOGGING_FREQ_HZ = float(frequency)
        self.OUTPUT_FOLDER = os.fspath(output_folder)
        self._show = not colab
        self._times: list[list[float]] = [[] for _ in range(self.NUM_DRONES)]
        self._states: list[list[np.ndarray]] = [[] for _ in range(self.NUM_DRONES)]
        self._controls: list[list[np.ndarray]] = [[] for _ in range(self.NUM_DRONES)]

    def log(self, drone: int, timestamp: float | None, state: Any, control: Any = None) -> None:
        """Adds a row.

        Args:
            drone: Index of the drone.
            timestamp: Simulated time, s; None for one time step after the last row of the drone.
            state: The 20 numbers of the drone, shape (20,).
            control: Target position, velocity, roll-pitch-yaw and angular velocity, shape (12,), or motor speeds in
                rpm, shape (4,), which replace those of the state.

        Raises:
            ValueError: for a drone that does not exist, a negative time or a wrong shape.
        """
        is_index = isinstance(drone, (int, np.integer)) and not isinstance(drone, bool)
        if not is_index or not 0 <= drone < self.NUM_DRONES:
            raise ValueError(f"drone is {short(drone)}, expected 0 to {self.NUM_DRONES - 1}")
        times = self._times[drone]
        if timestamp is None:
            timestamp = times[-1] + 1.0 / self.LOGGING_FREQ_HZ if times else 0.0
        time = _numbers("timestamp", timestamp, "a time in s from 0")
        if time.size != 1 or not 0.0 <= time[0] < np.inf:
            raise ValueError(f"timestamp is {short(timestamp)}, expected a time in s from 0")
        state = _numbers("state", state, "the 20 numbers of a drone")
        if state.size != 20:
            raise ValueError(f"state has {state.size} numbers, expected the 20 of a drone")
        targets = np.full(12, np.nan)
        if control is not None:
            control = _numbers("control", control, "12 targets or 4 motor speeds")
            if control.size == 12:
                targets = control
            elif control.size == 4:
                state[16:20] = control
            else:
                raise ValueError(f"control has {control.size} numbers, expected 12 targets or 4 motor speeds")
        times.append(float(time[0]))
        self._states[drone].append(state)
        self._controls[drone].append(targets)

    def log_env(self, env: Any) -> None:
        """Adds a row for every drone of an environment of this package, with the time of its episode."""
        aviary = aviary_of(env, "log_env")
        if self.NUM_DRONES != aviary.NUM_DRONES:
            raise ValueError(f"num_drones is {self.NUM_DRONES}, expected {aviary.NUM_DRONES}, as the environment has")
        time = aviary.time
        for drone in range(self.NUM_DRONES):
            self.log(drone, time, aviary._getDroneStateVector(drone))

    def reset(self) -> None:
        """Removes all rows."""
        for rows in (*self._times, *self._states, *self._controls):
            rows.clear()

    @property
    def counters(self) -> np.ndarray:
        """Number of rows of each drone, shape (num_drones,)."""
        return np.array([len(times) for times in self._times])

    @property
    def timestamps(self) -> np.ndarray:
        """Times, s, shape (num_drones, rows); NaN where a drone has fewer rows."""
        return self._padded([np.reshape(times, (len(times), 1)) for times in self._times], 1)[:, 0, :]

    @property
    def states(self) -> np.ndarray:
        """States, shape (num_drones, 20, rows); NaN where a drone has fewer rows."""
        return self._padded(self._states, 20)

    @property
    def controls(self) -> np.ndarray:
        """Targets, shape (num_drones, 12, rows); NaN where there are none."""
        return self._padded(self._controls, 12)

    def _padded(self, rows: list, width: int) -> np.ndarray:
        out = np.full((self.NUM_DRONES, width, int(self.counters.max())), np.nan)
        for drone, own in enumerate(rows):
            if len(own):
                out[drone, :, : len(own)] = np.transpose(own)
        return out

    def save(self, path: str | os.PathLike[str] | None = None) -> str:
        """Saves timestamps, states and controls as one `.npz` file and returns its path."""
        path = self._path(f"save-flight-{_now()}.npz") if path is None else os.fspath(path)
        with open(path, "wb") as file:
            np.savez(file, timestamps=self.timestamps, states=self.states, controls=self.controls)
        return path

    def save_to_csv(self, comment: str = "") -> list[str]:
        """Writes `drone0.csv`, `drone1.csv`, … into the output folder, and returns their paths.

        The columns are those of the simulator's flight logs: `t`, `drone`, position, quaternion, velocity, angular
        velocity (body frame), roll, pitch, yaw and motor speeds, then the targets if there are any. `aviary` reads such
        a directory.

        Args:
            comment: Text before the names of the files: `comment_drone0.csv`.
        """
        return self._write_csv(self.OUTPUT_FOLDER, f"{comment}_" if comment else "")

    def save_as_csv(self, comment: str = "") -> str:
        """Writes the CSV files of `save_to_csv` into a new directory with the date, and returns its path."""
        name = "-".join(part for part in ("save-flight", comment, _now()) if part)
        directory = os.path.join(self.OUTPUT_FOLDER, name)
        self._write_csv(directory, "")
        return directory

    def _write_csv(self, directory: str, prefix: str) -> list[str]:
        os.makedirs(directory, exist_ok=True)
        header = list(_native.flight_columns())
        paths = []
        for drone in range(self.NUM_DRONES):
            controls = np.reshape(self._controls[drone], (-1, 12))
            has_targets = not np.isnan(controls).all()
            path = os.path.join(directory, f"{prefix}drone{drone}.csv")
            with open(path, "w", encoding="utf-8") as file:
                file.write(",".join(header + (_CONTROL_COLUMNS if has_targets else [])) + "\n")
                for time, state, control in zip(self._times[drone], self._states[drone], controls, strict=True):
                    cells = [_cell(time), str(drone), *map(_cell, state[_ORDER])]
                    if has_targets:
                        cells += map(_cell, control)
                    file.write(",".join(cells) + "\n")
            paths.append(path)
        return paths

    def plot(self, path: str | os.PathLike[str] | None = None, *, show: bool | None = None) -> Any:
        """Plots position, attitude, velocity and motor speeds of all drones over time, in four panels.

        Args:
            path: Image file; `flight.png` in the output folder by default.
            show: True to open a window as well.

        Returns:
            The matplotlib figure.

        Raises:
            ImportError: if matplotlib is not installed.
        """
        show = self._show if show is None else show
        if show:
            from matplotlib import pyplot

            figure = pyplot.figure(figsize=(9, 10), layout="constrained")
        else:
            # without pyplot, a plot needs no display and leaves no global state
            from matplotlib.figure import Figure

            figure = Figure(figsize=(9, 10), layout="constrained")
        axes = figure.subplots(len(_PANELS), 1, sharex=True)
        for axis, (title, columns, names) in zip(axes, _PANELS, strict=True):
            for drone in range(self.NUM_DRONES):
                values = np.reshape(self._states[drone], (-1, 20))[:, columns]
                prefix = f"drone {drone} " if self.NUM_DRONES > 1 else ""
                for name, series in zip(names, values.T, strict=True):
                    axis.plot(self._times[drone], series, label=prefix + name)
            axis.set_ylabel(title)
            axis.grid(True)
            axis.legend(loc="upper right", fontsize="small", ncols=self.NUM_DRONES)
        axes[-1].set_xlabel("time, s")
        figure.savefig(self._path("flight.png") if path is None else os.fspath(path))
        if show:
            pyplot.show()
        return figure

    def _path(self, name: str) -> str:
        os.makedirs(self.OUTPUT_FOLDER, exist_ok=True)
        return os.path.join(self.OUTPUT_FOLDER, name)


def read_flight(path: str | os.PathLike[str], episode: int | None = None) -> list[dict[str, np.ndarray]]:
    """Reads the flight logs of a `Logger`, of `aviary fly --out`, or of the option `output_folder` of an environment.

    Args:
        path: Directory with `drone0.csv`, `drone1.csv`, …, or one table with the rows of all drones or of one of them,
            such as `episode_0000_drone1.csv`.
        episode: Number of an episode, for the `output_folder` of an environment, whose files are
            `episode_0000_drone0.csv`, ….

    Returns:
        For each drone `t` (s, shape (rows,)), `state` (the 20 numbers, shape (rows, 20)), `reward` (shape (rows,)) and
        `reference` (position in m and yaw in rad, shape (rows, 4), NaN without a reference).

    Raises:
        OSError: if the system cannot read a file.
        ValueError: with the file, the line and the column of an error, or for an episode that does not exist.
    """
    path = os.fspath(path)
    first = path
    if os.path.isdir(path):
        first = os.path.join(path, _first_file(path, episode))
    elif episode is not None:
        os.stat(path)
        raise ValueError(f"episode is {short(episode)}, expected None for a file")
    # the error of a file that the system cannot read
    with open(first, "rb"):
        pass
    return _native.read_flight(path, episode)


def _first_file(folder: str, episode: Any) -> str:
    """Returns the name of the file of the first drone in a directory."""
    names = os.listdir(folder)
    if episode is None and "drone0.csv" in names:
        return "drone0.csv"
    found = [re.fullmatch(r"episode_(\d{4,})_drone0\.csv", name) for name in names]
    episodes = sorted(int(match[1]) for match in found if match)
    if not episodes:
        if episode is None:
            return "drone0.csv"
        raise ValueError(f"episode is {short(episode)}, expected None: the directory has no files of episodes")
    if episode not in episodes or isinstance(episode, bool):
        numbers = str(episodes[0]) if len(episodes) == 1 else f"one from {episodes[0]} to {episodes[-1]}"
        raise ValueError(f"episode is {short(episode)}, expected {numbers}, as the directory has")
    return f"episode_{episode:04}_drone0.csv"


def _numbers(name: str, value: Any, expected: str) -> np.ndarray:
    """Returns an argument as a new float64 array of one dimension, or raises a ValueError."""
    try:
        return np.array(value, dtype=np.float64).reshape(-1)
    except (TypeError, ValueError):
        raise ValueError(f"{name} is {short(value)}, expected {expected}") from None


def _cell(number: float) -> str:
    """Returns a number as a cell that reads back exactly; empty for NaN."""
    return "" if np.isnan(number) else repr(float(number) + 0.0)


def _now() -> str:
    return datetime.now().strftime("%m.%d.%Y_%H.%M.%S")
