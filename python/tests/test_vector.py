"""Batches against single environments, and the contract of Gymnasium's vector environments."""

import gc
import pickle
import subprocess
import sys
import threading
import time

import gymnasium as gym
import numpy as np
import pytest
from airframes import AIRFRAME_WITH_BATTERY
from gymnasium.error import ClosedEnvironmentError, ResetNeeded
from gymnasium.vector import AutoresetMode

from mujoco_drones_gym import VectorAviary

IDS = {
    "hover": "Hover",
    "velocity": "Velocity",
    "multi_hover": "MultiHover",
    "fly_through": "FlyThrough",
    "formation": "Formation",
    "race": "Race",
    "antipodal": "Antipodal",
    "stabilize": "Stabilize",
    "track": "Track",
}
MODES = list(AutoresetMode)


def single(task, index, **options):
    """Returns the single environment that environment `index` of a batch must equal."""
    env_id = f"mujoco_drones_gym/{IDS[task]}-v0"
    return gym.make(env_id, stream=index, engine="hybrid", **options).unwrapped


class Wander:
    """Random float64 actions that change slowly."""

    def __init__(self, seed, shape):
        self.rng = np.random.default_rng(seed)
        self.held = np.zeros(shape)

    def next(self):
        common = 0.3 * (self.rng.random((*self.held.shape[:1], 1)) - 0.45)
        self.held = np.clip(0.8 * self.held + common + 0.01 * (self.rng.random(self.held.shape) - 0.5), -1.2, 1.2)
        return self.held


def compare(task, count, mode, threads, steps, **options):
    """Steps a batch and single environments with the same actions. Returns the number of episodes that ended."""
    batch = VectorAviary(task, count, autoreset_mode=mode, num_threads=threads, **options)
    alone = [single(task, i, **options) for i in range(count)]
    obs, infos = batch.reset(seed=5)
    assert infos == {}
    for i, env in enumerate(alone):
        np.testing.assert_array_equal(obs[i], env.reset(seed=5)[0])
    wander = Wander(3, (count, *batch.single_action_space.shape))
    over, ended = np.zeros(count, bool), 0
    for _ in range(steps):
        actions = wander.next()
        obs, rewards, terminations, truncations, infos = batch.step(actions)
        done = np.zeros(count, bool)
        for i, env in enumerate(alone):
            if over[i]:
                assert (rewards[i], terminations[i], truncations[i]) == (0, False, False)
                np.testing.assert_array_equal(obs[i], env.reset()[0])
                continue
            last, reward, terminated, truncated, info = env.step(actions[i])
            assert rewards[i] == np.float32(reward)
            assert (terminations[i], truncations[i]) == (terminated, truncated)
            done[i] = terminated or truncated
            if done[i] and mode is AutoresetMode.SAME_STEP:
                np.testing.assert_array_equal(infos["final_obs"][i], last)
                final = infos["final_info"]
                assert (final["success"][i], final["end"][i]) == (info["success"], info["end"])
                for key in ("time", "progress", "position_error", "crashed", "is_success"):
                    assert final[key][i] == info[key], key
                    np.testing.assert_array_equal(final[f"_{key}"], infos["_final_info"])
                np.testing.assert_array_equal(obs[i], env.reset()[0])
                continue
            np.testing.assert_array_equal(obs[i], last)
            if done[i]:
                for key in ("success", "end", "time", "progress", "position_error", "crashed", "is_success"):
                    assert infos[key][i] == info[key], key
                    np.testing.assert_array_equal(infos[f"_{key}"], infos["_success"])
            states = np.stack([env._getDroneStateVector(drone) for drone in range(env.NUM_DRONES)])
            np.testing.assert_array_equal(batch.states()[i], states)
        key = "_final_obs" if mode is AutoresetMode.SAME_STEP else "_success"
        assert (key in infos) == done.any()
        if done.any():
            np.testing.assert_array_equal(infos[key], done)
        ended += int(done.sum())
        over = done if mode is AutoresetMode.NEXT_STEP else np.zeros(count, bool)
        if mode is AutoresetMode.DISABLED and done.any():
            obs, _ = batch.reset(options={"reset_mask": done})
            for i in np.flatnonzero(done):
                np.testing.assert_array_equal(obs[i], alone[i].reset()[0])
    batch.close()
    return ended


