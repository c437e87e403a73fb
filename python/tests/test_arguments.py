"""Arguments of methods: errors of one line after which nothing has moved, and seeds of first resets."""

import importlib
import importlib.util
import sys

import numpy as np
import pytest
from gymnasium.error import ResetNeeded

import mujoco_drones_gym as mdg

WIDE = {"initial": {"position": 0.2}}

SQUARE = np.zeros((3, 3))
NO_ACTIONS = {
    "huge integers": [10**400] * 4,
    "a huge integer": 10**30,
    "a dict": {"a": 1},
    "text": "abc",
    "texts": ["1", "2", "3", "4"],
    "None": None,
    "objects": np.array([object()] * 4),
    "complex": np.zeros(4, complex),
    "ragged": [[1], [1, 2]],
    "an object": object(),
}


def one_line(function, *parts, error=ValueError):
    with pytest.raises(error) as caught:
        function()
    text = str(caught.value)
    assert "\n" not in text and len(text) < 300, text
    for part in parts:
        assert part in text, text


@pytest.mark.parametrize("action", NO_ACTIONS.values(), ids=NO_ACTIONS)
def test_wrong_actions_name_the_action_and_move_nothing(action):
    vector = mdg.VectorAviary("hover", 2)
    vector.reset(seed=1)
    before = vector.states()
    both = np.stack([action] * 2) if isinstance(action, np.ndarray) else action
    one_line(lambda: vector.step(both), "actions is ", "expected an array of numbers of the shape (2, 4)")
    np.testing.assert_array_equal(vector.states(), before)

    env = mdg.HoverAviary()
    env.reset(seed=1)
    before = env._getDroneStateVector(0)
    one_line(lambda: env.step(action), "action is ", "expected an array of numbers of the shape (4,)")
    np.testing.assert_array_equal(env._getDroneStateVector(0), before)

    parallel = mdg.MultiAgentAviary(num_drones=2)
    parallel.reset(seed=1)
    before = parallel.state()
    one_line(lambda: parallel.step({"drone0": np.zeros(4), "drone1": action}), "action of drone1 is ", "(4,)")
    np.testing.assert_array_equal(parallel.state(), before)


@pytest.mark.parametrize("actions", [None, "abc", 3, [np.zeros(4)] * 2, np.zeros((2, 4))])
def test_actions_of_agents_are_dicts(actions):
    env = mdg.MultiAgentAviary(num_drones=2)
    env.reset(seed=1)
    one_line(lambda: env.step(actions), "actions is ", "expected a dict with an action for every live agent")


def test_actions_have_the_names_of_agents():
    env = mdg.MultiAgentAviary(num_drones=2)
    env.reset(seed=1)
    for key in [0, "drone7", None, ("drone0",)]:
        actions = {"drone0": np.zeros(4), "drone1": np.zeros(4), key: np.zeros(4)}
        one_line(lambda actions=actions: env.step(actions), "unexpected action for the agent `", "drone0, drone1")
    one_line(lambda: env.step({"drone0": np.zeros(4)}), "drone1")
    assert env.step(dict.fromkeys(env.agents, np.zeros(4)))[4]["drone0"]["time"] == env.CTRL_TIMESTEP


def test_tensors_with_gradients_are_numbers():
    torch = pytest.importorskip("torch")
    action = torch.full((4,), 0.1, dtype=torch.float64, requires_grad=True)
    states = []
    for own in (action, action.detach().numpy()):
        env, vector = mdg.HoverAviary(), mdg.VectorAviary("hover", 2)
        agents = mdg.MultiAgentAviary(num_drones=1)
        env.reset(seed=1), vector.reset(seed=1), agents.reset(seed=1)
        env.step(own), vector.step(np.stack([own, own]) if own is not action else torch.stack([own, own]))
        agents.step({"drone0": own})
        states.append((env.pos, vector.states(), agents.state()))
    for first, second in zip(*states, strict=True):
        np.testing.assert_array_equal(first, second)
    one_dimensional = mdg.HoverAviary(act_type="one_d_rpm")
    one_dimensional.reset(seed=1)
    one_dimensional.step(0.1)


