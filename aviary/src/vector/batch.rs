use std::sync::PoisonError;

use super::pool::WorkerPool;
use super::shard::{BatchModel, EnvSlot, Environments, ImageSlices, Shard, StepSlices};
use super::worker::Worker;
use super::{Autoreset, OnFault, VecConfig, VecEnv, VecPictures, VecStep};
use crate::control::CollisionCone;
use crate::engine::flight::{Flow, LANES, LaneParams, Lanes, Width};
use crate::engine::{ClearanceCache, Engine, EngineKind, Substeps};
use crate::env::{
    Aviary, AviaryBuilder, BoxSpace, DroneEnv, Env, EnvError, EpisodeSummary, ObservationSpace, Phase, Task,
};
use crate::simulation::{SimData, SimView, Simulation};
use crate::world::Forcing;
use crate::wrappers::VelocityFilter;

/// M environments of one task.
///
/// All options of a single environment are those of the batch: the physics mode, wind, obstacles, randomization, cameras, the task's own.
/// The engine is the hybrid one unless the options say otherwise. Environment i draws from the seed's stream i, so that it is the same
/// as `builder.stream(i)` alone.
///
/// ```
/// use aviary::env::Randomization;
/// use aviary::tasks::Hover;
/// use aviary::vector::{VecAviary, VecBuffers, VecConfig, VecEnv};
///
/// let builder = Hover::builder().randomization(Randomization::default());
/// let mut env = VecAviary::new(builder, VecConfig::new(100))?;
/// let mut buffers = VecBuffers::new(&env);
/// env.reset(Some(7), &mut buffers.observations)?;
/// env.step(&vec![0.0; 400], buffers.step())?;
/// // any of them can be looked at as if it were alone
/// let mass = env.with(3, |env| env.simulation().params(0).mass)?;
/// assert!(mass > 0.02 && mass < 0.04);
/// # use aviary::env::{DroneEnv, Env};
/// # Ok::<(), aviary::env::EnvError>(())
/// ```
#[derive(Debug)]
pub struct VecAviary<T> {
    model: BatchModel,
    config: VecConfig,
    environments: Environments<T>,
    pool: WorkerPool<T>,
    name: &'static str,
    observation_space: ObservationSpace,
    action_space: BoxSpace,
    episode_steps: u64,
    control_period: f64,
    /// Whether every environment has ever begun an episode.
    all_begun: bool,
    /// Steps that were made.
    steps: u64,
    /// Those of the last step, in order.
    found: Vec<(usize, EnvError)>,
}

impl<T: Task + Clone + Send + Sync> VecAviary<T> {
    /// Makes the environments. They must be [reset](VecEnv::reset) before the first step.
    ///
    /// # Errors
    /// [`EnvError`] naming the option that is impossible.
    pub fn new(builder: AviaryBuilder<T>, config: VecConfig) -> Result<Self, EnvError> {
        let count = config.environments;
        if !(1..=VecConfig::MAX_ENVIRONMENTS).contains(&count) {
            return Err(EnvError::Option {
                option: "environments",
                got: count.to_string(),
                expected: "1 to 16,777,216",
            });
        }
        let cores = std::thread::available_parallelism().map_or(1, usize::from);
        let asked = config.threads;
        let threads = if asked == 0 { cores } else { asked };
        if threads > 1024 {
            let got = threads.to_string();
            return Err(EnvError::Option { option: "threads", got, expected: "up to 1024" });
        }
        /// Environments in flight that keep a thread busy for longer than it takes to wake.
        const WORTH_A_THREAD: usize = 256;
        let builder = builder.engine_or(EngineKind::Hybrid);
        let make = || -> Result<Aviary<T>, EnvError> {
            let mut env = builder.clone().build()?;
            env.simulation.data.refresh(&env.simulation.model);
            Ok(env)
        };
        let first = make()?;
        let flies = flies_in_lanes(&first.simulation);
        let space = first.observation_space();
        // images and MuJoCo's steps are worth a thread for every block
        let quick = flies && !space.kind.has_images() && !space.kind.ranges;
        let per_thread = if asked == 0 && quick { WORTH_A_THREAD } else { LANES };
        let threads = threads.min(count.div_ceil(per_thread));
        let model = batch_model(&first, &config, flies);
        let environments = Environments::of(&first, &model, count);
        let (name, episode_steps, control_period) =
            (first.name(), first.episode_steps(), first.simulation.control_period());
        let (observation_space, action_space) = (space.clone(), first.action_space().clone());
        let mut workers = vec![Worker::new(first)];
        while workers.len() < threads {
            workers.push(Worker::new(make()?));
        }
        Ok(Self {
            model,
            config: VecConfig { threads, ..config },
            environments,
            pool: WorkerPool::new(workers)?,
            name,
            observation_space,
            action_space,
            episode_steps,
            control_period,
            all_begun: false,
            steps: 0,
            found: Vec::new(),
        })
    }