@pytest.mark.parametrize("task", IDS)
def test_every_task_is_bit_identical_to_single_environments(task):
    mode = MODES[list(IDS).index(task) % 3]
    assert compare(task, 5, mode, 2, 45, episode_seconds=0.5) >= 5


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize(("count", "threads"), [(1, 1), (3, 2), (29, 3)])
def test_modes_threads_and_rates_are_bit_identical(mode, count, threads):
    options = {"sim_freq": 300, "ctrl_freq": 60, "episode_seconds": 0.4, "initial_rpys": [[0.05, -0.1, 0.7]]}
    assert compare("hover", count, mode, threads, 60, **options) >= count


@pytest.mark.parametrize("act_type", ["rpm", "one_d_rpm", "vel", "pid", "attitude", "ctbr", "raw_rpm", "duty"])
def test_action_types_of_swarms_are_bit_identical(act_type):
    yaws = [[0.0, 0.0, 1.2 - drone] for drone in range(3)]
    options = {"act_type": act_type, "num_drones": 3, "initial_rpys": yaws, "episode_seconds": 0.4}
    options["drone_model"] = AIRFRAME_WITH_BATTERY
    assert compare("formation", 9, AutoresetMode.NEXT_STEP, 2, 30, **options) >= 9


def test_conditions_are_bit_identical():
    options = {
        "physics": "mjc_gnd_drag_dw",
        "wind": {"model": "dryden", "velocity": [1.0, 0.5, 0.0]},
        "randomization": {"body": {"mass": [0.8, 1.2]}, "actuators": {"lag": [0.02, 0.05]}},
        "episode_seconds": 0.5,
    }
    assert compare("hover", 11, AutoresetMode.SAME_STEP, 2, 50, **options) >= 11


def test_float32_actions_equal_their_float64_values():
    batches = [VectorAviary("hover", 7, num_threads=1) for _ in range(3)]
    for batch in batches:
        batch.reset(seed=1)
    wander = Wander(1, (7, 4))
    for _ in range(20):
        actions = wander.next()
        exact = batches[0].step(actions.astype(np.float32))
        same = batches[1].step(actions.astype(np.float32).astype(np.float64))
        batches[2].step(actions)
        for a, b in zip(exact[:4], same[:4], strict=True):
            np.testing.assert_array_equal(a, b)
    assert not np.array_equal(batches[0].states(), batches[2].states())
    np.testing.assert_array_equal(batches[0].states(), batches[1].states())


def test_actions_of_any_layout_and_type_are_accepted():
    actions = 0.1 * np.arange(12, dtype=np.float64).reshape(3, 4) / 12
    states = []
    forms = [actions, actions.tolist(), np.asfortranarray(actions), np.repeat(actions, 2, axis=1)[:, ::2]]
    for form in [*forms, actions.astype(">f8")]:
        env = VectorAviary("hover", 3, num_threads=1)
        env.reset(seed=1)
        env.step(form)
        states.append(env.states())
    for state in states[1:]:
        np.testing.assert_array_equal(state, states[0])
    env.step(np.zeros((3, 4), np.int64))
    env.step(np.zeros((3, 4), np.float16))


