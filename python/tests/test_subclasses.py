"""Tasks in Python: attributes of subclasses, time limits, copies, states and ends; attributes of other packages."""

import copy
import pickle

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.error import ResetNeeded

import mujoco_drones_gym as mdg
from mujoco_drones_gym import BaseAviary, ImageType


class Before(BaseAviary):
    """A subclass that sets its time limit before the constructor of its base."""

    def __init__(self, **options):
        self.EPISODE_LEN_SEC = 2
        super().__init__(**options)


class After(mdg.HoverAviary):
    """A subclass that sets its time limit after the constructor of its base."""

    def __init__(self, **options):
        super().__init__(**options)
        self.EPISODE_LEN_SEC = 0.5


class OfClass(BaseAviary):
    """A subclass with the time limit of its class."""

    EPISODE_LEN_SEC = 1.5


class Goal(BaseAviary):
    """A task with an attribute that its hooks read, also while the base builds the simulation."""

    def __init__(self, goal, **options):
        self.goal = goal
        super().__init__(**options)

    def _observationSpace(self):
        return gym.spaces.Box(-np.inf, np.inf, (1 + len(self.goal),), np.float32)

    def _computeObs(self):
        return np.array([self.pos[0, 2], *self.goal], np.float32)

    def _computeTerminated(self):
        return bool(self.pos[0, 2] > self.goal[0])

    def _computeTruncated(self):
        return self.time > 0.3


def length(env, action=None):
    """Flies until the end of the episode and returns its duration, s."""
    env.reset(seed=1)
    action = np.full(4, env.HOVER_RPM) if env.TASK == "base" else np.zeros(4)
    while True:
        _, _, terminated, truncated, info = env.step(action)
        if terminated or truncated:
            return info["time"]


def test_time_limits_of_subclasses():
    for env, expected in [(Before(), 2.0), (OfClass(), 1.5), (After(), 0.5), (Before(episode_seconds=0.25), 0.25)]:
        for own in (env, pickle.loads(pickle.dumps(env)), copy.deepcopy(env)):
            assert length(own) == pytest.approx(expected)
            assert pytest.approx(expected) == own.EPISODE_LEN_SEC


def test_time_limits_change_from_the_next_reset_on():
    env = mdg.HoverAviary(randomization={"body": {"mass": (0.8, 1.2)}})
    env.reset(seed=3)
    mass, start = env.M, env.pos
    env.step(np.zeros(4))
    env.EPISODE_LEN_SEC = 1
    np.testing.assert_allclose(length(env), 1.0)
    env.reset(seed=3)
    assert mass == env.M and (start == env.pos).all()
    for bad in (0, -1.0, np.inf, np.nan, "x", None, True, np.zeros((2, 2))):
        env.EPISODE_LEN_SEC = bad
        with pytest.raises(ValueError, match="EPISODE_LEN_SEC is") as error:
            env.reset(seed=3)
        assert "\n" not in str(error.value) and "expected a positive number of seconds" in str(error.value)


@pytest.mark.parametrize("duplicate", [copy.deepcopy, lambda env: pickle.loads(pickle.dumps(env))])
def test_copies_of_tasks_whose_hooks_read_their_own_attributes(duplicate):
    other = duplicate(Goal((0.2, 5.0)))
    assert other.goal == (0.2, 5.0) and other.observation_space.shape == (3,)
    np.testing.assert_allclose(other.reset(seed=1)[0], [0.1, 0.2, 5.0])


@pytest.mark.parametrize(("goal", "speed", "end"), [(0.15, 1.2, "completed"), (9.0, 1.0, "time_limit")])
def test_ends_of_tasks_in_python(goal, speed, end):
    env = Goal((goal,))
    env.reset(seed=1)
    over, middle = False, None
    while not over:
        assert "end" not in env._computeInfo()
        middle = middle or env.get_state()
        *_, terminated, truncated, info = env.step(np.full(4, speed * env.HOVER_RPM))
        over = terminated or truncated
    assert (info["end"], info["is_success"], terminated) == (end, False, end == "completed")
    state = pickle.loads(pickle.dumps(env.get_state()))
    env.reset(seed=2)
    env.set_state(state)
    with pytest.raises(ResetNeeded):
        env.step(np.zeros(4))
    env.set_state(middle)
    env.step(np.zeros(4))
    other = Goal((goal,))
    other.set_state(state)
    with pytest.raises(ResetNeeded):
        other.step(np.zeros(4))


class Endless(mdg.HoverAviary):
    """A task that never ends by itself."""

    def _computeTerminated(self):
        return False