@pytest.mark.parametrize("name", ["gui", "vision_attributes", "output_folder", "render_mode", "width", "obs_type"])
def test_arrays_as_options(name):
    for make in (mdg.HoverAviary, lambda **options: mdg.VectorAviary("hover", **options), mdg.MultiAgentAviary):
        one_line(lambda make=make: make(**{name: SQUARE}), f"{name} is array(", "expected")


@pytest.mark.parametrize("name", ["copy", "on_fault", "autoreset_mode", "num_threads", "max_episode_steps", "num_envs"])
def test_arrays_as_options_of_batches(name):
    one_line(lambda: mdg.VectorAviary(**{"task": "hover", name: SQUARE}), f"{name} is array(", "expected")


def test_flags_and_names_have_their_types():
    one_line(lambda: mdg.VectorAviary("hover", copy=1), "copy is 1, expected True or False")
    one_line(lambda: mdg.HoverAviary(vision_attributes="yes"), "vision_attributes is 'yes', expected True or False")
    one_line(lambda: mdg.VectorAviary("hover", on_fault=3), 'on_fault is 3, expected "error" or "truncate"')
    one_line(lambda: mdg.VectorAviary("hover", max_episode_steps=1 << 40), "max_episode_steps is 1099511627776, ")
    one_line(lambda: mdg.MultiHoverAviary(target_heights=["x", 1]), "target_heights is ['x', 1]")
    one_line(lambda: setattr(mdg.MultiHoverAviary(), "TARGET_HEIGHTS", "x"), "target_heights is 'x'")
    assert mdg.VectorAviary("hover", copy=np.False_).copy is False
    assert mdg.BaseAviary(neighbourhood_radius=None).NEIGHBOURHOOD_RADIUS == np.inf
    assert mdg.BaseAviary(num_drones=3, neighbourhood_radius=None)._getAdjacencyMatrix().all()


@pytest.mark.parametrize("drone", [-1, 2, 10**30, "x", None, 0.5])
def test_indices_of_drones(drone):
    single, batch, agents = mdg.BaseAviary(num_drones=2), mdg.VectorAviary("multi_hover"), mdg.MultiAgentAviary(2)
    for env in (single, batch, agents):
        env.reset(seed=1)
    methods = (
        single._getDroneStateVector,
        single._getDroneImages,
        single.drone_params,
        single.reference,
        batch.envs[0]._getDroneStateVector,
        agents._getDroneStateVector,
        agents.drone_params,
    )
    for method in methods:
        one_line(lambda method=method: method(drone), f"drone {drone!r} does not exist, expected an index from 0 to 1")


def test_arguments_of_reset_and_render():
    single, batch, agents = mdg.HoverAviary(), mdg.VectorAviary("hover", 2), mdg.MultiAgentAviary()
    for env in (single, batch, agents):
        env.reset(seed=1)
        one_line(lambda env=env: env.reset(options="x"), "options is 'x', expected a dict or None")
        one_line(lambda env=env: env.reset(seed=-1), "seed is -1, expected an integer from 0")
        one_line(lambda env=env: env.reset(seed=SQUARE), "seed is array(", "expected an integer")
        env.reset(seed=np.array(3), options={})
    for env in (single, agents):
        one_line(lambda env=env: env.reset(seed=[1, 2]), "seed is [1, 2], expected an integer")
    one_line(lambda: single.render(1), "camera_mode is 1, expected track, fpv, fixed, front or top")


def test_seeds_are_any_integers():
    torch = pytest.importorskip("torch")
    for make in (mdg.HoverAviary, lambda **options: mdg.VectorAviary("hover", 2, **options)):
        env = make(randomization=WIDE)
        expected = env.reset(seed=3)[0]
        for seed in (np.array(3), torch.tensor(3), np.uint8(3)):
            np.testing.assert_array_equal(env.reset(seed=seed)[0], expected)
    batch = mdg.VectorAviary("hover", 2, randomization=WIDE)
    np.testing.assert_array_equal(batch.reset(seed=torch.tensor([3, 3]))[0], expected)


