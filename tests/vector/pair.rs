//! A batch next to single environments with the same options, actions and random streams.

use mujoco_drones_gym::env::AviaryBuilder;
use mujoco_drones_gym::observation::kinematic;
use mujoco_drones_gym::prelude::*;

use super::{bits, widen};

/// A batch and its single environments. Every function does the same with both and compares the results.
pub struct Pair<T> {
    pub batch: VecAviary<T>,
    pub buffers: VecBuffers,
    pub alone: Vec<Aviary<T>>,
    /// True for environments that the next step resets.
    over: Vec<bool>,
    /// Number of episodes that have ended.
    pub ended: usize,
    /// Number of steps.
    steps: usize,
    /// Row of a single environment.
    row: Vec<f32>,
}

impl<T: Task + Clone + Send + Sync> Pair<T> {
    /// Creates a batch and its single environments, and resets all of them with a seed.
    pub fn new(builder: &AviaryBuilder<T>, config: VecConfig, seed: u64) -> Self {
        let batch = VecAviary::new(builder.clone(), config).unwrap();
        let (count, size) = (batch.num_envs(), batch.observation_size());
        let buffers = VecBuffers::new(&batch);
        let alone = (0..count).map(|i| builder.clone().stream(i as u64).build().unwrap()).collect();
        let (over, row) = (vec![false; count], vec![0.0; size]);
        let mut pair = Self { batch, buffers, alone, over, ended: 0, steps: 0, row };
        pair.reset_where(&vec![true; count], Some(seed));
        pair
    }

    /// Resets the environments in a mask.
    pub fn reset_where(&mut self, mask: &[bool], seed: Option<u64>) {
        self.batch.reset_where(mask, seed, &mut self.buffers.observations).unwrap();
        for i in (0..mask.len()).filter(|&i| mask[i]) {
            self.reset_alone(i, seed);
            self.compare_row(i, "the reset");
        }
    }

    /// Resets the environments in a mask, each with its own seed.
    pub fn reset_with_seeds(&mut self, mask: &[bool], seeds: &[Option<u64>]) {
        self.batch.reset_with_seeds(mask, seeds, &mut self.buffers.observations).unwrap();
        for i in (0..mask.len()).filter(|&i| mask[i]) {
            self.reset_alone(i, seeds[i]);
            self.compare_row(i, "the reset");
        }
    }

    /// Advances all environments by one step. An action that is not finite must end its episode, see
    /// [`OnFault::Truncate`].
    pub fn step(&mut self, actions: &[f32]) {
        self.batch.step(actions, self.buffers.step()).unwrap();
        self.step_alone(&widen(actions));
    }

    /// Advances all environments by one step, with actions in double precision.
    pub fn step_f64(&mut self, actions: &[f64]) {
        self.batch.step_f64(actions, self.buffers.step()).unwrap();
        self.step_alone(actions);
    }

    /// Advances the single environments and compares them with the batch.
    fn step_alone(&mut self, actions: &[f64]) {
        self.steps += 1;
        let (size, autoreset) = (self.batch.action_size(), self.batch.config().autoreset);
        for (i, action) in actions.chunks_exact(size).enumerate() {
            let context = format!("step {} of environment {i}", self.steps);
            let got = (self.buffers.rewards[i].to_bits(), self.buffers.terminated[i], self.buffers.truncated[i]);
            if self.over[i] {
                assert_eq!(got, (0, false, false), "{context}");
                self.reset_alone(i, None);
                self.compare_row(i, &context);
                continue;
            }
            if action.iter().any(|x| !x.is_finite()) {
                assert!(self.alone[i].step(action).is_err());
                assert_eq!(got, (0, false, true), "{context}");
                assert_eq!(self.batch.faults().iter().filter(|(environment, _)| *environment == i).count(), 1);
                self.ended += 1;
                if autoreset == Autoreset::SameStep {
                    self.reset_alone(i, None);
                    self.compare_row(i, &context);
                } else {
                    self.over[i] = true;
                }
                continue;
            }
            let env = &mut self.alone[i];
            let Step { reward, terminated, truncated, .. } = env.step(action).unwrap();
            assert_eq!(got, ((reward as f32).to_bits(), terminated, truncated), "{context}");
            let (info, control_steps) = (env.info(), env.simulation().control_steps());
            let summary = self.batch.episode_summary(i).copied();
            assert_eq!(summary.and_then(|summary| summary.end), info.end, "{context}");
            if let Some(summary) = summary {
                assert_eq!((summary.success, summary.steps), (info.success, control_steps), "{context}");
                self.ended += 1;
                assert_eq!(self.batch.final_info(i), Some(&info), "{context}: the last info");
                if autoreset == Autoreset::SameStep {
                    self.write_row(i);
                    let last = &self.batch.final_observations()[self.row.len() * i..][..self.row.len()];
                    assert_eq!(bits(last), bits(&self.row), "{context}: the last observation");
                    self.reset_alone(i, None);
                } else {
                    self.over[i] = true;
                }
            }
            self.compare_row(i, &context);
        }
        if autoreset == Autoreset::Disabled && self.over.contains(&true) {
            self.reset_where(&self.over.clone(), None);
        }
    }