def misaligned(array):
    """Returns a copy of an array at an address that is not a multiple of the size of its numbers."""
    copy = np.frombuffer(b"x" + array.tobytes(), array.dtype, offset=1).reshape(array.shape)
    assert not copy.flags.aligned
    return copy


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_misaligned_actions_are_accepted(dtype):
    actions = (0.1 * np.arange(12).reshape(3, 4) / 12).astype(dtype)
    states = []
    for form in [actions, misaligned(actions)]:
        env = VectorAviary("hover", 3)
        env.reset(seed=1)
        env.step(form)
        states.append(env.states())
    np.testing.assert_array_equal(states[0], states[1])
    alone = single("hover", 2)
    alone.reset(seed=1)
    alone.step(misaligned(actions[2]))
    np.testing.assert_array_equal(alone._getDroneStateVector(0), states[0][2, 0])


OVERLAPS = {
    "rewards": lambda obs, rewards: rewards.reshape(40, 1),
    "observations": lambda obs, rewards: obs.reshape(-1)[5:45].reshape(40, 1),
    "observations as float64": lambda obs, rewards: obs.reshape(-1)[4:84].view(np.float64).reshape(40, 1),
}


@pytest.mark.parametrize("part", OVERLAPS)
def test_actions_in_the_buffers_of_the_batch_are_read_before_the_step(part):
    options = {"act_type": "one_d_rpm", "copy": False, "on_fault": "truncate", "num_threads": 2}
    envs = [VectorAviary("hover", 40, **options) for _ in range(2)]
    results = []
    for env in envs:
        env.reset(seed=1)
        for step in range(5):
            last = env.step(0.3 * np.sin(np.arange(40.0) + step).reshape(40, 1))
        results.append(last[:4])
    for _ in range(3):
        actions = OVERLAPS[part](*results[0][:2])
        assert any(np.shares_memory(actions, buffer) for buffer in results[0])
        copy = actions.copy()
        envs[0].step(actions)
        envs[1].step(copy)
        for a, b in zip(*results, strict=True):
            np.testing.assert_array_equal(a, b)
        np.testing.assert_array_equal(envs[0].states(), envs[1].states())


def test_a_rejected_step_changes_no_result():
    env = VectorAviary("hover", 9, copy=False, autoreset_mode="Disabled", max_episode_steps=3)
    env.reset(seed=1)
    for _ in range(3):
        results = env.step(np.zeros((9, 4)))
    kept = [array.copy() for array in results[:4]]
    assert kept[3].all()
    bad = np.zeros((9, 4))
    bad[8, 3] = np.inf
    for actions, error in [(np.zeros((9, 4)), ResetNeeded), (bad, ResetNeeded), (np.zeros((9, 3)), ValueError)]:
        with pytest.raises(error):
            env.step(actions)
        for array, before in zip(results[:4], kept, strict=True):
            np.testing.assert_array_equal(array, before)


def test_shapes_types_and_attributes():
    env = VectorAviary("multi_hover", 6, num_threads=2, autoreset_mode="SameStep")
    assert isinstance(env, gym.vector.VectorEnv)
    assert (env.num_envs, env.num_threads, env.closed, env.render_mode) == (6, 1, False, None)
    assert env.metadata["autoreset_mode"] is env.autoreset_mode is AutoresetMode.SAME_STEP
    assert env.observation_space.shape == (6, *env.single_observation_space.shape) == (6, 26)
    assert env.action_space.shape == (6, *env.single_action_space.shape) == (6, 8)
    alone = single("multi_hover", 0)
    assert env.single_observation_space == alone.observation_space
    assert env.single_action_space == alone.action_space
    obs, infos = env.reset(seed=3)
    assert obs.dtype == np.float32 and obs in env.observation_space and infos == {}
    env.action_space.seed(1)
    for _ in range(600):
        obs, rewards, terminations, truncations, infos = env.step(env.action_space.sample())
        assert obs in env.observation_space and obs.dtype == np.float32
        assert rewards.shape == terminations.shape == truncations.shape == (6,)
        assert rewards.dtype in (np.float32, np.float64)
        assert terminations.dtype == truncations.dtype == np.bool_
        assert "episode" not in infos
    assert env.np_random_seed == 3


