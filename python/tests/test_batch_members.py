"""Environments of a batch: changes that a copy keeps, attributes that cannot be set, and arrays of all environments."""

import copy
import pickle

import gymnasium as gym
import numpy as np
import pytest
from test_env import CLASSES

import mujoco_drones_gym as mdg
from mujoco_drones_gym.vector import SINGLE_ATTRIBUTES

TASKS = sorted({name for name in CLASSES if name != "base"} | {"multi_agent"})


def flight(batch, steps=30):
    """Returns the states after a flight from a seed."""
    batch.reset(seed=3)
    rng = np.random.default_rng(1)
    for _ in range(steps):
        batch.step(rng.uniform(-0.2, 0.3, (batch.num_envs, *batch.single_action_space.shape)))
    return batch.states()


@pytest.mark.parametrize("duplicate", [copy.deepcopy, lambda env: pickle.loads(pickle.dumps(env))])
def test_a_copy_of_a_batch_keeps_what_was_changed(duplicate):
    options = {"num_envs": 4, "vectorization_mode": "vector_entry_point"}
    env = gym.make_vec("mujoco_drones_gym/Hover-v0", randomization={"body": {"mass": (0.9, 1.1)}}, **options)
    env.envs[1].set_wind({"model": "dryden", "turbulence": 5.0})
    env.envs[2].set_randomization({"body": {"mass": (0.5, 0.6)}})
    env.envs[3].set_randomization(None)
    env.envs[3].TARGET_HEIGHT = 0.6
    env.set_attr("level", [1, 2, 3, 4])
    env.note = "mine"
    other = duplicate(env)
    assert other.spec == env.spec is not None and other.note == "mine"
    assert other.get_attr("level") == (1, 2, 3, 4)
    assert other.get_attr("TARGET_HEIGHT") == (1.0, 1.0, 1.0, 0.6)
    plain = mdg.VectorAviary("hover", 4, randomization={"body": {"mass": (0.9, 1.1)}})
    states = flight(env)
    np.testing.assert_array_equal(states, flight(other))
    same = (states == flight(plain)).all(axis=(1, 2))
    assert same.tolist() == [True, False, False, False]
    other.envs[0].level = 9
    assert env.envs[0].level == 1


class Own(mdg.VectorAviary):
    """A subclass with another constructor."""

    def __init__(self, count):
        super().__init__("hover", count, act_type="vel")
        self.note = "mine"


def test_copies_of_subclasses():
    other = pickle.loads(pickle.dumps(Own(3)))
    assert type(other) is Own and (other.num_envs, other.note, other.action_type) == (3, "mine", "vel")
    closed = Own(2)
    closed.close()
    assert copy.deepcopy(closed).reset(seed=1)[0].shape == (2, 12)


def test_target_heights_of_several_drones():
    env, other = (mdg.VectorAviary("multi_hover", 3) for _ in range(2))
    env.reset(seed=1)
    env.envs[1].TARGET_HEIGHTS = [0.5, 1.5]
    single = mdg.MultiHoverAviary(target_heights=[0.5, 1.5], stream=1, engine="hybrid")
    single.reset(seed=1)
    rewards = env.step(np.zeros((3, 8)))[1]
    assert rewards[1] == np.float32(single.step(np.zeros(8))[1]) and rewards[1] != rewards[0]
    np.testing.assert_array_equal(env.envs[1].TARGET_HEIGHTS, [0.5, 1.5])
    np.testing.assert_array_equal(pickle.loads(pickle.dumps(env)).envs[1].TARGET_HEIGHTS, [0.5, 1.5])
    np.testing.assert_array_equal(env.envs[0].TARGET_HEIGHTS, other.envs[1].TARGET_HEIGHTS)
    with pytest.raises(ValueError, match=r"^target_heights is 'x'"):
        env.envs[1].TARGET_HEIGHTS = "x"
    with pytest.raises(AttributeError, match="TARGET_HEIGHTS"):
        _ = mdg.VectorAviary("hover").envs[0].TARGET_HEIGHTS


REFUSED = ["INIT_XYZS", "EPISODE_LEN_SEC", "GATES", "gates", "NUM_LAPS", "reset", "obstacles", "M"]


@pytest.mark.parametrize("name", REFUSED)
def test_an_attribute_that_a_batch_cannot_set_is_an_error(name):
    env = mdg.VectorAviary("race", 2)
    for change in (
        lambda: setattr(env.envs[0], name, 1.0),
        lambda: env.set_attr(name, 1.0),
        lambda: env.envs[0].set_wrapper_attr(name, 1.0),
    ):
        with pytest.raises(AttributeError, match=f"^the attribute '{name}' of an environment cannot be set"):
            change()


def test_all_attributes_of_single_environments_are_known():
    public = {name for name in vars(mdg.HoverAviary()) if not name.startswith("_")}
    assert public == SINGLE_ATTRIBUTES


def test_single_environments_of_every_task():
    from mujoco_drones_gym.vector import single_attributes

    for task in TASKS:
        assert "INIT_XYZS" in single_attributes(task), task
    assert "TARGET_HEIGHTS" in single_attributes("multi_hover") and "GATES" in single_attributes("race")


