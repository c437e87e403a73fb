"""Images for people, and images of the onboard cameras."""

import gymnasium as gym
import numpy as np
import pytest

import mujoco_drones_gym as mdg

VIEWS = ["track", "fpv", "fixed", "front", "top"]


def test_views():
    env = mdg.HoverAviary(render_mode="rgb_array", width=160, height=120)
    env.reset(seed=1)
    images = {view: env.render(camera_mode=view) for view in VIEWS}
    for view, image in images.items():
        assert image.shape == (120, 160, 3) and image.dtype == np.uint8, view
        assert image.std() > 2, view
    assert (env.render() == images["track"]).all()
    for first in VIEWS:
        for second in VIEWS:
            assert first == second or (images[first] != images[second]).any(), (first, second)
    for _ in range(24):
        env.step(np.full(4, 0.2))
    assert (env.render() != images["track"]).any()
    with pytest.raises(ValueError, match=r"camera.*track"):
        env.render("side")


def test_the_option_camera_is_that_of_render():
    options = {"render_mode": "rgb_array", "width": 80, "height": 60}
    env = gym.make("mujoco_drones_gym/Hover-v0", camera="top", **options)
    env.reset(seed=1)
    plain = mdg.HoverAviary(**options)
    plain.reset(seed=1)
    images = {view: plain.render(view) for view in VIEWS}
    assert (env.render() == images["top"]).all() and (env.unwrapped.render("fpv") == images["fpv"]).all()
    batch = mdg.VectorAviary("hover", 2, camera="front", **options)
    batch.reset(seed=1)
    assert (batch.render()[0] == images["front"]).all()
    assert (batch.envs[0].render("top") == images["top"]).all()
    for make in (mdg.HoverAviary, lambda **options: mdg.VectorAviary("hover", **options)):
        with pytest.raises(ValueError, match=r"^camera is 'side', expected track, fpv, fixed, front or top$"):
            make(camera="side")
    with pytest.raises(ValueError, match=r"^camera_mode is 'side', expected track"):
        batch.envs[0].render("side")


def test_cameras_of_agents():
    pytest.importorskip("pettingzoo")
    options = {"render_mode": "rgb_array", "width": 80, "height": 60}
    env = mdg.MultiAgentAviary(2, camera="top", **options)
    env.reset(seed=1)
    assert (env.render() == env.render("top")).all() and (env.render() != env.render("fpv")).any()
    with pytest.raises(ValueError, match=r"^camera is 'side', expected track"):
        mdg.MultiAgentAviary(camera="side")


def test_default_size_and_render_modes():
    env = gym.make("mujoco_drones_gym/Hover-v0", render_mode="rgb_array")
    env.reset(seed=1)
    assert env.render().shape == (480, 640, 3)
    assert env.metadata["render_modes"] == ["rgb_array"] and env.metadata["render_fps"] == 48
    assert mdg.HoverAviary(ctrl_freq=60).metadata["render_fps"] == 60


def test_without_a_render_mode():
    env = mdg.HoverAviary(width=64, height=48)
    env.reset(seed=1)
    with pytest.warns(UserWarning, match="render_mode"):
        assert env.render() is None
    assert env.render("top").shape == (48, 64, 3)


def test_check_env_renders():
    from gymnasium.utils.env_checker import check_env

    check_env(gym.make("mujoco_drones_gym/MultiHover-v0", render_mode="rgb_array", width=64, height=48).unwrapped)


def test_record_video(tmp_path):
    env = mdg.HoverAviary(render_mode="rgb_array", width=64, height=48, episode_seconds=0.2)
    env = gym.wrappers.RenderCollection(env)
    env.reset(seed=1)
    for _ in range(5):
        env.step(np.zeros(4))
    frames = env.render()
    assert len(frames) == 6 and frames[0].shape == (48, 64, 3)


def test_vision_attributes():
    env = mdg.BaseAviary(num_drones=2, vision_attributes=True)
    env.reset(seed=1)
    assert env.rgb.shape == (2, 48, 64, 4) and env.rgb.dtype == np.uint8
    assert env.dep.shape == (2, 48, 64) and env.dep.dtype == np.float32
    assert env.seg.shape == (2, 48, 64) and env.seg.dtype == np.int32
    observed = mdg.BaseAviary(num_drones=2, obs_type="rgb").reset(seed=1)[0]
    assert (env.rgb == observed).all()
    before = env.dep
    for _ in range(20):
        env.step(np.full(8, env.MAX_RPM))
    assert (env.dep != before).any()
    assert not hasattr(mdg.BaseAviary(), "rgb")


def test_obstacles_and_markers_are_in_the_images():
    def image(**options):
        env = mdg.BaseAviary(initial_xyzs=[[0, 0, 0.5]], obs_type="depth", **options)
        return env.reset(seed=1)[0]

    wall = [mdg.wrappers.obstacles.Obstacle("box", [1, 0, 0.5], [0.1, 1, 0.5])]
    assert image(obstacles=wall).min() < 1.0 and (image(obstacles=wall) != image()).any()