@pytest.mark.parametrize("name", ["next_step", "NextStep", "NEXT_STEP", AutoresetMode.NEXT_STEP])
def test_autoreset_modes_by_name(name):
    assert VectorAviary("hover", 2, autoreset_mode=name).autoreset_mode is AutoresetMode.NEXT_STEP


def test_seeds_of_single_environments_and_repeated_resets():
    env = VectorAviary("stabilize", 4)
    first, _ = env.reset(seed=7)
    second, _ = env.reset()
    again, _ = env.reset(seed=7)
    np.testing.assert_array_equal(first, again)
    assert not np.array_equal(first, second) and not np.array_equal(first[0], first[1])
    each, _ = env.reset(seed=[7, 8, 7, 9])
    np.testing.assert_array_equal(each[[0, 2]], first[[0, 2]])
    np.testing.assert_array_equal(each[1], env.reset(seed=8)[0][1])
    mask = np.array([True, False, True, True])
    masked, _ = env.reset(seed=[8, 3, 9, None], options={"reset_mask": mask})
    for i, seed in [(0, 8), (2, 9)]:
        np.testing.assert_array_equal(masked[i], single("stabilize", i).reset(seed=seed)[0])
    np.testing.assert_array_equal(masked[1], env.reset(seed=8)[0][1])
    mixed, _ = env.reset(seed=[None, 8, None, np.int64(9)])
    np.testing.assert_array_equal(mixed[3], each[3])
    with pytest.raises(ValueError, match="seed has 3 entries, expected one, or 4"):
        env.reset(seed=[1, 2, 3])
    for bad in [-1, 2**64, 1.5, "a"]:
        with pytest.raises(ValueError, match="seed is "):
            env.reset(seed=bad)


def test_many_seeds_take_as_long_as_one():
    env = VectorAviary("hover", 20_000, num_threads=1)
    seeds = list(range(20_000))
    obs, _ = env.reset(seed=seeds)
    np.testing.assert_array_equal(obs[12_345], single("hover", 12_345).reset(seed=12_345)[0])
    start = time.perf_counter()
    env.reset(seed=1)
    one = time.perf_counter() - start
    start = time.perf_counter()
    env.reset(seed=seeds)
    many = time.perf_counter() - start
    # a reset for every distinct seed would take hundreds of times as long
    assert many < 50 * one + 1, f"{one:.3f} s for one seed, {many:.3f} s for {len(seeds)}"


def test_reset_masks():
    env = VectorAviary("stabilize", 5, autoreset_mode=AutoresetMode.DISABLED, num_threads=1)
    first, _ = env.reset(seed=1)
    for _ in range(3):
        moved, *_ = env.step(np.zeros((5, 4)))
    mask = np.array([True, False, True, False, False])
    options = {"reset_mask": mask}
    obs, _ = env.reset(seed=1, options=options)
    np.testing.assert_array_equal(obs[mask], first[mask])
    np.testing.assert_array_equal(obs[~mask], moved[~mask])
    assert options == {"reset_mask": mask}, "the caller's dict is unchanged"
    times = [env.envs[i].info()["time"] for i in range(5)]
    assert [time > 0 for time in times] == [False, True, False, True, True]
    for bad in ([1] * 5, np.ones(5), np.ones(4, bool), 3):
        with pytest.raises(ValueError, match="reset_mask"):
            env.reset(options={"reset_mask": bad})
    with pytest.raises(ValueError, match="selects no environment"):
        env.reset(options={"reset_mask": np.zeros(5, bool)})


