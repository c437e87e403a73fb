//! The stages of an episode and of a control step, over borrowed parts: one environment has them together in an
//! [`Aviary`](super::Aviary), a batch has the model and a workspace per thread, and data per environment.

use rand::{Rng as _, SeedableRng as _};

use super::episode::{Episode, Phase, StepOutcome};
use super::moving::MovingMarkers;
use super::randomization::Randomizer;
use super::{BoxSpace, EnvError, ObservationSpace, Rng, Task};
use crate::action::{ActionDecoder, ActionType};
use crate::observation::Observation;
use crate::sensing::Rangefinder;
use crate::simulation::{self, SimData, SimModel, SimView};
use crate::state::DroneState;
use crate::vision::SceneRenderer;
use crate::world::{Obstacle, ObstacleConfig};

/// What all environments of a batch share, besides the [`SimModel`].
#[derive(Debug)]
pub(crate) struct EnvModel {
    pub action_type: ActionType,
    pub action_space: BoxSpace,
    pub observation_space: ObservationSpace,
    /// Bounds of a row of [`EnvWorkspace::write_row`].
    pub row_space: BoxSpace,
    pub episode_steps: u64,
    /// Obstacles that are placed at random.
    pub obstacle_generator: Option<ObstacleConfig>,
    /// Where they were when the scene was compiled.
    pub first_layout: Vec<Obstacle>,
    /// Numbers in one drone's part of the observation.
    pub block: usize,
    pub neighbourhood_radius: f64,
}

impl EnvModel {
    /// Returns whether every episode has its obstacles elsewhere.
    pub(crate) fn moves_obstacles(&self) -> bool {
        self.obstacle_generator.as_ref().is_some_and(|generator| generator.new_layout)
    }
}

/// Scratch memory of one thread, besides the simulation's.
#[derive(Debug)]
pub(crate) struct EnvWorkspace {
    /// Markers of the task that move.
    pub moving: MovingMarkers,
    pub rangefinder: Option<Synced<Rangefinder>>,
    /// Renders the onboard cameras, where they are observed.
    pub cameras: Option<Synced<SceneRenderer>>,
    /// What was observed last.
    pub observation: Observation,
    /// The action within its bounds.
    pub clipped: Vec<f64>,
    /// Motor speeds, rpm.
    pub commands: Vec<[f64; 4]>,
    /// Where an episode starts.
    pub starts: Vec<DroneState>,
}

/// Something with obstacles of its own, and the revision of those it has.
#[derive(Debug)]
pub(crate) struct Synced<V> {
    pub value: V,
    revision: u64,
}

impl<V> Synced<V> {
    /// Made from the scene of the model.
    pub(crate) fn new(value: V) -> Self {
        Self { value, revision: 0 }
    }

    /// Returns it after `set` has given it the present obstacles, where they are others than its own.
    pub(crate) fn sync<E>(
        &mut self,
        model: &SimModel,
        data: &SimData,
        set: impl FnOnce(&mut V, &[Obstacle]) -> Result<(), E>,
    ) -> Result<&mut V, E> {
        if self.revision != data.obstacle_revision() {
            set(&mut self.value, data.obstacles(model))?;
            self.revision = data.obstacle_revision();
        }
        Ok(&mut self.value)
    }
}

impl EnvWorkspace {
    /// Copies everything observed that is no image into a row of single precision, within its bounds.
    pub(crate) fn write_row(&self, model: &EnvModel, row: &mut [f32]) {
        let Observation { vector, obstacle, ranges, adjacency, .. } = &self.observation;
        let (first, rest) = row.split_at_mut(vector.len());
        first.iter_mut().zip(vector).for_each(|(out, &x)| *out = x as f32);
        if !rest.is_empty() {
            let others = obstacle.iter().chain(ranges).map(|&x| x as f32);
            let others = others.chain(adjacency.iter().map(|&near| f32::from(u8::from(near))));
            rest.iter_mut().zip(others).for_each(|(out, x)| *out = x);
        }
        model.row_space.round_inside(row);
    }

    /// Decodes an action to motor speeds in `commands`, after clipping it to its bounds.
    pub(crate) fn decode(
        &mut self,
        model: &EnvModel,
        control_period: f64,
        states: &[DroneState],
        decoders: &mut [ActionDecoder],
        action: impl Iterator<Item = f64>,
    ) {
        let bounds = model.action_space.low().iter().zip(model.action_space.high());
        for ((clipped, x), (&low, &high)) in self.clipped.iter_mut().zip(action).zip(bounds) {
            *clipped = x.clamp(low, high);
        }
        let drones = decoders.iter_mut().zip(states);
        let parts = self.clipped.chunks_exact(model.action_type.size());
        for ((command, (decoder, state)), part) in self.commands.iter_mut().zip(drones).zip(parts) {
            *command = decoder.motor_speeds(control_period, state, part);
        }
    }
}

