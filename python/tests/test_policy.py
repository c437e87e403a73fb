"""Policies of `aviary train`."""

import itertools
import json
import pathlib
import pickle
import struct

import numpy as np
import pytest

from mujoco_drones_gym.policy import Policy

ASSETS = pathlib.Path(__file__).parents[2] / "assets" / "policies"

INFO = {
    "version": 2,
    "task": "hover",
    "drone": "cf2x",
    "num_drones": 1,
    "per_drone": False,
    "action_type": "rpm",
    "sim_freq": 240,
    "ctrl_freq": 48,
    "seed": 7,
    "steps": 1000,
    "command": "aviary train --task hover",
    "made_by": "a test",
    "training": 'physics = "mjc"\n',
}


def write_policy(path, sizes=(12, 16, 4), low=-1.0, high=1.0, activation="softsign", seed=0, units=0, **info):
    """Writes a policy as the trainer does, with recurrent units or without, and returns its tensors."""
    rng = np.random.default_rng(seed)
    tensors = {
        "observation.mean": rng.normal(size=sizes[0]),
        "observation.deviation": rng.uniform(0.5, 2.0, sizes[0]),
        "action.low": np.full(sizes[-1], low),
        "action.high": np.full(sizes[-1], high),
    }
    if units:
        for part, inputs in (("input", sizes[0]), ("state", units)):
            tensors[f"gru.{part}.weight"] = rng.normal(size=(inputs, 3 * units)) / np.sqrt(inputs)
            tensors[f"gru.{part}.bias"] = 0.1 * rng.normal(size=3 * units)
        info = {"version": 3, **info}
        sizes = (sizes[0] + units, *sizes[1:])
    for layer, (inputs, outputs) in enumerate(itertools.pairwise(sizes)):
        tensors[f"layer{layer}.weight"] = rng.normal(size=(inputs, outputs)) / np.sqrt(inputs)
        tensors[f"layer{layer}.bias"] = 0.1 * rng.normal(size=outputs)
    tensors = {name: value.astype(np.float32) for name, value in tensors.items()}
    header, data = {"__metadata__": {"policy": json.dumps({"info": {**INFO, **info}, "activation": activation})}}, b""
    for name, value in tensors.items():
        header[name] = {"dtype": "F32", "shape": value.shape, "data_offsets": [len(data), len(data) + value.nbytes]}
        data += value.tobytes()
    text = json.dumps(header).encode()
    text += b" " * (-len(text) % 8)
    path.write_bytes(struct.pack("<Q", len(text)) + text + data)
    return tensors


def expected_actions(tensors, observation):
    """The policy's formula in double precision."""
    x = (np.asarray(observation, dtype=np.float64) - tensors["observation.mean"]) / tensors["observation.deviation"]
    x = np.clip(x, -10, 10)
    layers = sum(name.startswith("layer") and name.endswith("weight") for name in tensors)
    for layer in range(layers):
        x = x @ tensors[f"layer{layer}.weight"].astype(np.float64) + tensors[f"layer{layer}.bias"]
        if layer + 1 < layers:
            x = x / (1 + np.abs(x))
    low, high = tensors["action.low"].astype(np.float64), tensors["action.high"].astype(np.float64)
    return np.clip((low + high) / 2 + (high - low) / 2 * x, low, high)


def test_actions_are_those_of_the_network(tmp_path):
    path = tmp_path / "policy.safetensors"
    tensors = write_policy(path, low=-2.0, high=3.0)
    policy = Policy.load(path)
    assert (policy.observation_size, policy.action_size) == (12, 4)
    observations = np.random.default_rng(1).normal(size=(50, 12)).astype(np.float32)
    expected = expected_actions(tensors, observations)
    actions = policy(observations)
    assert actions.dtype == np.float32 and actions.shape == (50, 4)
    assert actions == pytest.approx(expected, abs=2e-5)
    for observation, action in zip(observations, actions, strict=True):
        single = policy(observation)
        assert single.shape == (4,) and np.array_equal(single, action), "a batch changes no bit"
    assert np.array_equal(policy(observations.reshape(5, 10, 12)).reshape(50, 4), actions)
    assert np.array_equal(policy(observations[:, ::-1][:, ::-1]), actions), "any memory layout"
    assert np.array_equal(policy(list(observations[0])), actions[0])
    assert np.array_equal(policy({"kin": observations, "rgb": None}), actions)
    assert policy(np.empty((0, 12))).shape == (0, 4)
    predicted, state = policy.predict(observations, deterministic=True)
    assert np.array_equal(predicted, actions) and state is None


def expected_memory(tensors, observation, memory):
    """The equations of PyTorch's GRU in double precision."""
    x = (np.asarray(observation, dtype=np.float64) - tensors["observation.mean"]) / tensors["observation.deviation"]
    of_input = x @ tensors["gru.input.weight"].astype(np.float64) + tensors["gru.input.bias"]
    of_state = memory @ tensors["gru.state.weight"].astype(np.float64) + tensors["gru.state.bias"]
    (r, z, n), (hr, hz, hn) = np.split(of_input, 3, axis=-1), np.split(of_state, 3, axis=-1)
    reset, update = 1 / (1 + np.exp(-r - hr)), 1 / (1 + np.exp(-z - hz))
    return (1 - update) * np.tanh(n + reset * hn) + update * memory


