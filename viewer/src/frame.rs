//! Data of a flight for the window: the constants of an episode, and a frame for every control step.

use std::sync::Arc;

use aviary::engine::{Contact, Load};
use aviary::env::{DroneEnv, EndReason};
use aviary::physics::wind::{WindConfig, WindModel};
use aviary::simulation::Simulation;
use aviary::state::DroneState;
use aviary::world::{Marker, Obstacle, World};
use nalgebra::Vector3;

/// Subject of a window: an environment, or a simulation without a task.
#[derive(Clone, Copy)]
pub enum Source<'a> {
    /// Environment.
    Env(&'a dyn DroneEnv),
    /// Simulation.
    Simulation(&'a Simulation),
}

impl<'a> Source<'a> {
    /// Returns the simulation.
    pub fn simulation(self) -> &'a Simulation {
        match self {
            Self::Env(env) => env.simulation(),
            Self::Simulation(simulation) => simulation,
        }
    }

    /// Returns the name of the task.
    pub(crate) fn name(self) -> &'a str {
        self.env().map_or("simulation", |env| env.name())
    }

    /// Returns the environment.
    fn env(self) -> Option<&'a dyn DroneEnv> {
        match self {
            Self::Env(env) => Some(env),
            Self::Simulation(_) => None,
        }
    }

    /// Returns the position of the reference of a drone (world frame, m), if it has one.
    pub(crate) fn reference(self, drone: usize) -> Option<Vector3<f64>> {
        self.env().map(|env| env.reference(drone).position)
    }
}

/// Constants of an episode.
#[derive(Debug, Clone)]
pub struct EpisodeView {
    /// Name of the task.
    pub task: String,
    /// Number of the episode, from 1.
    pub number: u64,
    /// Scene with its obstacles and markers.
    pub world: World,
    /// Points that drones pass in the episode (world frame, m), for fixed cameras.
    pub extent: Vec<Vector3<f64>>,
    /// Points of the planned path of every drone (world frame, m); empty without a plan.
    pub paths: Vec<Vec<Vector3<f64>>>,
    /// Length of a control step, s.
    pub control_period: f64,
    /// Number of control steps after which the episode is truncated, if there is a limit.
    pub max_steps: Option<u64>,
}

impl EpisodeView {
    /// Number of points of a planned path.
    const POINTS: u32 = 240;

    /// Reads the constants of an environment that has just been reset, or of a simulation.
    pub(crate) fn new(source: Source<'_>, number: u64) -> Self {
        let (simulation, env) = (source.simulation(), source.env());
        let starts = || simulation.initial_states().iter().map(|state| state.position).collect();
        let points = |plan: Box<dyn aviary::control::trajectory::Trajectory>| {
            let at = |i: u32| plan.reference(plan.duration() * f64::from(i) / f64::from(Self::POINTS)).position;
            (0..=Self::POINTS).map(at).collect()
        };
        let plans = |env: &dyn DroneEnv| -> Vec<Vec<_>> {
            env.plans().into_iter().map(|plan| plan.map(points).unwrap_or_default()).collect()
        };
        Self {
            task: source.name().into(),
            number,
            world: simulation.scene(),
            extent: env.map_or_else(starts, |env| env.extent()),
            paths: env.map(plans).unwrap_or_default(),
            control_period: simulation.control_period(),
            max_steps: env.map(|env| env.episode_steps()),
        }
    }
}