/// One environment with everything that an episode needs.
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

    /// Starts an episode, without observing it.
    pub(crate) fn begin(&mut self, seed: Option<u64>) -> Result<(), EnvError> {
        let Self { sim_model, data, episode, .. } = self;
        // until all of it has gone well
        episode.phase = Phase::New;
        if let Some(seed) = seed {
            episode.rng = Rng::seed_from_u64(seed);
            episode.rng.set_stream(episode.stream);
        }
        if std::mem::take(&mut episode.task_changed) {
            let drones: Vec<_> = sim_model.world().drones.iter().map(|drone| drone.params.clone()).collect();
            if let Err(error) = episode.task.check(&drones) {
                // until it is one that can be flown
                episode.task_changed = true;
                return Err(error);
            }
        }
        if let Some(next) = episode.next_randomization.take() {
            if let Some(old) = episode.randomizer.take() {
                old.undo(sim_model, data)?;
            }
            let view = SimView::new(sim_model, data);
            let next = next.map(|config| Randomizer::new(*config, view, view.wind().copied())).transpose()?;
            episode.randomizer = next.map(Box::new);
        }
        if !self.workspace.moving.is_empty() {
            // starts do not depend on where the last episode left them
            self.workspace.moving.place(None::<&T>, self.sim_model, self.data)?;
        }
        let moves_obstacles = self.model.moves_obstacles();
        match &mut self.episode.randomizer {
            Some(randomizer) => {
                randomizer.begin(self.sim_model, self.data, &mut self.episode.rng, moves_obstacles)?;
            }
            None => self.data.reset(self.sim_model),
        }
        self.start_as_the_task_says()?;
        if moves_obstacles {
            self.move_obstacles()?;
        }
        if self.view().wind().is_some() {
            let seed = self.episode.rng.next_u64();
            self.data.reset_wind(seed);
        }
        self.episode.task.reset(SimView::new(self.sim_model, self.data), &mut self.episode.rng);
        self.move_markers()?;
        for decoder in &mut *self.decoders {
            decoder.reset();
        }
        self.episode.ends.fill(None);
        self.episode.end = None;
        self.episode.phase = Phase::Running;
        Ok(())
    }

    /// Lets the task change what the episode starts from. A start in the floor, in an obstacle or in another drone is drawn again, up to
    /// twenty times.
    fn start_as_the_task_says(&mut self) -> Result<(), EnvError> {
        let moves_obstacles = self.model.moves_obstacles();
        let Episode { task, rng, .. } = &mut *self.episode;
        let (view, starts) = (SimView::new(self.sim_model, self.data), &mut self.workspace.starts);
        // those that move make room for the drones
        let obstacles = if moves_obstacles { &[] } else { view.obstacles() };
        for _ in 0..20 {
            starts.copy_from_slice(view.states());
            if !task.start(view, rng, starts) {
                return Ok(());
            }
            if self.sim_model.has_room(starts, obstacles) {
                break;
            }
        }
        Ok(self.data.reset_to(starts)?)
    }

    /// Draws another layout of the obstacles. Where none can be found about these starts, it is the first one.
    fn move_obstacles(&mut self) -> Result<(), EnvError> {
        let starts: Vec<_> = self.data.states().iter().map(|state| state.position.into()).collect();
        let generator = self.model.obstacle_generator.as_ref();
        let mut obstacles = match generator.map(|generator| generator.generate(&starts, &mut self.episode.rng)) {
            Some(Ok(obstacles)) => obstacles,
            // the same for every history
            _ => self.model.first_layout.clone(),
        };
        // those that move come after the others
        let first_moving = self.workspace.moving.first_obstacle();
        obstacles.extend_from_slice(&self.data.obstacles(self.sim_model)[first_moving..]);
        Ok(self.data.set_obstacles(self.sim_model, &obstacles)?)
    }

    /// Moves the markers that move to where the task says.
    fn move_markers(&mut self) -> Result<(), EnvError> {
        if self.workspace.moving.is_empty() {
            return Ok(());
        }
        self.workspace.moving.place(Some(&self.episode.task), self.sim_model, self.data)
    }

    /// Decodes an action to the workspace's commands.
    pub(crate) fn decode(&mut self, action: impl Iterator<Item = f64>) {
        let (dt, states) = (self.sim_model.control_period(), self.data.states());
        self.workspace.decode(self.model, dt, states, self.decoders, action);
    }

    /// Advances the simulation by one control step under the workspace's commands.
    pub(crate) fn advance(&mut self) -> Result<(), EnvError> {
        let Self { sim_model, data, workspace, sim_workspace, .. } = self;
        if let Err(error) = simulation::step(sim_model, sim_workspace, data, &workspace.commands) {
            self.episode.phase = Phase::Over;
            return Err(error.into());
        }
        Ok(())
    }

    /// Updates the task after a control step, moves its markers, and asks how the step ended for each drone.
    pub(crate) fn update_task(&mut self) -> Result<(), EnvError> {
        self.episode.task.update(SimView::new(self.sim_model, self.data));
        self.move_markers()?;
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

    /// Observes everything that is no image.
    pub(crate) fn observe_numbers(&mut self) -> Result<(), EnvError> {
        let truth = SimView::new(self.sim_model, self.data);
        let Episode { task, randomizer, .. } = &mut *self.episode;
        let EnvWorkspace { observation, rangefinder, .. } = &mut *self.workspace;
        // a task observes what the sensors measure
        let measured = randomizer.as_mut().and_then(|randomizer| randomizer.measure(self.data));
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

    /// Renders what the onboard cameras see.
    pub(crate) fn observe_images(&mut self) -> Result<(), EnvError> {
        let EnvWorkspace { observation, cameras, moving, .. } = &mut *self.workspace;
        if let Some(cameras) = cameras {
            let cameras = cameras.sync(self.sim_model, self.data, SceneRenderer::set_obstacles)?;
            if !moving.is_empty() {
                cameras.set_markers(&self.data.markers(self.sim_model))?;
            }
            cameras.update(self.data.states())?;
            observation.take_pictures(cameras, self.model.observation_space.camera_size)?;
        }
        Ok(())
    }
}