    /// Compares states, rotor speeds, commands, loads, clock and sampled parameters of an environment in double
    /// precision.
    pub fn compare_exactly(&mut self, i: usize) {
        let got = self.batch.with(i, |env| exact(env)).unwrap();
        let expected = exact(&self.alone[i]);
        assert_eq!(got.len(), expected.len());
        for ((what, got), (_, expected)) in got.into_iter().zip(expected) {
            let context = format!("{what} of environment {i} after step {}: {got:e}, {expected:e}", self.steps);
            assert_eq!(got.to_bits(), expected.to_bits(), "{context}");
        }
        let simulation = self.alone[i].simulation();
        for (drone, (state, speeds)) in simulation.states().iter().zip(simulation.motor_speeds()).enumerate() {
            let got = self.batch.kinematic(i, drone).unwrap().map(f64::to_bits);
            assert_eq!(got, kinematic(state, speeds).map(f64::to_bits), "drone {drone} of environment {i}");
            assert_eq!(self.batch.battery(i, drone), simulation.battery(drone));
        }
        let sampled = self.batch.with(i, |env| env.sampled_params().cloned()).unwrap();
        assert_eq!(sampled.as_ref(), self.alone[i].sampled_params());
    }

    /// Compares all environments as [`compare_exactly`](Self::compare_exactly) does.
    pub fn compare_all_exactly(&mut self) {
        (0..self.alone.len()).for_each(|i| self.compare_exactly(i));
    }

    /// Changes one environment of the batch and the single environment alike.
    pub fn change(&mut self, i: usize, change: impl Fn(&mut Aviary<T>)) {
        self.batch.with(i, |env| change(env)).unwrap();
        change(&mut self.alone[i]);
    }

    /// Expects that the next step starts an episode of an environment, because a change has cut off the current one.
    pub fn cut_off(&mut self, i: usize) {
        self.over[i] = true;
    }

    fn reset_alone(&mut self, i: usize, seed: Option<u64>) {
        self.alone[i].reset(seed).unwrap();
        self.over[i] = false;
    }

    /// Writes the observation of a single environment to `row`.
    fn write_row(&mut self, i: usize) {
        self.batch.observation_space().vector.write_f32(&self.alone[i].observation().vector, &mut self.row);
    }

    fn compare_row(&mut self, i: usize, context: &str) {
        self.write_row(i);
        let got = &self.buffers.observations[self.row.len() * i..][..self.row.len()];
        assert_eq!(bits(got), bits(&self.row), "{context}: {got:?} {:?}", self.row);
    }
}

/// Returns the numbers of a simulation that every step changes, with their names.
fn exact<T: Task + Clone + Send + Sync>(env: &Aviary<T>) -> Vec<(&'static str, f64)> {
    let simulation = env.simulation();
    let mut numbers = vec![("time", simulation.time()), ("gravity", simulation.gravity())];
    let seed = simulation.wind().map_or(0, |_| simulation.wind_seed());
    numbers.extend([seed >> 32, seed & 0xffff_ffff].map(|half| ("wind seed", half as f64)));
    let mut add = |what: &'static str, values: &[f64]| numbers.extend(values.iter().map(|&x| (what, x)));
    for (drone, state) in simulation.states().iter().enumerate() {
        add("position", state.position.as_slice());
        add("attitude", state.attitude.coords.as_slice());
        add("velocity", state.velocity.as_slice());
        add("angular velocity", state.angular_velocity.as_slice());
        add("roll, pitch, yaw", simulation.rpy(drone).as_slice());
        add("rotor speed", simulation.rotor_speeds(drone));
        add("motor speed", &simulation.motor_speeds()[drone]);
        if let Some(battery) = simulation.battery(drone) {
            add("battery", &[battery.charge, battery.voltage, battery.current]);
        }
        let load = &simulation.loads()[drone];
        add("thrust", &[load.rotors.thrust]);
        add("torque", load.rotors.torque_body.as_slice());
        add("force", load.external.force_world.as_slice());
        let params = simulation.params(drone);
        add("mass", &[params.mass, params.thrust_coefficient]);
    }
    for state in simulation.remembered() {
        add("remembered position", state.position.as_slice());
        add("remembered attitude", state.attitude.coords.as_slice());
        add("remembered velocity", state.velocity.as_slice());
        add("remembered angular velocity", state.angular_velocity.as_slice());
    }
    numbers
}
