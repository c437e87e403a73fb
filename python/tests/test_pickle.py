"""Copies of environments, and snapshots."""

import copy
import pickle

import gymnasium as gym
import numpy as np
import pytest
from test_env import CLASSES

import mujoco_drones_gym as mdg
from mujoco_drones_gym.wrappers.obstacles import ObstacleConfig
from mujoco_drones_gym.wrappers.wind import WindConfig, WindModel


def flight(env, seed=5, steps=30):
    env.action_space.seed(seed)
    obs = [env.reset(seed=seed)[0]]
    for _ in range(steps):
        result = env.step(env.action_space.sample())
        obs.append(result[0])
        if result[2] or result[3]:
            break
    return np.stack(obs)


@pytest.mark.parametrize("task", CLASSES)
@pytest.mark.parametrize("duplicate", [lambda env: pickle.loads(pickle.dumps(env)), copy.deepcopy])
def test_a_copy_has_the_options_of_the_environment(task, duplicate):
    options = {"physics": "mjc_drag", "ctrl_freq": 120, "wind": WindConfig(WindModel.GUST), "render_mode": "rgb_array"}
    env = CLASSES[task](obstacles=ObstacleConfig(num_obstacles=3), **options)
    env.reset(seed=1)
    other = duplicate(env)
    assert type(other) is type(env) and other.render_mode == "rgb_array" and other.CTRL_FREQ == 120
    with pytest.raises(gym.error.ResetNeeded):
        other.step(np.zeros(other.action_space.shape))
    assert (flight(env) == flight(other)).all()


def test_a_copy_has_the_settings_that_were_changed():
    env = mdg.HoverAviary(target_height=0.8)
    env.TARGET_HEIGHT = 1.7
    env.set_wind(WindConfig(WindModel.CONSTANT))
    env.set_randomization({"body": {}})
    env.INIT_XYZS = [[0, 0, 0.5]]
    env.note = "mine"
    other = pickle.loads(pickle.dumps(env))
    assert (other.TARGET_HEIGHT, other.note, other.INIT_XYZS[0, 2]) == (1.7, "mine", 0.5)
    assert (flight(env) == flight(other)).all()
    assert env.M == other.M != 0.027


def test_copies_of_made_environments():
    env = gym.make("mujoco_drones_gym/Hover-v0", target_height=0.7)
    other = pickle.loads(pickle.dumps(env))
    assert other.unwrapped.TARGET_HEIGHT == 0.7 and other.spec.id == "mujoco_drones_gym/Hover-v0"
    assert (flight(env) == flight(other)).all()
    again = gym.make(env.spec)
    assert again.unwrapped.TARGET_HEIGHT == 0.7
    cloudpickle = pytest.importorskip("cloudpickle")
    assert cloudpickle.loads(cloudpickle.dumps(lambda: mdg.HoverAviary(target_height=0.6)))().TARGET_HEIGHT == 0.6


class Numbered(mdg.HoverAviary):
    """A subclass with its own constructor."""

    def __init__(self, number):
        super().__init__(target_height=0.5)
        self.number = number


def test_copies_of_subclasses():
    other = pickle.loads(pickle.dumps(Numbered(3)))
    assert (other.number, other.TARGET_HEIGHT) == (3, 0.5)


@pytest.mark.parametrize("task", CLASSES)
@pytest.mark.parametrize("engine", ["mujoco", "hybrid"])
def test_snapshots_are_exact(task, engine):
    options = {"wind": {"model": "combined"}, "randomization": {"actuators": {}, "sensors": {}}, "engine": engine}
    env, other = CLASSES[task](**options), CLASSES[task](**options)
    rng = np.random.default_rng(1)
    low, high = env.action_space.low, env.action_space.high
    actions = [(low + high) / 2 + 0.1 * (high - low) * rng.uniform(-1, 1, low.shape) for _ in range(40)]
    env.reset(seed=1)
    for action in actions[:10]:
        env.step(action)
    state = env.get_state()

    def run(env):
        results = []
        for action in actions[10:]:
            obs, reward, terminated, truncated, info = env.step(action)
            results.append((obs.tobytes(), reward, terminated, truncated, info, env._env.states().tobytes()))
            if terminated or truncated:
                break
        results.append((env.reset()[0].tobytes(), env._env.states().tobytes()))
        return results

    observed = env.observation()
    expected = run(env)
    env.set_state(state)
    assert (env.observation() == observed).all()
    assert run(env) == expected
    # in another environment, also after a file
    other.set_state(pickle.loads(pickle.dumps(state)))
    assert run(other) == expected


def test_wrong_snapshots_change_nothing():
    env = mdg.HoverAviary()
    env.reset(seed=1)
    env.step(np.zeros(4))
    before = env._env.states()
    for other in (mdg.HoverAviary(sim_freq=480), mdg.TrackAviary(), mdg.HoverAviary(act_type="pid")):
        other.reset(seed=1)
        with pytest.raises(ValueError):
            env.set_state(other.get_state())
    with pytest.raises(TypeError):
        env.set_state(b"state")
    assert (env._env.states() == before).all()
    env.step(np.zeros(4))


def test_a_snapshot_of_the_end_needs_a_reset():
    env = mdg.HoverAviary(episode_seconds=0.1)
    env.reset(seed=1)
    while not env.step(np.zeros(4))[3]:
        pass
    state = env.get_state()
    env.reset()
    env.set_state(state)
    with pytest.raises(gym.error.ResetNeeded):
        env.step(np.zeros(4))
