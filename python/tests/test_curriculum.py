"""Curricula: levels, statistics, errors."""

import pickle

import gymnasium as gym
import numpy as np
import pytest

from mujoco_drones_gym.wrappers import CurriculumConfig, CurriculumWrapper, WindConfig


class Scripted(gym.Env):
    """Episodes of one step whose success and reward a script gives."""

    observation_space = gym.spaces.Box(-1.0, 1.0, (1,))
    action_space = gym.spaces.Box(-1.0, 1.0, (1,))

    def __init__(self, script):
        self.script = list(script)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return np.zeros(1, np.float32), {"success": False}

    def step(self, action):
        success, reward = self.script.pop(0)
        return np.zeros(1, np.float32), reward, True, False, {"success": success, "is_success": success}


def levels(script, **settings):
    env = CurriculumWrapper(Scripted(script), None, CurriculumConfig(**settings))
    out = []
    for _ in script:
        env.reset()
        env.step(np.zeros(1))
        out.append(env.current_level)
    return env, out


def test_the_level_follows_the_success_rate():
    outcomes = [0, 1, 1, 1, 1, 1, 0, 0, 0]
    script = [(bool(success), 0.0) for success in outcomes]
    env, seen = levels(script, num_levels=3, window_size=2, threshold_advance=1.0, threshold_retreat=0.5)
    # a change of the level empties the window
    assert seen == [0, 0, 1, 1, 2, 2, 2, 1, 1]
    stats = env.get_stats()
    assert (stats["level"], stats["advances"], stats["retreats"], stats["episodes"]) == (1, 2, 1, 9)
    assert stats["episodes_per_level"] == [3, 2 + 1, 3] and stats["metric"] == "success_rate"
    assert stats["progress"] == 0.5 and stats["metric_avg"] == 0.0


def test_the_level_follows_reward_and_length():
    script = [(False, reward) for reward in (1.0, 3.0, 5.0, 7.0)]
    _, seen = levels(script, metric="reward", num_levels=5, window_size=2, threshold_advance=4.0)
    assert seen == [0, 0, 1, 1]
    _, seen = levels(script, metric="episode_length", num_levels=3, window_size=1, threshold_advance=1.0)
    assert seen == [1, 2, 2, 2], "the last level stays"


def test_start_level_and_advance_count():
    script = [(True, 0.0)] * 6
    _, seen = levels(script, num_levels=4, window_size=1, threshold_advance=1.0, start_level=1, advance_count=2)
    assert seen == [1, 2, 2, 3, 3, 3]


def test_names_of_the_simulator_are_accepted():
    paper = CurriculumConfig("reward", 3, 10, 0.5, threshold_retreat=0.1)
    assert paper == CurriculumConfig(metric="reward", levels=3, window=10, advance=0.5, retreat=0.1)
    assert CurriculumConfig().num_levels == 5 and paper.levels == 3


def test_every_reset_calls_the_function_with_the_unwrapped_environment():
    calls = []
    inner = Scripted([(True, 0.0)] * 3)
    config = CurriculumConfig(num_levels=3, window_size=1, threshold_advance=1.0)
    env = CurriculumWrapper(gym.wrappers.TimeLimit(inner, 5), lambda env, level: calls.append((env, level)), config)
    for expected in range(3):
        _, info = env.reset()
        assert info["curriculum_level"] == expected and info["curriculum_progress"] == expected / 2
        *_, info = env.step(np.zeros(1))
    assert calls == [(inner, 0), (inner, 1), (inner, 2)]


def test_interrupted_episodes_do_not_count():
    env = CurriculumWrapper(Scripted([(True, 0.0)]), config={"window_size": 1, "num_levels": 2})
    env.reset()
    env.reset()
    assert env.get_stats()["episodes"] == 0 and env.get_stats()["metric_avg"] == 0.0


def test_the_level_can_be_set_and_pickled():
    env = CurriculumWrapper(Scripted([(True, 0.0)] * 4), config={"window_size": 3, "num_levels": 4})
    env.current_level = 2
    for _ in range(2):
        env.reset()
        env.step(np.zeros(1))
    clone = pickle.loads(pickle.dumps(env))
    assert clone.get_stats() == env.get_stats() and clone.current_level == 2
    clone.reset()
    clone.step(np.zeros(1))
    assert (clone.current_level, env.current_level) == (3, 2)


def test_errors_name_the_setting():
    for settings, text in [
        ({"num_levels": 0}, "num_levels is 0, expected 1 to 1,000,000"),
        ({"window_size": 0}, "window_size is 0"),
        ({"threshold_retreat": 0.9}, "threshold_retreat is 0.9, expected less than threshold_advance"),
        ({"start_level": 5}, "start_level is 5, expected less than num_levels"),
        ({"levels": 0}, "levels is 0, expected 1 to 1,000,000"),
        ({"num_levels": "a"}, 'num_levels is "a", expected a whole number'),
        ({"metric": 5}, "metric: unknown variant `5`, expected one of `success_rate`, `reward`, `episode_length`"),
        (
            {"metric": "speed"},
            "metric: unknown variant `speed`, expected one of `success_rate`, `reward`, `episode_length`",
        ),
    ]:
        with pytest.raises(ValueError) as error:
            CurriculumConfig(**settings)
        assert str(error.value).startswith(text) and "\n" not in str(error.value)
    with pytest.raises(TypeError, match="patience"):
        CurriculumConfig(patience=3)
    with pytest.raises(TypeError, match="difficulty_fn is 3, expected a function"):
        CurriculumWrapper(Scripted([]), 3)
    for level in (9, -1, "a", None, 1.5, True):
        with pytest.raises(ValueError) as error:
            CurriculumWrapper(Scripted([])).current_level = level
        assert str(error.value) == f"current_level is {level!r}, expected a whole number from 0 to 4"
    for config in (5, "a", [1]):
        with pytest.raises(TypeError) as error:
            CurriculumWrapper(Scripted([]), None, config)
        assert str(error.value) == f"config is {config!r}, expected a CurriculumConfig or a dict of its fields"


def test_none_is_the_default_of_a_setting():
    assert CurriculumConfig(metric=None, num_levels=None) == CurriculumConfig()
    assert CurriculumWrapper(Scripted([]), config={"metric": None}).get_stats()["metric"] == "success_rate"


def test_the_function_changes_an_environment_of_this_package():
    from mujoco_drones_gym.envs.hover_aviary import HoverAviary

    def difficulty(env, level):
        env.TARGET_HEIGHT = 1.0 + 0.2 * level
        env.set_wind(WindConfig("constant", velocity=(float(level), 0.0, 0.0)))

    config = CurriculumConfig(metric="episode_length", num_levels=3, window_size=1, threshold_advance=1.0)
    env = CurriculumWrapper(gym.wrappers.RecordEpisodeStatistics(HoverAviary(episode_seconds=0.25)), difficulty, config)
    drifts = []
    for level in range(3):
        observation, info = env.reset(seed=1)
        assert info["curriculum_level"] == level
        assert env.unwrapped.TARGET_HEIGHT == pytest.approx(1.0 + 0.2 * level)
        done = False
        while not done:
            observation, _, terminated, truncated, info = env.step(np.zeros(env.action_space.shape))
            done = terminated or truncated
        assert "episode" in info
        drifts.append(observation[0])
    assert drifts[0] == 0.0 and drifts[2] > drifts[1] > 0.0
