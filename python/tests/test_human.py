"""The window of `render_mode="human"`, on an X server without a screen. A program has one connection to a display."""

import re
import shutil

import pytest
from conftest import without_display, x_server

import mujoco_drones_gym as mdg

NO_DISPLAY = "no window can be opened: .*; the window needs a display: set DISPLAY or WAYLAND_DISPLAY"

#: What the programs of the tests share.
START = """
import os, subprocess, sys, time, warnings
import gymnasium as gym
import numpy as np
import mujoco_drones_gym as mdg

warnings.simplefilter("error", UserWarning)


def is_open(env):
    return env.unwrapped._window._window is not None


def bits(value):
    if isinstance(value, dict):
        return [(name, bits(part)) for name, part in value.items()]
    if isinstance(value, (list, tuple)):
        return [bits(part) for part in value]
    array = np.asarray(value)
    return array.dtype.str, array.shape, array.tobytes()


def windows(title):
    command = ["xdotool", "search", "--onlyvisible", "--name", f"^{title}$"]
    return subprocess.run(command, capture_output=True, text=True).stdout.split()


def wait(condition):
    deadline = time.monotonic() + 30
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.02)
"""

needs_xdotool = pytest.mark.skipif(shutil.which("xdotool") is None, reason="needs xdotool: apt-get install xdotool")


def test_a_window_opens_at_the_first_reset_and_closes(run_python, display):
    run_python(
        START + "env = gym.make('mujoco_drones_gym/Hover-v0', render_mode='human')\n"
        "assert env.render_mode == 'human' and env.metadata['render_modes'] == ['human', 'rgb_array']\n"
        "assert not any('libX11' in line for line in open('/proc/self/maps'))\n"
        "assert not is_open(env)\n"
        "env.reset(seed=1)\n"
        "assert is_open(env)\n"
        "start = time.monotonic()\n"
        "for _ in range(10):\n"
        "    env.step(np.zeros(4))\n"
        "assert time.monotonic() - start >= 0.15\n"
        "assert env.render() is None and is_open(env)\n"
        "assert env.unwrapped.render('track').shape == (480, 640, 3)\n"
        "env.reset()\n"
        "env.close()\n"
        "env.close()\n"
        "assert not is_open(env)\n"
        "env.reset(seed=1)\n"
        "assert is_open(env)\n",
        env=display,
    )


@needs_xdotool
def test_the_window_is_visible_until_it_is_closed(run_python, display):
    run_python(
        START + "env = mdg.RaceAviary(gui=True)\n"
        "assert env.render_mode == 'human'\n"
        "assert windows('RaceAviary') == []\n"
        "env.reset(seed=1)\n"
        "wait(lambda: len(windows('RaceAviary')) == 1)\n"
        "env.close()\n"
        "wait(lambda: windows('RaceAviary') == [])\n",
        env=display,
    )


@needs_xdotool
def test_the_loop_goes_on_after_the_person_has_closed_the_window(run_python, display):
    run_python(
        START + "env = mdg.HoverAviary(render_mode='human', ctrl_freq=24)\n"
        "env.reset(seed=1)\n"
        "wait(lambda: len(windows('HoverAviary')) == 1)\n"
        "subprocess.run(['xdotool', 'windowfocus', windows('HoverAviary')[0]], check=True)\n"
        "time.sleep(0.5)\n"
        "subprocess.run(['xdotool', 'key', 'q'], check=True)\n"
        "def step():\n"
        "    if any(env.step(np.zeros(4))[2:4]):\n"
        "        env.reset()\n"
        "    return not is_open(env)\n"
        "wait(step)\n"
        "start = time.monotonic()\n"
        "for _ in range(100):\n"
        "    step()\n"
        "assert time.monotonic() - start < 100 / 24\n"
        "env.reset()\n"
        "assert not is_open(env) and env.render() is None\n"
        "env.close()\n",
        env=display,
    )


@pytest.mark.parametrize(
    ("task", "options"),
    [
        ("HoverAviary", "obs_type='kin_rgb'"),
        ("MultiHoverAviary", "engine='hybrid', wind={'model': 'dryden'}"),
        ("FlyThroughAviary", "obstacles=True, randomization={'body': {'mass': (0.8, 1.2)}, 'sensors': {}}"),
    ],
)
def test_a_window_does_not_change_the_flight(run_python, display, task, options):
    run_python(
        START + "def flight(**mode):\n"
        f"    env = mdg.{task}({options}, ctrl_freq=120, **mode)\n"
        "    env.action_space.seed(1)\n"
        "    results = [env.reset(seed=3)]\n"
        "    for _ in range(40):\n"
        "        results.append(env.step(env.action_space.sample()))\n"
        "        if any(results[-1][2:4]):\n"
        "            results.append(env.reset())\n"
        "    return bits(results), bits(env._env.states())\n"
        "assert flight() == flight(render_mode='human')\n",
        env=display,
    )


def test_a_task_in_python_and_a_changed_start(run_python, display):
    run_python(
        START + "class Task(mdg.BaseAviary):\n"
        "    def _computeReward(self):\n"
        "        return 1.0\n"
        "env = Task(render_mode='human', num_drones=2)\n"
        "env.reset(seed=1)\n"
        "assert env.step(np.full(8, env.HOVER_RPM))[1] == 1.0\n"
        "env.INIT_XYZS = [[0, 0, 1], [0, 1, 1]]\n"
        "env.reset()\n"
        "env.step(np.full(8, env.HOVER_RPM))\n"
        "assert is_open(env)\n",
        env=display,
    )


