//! Hover: closed forms, the paper's rewards and ends, and flights of the PID.
//!
//! "The paper" is *MuJoCo-Drones-Gym* (Tayal).

mod common;

use common::step_to_end;
use mujoco_drones_gym::drone::GRAVITY;
use mujoco_drones_gym::env::EndReason;
use mujoco_drones_gym::prelude::*;
use mujoco_drones_gym::state::attitude_from_rpy;
use mujoco_drones_gym::world::Integrator;
use nalgebra::Vector3;

/// Flies Hover with the paper's PID and returns all heights and the largest horizontal distance from the origin.
fn pid_flight(env: &mut Aviary<Hover>) -> (Vec<f64>, f64) {
    let mut pid = ControllerPolicy::new(ControllerKind::Pid, env);
    let (mut heights, mut sideways) = (Vec::new(), 0.0_f64);
    let mut rollout = Rollout::start(env, &mut pid, Some(1)).unwrap();
    rollout
        .finish(|env| {
            let position = env.simulation().states()[0].position;
            heights.push(position.z);
            sideways = sideways.max(position.xy().norm());
        })
        .unwrap();
    (heights, sideways)
}

#[test]
fn pid_takes_off_and_holds_one_metre_on_every_airframe() {
    for model in DroneModel::PAPER {
        let mut env = Hover::builder().drone(model).build().unwrap();
        let (heights, sideways) = pid_flight(&mut env);
        assert_eq!(heights.len(), 480);
        let last = heights[479];
        assert!((last - 1.0).abs() < 0.02, "{model} ends at {last} m");
        assert!(heights.iter().all(|&z| z < 1.05), "{model} overshoots");
        assert!(sideways < 1e-3, "{model} drifts by {sideways} m");
        assert!(env.info().success && env.info().end == Some(EndReason::TimeLimit));
    }
}

#[test]
fn pid_recovers_from_tilt_and_rotation_at_any_yaw() {
    for yaw in [-2.5, -0.8, 0.0, 1.3, 3.0] {
        for model in DroneModel::PAPER {
            let params = model.params();
            let mut simulation = Simulation::builder(model).build().unwrap();
            let start = DroneState {
                velocity: Vector3::new(0.5, -0.5, 0.2),
                angular_velocity: Vector3::new(2.0, -2.0, 1.0),
                ..DroneState::at_rest(Vector3::new(0.2, -0.1, 2.0), Vector3::new(0.5, -0.4, yaw))
            };
            simulation.reset_to(&[start]).unwrap();
            let mut pid = PidControl::new(&params);
            let reference = Reference::hover(Vector3::new(0.0, 0.0, 2.0), yaw);
            let mut output = pid.control(1.0 / 48.0, &start, &reference);
            for _ in 0..48 * 15 {
                simulation.step(&[output.rpm]).unwrap();
                output = pid.control(1.0 / 48.0, &simulation.states()[0], &reference);
            }
            // the paper's gains discharge the integral slowly, which leaves a position error
            assert!(output.position_error.norm() < 0.1, "{model} at yaw {yaw}: {}", output.position_error);
            assert!(output.yaw_error.abs() < 0.01, "{model} at yaw {yaw}: {}", output.yaw_error);
        }
    }
}

#[test]
fn hover_speed_holds_the_position_of_every_airframe() {
    for (sim_freq, ctrl_freq) in [(240, 48), (100, 100), (333, 37), (1000, 10)] {
        for model in DroneModel::PAPER {
            let mut simulation = Simulation::builder(model)
                .initial_positions([[0.0, 0.0, 1.0]])
                .sim_freq(sim_freq)
                .ctrl_freq(ctrl_freq)
                .build()
                .unwrap();
            let hover = model.params().hover_rpm();
            for _ in 0..ctrl_freq {
                simulation.step(&[[hover; 4]]).unwrap();
                let offset = simulation.distance(0, &Vector3::new(0.0, 0.0, 1.0));
                assert!(offset < 1e-3, "{model} moved {offset} m");
            }
            assert!((simulation.time() - 1.0).abs() < 1e-12);
        }
    }
}

