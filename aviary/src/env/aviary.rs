use nalgebra::Vector3;
use rand::{Rng as _, SeedableRng as _};

use super::moving::MovingMarkers;
use super::randomization::Randomizer;
use super::{BoxSpace, Draw, EndReason, Env, EnvError, Info, ObservationSpace, Randomization, Rng, Step, Task};
use crate::action::{ActionDecoder, ActionType};
use crate::control::Reference;
use crate::control::trajectory::Trajectory;
use crate::observation::Observation;
use crate::physics::wind::WindConfig;
use crate::sensing::Rangefinder;
use crate::simulation::Simulation;
use crate::state::DroneState;
use crate::vision::{ImageSize, Painter, View};
use crate::world::{Obstacle, ObstacleConfig};

/// A task made into an environment.
///
/// ```
/// use aviary::env::Env;
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
    pub(crate) simulation: Simulation,
    /// In a batch, that of one environment after the other.
    pub(crate) episode: Episode<T>,
    pub(super) action_type: ActionType,
    /// What makes motor speeds of actions.
    pub(crate) decoders: Vec<ActionDecoder>,
    pub(super) observation_space: ObservationSpace,
    /// Bounds of a row of [`write_numbers`](Self::write_numbers).
    pub(super) row_space: BoxSpace,
    pub(super) action_space: BoxSpace,
    pub(super) episode_steps: u64,
    /// Obstacles that are placed at random.
    pub(super) field: Option<ObstacleConfig>,
    /// Markers of the task that move.
    pub(super) moving: MovingMarkers,
    /// Where they were when the scene was compiled.
    pub(super) first_layout: Vec<Obstacle>,
    pub(super) rangefinder: Option<Rangefinder>,
    /// How the last step ended for each drone.
    pub(super) ends: Vec<Option<EndReason>>,
    /// Numbers in one drone's part of the observation.
    pub(super) block: usize,
    pub(super) neighbourhood_radius: f64,
    pub(super) observation: Observation,
    /// Draws the onboard cameras, where they are observed.
    pub(super) cameras: Option<Painter>,
    /// Draws for people, once they ask.
    pub(super) painter: Option<Painter>,
    /// The action within its bounds.
    pub(super) clipped: Vec<f64>,
    pub(crate) commands: Vec<[f64; 4]>,
    /// Where an episode starts.
    pub(super) starts: Vec<DroneState>,
}

/// What an environment has for itself beside its simulation: the task with what it remembers, its random numbers, what was drawn.
#[derive(Debug, Clone)]
pub(crate) struct Episode<T> {
    pub task: T,
    pub rng: Rng,
    /// Which of a seed's streams it draws from.
    pub stream: u64,
    /// Whether the task's options may have changed since they were checked.
    pub task_changed: bool,
    pub(super) randomizer: Option<Box<Randomizer>>,
    /// What was said about randomization since the last reset.
    pub(super) next_randomization: Option<Option<Box<Randomization>>>,
    pub phase: Phase,
    /// Why the episode ended.
    pub end: Option<EndReason>,
}

impl<T> Episode<T> {
    pub(super) fn new(task: T, stream: u64, randomizer: Option<Randomizer>) -> Self {
        let mut rng = Rng::seed_from_u64(0);
        rng.set_stream(stream);
        Self {
            task,
            rng,
            stream,
            task_changed: false,
            randomizer: randomizer.map(Box::new),
            next_randomization: None,
            phase: Phase::New,
            end: None,
        }
    }

    /// Draws from another of the seed's streams from now on.
    pub(crate) fn set_stream(&mut self, stream: u64) {
        self.stream = stream;
        self.rng.set_stream(stream);
    }

    /// Bytes that it takes on the heap, but for the task's own.
    pub(crate) fn bytes(&self) -> usize {
        self.randomizer.as_ref().map_or(0, |randomizer| randomizer.bytes())
    }

    /// Whether something is drawn for every episode.
    pub(crate) fn is_randomized(&self) -> bool {
        self.randomizer.is_some() || self.next_randomization.is_some()
    }
}

/// What a control step brought.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Verdict {
    pub reward: f64,
    pub terminated: bool,
    pub truncated: bool,
    /// Why the episode is over, if it is.
    pub end: Option<EndReason>,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Phase {
    New,
    Running,
    Over,
}

