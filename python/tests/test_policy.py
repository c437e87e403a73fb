"""Policies of `aviary train`."""

import itertools
import json
import pathlib
import pickle
import shutil
import struct
import subprocess
import warnings

import numpy as np
import pytest

import mujoco_drones_gym as mdg
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


def make(kind, task="hover", **options):
    """Returns an environment of a kind."""
    if kind == "single":
        return getattr(mdg, "".join(part.capitalize() for part in task.split("_")) + "Aviary")(**options)
    if kind == "batch":
        return mdg.VectorAviary(task, 2, **options)
    if kind == "agents":
        pytest.importorskip("pettingzoo")
        return mdg.parallel_env(task, **options)
    pytest.importorskip("stable_baselines3")
    from mujoco_drones_gym.sb3 import SB3VecEnv

    return SB3VecEnv(task, 2, **options)


KINDS = ["single", "batch", "agents", "stable_baselines3"]


@pytest.mark.parametrize("kind", KINDS)
def test_a_check_compares_action_types_and_rates(tmp_path, kind):
    path = tmp_path / "policy.safetensors"
    write_policy(path)
    policy = Policy.load(path)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        policy.check(make(kind))
    # all of these have four numbers
    for act_type in ("vel", "pid", "attitude", "ctbr", "raw_rpm"):
        env = make(kind, act_type=act_type)
        assert (env.venv if kind == "stable_baselines3" else env).action_type == act_type
        expected = rf"^the policy has 12 observations and 4 actions \(rpm\), the environment 12 and 4 \({act_type}\)$"
        with pytest.raises(ValueError, match=expected):
            policy.check(env)
    with pytest.warns(UserWarning, match="the policy has a control rate of 48 Hz, the environment 120 Hz"):
        policy.check(make(kind, ctrl_freq=120))


def test_a_check_knows_environments_under_wrappers_and_images(tmp_path):
    import gymnasium as gym

    path = tmp_path / "policy.safetensors"
    write_policy(path)
    policy = Policy.load(path)
    policy.check(gym.make("mujoco_drones_gym/Hover-v0"))
    policy.check(gym.vector.SyncVectorEnv([lambda: gym.make("mujoco_drones_gym/Hover-v0")] * 2))
    with pytest.raises(ValueError, match=r"\(ctbr\)$"):
        policy.check(gym.make("mujoco_drones_gym/Hover-v0", act_type="ctbr"))
    with pytest.raises(ValueError, match=r"\(ctbr\)$"):
        policy.check(gym.vector.SyncVectorEnv([lambda: gym.make("mujoco_drones_gym/Hover-v0", act_type="ctbr")]))
    policy.check(mdg.HoverAviary(obs_type="kin_rgb"))
    for obs_type in ("rgb", "rgb_depth"):
        with pytest.raises(ValueError, match=r"the environment 0 and 4 \(rpm\)"):
            policy.check(mdg.HoverAviary(obs_type=obs_type))
    with pytest.raises(ValueError, match=r"^the policy has .*, the environment 20 and 4 \(raw_rpm\)"):
        policy.check(mdg.BaseAviary())


@pytest.mark.parametrize("kind", KINDS)
def test_a_check_of_a_policy_per_drone(tmp_path, kind):
    path = tmp_path / "policy.safetensors"
    write_policy(path, sizes=(13, 8, 4), per_drone=True, num_drones=2, task="multi_hover")
    policy = Policy.load(path)
    for drones in (2, 4):
        policy.check(make(kind, "multi_hover", num_drones=drones))
    with pytest.raises(ValueError, match=r"the policy has (26|13) observations and [48] actions"):
        policy.check(make(kind, "antipodal", num_drones=2))


