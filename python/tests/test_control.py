"""Controllers: closed forms, frames, integral terms, errors."""

import copy
import math
import pickle

import numpy as np
import pytest

from mujoco_drones_gym import _native
from mujoco_drones_gym.control import DSLPIDControl, GeometricControl, PIDControl
from mujoco_drones_gym.control.dsl_pid_control import DSLPIDControl as SameDsl
from mujoco_drones_gym.control.pid_control import PIDControl as SamePid

ALL = [PIDControl, DSLPIDControl, GeometricControl]
DT = 1 / 48
UPRIGHT = np.array([1.0, 0.0, 0.0, 0.0])
ZERO = np.zeros(3)
HERE = (ZERO, UPRIGHT, ZERO, ZERO)


def quaternion(roll=0.0, pitch=0.0, yaw=0.0):
    return _native.quaternion_of_rpy(np.array([roll, pitch, yaw]))


def rotation(quat):
    w, x, y, z = quat
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def wrench(control, rpm, plus=False):
    """Thrust and torque about the body axes, from the paper's allocation matrix."""
    f = control.KF * rpm**2
    arm = control.L if plus else control.L / math.sqrt(2.0)
    torque = (
        [arm * (f[1] - f[3]), arm * (f[2] - f[0])]
        if plus
        else [arm * (f[0] + f[1] - f[2] - f[3]), arm * (-f[0] + f[1] + f[2] - f[3])]
    )
    return f.sum(), np.array([*torque, control.KM / control.KF * (-f[0] + f[1] - f[2] + f[3])])


def test_the_modules_of_the_paper_have_the_classes():
    assert SamePid is PIDControl and SameDsl is DSLPIDControl


@pytest.mark.parametrize("kind", ALL)
@pytest.mark.parametrize("model", ["cf2x", "cf2p", "race"])
def test_no_error_gives_hover_speed(kind, model):
    control = kind(drone_model=model)
    expected = math.sqrt(control.MASS * 9.81 / (4 * control.KF))
    assert control.HOVER_RPM == pytest.approx(expected, rel=1e-12)
    for yaw in (0.0, 1.2, -3.0):
        control.reset()
        rpm, pos_e, yaw_e = control.computeControl(
            DT, [1, 2, 3], quaternion(yaw=yaw), ZERO, ZERO, [1, 2, 3], [0, 0, yaw]
        )
        assert rpm == pytest.approx(np.full(4, expected), rel=1e-9)
        assert rpm.shape == (4,) and pos_e == pytest.approx(ZERO) and yaw_e == pytest.approx(0.0, abs=1e-12)


def test_the_airframes_are_those_of_the_paper():
    crazyflie, racer = PIDControl(), PIDControl("race")
    assert (crazyflie.MASS, crazyflie.L, crazyflie.KF, crazyflie.KM) == (0.027, 0.0397, 3.16e-10, 7.94e-12)
    assert crazyflie.MAX_RPM == pytest.approx(1.5 * crazyflie.HOVER_RPM)
    assert (racer.MASS, racer.L) == (0.25, 0.125) and racer.MAX_RPM == pytest.approx(2 * racer.HOVER_RPM)
    assert np.diag(crazyflie.J) == pytest.approx([1.4e-5, 1.4e-5, 2.17e-5])


def test_results_are_the_errors_of_target_and_state():
    for kind in ALL:
        rpm, pos_e, yaw_e = kind().compute_control(
            control_timestep=DT,
            cur_pos=np.array([0.1, 0.2, 0.3]),
            cur_quat=quaternion(yaw=3.0),
            cur_vel=ZERO,
            cur_ang_vel=ZERO,
            target_pos=np.array([1.0, 1.0, 1.0]),
            target_rpy=np.array([0.5, 0.6, -3.0]),
        )
        assert pos_e == pytest.approx([0.9, 0.8, 0.7])
        assert yaw_e == pytest.approx(2 * math.pi - 6.0), "the short way round"
        assert isinstance(yaw_e, float) and np.all((rpm >= 0) & (rpm <= 22000))


