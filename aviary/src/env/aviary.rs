use std::sync::Arc;

use nalgebra::Vector3;
use rand::Rng as _;

use super::episode::{Episode, Phase, StepOutcome};
use super::stored::Snapshot;
use super::workspace::{EnvModel, EnvWorkspace, Synced};
use super::{
    BoxSpace, DroneEnv, EndReason, Env, EnvError, EnvSnapshot, Info, ObservationSpace, Randomization, SampledParams,
    Step, Task, TaskOptions,
};
use crate::action::{ActionDecoder, ActionType};
use crate::control::Reference;
use crate::control::trajectory::Trajectory;
use crate::observation::Observation;
use crate::physics::battery::BatteryState;
use crate::physics::wind::WindConfig;
use crate::sensing::Rangefinder;
use crate::simulation::{self, SimData, SimModel, SimView, Simulation};
use crate::state::DroneState;
use crate::vision::{ImageSize, SceneRenderer, View};
use crate::world::Obstacle;

/// Environment made from a [`Task`].
///
/// ```
/// use aviary::env::{DroneEnv, Env};
/// use aviary::tasks::Hover;
///
/// let mut env = Hover::builder().build()?;
/// // higher, from the next episode on
/// env.task_mut().target_height = 1.5;
/// env.reset(Some(1))?;
/// assert_eq!(env.reference(0).position.z, 1.5);
/// assert_eq!(env.observation_of(0)[..3], [0.0, 0.0, 0.1]);
/// # Ok::<(), aviary::env::EnvError>(())
/// ```
#[derive(Debug)]
pub struct Aviary<T> {
    pub(crate) model: Arc<EnvModel>,
    pub(crate) simulation: Simulation,
    pub(crate) episode: Episode<T>,
    /// Decoders from actions to motor speeds, one per drone.
    pub(crate) decoders: Vec<ActionDecoder>,
    pub(crate) workspace: EnvWorkspace,
    /// Renderer of [`Env::render`], created by its first call.
    pub(super) renderer: Option<Synced<SceneRenderer>>,
}

impl<T: Task> Aviary<T> {
    /// Returns the task.
    pub fn task(&self) -> &T {
        &self.episode.task
    }

    /// Returns the task, to change its options between episodes. The current episode ends, and the next reset
    /// validates the options. Options that only the builder reads (number of drones, initial positions, markers)
    /// have no effect.
    pub fn task_mut(&mut self) -> &mut T {
        (self.episode.task_changed, self.episode.phase) = (true, Phase::New);
        &mut self.episode.task
    }

    /// Returns one drone's block of the observation vector; empty if the observation type has no vector or `drone`
    /// is out of range.
    pub fn observation_of(&self, drone: usize) -> &[f64] {
        let block = self.model.block;
        self.workspace.observation.vector.get(drone * block..(drone + 1) * block).unwrap_or_default()
    }

    /// Returns the decoder from actions to motor speeds of a drone.
    ///
    /// # Panics
    /// If `drone` is out of range.
    pub fn action_decoder(&self, drone: usize) -> &ActionDecoder {
        &self.decoders[drone]
    }

    /// Returns the ranges of the parameters that are sampled for the next episode; `None` without randomization.
    pub fn randomization(&self) -> Option<&Randomization> {
        match &self.episode.next_randomization {
            Some(next) => next.as_deref(),
            None => self.episode.randomizer.as_ref().map(|randomizer| randomizer.config()),
        }
    }

    /// Returns the settings of the environment's own wind, also those of still air; `None` without settings. A
    /// randomization of the wind keeps some of them.
    pub fn wind_settings(&self) -> Option<&WindConfig> {
        match &self.episode.randomizer {
            Some(randomizer) => randomizer.own_wind(),
            None => self.simulation.wind(),
        }
    }

    /// Returns the index of the seed's random stream that the environment uses.
    pub fn stream(&self) -> u64 {
        self.episode.stream
    }