@pytest.mark.skipif(shutil.which("cc") is None, reason="needs a C compiler")
def test_exported_c_code_computes_the_same_actions(tmp_path):
    write_policy(tmp_path / "policy.safetensors")
    policy = Policy.load(tmp_path / "policy.safetensors")
    files = policy.export(tmp_path / "code", "c", name="my_policy")
    assert files == [str(tmp_path / "code" / name) for name in ("my_policy.h", "my_policy.c")]
    observation = np.linspace(-1, 1, 12).astype(np.float32)
    numbers = ", ".join(f"{x!r}f" for x in observation.tolist())
    main = f"""#include <stdio.h>
#include "my_policy.h"
int main(void) {{
    const float observation[12] = {{{numbers}}};
    float action[4];
    my_policy_evaluate(observation, action);
    for (int i = 0; i < 4; i++) printf("%.9g\\n", action[i]);
}}
"""
    (tmp_path / "main.c").write_text(main)
    program = tmp_path / "main"
    command = ["cc", "-std=c99", f"-I{tmp_path / 'code'}", tmp_path / "main.c", files[1], "-o", program, "-lm"]
    subprocess.run(command, check=True)
    output = subprocess.run([program], capture_output=True, text=True, check=True).stdout
    np.testing.assert_array_equal(np.array(output.split(), np.float32), policy(observation))
    small = policy.export(tmp_path / "small", "c", weights="int8")
    assert pathlib.Path(small[1]).name == "hover_policy.c" and "signed char" in pathlib.Path(small[1]).read_text()


def test_an_application_of_a_crazyflie(tmp_path):
    write_policy(tmp_path / "policy.safetensors")
    policy = Policy.load(tmp_path / "policy.safetensors")
    files = policy.export(tmp_path / "app", "crazyflie", drone_model="cf2x")
    assert {"Makefile", "Kbuild", "app-config", "README.md"} <= {pathlib.Path(path).name for path in files}
    assert all(pathlib.Path(path).is_file() for path in files)
    write_policy(tmp_path / "own.safetensors", drone="heavy")
    with pytest.raises(ValueError, match=r"^drone_model is None, expected the file of the policy's airframe `heavy`$"):
        Policy.load(tmp_path / "own.safetensors").export(tmp_path / "other", "crazyflie")
    assert not (tmp_path / "other").exists()


def test_exports_that_are_read_again(tmp_path):
    path = tmp_path / "policy.safetensors"
    write_policy(path, low=-2.0, high=3.0)
    policy = Policy.load(path)
    observations = np.random.default_rng(1).normal(size=(2, 5, 12)).astype(np.float32)
    assert policy.export(tmp_path / "copy.safetensors", "safetensors") == [str(tmp_path / "copy.safetensors")]
    np.testing.assert_array_equal(Policy.load(tmp_path / "copy.safetensors")(observations), policy(observations))
    policy.export(tmp_path / "rounded.safetensors", "safetensors", "int8")
    rounded = Policy.load(tmp_path / "rounded.safetensors")(observations)
    assert 0 < np.abs(rounded - policy(observations)).max() < 0.2
    policy.export(tmp_path / "out" / "policy.onnx", "onnx")
    onnx = Policy.load(tmp_path / "out" / "policy.onnx")
    assert (onnx.observation_size, onnx.action_size, onnx.memory_size) == (12, 4, 0)
    assert onnx.info["task"] == "hover" and onnx.info["ctrl_freq"] == 48
    # the actions of an ONNX file are within the bounds of the task
    np.testing.assert_allclose(onnx(observations), np.clip(policy(observations), -1, 1), atol=1e-5)
    onnx.check(mdg.HoverAviary())
    again = pickle.loads(pickle.dumps(onnx))
    assert again.info == onnx.info
    np.testing.assert_array_equal(again(observations), onnx(observations))
    with pytest.raises(ValueError, match="the policy is from an ONNX file, expected one of `aviary train`"):
        onnx.export(tmp_path / "code", "c")