#[test]
fn the_reward_matches_the_papers_formula() {
    let reward_after = |start: DroneState, action: [f64; 4]| {
        let mut env = Hover::builder()
            .initial_positions([start.position.into()])
            .initial_rpys([start.rpy().into()])
            .build()
            .unwrap();
        env.reset(None).unwrap();
        let step = env.step(&action).unwrap();
        let (reward, terminated) = (step.reward, step.terminated);
        (reward, terminated, env.simulation().states()[0])
    };

    // at rest at the target: the bonus alone
    let (reward, _, _) = reward_after(DroneState::at_rest(Vector3::z(), Vector3::zeros()), [0.0; 4]);
    assert!((reward - 0.5).abs() < 1e-9, "{reward}");

    // free fall from (0.3, 0.4, 2) m: v = −g·t and z = 2 − g·t²/2 after one control step
    let (reward, _, _) = reward_after(DroneState::at_rest(Vector3::new(0.3, 0.4, 2.0), Vector3::zeros()), [-1.0; 4]);
    let t = 1.0 / 48.0;
    let by_hand = -(1.0 - 0.5 * GRAVITY * t * t) - 0.1 * 0.5 - 0.05 * GRAVITY * t;
    assert!((reward - by_hand).abs() < 1e-9, "{reward} {by_hand}");

    // free fall with a constant roll of 0.3 rad and pitch of −0.2 rad
    let tilted = DroneState::at_rest(Vector3::new(0.0, 0.0, 2.0), Vector3::new(0.3, -0.2, 1.0));
    let (reward, _, _) = reward_after(tilted, [-1.0; 4]);
    let by_hand = -(1.0 - 0.5 * GRAVITY * t * t) - 0.05 * GRAVITY * t - 0.05 * 0.5;
    assert!((reward - by_hand).abs() < 1e-9, "{reward} {by_hand}");

    // upside down: a crash with −100
    let inverted = DroneState::at_rest(Vector3::new(0.0, 0.0, 2.0), Vector3::new(3.0, 0.0, 0.0));
    let (reward, terminated, _) = reward_after(inverted, [-1.0; 4]);
    let by_hand = -(1.0 - 0.5 * GRAVITY * t * t) - 0.05 * GRAVITY * t - 0.05 * 3.0 - 100.0;
    assert!(terminated && (reward - by_hand).abs() < 1e-9, "{reward} {by_hand}");
}

/// Flies an episode with a constant action and returns the end, the last reward and `terminated`.
fn end_of(env: &mut Aviary<Hover>, action: [f64; 4]) -> (EndReason, f64, bool) {
    env.reset(None).unwrap();
    loop {
        let step = env.step(&action).unwrap();
        if step.terminated || step.truncated {
            let (reward, terminated) = (step.reward, step.terminated);
            return (env.info().end.unwrap(), reward, terminated);
        }
    }
}

#[test]
fn episodes_end_by_the_papers_conditions() {
    // motors off: the drone starts clear of the floor, falls 0.1 m and touches it
    let mut env = Hover::builder().build().unwrap();
    let (end, reward, terminated) = end_of(&mut env, [-1.0; 4]);
    assert!(end == EndReason::FloorContact && terminated && reward < -100.0);
    assert!(env.info().crashed() && env.info().contacts > 0 && !env.info().success);

    // a drone that starts on the floor does not crash, for any rate and integrator
    for (sim_freq, ctrl_freq) in [(240, 48), (240, 240), (1000, 1000), (100, 50)] {
        for integrator in [Integrator::Rk4, Integrator::Euler, Integrator::Implicit] {
            for height in [0.015, 0.0151, 0.02] {
                let mut env = Hover::builder()
                    .initial_positions([[0.0, 0.0, height]])
                    .sim_freq(sim_freq)
                    .ctrl_freq(ctrl_freq)
                    .integrator(integrator)
                    .episode_seconds(0.5)
                    .build()
                    .unwrap();
                assert_eq!(end_of(&mut env, [-1.0; 4]).0, EndReason::TimeLimit, "{sim_freq} {integrator:?} {height}");
            }
        }
    }

    // full thrust: the drone exceeds the maximum height, which ends the episode without a crash
    let mut env = Hover::builder().build().unwrap();
    let (end, reward, terminated) = end_of(&mut env, [1.0; 4]);
    assert!(end == EndReason::OutOfBounds && terminated && !env.info().crashed() && reward > -100.0);

    // two motors faster than the others: the drone rolls past 90°
    let mut env = Hover::builder().initial_positions([[0.0, 0.0, 2.0]]).build().unwrap();
    assert_eq!(end_of(&mut env, [0.1, 0.1, -0.1, -0.1]).0, EndReason::Tilt);

    // without the floor condition, the drone rests on the floor until the time limit
    let mut env =
        Hover::builder().task(|hover| hover.crash.floor_contact = false).episode_seconds(2.0).build().unwrap();
    let (end, _, terminated) = end_of(&mut env, [-1.0; 4]);
    assert!(end == EndReason::TimeLimit && !terminated);
    assert_eq!(env.simulation().control_steps(), 96);
}