def test_agents(run_python, display):
    pytest.importorskip("pettingzoo")
    run_python(
        START + "def flight(**mode):\n"
        "    env = mdg.parallel_env('multi_hover', **mode)\n"
        "    results = [env.reset(seed=3)]\n"
        "    for _ in range(10):\n"
        "        results.append(env.step({agent: np.full(4, 0.1) for agent in env.agents}))\n"
        "    return env, bits(results)\n"
        "expected = flight()[1]\n"
        "start = time.monotonic()\n"
        "env, results = flight(gui=True)\n"
        "assert time.monotonic() - start >= 0.15\n"
        "assert env.render_mode == 'human' and 'human' in env.metadata['render_modes']\n"
        "assert results == expected and is_open(env) and env.render() is None\n"
        "env.close()\n"
        "assert not is_open(env)\n",
        env=display,
    )


def test_two_windows_and_the_checker_of_gymnasium(run_python, display):
    run_python(
        START + "from gymnasium.utils.env_checker import check_env\n"
        "envs = [mdg.HoverAviary(render_mode='human') for _ in range(2)]\n"
        "for env in envs:\n"
        "    env.reset(seed=1)\n"
        "    env.step(np.zeros(4))\n"
        "assert all(map(is_open, envs))\n"
        "warnings.simplefilter('ignore')\n"
        "check_env(gym.make('mujoco_drones_gym/Hover-v0', render_mode='human').unwrapped)\n",
        env=display,
    )


def test_a_display_that_disconnects_is_a_warning(run_python):
    with x_server() as (server, variables):
        run_python(
            START + "env = mdg.HoverAviary(render_mode='human')\n"
            "env.reset(seed=1)\n"
            "env.step(np.zeros(4))\n"
            f"os.kill({server.pid}, 9)\n"
            "with warnings.catch_warnings(record=True) as caught:\n"
            "    warnings.simplefilter('always')\n"
            "    wait(lambda: env.step(np.zeros(4)) and not is_open(env))\n"
            "    env.step(np.zeros(4))\n"
            "(warning,) = caught\n"
            "assert 'connection to the display ended' in str(warning.message), warning\n"
            "env.close()\n",
            env=variables,
        )


def test_a_fork_cannot_use_the_window(run_python, display):
    output = run_python(
        START + "env = mdg.HoverAviary(render_mode='human')\n"
        "env.reset(seed=1)\n"
        "if os.fork() == 0:\n"
        "    for use in (lambda: env.step(np.zeros(4)), mdg.HoverAviary(gui=True).reset):\n"
        "        try:\n"
        "            use()\n"
        "        except RuntimeError as error:\n"
        "            print(error, flush=True)\n"
        "    env.close()\n"
        "    env.step(np.zeros(4))\n"
        "    del env\n"
        "    print('child', flush=True)\n"
        "    os._exit(0)\n"
        "os.wait()\n"
        "env.step(np.zeros(4))\n"
        "assert is_open(env)\n",
        env=display,
    )
    first, second, end = output.splitlines()
    assert first == second and first.startswith("a forked process cannot use the window of its parent")
    assert end == "child"


def test_the_interpreter_ends_with_an_open_window(run_python, display):
    for steps in range(0, 40, 8):
        run_python(
            START + "env = mdg.HoverAviary(render_mode='human')\n"
            "env.reset(seed=1)\n"
            f"for _ in range({steps}):\n"
            "    env.step(np.zeros(4))\n",
            env=display,
        )


def test_copies_have_a_window_of_their_own(run_python, display):
    run_python(
        START + "import pickle\n"
        "env = mdg.HoverAviary(render_mode='human')\n"
        "env.reset(seed=1)\n"
        "other = pickle.loads(pickle.dumps(env))\n"
        "assert other.render_mode == 'human' and is_open(env) and not is_open(other)\n"
        "other.reset(seed=1)\n"
        "assert is_open(other)\n",
        env=display,
    )


@pytest.mark.parametrize("environment", ["mdg.HoverAviary(gui=True)", "mdg.MultiAgentAviary(render_mode='human')"])
def test_the_first_reset_needs_a_display(run_python, environment):
    if "MultiAgent" in environment:
        pytest.importorskip("pettingzoo")
    message = run_python(
        START + f"env = {environment}\n"
        "for _ in range(2):\n"
        "    try:\n"
        "        env.reset(seed=1)\n"
        "    except RuntimeError as error:\n"
        "        message = str(error)\n"
        "print(message)\n"
        "env.close()\n",
        env=without_display(),
    ).strip()
    assert re.fullmatch(f"{NO_DISPLAY}.*", message), message


def test_an_environment_names_the_mode_only_if_it_has_it():
    assert mdg.HoverAviary.metadata["render_modes"] == ["human", "rgb_array"]
    for mode in (None, "rgb_array"):
        assert mdg.HoverAviary(render_mode=mode).metadata["render_modes"] == ["rgb_array"]
    assert mdg.HoverAviary(render_mode="human").metadata["render_modes"] == ["human", "rgb_array"]


def test_options_that_contradict_each_other():
    with pytest.raises(ValueError, match="gui is True, expected False with render_mode='rgb_array'"):
        mdg.HoverAviary(gui=True, render_mode="rgb_array")
    assert mdg.HoverAviary(gui=True, render_mode="human").render_mode == "human"
    with pytest.raises(ValueError, match="render_mode is 'hologram', expected 'human', 'rgb_array' or None"):
        mdg.HoverAviary(render_mode="hologram")


def test_batches_have_no_window():
    with pytest.raises(ValueError, match="render_mode is 'human', expected 'rgb_array' or None"):
        mdg.VectorAviary("hover", 2, render_mode="human")
    with pytest.raises(ValueError, match="gui is True, expected an environment of a single agent"):
        mdg.VectorAviary("hover", 2, gui=True)