impl<T: Task> Aviary<T> {
    /// The task.
    pub fn task(&self) -> &T {
        &self.episode.task
    }

    /// The task, to be changed between episodes. What only building an environment looks at (the number of drones, initial
    /// positions, markers) stays as it is. The episode is over with it, and the next
    /// reset checks what was changed.
    pub fn task_mut(&mut self) -> &mut T {
        (self.episode.task_changed, self.episode.phase) = (true, Phase::New);
        &mut self.episode.task
    }

    /// A drone's own part of the observation's vector; empty where the observation type has none, and for a drone that is not
    /// there.
    pub fn observation_of(&self, drone: usize) -> &[f64] {
        self.observation.vector.get(drone * self.block..(drone + 1) * self.block).unwrap_or_default()
    }

    pub(crate) fn observe(&mut self) -> Result<(), EnvError> {
        self.observe_numbers()?;
        self.observe_pictures()
    }

    /// Everything that is no picture.
    pub(crate) fn observe_numbers(&mut self) -> Result<(), EnvError> {
        let Episode { task, randomizer, .. } = &mut self.episode;
        // a task reads the simulation's states: for what is seen, they are what the sensors say
        let mut measured = randomizer.as_mut().and_then(|randomizer| randomizer.measure(&self.simulation));
        if let Some(states) = &mut measured {
            self.simulation.swap_states(states);
        }
        if self.observation_space.kind.kinematic {
            for (drone, part) in self.observation.vector.chunks_exact_mut(self.block.max(1)).enumerate() {
                task.observe(&self.simulation, drone, part);
            }
        }
        if self.observation_space.kind.adjacency {
            self.simulation.adjacency(self.neighbourhood_radius, &mut self.observation.adjacency);
        }
        if let Some(states) = &mut measured {
            self.simulation.swap_states(states);
        }
        for (drone, out) in self.observation.obstacle.iter_mut().enumerate() {
            *out = self.simulation.obstacle_distance(drone).min(Observation::FAR);
        }
        if let Some(rangefinder) = &mut self.rangefinder {
            rangefinder.measure(self.simulation.states(), &mut self.observation.ranges)?;
        }
        Ok(())
    }

    /// What the onboard cameras see.
    pub(crate) fn observe_pictures(&mut self) -> Result<(), EnvError> {
        if self.cameras.is_some() {
            // in a batch, those of whatever environment was drawn last
            self.move_markers()?;
        }
        if let Some(painter) = &mut self.cameras {
            if !self.moving.is_empty() {
                painter.set_markers(&self.simulation.world().markers)?;
            }
            painter.update(self.simulation.states())?;
            self.observation.take_pictures(painter, self.observation_space.camera_size)?;
        }
        Ok(())
    }

    /// How the last step ended for every drone.
    pub(crate) fn ends(&self) -> &[Option<EndReason>] {
        &self.ends
    }

    /// Says how the episode has ended for every drone; empty while it runs.
    pub(crate) fn set_ends(&mut self, ends: &[Option<EndReason>]) {
        self.ends.fill(None);
        self.ends.iter_mut().zip(ends).for_each(|(end, &of_drone)| *end = of_drone);
    }

    /// Bounds of actions.
    pub(crate) fn space_of_actions(&self) -> &BoxSpace {
        &self.action_space
    }

    /// What was observed last.
    pub(crate) fn seen(&self) -> &Observation {
        &self.observation
    }

    /// Copies everything that is no picture into a row of single precision, within its bounds.
    pub(crate) fn write_numbers(&self, row: &mut [f32]) {
        let Observation { vector, obstacle, ranges, adjacency, .. } = &self.observation;
        let (first, rest) = row.split_at_mut(vector.len());
        first.iter_mut().zip(vector).for_each(|(out, &x)| *out = x as f32);
        if !rest.is_empty() {
            let others = obstacle.iter().chain(ranges).map(|&x| x as f32);
            let others = others.chain(adjacency.iter().map(|&near| f32::from(u8::from(near))));
            rest.iter_mut().zip(others).for_each(|(out, x)| *out = x);
        }
        self.row_space.round_inside(row);
    }

