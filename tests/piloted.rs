//! Drones flown by the sticks of a person, and rewound policies.

mod common;

use common::airframe_with_duty;
use mujoco_drones_gym::action::ActionLimits;
use mujoco_drones_gym::control::CollisionCone;
use mujoco_drones_gym::control::trajectory::named;
use mujoco_drones_gym::prelude::*;
use mujoco_drones_gym::rollout::{PilotMode, PilotedPolicy, from_fn};
use mujoco_drones_gym::tasks::Base;
use mujoco_drones_gym::wrappers::SafetyWrapper;
use nalgebra::Vector3;

/// Returns sticks that change with the control step.
fn sticks(step: u32) -> [f64; 4] {
    let wave = |rate: f64, phase: f64| (f64::from(step) * rate + phase).sin();
    [0.2 * wave(0.09, 0.3), 0.1 * wave(0.11, 1.0), 0.1 * wave(0.13, 2.0), 0.3 * wave(0.04, 0.0)]
}

fn base(action_type: ActionType) -> AviaryBuilder<Base> {
    Base::builder()
        .drone(airframe_with_duty())
        .action_type(action_type)
        .physics(Physics::MjcGndDragDw)
        .initial_positions([[0.0, 0.0, 3.0]])
}

/// Returns a policy that leaves the motors off.
fn off() -> impl Policy {
    from_fn(|env, action| action.fill(env.action_space().low()[0]))
}

/// Flies one drone with the sticks, and returns its states.
fn fly<P: Policy>(env: impl DroneEnv, mut policy: PilotedPolicy<P>, mode: PilotMode) -> Vec<DroneState> {
    policy.take(0, mode);
    let mut rollout = Rollout::start(env, policy, Some(1)).unwrap();
    let mut states = Vec::new();
    for step in 0..96 {
        rollout.policy_mut().set_command(0, sticks(step));
        rollout.step().unwrap();
        states.push(rollout.env().simulation().states()[0]);
    }
    states
}

/// The reference is an environment with the action type of the mode. Commands in rpm are exact, normalized commands
/// and duties round.
#[test]
fn every_mode_flies_as_the_environment_with_its_action_type() {
    for mode in PilotMode::ALL {
        let mut env = base(mode.action_type()).build().unwrap();
        let high = env.action_space().high().to_vec();
        env.reset(Some(1)).unwrap();
        let expected: Vec<_> = (0..96)
            .map(|step| {
                let action: Vec<_> = sticks(step).iter().zip(&high).map(|(stick, high)| stick * high).collect();
                env.step(&action).unwrap();
                env.simulation().states()[0]
            })
            .collect();
        let travel = (expected[95].position - Vector3::new(0.0, 0.0, 3.0)).norm();
        assert!(travel > 0.1 && env.info().end.is_none(), "{mode}: {travel}");
        let fly = |action_type| fly(base(action_type).build().unwrap(), PilotedPolicy::new(off()), mode);
        assert_eq!(fly(ActionType::RawRpm), expected, "{mode}");
        // the environment has the action type of the mode
        assert_eq!(fly(mode.action_type()), expected, "{mode}");
        for action_type in [ActionType::Rpm, ActionType::Duty] {
            let apart = |(a, b): (DroneState, &DroneState)| (a.position - b.position).norm();
            let error = fly(action_type).into_iter().zip(&expected).map(apart).fold(0.0, f64::max);
            assert!(error < 1e-9, "{mode} {action_type}: {error:e}");
        }
    }
}

#[test]
fn limits_and_controller_of_the_policy_are_those_of_the_builder() {
    let limits = ActionLimits { yaw_rate: 1.0, tilt: 0.2, body_rate: [3.0, 4.0, 2.0], ..ActionLimits::default() };
    for mode in PilotMode::ALL {
        let build = |action_type| base(action_type).action_limits(limits).controller(ControllerKind::Geometric).build();
        let policy = || PilotedPolicy::new(off()).action_limits(limits).unwrap().controller(ControllerKind::Geometric);
        let of_mode = fly(build(mode.action_type()).unwrap(), policy(), mode);
        assert_eq!(fly(build(ActionType::RawRpm).unwrap(), policy(), mode), of_mode, "{mode}");
        let plain = fly(build(ActionType::RawRpm).unwrap(), PilotedPolicy::new(off()), mode);
        assert_ne!(plain, of_mode, "{mode}");
    }
    let wrong = ActionLimits { tilt: -1.0, ..limits };
    let error = PilotedPolicy::new(()).action_limits(wrong).unwrap_err().to_string();
    assert!(error.contains("tilt is -1"), "{error}");
}

