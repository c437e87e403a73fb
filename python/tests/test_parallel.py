"""The contract of PettingZoo's parallel environments."""

import pickle
import subprocess
import sys
import warnings

import numpy as np
import pytest
from airframes import AIRFRAME_WITH_DUTY
from gymnasium.error import ResetNeeded

pettingzoo = pytest.importorskip("pettingzoo")

import cloudpickle  # noqa: E402
from pettingzoo.test import parallel_api_test, parallel_seed_test  # noqa: E402

from mujoco_drones_gym import MultiAgentAviary, parallel_env  # noqa: E402

TASKS = [
    "hover",
    "velocity",
    "multi_hover",
    "fly_through",
    "formation",
    "race",
    "multi_agent",
    "antipodal",
    "stabilize",
    "track",
]
ACTIONS = ["rpm", "one_d_rpm", "vel", "pid", "attitude", "ctbr", "raw_rpm", "duty"]


def drones(task):
    return {} if task == "hover" else {"num_drones": 3}


@pytest.mark.parametrize("act_type", ACTIONS)
@pytest.mark.parametrize("task", TASKS)
def test_api_and_seeds(task, act_type):
    options = {"act_type": act_type, "drone_model": AIRFRAME_WITH_DUTY, "episode_seconds": 1.0, **drones(task)}
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        parallel_api_test(parallel_env(task, **options), num_cycles=60)
        parallel_seed_test(lambda: parallel_env(task, **options), num_cycles=40)


@pytest.mark.parametrize("obs_type", ["rgb", "kin_rgb", "depth", "segmentation"])
def test_api_and_seeds_with_images(obs_type):
    options = {"obs_type": obs_type, "num_drones": 2, "episode_seconds": 0.2}
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        parallel_api_test(parallel_env("multi_hover", **options), num_cycles=12)
        parallel_seed_test(lambda: parallel_env("multi_hover", **options), num_cycles=6)


@pytest.mark.parametrize("task", TASKS)
def test_spaces_hold_every_value(task):
    env = parallel_env(task, episode_seconds=2.0, **drones(task))
    assert env.possible_agents == [f"drone{i}" for i in range(env.max_num_agents)]
    obs, infos = env.reset(seed=1)
    assert list(obs) == list(infos) == env.agents == env.possible_agents
    for i, agent in enumerate(env.agents):
        env.action_space(agent).seed(i)
    steps = 0
    while env.agents:
        live = list(env.agents)
        obs, rewards, terminations, truncations, infos = env.step({a: env.action_space(a).sample() for a in live})
        for result in (obs, rewards, terminations, truncations, infos):
            assert list(result) == live
        for agent in live:
            assert obs[agent] in env.observation_space(agent) and obs[agent].dtype == np.float32
            assert type(rewards[agent]) is float
            assert type(terminations[agent]) is bool and type(truncations[agent]) is bool
            over = terminations[agent] or truncations[agent]
            keys = {"time", "success", "progress", "position_error", "crashed"}
            assert set(infos[agent]) == (keys | {"end", "is_success"} if over else keys)
            assert (agent in env.agents) == (not over)
        steps += 1
    assert 0 < steps <= 96
    for _ in range(2):
        assert env.step({}) == ({}, {}, {}, {}, {})


def test_agents_leave_on_their_own():
    env = MultiAgentAviary(num_drones=3, initial_xyzs=[[0, 0, 0.6], [1, 0, 0.6], [2, 0, 0.6]])
    env.reset(seed=1)
    assert env.num_agents == 3 and env.observation_space("drone0").shape == (13,)
    while len(env.agents) == 3:
        result = env.step({"drone0": np.zeros(4), "drone1": -np.ones(4), "drone2": np.zeros(4)})
    assert env.agents == ["drone0", "drone2"]
    assert result[2] == {"drone0": False, "drone1": True, "drone2": False}
    assert result[4]["drone1"]["end"] == "floor_contact" and result[4]["drone1"]["crashed"] is True
    with pytest.raises(ValueError, match=r"unexpected action for the agent `drone1`, expected .*drone0, drone2"):
        env.step({"drone0": np.zeros(4), "drone1": np.zeros(4), "drone2": np.zeros(4)})
    env.step({"drone0": np.zeros(4), "drone2": np.zeros(4)})