    /// Borrows the parts that the stages of a control step need.
    pub(crate) fn parts(&mut self) -> EnvParts<'_, T> {
        let Self { model, simulation, episode, decoders, workspace, .. } = self;
        EnvParts {
            model,
            sim_model: &simulation.model,
            data: &mut simulation.data,
            episode,
            decoders,
            workspace,
            sim_workspace: &mut simulation.workspace,
        }
    }

    /// Makes a control step up to the update of the task, without an observation. `instead` may return motor speeds
    /// (rpm) that replace the decoded action of a drone.
    pub(crate) fn advance(
        &mut self,
        action: &[f64],
        mut instead: impl FnMut(usize, &DroneState) -> Option<[f64; 4]>,
    ) -> Result<(), EnvError> {
        self.episode.check_running()?;
        self.check_action(action)?;
        let mut parts = self.parts();
        let dt = parts.sim_model.control_period();
        parts.workspace.decode(parts.model, dt, parts.data, parts.decoders, action.iter().copied());
        let commands = parts.workspace.commands.iter_mut().zip(parts.data.states()).enumerate();
        for (drone, (command, state)) in commands {
            if let Some(speeds) = instead(drone, state) {
                *command = speeds;
            }
        }
        parts.advance()?;
        let updated = parts.update_task();
        if updated.is_err() {
            self.episode.phase = Phase::Over;
        }
        updated
    }

    fn check_action(&self, action: &[f64]) -> Result<(), EnvError> {
        let expected = self.model.action_space.size();
        if action.len() != expected {
            return Err(EnvError::ActionLength { got: action.len(), expected });
        }
        match action.iter().enumerate().find(|(_, x)| !x.is_finite()) {
            Some((index, &got)) => Err(EnvError::Action { index, got, time: self.simulation.time() }),
            None => Ok(()),
        }
    }

    /// Returns true if the time limit of the episode is reached.
    pub(crate) fn is_out_of_time(&self) -> bool {
        self.simulation.control_steps() >= self.model.episode_steps
    }

    /// Returns true after the first step of an episode.
    fn has_stepped(&self) -> bool {
        self.episode.phase != Phase::New && self.simulation.control_steps() > 0
    }

    /// Returns a drone's reward for the last step.
    pub(crate) fn reward_of(&self, drone: usize) -> f64 {
        self.episode.reward_of(self.simulation.view(), drone)
    }
}

/// Borrowed parts of one environment, on which the stages of a control step work. An [`Aviary`] owns all parts. A
/// batch has the model once, the workspaces once per thread, and the rest once per environment.
pub(crate) struct EnvParts<'a, T> {
    pub model: &'a EnvModel,
    pub sim_model: &'a SimModel,
    pub data: &'a mut SimData,
    pub episode: &'a mut Episode<T>,
    pub decoders: &'a mut [ActionDecoder],
    pub workspace: &'a mut EnvWorkspace,
    pub sim_workspace: &'a mut simulation::Workspace,
}

impl<T: Task> EnvParts<'_, T> {
    pub(crate) fn view(&self) -> SimView<'_> {
        SimView::new(self.sim_model, self.data)
    }

    /// Advances the simulation by one control step with the workspace's commands.
    pub(crate) fn advance(&mut self) -> Result<(), EnvError> {
        let Self { sim_model, data, workspace, sim_workspace, .. } = self;
        if let Err(error) = simulation::step(sim_model, sim_workspace, data, &workspace.commands) {
            self.episode.phase = Phase::Over;
            return Err(error.into());
        }
        Ok(())
    }

    /// Updates the task after a control step, moves its markers, and evaluates the end for each drone.
    pub(crate) fn update_task(&mut self) -> Result<(), EnvError> {
        self.episode.task.update(SimView::new(self.sim_model, self.data));
        self.move_markers(false)?;
        let (view, Episode { task, ends, .. }) = (SimView::new(self.sim_model, self.data), &mut *self.episode);
        for (drone, end) in ends.iter_mut().enumerate() {
            *end = task.end(view, drone);
        }
        Ok(())
    }

    /// Returns the outcome of the last control step.
    pub(crate) fn outcome(&self) -> StepOutcome {
        self.episode.outcome(self.view(), self.model.episode_steps)
    }

    /// Writes the observation except its images.
    pub(crate) fn observe_numbers(&mut self) -> Result<(), EnvError> {
        let truth = SimView::new(self.sim_model, self.data);
        let Episode { task, randomizer, .. } = &mut *self.episode;
        let EnvWorkspace { observation, rangefinder, measured, .. } = &mut *self.workspace;
        // a task observes the measured states, not the true ones
        let measured = randomizer.as_ref().and_then(|randomizer| randomizer.measure(self.data, measured));
        let view = measured.map_or(truth, |(states, rpys)| truth.measured(states, rpys));
        if self.model.observation_space.kind.kinematic {
            for (drone, part) in observation.vector.chunks_exact_mut(self.model.block.max(1)).enumerate() {
                task.observe(view, drone, part);
            }
        }
        if self.model.observation_space.kind.adjacency {
            view.adjacency(self.model.neighbourhood_radius, &mut observation.adjacency);
        }
        for (drone, out) in observation.obstacle.iter_mut().enumerate() {
            *out = truth.obstacle_distance(drone).min(Observation::FAR);
        }
        if let Some(rangefinder) = rangefinder {
            let rangefinder = rangefinder.sync(self.sim_model, self.data, Rangefinder::set_obstacles)?;
            rangefinder.measure(truth.states(), &mut observation.ranges)?;
        }
        Ok(())
    }

    /// Renders the images of the onboard cameras into the observation.
    pub(crate) fn observe_images(&mut self) -> Result<(), EnvError> {
        let EnvWorkspace { observation, cameras, moving, .. } = &mut *self.workspace;
        if let Some(cameras) = cameras {
            let cameras = cameras.sync(self.sim_model, self.data, SceneRenderer::set_obstacles)?;
            if !moving.is_empty() {
                cameras.set_markers(&self.data.markers(self.sim_model))?;
            }
            cameras.update(self.data.states())?;
            observation.take_images(cameras, self.model.observation_space.camera_size)?;
        }
        Ok(())
    }
}

