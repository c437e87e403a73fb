//! A task flown by a built-in controller, control step by control step.

use aviary::action::ActionType;
use aviary::control::trajectory::Trajectory;
use aviary::control::{AnyController, Controller as _, ControllerKind, Reference};
use aviary::env::Env;
use aviary::tasks::hover_reward;

use crate::failure::Failure;
use crate::options::{FlightOptions, Variation};

/// An environment and one controller for each of its drones.
pub struct Pilot {
    env: Box<dyn Env>,
    controllers: Vec<AnyController>,
    kind: ControllerKind,
    trajectory: Option<Box<dyn Trajectory>>,
    /// Each drone's way through the task, where it has one.
    plans: Vec<Option<Box<dyn Trajectory>>>,
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
        Self::varied(options, Variation::NONE)
    }

    /// The same with episodes that differ.
    pub fn varied(options: &FlightOptions, variation: Variation) -> Result<Self, Failure> {
        let kind = options.controller()?;
        let trajectory = options.trajectory()?;
        let mut env = options.environment(trajectory.as_deref(), variation)?;
        let drones = env.simulation().num_drones();
        let controllers = (0..drones).map(|drone| kind.build(env.simulation().params(drone))).collect();
        let (dt, action) = (env.simulation().control_period(), vec![0.0; env.action_space().size()]);
        env.reset(Some(options.seed)).map_err(Failure::work)?;
        let speeds = vec![[0.0; 4]; drones];
        let mut pilot = Self { env, controllers, kind, trajectory, plans: Vec::new(), speeds, action, dt };
        pilot.plan();
        Ok(pilot)
    }

    /// Looks for a way through the task from where the drones are now.
    fn plan(&mut self) {
        let planned = |drone| if self.trajectory.is_none() { self.env.plan(drone) } else { None };
        self.plans = (0..self.controllers.len()).map(planned).collect();
    }

    /// The kind of controller.
    pub fn kind(&self) -> ControllerKind {
        self.kind
    }

    /// Starts the next episode, going on with the same random numbers.
    pub fn restart(&mut self) -> Result<(), Failure> {
        for controller in &mut self.controllers {
            controller.reset();
        }
        self.env.reset(None).map_err(Failure::work)?;
        self.plan();
        Ok(())
    }

    /// The way that a drone is to fly, where it has one.
    pub fn way(&self, drone: usize) -> Option<&dyn Trajectory> {
        self.trajectory.as_deref().or(self.plans[drone].as_deref())
    }

    /// What a drone is asked to follow now.
    pub fn reference(&self, drone: usize) -> Reference {
        match self.way(drone) {
            Some(way) => way.reference(self.env.simulation().time()),
            None => self.env.reference(drone),
        }
    }

    /// A drone's reward for the last control step. Along a trajectory, which replaces the target of hover, it is hover's
    /// reward with the point that the trajectory has reached as the target.
    pub fn reward(&self, drone: usize) -> f64 {
        let simulation = self.env.simulation();
        match &self.trajectory {
            Some(_) if simulation.control_steps() == 0 => 0.0,
            Some(_) => hover_reward(simulation, drone, &self.reference(drone).position, self.env.drone_end(drone)),
            None => self.env.drone_reward(drone),
        }
    }

    /// Whether it follows a trajectory in place of the task's reference.
    pub fn trajectory(&self) -> Option<&dyn Trajectory> {
        self.trajectory.as_deref()
    }

    /// Whether drones follow ways through the task that it gave them.
    pub fn has_plan(&self) -> bool {
        self.plans.iter().any(Option::is_some)
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
        if self.env.action_type() == ActionType::Vel {
            self.command_velocities();
            return self.advance();
        }
        for drone in 0..self.controllers.len() {
            let reference = self.reference(drone);
            let state = &self.env.simulation().states()[drone];
            self.speeds[drone] = self.controllers[drone].control(self.dt, state, &reference).rpm;
        }
        self.env.action_of_motor_speeds(&self.speeds, &mut self.action).map_err(Failure::work)?;
        self.advance()
    }

    /// Velocities towards where the drones are asked to be, a little to the right of it while it is far: somebody has to
    /// give way first.
    fn command_velocities(&mut self) {
        const SPEED: f64 = 1.0;
        for drone in 0..self.controllers.len() {
            let (state, reference) = (&self.env.simulation().states()[drone], self.reference(drone));
            let way = reference.position - state.position;
            let aside = 0.25 * (way.xy().norm() - 0.3).clamp(0.0, 1.0);
            let (x, y) = (way.x + aside * way.y, way.y - aside * way.x);
            let fast = 1.5 * x.hypot(y);
            let share = 1.5 * (SPEED / fast.max(SPEED));
            let (sin, cos) = state.yaw().sin_cos();
            let command = &mut self.action[4 * drone..][..4];
            command[0] = share * (cos * x + sin * y);
            command[1] = share * (cos * y - sin * x);
            command[2] = (2.0 * way.z).clamp(-SPEED, SPEED);
            command[3] = 0.0;
        }
    }

    fn advance(&mut self) -> Result<Flown, Failure> {
        let step = self.env.step(&self.action).map_err(Failure::work)?;
        let (reward, over) = (step.reward, step.terminated || step.truncated);
        let drones = 0..self.controllers.len();
        let reward = if self.trajectory.is_some() { drones.map(|drone| self.reward(drone)).sum() } else { reward };
        Ok(Flown { reward, over })
    }

    pub fn env(&self) -> &dyn Env {
        &*self.env
    }
}