@pytest.mark.parametrize("kind", ALL)
def test_symmetric_targets_give_mirrored_motor_speeds(kind):
    def rpm(target, **more):
        return kind().computeControl(DT, *HERE, target, **more)[0]

    left, right = rpm([0, 0.1, 0]), rpm([0, -0.1, 0])
    # y points to the left: motors 0 and 1 are on the left
    assert left == pytest.approx(right[[3, 2, 1, 0]], rel=1e-9) and left[2] > left[0]
    forward, back = rpm([0.1, 0, 0]), rpm([-0.1, 0, 0])
    assert forward == pytest.approx(back[[1, 0, 3, 2]], rel=1e-9) and forward[1] > forward[0]
    higher = rpm([0, 0, 0.05])
    assert np.ptp(higher) < 1e-6 and higher[0] > kind().HOVER_RPM
    slower = rpm([0, 0, 0], target_vel=[0, 0, -0.05])
    assert np.ptp(slower) < 1e-6 and slower[0] < kind().HOVER_RPM


def test_thrust_of_the_pid_is_the_papers_law():
    control = PIDControl()
    rpm, *_ = control.computeControl(DT, *HERE, [0.0, 0.0, 0.3], target_vel=[0, 0, 0.1])
    acceleration = 1.0 * 0.3 + 0.01 * 0.3 * DT + 2.0 * 0.1 + 9.81
    assert wrench(control, rpm)[0] == pytest.approx(0.027 * acceleration, rel=1e-9)


def test_feed_forward_of_acceleration_is_exact_along_z():
    for kind in (DSLPIDControl, GeometricControl):
        control = kind()
        rpm, *_ = control.computeControl(DT, *HERE, ZERO, target_acc=[0, 0, 1.5])
        assert wrench(control, rpm)[0] == pytest.approx(0.027 * (9.81 + 1.5), rel=1e-9)
    with pytest.raises(TypeError, match="target_acc"):
        PIDControl().computeControl(DT, *HERE, ZERO, target_acc=[0, 0, 1.5])


@pytest.mark.parametrize("kind", ALL)
@pytest.mark.parametrize("yaw", [0.7, -2.4])
def test_commands_turn_with_the_world(kind, yaw):
    """The same situation, turned about the vertical, has the same motor speeds."""
    turn = rotation(quaternion(yaw=yaw))
    pos, vel, target = np.array([0.1, -0.2, 1.0]), np.array([0.2, 0.1, -0.1]), np.array([0.3, 0.1, 1.1])
    rates = np.array([0.3, -0.2, 0.4])
    plain = kind().computeControl(DT, pos, quaternion(0.1, -0.2, 0.3), vel, rates, target, [0, 0, 0.5])
    turned = kind().computeControl(
        DT, turn @ pos, quaternion(0.1, -0.2, 0.3 + yaw), turn @ vel, rates, turn @ target, [0, 0, 0.5 + yaw]
    )
    assert turned[0] == pytest.approx(plain[0], rel=1e-9)
    assert turned[1] == pytest.approx(turn @ plain[1]) and turned[2] == pytest.approx(plain[2])


@pytest.mark.parametrize("kind", ALL)
def test_angular_velocity_is_in_the_body_frame(kind):
    """A drone that lies on its side and turns about its own z axis gets a torque against it about its own z axis."""
    attitude = quaternion(roll=1.3, pitch=0.4, yaw=2.0)
    control = kind("cf2x")

    def torque(rates):
        control.reset()
        return wrench(control, control.computeControl(DT, ZERO, attitude, ZERO, rates, ZERO, [0, 0, 2.0])[0])[1]

    still = torque(ZERO)
    for axis in range(3):
        rates = np.zeros(3)
        rates[axis] = 0.05
        change = torque(rates) - still
        assert change[axis] < 0.0
        others = np.delete(change, axis)
        assert np.all(np.abs(others) < 0.35 * abs(change[axis])), (axis, change)