def test_recurrent_policies_take_and_return_a_state(tmp_path):
    path = tmp_path / "policy.safetensors"
    tensors = write_policy(path, units=5)
    policy = Policy.load(path)
    assert (policy.observation_size, policy.memory_size) == (12, 5)
    observations = np.random.default_rng(3).normal(size=(6, 2, 12)).astype(np.float32)
    state, expected, single = None, np.zeros((2, 5)), None
    for step, observation in enumerate(observations):
        starts = np.array([step == 3, False])
        expected[starts] = 0.0
        expected = expected_memory(tensors, observation, expected)
        actions, state = policy.predict(observation, state, episode_start=starts)
        assert actions.shape == (2, 4) and state.shape == (2, 5) and state.dtype == np.float32
        assert state == pytest.approx(expected, abs=2e-5)
        alone, single = policy.predict({"drone0": observation[1]}, single)
        assert np.array_equal(alone["drone0"], actions[1]) and np.array_equal(single["drone0"], state[1])
    with pytest.raises(ValueError, match="the policy is recurrent"):
        policy(observations[0])
    with pytest.raises(ValueError, match=r"state has the shape \(5,\), expected \(2, 5\)"):
        policy.predict(observations[0], state[0])


def test_policies_per_drone_fly_any_number_of_drones(tmp_path):
    path = tmp_path / "policy.safetensors"
    write_policy(path, sizes=(13, 8, 4), per_drone=True, num_drones=2, task="multi_hover")
    policy = Policy.load(str(path))
    observations = np.random.default_rng(2).normal(size=(7, 3 * 13))
    actions = policy(observations)
    assert actions.shape == (7, 12)
    assert np.array_equal(actions.reshape(21, 4), policy(observations.reshape(21, 13)))
    agents = {f"drone{i}": observations[0, 13 * i : 13 * i + 13] for i in range(3)}
    assert np.array_equal(np.concatenate(list(policy(agents).values())), actions[0])


def test_metadata_and_pickling(tmp_path):
    path = tmp_path / "policy.safetensors"
    write_policy(path)
    policy = Policy.load(path)
    assert policy.info["task"] == "hover" and policy.info["ctrl_freq"] == 48 and policy.info["steps"] == 1000
    assert repr(policy) == "<Policy hover: 12 observations, 4 actions>"
    clone = pickle.loads(pickle.dumps(policy))
    observation = np.linspace(-1, 1, 12)
    assert clone.info == policy.info and np.array_equal(clone(observation), policy(observation))


def test_errors_of_files_name_the_file(tmp_path):
    missing = tmp_path / "none.safetensors"
    with pytest.raises(FileNotFoundError) as error:
        Policy.load(missing)
    assert str(missing) in str(error.value) and "\n" not in str(error.value)
    with pytest.raises(OSError, match="directory"):
        Policy.load(tmp_path)
    other = tmp_path / "other.safetensors"
    other.write_bytes(b"PK\x03\x04 not a policy")
    with pytest.raises(ValueError, match=r"other\.safetensors: not a policy"):
        Policy.load(other)
    write_policy(other, version=4)
    with pytest.raises(ValueError, match="its version is 4, expected up to 3"):
        Policy.load(other)
    write_policy(other)
    content = other.read_bytes()
    other.write_bytes(content[:-10])
    with pytest.raises(ValueError, match="not a policy"):
        Policy.load(other)


@pytest.mark.parametrize("shape", [(11,), (13,), (5, 11), (24,), ()])
def test_errors_of_shapes_name_the_expected_one(tmp_path, shape):
    path = tmp_path / "policy.safetensors"
    write_policy(path)
    with pytest.raises(ValueError) as error:
        Policy.load(path)(np.zeros(shape))
    assert str(error.value) == f"observation has the shape {shape}, expected (..., n) with n 12"


@pytest.mark.skipif(not ASSETS.is_dir(), reason="the policies are in a checkout of the repository")
@pytest.mark.parametrize(("name", "task"), [("hover", "HoverAviary"), ("fly_through", "FlyThroughAviary")])
def test_policies_of_the_repository_solve_their_tasks(name, task):
    import mujoco_drones_gym

    policy = Policy.load(ASSETS / f"{name}.safetensors")
    env = getattr(mujoco_drones_gym, task)(
        act_type=policy.info["action_type"], engine="hybrid", randomization={"initial": {}}
    )
    policy.check(env)
    for seed in range(3):
        observation, info = env.reset(seed=seed)
        done = False
        while not done:
            action = policy(observation)
            assert env.action_space.contains(action)
            observation, _, terminated, truncated, info = env.step(action)
            done = terminated or truncated
        assert info["is_success"], (seed, info)
    with pytest.raises(ValueError, match=r"the policy has .* observations and .* actions .*, the environment"):
        policy.check(mujoco_drones_gym.MultiHoverAviary())
