//! Tests of PPO with a recurrent layer.

use aviary::env::BoxSpace;
use aviary::policy::Activation;

use super::*;
use crate::TrainConfig;
use crate::agents::Next;

/// Steps of an episode of [`Recall`].
const LENGTH: u64 = 6;

/// Agents that are shown −1 or 1 at the first step of an episode, and must output this number until the end.
struct Recall {
    observations: BoxSpace,
    actions: BoxSpace,
    /// Number and age of every row.
    rows: Vec<(f32, u64)>,
    rng: Rng,
}

impl Recall {
    fn new(rows: usize) -> Self {
        let space = |size| BoxSpace::new(vec![[-2.0, 2.0]; size]);
        let rng = Rng::seed_from_u64(0);
        Self { observations: space(2), actions: space(1), rows: vec![(0.0, 0); rows], rng }
    }

    fn begin(&mut self, row: usize) {
        self.rows[row] = (if self.rng.random() { 1.0 } else { -1.0 }, 0);
    }

    /// Writes the number and 1 at the first step, and zeros at the others.
    fn observe(&self, out: &mut [f32]) {
        for (out, &(number, age)) in out.chunks_exact_mut(2).zip(&self.rows) {
            out.copy_from_slice(&if age == 0 { [number, 1.0] } else { [0.0, 0.0] });
        }
    }
}

impl Agents for Recall {
    fn rows(&self) -> usize {
        self.rows.len()
    }

    fn observation_space(&self) -> &BoxSpace {
        &self.observations
    }

    fn action_space(&self) -> &BoxSpace {
        &self.actions
    }

    fn longest(&self, _: usize) -> u64 {
        LENGTH + 1
    }

    fn reset(&mut self, seed: u64, observations: &mut [f32]) -> Result<(), EnvError> {
        self.rng = Rng::seed_from_u64(seed);
        (0..self.rows.len()).for_each(|row| self.begin(row));
        self.observe(observations);
        Ok(())
    }

    fn step(&mut self, actions: &[f32], outcome: &mut Outcome) -> Result<(), EnvError> {
        for (row, action) in actions.iter().enumerate() {
            let (number, age) = &mut self.rows[row];
            outcome.rewards[row] = if *age == 0 { 0.0 } else { -(action - *number).powi(2) };
            *age += 1;
            outcome.next[row] = if *age == LENGTH { Next::Terminated } else { Next::Running };
            if *age == LENGTH {
                self.begin(row);
            }
        }
        self.observe(&mut outcome.observations);
        Ok(())
    }

    fn restart(&mut self, mask: &mut [bool], observations: &mut [f32]) -> Result<(), EnvError> {
        for row in (0..mask.len()).filter(|&row| mask[row]) {
            self.begin(row);
        }
        self.observe(observations);
        Ok(())
    }
}

fn recall(recurrent: usize) -> (Recall, Ppo) {
    let mut config = TrainConfig::of_task("hover").unwrap().ppo;
    (config.horizon, config.minibatch, config.learning_rate) = (24, 480, 3e-3);
    (config.hidden, config.activation, config.recurrent) = (vec![16], Activation::Softsign, recurrent);
    let mut agents = Recall::new(70);
    let mut ppo = Ppo::new(config, Width::best(), &agents, 5).unwrap();
    ppo.estimate_scales(&mut agents, [1, 2]).unwrap();
    ppo.restart(&mut agents, 3).unwrap();
    (agents, ppo)
}

#[test]
fn a_task_that_needs_a_memory_is_solved_by_the_recurrent_policy_alone() {
    let learned = |recurrent| {
        let (mut agents, mut ppo) = recall(recurrent);
        let mut reward = 0.0;
        for seed in 0..60 {
            reward = ppo.iterate(&mut agents, seed).unwrap().mean_reward;
        }
        reward
    };
    // the best constant action, 0, has a mean reward of -1 at five of six steps
    let (with, without) = (learned(8), learned(0));
    assert!(with > -0.25, "{with}");
    assert!(without < -0.8, "{without}");
}

#[test]
fn memories_are_zero_at_the_start_of_an_episode_and_go_on_from_rollout_to_rollout() {
    let (mut agents, mut ppo) = recall(4);
    let gru = ppo.recurrent.clone().unwrap();
    let (rows, horizon) = (agents.rows(), ppo.config.horizon);
    ppo.collect(&mut agents, 7).unwrap();
    let mut state = vec![0.0; 4 * rows];
    let (mut starts, mut finals) = (0, 0);
    for _ in 0..2 {
        let experience = &ppo.experience;
        assert_eq!(experience.starts, state);
        for step in 0..horizon {
            for row in 0..rows {
                let entry = step * rows + row;
                let features = &experience.observations[6 * entry..][..6];
                let own = &mut state[4 * row..][..4];
                gru.forward(&features[..2], own);
                assert_eq!(*own, features[2..], "step {step}, row {row}");
                if let Some(place) = experience.cut.iter().position(|&cut| cut == entry) {
                    let last = &experience.finals[6 * place..][..6];
                    let mut after = own.to_vec();
                    gru.forward(&last[..2], &mut after);
                    assert_eq!(after, last[2..]);
                    finals += 1;
                }
                if experience.next[entry].is_end() {
                    own.fill(0.0);
                    starts += 1;
                }
            }
        }
        assert_eq!(ppo.memory, state);
        ppo.collect(&mut agents, 8).unwrap();
    }
    assert!(starts > 300 && finals > 30, "{starts} {finals}");
    ppo.restart(&mut agents, 9).unwrap();
    assert!(ppo.memory.iter().all(|x| *x == 0.0));
}