#[test]
fn steps_outside_an_episode_and_invalid_actions_are_errors_that_change_nothing() {
    let mut env = Hover::builder().build().unwrap();
    assert!(matches!(env.step(&[0.0; 4]), Err(EnvError::NeedsReset { .. })));
    env.reset(Some(3)).unwrap();
    env.step(&[0.1; 4]).unwrap();
    let before = env.simulation().states()[0];
    assert_eq!(env.step(&[0.0; 3]).unwrap_err(), EnvError::ActionLength { got: 3, expected: 4 });
    for bad in [f64::NAN, f64::INFINITY, f64::NEG_INFINITY] {
        let text = env.step(&[0.0, 0.0, bad, 0.0]).unwrap_err().to_string();
        assert!(text.starts_with(&format!("action[2] is {bad} at t = 0.0208")), "{text}");
    }
    assert_eq!(env.simulation().states()[0], before);
    env.step(&[5.0; 4]).expect("actions out of range are clipped");
    assert_eq!(env.simulation().motor_speeds()[0], [DroneModel::Cf2x.params().max_rpm(); 4]);
    step_to_end(&mut env, &[-1.0; 4]);
    let text = env.step(&[0.0; 4]).unwrap_err().to_string();
    assert!(text.contains("after the end of the episode"), "{text}");
}

#[test]
fn invalid_options_are_errors_with_their_name() {
    let text = |result: Result<Aviary<Hover>, EnvError>| result.unwrap_err().to_string();
    assert!(text(Hover::builder().sim_freq(100).build()).contains("sim_freq is 100 Hz and ctrl_freq 48 Hz"));
    assert!(text(Hover::builder().ctrl_freq(0).build()).contains("ctrl_freq 0 Hz"));
    assert!(text(Hover::builder().episode_seconds(-1.0).build()).contains("-1 s"));
    assert!(text(Hover::builder().episode_seconds(f64::NAN).build()).contains("NaN s"));
    assert!(text(Hover::builder().num_drones(2).build()).contains("num_drones is 2, expected 1 in hover"));
    assert!(text(Hover::builder().task(|hover| hover.target_height = 4.0).build()).contains("target_height is 4 m"));
    let heavy = DroneParams { mass: f64::NAN, ..DroneModel::Race.params() };
    assert!(text(Hover::builder().drone(heavy).build()).contains("mass is NaN"));
    assert!(text(Hover::builder().initial_positions([[f64::NAN, 0.0, 1.0]]).build()).contains("position of drone 0"));
    assert!(text(Hover::builder().initial_positions([[0.0; 3]; 3]).build()).contains("3 entries"));
}

#[test]
fn one_motor_speed_for_all_four_rotors_moves_the_drone_vertically() {
    let mut env = Hover::builder().action_type(ActionType::OneDRpm).build().unwrap();
    assert_eq!(env.action_space().size(), 1);
    env.reset(None).unwrap();
    for _ in 0..48 {
        let height = env.simulation().states()[0].position.z;
        let velocity = env.simulation().states()[0].velocity.z;
        env.step(&[0.5 * (1.0 - height) - 0.4 * velocity]).unwrap();
    }
    let state = env.simulation().states()[0];
    assert!(state.position.z > 0.5 && state.position.xy().norm() < 1e-12);
    let rest = attitude_from_rpy(Vector3::zeros());
    assert!(state.attitude.angle_to(&rest) < 1e-9);
}