def test_an_end_of_the_simulation_that_a_task_does_not_report_is_a_truncation():
    env = Endless(initial_xyzs=[[0, 0, 0.5]], episode_seconds=2.0)
    for action, end, crashed in [(-1.0, "floor_contact", True), (0.0, "time_limit", False)]:
        env.reset(seed=1)
        over = False
        while not over:
            *_, terminated, truncated, info = env.step(np.full(4, action))
            over = terminated or truncated
        assert (terminated, truncated, info["end"], info["crashed"]) == (False, True, end, crashed)
        with pytest.raises(ResetNeeded):
            env.step(np.zeros(4))


def test_success_of_tasks_in_python():
    class Success(Goal):
        def _computeInfo(self):
            return {"success": bool(self.pos[0, 2] > self.goal[0]), "height": self.pos[0, 2]}

    env = Success((0.15,))
    _, info = env.reset(seed=1)
    assert set(info) == {"success", "height"}
    for _ in range(100):
        *_, terminated, _, info = env.step(np.full(4, 1.2 * env.HOVER_RPM))
        assert set(info) == {"success", "height"} | ({"end", "is_success"} if terminated else set())
        if terminated:
            break
    assert info["is_success"] is True and info["end"] == "completed"


class Spaces(mdg.HoverAviary):
    """A subclass that replaces attributes of its base after the constructor."""

    def __init__(self):
        super().__init__()
        self.observation_space = gym.spaces.Box(-1.0, 1.0, (2,), np.float32)
        self.action_space = gym.spaces.Box(-2.0, 2.0, (4,), np.float32)
        self.metadata = {**self.metadata, "author": "me"}
        self.NEIGHBOURHOOD_RADIUS = 2.5

    def _computeObs(self):
        return super()._computeObs()[:2]


@pytest.mark.parametrize("duplicate", [copy.deepcopy, lambda env: pickle.loads(pickle.dumps(env))])
def test_a_copy_keeps_attributes_that_a_subclass_has_replaced(duplicate):
    env = Spaces()
    other = duplicate(env)
    assert (other.observation_space, other.action_space) == (env.observation_space, env.action_space)
    assert other.metadata == env.metadata and other.metadata["author"] == "me"
    assert other.NEIGHBOURHOOD_RADIUS == 2.5
    assert other.reset(seed=1)[0].shape == (2,)


class Drawing(mdg.HoverAviary):
    """A task with random rewards."""

    def _computeReward(self):
        return self.np_random.random()


class DrawingInStep(mdg.HoverAviary):
    """A task that draws its rewards in a function of its own."""

    def step(self, action):
        obs, _, *rest = super().step(action)
        return obs, self.np_random.random(), *rest


@pytest.mark.parametrize("task", [Drawing, DrawingInStep])
def test_a_state_has_the_random_numbers_of_a_task(task):
    env, other = task(), task()
    env.reset(seed=1)
    env.step(np.zeros(4))
    state = env.get_state()
    rewards = [env.step(np.zeros(4))[1] for _ in range(3)]
    env.set_state(state)
    assert [env.step(np.zeros(4))[1] for _ in range(3)] == rewards
    other.set_state(pickle.loads(pickle.dumps(state)))
    assert [other.step(np.zeros(4))[1] for _ in range(3)] == rewards


@pytest.mark.parametrize("task", [mdg.HoverAviary, Drawing])
def test_a_new_environment_has_no_state(task):
    with pytest.raises(ResetNeeded, match="get_state was called before the first reset"):
        task().get_state()


def test_a_restored_task_is_that_of_copies():
    env = mdg.HoverAviary()
    env.reset(seed=1)
    before = env.get_state()
    env.TARGET_HEIGHT = 2.0
    after = env.get_state()
    for state, height in [(before, 1.0), (after, 2.0), (before, 1.0)]:
        env.set_state(state)
        assert height == env.TARGET_HEIGHT == copy.deepcopy(env).TARGET_HEIGHT
    env.set_state(after)
    env.INIT_XYZS = np.array([[0.0, 0.0, 0.5]])
    env.reset(seed=1)
    assert env.TARGET_HEIGHT == 2.0