@pytest.mark.parametrize("kind", ALL)
def test_tumbling_drones_get_finite_speeds_within_limits(kind):
    rng = np.random.default_rng(0)
    control = kind("race")
    for _ in range(200):
        quat = rng.normal(size=4)
        rpm, pos_e, yaw_e = control.computeControl(
            DT, rng.normal(size=3) * 5, quat / np.linalg.norm(quat), rng.normal(size=3) * 5, rng.normal(size=3) * 20,
            rng.normal(size=3) * 5, rng.normal(size=3) * 3, rng.normal(size=3),
        )  # fmt: skip
        assert np.all((rpm >= 0) & (rpm <= control.MAX_RPM + 1e-9)) and np.isfinite(pos_e).all()
        assert -math.pi <= yaw_e <= math.pi


def test_state_of_twenty_numbers_gives_the_same_result():
    state = np.arange(20.0) / 10
    state[3:7] = quaternion(0.1, 0.2, 2.5)
    for kind in ALL:
        by_state = kind().computeControlFromState(DT, state, [1, 1, 1], [0, 0, 1], [0.1, 0, 0])
        by_parts = kind().computeControl(
            DT, state[0:3], state[3:7], state[10:13], state[13:16], [1, 1, 1], [0, 0, 1], [0.1, 0, 0]
        )
        named = kind().compute_control_from_state(
            control_timestep=DT, state=state, target_pos=[1, 1, 1], target_rpy=[0, 0, 1], target_vel=[0.1, 0, 0]
        )
        for other in (by_parts, named):
            assert np.array_equal(by_state[0], other[0]) and by_state[2] == other[2]


def test_integral_of_the_position_error_is_readable_and_writable():
    control = PIDControl()
    control.computeControl(DT, *HERE, [1.0, -2.0, 3.0])
    assert control.integral_pos_e == pytest.approx(np.array([1.0, -2.0, 3.0]) * DT)
    control.computeControl(DT, *HERE, [1.0, -2.0, 3.0])
    assert control.integral_pos_e == pytest.approx(np.array([1.0, -2.0, 3.0]) * 2 * DT)
    other = PIDControl()
    other.integral_pos_e = control.integral_pos_e
    other.integral_rpy_e = control.integral_rpy_e
    assert np.array_equal(other.computeControl(DT, *HERE, ZERO)[0], control.computeControl(DT, *HERE, ZERO)[0])
    # a change in place counts, too
    control.integral_pos_e[:] = [5.0, 0.0, -5.0]
    control.computeControl(DT, *HERE, ZERO)
    assert control.integral_pos_e == pytest.approx([2.0, 0.0, -2.0]), "clamped"
    control.reset()
    assert not control.integral_pos_e.any() and not control.integral_rpy_e.any()


def test_integral_of_the_attitude_error_is_readable_and_writable():
    control = PIDControl()
    control.computeControl(DT, ZERO, quaternion(yaw=-0.2), ZERO, ZERO, ZERO)
    assert control.integral_rpy_e == pytest.approx([0, 0, 0.2 * DT])
    control.integral_rpy_e = [0, 0, 0.4]
    rpm, *_ = control.computeControl(DT, *HERE, ZERO)
    assert wrench(control, rpm)[1] == pytest.approx([0, 0, 1e-4 * 0.4], abs=1e-12)


def test_dsl_clamps_half_as_much_and_moves_its_setpoint_slowly():
    control = DSLPIDControl()
    assert (control.INTEGRAL_POS_LIMIT, control.INTEGRAL_RPY_LIMIT) == (1.0, 0.25)
    near = control.computeControl(DT, *HERE, [2.0 * DT, 0, 0])[0]
    far = DSLPIDControl().computeControl(DT, *HERE, [50.0, 0, 0])[0]
    assert far == pytest.approx(near, rel=1e-12), "2 m/s"