/// State of one drone in a frame.
#[derive(Debug, Clone)]
pub struct DroneFrame {
    /// Pose and velocities.
    pub state: DroneState,
    /// Roll, pitch and yaw, rad.
    pub rpy: Vector3<f64>,
    /// Position of the reference, world frame, m; `None` in a simulation without a task.
    pub reference: Option<Vector3<f64>>,
    /// Rotor speeds, rpm.
    pub rotor_speeds: [f64; 4],
    /// Maximum rotor speed, rpm.
    pub max_rpm: f64,
    /// Factors on the commanded speeds of the motors.
    pub motor_gains: [f64; 4],
    /// Supply voltage, V; `None` without a battery.
    pub voltage: Option<f64>,
    /// Reward of the last control step.
    pub reward: f64,
    /// Terms of the reward, by name; empty before the first control step and for a task without terms.
    pub reward_terms: Vec<(&'static str, f64)>,
    /// Reason of the end, if the episode has ended for the drone.
    pub end: Option<EndReason>,
    /// Thrust and external force in the last physics step.
    pub load: Load,
    /// Force with which a person pushes the drone, world frame, N.
    pub push: Vector3<f64>,
}

/// State of a flight after a control step.
#[derive(Debug, Clone)]
pub struct Frame {
    /// Simulated time, s.
    pub time: f64,
    /// Number of control steps since the start of the episode.
    pub step: u64,
    /// States of the drones.
    pub drones: Vec<DroneFrame>,
    /// Sum of the rewards of the episode up to this frame.
    pub episode_reward: f64,
    /// Metrics of the task and of the episode, by name.
    pub metrics: Vec<(&'static str, f64)>,
    /// Contacts of the last control step.
    pub contacts: Vec<Contact>,
    /// Wind; `None` for still air.
    pub wind_config: Option<WindConfig>,
    /// Steady part of the wind, world frame, m/s; zero in still air.
    pub wind: Vector3<f64>,
    /// True if every drone fulfils the task at this moment.
    pub success: bool,
    /// Reason of the end; `None` while the episode runs.
    pub end: Option<EndReason>,
    /// Obstacles.
    pub obstacles: Arc<[Obstacle]>,
    /// Markers, such as gates.
    pub markers: Arc<[Marker]>,
}

impl Frame {
    /// Reads the present state. `before` is the previous frame of the same episode, whose obstacles and markers are
    /// shared if they are equal. `reference` returns the position (world frame, m) that a drone follows.
    pub(crate) fn new(
        source: Source<'_>,
        before: Option<&Self>,
        reference: impl Fn(usize) -> Option<Vector3<f64>>,
    ) -> Self {
        let (simulation, env) = (source.simulation(), source.env());
        let drones: Vec<_> = (simulation.states().iter().enumerate())
            .map(|(drone, state)| DroneFrame {
                state: *state,
                rpy: *simulation.rpy(drone),
                reference: reference(drone),
                rotor_speeds: *simulation.rotor_speeds(drone),
                max_rpm: simulation.params(drone).max_rpm(),
                motor_gains: *simulation.motor_gains(drone),
                voltage: simulation.battery(drone).map(|_| simulation.voltage(drone)),
                reward: env.map_or(0.0, |env| env.drone_reward(drone)),
                reward_terms: env.map_or_else(Vec::new, |env| env.reward_terms(drone)),
                end: env.and_then(|env| env.drone_end(drone)),
                load: simulation.loads()[drone],
                push: Vector3::zeros(),
            })
            .collect();
        let info = env.map(|env| env.info());
        let values = info.iter().flat_map(|info| info.values());
        let mut metrics: Vec<_> = values.filter(|(name, _)| !["time", "success"].contains(name)).collect();
        if let Some(env) = env {
            env.metrics(&mut |name, value| metrics.push((name, value)));
        }
        let reward: f64 = drones.iter().map(|drone| drone.reward).sum();
        let step = simulation.control_steps();
        let earlier = before.map_or(0.0, |before| before.episode_reward);
        let (obstacles, markers) = (simulation.obstacles(), simulation.markers());
        let shared = |same: Option<&Arc<[Obstacle]>>| same.filter(|same| same[..] == *obstacles).cloned();
        let shared_markers = |same: Option<&Arc<[Marker]>>| same.filter(|same| same[..] == markers[..]).cloned();
        Self {
            time: simulation.time(),
            step,
            drones,
            episode_reward: if step == 0 { 0.0 } else { earlier + reward },
            metrics,
            contacts: simulation.contacts().to_vec(),
            wind_config: simulation.wind().copied(),
            wind: steady(simulation.wind()),
            success: info.is_some_and(|info| info.success),
            end: info.and_then(|info| info.end),
            obstacles: shared(before.map(|frame| &frame.obstacles)).unwrap_or_else(|| obstacles.into()),
            markers: shared_markers(before.map(|frame| &frame.markers)).unwrap_or_else(|| markers.as_slice().into()),
        }
    }

    /// Returns the states of the drones.
    pub fn states(&self) -> Vec<DroneState> {
        self.drones.iter().map(|drone| drone.state).collect()
    }
}

/// Returns the steady part of a wind, world frame, m/s.
fn steady(wind: Option<&WindConfig>) -> Vector3<f64> {
    match wind {
        Some(wind) if matches!(wind.model, WindModel::Constant | WindModel::Combined) => wind.velocity.into(),
        _ => Vector3::zeros(),
    }
}