    /// Keeps drones apart whatever an agent commands, in every environment as a
    /// [`SafetyWrapper`](crate::wrappers::SafetyWrapper) does; `response` is how fast the controller beneath takes up a
    /// velocity, 1/s.
    ///
    /// # Errors
    /// As for the wrapper.
    pub fn safety(mut self, filter: CollisionCone, response: f64) -> Result<Self, EnvError> {
        for worker in &mut self.pool.workers {
            let worker = worker.get_mut().unwrap_or_else(PoisonError::into_inner);
            let action_type = worker.env.action_type();
            worker.guard = Some(VelocityFilter::new(filter, response, action_type, self.model.drones)?);
        }
        Ok(self)
    }

    /// Returns the number of steps that were made, without those that were refused before anything had moved.
    pub(super) fn steps(&self) -> u64 {
        self.steps
    }

    /// How it was made.
    pub fn config(&self) -> &VecConfig {
        &self.config
    }

    /// Puts an environment where it can be looked at and changed as if it were alone: its task, its wind, its randomization. It
    /// should not be stepped, reset or restored there. Its observation and its contacts are not those of the last step: observations are in the
    /// caller's buffers, contacts were seen by the task.
    ///
    /// # Errors
    /// [`EnvError::NoEnvironment`]; [`EnvError::InBatch`] where it cannot be put there; [`EnvError::Panicked`] where a task, or
    /// `look`, has panicked before.
    pub fn with<R>(&mut self, environment: usize, look: impl FnOnce(&mut Aviary<T>) -> R) -> Result<R, EnvError> {
        let Self { model, environments, pool, .. } = self;
        let count = environments.slots.len();
        if environment >= count {
            return Err(EnvError::NoEnvironment { got: environment, environments: count });
        }
        // a lock, which knows when `look` panics
        let Ok(mut worker) = pool.workers[0].lock() else { return Err(EnvError::Panicked) };
        let env = &mut worker.env;
        let shares = environments.slots[environment].data.is_none();
        if shares {
            let mut data = Box::new(env.simulation.snapshot());
            environments.slices().load(model, environment, &mut data);
            environments.slots[environment].data = Some(data);
        }
        let slot = &mut environments.slots[environment];
        let mut exchange = |env: &mut Aviary<T>| {
            std::mem::swap(&mut env.episode, &mut slot.episode);
            if let Some(data) = &mut slot.data {
                std::mem::swap(&mut env.simulation.data, data);
            }
            if !slot.decoders.is_empty() {
                std::mem::swap(&mut env.decoders, &mut slot.decoders);
            }
        };
        exchange(env);
        let result = look(env);
        exchange(env);
        if let Some(own) = &mut slot.data {
            own.refresh(&env.simulation.model);
        }
        let same = shares && slot.data.as_ref().is_some_and(|own| own.has_parameters_of(&env.simulation.data));
        // what will be drawn at its next reset must not be drawn into the shared data
        let unchanged = same && !slot.episode.is_randomized();
        if !unchanged && environments.lane_params.is_empty() {
            environments.lane_params = model.lane_params.repeat(count.div_ceil(LANES));
        }
        let mut envs = environments.slices();
        envs.store(model, environment, None, Some(&env.simulation));
        envs.forget_clearances(model, environment);
        let slot = &mut envs.slots[environment];
        if unchanged {
            slot.data = None;
        }
        // motors that are slow now need the longer form of the kernel
        if let Some(flow) = &mut model.flow {
            let lag = |data: &SimData| {
                let view = SimView::new(&env.simulation.model, data);
                (0..view.num_drones()).any(|drone| view.actuator_params(drone).lag > 0.0)
            };
            flow.air |= slot.data.as_deref().is_some_and(lag) || slot.episode.is_randomized();
        }
        Ok(result)
    }
}

