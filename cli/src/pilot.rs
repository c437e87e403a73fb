//! A task flown by a built-in controller, control step by control step.

use aviary::control::trajectory::Trajectory;
use aviary::control::{AnyController, Controller as _, Reference};
use aviary::env::Env;

use crate::failure::Failure;
use crate::options::FlightOptions;

/// An environment and one controller for each of its drones.
pub struct Pilot {
    env: Box<dyn Env>,
    controllers: Vec<AnyController>,
    trajectory: Option<Box<dyn Trajectory>>,
    speeds: Vec<[f64; 4]>,
    action: Vec<f64>,
    dt: f64,
}

/// What a control step brought.
pub struct Flown {
    pub reward: f64,
    pub over: bool,
}

impl Pilot {
    /// At the start of the first episode.
    pub fn new(options: &FlightOptions) -> Result<Self, Failure> {
        let kind = options.controller()?;
        let trajectory = options.trajectory()?;
        let mut env = options.environment(trajectory.as_deref())?;
        let drones = env.simulation().num_drones();
        let controllers = (0..drones).map(|drone| kind.build(env.simulation().params(drone))).collect();
        let (dt, action) = (env.simulation().control_period(), vec![0.0; env.action_space().size()]);
        env.reset(Some(options.seed)).map_err(Failure::work)?;
        Ok(Self { env, controllers, trajectory, speeds: vec![[0.0; 4]; drones], action, dt })
    }

    /// Starts the next episode, going on with the same random numbers.
    pub fn restart(&mut self) -> Result<(), Failure> {
        for controller in &mut self.controllers {
            controller.reset();
        }
        self.env.reset(None).map_err(Failure::work)?;
        Ok(())
    }

    /// What a drone is asked to follow now.
    pub fn reference(&self, drone: usize) -> Reference {
        match &self.trajectory {
            Some(trajectory) => trajectory.reference(self.env.simulation().time()),
            None => self.env.reference(drone),
        }
    }

    /// Whether it follows a trajectory in place of the task's reference.
    pub fn trajectory(&self) -> Option<&dyn Trajectory> {
        self.trajectory.as_deref()
    }

    /// Largest distance of a drone from where it is asked to be now, m.
    pub fn position_error(&self) -> f64 {
        let simulation = self.env.simulation();
        (0..simulation.num_drones())
            .map(|drone| simulation.distance(drone, &self.reference(drone).position))
            .fold(0.0, f64::max)
    }

    /// Flies one control step.
    pub fn step(&mut self) -> Result<Flown, Failure> {
        for drone in 0..self.controllers.len() {
            let reference = self.reference(drone);
            let state = &self.env.simulation().states()[drone];
            self.speeds[drone] = self.controllers[drone].control(self.dt, state, &reference).rpm;
        }
        self.env.action_of_motor_speeds(&self.speeds, &mut self.action).map_err(Failure::work)?;
        let step = self.env.step(&self.action).map_err(Failure::work)?;
        Ok(Flown { reward: step.reward, over: step.terminated || step.truncated })
    }

    pub fn env(&self) -> &dyn Env {
        &*self.env
    }

    pub fn env_mut(&mut self) -> &mut dyn Env {
        &mut *self.env
    }
}
