"""Batches for Stable-Baselines3."""

import pickle

import numpy as np
import pytest

stable_baselines3 = pytest.importorskip("stable_baselines3")

from stable_baselines3 import PPO  # noqa: E402
from stable_baselines3.common.evaluation import evaluate_policy  # noqa: E402
from stable_baselines3.common.monitor import Monitor  # noqa: E402
from stable_baselines3.common.vec_env import VecEnv, VecMonitor, VecNormalize  # noqa: E402

from mujoco_drones_gym import VectorAviary  # noqa: E402
from mujoco_drones_gym.sb3 import SB3VecEnv  # noqa: E402


def test_steps_equal_those_of_a_vector_environment():
    env = SB3VecEnv("hover", 5, max_episode_steps=6)
    other = VectorAviary("hover", 5, max_episode_steps=6, autoreset_mode="SameStep")
    assert isinstance(env, VecEnv) and env.num_envs == 5
    assert (env.observation_space, env.action_space) == (other.single_observation_space, other.single_action_space)
    assert env.seed(3) == [3] * 5
    np.testing.assert_array_equal(env.reset(), other.reset(seed=3)[0])
    rng = np.random.default_rng(1)
    ended = 0
    for _ in range(40):
        actions = rng.uniform(-1, 1, (5, 4)).astype(np.float32)
        obs, rewards, dones, infos = env.step(actions)
        expected, reward, terminations, truncations, ends = other.step(actions)
        np.testing.assert_array_equal(obs, expected)
        np.testing.assert_array_equal(rewards, reward)
        np.testing.assert_array_equal(dones, terminations | truncations)
        for i, info in enumerate(infos):
            assert info["TimeLimit.truncated"] is bool(truncations[i] and not terminations[i])
            assert ("terminal_observation" in info) == bool(dones[i])
            if dones[i]:
                ended += 1
                np.testing.assert_array_equal(info["terminal_observation"], ends["final_obs"][i])
                assert info["end"] == ends["final_info"]["end"][i] and info["is_success"] is False
                for key in ("time", "progress", "position_error", "crashed", "success"):
                    assert info[key] == ends["final_info"][key][i] and type(info[key]) in (float, bool)
    assert ended >= 30
    env.close()


def test_infos_of_a_reset():
    env = SB3VecEnv("multi_hover", 3)
    env.reset()
    assert [info["time"] for info in env.reset_infos] == [0.0] * 3
    assert set(env.reset_infos[0]) == {"time", "success", "progress", "position_error", "crashed"}


class Own(SB3VecEnv):
    """A subclass with another constructor."""

    def __init__(self, count):
        super().__init__("hover", count)
        self.note = "mine"


def test_copies_of_subclasses():
    env = Own(3)
    env.set_attr("TARGET_HEIGHT", 0.7, indices=1)
    other = pickle.loads(pickle.dumps(env))
    assert type(other) is Own and (other.num_envs, other.note) == (3, "mine")
    assert other.get_attr("TARGET_HEIGHT") == [1.0, 0.7, 1.0]
    other.reset()
    assert other.step(np.zeros((3, 4)))[0].shape == (3, 12)


def test_terminations_are_no_time_limits():
    env = SB3VecEnv("hover", 2, initial_xyzs=[[0, 0, 0.5]])
    env.reset()
    for _ in range(100):
        _, _, dones, infos = env.step(-np.ones((2, 4), np.float32))
        if dones.any():
            break
    assert infos[0]["end"] == "floor_contact" and infos[0]["TimeLimit.truncated"] is False


def test_random_streams_continue_without_a_seed():
    env = SB3VecEnv("stabilize", 3)
    env.seed(1)
    first = env.reset()
    second = env.reset()
    env.seed(1)
    np.testing.assert_array_equal(env.reset(), first)
    assert not np.array_equal(first, second) and not np.array_equal(first[0], first[1])
    assert len(set(env.seed())) == 1


def test_attributes_and_methods():
    env = SB3VecEnv("multi_hover", 3, render_mode="rgb_array", width=64, height=48)
    env.reset()
    assert env.get_attr("render_mode") == ["rgb_array"] * 3 and env.render_mode == "rgb_array"
    assert env.get_attr("NUM_DRONES", indices=[0, 2]) == [2, 2]
    env.set_attr("level", 4, indices=1)
    assert env.get_attr("level", indices=1) == [4]
    assert env.has_attr("CTRL_FREQ") and not env.has_attr("level")
    assert env.env_method("info", indices=0)[0]["time"] == 0
    env.env_method("set_wind", None)
    assert env.env_is_wrapped(Monitor) == [False] * 3 and env.env_is_wrapped(Monitor, indices=[1]) == [False]
    assert env.render().shape == (96, 128, 3)
    assert len(env.get_images()) == 3
    with pytest.raises(TypeError, match="autoreset_mode"):
        SB3VecEnv("hover", 2, autoreset_mode="NextStep")
    with pytest.raises(TypeError):
        SB3VecEnv("hover", 2, size=2)
    again = pickle.loads(pickle.dumps(env))
    assert (again.num_envs, again.venv.task) == (3, "multi_hover")


def test_image_observations():
    env = SB3VecEnv("hover", 2, obs_type="kin_rgb", episode_seconds=0.1)
    obs = env.reset()
    assert set(obs) == {"kin", "rgb"} and obs["rgb"].shape == (2, 1, 48, 64, 4)
    for _ in range(5):
        obs, _, dones, infos = env.step(np.full((2, 4), 0.5, np.float32))
    assert dones.all() and infos[1]["terminal_observation"]["rgb"].shape == (1, 48, 64, 4)
    assert infos[1]["terminal_observation"]["kin"][2] > obs["kin"][1][2]


IMPORT_AFTER_AN_IMAGE = """
import mujoco_drones_gym
env = mujoco_drones_gym.VectorAviary("hover", 2, obs_type="rgb")
obs, _ = env.reset(seed=1)
import triton
import torch
torch.optim.Adam([torch.zeros(3, requires_grad=True)])
print(obs.std() > 1)
"""


def test_pytorch_works_after_the_first_image(run_python):
    pytest.importorskip("triton")
    assert run_python(IMPORT_AFTER_AN_IMAGE).strip() == "True"


@pytest.mark.parametrize("task", ["hover", "multi_hover"])
def test_ppo_learns(task):
    env = VecNormalize(VecMonitor(SB3VecEnv(task, 16, episode_seconds=1.0)))
    model = PPO("MlpPolicy", env, n_steps=64, batch_size=256, n_epochs=2, device="cpu", seed=1)
    model.learn(3 * 16 * 64)
    assert model.num_timesteps == 3 * 16 * 64 and len(model.ep_info_buffer) > 10
    mean, _ = evaluate_policy(model, VecMonitor(SB3VecEnv(task, 4, episode_seconds=1.0)), n_eval_episodes=4)
    assert np.isfinite(mean)
