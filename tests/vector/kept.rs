//! Batches that keep the last observations, with another buffer in every call.

use mujoco_drones_gym::env::AviaryBuilder;
use mujoco_drones_gym::prelude::*;
use mujoco_drones_gym::{Rng, RngExt, SeedableRng};

use super::common::conditions::{forest, sensors};
use super::faults::odd;
use super::{Wander, bits};

/// Two batches with the same options, of which one keeps its last observations and receives buffers without valid
/// numbers in every call.
struct Twins<T> {
    plain: VecAviary<T>,
    keeping: VecAviary<T>,
    /// Buffers of the plain batch.
    buffers: VecBuffers,
    /// Number of rows of a reset whose environments the mask did not select.
    kept: usize,
}

impl<T: Task + Clone + Send + Sync> Twins<T> {
    fn new(builder: &AviaryBuilder<T>, config: VecConfig) -> Self {
        let plain = VecAviary::new(builder.clone(), config).unwrap();
        let keeping = VecAviary::new(builder.clone(), VecConfig { keep_observations: true, ..config }).unwrap();
        let buffers = VecBuffers::new(&plain);
        Self { plain, keeping, buffers, kept: 0 }
    }

    fn fresh(&self) -> VecBuffers {
        let mut fresh = VecBuffers::new(&self.keeping);
        fresh.observations.fill(f32::NAN);
        fresh.rewards.fill(f32::NAN);
        fresh
    }

    fn compare(&self, fresh: &[f32]) {
        for (i, (got, expected)) in fresh.iter().zip(&self.buffers.observations).enumerate() {
            let environment = i / self.plain.observation_size();
            assert_eq!(got.to_bits(), expected.to_bits(), "entry {i}, environment {environment}: {got} {expected}");
        }
        assert_eq!(bits(self.plain.final_observations()), bits(self.keeping.final_observations()));
    }

    fn step(&mut self, actions: &[f32]) {
        let mut fresh = self.fresh();
        let results = [self.plain.step(actions, self.buffers.step()), self.keeping.step(actions, fresh.step())];
        assert_eq!(results[0], results[1]);
        if results[0].is_err() && self.keeping.faults().is_empty() {
            assert!(fresh.observations.iter().all(|x| x.is_nan()), "a rejected step writes nothing");
            return;
        }
        self.compare(&fresh.observations);
        assert_eq!(bits(&fresh.rewards), bits(&self.buffers.rewards));
        assert_eq!(fresh.terminated, self.buffers.terminated);
        assert_eq!(fresh.truncated, self.buffers.truncated);
    }

    /// Resets the environments in a mask, each with its own seed if `seeds` are given.
    fn reset(&mut self, mask: &[bool], seeds: Option<&[Option<u64>]>) {
        let mut fresh = self.fresh().observations;
        let reset = |batch: &mut VecAviary<T>, observations: &mut [f32]| match seeds {
            Some(seeds) => batch.reset_with_seeds(mask, seeds, observations),
            None => batch.reset_where(mask, None, observations),
        };
        let results = [reset(&mut self.plain, &mut self.buffers.observations), reset(&mut self.keeping, &mut fresh)];
        assert_eq!(results[0], results[1]);
        self.compare(&fresh);
        self.kept += mask.iter().filter(|selected| !**selected).count();
    }

    fn has_ended(&self, environment: usize) -> bool {
        self.buffers.terminated[environment] || self.buffers.truncated[environment]
    }
}

#[test]
fn a_batch_that_keeps_observations_writes_every_row_to_every_buffer() {
    let noisy = |latency: f64| {
        let builder = Hover::builder().randomization(sensors(latency, true));
        builder.initial_positions([[0.0, 0.0, 0.5]]).episode_seconds(0.6)
    };
    let obstacles = Hover::builder().obstacle_generator(forest(true)).episode_seconds(0.6);
    let (mut ended, mut kept) = (0, 0);
    for (n, builder) in [noisy(0.0), noisy(0.03), obstacles].into_iter().enumerate() {
        for (environments, threads) in [(1, 1), (7, 1), (13, 2), (45, 4)] {
            for autoreset in [Autoreset::NextStep, Autoreset::SameStep, Autoreset::Disabled] {
                let config = VecConfig { threads, autoreset, ..VecConfig::new(environments) };
                let mut twins = Twins::new(&builder, config);
                let mut rng = Rng::seed_from_u64(n as u64);
                let mut wander = Wander::new(3, environments, 4);
                twins.reset(&vec![true; environments], Some(&vec![Some(7); environments]));
                for step in 0..60 {
                    twins.step(wander.next());
                    let over: Vec<_> = (0..environments).map(|i| twins.has_ended(i)).collect();
                    ended += over.iter().filter(|over| **over).count();
                    let pending = autoreset == Autoreset::Disabled && over.contains(&true);
                    if pending || step % 7 == 3 {
                        let mask: Vec<_> =
                            over.iter().map(|over| pending && *over || rng.random::<f64>() < 0.3).collect();
                        let seeds: Vec<_> = mask.iter().map(|_| rng.random::<bool>().then_some(step)).collect();
                        twins.reset(&mask, (step % 2 == 0).then_some(&seeds[..]));
                    }
                }
                kept += twins.kept;
            }
        }
    }
    assert!(ended > 200 && kept > 2000, "{ended} {kept}");
}

#[test]
fn rows_that_a_fault_leaves_unwritten_hold_the_kept_observation() {
    for autoreset in [Autoreset::NextStep, Autoreset::SameStep, Autoreset::Disabled] {
        for on_fault in [OnFault::Truncate, OnFault::Error] {
            // the second episode cannot start: each start is tried 20 times
            let builder =
                odd(|_| {}).episode_seconds(0.25).task(|odd| odd.impossible = |start| (2..42).contains(&start));
            let config = VecConfig { autoreset, on_fault, threads: 2, ..VecConfig::new(19) };
            let mut twins = Twins::new(&builder, config);
            twins.reset(&[true; 19], None);
            let mut faults = 0;
            for step in 0..40 {
                twins.step(&[0.01; 4 * 19]);
                faults += twins.keeping.faults().len();
                if step % 5 == 4 {
                    let mask: [bool; 19] = std::array::from_fn(|i| i % 3 == step % 2);
                    twins.reset(&mask, None);
                    faults += twins.keeping.faults().len();
                }
            }
            assert!(faults > 19, "{autoreset:?} {on_fault:?}: {faults}");
        }
    }
}

#[test]
fn environments_without_a_reset_have_zeros_and_the_copy_counts_as_memory() {
    let config = |keep_observations| VecConfig { keep_observations, ..VecConfig::new(9) };
    let mut batch = VecAviary::new(Hover::builder(), config(true)).unwrap();
    let mut observations = vec![f32::NAN; 9 * 12];
    batch
        .reset_where(&[false, false, false, true, false, false, false, false, false], None, &mut observations)
        .unwrap();
    for (i, row) in observations.chunks_exact(12).enumerate() {
        assert_eq!(row.iter().all(|x| *x == 0.0), i != 3, "{i}: {row:?}");
    }
    let plain = VecAviary::new(Hover::builder(), config(false)).unwrap();
    assert_eq!(batch.bytes_per_env(), plain.bytes_per_env() + 4 * 12);
}
