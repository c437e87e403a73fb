"""Environments of a single agent: Gymnasium's contract, infos, errors, and their flights."""

import ast
import csv
import math
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
from airframes import AIRFRAME_WITH_DUTY
from gymnasium.error import ResetNeeded
from gymnasium.utils.env_checker import check_env

import mujoco_drones_gym as mdg
from mujoco_drones_gym import _registration
from mujoco_drones_gym.utils.enums import ActionType, ObservationType

REFERENCE = Path(__file__).resolve().parents[2] / "tests" / "reference"
CLASSES = {
    "base": mdg.BaseAviary,
    "hover": mdg.HoverAviary,
    "velocity": mdg.VelocityAviary,
    "multi_hover": mdg.MultiHoverAviary,
    "fly_through": mdg.FlyThroughAviary,
    "formation": mdg.FormationAviary,
    "race": mdg.RaceAviary,
    "antipodal": mdg.AntipodalAviary,
    "stabilize": mdg.StabilizeAviary,
    "track": mdg.TrackAviary,
}
#: Numbers of an observation per drone and default number of drones, from the README.
SIZES = {
    "base": (20, 1),
    "hover": (12, 1),
    "velocity": (16, 1),
    "multi_hover": (13, 2),
    "fly_through": (18, 1),
    "formation": (18, 3),
    "race": (21, 1),
    "stabilize": (12, 1),
    "track": (18, 1),
}
INFO = {"time": float, "success": bool, "progress": float, "position_error": float, "crashed": bool}

checked = {"gymnasium": 0, "sb3": 0}


@pytest.fixture(scope="module", autouse=True)
def print_counts():
    yield
    print(f"\nenvironments checked by Gymnasium: {checked['gymnasium']}, by Stable-Baselines3: {checked['sb3']}")


@pytest.mark.filterwarnings("ignore::UserWarning")
@pytest.mark.parametrize("obs_type", ObservationType)
@pytest.mark.parametrize("task", CLASSES)
def test_check_env(task, obs_type):
    for act_type in ActionType:
        check_env(
            CLASSES[task](obs_type=obs_type, act_type=act_type, drone_model=AIRFRAME_WITH_DUTY), skip_render_check=True
        )
        checked["gymnasium"] += 1


@pytest.mark.filterwarnings("ignore::UserWarning")
@pytest.mark.parametrize("task", CLASSES)
def test_check_env_of_sb3(task):
    checker = pytest.importorskip("stable_baselines3.common.env_checker")
    for obs_type in ("kin", "kin_rgb"):
        for act_type in ActionType:
            checker.check_env(
                CLASSES[task](obs_type=obs_type, act_type=act_type, drone_model=AIRFRAME_WITH_DUTY), warn=False
            )
            checked["sb3"] += 1


@pytest.mark.parametrize("name", _registration.IDS)
def test_registered_ids(name):
    task = _registration.IDS[name]
    spec = gym.spec(f"mujoco_drones_gym/{name}-v0")
    assert spec.entry_point and spec.vector_entry_point and spec.max_episode_steps is None
    env = gym.make(f"mujoco_drones_gym/{name}-v0", episode_seconds=0.2)
    assert type(env.unwrapped) is CLASSES[task]
    env.reset(seed=1)
    steps = 0
    while True:
        _, _, terminated, truncated, info = env.step(np.zeros(env.action_space.shape))
        steps += 1
        if terminated or truncated:
            break
    assert info["end"] == "time_limit" and steps == round(0.2 * 48)
    envs = gym.make_vec(f"mujoco_drones_gym/{name}-v0", num_envs=2, vectorization_mode="vector_entry_point")
    assert isinstance(envs, mdg.VectorAviary) and envs.task == task
    envs.close()