/// Returns whether an engine's flights can be flown in lanes.
fn flies_in_lanes(simulation: &Simulation) -> bool {
    matches!(simulation.engine(), Engine::Hybrid(engine) if engine.can_fly())
}

fn batch_model<T: Task>(first: &Aviary<T>, config: &VecConfig, flies: bool) -> BatchModel {
    let simulation = &first.simulation;
    let (drones, effects, world) = (simulation.num_drones(), simulation.effects(), simulation.world());
    let lag = (0..drones).any(|drone| simulation.actuator_params(drone).lag > 0.0) || first.episode.is_randomized();
    let space = &first.model.observation_space;
    let numbers = space.vector.size()
        + if space.kind.obstacle { drones } else { 0 }
        + if space.kind.ranges { drones * space.rays.0 } else { 0 }
        + if space.kind.adjacency { drones * drones } else { 0 };
    let pixels = drones * space.camera_size.pixels();
    let on = |on: bool, size: usize| if on { size } else { 0 };
    let kind = space.kind;
    BatchModel {
        drones,
        action_size: first.model.action_space.size(),
        observation_size: numbers,
        autoreset: config.autoreset,
        on_fault: config.on_fault,
        flow: flies.then(|| Flow {
            dt: world.timestep,
            body_fixed: world.forcing == Forcing::BodyFixed,
            medium: world.medium.is_some(),
            air: effects.ground || effects.drag || effects.downwash || lag,
            width: Width::best(),
        }),
        downwash: effects.downwash,
        substeps: simulation.substeps(),
        lane_params: (0..drones).map(|drone| LaneParams::all(&simulation.data.airframe(drone, effects))).collect(),
        images: [on(kind.rgb, 4 * pixels), on(kind.depth, pixels), on(kind.segmentation, pixels)],
    }
}

impl<T: Task + Clone> Environments<T> {
    /// Makes environments like the first one, each with a random stream of its own.
    fn of(first: &Aviary<T>, model: &BatchModel, count: usize) -> Self {
        let (simulation, drones, flies) = (&first.simulation, model.drones, model.flow.is_some());
        let individual = first.episode.is_randomized()
            || first.model.moves_obstacles()
            || !first.workspace.moving.is_empty()
            || !simulation.data.is_nominal();
        let memory = first.decoders.iter().any(|decoder| decoder.has_memory());
        let slot = |index: usize| {
            let mut episode = first.episode.clone();
            episode.set_stream(first.episode.stream.wrapping_add(index as u64));
            EnvSlot {
                episode,
                data: individual.then(|| Box::new(simulation.snapshot())),
                decoders: if memory { first.decoders.clone() } else { Vec::new() },
                control_steps: 0,
                begun: false,
                start_failed: false,
                reward: 0.0,
                summary: None,
                in_mujoco: false,
                fits_lanes: flies && simulation.data.fits_lanes(),
            }
        };
        let blocks = count.div_ceil(LANES);
        let clearance_caches = if flies && !simulation.obstacles().is_empty() { count * drones } else { 0 };
        let mut lanes = vec![Lanes::default(); blocks * drones];
        for (index, lanes) in lanes.iter_mut().enumerate() {
            let state = &simulation.initial_states()[index % drones];
            (0..LANES).for_each(|lane| lanes.set(lane, state, &[0.0; 4], &[0.0; 4]));
        }
        let finals = if model.autoreset == Autoreset::SameStep { model.observation_size * count } else { 0 };
        Self {
            slots: (0..count).map(slot).collect(),
            lanes,
            lane_params: if individual { model.lane_params.repeat(blocks) } else { Vec::new() },
            warm_starts: vec![0.0; 6 * drones * count],
            clearance_caches: vec![ClearanceCache::default(); clearance_caches],
            finals: vec![0.0; finals],
        }
    }
}

