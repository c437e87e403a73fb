"""Spaces: bounds that hold for every observation, Dict spaces, and actions in their bounds."""

import math

import gymnasium as gym
import numpy as np
import pytest
from airframes import AIRFRAME_WITH_DUTY
from test_env import CLASSES

import mujoco_drones_gym as mdg
from mujoco_drones_gym.utils.enums import ActionType


@pytest.mark.parametrize("task", CLASSES)
def test_every_observation_is_in_its_space(task):
    for act_type, options in [("rpm", {}), ("rpm", {"randomization": True}), ("ctbr", {"wind": {"model": "combined"}})]:
        env = CLASSES[task](act_type=act_type, engine="hybrid", **options)
        env.action_space.seed(1)
        for episode in range(5):
            obs, _ = env.reset(seed=episode)
            assert env.observation_space.contains(obs)
            for _ in range(300):
                obs, reward, terminated, truncated, info = env.step(env.action_space.sample())
                assert env.observation_space.contains(obs)
                assert math.isfinite(reward) and 0 <= info["progress"] <= 1
                if terminated or truncated:
                    break


def test_angles_at_the_bounds_are_in_the_space():
    # π in single precision is larger than π
    env = mdg.HoverAviary(initial_rpys=[[0, 0, math.pi]], initial_xyzs=[[0, 0, 1]])
    obs, _ = env.reset(seed=1)
    high = env.observation_space.high[5]
    assert obs[5] == high and float(high) <= math.pi
    env = mdg.HoverAviary(initial_rpys=[[0, 0, -math.pi]], initial_xyzs=[[0, 0, 1]])
    assert env.observation_space.contains(env.reset(seed=1)[0])


@pytest.mark.parametrize("act_type", ActionType)
def test_action_spaces(act_type):
    env = mdg.MultiHoverAviary(act_type=act_type, drone_model=AIRFRAME_WITH_DUTY)
    size = 1 if act_type is ActionType.ONE_D_RPM else 4
    space = env.action_space
    assert space.shape == (2 * size,) and space.dtype == np.float32
    if act_type is ActionType.RAW_RPM:
        assert (space.low == 0).all() and space.high == pytest.approx(env.MAX_RPM)
        assert (space.high.astype(np.float64) <= env.MAX_RPM).all()
    elif act_type is ActionType.PID:
        assert space.low.tolist()[:3] == [-10, -10, 0] and space.high.tolist()[:3] == [10, 10, 10]
    elif act_type is ActionType.DUTY:
        assert (space.low == 0).all() and (space.high == 1).all()
    elif act_type is not ActionType.VEL:
        assert (space.low == -1).all() and (space.high == 1).all()


def test_rpm_is_raw_without_a_task_and_normalized_in_tasks():
    base = mdg.BaseAviary()
    assert base.action_space.low.tolist() == [0] * 4
    assert base.action_space.high.tolist() == pytest.approx([base.MAX_RPM] * 4)
    assert mdg.HoverAviary().action_space.high.tolist() == [1] * 4
    raw = mdg.HoverAviary(act_type="raw_rpm")
    assert raw.action_space.high.tolist() == pytest.approx([base.MAX_RPM] * 4)
    assert mdg.BaseAviary(act_type="one_d_rpm").action_space.shape == (1,)


@pytest.mark.parametrize("drones", [1, 2])
def test_images(drones):
    def env(obs_type):
        return mdg.BaseAviary(num_drones=drones, obs_type=obs_type)

    rgb = env("rgb")
    assert rgb.observation_space == gym.spaces.Box(0, 255, (drones, 48, 64, 4), np.uint8)
    image, _ = rgb.reset(seed=1)
    assert image.shape == (drones, 48, 64, 4) and image.dtype == np.uint8
    assert (image[..., 3] == 255).all() and image[..., :3].std() > 5
    depth = env("depth").reset(seed=1)[0]
    assert depth.shape == (drones, 48, 64) and depth.dtype == np.float32
    assert 0 < depth.min() < depth.max() <= 100
    objects = env("segmentation").reset(seed=1)[0]
    assert objects.shape == (drones, 48, 64, 2) and objects.dtype == np.int32
    both = env("kin_rgb")
    assert isinstance(both.observation_space, gym.spaces.Dict)
    assert list(both.observation_space.keys()) == ["kin", "rgb"]
    obs, _ = both.reset(seed=1)
    assert (obs["rgb"] == image).all() and (obs["kin"] == env("kin").reset(seed=1)[0]).all()
    assert both.observation_space.contains(obs)


def test_numbers_of_other_parts_follow_those_of_the_task():
    env = mdg.MultiHoverAviary(obs_type="kin_adjacency", neighbourhood_radius=2.0)
    obs, _ = env.reset(seed=1)
    assert obs.shape == (26 + 4,) and obs[26:].tolist() == [0, 1, 1, 0]
    assert mdg.MultiHoverAviary(obs_type="kin_adjacency", neighbourhood_radius=0.5).reset(seed=1)[0][26:].sum() == 0


def test_observations_are_new_arrays():
    env = mdg.HoverAviary()
    first, _ = env.reset(seed=1)
    copy = first.copy()
    second = env.step(np.ones(4))[0]
    assert (first == copy).all() and (first != second).any()
    second[:] = 0
    assert env.observation()[2] > 0