@pytest.mark.parametrize("per_drone", [False, True])
def test_recurrent_policies_in_onnx(tmp_path, per_drone):
    sizes, task = ((13, 8, 4), "multi_hover") if per_drone else ((12, 8, 4), "hover")
    write_policy(tmp_path / "p.safetensors", sizes, units=5, per_drone=per_drone, task=task, num_drones=1 + per_drone)
    policy = Policy.load(tmp_path / "p.safetensors")
    policy.export(tmp_path / "p.onnx", "onnx")
    onnx = Policy.load(tmp_path / "p.onnx")
    assert onnx.memory_size == 5
    states = [None, None]
    width = 26 if per_drone else 12
    for step, observation in enumerate(np.random.default_rng(3).normal(size=(6, 3, width)).astype(np.float32)):
        starts = np.array([step == 3, False, False])
        (expected, states[0]), (actions, states[1]) = (
            own.predict(observation, state, starts) for own, state in zip((policy, onnx), states, strict=True)
        )
        np.testing.assert_allclose(actions, expected, atol=1e-5)
        np.testing.assert_allclose(states[1], states[0], atol=1e-5)


@pytest.mark.skipif(not ASSETS.is_dir(), reason="the policies are in a checkout of the repository")
def test_an_exported_policy_solves_its_task(tmp_path):
    Policy.load(ASSETS / "hover.safetensors").export(tmp_path / "hover.onnx", "onnx")
    policy = Policy.load(tmp_path / "hover.onnx")
    env = mdg.VectorAviary("hover", 4, act_type=policy.info["action_type"], autoreset_mode="disabled")
    policy.check(env)
    observations, _ = env.reset(seed=1)
    for _ in range(env.max_episode_steps):
        observations, _, _, _, infos = env.step(policy(observations))
    assert infos["success"].all()


def message(field, content):
    """Returns a field of a protobuf message: a number, or bytes with their length."""

    def varint(number):
        digits = []
        while number > 127:
            digits.append(number & 127 | 128)
            number >>= 7
        return bytes([*digits, number])

    if isinstance(content, int):
        return varint(field << 3) + varint(content)
    content = content.encode() if isinstance(content, str) else content
    return varint(field << 3 | 2) + varint(len(content)) + content


def write_onnx(path, matrix):
    """Writes a graph of another trainer, without metadata: the output is the input times a matrix."""

    def value(name, columns):
        rows = message(1, message(2, "n"))
        shape = message(2, rows + message(1, message(1, columns)))
        return message(1, name) + message(2, message(1, message(1, 1) + shape))

    inputs, outputs = matrix.shape
    weights = message(1, inputs) + message(1, outputs) + message(2, 1) + message(8, "w")
    weights += message(9, matrix.astype("<f4").tobytes())
    node = message(1, "seen") + message(1, "w") + message(2, "acted") + message(3, "node") + message(4, "MatMul")
    graph = message(1, node) + message(2, "graph") + message(5, weights)
    graph += message(11, value("seen", inputs)) + message(12, value("acted", outputs))
    path.write_bytes(message(1, 8) + message(7, graph) + message(8, message(1, "") + message(2, 13)))


def test_policies_of_other_trainers(tmp_path):
    path = tmp_path / "other.onnx"
    matrix = np.random.default_rng(1).normal(size=(5, 4)).astype(np.float32)
    write_onnx(path, matrix)
    with pytest.raises(ValueError, match=r"other\.onnx: task is None, expected the name of a task"):
        Policy.load(path)
    options = {"task": "hover", "act_type": "vel", "ctrl_freq": 60, "observation_indices": "6-8,0-1"}
    policy = Policy.load(path, action_range="unit", **options)
    assert (policy.observation_size, policy.action_size) == (12, 4)
    assert (policy.info["action_type"], policy.info["ctrl_freq"], policy.info["drone"]) == ("vel", 60, "cf2x")
    observations = np.random.default_rng(2).normal(size=(7, 12))
    outputs = observations[:, [6, 7, 8, 0, 1]].astype(np.float32) @ matrix
    env = mdg.HoverAviary(act_type="vel", ctrl_freq=60)
    low, high = env.action_space.low, env.action_space.high
    expected = (low + high) / 2 + (high - low) / 2 * np.clip(outputs, -1, 1)
    np.testing.assert_allclose(policy(observations), expected, atol=1e-4)
    np.testing.assert_array_equal(pickle.loads(pickle.dumps(policy))(observations), policy(observations))
    policy.check(env)
    # the entries of the graph are also in longer observations
    longer = np.hstack([observations, np.ones((7, 2))])
    np.testing.assert_array_equal(policy(longer), policy(observations))
    space = Policy.load(path, **{**options, "observation_indices": [6, 7, 8, 0, 1]})
    np.testing.assert_allclose(space(observations), np.clip(outputs, low, high), atol=1e-4)
    fast = Policy.load(path, action_range="unit", drone_model="race", **options)
    assert fast.info["drone"] == "race" and np.abs(fast(observations)).max() > np.abs(policy(observations)).max()