    /// Whether every episode has its obstacles elsewhere.
    pub(crate) fn moves_obstacles(&self) -> bool {
        self.field.as_ref().is_some_and(|field| field.new_layout)
    }

    /// Brings everything that looks at obstacles up to date with the simulation's.
    pub(crate) fn follow_obstacles(&mut self) -> Result<(), EnvError> {
        let obstacles = &self.simulation.world().obstacles;
        for painter in [&mut self.cameras, &mut self.painter].into_iter().flatten() {
            painter.set_obstacles(obstacles)?;
        }
        if let Some(rangefinder) = &mut self.rangefinder {
            rangefinder.set_obstacles(obstacles)?;
        }
        Ok(())
    }

    /// Draws another layout of the obstacles, in place: the scene stays compiled. Where none can be found about these starts,
    /// it is the first one.
    fn move_obstacles(&mut self) -> Result<(), EnvError> {
        let starts: Vec<_> = self.simulation.states().iter().map(|state| state.position.into()).collect();
        let layout = self.field.as_ref().map(|field| field.generate(&starts, &mut self.episode.rng));
        let mut obstacles = match layout {
            Some(Ok(obstacles)) => obstacles,
            // the same for every history
            _ => self.first_layout.clone(),
        };
        // those that move come after the others
        obstacles.extend_from_slice(&self.simulation.world().obstacles[self.moving.first_obstacle()..]);
        self.simulation.set_obstacles(&obstacles)?;
        self.follow_obstacles()
    }

    /// Whether the task has markers that drones collide with: every environment of a batch has its own obstacles then.
    pub(crate) fn has_moving_obstacles(&self) -> bool {
        self.moving.has_solid()
    }

    /// Puts the markers that move where the task says.
    fn move_markers(&mut self) -> Result<(), EnvError> {
        if self.moving.is_empty() {
            return Ok(());
        }
        if self.moving.place(Some(&self.episode.task), &mut self.simulation)? {
            self.follow_obstacles()?;
        }
        Ok(())
    }

    /// Lets the task change what the episode starts from. A start in the floor, in an obstacle or in another drone is drawn anew,
    /// up to twenty times.
    fn start_as_the_task_says(&mut self) -> Result<(), EnvError> {
        let moving = self.moves_obstacles();
        let Self { simulation, episode: Episode { task, rng, .. }, starts, .. } = self;
        for _ in 0..20 {
            starts.copy_from_slice(simulation.states());
            if !task.start(simulation, rng, starts) {
                return Ok(());
            }
            // those that move make room for the drones
            if simulation.has_room(starts, !moving) {
                break;
            }
        }
        Ok(simulation.reset_to(starts)?)
    }

    /// Starts an episode, without looking at it.
    pub(crate) fn begin(&mut self, seed: Option<u64>) -> Result<(), EnvError> {
        // until all of it has gone well
        self.episode.phase = Phase::New;
        if let Some(seed) = seed {
            self.episode.rng = Rng::seed_from_u64(seed);
            self.episode.rng.set_stream(self.episode.stream);
        }
        if std::mem::take(&mut self.episode.task_changed) {
            let drones: Vec<_> = self.simulation.world().drones.iter().map(|drone| drone.params.clone()).collect();
            if let Err(error) = self.episode.task.check(&drones) {
                // until it is one that can be flown
                self.episode.task_changed = true;
                return Err(error);
            }
        }
        if let Some(next) = self.episode.next_randomization.take() {
            if let Some(old) = self.episode.randomizer.take() {
                old.undo(&mut self.simulation)?;
            }
            let wind = self.simulation.wind().copied();
            let next = next.map(|config| Randomizer::new(*config, &self.simulation, wind)).transpose()?;
            self.episode.randomizer = next.map(Box::new);
        }
        if !self.moving.is_empty() {
            // starts do not depend on where the last episode left them
            if self.moving.place(None, &mut self.simulation)? {
                self.follow_obstacles()?;
            }
        }
        let moving = self.moves_obstacles();
        match &mut self.episode.randomizer {
            Some(randomizer) => randomizer.begin(&mut self.simulation, &mut self.episode.rng, moving)?,
            None => self.simulation.reset()?,
        }
        self.start_as_the_task_says()?;
        if self.moves_obstacles() {
            self.move_obstacles()?;
        }
        if self.simulation.wind().is_some() {
            let seed = self.episode.rng.next_u64();
            self.simulation.reset_wind(seed);
        }
        self.episode.task.reset(&self.simulation, &mut self.episode.rng);
        self.move_markers()?;
        for decoder in &mut self.decoders {
            decoder.reset();
        }
        self.ends.fill(None);
        self.episode.end = None;
        self.episode.phase = Phase::Running;
        Ok(())
    }