def test_id_with_the_module_in_a_new_process(run_python):
    run_python(
        "import gymnasium as gym\n"
        "env = gym.make('mujoco_drones_gym:mujoco_drones_gym/Hover-v0', target_height=0.5)\n"
        "assert env.unwrapped.TARGET_HEIGHT == 0.5\n"
    )


def test_import_needs_numpy_and_gymnasium_alone_and_leaves_the_environment(run_python):
    run_python(
        "import os, sys\n"
        "before = dict(os.environ)\n"
        "import mujoco_drones_gym\n"
        "assert dict(os.environ) == before\n"
        "loaded = {'pettingzoo', 'stable_baselines3', 'torch', 'mujoco', 'matplotlib'} & set(sys.modules)\n"
        "assert not loaded, loaded\n"
        "from mujoco_drones_gym import *\n"
        "assert 'pettingzoo' not in sys.modules\n"
        "mujoco_drones_gym.HoverAviary().reset()\n"
    )


@pytest.mark.parametrize("task", SIZES)
def test_sizes(task):
    env = CLASSES[task]()
    per_drone, drones = SIZES[task]
    assert env.NUM_DRONES == drones
    assert env.observation_space.shape == (per_drone * drones,)
    assert env.action_space.shape == (4 * drones,)
    assert env.observation_space.dtype == env.action_space.dtype == np.float32


def test_infos():
    env = mdg.HoverAviary()
    _, info = env.reset(seed=1)
    assert {name: type(value) for name, value in info.items()} == INFO
    assert info["time"] == 0.0 and info["position_error"] == pytest.approx(0.9)
    terminated = truncated = False
    while not (terminated or truncated):
        assert "end" not in info and "is_success" not in info
        obs, reward, terminated, truncated, info = env.step(np.zeros(4))
        assert type(reward) is float and type(terminated) is bool and type(truncated) is bool
        assert obs.dtype == np.float32
    # the drone hovers at its start
    assert (terminated, truncated, info["end"], info["is_success"]) == (False, True, "time_limit", False)
    assert info["time"] == 10.0


def test_a_crash_terminates():
    env = mdg.HoverAviary(initial_xyzs=[[0, 0, 1]])
    env.reset(seed=1)
    reward, terminated = 0.0, False
    while not terminated:
        _, reward, terminated, truncated, info = env.step(np.full(4, -1.0))
    assert info["end"] == "floor_contact" and info["crashed"] and not truncated and reward < -100


def test_a_controller_completes_the_task():
    env = mdg.FlyThroughAviary(act_type="pid", waypoints=[[0, 0, 0.5], [0.2, 0, 0.5]])
    env.reset(seed=1)
    terminated = truncated = False
    while not (terminated or truncated):
        position, _, yaw = env.reference(0)
        _, _, terminated, truncated, info = env.step(np.append(position, yaw))
    assert (terminated, info["end"], info["is_success"], info["progress"]) == (True, "completed", True, 1.0)


def test_steps_outside_an_episode_need_a_reset():
    env = mdg.HoverAviary(episode_seconds=0.05)
    with pytest.raises(ResetNeeded, match="reset"):
        env.step(np.zeros(4))
    env.reset(seed=1)
    while not env.step(np.zeros(4))[3]:
        pass
    before = env._getDroneStateVector(0)
    with pytest.raises(ResetNeeded):
        env.step(np.zeros(4))
    assert (env._getDroneStateVector(0) == before).all()
    env.reset()
    env.step(np.zeros(4))


@pytest.mark.parametrize(
    "action",
    [np.zeros(3), np.zeros(5), np.zeros((0,)), [0.0, 0.0, math.nan, 0.0], [math.inf] * 4, "abcd", None, [None] * 4, {}],
)
def test_wrong_actions_move_nothing(action):
    env = mdg.HoverAviary()
    env.reset(seed=1)
    env.step(np.zeros(4))
    before, time = env._env.states(), env._env.info()["time"]
    with pytest.raises(ValueError) as error:
        env.step(action)
    assert "action" in str(error.value) and "\n" not in str(error.value)
    assert (env._env.states() == before).all() and env._env.info()["time"] == time
    env.step(np.zeros(4))