def test_geometric_control_integrates_with_the_option():
    error = [0.05, 0.0, 0.0]
    plain, integrating = GeometricControl(), GeometricControl(integral=0.1)
    for control in (plain, integrating):
        for _ in range(5):
            control.computeControl(DT, *HERE, error)
    assert not plain.integral_pos_e.any()
    assert integrating.integral_pos_e == pytest.approx([0.1 * 5.0**3 * 0.05 * 5 * DT, 0, 0])
    assert GeometricControl(tilt=5.0).computeControl(DT, *HERE, error)[0] != pytest.approx(
        plain.computeControl(DT, *HERE, error)[0]
    )


def test_gains_are_readable_and_writable():
    control = PIDControl()
    assert control.P_COEFF_FOR == pytest.approx([0.4, 0.4, 1.0])
    assert control.D_COEFF_TOR == pytest.approx([5e-4, 5e-4, 2e-4])
    control.P_COEFF_FOR = [1.0, 1.0, 4.0]
    rpm, *_ = control.computeControl(DT, *HERE, [0, 0, 0.2])
    assert wrench(control, rpm)[0] == pytest.approx(0.027 * (9.81 + 0.8 + 0.01 * 0.2 * DT), rel=1e-9)
    with pytest.raises(ValueError, match="read-only"):
        control.P_COEFF_FOR[0] = 3.0
    with pytest.raises(ValueError, match=r"P_COEFF_FOR is \[.*expected three finite numbers"):
        control.P_COEFF_FOR = [math.nan, 0, 0]
    control.setPIDCoefficients(p_coeff_att=[1e-3] * 3)
    assert control.P_COEFF_TOR == pytest.approx([1e-3] * 3) and control.P_COEFF_FOR[2] == 4.0


@pytest.mark.parametrize("kind", [PIDControl, DSLPIDControl])
@pytest.mark.parametrize(
    "gain", ["P_COEFF_FOR", "I_COEFF_FOR", "D_COEFF_FOR", "P_COEFF_TOR", "I_COEFF_TOR", "D_COEFF_TOR"]
)
def test_outputs_are_finite_with_all_gains_that_are_possible(kind, gain):
    for value in (1e308, 1.1e9, -math.inf, math.nan):
        control = kind()
        with pytest.raises(ValueError, match=rf"^{gain} is \[.*\], expected three finite numbers from -1e9 to 1e9$"):
            setattr(control, gain, [1.0, value, 1.0])
    for value in (1e9, -1e9):
        control = kind()
        for name in ("P_COEFF_FOR", "I_COEFF_FOR", "D_COEFF_FOR", "P_COEFF_TOR", "I_COEFF_TOR", "D_COEFF_TOR"):
            setattr(control, name, [-value] * 3)
        setattr(control, gain, [value] * 3)
        control.INTEGRAL_POS_LIMIT = control.INTEGRAL_RPY_LIMIT = 1e9
        state = [1e9, -1e9, 1e9], [0.6, 0.0, -0.8, 0.0], [-1e9] * 3, [1e9] * 3
        for target in ([-1e9] * 3, [1e9, 1e9, -1e9]) * 3:
            rpm, error, yaw = control.computeControl(DT, *state, target, [0, 0, 1e9], [1e9] * 3)
            assert np.isfinite([*rpm, *error, yaw, *control.integral_pos_e, *control.integral_rpy_e]).all()
            assert (rpm >= 0).all() and (rpm <= control.MAX_RPM * (1 + 1e-9)).all()


@pytest.mark.parametrize("name", ["integral_pos_e", "integral_rpy_e"])
def test_integrals_beyond_the_numbers_of_a_control_law_are_errors(name):
    control = PIDControl()
    setattr(control, name, np.array([0.0, 1e300, 0.0]))
    with pytest.raises(ValueError, match=rf"{name}\[1\] is 1e\+300, expected a number from -1e\+09 to 1e\+09"):
        control.computeControl(DT, *HERE, [0, 0, 1])