    /// One control step, without looking at what it brought: states, the task, how it ended for each drone. `instead` may
    /// give motor speeds (rpm) for a drone in place of what the action says.
    pub(crate) fn advance(
        &mut self,
        action: &[f64],
        mut instead: impl FnMut(usize, &DroneState) -> Option<[f64; 4]>,
    ) -> Result<(), EnvError> {
        self.check_running()?;
        self.check_action(action)?;
        self.decode(action.iter().copied());
        for (drone, (command, state)) in self.commands.iter_mut().zip(self.simulation.states()).enumerate() {
            if let Some(speeds) = instead(drone, state) {
                *command = speeds;
            }
        }
        self.fly()?;
        let looked = self.look();
        if looked.is_err() {
            self.episode.phase = Phase::Over;
        }
        looked
    }

    /// Whether a step may be made.
    pub(crate) fn check_running(&self) -> Result<(), EnvError> {
        match self.episode.phase {
            Phase::Running => Ok(()),
            Phase::New => Err(EnvError::NeedsReset { when: "on a new environment" }),
            Phase::Over => Err(EnvError::NeedsReset { when: "after the end of the episode" }),
        }
    }

    /// Moves the simulation by one control step under the commands.
    pub(crate) fn fly(&mut self) -> Result<(), EnvError> {
        if let Err(error) = self.simulation.step(&self.commands) {
            self.episode.phase = Phase::Over;
            return Err(error.into());
        }
        Ok(())
    }

    /// Lets the task look at a control step, and puts its markers where they are now.
    fn look(&mut self) -> Result<(), EnvError> {
        self.episode.task.update(&self.simulation);
        self.move_markers()?;
        let task = &self.episode.task;
        for (drone, end) in self.ends.iter_mut().enumerate() {
            *end = task.end(&self.simulation, drone);
        }
        Ok(())
    }

    /// What a control step brought for an agent of all drones.
    ///
    /// # Errors
    /// [`EnvError::Option`] for a marker that the task puts nowhere.
    pub(crate) fn judge(&mut self) -> Result<Verdict, EnvError> {
        self.look()?;
        Ok(self.verdict())
    }

    fn verdict(&self) -> Verdict {
        // one lost drone ends the episode, and so do all that have completed their part
        let crash = self.ends.iter().flatten().copied().find(|end| end.is_crash());
        let lost = crash.or(self.ends.iter().flatten().copied().find(|&end| end != EndReason::Completed));
        let completed = self.ends.iter().all(|&end| end == Some(EndReason::Completed));
        let end = lost.or(completed.then_some(EndReason::Completed));
        let (terminated, truncated) = (end.is_some(), self.is_out_of_time());
        let reward = (0..self.ends.len()).map(|drone| self.reward_of(drone)).sum();
        Verdict { reward, terminated, truncated, end: end.or(truncated.then_some(EndReason::TimeLimit)) }
    }

    /// Whether all drones fulfil the task at this moment.
    pub(crate) fn is_success(&self, end: Option<EndReason>) -> bool {
        let lost = end.is_some_and(EndReason::is_crash);
        !lost && (0..self.ends.len()).all(|drone| self.episode.task.success(&self.simulation, drone))
    }

    /// Whether the time of the episode is over.
    pub(crate) fn is_out_of_time(&self) -> bool {
        self.simulation.control_steps() >= self.episode_steps
    }

    /// Ends the episode.
    pub(crate) fn finish(&mut self, end: EndReason) {
        self.episode.end = Some(end);
        self.episode.phase = Phase::Over;
    }