def test_attributes_of_airframes(tmp_path):
    env = BaseAviary(num_drones=2, output_folder=tmp_path)
    env.reset(seed=1)
    params = env.drone_params(0)
    assert pytest.approx(4 * env.KF * env.MAX_RPM**2) == env.MAX_THRUST
    assert pytest.approx(env.THRUST2WEIGHT_RATIO * env.GRAVITY) == env.MAX_THRUST
    assert params["propeller_radius"] == env.PROP_RADIUS
    assert params["ground_effect_coefficient"] == env.GND_EFF_COEFF
    assert env.DRAG_COEFF.tolist() == params["drag_coefficients"]
    assert pytest.approx(30.0) == env.MAX_SPEED_KMH
    assert env.OUTPUT_FOLDER == str(tmp_path) and BaseAviary().OUTPUT_FOLDER is None
    assert (env.KF, env.KM, env.L) == tuple(
        params[name] for name in ("thrust_coefficient", "torque_coefficient", "arm_length")
    )
    assert env.J.diagonal().tolist() == params["inertia"]
    assert env.time == 0.0
    env.step(np.full(8, env.HOVER_RPM))
    assert env.time == pytest.approx(1 / 48)


def test_images_of_one_drone():
    env = BaseAviary(num_drones=2, vision_attributes=True)
    env.reset(seed=1)
    for drone in range(2):
        rgb, depth, segmentation = env._getDroneImages(drone)
        assert (rgb.shape, depth.shape, segmentation.shape) == ((48, 64, 4), (48, 64), (48, 64))
        np.testing.assert_array_equal(rgb, env.rgb[drone])
        np.testing.assert_array_equal(depth, env.dep[drone])
        np.testing.assert_array_equal(segmentation, env.seg[drone])
    assert BaseAviary()._getDroneImages(0)[0].any()


def test_image_types_by_any_name():
    assert [member.value for member in ImageType] == ["rgb", "dep", "seg"]
    assert (ImageType("depth"), ImageType("segmentation")) == (ImageType.DEP, ImageType.SEG)
    for wrong in ("kin", 3, None):
        with pytest.raises(ValueError):
            ImageType(wrong)


def test_parameters_and_states_of_agents():
    env = mdg.MultiAgentAviary(3, randomization={"body": {"mass": (0.5, 0.9)}, "environment": {"gravity": (0.8, 0.9)}})
    masses = set()
    for seed in range(3):
        env.reset(seed=seed)
        masses.add(env.M)
        assert env.drone_params(0)["mass"] == env.M < 0.9 * 0.027 + 1e-12 and 0.8 * 9.8 < env.G < 0.9 * 9.82
    assert len(masses) == 3
    action = np.full(4, 0.1)
    for _ in range(5):
        env.step(dict.fromkeys(env.agents, action))
    single = mdg.MultiHoverAviary(num_drones=3)
    parts = np.hstack([env.pos, env.rpy, env.vel, env.ang_v])
    np.testing.assert_allclose(parts.reshape(-1), env.state(), rtol=1e-6, atol=1e-7)
    assert env.quat.shape == (3, 4) and env.last_clipped_action.shape == single.last_clipped_action.shape
    for drone in range(3):
        state = env._getDroneStateVector(drone)
        assert state.shape == (20,) and (state[:3] == env.pos[drone]).all()
        np.testing.assert_allclose(state[16:], env.last_clipped_action[drone])


def test_a_controller_flies_every_agent():
    env = mdg.MultiAgentAviary(2, act_type="raw_rpm")
    env.reset(seed=1)
    controllers = [mdg.PIDControl(env) for _ in range(2)]
    targets = [np.array([0.0, 0.0, 0.7]), np.array([1.0, 0.0, 1.2])]
    for _ in range(8 * 48):
        actions = {
            agent: controllers[i].computeControlFromState(env.CTRL_TIMESTEP, env._getDroneStateVector(i), targets[i])[0]
            for i, agent in enumerate(env.agents)
        }
        env.step(actions)
    assert np.abs(env.pos - targets).max() < 0.1


def test_attributes_of_batches_of_stable_baselines3():
    pytest.importorskip("stable_baselines3")
    from mujoco_drones_gym.sb3 import SB3VecEnv

    env = SB3VecEnv("hover", 3)
    assert env.get_attr("TARGET_HEIGHT") == [1.0, 1.0, 1.0]
    env.set_attr("TARGET_HEIGHT", 0.5, indices=[1])
    assert env.get_attr("TARGET_HEIGHT") == [1.0, 0.5, 1.0] and env.get_attr("TARGET_HEIGHT", 1) == [0.5]
    env.seed(np.array(3))
    env.reset()
    assert [info["time"] for info in env.env_method("info")] == [0.0, 0.0, 0.0]
    assert env.env_method("_getDroneStateVector", 0, indices=2)[0].shape == (20,)
    for bad in (-1, "x", 2.5):
        with pytest.raises(ValueError, match="seed is"):
            env.seed(bad)