#[test]
fn a_drone_with_sticks_at_zero_hovers_in_every_mode() {
    for mode in PilotMode::ALL {
        let mut policy = PilotedPolicy::new(off());
        policy.take(0, mode);
        let env = Hover::builder().initial_positions([[0.0, 0.0, 1.0]]).build().unwrap();
        let mut rollout = Rollout::start(env, policy, Some(1)).unwrap();
        for _ in 0..96 {
            rollout.step().unwrap();
        }
        let state = rollout.env().simulation().states()[0];
        assert!((state.position - Vector3::new(0.0, 0.0, 1.0)).norm() < 1e-3, "{mode}: {:?}", state.position);
        assert_eq!((rollout.policy().piloted(0), rollout.policy().command(0)), (Some(mode), Some([0.0; 4])));
    }
}

/// One of three drones is taken, flown and released. The actions of the others are those of a swarm without a person.
#[test]
fn the_other_drones_of_a_swarm_fly_bit_identically() {
    for kind in ControllerKind::ALL {
        let build = || MultiHover::builder().num_drones(3).physics(Physics::Mjc).episode_seconds(12.0).build().unwrap();
        let policy = || PilotedPolicy::new(ControllerPolicy::new(kind, &build()));
        let mut free = Rollout::start(build(), policy(), Some(1)).unwrap();
        let mut flown = Rollout::start(build(), policy(), Some(1)).unwrap();
        let mut farthest = 0.0_f64;
        for step in 0..480 {
            match step {
                48 => flown.policy_mut().take(1, PilotMode::Vel),
                // away from the others and up
                60 => flown.policy_mut().set_command(1, [0.0, 0.0, 0.15, 0.3]),
                95 => flown.policy_mut().set_command(1, [0.0, 0.0, 0.0, 0.3]),
                120 => flown.policy_mut().take(1, PilotMode::Attitude),
                121 => flown.policy_mut().set_command(1, [-0.005, 0.0, 0.0, 0.2]),
                170 => flown.policy_mut().release(1),
                _ => {}
            }
            free.step().unwrap();
            flown.step().unwrap();
            let [a, b] = [&free, &flown].map(|rollout| rollout.env().simulation().states());
            assert_eq!((a[0], a[2]), (b[0], b[2]), "{kind}, step {step}");
            assert_eq!(a[1] == b[1], step < 48, "{kind}, step {step}");
            farthest = farthest.max((a[1].position - b[1].position).norm());
        }
        assert!(farthest > 0.3, "{kind}: {farthest}");
        let [a, b] = [&free, &flown].map(|rollout| rollout.env().simulation().states()[1].position);
        assert!((a - b).norm() < 0.05, "{kind}: the controller flies the drone back to its target, {a} {b}");
        assert_eq!(flown.policy().piloted(1), None);
    }
}

/// The controller of a released drone starts without the integrals of the time in which a person flew, and follows a
/// new plan from the present state.
#[test]
fn a_released_drone_is_flown_by_a_reset_controller() {
    let build = || FlyThrough::builder().build().unwrap();
    let policy = PilotedPolicy::new(ControllerPolicy::new(ControllerKind::Pid, &build()));
    let mut rollout = Rollout::start(build(), policy, Some(1)).unwrap();
    rollout.policy_mut().take(0, PilotMode::Vel);
    rollout.policy_mut().set_command(0, [0.0, -0.2, 0.2, 0.0]);
    for _ in 0..60 {
        rollout.step().unwrap();
    }
    rollout.policy_mut().release(0);
    let state = rollout.env().simulation().states()[0];
    let mut fresh = ControllerKind::Pid.build(rollout.env().simulation().params(0));
    let plan = rollout.env().plan(0).unwrap();
    for step in 0..5 {
        let simulation = rollout.env().simulation();
        let reference = plan.reference(simulation.time() - 60.0 / 48.0);
        let speeds = fresh.control(simulation.control_period(), &simulation.states()[0], &reference).rpm;
        rollout.step().unwrap();
        let got = rollout.env().simulation().motor_speeds()[0];
        assert!(got.iter().zip(speeds).all(|(a, b)| (a - b).abs() < 1e-8), "step {step}: {got:?} {speeds:?}");
        let inner = rollout.policy().inner().reference(rollout.env(), 0);
        assert!((inner.position - state.position).norm() < 0.1, "the plan starts where the person left the drone");
    }
}

