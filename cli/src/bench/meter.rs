//! Measurements that alternate with bare MuJoCo steps.

use std::time::{Duration, Instant};

use aviary::drone::DroneModel;
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
}

/// Result of a measurement: medians over the rounds of the calls per second, and of their ratio to bare MuJoCo steps.
pub(super) struct Measured {
    pub(super) rate: f64,
    pub(super) over_bare: f64,
}

impl Meter {
    pub(super) fn new(options: &Bench) -> Result<Self, Failure> {
        let (rounds, turn) = if options.quick { (5, 60) } else { (9, 200) };
        let bare = Bare::new(20.0, 1.0).map_err(Failure::work)?;
        Ok(Self { bare, rates: Vec::new(), rounds, turn: Duration::from_millis(turn), seed: options.seed })
    }

    pub(super) fn bare_rate(&mut self) -> f64 {
        median(&mut self.rates)
    }

    /// Calls `work` repeatedly; it returns the time to count.
    pub(super) fn measure(
        &mut self,
        mut work: impl FnMut() -> Result<Duration, EnvError>,
    ) -> Result<Measured, EnvError> {
        let (mut rates, mut ratios) = (Vec::new(), Vec::new());
        work()?;
        for _ in 0..self.rounds {
            let before = self.bare.rate(4000)?;
            let (mut spent, mut calls) = (Duration::ZERO, 0_u32);
            let start = Instant::now();
            while start.elapsed() < self.turn || calls == 0 {
                spent += work()?;
                calls += 1;
            }
            let after = self.bare.rate(4000)?;
            let (rate, bare) = (f64::from(calls) / spent.as_secs_f64(), 0.5 * (before + after));
            self.rates.push(bare);
            rates.push(rate);
            ratios.push(rate / bare);
        }
        Ok(Measured { rate: median(&mut rates), over_bare: median(&mut ratios) })
    }
}

pub(super) fn median(values: &mut [f64]) -> f64 {
    values.sort_by(f64::total_cmp);
    values.get(values.len() / 2).copied().unwrap_or(0.0)
}
