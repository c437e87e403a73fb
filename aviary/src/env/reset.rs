//! Start of an episode.

use rand::{Rng as _, SeedableRng as _};

use super::episode::Phase;
use super::randomization::Randomizer;
use super::{EnvError, EnvParts, Rng, Task};
use crate::simulation::SimView;

impl<T: Task> EnvParts<'_, T> {
    /// Starts an episode, without an observation.
    pub(crate) fn begin(&mut self, seed: Option<u64>) -> Result<(), EnvError> {
        // a failed reset leaves the environment in this phase
        self.episode.phase = Phase::New;
        let mut rng = match seed {
            Some(seed) => {
                let mut rng = Rng::seed_from_u64(seed);
                rng.set_stream(self.episode.stream);
                rng
            }
            None => self.episode.rng.into(),
        };
        let begun = self.begin_with(&mut rng);
        self.episode.rng = (&rng).into();
        begun
    }

    fn begin_with(&mut self, rng: &mut Rng) -> Result<(), EnvError> {
        let Self { sim_model, data, episode, .. } = &mut *self;
        if std::mem::take(&mut episode.task_changed) {
            let drones: Vec<_> = sim_model.world().drones.iter().map(|drone| drone.params.clone()).collect();
            if let Err(error) = episode.task.validate(&drones) {
                // keeps the task unusable until a reset accepts its options
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
        if !self.model.moves_obstacles() {
            self.restore_obstacles()?;
        }
        if !self.workspace.moving.is_empty() {
            // starts must not depend on the marker poses of the last episode
            self.workspace.moving.place(None::<&T>, true, self.sim_model, self.data)?;
        }
        let moves_obstacles = self.model.moves_obstacles();
        match &mut self.episode.randomizer {
            Some(randomizer) => {
                randomizer.begin(self.sim_model, self.data, rng, moves_obstacles)?;
            }
            None => self.data.reset_unchecked(self.sim_model),
        }
        self.apply_task_start(rng)?;
        if moves_obstacles {
            self.move_obstacles(rng)?;
        }
        if self.view().wind().is_some() {
            self.data.reset_wind(rng.next_u64());
        }
        self.episode.task.reset(SimView::new(self.sim_model, self.data), rng);
        self.move_markers(true)?;
        for decoder in &mut *self.decoders {
            decoder.reset();
        }
        self.episode.ends.fill(None);
        self.episode.end = None;
        self.episode.phase = Phase::Running;
        Ok(())
    }

    /// Lets the task change the initial states. Repeats this up to 20 times while a drone overlaps the floor, an
    /// obstacle or another drone.
    fn apply_task_start(&mut self, rng: &mut Rng) -> Result<(), EnvError> {
        let moves_obstacles = self.model.moves_obstacles();
        let task = &mut self.episode.task;
        let (view, starts) = (SimView::new(self.sim_model, self.data), &mut self.workspace.starts);
        // the new layout of obstacles leaves room for the drones
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

    /// Generates a new layout of the obstacles. If none fits around these starts, uses the first layout.
    fn move_obstacles(&mut self, rng: &mut Rng) -> Result<(), EnvError> {
        let starts: Vec<_> = self.data.states().iter().map(|state| state.position.into()).collect();
        let generator = self.model.obstacle_generator.as_ref();
        let mut obstacles = match generator.map(|generator| generator.generate(&starts, rng)) {
            Some(Ok(obstacles)) => obstacles,
            // independent of earlier episodes
            _ => self.model.first_layout.clone(),
        };
        // moving obstacles follow the others in the list
        let first_moving = self.workspace.moving.first_obstacle();
        obstacles.extend_from_slice(&self.data.obstacles(self.sim_model)[first_moving..]);
        Ok(self.data.set_obstacles(self.sim_model, &obstacles)?)
    }

    /// Moves the task's markers to their present poses. `starts` is true at the start of an episode.
    pub(super) fn move_markers(&mut self, starts: bool) -> Result<(), EnvError> {
        let moving = &self.workspace.moving;
        if moving.is_empty() || !(starts || moving.moves()) {
            return Ok(());
        }
        self.workspace.moving.place(Some(&self.episode.task), starts, self.sim_model, self.data)
    }
}
