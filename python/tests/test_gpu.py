"""Batches on a GPU. Without a GPU back end in the package, the option is an error."""

import numpy as np
import pytest

from mujoco_drones_gym import VectorAviary


def gpu(task="hover", num_envs=8, **options):
    try:
        return VectorAviary(task, num_envs, device="gpu", **options)
    except (RuntimeError, ValueError) as error:
        text = str(error)
        assert "\n" not in text
        if "no GPU back end" in text or "no adapter" in text:
            pytest.skip(text)
        raise


@pytest.mark.parametrize("device", ["", "tpu", "gpu:", "cuda", "GPU"])
def test_an_unknown_device_is_an_error(device):
    with pytest.raises(ValueError, match=r'^device is .*expected "cpu", "gpu" or "gpu:" and an adapter$'):
        VectorAviary("hover", 2, device=device)


def test_a_device_that_is_no_string_is_an_error():
    with pytest.raises(ValueError, match=r"^device is 3, expected"):
        VectorAviary("hover", 2, device=3)


def test_the_cpu_is_the_default():
    env = VectorAviary("hover", 2)
    assert env.device == "cpu"
    env.close()


def test_a_gpu_has_no_images_for_people():
    with pytest.raises(ValueError, match=r"^render_mode is 'rgb_array', expected None with device='gpu'$"):
        VectorAviary("hover", 2, device="gpu", render_mode="rgb_array")


def test_an_environment_of_the_gpu_has_its_state_alone():
    env = gpu()
    env.reset(seed=1)
    assert env.states().shape == (8, 1, 20) and env.batteries().shape == (8, 1, 3)
    assert env.envs[3].pos.shape == (1, 3) and env.metadata["render_modes"] == []
    for call in (env.envs[0].info, env.reward_terms, lambda: env.envs[0].set_wind(None)):
        with pytest.raises(ValueError, match=r'^device is "gpu", expected "cpu": an environment on a GPU gives access'):
            call()


def test_a_flight_on_the_gpu_is_close_to_that_on_the_cpu():
    envs = [gpu(), VectorAviary("hover", 8)]
    assert envs[0].single_observation_space == envs[1].single_observation_space
    assert (envs[0].CTRL_FREQ, envs[0].NUM_DRONES) == (envs[1].CTRL_FREQ, envs[1].NUM_DRONES)
    rows = [env.reset(seed=1)[0] for env in envs]
    np.testing.assert_allclose(rows[0], rows[1], atol=1e-6)
    rng = np.random.default_rng(0)
    for _ in range(40):
        actions = (0.05 * rng.standard_normal((8, 1)) + np.zeros((8, 4))).astype(np.float32)
        (a, reward_a, over_a, cut_a, _), (b, reward_b, over_b, cut_b, _) = (env.step(actions) for env in envs)
        np.testing.assert_allclose(a, b, atol=1e-4)
        np.testing.assert_allclose(reward_a, reward_b, atol=1e-4)
        assert (over_a == over_b).all() and (cut_a == cut_b).all()
    for env in envs:
        env.close()


def test_the_end_of_an_episode_has_its_info():
    env = gpu(episode_seconds=0.25, autoreset_mode="SameStep")
    env.reset(seed=1)
    for _ in range(12):
        *_, truncated, infos = env.step(np.zeros((8, 4), np.float32))
    assert truncated.all()
    assert np.allclose(infos["final_info"]["time"], 0.25)
    assert infos["_final_obs"].all()
    env.close()


def test_an_option_that_the_gpu_lacks_is_one_line():
    gpu().close()
    with pytest.raises(ValueError, match=r"on the GPU$"):
        gpu(drone_model="cf21")
