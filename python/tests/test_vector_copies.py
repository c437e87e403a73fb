"""New arrays of `VectorAviary` with `copy=True`: their memory, masked resets and errors."""

import gc
import pickle
import subprocess
import sys

import numpy as np
import pytest
from gymnasium.error import ResetNeeded

from mujoco_drones_gym import VectorAviary

CONDITIONS = {
    "plain": {},
    "noisy and late": {"randomization": {"sensors": {"position": 0.01, "latency": (0.03, 0.03)}}},
}


@pytest.mark.parametrize("condition", CONDITIONS)
@pytest.mark.parametrize("mode", ["NextStep", "SameStep", "Disabled"])
def test_copies_equal_views_after_steps_and_masked_resets(mode, condition):
    count = 21
    options = {
        **CONDITIONS[condition],
        "autoreset_mode": mode,
        "num_threads": 2,
        "max_episode_steps": 17,
        "initial_xyzs": [[0, 0, 0.6]],
    }
    copies, views = [VectorAviary("hover", count, copy=copy, **options) for copy in (True, False)]
    rng = np.random.default_rng(1)
    np.testing.assert_array_equal(copies.reset(seed=5)[0], views.reset(seed=5)[0])
    kept, snapshots = [], []
    for step in range(60):
        actions = rng.uniform(-0.3, 0.4, (count, 4))
        new, same = copies.step(actions), views.step(actions)
        for a, b in zip(new[:4], same[:4], strict=True):
            np.testing.assert_array_equal(a, b)
        over = new[2] | new[3]
        kept.append(new[:4])
        snapshots.append([array.copy() for array in new[:4]])
        if step % 5 == 2 or (mode == "Disabled" and over.any()):
            mask = rng.random(count) < 0.3
            mask = mask | over if mode == "Disabled" else mask
            mask[3] = True
            seed = [int(seed) for seed in rng.integers(9, size=count)] if step % 2 else None
            # what the caller does with earlier arrays has no effect on later ones
            writable = new[0].copy()
            new[0][...] = 77.0
            obs, _ = copies.reset(seed=seed, options={"reset_mask": mask})
            np.testing.assert_array_equal(obs, views.reset(seed=seed, options={"reset_mask": mask})[0])
            np.testing.assert_array_equal(obs[~mask], writable[~mask])
            snapshots[-1][0][...] = 77.0
    # no later step has written to an array that exists
    for arrays, before in zip(kept, snapshots, strict=True):
        for a, b in zip(arrays, before, strict=True):
            np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize("keep", ["array", "row", "reshaped", "buffer", "field"])