impl<T: Task + Clone + Send + Sync> Env for Aviary<T> {
    fn name(&self) -> &'static str {
        self.episode.task.name()
    }

    fn observation_space(&self) -> &ObservationSpace {
        &self.model.observation_space
    }

    fn action_space(&self) -> &BoxSpace {
        &self.model.action_space
    }

    fn reset(&mut self, seed: Option<u64>) -> Result<&Observation, EnvError> {
        self.parts().begin(seed)?;
        let mut parts = self.parts();
        parts.observe_numbers()?;
        parts.observe_images()?;
        Ok(&self.workspace.observation)
    }

    fn step(&mut self, action: &[f64]) -> Result<Step<'_>, EnvError> {
        self.advance(action, |_, _| None)?;
        let StepOutcome { reward, terminated, truncated, end } = self.parts().outcome();
        if let Some(end) = end {
            self.episode.finish(end);
        }
        let mut parts = self.parts();
        parts.observe_numbers()?;
        parts.observe_images()?;
        Ok(Step { observation: &self.workspace.observation, reward, terminated, truncated })
    }

    fn snapshot(&self) -> EnvSnapshot {
        EnvSnapshot::serializable(Snapshot {
            data: self.simulation.snapshot(),
            episode: self.episode.clone(),
            decoders: self.decoders.clone(),
            observation: self.workspace.observation.clone(),
            action_type: self.model.action_type,
        })
    }

    fn restore(&mut self, snapshot: &EnvSnapshot) -> Result<(), EnvError> {
        let read;
        let snapshot = match snapshot.saved() {
            Some(saved) => {
                read = Snapshot::read(saved, &self.episode.task)?;
                &read
            }
            None => snapshot.own::<Snapshot<T>>()?,
        };
        let Snapshot { data, episode, decoders, observation, action_type } = snapshot;
        let has_shape = *action_type == self.model.action_type
            && decoders.len() == self.decoders.len()
            && decoders.iter().zip(&self.decoders).all(|(new, own)| new.is_like(own))
            && episode.ends.len() == self.episode.ends.len()
            && observation.has_sizes_of(&self.workspace.observation);
        if !has_shape {
            return Err(EnvError::Snapshot);
        }
        self.simulation.restore(data)?;
        self.episode.clone_from(episode);
        self.decoders.clone_from(decoders);
        self.workspace.observation.clone_from(observation);
        Ok(())
    }

    fn observation(&self) -> &Observation {
        &self.workspace.observation
    }

    fn info(&self) -> Info {
        self.episode.info(self.simulation.view())
    }

    fn metrics(&self, report: &mut dyn FnMut(&'static str, f64)) {
        if self.episode.phase != Phase::New {
            self.episode.task.metrics(self.simulation.view(), report);
        }
        let batteries = (0..self.simulation.num_drones()).filter_map(|drone| self.simulation.battery(drone));
        let lowest = |a: BatteryState, b: BatteryState| BatteryState {
            charge: a.charge.min(b.charge),
            voltage: a.voltage.min(b.voltage),
            current: a.current.max(b.current),
        };
        if let Some(BatteryState { charge, voltage, current }) = batteries.reduce(lowest) {
            for (name, value) in
                [("battery_charge", charge), ("battery_voltage", voltage), ("battery_current", current)]
            {
                report(name, value);
            }
        }
        if let Some(draw) = self.sampled_params() {
            let first = &draw.drones[0];
            for (name, value) in [
                ("sampled_mass", first.mass),
                ("sampled_inertia", first.inertia),
                ("sampled_arm_length", first.arm_length),
                ("sampled_thrust", first.thrust),
                ("sampled_torque", first.torque),
                ("sampled_lag", first.actuators.lag),
                ("sampled_latency", first.actuators.latency),
                ("sampled_gravity", draw.gravity),
            ] {
                report(name, value);
            }
        }
    }

    fn render(&mut self, view: View, size: ImageSize, rgb: &mut [u8]) -> Result<(), EnvError> {
        // within an episode, the extent does not depend on the state
        let begins = self.renderer.is_none() || self.simulation.control_steps() == 0;
        let extent = if begins { self.extent() } else { Vec::new() };
        let (model, data) = (&self.simulation.model, &self.simulation.data);
        let renderer = match &mut self.renderer {
            Some(renderer) => renderer,
            none => none.insert(Synced::new(SceneRenderer::for_people(model.world())?)),
        };
        let renderer = renderer.sync(model, data, SceneRenderer::set_obstacles)?;
        if begins {
            renderer.keep_in_frame(&extent);
        }
        if !self.workspace.moving.is_empty() {
            renderer.set_markers(&data.markers(model))?;
        }
        renderer.update(data.states())?;
        Ok(renderer.rgb(view, size, rgb)?)
    }
}

