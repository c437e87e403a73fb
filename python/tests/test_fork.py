"""Batches and processes: fork and spawn."""

import multiprocessing
import os
import signal
import subprocess
import sys
import time

import numpy as np
import pytest

from mujoco_drones_gym import VectorAviary

fork = pytest.mark.skipif(not hasattr(os, "fork"), reason="no fork")


def in_child(work):
    """Runs a function in a forked child with a deadline. Returns the text that it returns."""
    reading, writing = os.pipe()
    child = os.fork()
    if child == 0:
        try:
            os.write(writing, str(work()).encode())
        except BaseException as error:
            os.write(writing, f"{type(error).__name__}: {error}".encode())
        finally:
            os._exit(0)
    os.close(writing)
    deadline = time.monotonic() + 300
    while os.waitpid(child, os.WNOHANG)[0] == 0:
        if time.monotonic() > deadline:
            os.kill(child, signal.SIGKILL)
            os.waitpid(child, 0)
            os.close(reading)
            return "hangs"
        time.sleep(0.01)
    with os.fdopen(reading) as file:
        return file.read()


@fork
@pytest.mark.parametrize("threads", [1, 2])
def test_a_batch_of_the_parent_is_an_error_in_the_child(threads):
    env = VectorAviary("hover", 64, num_threads=threads)
    env.reset(seed=1)
    actions = np.zeros((64, 4))
    env.step(actions)
    message = "RuntimeError: this batch belongs to the parent of this forked process, expected a new batch in the child"
    for use in (lambda: env.step(actions), lambda: env.reset(seed=1), lambda: env.states(), lambda: env.envs[0].info()):
        assert in_child(use) == message
    env.step(actions)


@fork
def test_new_batches_work_in_the_child_and_inherited_ones_can_be_dropped():
    env = VectorAviary("hover", 64, num_threads=2)
    env.reset(seed=1)
    actions = np.full((64, 4), 0.05)
    expected = env.step(actions)[0]

    def work():
        nonlocal env
        env.close()
        env = None
        child = VectorAviary("hover", 64, num_threads=2)
        child.reset(seed=1)
        return np.array_equal(child.step(actions)[0], expected)

    assert in_child(work) == "True"
    env.step(actions)


@fork
def test_new_batches_render_images_in_the_child():
    def first_images():
        env = VectorAviary("hover", 9, num_threads=2, obs_type="rgb")
        return env.reset(seed=1)[0]

    expected = first_images()
    assert expected.std() > 1
    assert in_child(lambda: np.array_equal(first_images(), expected)) == "True"
    np.testing.assert_array_equal(first_images(), expected)


@fork
def test_a_fork_during_a_step_of_another_thread():
    import threading

    env = VectorAviary("hover", 4096, num_threads=2)
    env.reset(seed=1)
    actions, stop = np.zeros((4096, 4), np.float32), threading.Event()

    def step():
        while not stop.is_set():
            env.step(actions)

    thread = threading.Thread(target=step)
    thread.start()
    try:
        for _ in range(5):
            assert in_child(lambda: env.step(actions)).startswith("RuntimeError: this batch belongs to the parent")
            assert in_child(lambda: VectorAviary("hover", 64, num_threads=2).reset(seed=1)[0].shape) == "(64, 12)"
    finally:
        stop.set()
        thread.join()


def first_step(task):
    env = VectorAviary(task, 16, num_threads=2)
    env.reset(seed=3)
    return env.step(np.zeros(env.action_space.shape))[0]


@pytest.mark.parametrize("method", ["fork", "spawn", "forkserver"])
def test_processes_of_every_start_method_agree(method):
    if method not in multiprocessing.get_all_start_methods():
        pytest.skip(f"no start method {method}")
    keep = VectorAviary("hover", 16, num_threads=2)
    keep.reset(seed=1)
    context = multiprocessing.get_context(method)
    with context.Pool(2) as pool:
        results = pool.map_async(first_step, ["hover", "multi_hover", "hover"]).get(timeout=300)
    np.testing.assert_array_equal(results[0], first_step("hover"))
    np.testing.assert_array_equal(results[0], results[2])
    np.testing.assert_array_equal(results[1], first_step("multi_hover"))


def test_the_interpreter_ends_with_live_batches():
    code = """
import numpy as np
from mujoco_drones_gym import VectorAviary

envs = [VectorAviary("hover", 9, num_threads=2, obs_type="kin_rgb") for _ in range(2)]
for env in envs:
    env.reset(seed=1)
    env.step(np.zeros((9, 4)))
print("done")
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=300, check=False)
    assert (done.returncode, done.stdout) == (0, "done\n"), done.stderr
