//! Measurements that alternate with bare MuJoCo steps.

use std::time::{Duration, Instant};

use aviary::drone::DroneModel;
use aviary::engine::flight::Width;
use aviary::env::EnvError;
use aviary::world::{DroneBody, World};
use mujoco_rs::{Data, Model};
use nalgebra::Vector3;

use super::Bench;
use crate::failure::Failure;

/// Bare MuJoCo: one drone in the lean scene, with a wrench written before every step.
pub(super) struct Bare {
    data: Data,
    thrust: f64,
    height: f64,
}

impl Bare {
    pub(super) fn new(height: f64, thrust: f64) -> Result<Self, EnvError> {
        let params = DroneModel::Cf2x.params();
        let thrust = thrust * params.weight();
        let drone = DroneBody { params, position: Vector3::new(0.0, 0.0, height), rpy: Vector3::zeros() };
        let scene = World::new(vec![drone]).to_mjcf().map_err(|error| EnvError::Vision(error.into()))?;
        Ok(Self { data: Data::new(Model::from_xml(&scene)?)?, thrust, height })
    }

    /// Measures the rate of a number of steps, 1/s.
    pub(super) fn rate(&mut self, steps: usize) -> Result<f64, EnvError> {
        self.data.qpos_mut()[2] = self.height;
        self.data.qvel_mut().fill(0.0);
        // a small angular velocity, because MuJoCo is faster without rotation
        self.data.qvel_mut()[3..6].copy_from_slice(&[0.02, 0.01, 0.03]);
        let start = Instant::now();
        for _ in 0..steps {
            self.data.xfrc_applied_mut()[6..12].copy_from_slice(&[0.0, 0.0, self.thrust, 0.0, 0.0, 0.0]);
            self.data.step()?;
        }
        Ok(steps as f64 / start.elapsed().as_secs_f64())
    }
}

/// Measures rates; bare MuJoCo steps before and after each measurement give the ratio.
pub(super) struct Meter {
    bare: Bare,
    rates: Vec<f64>,
    rounds: usize,
    turn: Duration,
    pub(super) seed: u64,
    /// Instruction set of the batches.
    pub(super) width: Width,
}

/// Result of a measurement: medians over the rounds of the calls per second, and of their ratio to bare MuJoCo steps.
pub(super) struct Measured {
    pub(super) rate: f64,
    pub(super) over_bare: f64,
    /// Spread of the ratio, see [`spread`].
    pub(super) spread: f64,
}

impl Meter {
    pub(super) fn new(options: &Bench) -> Result<Self, Failure> {
        let (rounds, turn) = if options.quick { (5, 60) } else { (9, 200) };
        let bare = Bare::new(20.0, 1.0).map_err(Failure::work)?;
        Ok(Self {
            bare,
            rates: Vec::new(),
            rounds,
            turn: Duration::from_millis(turn),
            seed: options.seed,
            width: options.width(),
        })
    }

    pub(super) fn bare_rate(&mut self) -> f64 {
        median(&mut self.rates)
    }

    /// Calls `work` repeatedly; it returns the time to count.
    pub(super) fn measure(
        &mut self,
        mut work: impl FnMut() -> Result<Duration, EnvError>,
    ) -> Result<Measured, EnvError> {
        let mut measured = self.measure_in_turns(1, |_| work())?;
        measured.pop().ok_or(EnvError::Panicked)
    }

    /// Calls `work` repeatedly with every index below `count`; it returns the time to count. Every round measures
    /// all of them, one after another.
    pub(super) fn measure_in_turns(
        &mut self,
        count: usize,
        mut work: impl FnMut(usize) -> Result<Duration, EnvError>,
    ) -> Result<Vec<Measured>, EnvError> {
        let rounds = self.rounds_in_turns(count, &mut work)?;
        let measured = |index: usize| {
            let of = |pick: fn(&[f64; 2]) -> f64| rounds.iter().map(|round| pick(&round[index])).collect::<Vec<_>>();
            let mut ratios = of(|[_, ratio]| *ratio);
            let spread = spread(&ratios);
            Measured { rate: median(&mut of(|[rate, _]| *rate)), over_bare: median(&mut ratios), spread }
        };
        Ok((0..count).map(measured).collect())
    }

    /// Measures as [`measure_in_turns`](Self::measure_in_turns) does, and returns the calls per second and their
    /// ratio to bare MuJoCo steps of every round and index.
    pub(super) fn rounds_in_turns(
        &mut self,
        count: usize,
        mut work: impl FnMut(usize) -> Result<Duration, EnvError>,
    ) -> Result<Vec<Vec<[f64; 2]>>, EnvError> {
        for index in 0..count {
            work(index)?;
        }
        let mut rounds = Vec::new();
        for _ in 0..self.rounds {
            let mut round = Vec::new();
            for index in 0..count {
                let before = self.bare.rate(4000)?;
                let (mut spent, mut calls) = (Duration::ZERO, 0_u32);
                let start = Instant::now();
                while start.elapsed() < self.turn || calls == 0 {
                    spent += work(index)?;
                    calls += 1;
                }
                let after = self.bare.rate(4000)?;
                let (rate, bare) = (f64::from(calls) / spent.as_secs_f64(), 0.5 * (before + after));
                self.rates.push(bare);
                round.push([rate, rate / bare]);
            }
            rounds.push(round);
        }
        Ok(rounds)
    }
}

/// Returns the largest minus the smallest value, relative to the median.
pub(super) fn spread(values: &[f64]) -> f64 {
    let (min, max) = values.iter().fold((f64::INFINITY, 0.0_f64), |(min, max), &x| (min.min(x), max.max(x)));
    (max - min) / median(&mut values.to_vec())
}

pub(super) fn median(values: &mut [f64]) -> f64 {
    values.sort_by(f64::total_cmp);
    values.get(values.len() / 2).copied().unwrap_or(0.0)
}