@pytest.mark.parametrize(
    "action",
    [
        [0.1, 0.2, 0.3, 0.4],
        (0.1, 0.2, 0.3, 0.4),
        np.array([[0.1, 0.2, 0.3, 0.4]]),
        np.array([0.1, 0.2, 0.3, 0.4]),
        np.array([9, 0.1, 9, 0.2, 9, 0.3, 9, 0.4])[1::2],
    ],
)
def test_actions_of_any_kind_of_array(action):
    env, same = mdg.HoverAviary(), mdg.HoverAviary()
    env.reset(seed=1)
    same.reset(seed=1)
    same.step(np.array([0.1, 0.2, 0.3, 0.4]))
    env.step(action)
    assert (env._env.states() == same._env.states()).all()


def test_actions_are_clipped():
    env, same = mdg.HoverAviary(), mdg.HoverAviary()
    env.reset(seed=1)
    same.reset(seed=1)
    env.step(np.array([5.0, -5.0, 1.0, -1.0]))
    same.step(np.array([1.0, -1.0, 1.0, -1.0]))
    assert (env._env.states() == same._env.states()).all()


def test_seeds():
    env, same = mdg.VelocityAviary(), mdg.VelocityAviary()
    first = env.reset(seed=7)[0]
    assert (first == same.reset(seed=7)[0]).all()
    assert (env.np_random.random(3) == same.np_random.random(3)).all()
    second = env.reset()[0]
    assert (second == same.reset()[0]).all() and (first != second).any()
    assert (env.reset(seed=np.int64(7))[0] == first).all()
    assert (mdg.VelocityAviary(stream=1).reset(seed=7)[0] != first).any()
    # without a seed, an episode is random
    assert (mdg.VelocityAviary().reset()[0] != mdg.VelocityAviary().reset()[0]).any()
    for seed in (-1, 2**64, 1.5, "1", True):
        with pytest.raises(ValueError, match="seed"):
            env.reset(seed=seed)


def test_engines_agree():
    envs = [mdg.HoverAviary(engine=engine) for engine in ("mujoco", "hybrid")]
    rng = np.random.default_rng(1)
    for env in envs:
        env.reset(seed=1)
    for _ in range(48):
        action = rng.uniform(-0.02, 0.1, 4)
        states = [(env.step(action), env._env.states())[1] for env in envs]
        np.testing.assert_allclose(states[0], states[1], rtol=0, atol=1e-8)


@pytest.mark.parametrize("rpm", [14_000.123456789, 15_000.987654321, 0.0])
@pytest.mark.parametrize("engine", ["mujoco", "hybrid"])
def test_equal_motor_speeds_accelerate_as_in_closed_form(rpm, engine):
    env = mdg.BaseAviary(initial_xyzs=[[0, 0, 50]], engine=engine)
    env.reset(seed=1)
    acceleration = 4 * env.KF * rpm**2 / env.M - env.G
    for step in range(1, 49):
        env.step(np.full(4, rpm))
        time = step / 48
        # single precision of the motor speeds would change the height by more than 1e-7 m
        assert env.pos[0, 2] == pytest.approx(50 + acceleration * time**2 / 2, abs=1e-9)
        assert env.vel[0, 2] == pytest.approx(acceleration * time, abs=1e-9)


def test_opposite_motor_speeds_turn_as_in_closed_form():
    env = mdg.BaseAviary(initial_xyzs=[[0, 0, 50]])
    env.reset(seed=1)
    slow, fast = 14_000.1, 14_200.3
    moment = env.drone_params(0)["inertia"][2]
    acceleration = 2 * env.KM * (fast**2 - slow**2) / moment
    for step in range(1, 25):
        env.step(np.array([slow, fast, slow, fast]))
        time = step / 48
        assert env.ang_v[0] == pytest.approx([0, 0, acceleration * time], abs=1e-9)
        assert env.rpy[0] == pytest.approx([0, 0, acceleration * time**2 / 2], abs=1e-9)