def test_disabled_autoreset_needs_a_reset_after_an_end():
    env = VectorAviary("hover", 3, autoreset_mode="Disabled", max_episode_steps=4)
    with pytest.raises(ResetNeeded):
        env.step(np.zeros((3, 4)))
    env.reset(seed=1)
    for _ in range(4):
        *_, truncations, infos = env.step(np.zeros((3, 4)))
    assert truncations.all() and list(infos["end"]) == ["time_limit"] * 3
    before = env.states()
    with pytest.raises(ResetNeeded) as error:
        env.step(np.ones((3, 4)))
    assert "\n" not in str(error.value)
    np.testing.assert_array_equal(env.states(), before)
    env.reset(options={"reset_mask": np.array([True, False, False])})
    with pytest.raises(ResetNeeded):
        env.step(np.zeros((3, 4)))
    env.reset(options={"reset_mask": np.array([False, True, True])})
    env.step(np.zeros((3, 4)))


def test_time_limits():
    for limit, expected in [(None, 480), (10, 10), (480, 480), (100_000, 100_000)]:
        assert VectorAviary("hover", 2, max_episode_steps=limit).max_episode_steps == expected
    env = VectorAviary("hover", 2, max_episode_steps=7, ctrl_freq=30)
    env.reset(seed=1)
    for step in range(1, 8):
        *_, terminations, truncations, _ = env.step(np.zeros((2, 4)))
        assert not terminations.any() and truncations.all() == (step == 7)


def test_views_are_the_same_arrays_and_outlive_the_environment():
    env = VectorAviary("hover", 40, copy=False, num_threads=2)
    obs, _ = env.reset(seed=1)
    first = env.step(np.full((40, 4), 0.1))
    kept = [array.copy() for array in first[:4]]
    second = env.step(np.full((40, 4), 0.2))
    for a, b in zip(first[:4], second[:4], strict=True):
        assert a is b and a.base is not None
    assert obs is first[0]
    assert not np.array_equal(kept[0], second[0])
    last = second[0].copy()
    env.close()
    del env
    gc.collect()
    filler = [np.full(480, 7.0, np.float32) for _ in range(1000)]
    np.testing.assert_array_equal(second[0], last)
    assert len(filler) == 1000


def test_copies_are_independent():
    env = VectorAviary("hover", 40)
    obs, _ = env.reset(seed=1)
    kept = obs.copy()
    results = env.step(np.full((40, 4), 0.1))
    np.testing.assert_array_equal(obs, kept)
    copies = [array.copy() for array in results[:4]]
    for array in results[:4]:
        array[...] = 1
    again = env.step(np.full((40, 4), 0.1))
    assert not np.array_equal(again[0], results[0]) and not np.array_equal(again[0], copies[0])
    assert not again[2].any() and not again[3].any()


def test_bytes_that_python_writes_into_flags_do_no_harm():
    env = VectorAviary("hover", 9, copy=False)
    env.reset(seed=1)
    *_, terminations, _, infos = env.step(np.zeros((9, 4)))
    terminations.view(np.uint8)[...] = 7
    *_, terminations, truncations, infos = env.step(np.zeros((9, 4)))
    assert not terminations.any() and not truncations.any() and infos == {}