@pytest.mark.parametrize("kind", ALL)
def test_controllers_can_be_pickled_and_copied(kind):
    control = kind("cf2p")
    control.computeControl(DT, *HERE, [0.1, 0.1, 0.1])
    for clone in (pickle.loads(pickle.dumps(control)), copy.deepcopy(control)):
        again = copy.deepcopy(control).computeControl(DT, *HERE, [0.1, 0.2, 0.1])
        assert np.array_equal(clone.computeControl(DT, *HERE, [0.1, 0.2, 0.1])[0], again[0])
        assert np.array_equal(clone.integral_pos_e, clone._native.integrals()[0])


def test_quaternions_are_normalized():
    state = np.zeros(20, dtype=np.float32)
    state[3:7] = quaternion(0.3, 0.2, 1.0)
    exact = PIDControl().computeControl(DT, ZERO, quaternion(0.3, 0.2, 1.0), ZERO, ZERO, [0, 0, 1])[0]
    assert PIDControl().computeControlFromState(DT, state, [0, 0, 1])[0] == pytest.approx(exact, rel=1e-5)
    double = PIDControl().computeControl(DT, ZERO, 2 * quaternion(0.3, 0.2, 1.0), ZERO, ZERO, [0, 0, 1])[0]
    assert double == pytest.approx(exact, rel=1e-9)


@pytest.mark.parametrize("kind", ALL)
@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        ({"control_timestep": 0.0}, "control_timestep is 0, expected 1e-6 to 10 s"),
        ({"control_timestep": math.nan}, "control_timestep is NaN"),
        ({"control_timestep": None}, "control_timestep is None, expected 1e-6 to 10 s"),
        ({"control_timestep": "a"}, "control_timestep is 'a', expected 1e-6 to 10 s"),
        ({"control_timestep": -1}, "control_timestep is -1, expected 1e-6 to 10 s"),
        ({"target_pos": [0, 0, 1e300]}, "target_pos[2] is 1e+300, expected a number from -1e+09 to 1e+09"),
        ({"cur_ang_vel": [0, -1e155, 0]}, "cur_ang_vel[1] is -1e+155, expected a number"),
        ({"target_rpy": [0, 0, 1e300]}, "target_rpy[2] is 1e+300, expected a number"),
        ({"cur_pos": [0, 0]}, "cur_pos has the shape (2,), expected (3,)"),
        ({"cur_quat": [0, 0, 0]}, "cur_quat has the shape (3,), expected (4,)"),
        ({"cur_quat": [0, 0, 0, 0]}, "cur_quat has the length 0, expected a quaternion (w, x, y, z)"),
        ({"cur_vel": [0, math.inf, 0]}, "cur_vel[1] is inf, expected a finite number"),
        ({"cur_ang_vel": "abc"}, "cur_ang_vel is 'abc', expected 3 numbers"),
        ({"target_pos": [0, 0, math.nan]}, "target_pos[2] is NaN"),
        ({"target_rpy": [0, 0, math.nan]}, "target_rpy[2] is NaN"),
        ({"target_vel": [0]}, "target_vel has the shape (1,)"),
    ],
)
def test_errors_name_the_argument_and_change_nothing(kind, arguments, text):
    control = kind()
    control.computeControl(DT, *HERE, [0.1, 0.1, 0.1])
    before = control.integral_pos_e.copy()
    good = {
        "control_timestep": DT, "cur_pos": ZERO, "cur_quat": UPRIGHT, "cur_vel": ZERO, "cur_ang_vel": ZERO,
        "target_pos": ZERO,
    }  # fmt: skip
    with pytest.raises(ValueError) as error:
        control.computeControl(**{**good, **arguments})
    assert str(error.value).startswith(text) and "\n" not in str(error.value)
    assert np.array_equal(control.integral_pos_e, before)


