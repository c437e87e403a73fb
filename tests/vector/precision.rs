//! Actions in single and in double precision.

use mujoco_drones_gym::env::AviaryBuilder;
use mujoco_drones_gym::prelude::*;

use super::common::reset_batch;
use super::pair::Pair;
use super::{Wander, widen};

/// Returns actions that single precision cannot represent.
fn fine(actions: &[f32]) -> Vec<f64> {
    actions.iter().enumerate().map(|(i, &x)| f64::from(x) + 1e-10 * (1 + i % 7) as f64).collect()
}

/// Flies a batch and single environments with actions in double precision.
fn fly<T: Task + Clone + Send + Sync>(builder: &AviaryBuilder<T>, config: VecConfig, steps: usize) -> usize {
    let mut pair = Pair::new(&builder.clone().engine(EngineKind::Hybrid), config, 3);
    let mut wander = Wander::new(6, pair.batch.num_envs(), pair.batch.action_size());
    for _ in 0..steps {
        pair.step_f64(&fine(wander.next()));
        pair.compare_all_exactly();
    }
    pair.ended
}

#[test]
fn actions_in_double_precision_are_bit_identical_to_those_of_single_environments() {
    let mut ended = 0;
    for (environments, threads, autoreset) in
        [(1, 1, Autoreset::NextStep), (9, 2, Autoreset::Disabled), (43, 3, Autoreset::NextStep)]
    {
        let config = VecConfig { threads, autoreset, ..VecConfig::new(environments) };
        let rpys = (0..3).map(|drone| [0.0, 0.0, 0.9 - f64::from(drone)]);
        let hover = Hover::builder().initial_rpys([[0.05, -0.1, 0.7]]).sim_freq(300).ctrl_freq(60);
        ended += fly(&hover.clone().episode_seconds(0.7), config, 60);
        ended += fly(&hover.action_type(ActionType::OneDRpm).episode_seconds(0.4), config, 40);
        let swarm = Formation::builder().num_drones(3).initial_rpys(rpys).episode_seconds(0.5);
        ended += fly(&swarm.action_type(ActionType::Ctbr), config, 40);
    }
    assert!(ended > 100, "{ended}");
}

#[test]
fn equal_actions_have_equal_results_in_both_precisions() {
    let config = VecConfig { on_fault: OnFault::Truncate, ..VecConfig::new(21) };
    let builder = || MultiHover::builder().episode_seconds(0.9);
    let (mut single, mut of_single) = reset_batch(builder(), config, 1);
    let (mut double, mut of_double) = reset_batch(builder(), config, 1);
    let (mut other, mut of_other) = reset_batch(builder(), config, 1);
    let mut wander = Wander::new(8, 21, 8);
    for step in 0..70 {
        let mut actions = wander.next().to_vec();
        if step == 30 {
            actions[77] = f32::NAN;
        }
        single.step(&actions, of_single.step()).unwrap();
        double.step_f64(&widen(&actions), of_double.step()).unwrap();
        assert_eq!(single.faults().len(), usize::from(step == 30));
        assert_eq!(single.faults().len(), double.faults().len());
        assert_eq!(of_single, of_double);
        other.step_f64(&fine(&actions), of_other.step()).unwrap();
    }
    assert_ne!(of_single, of_other, "double precision has an effect");
}

#[test]
fn errors_of_actions_in_double_precision_change_nothing() {
    let (mut batch, mut buffers) = reset_batch(Hover::builder(), VecConfig::new(9), 1);
    batch.step_f64(&[1e-9; 36], buffers.step()).unwrap();
    let before = (buffers.clone(), batch.kinematic(8, 0));
    let mut actions = [1e-9; 36];
    actions[34] = f64::INFINITY;
    let error = batch.step_f64(&actions, buffers.step()).unwrap_err().to_string();
    assert!(error.starts_with("environment 8: action[2] is"), "{error}");
    let error = batch.step_f64(&actions[1..], buffers.step()).unwrap_err().to_string();
    assert!(error.contains("actions has 35 entries, expected 36"), "{error}");
    assert_eq!((buffers, batch.kinematic(8, 0)), before);
    assert_eq!([batch.kinematic(9, 0), batch.kinematic(8, 1)], [None; 2]);
    assert_eq!([batch.kinematic(16, 0), batch.kinematic(1000, 0), batch.kinematic(usize::MAX, 0)], [None; 3]);
}