def test_faults():
    env = VectorAviary("hover", 5, initial_xyzs=[[0, 0, 1]])
    env.reset(seed=1)
    before = env.states()
    actions = np.zeros((5, 4))
    actions[3, 1] = np.nan
    with pytest.raises(ValueError, match=r"environment 3: action\[1\] is NaN") as error:
        env.step(actions)
    assert "\n" not in str(error.value)
    np.testing.assert_array_equal(env.states(), before)
    for bad in [np.zeros((4, 4)), np.zeros(20), np.zeros((5, 3)), np.zeros((5, 4, 2))]:
        with pytest.raises(ValueError, match=r"actions have the shape \(.*\), expected \(5, 4\)"):
            env.step(bad)
    for bad in ["fast", None, object()]:
        with pytest.raises((TypeError, ValueError)):
            env.step(bad)
    np.testing.assert_array_equal(env.states(), before)
    env.step(np.zeros((5, 4)))
    lenient = VectorAviary("hover", 5, initial_xyzs=[[0, 0, 1]], on_fault="truncate")
    lenient.reset(seed=1)
    _, rewards, terminations, truncations, infos = lenient.step(actions)
    assert list(truncations) == [False, False, False, True, False] and not terminations.any()
    assert list(lenient.faults()) == [3] and "action[1] is NaN" in lenient.faults()[3]
    assert infos["end"][3] == "fault" and rewards[3] == 0 and list(infos["_end"]) == list(truncations)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"num_envs": 0}, "num_envs is 0, expected an integer from 1"),
        ({"num_envs": -4}, "num_envs is -4"),
        ({"num_envs": 2.5}, "num_envs is 2.5"),
        ({"num_threads": -1}, "num_threads is -1"),
        ({"num_threads": 5000}, "num_threads is 5000"),
        ({"max_episode_steps": 0}, "max_episode_steps is 0"),
        ({"autoreset_mode": "later"}, "autoreset_mode is 'later', expected one of 'NextStep', 'SameStep', 'Disabled'"),
        ({"on_fault": "ignore"}, 'on_fault is "ignore", expected "error" or "truncate"'),
        ({"task": "hovr"}, "hover"),
        ({"sim_freq": 0}, "sim_freq"),
        ({"physics": "bullet"}, "physics"),
    ],
)
def test_invalid_options_are_errors_of_one_line(options, message):
    with pytest.raises(ValueError) as error:
        VectorAviary(**{"task": "hover", "num_envs": 2, **options})
    assert message in str(error.value) and "\n" not in str(error.value)


def test_unknown_options_are_type_errors():
    with pytest.raises(TypeError, match="target_hight"):
        VectorAviary("hover", 2, target_hight=2.0)


def test_task_options_reach_every_environment():
    env = VectorAviary("hover", 3, target_height=2.0)
    env.reset(seed=1)
    assert [member.info()["position_error"] for member in env.envs] == pytest.approx([1.9] * 3)


def test_a_target_height_of_one_environment():
    env, other = VectorAviary("hover", 3), VectorAviary("hover", 3)
    for one in (env, other):
        one.reset(seed=1)
        one.step(np.zeros((3, 4)))
    env.envs[1].TARGET_HEIGHT = 0.1
    assert env.get_attr("TARGET_HEIGHT") == (1.0, 0.1, 1.0)
    _, rewards, *_ = env.step(np.zeros((3, 4)))
    _, expected, *_ = other.step(np.zeros((3, 4)))
    assert rewards[1] > expected[1] + 0.5 and list(rewards[[0, 2]]) == list(expected[[0, 2]])
    env.reset()
    assert env.get_attr("TARGET_HEIGHT") == (1.0, 0.1, 1.0)
    with pytest.raises(AttributeError, match="no attribute 'TARGET_HEIGHT'"):
        VectorAviary("track", 1).get_attr("TARGET_HEIGHT")


@pytest.mark.parametrize("task", IDS)
def test_make_vec(task):
    env_id = f"mujoco_drones_gym/{IDS[task]}-v0"
    env = gym.make_vec(env_id, num_envs=3, num_threads=1)
    assert isinstance(env.unwrapped, VectorAviary) and env.spec.id == env_id and env.num_envs == 3
    obs, _ = env.reset(seed=1)
    by_mode = gym.make_vec(env_id, 3, vectorization_mode="vector_entry_point", autoreset_mode="SameStep")
    np.testing.assert_array_equal(by_mode.reset(seed=1)[0], obs)
    assert by_mode.metadata["autoreset_mode"] is AutoresetMode.SAME_STEP
    assert "hover" not in repr(env) or "num_envs=3" in repr(env)
    by_mode.close()


def test_gymnasiums_own_vector_environments_agree_in_form():
    env_id = "mujoco_drones_gym/Hover-v0"
    ours = gym.make_vec(env_id, 2)
    sync = gym.make_vec(env_id, 2, vectorization_mode="sync")
    assert ours.single_observation_space == sync.single_observation_space
    assert ours.observation_space == sync.observation_space
    assert ours.action_space == sync.action_space
    a, b = ours.reset(seed=1)[0], sync.reset(seed=1)[0]
    assert (a.shape, a.dtype) == (b.shape, b.dtype)