    /// A drone's reward for the last step.
    pub(crate) fn reward_of(&self, drone: usize) -> f64 {
        self.episode.task.reward(&self.simulation, drone, self.ends[drone])
    }

    fn check_action(&self, action: &[f64]) -> Result<(), EnvError> {
        let expected = self.action_space.size();
        if action.len() != expected {
            return Err(EnvError::ActionLength { got: action.len(), expected });
        }
        match action.iter().enumerate().find(|(_, x)| !x.is_finite()) {
            Some((index, &got)) => Err(EnvError::Action { index, got, time: self.simulation.time() }),
            None => Ok(()),
        }
    }

    /// Makes motor speeds of an action.
    pub(crate) fn decode(&mut self, action: impl Iterator<Item = f64>) {
        let bounds = self.action_space.low().iter().zip(self.action_space.high());
        for ((clipped, x), (&low, &high)) in self.clipped.iter_mut().zip(action).zip(bounds) {
            *clipped = x.clamp(low, high);
        }
        let dt = self.simulation.control_period();
        let drones = self.decoders.iter_mut().zip(self.simulation.states());
        let parts = self.clipped.chunks_exact(self.action_type.size());
        for ((command, (decoder, state)), part) in self.commands.iter_mut().zip(drones).zip(parts) {
            *command = decoder.motor_speeds(dt, state, part);
        }
    }
}