impl<T: Task + Clone + Send + Sync> DroneEnv for Aviary<T> {
    fn drone_end(&self, drone: usize) -> Option<EndReason> {
        self.episode.ends[drone]
    }

    fn drone_reward(&self, drone: usize) -> f64 {
        if self.has_stepped() { self.reward_of(drone) } else { 0.0 }
    }

    fn reward_terms(&self, drone: usize) -> Vec<(&'static str, f64)> {
        if self.has_stepped() { self.episode.reward_terms_of(self.simulation.view(), drone) } else { Vec::new() }
    }

    fn gates(&self) -> Vec<[f64; 4]> {
        self.episode.task.gates()
    }

    fn action_type(&self) -> ActionType {
        self.model.action_type
    }

    fn plan(&self, drone: usize) -> Option<Box<dyn Trajectory>> {
        // the task must not be evaluated with options that have not been validated
        if self.episode.task_changed { None } else { self.episode.task.plan(self.simulation.view(), drone) }
    }

    fn plans(&self) -> Vec<Option<Box<dyn Trajectory>>> {
        // the task must not be evaluated with options that have not been validated
        if self.episode.task_changed {
            return (0..self.simulation.num_drones()).map(|_| None).collect();
        }
        self.episode.task.plans(self.simulation.view())
    }

    fn extent(&self) -> Vec<Vector3<f64>> {
        let mut points: Vec<_> = self.simulation.started_from().iter().map(|state| state.position).collect();
        // the task must not be evaluated with options that have not been validated
        if !self.episode.task_changed {
            let seconds = self.model.episode_steps as f64 * self.simulation.control_period();
            for drone in 0..self.simulation.num_drones() {
                points.extend(self.episode.task.extent(self.simulation.view(), drone, seconds));
            }
        }
        points
    }

    fn may_be_constant(&self, entry: usize) -> bool {
        self.episode.task.may_be_constant(entry % self.model.block.max(1))
    }

    fn set_wind(&mut self, wind: Option<WindConfig>) -> Result<(), EnvError> {
        if let Some(wind) = &wind {
            match (&self.episode.next_randomization, &self.episode.randomizer) {
                (Some(next), _) => next.as_ref().map_or(Ok(()), |next| next.validate_wind(wind))?,
                (None, randomizer) => {
                    randomizer.as_ref().map_or(Ok(()), |randomizer| randomizer.validate_wind(wind))?
                }
            }
        }
        let seed = self.episode.rng.with(|rng| rng.next_u64());
        self.simulation.set_wind(wind, seed)?;
        if let Some(randomizer) = &mut self.episode.randomizer {
            randomizer.replace_wind(wind);
        }
        Ok(())
    }

