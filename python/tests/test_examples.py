"""The programs of examples/python, with few steps."""

import ast
import importlib.util
import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import mujoco_drones_gym

EXAMPLES = Path(__file__).resolve().parents[2] / "examples" / "python"
# modules that the package itself does not need
NEEDS = {
    "multi_agent": ["pettingzoo"],
    "ppo": ["torch"],
    "ray_hover": ["torch", "ray"],
    "sb3_hover": ["stable_baselines3"],
    "sb3_speed": ["stable_baselines3"],
    "torchrl_hover": ["torchrl"],
    "vision": ["PIL"],
}
SCRIPTS = sorted(path.stem for path in EXAMPLES.glob("*.py"))


def environment():
    """Returns environment variables with which a program finds the package that is tested."""
    paths = [str(Path(mujoco_drones_gym.__file__).parents[1]), os.environ.get("PYTHONPATH")]
    return {**os.environ, "PYTHONPATH": os.pathsep.join(path for path in paths if path)}


def run(name, *args):
    """Runs an example and returns its output."""
    for module in NEEDS.get(name, []):
        if importlib.util.find_spec(module) is None:
            pytest.skip(f"needs {module}")
    command = [sys.executable, str(EXAMPLES / f"{name}.py"), *map(str, args)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=600, env=environment(), check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.mark.parametrize("name", SCRIPTS)
def test_an_example_is_short_and_describes_itself(name):
    text = (EXAMPLES / f"{name}.py").read_text()
    assert len(text.splitlines()) < 80
    description = ast.get_docstring(ast.parse(text))
    assert description.splitlines()[0] in " ".join(run(name, "--help").split())


def test_multi_agent():
    lines = run("multi_agent", "--drones", 3).splitlines()
    assert [line for line in lines if "ends after" in line] == [
        f"drone{i} ends after 10.00 s: time_limit" for i in range(3)
    ]
    errors = [float(re.search(r"([\d.]+) m from its target", line)[1]) for line in lines if "return" in line]
    assert len(errors) == 3 and max(errors) < 0.05


@pytest.mark.parametrize(("task", "steps", "near"), [("hover", 72, 0.15), ("track", 72, 0.2)])
def test_mppi(task, steps, near):
    lines = run("mppi", "--task", task, "--steps", steps, "--samples", 32).splitlines()
    assert "from the target" in lines[0]
    assert float(re.search(r"last second ([\d.]+) m", lines[-1])[1]) < near


def test_vision(tmp_path):
    from PIL import Image

    run("vision", "--steps", 24, "--out", tmp_path / "vision.png")
    image = np.asarray(Image.open(tmp_path / "vision.png"))
    assert image.shape == (4 * 48 * 3, 6 * 64 * 3, 3)
    rows = image.reshape(4, -1)
    # each drone has a forest of its own
    assert len({row.tobytes() for row in rows}) == 4
    assert rows.std(axis=1).min() > 5


def test_sb3_hover(tmp_path):
    text = run("sb3_hover", "--envs", 16, "--steps", 6000, "--save", tmp_path / "hover.zip")
    assert re.search(r"0 steps +\d+ s  success +0%\n +5,120 steps", text)
    from stable_baselines3 import PPO

    action, _ = PPO.load(tmp_path / "hover.zip").predict(np.zeros((3, 12), np.float32))
    assert action.shape == (3, 4)


def test_sb3_speed():
    rows = run("sb3_speed", "--steps", 512, "--envs", 16).splitlines()
    assert len(rows) == 3
    for row in rows:
        alone, learning = re.search(r"([\d,]+) alone +([\d,]+) in PPO", row).groups()
        assert 0 < int(learning.replace(",", "")) < int(alone.replace(",", ""))


@pytest.mark.parametrize("name", ["ppo", "torchrl_hover"])
def test_training_loops(name):
    rewards = [float(line.split()[-1]) for line in run(name, "--envs", 128, "--steps", 45 * 4096).splitlines()]
    assert len(rewards) == 45
    # 20 % of the costs of a random policy are gone after a few seconds
    assert np.mean(rewards[-5:]) > 0.8 * np.mean(rewards[:5])