def test_images_need_an_episode():
    for env in (
        mdg.HoverAviary(render_mode="rgb_array"),
        mdg.VectorAviary("hover", 2, render_mode="rgb_array"),
        mdg.MultiAgentAviary(render_mode="rgb_array"),
    ):
        with pytest.raises(ResetNeeded, match="reset"):
            env.render()
        env.reset(seed=1)
        assert env.render() is not None
    batch = mdg.VectorAviary("hover", 2, render_mode="rgb_array")
    batch.reset(seed=1, options={"reset_mask": [True, False]})
    assert batch.envs[0].render() is not None
    with pytest.raises(ResetNeeded):
        batch.envs[1].render()


# seeds of first resets


def starts_of(batch, **reset):
    return batch.reset(**reset)[0][:, :3].copy()


def test_first_resets_without_a_seed_differ():
    from mujoco_drones_gym.sb3 import SB3VecEnv

    def agents():
        observations = mdg.MultiAgentAviary(randomization=WIDE).reset()[0]
        return np.stack(list(observations.values()))

    for start in (
        lambda: mdg.HoverAviary(randomization=WIDE).reset()[0],
        lambda: mdg.VectorAviary("hover", 3, randomization=WIDE).reset()[0],
        lambda: mdg.VectorAviary("hover", 3, randomization=WIDE).reset(seed=[None, None, None])[0],
        lambda: mdg.VectorAviary("hover", 3, randomization=WIDE).reset(options={"reset_mask": [True, False, True]})[0],
        lambda: SB3VecEnv("hover", 3, randomization=WIDE).reset(),
        agents,
    ):
        assert not np.array_equal(start(), start())


def test_seeds_of_some_environments():
    batch = mdg.VectorAviary("hover", 3, randomization=WIDE)
    other = mdg.VectorAviary("hover", 3, randomization=WIDE)
    first, second = (starts_of(env, seed=[5, None, None]) for env in (batch, other))
    np.testing.assert_array_equal(first[0], second[0])
    assert not (first[1:] == second[1:]).any()
    # the streams continue afterwards
    seeded = mdg.VectorAviary("hover", 3, randomization=WIDE)
    seeded.reset(seed=5)
    np.testing.assert_array_equal(starts_of(batch, seed=[None, 7, 8])[0], starts_of(seeded)[0])
    # a seed of some environments determines the first reset of the others
    rows = []
    for _ in range(2):
        env = mdg.VectorAviary("hover", 3, randomization=WIDE)
        env.reset(seed=5, options={"reset_mask": np.array([True, False, False])})
        rows.append(starts_of(env))
    np.testing.assert_array_equal(*rows)
    with pytest.raises(ValueError, match="seed has 2 entries"):
        mdg.VectorAviary("hover", 3).reset(seed=[None, None])


# modules


def test_modules_are_attributes_of_the_package(run_python):
    program = """
import sys
import mujoco_drones_gym as mdg
assert not any(f"mujoco_drones_gym.{name}" in sys.modules for name in ("sb3", "vector", "wrappers"))
for name in ("wrappers", "control", "envs", "utils", "vector", "policy"):
    assert getattr(mdg, name).__name__ == f"mujoco_drones_gym.{name}"
    assert name in dir(mdg)
assert "stable_baselines3" not in sys.modules and "pettingzoo" not in sys.modules
assert mdg.wrappers.WindConfig is not None and mdg.vector.VectorAviary is mdg.VectorAviary
try:
    mdg.simulators
except AttributeError as error:
    assert "simulators" in str(error)
else:
    raise AssertionError
"""
    run_python(program)


def test_the_finder_of_triton_leaves_the_other_finders_alone(monkeypatch):
    opengl = importlib.import_module("mujoco_drones_gym._opengl")
    asked = []

    class Next:
        @staticmethod
        def find_spec(name, path=None, target=None):
            asked.append(name)
            return None

    has_llvm, loads = [False, True, True], []
    monkeypatch.setattr(sys, "meta_path", [opengl._TritonFinder(), Next])
    monkeypatch.delitem(sys.modules, "triton", raising=False)
    monkeypatch.setattr(opengl, "_has_llvm_of_mesa", lambda: has_llvm[len(asked)])
    monkeypatch.setattr(opengl, "_load_triton", lambda: loads.append(len(asked)))
    finders = list(sys.meta_path)
    for _ in range(3):
        assert importlib.util.find_spec("triton") is None
        assert sys.meta_path == finders
    assert asked == ["triton"] * 3 and loads == [1], "once, and not before there is a library to fear"
