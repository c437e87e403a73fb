"""The environment without a task, and tasks in Python."""

import numpy as np
import pytest
from gymnasium.error import ResetNeeded
from gymnasium.utils.env_checker import check_env

import mujoco_drones_gym as mdg
from mujoco_drones_gym import BaseAviary


def test_attributes():
    env = BaseAviary(num_drones=2, initial_xyzs=[[0, 0, 1], [1, 0, 2]], initial_rpys=[[0, 0, 0.1], [0, 0, 0.2]])
    assert (env.NUM_DRONES, env.SIM_FREQ, env.CTRL_FREQ, env.CTRL_TIMESTEP) == (2, 240, 48, 1 / 48)
    assert env.M == 0.027 and env.G == 9.81
    assert pytest.approx(14_475.8, abs=0.1) == env.HOVER_RPM
    assert pytest.approx(env.HOVER_RPM * 2.25**0.5) == env.MAX_RPM
    assert env.INIT_XYZS.tolist() == [[0, 0, 1], [1, 0, 2]]
    env.reset(seed=1)
    for name, size in [("pos", 3), ("quat", 4), ("rpy", 3), ("vel", 3), ("ang_v", 3)]:
        value = getattr(env, name)
        assert value.shape == (2, size) and value.dtype == np.float64
    assert env.pos.tolist() == [[0, 0, 1], [1, 0, 2]]
    assert env.rpy[:, 2] == pytest.approx([0.1, 0.2])
    assert env.quat[0] == pytest.approx([np.cos(0.05), 0, 0, np.sin(0.05)])
    assert (env.SIM_TIMESTEP, env.SIM_STEPS_PER_CTRL, env.step_counter) == (1 / 240, 5, 0)
    env.step(np.arange(8.0))
    assert env.step_counter == 5 and env.last_clipped_action.tolist() == [[0, 1, 2, 3], [4, 5, 6, 7]]
    assert pytest.approx(0.027 * 9.81) == env.GRAVITY
    assert env.J.tolist() == np.diag([1.4e-5, 1.4e-5, 2.17e-5]).tolist()
    assert (env.KF, env.KM, env.L) == (3.16e-10, 7.94e-12, 0.0397)
    race = BaseAviary(drone_model="race", physics="mjc_drag", obs_type="kin", act_type=mdg.ActionType.ONE_D_RPM)
    assert (race.DRONE_MODEL, race.PHYSICS) == (mdg.DroneModel.RACE, mdg.Physics.MJC_DRAG)
    assert (race.OBS_TYPE, race.ACT_TYPE) == (mdg.ObservationType.KIN, mdg.ActionType.ONE_D_RPM)


def test_state_vectors():
    env = BaseAviary(num_drones=2)
    obs, _ = env.reset(seed=1)
    assert obs.shape == (40,) and obs[16:20].tolist() == [0] * 4
    rpm = np.array([15_000.1, 15_010.2, 15_020.3, 15_030.4, 14_000, 14_010, 14_020, 14_030])
    for _ in range(5):
        obs, reward, terminated, truncated, _ = env.step(rpm)
        assert (reward, terminated, truncated) == (0.0, False, False)
    for drone in range(2):
        state = env._getDroneStateVector(drone)
        assert state.shape == (20,) and state.dtype == np.float64
        parts = [env.pos, env.quat, env.rpy, env.vel, env.ang_v]
        assert (state[:16] == np.hstack([part[drone] for part in parts])).all()
        assert (state[16:] == rpm[4 * drone : 4 * drone + 4]).all()
        assert (obs[20 * drone : 20 * drone + 20] == state.astype(np.float32)).all()
    with pytest.raises(ValueError, match="drone 2 does not exist"):
        env._getDroneStateVector(2)
    # actions of the shape (N, 4) are those of the paper
    same = BaseAviary(num_drones=2)
    same.reset(seed=1)
    for _ in range(5):
        same.step(rpm.reshape(2, 4))
    assert (same._env.states() == env._env.states()).all()