def test_batteries_and_parameters_of_one_environment():
    env = mdg.VectorAviary("multi_hover", 3, randomization={"body": {"mass": (0.5, 1.5)}})
    env.reset(seed=1)
    for index, member in enumerate(env.envs):
        single = mdg.MultiHoverAviary(randomization={"body": {"mass": (0.5, 1.5)}}, stream=index, engine="hybrid")
        single.reset(seed=1)
        for drone in range(2):
            assert member.drone_params(drone) == single.drone_params(drone)
            for own, expected in zip(member.reference(drone), single.reference(drone), strict=True):
                np.testing.assert_array_equal(own, expected)
        assert mdg.PIDControl(member).MASS == single.M
        np.testing.assert_array_equal(member.battery, env.batteries()[index])
    assert np.shape(env.get_attr("battery")) == (3, 2, 3)


def test_observations_with_images_are_new_dicts_of_the_same_arrays():
    env = mdg.VectorAviary("hover", 2, obs_type="kin_rgb", copy=False)
    first, _ = env.reset(seed=1)
    kin, rgb = first["kin"], first["rgb"]
    first["kin"] = None
    second = env.step(np.zeros((2, 4)))[0]
    assert second["kin"] is kin and second["rgb"] is rgb
    images = mdg.VectorAviary("hover", 2, obs_type="rgb_depth", copy=False)
    first, _ = images.reset(seed=1)
    first.clear()
    assert set(images.step(np.zeros((2, 4)))[0]) == {"rgb", "depth"}


@pytest.mark.parametrize("task", TASKS)
@pytest.mark.parametrize("mode", ["same_step", "disabled"])
def test_the_terms_of_a_batch_add_up_to_its_rewards(task, mode):
    drones = {} if task == "hover" else {"num_drones": 2}
    env = mdg.VectorAviary(task, 5, autoreset_mode=mode, episode_seconds=0.5, **drones)
    untouched = mdg.VectorAviary(task, 5, autoreset_mode=mode, episode_seconds=0.5, **drones)
    env.reset(seed=1), untouched.reset(seed=1)
    assert env.reward_terms() == {}
    rng = np.random.default_rng(1)
    for _ in range(24):
        actions = rng.uniform(-1, 1, (5, *env.single_action_space.shape))
        _, rewards, terminations, truncations, _ = env.step(actions)
        np.testing.assert_array_equal(untouched.step(actions)[1], rewards)
        over = terminations | truncations
        terms = env.reward_terms()
        if mode == "same_step" and over.all():
            assert terms == {}
            continue
        assert all(term.shape == ((5,) if task == "hover" else (5, 2)) for term in terms.values())
        sums = np.reshape(list(terms.values()), (len(terms), 5, -1)).sum(axis=(0, 2))
        known = ~over if mode == "same_step" else np.ones(5, bool)
        np.testing.assert_allclose(sums[known], rewards[known], rtol=1e-6, atol=1e-7)
        assert np.isnan(sums[~known]).all()
        if mode == "disabled" and over.any():
            for own in (env, untouched):
                own.reset(options={"reset_mask": over})
    np.testing.assert_array_equal(env.states(), untouched.states())


def test_terms_of_a_single_environment():
    env = mdg.FormationAviary()
    env.reset(seed=1)
    assert env.reward_terms() == {}
    reward = env.step(np.full(12, 0.1))[1]
    terms = [env.reward_terms(drone) for drone in range(3)]
    assert list(terms[0]) == ["slot_error", "distance_errors", "crash"]
    assert [sum(own.values()) for own in terms] == env.drone_rewards().tolist()
    assert sum(env.drone_rewards()) == reward
    with pytest.raises(ValueError, match="drone 3 does not exist"):
        env.reward_terms(3)
    assert mdg.BaseAviary().reward_terms() == {}


def test_sampled_parameters_of_a_batch():
    ranges = {"body": {"mass": (0.8, 1.2)}, "actuators": {}, "environment": {"gravity": (0.9, 1.1)}}
    env = mdg.VectorAviary("multi_hover", 3, randomization=ranges)
    env.envs[2].set_randomization(None)
    env.reset(seed=4)
    sampled = env.sampled_params()
    for index in range(2):
        single = mdg.MultiHoverAviary(randomization=ranges, stream=index, engine="hybrid")
        single.reset(seed=4)
        expected = single.sampled_params()
        for drone, own in enumerate(expected["drones"]):
            assert sampled["mass"][index, drone] == own["mass"]
            assert sampled["actuators.lag"][index, drone] == own["actuators"]["lag"]
            assert sampled["actuators.gains"][index, drone].tolist() == own["actuators"]["gains"]
            assert sampled["bias"][index, drone].tolist() == own["bias"]
            assert sampled["gravity"][index, drone] == expected["gravity"]
    assert sampled["mass"].shape == (3, 2) and sampled["actuators.gains"].shape == (3, 2, 4)
    assert all(np.isnan(values[2]).all() and values.dtype == np.float64 for values in sampled.values())
    assert mdg.VectorAviary("hover", 2).sampled_params() == {}