def test_vector_wrappers_of_gymnasium():
    from gymnasium.wrappers.vector import ClipReward, DictInfoToList, RecordEpisodeStatistics

    env = RecordEpisodeStatistics(VectorAviary("hover", 4, max_episode_steps=5))
    env.reset(seed=1)
    total = np.zeros(4)
    for _ in range(5):
        _, rewards, _, _, infos = env.step(np.zeros((4, 4), np.float32))
        total += rewards
    np.testing.assert_allclose(infos["episode"]["r"], total, rtol=1e-5)
    assert list(infos["episode"]["l"]) == [5] * 4
    listed = DictInfoToList(ClipReward(VectorAviary("hover", 2, max_episode_steps=2), -0.1, 0.1))
    listed.reset(seed=1)
    listed.step(np.zeros((2, 4)))
    *_, infos = listed.step(np.zeros((2, 4)))
    assert [info["end"] for info in infos] == ["time_limit"] * 2
    torch = pytest.importorskip("torch")
    env = VectorAviary("hover", 2)
    env.reset(seed=1)
    assert env.step(torch.zeros(2, 4))[0].shape == (2, 12)


@pytest.mark.parametrize("mode", MODES)
def test_image_observations(mode):
    options = {"obs_type": "kin_rgb", "episode_seconds": 0.1, "initial_xyzs": [[0, 0, 0.6]]}
    env = VectorAviary("hover", 3, autoreset_mode=mode, num_threads=2, **options)
    alone = [single("hover", i, **options) for i in range(3)]
    obs, _ = env.reset(seed=1)
    assert obs["rgb"].shape == (3, 1, 48, 64, 4) and obs["rgb"].dtype == np.uint8
    assert obs in env.observation_space
    assert env.single_observation_space == alone[0].observation_space
    firsts = [one.reset(seed=1)[0] for one in alone]
    for step in range(5):
        actions = 0.1 * np.arange(12).reshape(3, 4) / 12
        obs, _, _, truncations, infos = env.step(actions)
        for i in range(3):
            last = alone[i].step(actions[i])[0]
            if mode is AutoresetMode.SAME_STEP and truncations[i]:
                for part in ("kin", "rgb"):
                    np.testing.assert_array_equal(infos["final_obs"][i][part], last[part])
                last = alone[i].reset()[0]
            np.testing.assert_array_equal(obs["kin"][i], last["kin"])
            np.testing.assert_array_equal(obs["rgb"][i], last["rgb"])
        assert truncations.all() == (step == 4)
    assert not np.array_equal(firsts[0]["rgb"], obs["rgb"][0]) or mode is AutoresetMode.SAME_STEP


@pytest.mark.parametrize("obs_type", ["rgb", "depth", "segmentation"])
def test_views_of_images(obs_type):
    env = VectorAviary("multi_hover", 2, obs_type=obs_type, copy=False)
    alone = single("multi_hover", 1, obs_type=obs_type)
    obs, _ = env.reset(seed=1)
    expected, _ = alone.reset(seed=1)
    np.testing.assert_array_equal(obs[1], expected)
    assert obs.dtype == expected.dtype and env.single_observation_space == alone.observation_space
    assert env.step(np.zeros((2, 8)))[0] is obs