def test_errors_of_onnx_files_and_exports(tmp_path):
    path = tmp_path / "other.onnx"
    write_onnx(path, np.zeros((5, 4), np.float32))

    def one_line(call, *parts, error=ValueError):
        with pytest.raises(error) as caught:
            call()
        text = str(caught.value)
        assert "\n" not in text and all(part in text for part in parts), text

    load = Policy.load
    one_line(lambda: load(tmp_path / "none.onnx"), "none.onnx", error=FileNotFoundError)
    one_line(lambda: load(path, task="hovr"), "no task `hovr`")
    assert load(path, task="hover").observation_size == 5
    one_line(lambda: load(path, task="hover").check(mdg.HoverAviary()), "has 5 observations", "the environment 12")
    one_line(lambda: load(path, task="hover", act_type="one_d_rpm", observation_indices="0-4"), "4 numbers, expected 1")
    one_line(lambda: load(path, task="hover", act_type="thrust"), "act_type", "expected", "rpm")
    one_line(lambda: load(path, task="hover", observation_indices="0-x"), "observation_indices is `0-x`, expected")
    one_line(lambda: load(path, task="hover", observation_indices=3), "observation_indices is 3, expected numbers")
    one_line(lambda: load(path, task="hover", observation_indices=[0, 1]), "observation_indices is 2 numbers")
    one_line(lambda: load(path, task="hover", action_range="all"), 'action_range is "all", expected "space" or "unit"')
    one_line(lambda: load(path, task="hover", action_output="x"), "action_output is `x`, expected acted")
    one_line(lambda: load(path, task="hover", ctrl_freq=0), "ctrl_freq is 0, expected an integer from 1")
    path.write_bytes(b"no graph")
    one_line(lambda: load(path, task="hover"), "other.onnx: not a policy in ONNX")
    write_policy(tmp_path / "policy.safetensors")
    file = tmp_path / "policy.safetensors"
    one_line(lambda: load(file, task="hover"), "task is 'hover', expected None for a file that is not ONNX")
    one_line(lambda: load(file, act_type="vel"), "act_type is 'vel', expected None for a file that is not ONNX")
    policy = Policy.load(file)
    out = tmp_path / "out"
    one_line(lambda: policy.export(out, "tflite"), "format is 'tflite', expected one of 'c', 'crazyflie', 'onnx', ")
    one_line(lambda: policy.export(out, "c", "int4"), "weights is 'int4', expected one of 'float32', 'int8'")
    one_line(lambda: policy.export(out, "c", name="My Policy"), "name is `My Policy`, expected lower snake case")
    one_line(lambda: policy.export(out, "onnx"), "expected a name that ends in .onnx with format='onnx'")
    one_line(lambda: policy.export(tmp_path / "p.onnx", "safetensors"), "expected another name than that of an ONNX")
    onnx = tmp_path / "p.onnx"
    one_line(lambda: policy.export(onnx, "onnx", "int8"), "weights is 'int8', expected 'float32' with format='onnx'")
    one_line(lambda: policy.export(onnx, "onnx", name="x"), "name is 'x', expected None with format='onnx'")
    one_line(lambda: policy.export(out, "c", drone_model="cf2x"), "drone_model is 'cf2x', expected None with format=")
    one_line(lambda: policy.export(file / "x", "c"), "policy.safetensors", error=OSError)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["other.onnx", "policy.safetensors"]