@pytest.mark.parametrize("part", range(4))
def test_a_view_of_an_array_keeps_its_memory(part, keep):
    env = VectorAviary("hover", 33)
    env.reset(seed=1)
    views = {
        "array": lambda array: array,
        "row": lambda array: array[3:],
        "reshaped": lambda array: array.reshape(-1, 1)[::2],
        "buffer": memoryview,
        "field": lambda array: array.view(np.uint8),
    }
    kept = []
    for step in range(8):
        array = env.step(np.full((33, 4), 0.05 * step))[part]
        array[...] = step % 2 if array.dtype == bool else step
        kept.append(views[keep](array))
        del array
        gc.collect()
    for step, view in enumerate(kept):
        numbers = np.asarray(view)
        expected = np.full(1, step % 2 if part > 1 else step, env.step(np.zeros((33, 4)))[part].dtype)
        expected = expected.view(np.uint8) if keep == "field" else expected
        assert np.array_equal(numbers.reshape(-1, expected.size), np.tile(expected, (numbers.size // expected.size, 1)))


def test_memory_that_the_caller_has_dropped_is_used_again():
    env = VectorAviary("hover", 33)
    env.reset(seed=1)
    addresses = {tuple(array.ctypes.data for array in env.step(np.zeros((33, 4)))[:4]) for _ in range(50)}
    assert len(addresses) <= 3
    arrays = [env.step(np.zeros((33, 4)))[0] for _ in range(20)]
    assert len({array.ctypes.data for array in arrays}) == 20


def test_arrays_of_the_caller_keep_their_own_shape_and_flags():
    env = VectorAviary("hover", 4)
    env.reset(seed=1)
    obs = env.step(np.zeros((4, 4)))[0]
    obs.setflags(write=False)
    obs.shape = (48,)
    del obs
    for _ in range(4):
        obs = env.step(np.zeros((4, 4)))[0]
        assert obs.shape == (4, 12) and obs.flags.c_contiguous and obs.flags.aligned
        obs[...] = 1.0  # fails for a read-only array


@pytest.mark.parametrize("part", ["rewards", "observations"])
def test_actions_may_be_earlier_results(part):
    options = {"act_type": "one_d_rpm", "on_fault": "truncate", "num_threads": 2}
    envs = [VectorAviary("hover", 40, **options) for _ in range(2)]
    for env in envs:
        env.reset(seed=1)
        obs, rewards, *_ = env.step(0.3 * np.ones((40, 1)))
    for _ in range(20):
        actions = rewards.reshape(40, 1) if part == "rewards" else obs.reshape(-1)[5:45].reshape(40, 1)
        copied = actions.copy()
        a, b = envs[0].step(actions), envs[1].step(copied)
        np.testing.assert_array_equal(actions, copied)
        for x, y in zip(a[:4], b[:4], strict=True):
            np.testing.assert_array_equal(x, y)
        obs, rewards, *_ = a


def test_an_error_of_arguments_changes_no_array_and_no_later_observation():
    env = VectorAviary("hover", 9, autoreset_mode="Disabled", max_episode_steps=3)
    env.reset(seed=1)
    for _ in range(3):
        results = env.step(np.zeros((9, 4)))[:4]
    before = [array.copy() for array in results]
    bad = np.full((9, 4), np.inf)
    for actions, error in [(np.zeros((9, 4)), ResetNeeded), (bad, ResetNeeded), (np.zeros((9, 3)), ValueError)]:
        with pytest.raises(error):
            env.step(actions)
    with pytest.raises(ValueError, match="reset_mask"):
        env.reset(options={"reset_mask": np.zeros(9, bool)})
    for array, expected in zip(results, before, strict=True):
        np.testing.assert_array_equal(array, expected)
    mask = np.arange(9) == 4
    obs, _ = env.reset(seed=1, options={"reset_mask": mask})
    np.testing.assert_array_equal(obs[~mask], before[0][~mask])
    assert not np.array_equal(obs[4], before[0][4])


def test_a_pickled_environment_keeps_the_option_copy():
    env = pickle.loads(pickle.dumps(VectorAviary("hover", 3)))
    obs, _ = env.reset(seed=1)
    assert env.step(np.zeros((3, 4)))[0] is not obs
    env = pickle.loads(pickle.dumps(VectorAviary("hover", 3, copy=False)))
    obs, _ = env.reset(seed=1)
    assert env.step(np.zeros((3, 4)))[0] is obs


@pytest.mark.parametrize("copy", [True, False])
def test_a_masked_reset_renders_the_images_of_its_mask(copy):
    options = {"obs_type": "kin_rgb", "initial_xyzs": [[0, 0, 0.6]]}
    env = VectorAviary("hover", 4, copy=copy, **options)
    env.reset(seed=1)
    for step in range(8):
        obs, *_ = env.step(np.full((4, 4), [0.02, 0.0, 0.02, 0.0]) * (1 + step % 2))
    last = {name: part.copy() for name, part in obs.items()}
    mask = np.array([False, True, False, True])
    obs, _ = env.reset(options={"reset_mask": mask})
    for name in ("kin", "rgb"):
        np.testing.assert_array_equal(obs[name][~mask], last[name][~mask])
        assert not np.array_equal(obs[name][1], last[name][1])


def test_more_environments_than_fit_into_memory_are_an_error_of_one_line():
    code = """
import resource
from mujoco_drones_gym import VectorAviary
VectorAviary("hover", 300)
resource.setrlimit(resource.RLIMIT_AS, (4 << 30, 4 << 30))
for count, options in [(1 << 24, {}), (1 << 22, {"randomization": True}), (1 << 19, {"obs_type": "rgb"})]:
    try:
        VectorAviary("hover", count, **options)
    except MemoryError as error:
        print(error)
VectorAviary("hover", 300).reset(seed=1)
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    lines = done.stdout.splitlines()
    assert len(lines) == 3
    for line, count in zip(lines, (1 << 24, 1 << 22, 1 << 19), strict=True):
        assert line.startswith(f"num_envs is {count}, expected at most ")


@pytest.mark.parametrize("copy", [True, False])
def test_results_and_tensors_share_their_memory_by_dlpack(copy):
    torch = pytest.importorskip("torch")
    env = VectorAviary("hover", 4, copy=copy)
    observations, _ = env.reset(seed=1)
    step = env.step(torch.zeros((4, 4), dtype=torch.float64))
    for array in (observations, *step[:4]):
        tensor = torch.from_dlpack(array)
        assert tensor.shape == array.shape and tensor.data_ptr() == array.ctypes.data
        np.testing.assert_array_equal(tensor.numpy(), array)
    env.close()