#[test]
fn the_controller_can_be_switched_in_flight() {
    let build = || FlyThrough::builder().build().unwrap();
    let kind = |kind| Box::new(ControllerPolicy::new(kind, &build())) as Box<dyn Policy>;
    let mut rollout = Rollout::start(build(), PilotedPolicy::new(kind(ControllerKind::Pid)), Some(1)).unwrap();
    for _ in 0..48 {
        rollout.step().unwrap();
    }
    let before = rollout.snapshot();
    rollout.policy_mut().set_inner(kind(ControllerKind::Geometric));
    let place = rollout.env().simulation().states()[0].position;
    for _ in 0..5 {
        rollout.step().unwrap();
    }
    assert!((rollout.env().simulation().states()[0].position - place).norm() < 0.2, "the new plan starts here");
    assert_eq!(rollout.restore(&before), Err(RolloutError::Snapshot), "the state of a PID controller");
    let steps = rollout.summary().steps;
    assert_eq!(steps, 53, "unchanged after an error");
    assert!(rollout.finish(|_| {}).unwrap().success);
    // a network or a function has no state to restore
    assert_eq!(rollout.policy_mut().inner_mut().restore(&off().snapshot()), Err(RolloutError::Snapshot));
}

/// Flies, rewinds and flies again; also in another rollout.
fn assert_rewinds<P: Policy>(what: &str, build: impl Fn() -> (Box<dyn DroneEnv + Send>, P), act: impl Fn(&mut P, u32)) {
    let start = || {
        let (env, policy) = build();
        Rollout::start(env, policy, Some(1)).unwrap()
    };
    let fly = |rollout: &mut Rollout<Box<dyn DroneEnv + Send>, P>, steps: std::ops::Range<u32>| {
        let mut out = Vec::new();
        for step in steps {
            act(rollout.policy_mut(), step);
            if !rollout.is_over() {
                rollout.step().unwrap();
            }
            out.push((rollout.env().simulation().states().to_vec(), rollout.summary()));
        }
        out
    };
    let (mut rollout, mut other) = (start(), start());
    for at in [0, 1, 40] {
        rollout.restart(Some(2)).unwrap();
        fly(&mut rollout, 0..at);
        let snapshot = rollout.snapshot();
        let expected = fly(&mut rollout, at..at + 60);
        rollout.restore(&snapshot).unwrap();
        assert_eq!(fly(&mut rollout, at..at + 60), expected, "{what} from step {at}");
        fly(&mut other, 0..7);
        other.restore(&snapshot).unwrap();
        assert_eq!(fly(&mut other, at..at + 60), expected, "{what} from step {at} in another rollout");
    }
}

#[test]
fn a_rewound_flight_continues_bit_identically() {
    let config = || EnvConfig::default().physics(Physics::MjcGndDragDw).episode_seconds(3.0);
    let env = |name| make(name, config()).unwrap();
    for kind in ControllerKind::ALL {
        for name in ["hover", "fly_through", "multi_hover", "race"] {
            for planned in [true, false] {
                let build = || {
                    let (env, pilot) = (env(name), ControllerPolicy::new(kind, &env(name)));
                    (env, if planned { pilot } else { pilot.without_plans() })
                };
                assert_rewinds(&format!("{kind} {name} {planned}"), build, |_, _| {});
            }
        }
        let build = || (env("hover"), ControllerPolicy::new(kind, &env("hover")).follow([named("circle").unwrap()]));
        assert_rewinds(&format!("{kind} on a circle"), build, |_, _| {});
        // a person takes a drone, changes the mode and releases it, before and after the snapshots
        let build = || (env("multi_hover"), PilotedPolicy::new(ControllerPolicy::new(kind, &env("multi_hover"))));
        assert_rewinds(&format!("{kind} with a person"), build, |policy, step| {
            match step {
                10 => policy.take(1, PilotMode::Vel),
                35 => policy.take(1, PilotMode::Attitude),
                39 => policy.take(0, PilotMode::Ctbr),
                55 => policy.release(0),
                80 => policy.release(1),
                _ => {}
            }
            policy.set_command(1, sticks(step).map(|stick| 0.2 * stick));
        });
    }
}