def test_members():
    env = VectorAviary("multi_hover", 3, render_mode="rgb_array", width=96, height=64)
    env.reset(seed=1)
    assert len(env.envs) == len(list(env.envs)) == len(env.envs[:]) == 3
    np.testing.assert_array_equal(env.envs[-1].pos, env.envs[2].pos)
    assert env.envs[1].pos.shape == (2, 3) and env.envs[1].quat.shape == (2, 4)
    np.testing.assert_array_equal(env.envs[1].pos, env.states()[1, :, :3])
    assert env.get_attr("NUM_DRONES") == (2, 2, 2)
    assert env.call("info")[0]["time"] == 0
    env.set_attr("label", ["a", "b", "c"])
    assert env.get_attr("label") == ("a", "b", "c")
    with pytest.raises(AttributeError, match="no attribute 'levels'"):
        env.get_attr("levels")
    with pytest.raises(AttributeError, match="'pos' of an environment cannot be set"):
        env.set_attr("pos", 0)
    with pytest.raises(ValueError, match="values has 2 entries"):
        env.set_attr("label", [1, 2])
    with pytest.raises(IndexError, match="environment 3 does not exist"):
        env.envs[3]
    env.envs[1].set_wind({"model": "constant", "velocity": [5.0, 0.0, 0.0]})
    for _ in range(10):
        env.step(np.full((3, 8), 0.05))
    pos = env.states()[:, 0, 0]
    assert pos[1] > pos[0] + 1e-4 and pos[0] == pos[2]
    frames = env.render()
    assert len(frames) == 3 and frames[0].shape == (64, 96, 3) and frames[0].dtype == np.uint8
    assert frames[0].std() > 1


def test_closed_environments():
    env = VectorAviary("hover", 2)
    env.reset(seed=1)
    env.close()
    env.close()
    assert env.closed
    for call in (lambda: env.step(np.zeros((2, 4))), env.reset, env.states):
        with pytest.raises(ClosedEnvironmentError):
            call()


def test_pickles_are_the_options():
    env = VectorAviary("formation", 3, autoreset_mode="SameStep", num_drones=4, max_episode_steps=9)
    again = pickle.loads(pickle.dumps(env))
    assert again.single_observation_space == env.single_observation_space
    assert (again.max_episode_steps, again.autoreset_mode) == (9, AutoresetMode.SAME_STEP)
    np.testing.assert_array_equal(again.reset(seed=2)[0], env.reset(seed=2)[0])


def test_the_gil_is_released_during_a_step():
    env = VectorAviary("hover", 4096, num_threads=1)
    env.reset(seed=1)
    actions = np.zeros((4096, 4), np.float32)
    ticks, stop = [0], threading.Event()

    def count():
        while not stop.is_set():
            ticks[0] += 1
            time.sleep(0)

    counter = threading.Thread(target=count)
    counter.start()
    interval = sys.getswitchinterval()
    sys.setswitchinterval(10.0)
    try:
        before = ticks[0]
        for _ in range(200):
            env.step(actions)
        during = ticks[0] - before
    finally:
        sys.setswitchinterval(interval)
        stop.set()
        counter.join()
    assert during > 20, "a thread that needs the GIL runs during the steps"


def test_the_wrong_thread_gets_an_error():
    env = VectorAviary("hover", 4096, num_threads=1)
    env.reset(seed=1)
    actions, errors = np.zeros((4096, 4), np.float32), []

    def step():
        for _ in range(100):
            try:
                env.step(actions)
            except RuntimeError as error:
                errors.append(str(error))

    threads = [threading.Thread(target=step) for _ in range(3)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert errors and all(error == "another thread uses this batch, expected one thread at a time" for error in errors)
    env.step(actions)


def test_environments_that_are_dropped_leave_no_memory():
    code = """
import gc, resource
import numpy as np
from mujoco_drones_gym import VectorAviary

def use(i):
    env = VectorAviary("hover", 16, num_threads=1 + i % 2, copy=bool(i % 3))
    env.reset(seed=i)
    env.step(np.zeros((16, 4)))

def resident():
    gc.collect()
    with open("/proc/self/statm") as file:
        return int(file.read().split()[1]) * resource.getpagesize()

for i in range(100):
    use(i)
before = resident()
for i in range(400):
    use(i)
print(resident() - before)
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert int(done.stdout) < 4_000_000, "bytes for 400 environments"
