//! Rollouts: bit-identical episodes, errors, and wrappers.

use mujoco_drones_gym::control::CollisionCone;
use mujoco_drones_gym::policy::{PolicyError, PolicyNetwork};
use mujoco_drones_gym::prelude::*;
use mujoco_drones_gym::rollout::from_fn;
use mujoco_drones_gym::tasks::{NAMES, summary};
use mujoco_drones_gym::wrappers::{SafetyWrapper, Wrapper};

/// Flies an episode with direct calls of the controllers. Returns the sum of rewards, the number of control steps and
/// the final states.
fn fly_with_direct_calls(env: &mut dyn DroneEnv, kind: ControllerKind) -> (f64, u64, Vec<DroneState>) {
    env.reset(Some(5)).unwrap();
    let drones = env.simulation().num_drones();
    let mut controllers: Vec<_> = (0..drones).map(|drone| kind.build(env.simulation().params(drone))).collect();
    let plans = env.plans();
    let (mut action, mut speeds) = (vec![0.0; env.action_space().size()], vec![[0.0; 4]; drones]);
    let (mut reward, mut steps) = (0.0, 0);
    while env.info().end.is_none() {
        let simulation = env.simulation();
        for (drone, controller) in controllers.iter_mut().enumerate() {
            let plan = plans[drone].as_ref();
            let reference = plan.map_or_else(|| env.reference(drone), |plan| plan.reference(simulation.time()));
            let state = &simulation.states()[drone];
            speeds[drone] = controller.control(simulation.control_period(), state, &reference).rpm;
        }
        env.action_of_motor_speeds(&speeds, &mut action).unwrap();
        reward += env.step(&action).unwrap().reward;
        steps += 1;
    }
    (reward, steps, env.simulation().states().to_vec())
}

#[test]
fn a_rollout_is_bit_identical_to_direct_calls_of_the_controllers_in_every_task() {
    for name in NAMES {
        let mut env = make(name, EnvConfig::default().physics(Physics::MjcGndDragDw).episode_seconds(5.0)).unwrap();
        let kind = summary(name).unwrap().defaults.controller;
        let mut pilot = ControllerPolicy::new(kind, &env);
        // the state of the controllers after an earlier episode has no effect
        fly_episode(&mut env, &mut pilot, Some(4)).unwrap();
        let flown = fly_episode(&mut env, &mut pilot, Some(5)).unwrap();
        let states = env.simulation().states().to_vec();
        assert_eq!((flown.reward, flown.steps, states), fly_with_direct_calls(&mut env, kind), "{name}");
        assert_eq!((flown.end, flown.success), (env.info().end, env.info().success), "{name}");
    }
}

#[test]
fn a_controller_commands_velocities_through_the_safety_wrapper() {
    let task = Antipodal::builder().num_drones(4).action_type(ActionType::Vel).controller(ControllerKind::Geometric);
    let env = SafetyWrapper::new(task.build().unwrap(), CollisionCone::new(0.36)).unwrap();
    let pilot = ControllerPolicy::new(ControllerKind::Geometric, &env);
    let mut rollout = Rollout::start(env, pilot, Some(1)).unwrap();
    let summary = rollout.finish(|_| {}).unwrap();
    assert!(summary.success && rollout.env().info_map()["minimum_distance"] > 0.3, "{summary:?}");
    assert!(rollout.env().interventions() > 0);
}

#[test]
fn errors_of_policies_and_of_environments_end_a_rollout() {
    let mut env = MultiHover::builder().build().unwrap();
    let path = concat!(env!("CARGO_MANIFEST_DIR"), "/assets/policies/hover.safetensors");
    let one = PolicyNetwork::load(path).unwrap();
    let refused = fly_episode(&mut env, &mut one.pilot(), Some(1)).unwrap_err();
    assert!(matches!(refused, RolloutError::Policy(PolicyError::Mismatch { .. })), "{refused}");

    let mut rollout = Rollout::start(
        &mut env,
        from_fn(|env, action| action[5] = if env.simulation().control_steps() < 3 { 0.1 } else { f64::NAN }),
        Some(1),
    )
    .unwrap();
    let error = rollout.finish(|_| {}).unwrap_err();
    assert!(matches!(error, RolloutError::Env(EnvError::Action { index: 5, .. })), "{error}");
    // the failed step is not counted
    assert_eq!((rollout.summary().steps, rollout.is_over()), (3, false));
}

/// Wrapper that removes the last number of the observation.
struct ShortObservation<E> {
    env: E,
    observation: Observation,
}

impl<E: DroneEnv> Wrapper for ShortObservation<E> {
    type Inner = E;

    fn inner(this: &Self) -> &E {
        &this.env
    }

    fn inner_mut(this: &mut Self) -> &mut E {
        &mut this.env
    }

    fn observation(this: &Self) -> &Observation {
        &this.observation
    }

    fn step<'a>(this: &'a mut Self, action: &[f64]) -> Result<Step<'a>, EnvError> {
        let Step { reward, terminated, truncated, .. } = this.env.step(action)?;
        this.observation.clone_from(this.env.observation());
        this.observation.vector.truncate(11);
        Ok(Step { observation: &this.observation, reward, terminated, truncated })
    }
}

#[test]
fn a_wrapper_overrides_some_methods_and_forwards_the_others() {
    let plain = make("hover", EnvConfig::default()).unwrap();
    let mut wrapped = ShortObservation { observation: plain.observation().clone(), env: plain };
    let mut pilot = ControllerPolicy::new(ControllerKind::Pid, &wrapped);
    let flown = fly_episode(&mut wrapped, &mut pilot, Some(1)).unwrap();
    assert_eq!((wrapped.observation().vector.len(), wrapped.env.observation().vector.len()), (11, 12));
    assert_eq!(flown, fly_episode(&mut wrapped.env, &mut pilot, Some(1)).unwrap());
    assert_eq!((wrapped.name(), wrapped.episode_steps()), ("hover", 480));
}