#[test]
fn snapshots_of_other_policies_are_refused() {
    let env = Hover::builder().build().unwrap();
    let of = |kind| ControllerPolicy::new(kind, &env);
    for a in ControllerKind::ALL {
        for b in ControllerKind::ALL {
            assert_eq!(of(b).restore(&of(a).snapshot()).is_ok(), a == b, "{a} {b}");
        }
    }
    let three = ControllerPolicy::new(ControllerKind::Pid, &MultiHover::builder().num_drones(3).build().unwrap());
    let error = of(ControllerKind::Pid).restore(&three.snapshot()).unwrap_err();
    assert!(error.to_string().starts_with("the snapshot is of another kind of policy"), "{error}");
    let mut piloted = PilotedPolicy::new(of(ControllerKind::Pid));
    assert_eq!(piloted.restore(&three.snapshot()), Err(RolloutError::Snapshot));
    assert_eq!(off().restore(&piloted.snapshot()), Err(RolloutError::Snapshot));
}

#[test]
fn unsuitable_environments_drones_and_sticks_are_clear_errors() {
    let act = |env: &mut dyn DroneEnv, drone, mode, sticks| {
        let mut policy = PilotedPolicy::new(from_fn(|_, action| action.fill(0.0)));
        policy.take(drone, mode);
        policy.set_command(drone, sticks);
        env.reset(Some(1)).unwrap();
        policy.act(env, &mut vec![0.0; env.action_space().size()]).map_err(|error| error.to_string())
    };
    let mut vel = base(ActionType::Vel).build().unwrap();
    let expected = "action_type is vel for a drone that a person flies in the mode ctbr, expected rpm, raw_rpm or \
                    duty, which command single motors, or the action type of the mode";
    assert_eq!(act(&mut vel, 0, PilotMode::Ctbr, [0.0; 4]), Err(expected.into()));
    assert_eq!(act(&mut vel, 0, PilotMode::Vel, [0.0; 4]), Ok(()));
    let mut one = base(ActionType::OneDRpm).build().unwrap();
    assert!(act(&mut one, 0, PilotMode::Vel, [0.0; 4]).unwrap_err().starts_with("action_type is one_d_rpm for"));
    let mut env = base(ActionType::Rpm).build().unwrap();
    let expected = "drone 2 does not exist, expected an index from 0 to 0";
    assert_eq!(act(&mut env, 2, PilotMode::Vel, [0.0; 4]), Err(expected.into()));
    let expected = format!("drone {} does not exist, expected an index from 0 to 0", usize::MAX);
    assert_eq!(act(&mut env, usize::MAX, PilotMode::Vel, [0.0; 4]), Err(expected));
    let expected = "command is NaN for stick 1 of drone 0, expected finite numbers from -1 to 1";
    assert_eq!(act(&mut env, 0, PilotMode::Vel, [0.0, f64::NAN, 0.0, 0.0]), Err(expected.into()));
    // sticks beyond their bounds are clipped
    let mut actions = [[1.0; 4], [7.0, 1.0, 2.0, 1.0]].map(|sticks| {
        let mut policy = PilotedPolicy::new(off());
        policy.take(0, PilotMode::Attitude);
        policy.set_command(0, sticks);
        let mut action = [0.0; 4];
        policy.act(&env, &mut action).unwrap();
        action
    });
    assert_eq!(actions[0], actions[1]);
    // a drone that is not piloted has no sticks
    let mut policy = PilotedPolicy::new(off());
    policy.set_command(0, [1.0; 4]);
    policy.act(&env, &mut actions[0]).unwrap();
    assert_eq!((actions[0], policy.command(0)), ([-1.0; 4], None));
}

/// A person flies one drone among others through the safety filter, whose environment has velocity actions.
#[test]
fn a_person_flies_through_the_safety_wrapper() {
    let task = Antipodal::builder().num_drones(4).action_type(ActionType::Vel).controller(ControllerKind::Geometric);
    let env = SafetyWrapper::new(task.build().unwrap(), CollisionCone::new(0.36)).unwrap();
    let mut policy = PilotedPolicy::new(ControllerPolicy::new(ControllerKind::Geometric, &env));
    policy.take(0, PilotMode::Vel);
    let mut rollout = Rollout::start(env, policy, Some(1)).unwrap();
    for step in 0..200 {
        rollout.policy_mut().set_command(0, [if step < 100 { -0.3 } else { 0.3 }, 0.0, 0.0, 0.0]);
        rollout.step().unwrap();
    }
    assert!(rollout.env().info_map()["minimum_distance"] > 0.3);
}
