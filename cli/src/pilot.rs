//! A task flown by a built-in controller, control step by control step.

use aviary::control::{Controller, PidControl};
use aviary::env::Env;

use crate::failure::Failure;
use crate::options::FlightOptions;

/// An environment and one controller for each of its drones.
pub struct Pilot {
    env: Box<dyn Env>,
    controllers: Vec<Box<dyn Controller>>,
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
        let mut env = options.environment()?;
        let drones = env.simulation().num_drones();
        let controllers = (0..drones)
            .map(|drone| Box::new(PidControl::new(env.simulation().params(drone))) as Box<dyn Controller>)
            .collect();
        let (dt, action) = (env.simulation().control_period(), vec![0.0; env.action_space().size()]);
        env.reset(Some(options.seed)).map_err(Failure::work)?;
        Ok(Self { env, controllers, speeds: vec![[0.0; 4]; drones], action, dt })
    }

    /// Starts the next episode, going on with the same random numbers.
    pub fn restart(&mut self) -> Result<(), Failure> {
        for controller in &mut self.controllers {
            controller.reset();
        }
        self.env.reset(None).map_err(Failure::work)?;
        Ok(())
    }

    /// Flies one control step.
    pub fn step(&mut self) -> Result<Flown, Failure> {
        for (drone, (controller, speeds)) in self.controllers.iter_mut().zip(&mut self.speeds).enumerate() {
            let state = &self.env.simulation().states()[drone];
            *speeds = controller.control(self.dt, state, &self.env.reference(drone)).rpm;
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
