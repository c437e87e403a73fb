"""The package next to the package `mujoco` (3.x) in one process, and the libraries that it loads."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

import mujoco_drones_gym

SCRIPT = """
import hashlib, json, sys, threading

def digest(array):
    return hashlib.sha1(array.tobytes()).hexdigest()

def own():
    import numpy as np
    from mujoco_drones_gym import HoverAviary
    env = HoverAviary(render_mode="rgb_array", width=96, height=64)
    env.reset(seed=1)
    for _ in range(30):
        observation = env.step(np.full(4, 0.05))[0]
    image = env.render()
    assert image.std() > 1
    return [digest(observation), digest(image)]

def other():
    import mujoco
    model = mujoco.MjModel.from_xml_string(
        '<mujoco><worldbody><light pos="0 0 3"/><geom type="plane" size="2 2 .1"/><body pos="0 0 1"><freejoint/>'
        '<geom type="box" size=".1 .2 .3" rgba="1 0 0 1"/></body></worldbody></mujoco>'
    )
    data = mujoco.MjData(model)
    for _ in range(500):
        mujoco.mj_step(model, data)
    with mujoco.Renderer(model, 64, 96) as renderer:
        renderer.update_scene(data)
        image = renderer.render()
    assert image.std() > 1
    return [digest(data.qpos), digest(image)]

def run(name):
    results.setdefault(name, []).append(own() if name == "own" else other())

results = {}
for names in sys.argv[1:]:
    threads = [threading.Thread(target=run, args=(name,)) for name in names.split("+")[1:]]
    for thread in threads:
        thread.start()
    run(names.split("+")[0])
    for thread in threads:
        thread.join()
print(json.dumps(results))
"""


def run(*names):
    """Runs the packages in turn in one process and returns the digests of their results; `a+b` runs two threads."""
    environment = {**os.environ, "MUJOCO_GL": "egl"}
    command = [sys.executable, "-c", SCRIPT, *names]
    done = subprocess.run(command, capture_output=True, text=True, env=environment, timeout=300, check=False)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout.splitlines()[-1])


def test_both_packages_step_and_render_in_one_process_in_any_order():
    mujoco = pytest.importorskip("mujoco")
    assert int(mujoco.__version__.split(".")[0]) >= 3
    expected = {**run("own"), **run("other")}
    for names in (["own", "other", "own", "other"], ["other", "own", "other", "own"], ["other+own", "own+other"]):
        results = run(*names)
        for name in ("own", "other"):
            assert all(result == expected[name][0] for result in results[name]), (names, name)


def test_a_wheel_loads_its_own_libraries_alone():
    own = Path(mujoco_drones_gym.__file__).parent.parent / "mujoco_drones_gym.libs"
    if not own.is_dir():
        pytest.skip("the package has no libraries of its own: it was built without them")
    code = """
from mujoco_drones_gym import HoverAviary
env = HoverAviary()
env.reset(seed=1)
print(*{line.split()[-1] for line in open("/proc/self/maps") if ".so" in line}, sep="\\n")
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    loaded = {Path(line) for line in done.stdout.splitlines()}
    assert {path.name for path in own.iterdir()} <= {path.name for path in loaded}
    for name in ("libmujoco", "libccd", "libqhull", "libtinyxml2", "liblodepng"):
        found = [path for path in loaded if path.name.startswith(name)]
        assert len(found) == 1 and found[0].parent.resolve() == own.resolve(), (name, found)