def test_errors_of_actions_change_nothing():
    env = MultiAgentAviary()
    with pytest.raises(ResetNeeded):
        env.step({"drone0": np.zeros(4)})
    env.reset(seed=1)
    state = env.state()
    good = {agent: np.zeros(4) for agent in env.agents}
    for bad, message in [
        ({}, "missing action for the agent `drone0`"),
        ({**good, "drone9": np.zeros(4)}, "unexpected action for the agent `drone9`"),
        ({**good, "drone1": np.zeros(3)}, "the agent `drone1`: the action has 3 numbers, expected 4"),
        ({**good, "drone2": [0, np.inf, 0, 0]}, r"the agent `drone2`: action\[1\] is "),
    ]:
        with pytest.raises(ValueError, match=message.replace("[1]", "[1]")) as error:
            env.step(bad)
        assert "\n" not in str(error.value)
    np.testing.assert_array_equal(env.state(), state)
    assert env.agents == ["drone0", "drone1", "drone2"]
    env.step(good)
    with pytest.raises(ValueError, match="seed is -1"):
        env.reset(seed=-1)


def test_the_end_needs_a_reset():
    env = MultiAgentAviary(episode_seconds=0.05)
    env.reset(seed=1)
    while env.agents:
        _, _, terminations, truncations, infos = env.step({agent: np.zeros(4) for agent in env.agents})
    assert all(truncations.values()) and not any(terminations.values())
    assert infos["drone2"]["end"] == "time_limit" and infos["drone2"]["is_success"] is False
    with pytest.raises(ResetNeeded):
        env.step({"drone0": np.zeros(4)})
    assert env.step({}) == ({}, {}, {}, {}, {})
    env.reset()
    assert env.num_agents == 3


class Own(MultiAgentAviary):
    """A subclass with another constructor."""

    def __init__(self, count):
        super().__init__(count, task="antipodal")
        self.note = "mine"


def test_copies_of_subclasses_and_of_changed_conditions():
    env = Own(3)
    env.set_wind({"model": "constant", "velocity": (2.0, 0.0, 0.0)})
    env.set_randomization({"body": {"mass": (0.5, 0.6)}})
    other = pickle.loads(pickle.dumps(env))
    assert type(other) is Own and (other.note, other.NUM_DRONES, other.agents) == ("mine", 3, [])
    for own in (env, other):
        own.reset(seed=1)
        for _ in range(20):
            own.step({agent: np.full(4, 0.1) for agent in own.agents})
    np.testing.assert_array_equal(env.state(), other.state())


def test_wind_and_sampled_parameters_of_agents():
    env, calm = (MultiAgentAviary(2, act_type="vel") for _ in range(2))
    assert env.sampled_params() is None
    env.set_wind({"model": "constant", "velocity": (3.0, 0.0, 0.0)})
    for own in (env, calm):
        own.reset(seed=1)
        for _ in range(40):
            own.step({agent: np.array([0.0, 0.0, 0.5, 0.0]) for agent in own.agents})
    assert (env.pos[:, 0] > calm.pos[:, 0] + 1e-3).all()
    env.set_randomization({"body": {"mass": (0.5, 0.6)}})
    env.reset(seed=1)
    factors = [drone["mass"] for drone in env.sampled_params()["drones"]]
    assert all(0.5 <= factor <= 0.6 for factor in factors)
    assert pytest.approx(factors[0] * 0.027) == env.M
    with pytest.raises(ValueError, match="wind"):
        env.set_wind({"model": "storm"})
    ranged = MultiAgentAviary(2, randomization={"environment": {"wind": (0.0, 3.0)}})
    with pytest.raises(ValueError, match="wind"):
        ranged.set_wind({"model": "gust"})


def test_metrics_of_agents():
    env = parallel_env("race", num_drones=2)
    env.reset(seed=1)
    assert env.metrics() == {"gates_passed": 0.0}