fn check_len(what: &'static str, got: usize, expected: usize) -> Result<(), EnvError> {
    if got == expected { Ok(()) } else { Err(EnvError::Buffer { what, got, expected }) }
}

impl<T: Task + Clone + Send + Sync> VecAviary<T> {
    /// Takes what went wrong since the last call; in a step that shall be without a fault, the first one is an error.
    fn take_faults(&mut self, fatal: bool) -> Result<(), EnvError> {
        self.found.clear();
        let faults = self.pool.faults.get_mut().unwrap_or_else(PoisonError::into_inner);
        if faults.is_empty() {
            return Ok(());
        }
        self.found.append(faults);
        self.found.sort_by_key(|(environment, _)| *environment);
        match self.found.first() {
            Some((environment, error)) if fatal => {
                Err(EnvError::InBatch { environment: *environment, error: Box::new(error.clone()) })
            }
            _ => Ok(()),
        }
    }

    /// What would make a step an error, before anything moves.
    fn check_actions(&mut self, actions: &[f32]) -> Result<(), EnvError> {
        let bad = |environment, error| Err(EnvError::InBatch { environment, error: Box::new(error) });
        // a look at every environment is dear beside a step: once all have begun, only those that do not begin by themselves can fail
        if !self.all_begun || self.config.autoreset == Autoreset::Disabled {
            for (environment, slot) in self.environments.slots.iter().enumerate() {
                match slot.episode.phase {
                    Phase::Running => {}
                    Phase::New if !slot.begun => {
                        return bad(environment, EnvError::NeedsReset { when: "on a new environment" });
                    }
                    _ if self.config.autoreset == Autoreset::Disabled => {
                        return bad(environment, EnvError::NeedsReset { when: "after the end of the episode" });
                    }
                    _ => {}
                }
            }
            self.all_begun = true;
        }
        // without an early end, which could not be vectorised
        let has_bad = |chunk: &[f32]| chunk.iter().fold(false, |bad, x| bad | !x.is_finite());
        if !actions.chunks(512).any(has_bad) {
            return Ok(());
        }
        let Some(entry) = actions.iter().position(|x| !x.is_finite()) else { return Ok(()) };
        let (environment, index) = (entry / self.model.action_size, entry % self.model.action_size);
        let slot = &self.environments.slots[environment];
        if slot.awaits_episode() {
            // it will not be looked at; those behind it may be
            let row = |environment: usize| &actions[environment * self.model.action_size..][..self.model.action_size];
            for (environment, slot) in self.environments.slots.iter().enumerate() {
                let bad_entry = row(environment).iter().position(|x| !x.is_finite());
                if let (Some(index), Phase::Running) = (bad_entry, slot.episode.phase) {
                    let (got, time) = (f64::from(row(environment)[index]), self.time_of(slot));
                    return bad(environment, EnvError::Action { index, got, time });
                }
            }
            return Ok(());
        }
        bad(environment, EnvError::Action { index, got: f64::from(actions[entry]), time: self.time_of(slot) })
    }

    fn time_of(&self, slot: &EnvSlot<T>) -> f64 {
        slot.control_steps as f64 * self.control_period
    }
}