def reference_flight(name):
    lines = (REFERENCE / f"{name}.toml").read_text().splitlines()
    options = {key.strip(): ast.literal_eval(value.strip()) for key, value in (line.split("=") for line in lines)}
    with open(REFERENCE / f"{name}.actions.csv", newline="") as file:
        actions = [[float(number) for number in row] for row in list(csv.reader(file))[1:]]
    with open(REFERENCE / f"{name}.expected.csv", newline="") as file:
        expected = np.array([[float(number) for number in row] for row in list(csv.reader(file))[1:]])
    return options, np.array(actions), expected.reshape(len(actions), options["num_drones"], -1)


@pytest.mark.parametrize(
    ("name", "engine"),
    [
        ("mjc_cf2x", "mujoco"),
        ("mjc_cf2x", "hybrid"),
        ("mjc_gnd_race", "mujoco"),
        ("mjc_gnd_race", "hybrid"),
        ("mjc_dw_close", "mujoco"),
        ("mjc_dw_close", "hybrid"),
        ("dyn_cf2p", None),
    ],
)
def test_reference_flights(name, engine):
    options, actions, expected = reference_flight(name)
    env = mdg.BaseAviary(engine=engine, **options)
    env.reset(seed=1)
    worst = 0.0
    for action, rows in zip(actions, expected, strict=True):
        env.step(action)
        states = np.hstack([env.pos, env.quat, env.vel, env.ang_v])
        worst = max(worst, np.abs(states - rows[:, 2:]).max())
    assert worst < 1e-8


def test_threads_step_environments_of_their_own():
    from concurrent.futures import ThreadPoolExecutor

    def fly(seed):
        env = mdg.VelocityAviary()
        obs = [env.reset(seed=seed)[0]]
        obs += [env.step(np.zeros(4))[0] for _ in range(200)]
        return np.stack(obs)

    with ThreadPoolExecutor(4) as pool:
        for seed, obs in enumerate(pool.map(fly, range(8))):
            assert (obs == fly(seed)).all()


@pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="reads the memory of the process from /proc")
def test_memory_does_not_grow():
    def resident():
        return int(Path("/proc/self/statm").read_text().split()[1]) * 4096

    def steps(count):
        env = mdg.HoverAviary(engine="hybrid")
        env.reset(seed=1)
        for _ in range(count):
            _, _, terminated, truncated, _ = env.step(np.zeros(4))
            if terminated or truncated:
                env.reset()

    def environments(count):
        for _ in range(count):
            mdg.HoverAviary().reset(seed=1)

    for work, few, many in ((steps, 20_000, 1_000_000), (environments, 50, 1_000)):
        work(few)
        before = resident()
        work(many)
        growth = resident() - before
        print(f"{work.__name__}: {many:,}, growth {growth / 1e6:.1f} MB")
        assert growth < 4e6, work.__name__


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_actions_are_read_in_the_order_of_their_indices(dtype):
    actions = (0.01 * np.arange(8).reshape(2, 4)).astype(dtype)
    transposed = np.ascontiguousarray(actions.T).T
    strided = np.repeat(actions, 2, axis=1)[:, ::2]
    states = []
    for form in [actions, actions.reshape(-1), np.asfortranarray(actions), transposed, strided, actions.tolist()]:
        env = mdg.MultiHoverAviary()
        env.reset(seed=1)
        for _ in range(3):
            env.step(form)
        states.append(np.stack([env._getDroneStateVector(drone) for drone in range(2)]))
    for other in states[1:]:
        np.testing.assert_array_equal(other, states[0])
    assert not np.array_equal(states[0][0, 16:], states[0][1, 16:])