def test_terms_of_the_reward_of_agents():
    env = MultiAgentAviary(num_drones=3, initial_xyzs=[[0, 0, 0.6], [1, 0, 0.6], [2, 0, 0.6]])
    env.reset(seed=1)
    assert env.reward_terms("drone0") == {}
    while len(env.agents) == 3:
        _, rewards, *_ = env.step({"drone0": np.zeros(4), "drone1": -np.ones(4), "drone2": np.zeros(4)})
        for agent, reward in rewards.items():
            assert sum(env.reward_terms(agent).values()) == reward
    assert env.reward_terms("drone1")["crash"] == -100.0
    env.step(dict.fromkeys(env.agents, np.zeros(4)))
    assert env.reward_terms("drone1") == {} and env.reward_terms("drone2")["crash"] == 0.0
    with pytest.raises(ValueError, match=r"^agent is 'drone7', expected one of drone0, drone1, drone2$"):
        env.reward_terms("drone7")


def test_action_types_of_agents():
    assert parallel_env("hover", act_type="ctbr").action_type == "ctbr"


def test_seeds_streams_and_state():
    env = parallel_env("stabilize", num_drones=2)
    first, _ = env.reset(seed=4)
    second, _ = env.reset()
    again, _ = env.reset(seed=4)
    np.testing.assert_array_equal(first["drone1"], again["drone1"])
    assert not np.array_equal(first["drone0"], second["drone0"])
    assert env.state().shape == env.state_space.shape == (24,) and env.state() in env.state_space
    np.testing.assert_allclose(env.state()[12:], first["drone1"][:12], atol=1e-6)


def test_float64_actions_keep_their_precision():
    states = []
    for epsilon in (0.0, 1e-9):
        env = MultiAgentAviary(num_drones=2)
        env.reset(seed=1)
        for _ in range(60):
            env.step({agent: np.full(4, 0.1 + epsilon) for agent in env.agents})
        states.append(env._env.state())
    assert not np.array_equal(*states)
    np.testing.assert_allclose(*states, atol=1e-6)


def test_pickles_are_the_options():
    env = parallel_env("antipodal", num_drones=4, act_type="vel")
    for again in (pickle.loads(pickle.dumps(env)), cloudpickle.loads(cloudpickle.dumps(env))):
        assert again.possible_agents == env.possible_agents
        assert again.observation_space("drone0") == env.observation_space("drone0")
        np.testing.assert_array_equal(again.reset(seed=2)[0]["drone3"], env.reset(seed=2)[0]["drone3"])


def test_rendering_and_metadata():
    env = MultiAgentAviary(render_mode="rgb_array", width=96, height=64)
    assert env.metadata["name"] == "multi_agent_v0" and env.metadata["render_modes"] == ["rgb_array"]
    env.reset(seed=1)
    frame = env.render()
    assert frame.shape == (64, 96, 3) and frame.dtype == np.uint8 and frame.std() > 1
    with pytest.raises(ValueError, match="render_mode"):
        MultiAgentAviary(render_mode="hologram")
    env.close()
    assert env.agents == []


def test_unknown_options_and_tasks():
    with pytest.raises(TypeError, match="drones"):
        parallel_env("multi_hover", drones=3)
    with pytest.raises(ValueError, match="multi_hover"):
        parallel_env("multi_hovr")
    with pytest.raises(KeyError):
        parallel_env("multi_hover").observation_space("drone7")


def test_conversion_to_an_aec_environment():
    from pettingzoo.utils import parallel_to_aec

    env = parallel_to_aec(MultiAgentAviary(num_drones=2, episode_seconds=0.2))
    env.reset(seed=1)
    count = 0
    for agent in env.agent_iter():
        _, _, terminated, truncated, _ = env.last()
        env.step(None if terminated or truncated else env.action_space(agent).sample())
        count += 1
    assert count > 4


def test_the_package_does_not_import_pettingzoo_by_itself():
    code = "import sys, mujoco_drones_gym; print('pettingzoo' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "False"