    fn set_external_force(&mut self, drone: usize, force: Vector3<f64>) -> Result<(), EnvError> {
        Ok(self.simulation.set_external_force(drone, force)?)
    }

    fn set_motor_gain(&mut self, drone: usize, motor: usize, gain: f64) -> Result<(), EnvError> {
        Ok(self.simulation.set_motor_gain(drone, motor, gain)?)
    }

    fn set_obstacles(&mut self, obstacles: &[Obstacle]) -> Result<(), EnvError> {
        self.replace_obstacles(obstacles)
    }

    fn new_obstacles(&mut self, seed: u64) -> Result<(), EnvError> {
        let obstacles = self.generate_obstacles(seed)?;
        self.replace_obstacles(&obstacles)
    }

    fn set_randomization(&mut self, randomization: Option<Randomization>) -> Result<(), EnvError> {
        if let Some(config) = &randomization {
            config.validate()?;
            config.validate_batteries(self.simulation.world().drones.iter().map(|drone| &drone.params))?;
            let own = match &self.episode.randomizer {
                Some(randomizer) => randomizer.own_wind(),
                None => self.simulation.wind(),
            };
            own.map_or(Ok(()), |wind| config.validate_wind(wind))?;
        }
        self.episode.next_randomization = Some(randomization.map(Box::new));
        Ok(())
    }

    fn set_task_options(&mut self, options: &TaskOptions) -> Result<(), EnvError> {
        // markers of waypoints and gates are compiled into the scene
        if let Some(option) = options.names().find(|option| !TaskOptions::TARGETS.contains(option)) {
            let got = "set after the environment was built".into();
            return Err(EnvError::Option { option, got, expected: "an option of a new environment" });
        }
        let mut task = self.episode.task.clone();
        task.set_options(options)?;
        let drones: Vec<_> = self.simulation.world().drones.iter().map(|drone| drone.params.clone()).collect();
        task.validate(&drones)?;
        self.episode.task = task;
        Ok(())
    }

    fn task_options(&self) -> TaskOptions {
        self.episode.task.options()
    }

    fn sampled_params(&self) -> Option<&SampledParams> {
        self.episode.randomizer.as_ref().map(|randomizer| &randomizer.draw)
    }

    fn episode_steps(&self) -> u64 {
        self.model.episode_steps
    }

    fn reference(&self, drone: usize) -> Reference {
        if self.episode.task_changed {
            // the task must not be evaluated with options that have not been validated
            let start = &self.simulation.initial_states()[drone];
            return Reference::hover(start.position, start.yaw());
        }
        self.episode.task.reference(self.simulation.view(), drone)
    }

    fn action_of_motor_speeds(&self, speeds: &[[f64; 4]], action: &mut [f64]) -> Result<(), EnvError> {
        if !matches!(self.model.action_type, ActionType::Rpm | ActionType::RawRpm | ActionType::Duty) {
            return Err(EnvError::Option {
                option: "action_type",
                got: self.model.action_type.to_string(),
                expected: "rpm, raw_rpm or duty, which command single motors",
            });
        }
        let expected = self.model.action_space.size();
        if action.len() != expected || speeds.len() * 4 != expected {
            return Err(EnvError::ActionLength { got: action.len().min(4 * speeds.len()), expected });
        }
        let raw = self.model.action_type == ActionType::RawRpm;
        let drones = self.decoders.iter().zip(&self.simulation.world().drones).enumerate();
        for ((part, speeds), (drone, (decoder, nominal))) in action.chunks_exact_mut(4).zip(speeds).zip(drones) {
            let voltage = decoder
                .duty_scale()
                .map(|scale| self.simulation.battery(drone).map_or(scale.voltage(), |battery| battery.voltage));
            for (command, &rpm) in part.iter_mut().zip(speeds) {
                *command = match voltage {
                    Some(voltage) => nominal.params.motors.duty(rpm, voltage),
                    None if raw => rpm,
                    None => decoder.scale().command(rpm),
                };
            }
        }
        Ok(())
    }

    fn simulation(&self) -> &Simulation {
        &self.simulation
    }
}
