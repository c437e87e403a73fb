"""Logs of flights."""

import csv
import subprocess
import sys

import gymnasium as gym
import numpy as np
import pytest

from mujoco_drones_gym.utils.logger import Logger, read_flight

# the columns of `aviary fly --out`
COLUMNS = [
    *("t", "drone", "x", "y", "z", "qw", "qx", "qy", "qz", "vx", "vy", "vz", "wx", "wy", "wz"),
    *("roll", "pitch", "yaw", "rpm0", "rpm1", "rpm2", "rpm3"),
]


def state(seed):
    numbers = np.random.default_rng(seed).normal(size=20)
    numbers[16:20] = 14000.0 + 100.0 * numbers[16:20]
    return numbers


def test_csv_files_have_the_columns_of_the_simulator_and_every_digit(tmp_path):
    logger = Logger(num_drones=2, logging_freq=48, output_folder=tmp_path / "out")
    for step in range(5):
        for drone in range(2):
            logger.log(drone, step / 48, state(10 * step + drone))
    assert logger.save_to_csv("first")[1].endswith("first_drone1.csv")
    paths = logger.save_to_csv()
    assert [path.rsplit("/", 1)[1] for path in paths] == ["drone0.csv", "drone1.csv"]
    for drone, path in enumerate(paths):
        with open(path, newline="") as file:
            rows = list(csv.DictReader(file))
        assert list(rows[0]) == COLUMNS and len(rows) == 5
        for step, row in enumerate(rows):
            numbers = state(10 * step + drone)
            assert (float(row["t"]), int(row["drone"])) == (step / 48, drone)
            named = {
                "x": 0, "z": 2, "qw": 3, "qz": 6, "roll": 7, "yaw": 9, "vx": 10, "vz": 12, "wx": 13, "wz": 15,
                "rpm0": 16, "rpm3": 19,
            }  # fmt: skip
            for column, index in named.items():
                assert float(row[column]) == numbers[index], column


def test_flights_read_back_exactly(tmp_path):
    logger = Logger(2, 48, tmp_path)
    attitude = np.array([0.8, 0.0, 0.6, 0.0])
    for step in range(4):
        for drone in range(2):
            numbers = state(step)
            numbers[3:7] = attitude
            target = np.arange(12.0) + step
            logger.log(drone, step / 48, numbers, target if drone else None)
    logger.save_to_csv()
    flight = read_flight(tmp_path)
    assert len(flight) == 2
    for drone, log in enumerate(flight):
        assert np.array_equal(log["t"], np.arange(4) / 48)
        # roll, pitch and yaw follow from the quaternion
        columns = [*range(7), *range(10, 20)]
        assert np.array_equal(log["state"][:, columns], logger.states[drone].T[:, columns])
    assert np.isnan(flight[0]["reference"]).all()
    assert np.array_equal(flight[1]["reference"][2], [2.0, 3.0, 4.0, 10.0])


def test_arrays_have_a_row_per_call(tmp_path):
    logger = Logger(logging_freq_hz=10, output_folder=str(tmp_path), num_drones=2, duration_sec=5)
    logger.log(drone=0, timestamp=0.5, state=state(1), control=np.arange(12.0))
    logger.log(drone=0, timestamp=None, state=state(2), control=[1.0, 2.0, 3.0, 4.0])
    logger.log(drone=1, timestamp=None, state=state(3))
    assert logger.counters.tolist() == [2, 1]
    assert logger.timestamps[0].tolist() == pytest.approx([0.5, 0.6])
    assert logger.timestamps[1, 0] == 0.0 and np.isnan(logger.timestamps[1, 1])
    assert np.array_equal(logger.states[0, :, 0], state(1)) and np.array_equal(logger.states[1, :, 0], state(3))
    assert logger.states[0, 16:, 1].tolist() == [1.0, 2.0, 3.0, 4.0]
    assert np.array_equal(logger.controls[0, :, 0], np.arange(12.0)) and np.isnan(logger.controls[1]).all()
    with np.load(logger.save()) as saved:
        assert np.array_equal(saved["states"], logger.states, equal_nan=True)
    directory = logger.save_as_csv("first")
    assert "save-flight-first-" in directory and len(read_flight(directory)[0]["t"]) == 2
    logger.reset()
    assert logger.counters.tolist() == [0, 0] and logger.states.shape == (2, 20, 0)