impl<T: Task> Env for Aviary<T> {
    fn name(&self) -> &'static str {
        self.episode.task.name()
    }

    fn observation_space(&self) -> &ObservationSpace {
        &self.observation_space
    }

    fn action_space(&self) -> &BoxSpace {
        &self.action_space
    }

    fn reset(&mut self, seed: Option<u64>) -> Result<&Observation, EnvError> {
        self.begin(seed)?;
        self.observe()?;
        Ok(&self.observation)
    }

    fn step(&mut self, action: &[f64]) -> Result<Step<'_>, EnvError> {
        self.advance(action, |_, _| None)?;
        let Verdict { reward, terminated, truncated, end } = self.verdict();
        if let Some(end) = end {
            self.finish(end);
        }
        self.observe()?;
        Ok(Step { observation: &self.observation, reward, terminated, truncated })
    }

    fn observation(&self) -> &Observation {
        &self.observation
    }

    fn info(&self) -> Info {
        let (simulation, count) = (&self.simulation, self.simulation.num_drones());
        // options that nobody has checked are not asked for anything
        let asked = if self.episode.task_changed { 0 } else { count };
        let position_error =
            (0..asked).map(|drone| simulation.distance(drone, &self.reference(drone).position)).fold(0.0, f64::max);
        let started = self.episode.phase != Phase::New;
        Info {
            time: simulation.time(),
            success: started && self.is_success(self.episode.end),
            progress: if started {
                (0..count).map(|drone| self.episode.task.progress(simulation, drone)).sum::<f64>() / count as f64
            } else {
                0.0
            },
            end: self.episode.end,
            position_error,
            contacts: simulation.contacts().len(),
        }
    }

    fn measures(&self, report: &mut dyn FnMut(&'static str, f64)) {
        if self.episode.phase != Phase::New {
            self.episode.task.measures(&self.simulation, report);
        }
        if let Some(draw) = self.draw() {
            let first = &draw.drones[0];
            for (name, value) in [
                ("drawn_mass", first.mass),
                ("drawn_inertia", first.inertia),
                ("drawn_arm_length", first.arm_length),
                ("drawn_thrust", first.thrust),
                ("drawn_torque", first.torque),
                ("drawn_lag", first.actuators.lag),
                ("drawn_latency", first.actuators.latency),
                ("drawn_gravity", draw.gravity),
            ] {
                report(name, value);
            }
        }
    }

    fn drone_end(&self, drone: usize) -> Option<EndReason> {
        self.ends[drone]
    }

    fn drone_reward(&self, drone: usize) -> f64 {
        let stepped = self.episode.phase != Phase::New && self.simulation.control_steps() > 0;
        if stepped { self.reward_of(drone) } else { 0.0 }
    }

    fn action_type(&self) -> ActionType {
        self.action_type
    }

    fn plan(&self, drone: usize) -> Option<Box<dyn Trajectory>> {
        self.episode.task.plan(&self.simulation, drone)
    }

    fn plans(&self) -> Vec<Option<Box<dyn Trajectory>>> {
        self.episode.task.plans(&self.simulation)
    }

    fn extent(&self) -> Vec<Vector3<f64>> {
        let mut points: Vec<_> = self.simulation.started_from().iter().map(|state| state.position).collect();
        // options that nobody has checked are not asked for anything
        if !self.episode.task_changed {
            let seconds = self.episode_steps as f64 * self.simulation.control_period();
            for drone in 0..self.simulation.num_drones() {
                points.extend(self.episode.task.extent(&self.simulation, drone, seconds));
            }
        }
        points
    }

    fn may_be_constant(&self, entry: usize) -> bool {
        self.episode.task.may_be_constant(entry % self.block.max(1))
    }

    fn set_wind(&mut self, wind: Option<WindConfig>) -> Result<(), EnvError> {
        if let Some(wind) = &wind {
            match (&self.episode.next_randomization, &self.episode.randomizer) {
                (Some(next), _) => next.as_ref().map_or(Ok(()), |next| next.check_wind(wind))?,
                (None, randomizer) => randomizer.as_ref().map_or(Ok(()), |randomizer| randomizer.check_wind(wind))?,
            }
        }
        let seed = self.episode.rng.next_u64();
        Ok(self.simulation.set_wind(wind, seed)?)
    }

    fn set_randomization(&mut self, randomization: Option<Randomization>) -> Result<(), EnvError> {
        if let Some(config) = &randomization {
            config.validate()?;
            let own = match &self.episode.randomizer {
                Some(randomizer) => randomizer.own_wind(),
                None => self.simulation.wind(),
            };
            own.map_or(Ok(()), |wind| config.check_wind(wind))?;
        }
        self.episode.next_randomization = Some(randomization.map(Box::new));
        Ok(())
    }

    fn draw(&self) -> Option<&Draw> {
        self.episode.randomizer.as_ref().map(|randomizer| &randomizer.draw)
    }

    fn episode_steps(&self) -> u64 {
        self.episode_steps
    }

    fn reference(&self, drone: usize) -> Reference {
        if self.episode.task_changed {
            // options that nobody has checked are not asked for anything
            let start = &self.simulation.initial_states()[drone];
            return Reference::hover(start.position, start.yaw());
        }
        self.episode.task.reference(&self.simulation, drone)
    }

    fn action_of_motor_speeds(&self, speeds: &[[f64; 4]], action: &mut [f64]) -> Result<(), EnvError> {
        if !matches!(self.action_type, ActionType::Rpm | ActionType::RawRpm) {
            return Err(EnvError::Option {
                option: "the action type",
                got: self.action_type.to_string(),
                expected: "rpm or raw_rpm, which command single motors",
            });
        }
        let expected = self.action_space.size();
        if action.len() != expected || speeds.len() * 4 != expected {
            return Err(EnvError::ActionLength { got: action.len().min(4 * speeds.len()), expected });
        }
        let raw = self.action_type == ActionType::RawRpm;
        for ((part, speeds), decoder) in action.chunks_exact_mut(4).zip(speeds).zip(&self.decoders) {
            for (command, &rpm) in part.iter_mut().zip(speeds) {
                *command = if raw { rpm } else { decoder.scale().command(rpm) };
            }
        }
        Ok(())
    }

    fn render(&mut self, view: View, size: ImageSize, rgb: &mut [u8]) -> Result<(), EnvError> {
        // what is asked of the task does not change with the state, once the episode has begun
        let begins = self.painter.is_none() || self.simulation.control_steps() == 0;
        let extent = if begins { self.extent() } else { Vec::new() };
        let painter = match &mut self.painter {
            Some(painter) => painter,
            none => none.insert(Painter::for_people(self.simulation.world())?),
        };
        if begins {
            painter.keep_in_frame(&extent);
        }
        if !self.moving.is_empty() {
            painter.set_markers(&self.simulation.world().markers)?;
        }
        painter.update(self.simulation.states())?;
        Ok(painter.rgb(view, size, rgb)?)
    }

    fn simulation(&self) -> &Simulation {
        &self.simulation
    }
}
