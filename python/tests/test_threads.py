"""Environments in Python threads."""

import threading
import time

import numpy as np
import pytest

from mujoco_drones_gym import HoverAviary, MultiAgentAviary, VectorAviary


def run_in_threads(works):
    """Runs functions in threads of their own and returns their results. Raises the first error."""
    results, errors = [None] * len(works), []

    def run(i, work):
        try:
            results[i] = work()
        except BaseException as error:
            errors.append(error)

    threads = [threading.Thread(target=run, args=(i, work)) for i, work in enumerate(works)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    if errors:
        raise errors[0]
    return results


def fly_batch(seed):
    env = VectorAviary("multi_hover", 32, num_threads=2, autoreset_mode="SameStep", episode_seconds=0.5)
    env.reset(seed=seed)
    rng = np.random.default_rng(seed)
    rewards = [env.step(rng.uniform(-1, 1, (32, 8)))[1].sum() for _ in range(60)]
    return rewards, env.states()


def fly_single(seed):
    env = HoverAviary(engine="hybrid", initial_xyzs=[[0, 0, 1]])
    env.reset(seed=seed)
    rng = np.random.default_rng(seed)
    return [env.step(rng.uniform(-0.01, 0.01, 4))[1] for _ in range(40)]


def fly_agents(seed):
    env = MultiAgentAviary(num_drones=3)
    env.reset(seed=seed)
    return [sum(env.step({agent: np.full(4, 0.02) for agent in env.agents})[1].values()) for _ in range(40)]


@pytest.mark.parametrize("fly", [fly_batch, fly_single, fly_agents])
def test_threads_with_an_environment_each_agree_with_one_thread(fly):
    expected = [fly(seed) for seed in range(4)]
    results = run_in_threads([lambda seed=seed: fly(seed) for seed in range(4)])
    for got, wanted in zip(results, expected, strict=True):
        for a, b in zip(got, wanted, strict=True):
            np.testing.assert_array_equal(a, b)


def test_an_environment_may_move_between_threads():
    env = VectorAviary("hover", 16, num_threads=2, obs_type="kin_rgb")
    env.reset(seed=1)
    run_in_threads([lambda: env.step(np.zeros((16, 4)))])
    obs = env.step(np.zeros((16, 4)))[0]
    (made,) = run_in_threads([lambda: VectorAviary("hover", 16, num_threads=2, obs_type="kin_rgb")])
    made.reset(seed=1)
    made.step(np.zeros((16, 4)))
    again = made.step(np.zeros((16, 4)))[0]
    np.testing.assert_array_equal(again["rgb"], obs["rgb"])
    del made
    run_in_threads([env.close])


def test_steps_of_two_threads_overlap():
    calls = [[], []]
    ready = threading.Barrier(2)

    def fly(own):
        env = VectorAviary("hover", 32768, num_threads=1, copy=False)
        env.reset(seed=1)
        actions = np.zeros((32768, 4), np.float32)
        ready.wait()
        for _ in range(60):
            start = time.perf_counter()
            env.step(actions)
            own.append((start, time.perf_counter()))

    run_in_threads([lambda: fly(calls[0]), lambda: fly(calls[1])])
    # a thread can only start a step while the other one has released the GIL
    starts = np.array([start for start, _ in calls[1]])
    overlaps = sum(bool(((starts > start) & (starts < end)).any()) for start, end in calls[0])
    print(f"{overlaps} of 60 steps overlap with the start of a step of the other thread")
    assert overlaps > 6