impl<T: Task + Clone + Send + Sync> VecEnv for VecAviary<T> {
    fn name(&self) -> &'static str {
        self.name
    }

    fn num_envs(&self) -> usize {
        self.environments.slots.len()
    }

    fn num_threads(&self) -> usize {
        self.pool.workers.len()
    }

    fn observation_space(&self) -> &ObservationSpace {
        &self.observation_space
    }

    fn action_space(&self) -> &BoxSpace {
        &self.action_space
    }

    fn observation_size(&self) -> usize {
        self.model.observation_size
    }

    fn episode_steps(&self) -> u64 {
        self.episode_steps
    }

    fn control_period(&self) -> f64 {
        self.control_period
    }

    fn reset_where(&mut self, mask: &[bool], seed: Option<u64>, observations: &mut [f32]) -> Result<(), EnvError> {
        check_len("mask", mask.len(), self.num_envs())?;
        check_len("observations", observations.len(), self.num_envs() * self.model.observation_size)?;
        let (model, envs) = (&self.model, self.environments.slices());
        let step = StepSlices { observations, ..StepSlices::default() };
        let shard = Shard { first: 0, mask, envs, step, images: ImageSlices::default() };
        self.pool.run(model, shard, &|worker, shard, faults| worker.reset_where(model, shard, seed, faults))?;
        self.take_faults(true)
    }

    fn step(&mut self, actions: &[f32], out: VecStep<'_>) -> Result<(), EnvError> {
        let count = self.num_envs();
        check_len("actions", actions.len(), count * self.model.action_size)?;
        check_len("observations", out.observations.len(), count * self.model.observation_size)?;
        check_len("rewards", out.rewards.len(), count)?;
        check_len("terminated", out.terminated.len(), count)?;
        check_len("truncated", out.truncated.len(), count)?;
        let fatal = self.model.on_fault == OnFault::Error;
        if fatal {
            self.check_actions(actions)?;
        }
        self.steps += 1;
        let VecStep { observations, rewards, terminated, truncated } = out;
        let (model, envs) = (&self.model, self.environments.slices());
        let step = StepSlices { actions, observations, rewards, terminated, truncated };
        let shard = Shard { first: 0, mask: &[], envs, step, images: ImageSlices::default() };
        self.pool.run(model, shard, &|worker, shard, faults| worker.step(model, shard, faults))?;
        self.take_faults(fatal)
    }

    fn pictures(&mut self, out: VecPictures<'_>) -> Result<(), EnvError> {
        let (count, [rgb, depth, objects]) = (self.num_envs(), self.model.images);
        check_len("rgb", out.rgb.len(), count * rgb)?;
        check_len("depth", out.depth.len(), count * depth)?;
        check_len("segmentation", out.segmentation.len(), count * objects)?;
        let images = ImageSlices { rgb: out.rgb, depth: out.depth, segmentation: out.segmentation };
        let (model, envs) = (&self.model, self.environments.slices());
        let shard = Shard { first: 0, mask: &[], envs, step: StepSlices::default(), images };
        self.pool.run(model, shard, &|worker, shard, faults| worker.render(model, shard, faults))?;
        self.take_faults(true)
    }

    fn final_observations(&self) -> &[f32] {
        &self.environments.finals
    }

    fn episode_summary(&self, environment: usize) -> Option<&EpisodeSummary> {
        self.environments.slots.get(environment)?.summary.as_ref()
    }

    fn faults(&self) -> &[(usize, EnvError)] {
        &self.found
    }

    fn with_env(&mut self, environment: usize, look: &mut dyn FnMut(&mut dyn DroneEnv)) -> Result<(), EnvError> {
        self.with(environment, |env| look(env))
    }

    fn bytes_per_env(&self) -> usize {
        self.environments.bytes_per_env()
    }

    fn engine_substeps(&self) -> Substeps {
        let mut sum = Substeps::default();
        for worker in &self.pool.workers {
            let worker = worker.lock().unwrap_or_else(PoisonError::into_inner);
            sum += worker.env.simulation.engine_substeps();
            sum.flight += worker.flown;
        }
        sum
    }
}