def test_environments_are_logged_with_their_time():
    from mujoco_drones_gym import BaseAviary

    env = gym.wrappers.TimeLimit(BaseAviary(num_drones=2), 10)
    logger = Logger(num_drones=2)
    env.reset(seed=1)
    for _ in range(3):
        logger.log_env(env)
        env.step(np.full(8, 15000.0))
    assert logger.timestamps.tolist() == [pytest.approx([0.0, 1 / 48, 2 / 48])] * 2
    logger.log_env(env)
    for drone in range(2):
        assert np.array_equal(logger.states[drone, :, -1], env.unwrapped._getDroneStateVector(drone))
    with pytest.raises(ValueError, match="num_drones is 1, expected 2, as the environment has"):
        Logger(num_drones=1).log_env(env)
    with pytest.raises(TypeError, match="log_env got CartPoleEnv, expected an environment of mujoco_drones_gym"):
        logger.log_env(gym.make("CartPole-v1"))


def test_logged_states_are_copies(tmp_path):
    numbers = state(1)
    logger = Logger(output_folder=tmp_path)
    logger.log(0, 0.0, numbers)
    numbers[:] = 0.0
    assert np.array_equal(logger.states[0, :, 0], state(1))


def test_plots_have_four_panels_and_need_no_display(tmp_path):
    pytest.importorskip("matplotlib")
    logger = Logger(num_drones=2, output_folder=tmp_path)
    for step in range(10):
        for drone in range(2):
            logger.log(drone, step / 48, state(step))
    figure = logger.plot()
    labels = [axis.get_ylabel() for axis in figure.axes]
    assert labels == ["position, m", "attitude, rad", "velocity, m/s", "motor speeds, rpm"]
    assert [len(axis.lines) for axis in figure.axes] == [6, 6, 6, 8]
    assert np.array_equal(figure.axes[0].lines[2].get_ydata(), logger.states[0, 2])
    assert (tmp_path / "flight.png").read_bytes().startswith(b"\x89PNG")
    logger.plot(tmp_path / "flight.svg")
    assert (tmp_path / "flight.svg").exists()


def test_importing_the_logger_does_not_import_matplotlib():
    code = "import sys, mujoco_drones_gym.utils.logger; assert 'matplotlib' not in sys.modules"
    subprocess.run([sys.executable, "-c", code], check=True)


def test_errors_name_the_value(tmp_path):
    logger = Logger(num_drones=2, output_folder=tmp_path / "none")
    for arguments, text in [
        ((2, 0.0, state(1)), "drone is 2, expected 0 to 1"),
        ((-1, 0.0, state(1)), "drone is -1"),
        ((0, -0.1, state(1)), "timestamp is -0.1, expected a time in s from 0"),
        (("a", 0.0, state(1)), "drone is 'a', expected 0 to 1"),
        ((None, 0.0, state(1)), "drone is None"),
        ((0.0, 0.0, state(1)), "drone is 0.0"),
        ((0, "a", state(1)), "timestamp is 'a', expected a time in s from 0"),
        ((0, [0.0, 1.0], state(1)), "timestamp is [0.0, 1.0], expected"),
        ((0, 0.0, None), "state"),
        ((0, 0.0, "abc"), "state is 'abc', expected the 20 numbers of a drone"),
        ((0, 0.0, state(1), "abc"), "control is 'abc', expected 12 targets or 4 motor speeds"),
        ((0, 0.0, np.zeros(12)), "state has 12 numbers, expected the 20 of a drone"),
        ((0, 0.0, state(1), np.zeros(3)), "control has 3 numbers, expected 12 targets or 4 motor speeds"),
    ]:
        with pytest.raises(ValueError) as error:
            logger.log(*arguments)
        assert str(error.value).startswith(text)
    assert logger.counters.tolist() == [0, 0] and not (tmp_path / "none").exists()
    with pytest.raises(ValueError, match="num_drones is 0"):
        Logger(num_drones=0)
    with pytest.raises(ValueError, match="logging_freq is 'out', expected a positive number"):
        Logger(1, "out")
    with pytest.raises(TypeError, match="frequency"):
        Logger(frequency=3)
    broken = tmp_path / "drone0.csv"
    broken.write_text("t,x\n0,1\n")
    with pytest.raises(ValueError, match=r"drone0\.csv"):
        read_flight(tmp_path)
    with pytest.raises(FileNotFoundError):
        read_flight(tmp_path / "nowhere")