def test_no_end_without_a_time_limit():
    env = BaseAviary(engine="hybrid")
    env.reset(seed=1)
    for _ in range(3000):
        _, _, terminated, truncated, info = env.step(np.zeros(4))
        assert not (terminated or truncated or info["success"] or info["crashed"])
    limited = BaseAviary(episode_seconds=1.0)
    limited.reset(seed=1)
    steps = 1
    while not limited.step(np.zeros(4))[3]:
        steps += 1
    assert steps == 48


def test_adjacency_and_normalized_speeds():
    env = BaseAviary(num_drones=3, initial_xyzs=[[0, 0, 1], [1, 0, 1], [3, 0, 1]], neighbourhood_radius=1.5)
    env.reset(seed=1)
    assert env._getAdjacencyMatrix().tolist() == [[1, 1, 0], [1, 1, 0], [0, 0, 1]]
    speeds = env._normalizedActionToRPM(np.array([[-1.0, 0.0, 1.0, 0.5]]))
    middle = (env.HOVER_RPM + env.MAX_RPM) / 2
    assert speeds.shape == (1, 4) and speeds[0] == pytest.approx([0, env.HOVER_RPM, env.MAX_RPM, middle])


def test_actions_of_motor_speeds():
    hover, base = mdg.HoverAviary(), BaseAviary()
    rpm = np.array([[15_000.0, 14_000.0, 14_500.0, 10_000.0]])
    action = hover.action_of_rpm(rpm)
    assert hover._normalizedActionToRPM(action) == pytest.approx(rpm[0])
    assert (base.action_of_rpm(rpm) == rpm[0]).all()
    with pytest.raises(ValueError, match="act_type is pid"):
        mdg.HoverAviary(act_type="pid").action_of_rpm(rpm)
    with pytest.raises(ValueError, match="expected 4"):
        base.action_of_rpm(rpm[0, :3])


def test_a_controller_hovers():
    env = BaseAviary()
    env.reset(seed=1)
    controller = mdg.PIDControl(env)
    for _ in range(10 * 48):
        rpm, _, _ = controller.computeControlFromState(
            env.CTRL_TIMESTEP, env._getDroneStateVector(0), np.array([0.0, 0.0, 1.0])
        )
        env.step(rpm)
    assert np.linalg.norm(env.pos[0] - [0, 0, 1]) < 0.05


class Climb(BaseAviary):
    """A task in Python: climb to 1.5 m with one normalized command for all motors."""

    def _preprocessAction(self, action):
        return self._normalizedActionToRPM(np.repeat(np.asarray(action, np.float64), 4))

    def _actionSpace(self):
        import gymnasium as gym

        return gym.spaces.Box(-1.0, 1.0, (1,), np.float32)

    def _observationSpace(self):
        import gymnasium as gym

        return gym.spaces.Box(-np.inf, np.inf, (2,), np.float32)

    def _computeObs(self):
        return self._getDroneStateVector(0)[[2, 12]].astype(np.float32)

    def _computeReward(self):
        return -abs(self.pos[0, 2] - 1.5)

    def _computeTerminated(self):
        return self.pos[0, 2] > 1.5

    def _computeInfo(self):
        return {"height": self.pos[0, 2]}


@pytest.mark.filterwarnings("ignore::UserWarning")
def test_tasks_in_python():
    env = Climb(episode_seconds=5.0)
    obs, info = env.reset(seed=1)
    assert obs.tolist() == pytest.approx([0.1, 0.0]) and info == {"height": 0.1}
    terminated = truncated = False
    while not (terminated or truncated):
        obs, reward, terminated, truncated, info = env.step([0.5])
        assert reward == -abs(info["height"] - 1.5)
    assert terminated and not truncated and info["height"] > 1.5
    with pytest.raises(ResetNeeded):
        env.step([0.5])
    env.reset()
    while not truncated:
        truncated = env.step([-1.0])[3]
    check_env(Climb(), skip_render_check=True)