@pytest.mark.parametrize("kind", ALL)
def test_the_largest_arguments_give_finite_speeds(kind):
    good = {"cur_pos": ZERO, "cur_quat": UPRIGHT, "cur_vel": ZERO, "cur_ang_vel": ZERO, "target_pos": ZERO}
    for name in ("cur_pos", "cur_vel", "cur_ang_vel", "target_pos", "target_vel", "target_rpy", "target_rpy_rates"):
        for sign in (-1, 1):
            control = kind()
            for large in ([1e9] * 3, [0, 0, 1e9], [1e9, 0, 0]):
                arguments = {**good, name: sign * np.array(large)}
                rpm, *_ = control.computeControl(DT, **arguments)
                assert np.all((rpm >= 0) & (rpm <= control.MAX_RPM + 1e-9)), (name, sign, large)
    with pytest.raises(ValueError, match="an integral limit is 'a', expected a number"):
        PIDControl().INTEGRAL_POS_LIMIT = "a"


def test_errors_of_the_constructor():
    with pytest.raises(ValueError, match="drone_model: no drone model `cf3`, expected cf2x, cf2p, race or cf21"):
        PIDControl("cf3")
    with pytest.raises(TypeError, match="env is object, expected an environment, a drone model or None"):
        PIDControl(object())
    with pytest.raises(TypeError, match="env and drone_model"):
        PIDControl("cf2x", drone_model="race")
    with pytest.raises(TypeError, match="gains"):
        PIDControl(gains=3)
    with pytest.raises(ValueError, match="tilt is -1, expected a positive frequency"):
        GeometricControl(tilt=-1.0)
    with pytest.raises(ValueError, match="integral is 2, expected 0 to 1"):
        GeometricControl(integral=2.0)
    with pytest.raises(ValueError, match="drone_model: mass is -1"):
        PIDControl({**_native.airframe_constants("cf2x")[0], "mass": -1.0})


@pytest.mark.parametrize("kind", ALL)
def test_controllers_know_the_airframe_of_an_environment(kind):
    from mujoco_drones_gym.envs.base_aviary import BaseAviary
    from mujoco_drones_gym.utils.enums import DroneModel

    racer = kind(DroneModel.RACE)
    assert (racer.MASS, racer.HOVER_RPM) == (0.25, kind("race").HOVER_RPM)
    env = BaseAviary(drone_model="race")
    assert kind(env).MASS == 0.25 and env.HOVER_RPM == kind(env).HOVER_RPM
    state = np.zeros(20)
    state[3] = 1.0
    arguments = (DT, state, [0.1, 0.2, 0.3])
    assert np.array_equal(
        kind(env).computeControlFromState(*arguments)[0], racer.computeControlFromState(*arguments)[0]
    )
    heavier = BaseAviary(randomization={"body": {"mass": (1.1, 1.1)}})
    heavier.reset(seed=0)
    assert kind(heavier).MASS == pytest.approx(1.1 * 0.027)


def test_controllers_know_the_airframe_of_agents():
    pytest.importorskip("pettingzoo")
    from mujoco_drones_gym.envs.multi_agent_aviary import MultiAgentAviary

    assert PIDControl(MultiAgentAviary(num_drones=2, drone_model="race")).MASS == 0.25
    assert PIDControl(MultiAgentAviary(num_drones=2)).MASS == 0.027


@pytest.mark.parametrize("kind", ALL)
def test_controllers_hold_a_position_in_flight(kind):
    import gymnasium as gym

    from mujoco_drones_gym.envs.base_aviary import BaseAviary

    env = gym.wrappers.TimeLimit(BaseAviary(initial_xyzs=[[0, 0, 0.1]], initial_rpys=[[0.2, -0.1, 2.0]]), 600)
    state, _ = env.reset(seed=0)
    control, target = kind(env), np.array([0.3, -0.2, 1.0])
    for _ in range(600):
        rpm, pos_e, yaw_e = control.computeControlFromState(DT, state, target, [0, 0, -2.5])
        state, *_ = env.step(rpm)
    assert np.linalg.norm(pos_e) < (0.05 if kind is PIDControl else 0.005), pos_e
    assert abs(yaw_e) < 0.02
