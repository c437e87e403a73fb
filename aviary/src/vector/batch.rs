use std::sync::PoisonError;

use super::actions::Actions;
use super::conditions::{ConditionLanes, Needs};
use super::control_loops::{LoopLanes, read_memories, write_memories};
use super::pool::WorkerPool;
use super::shard::{BatchModel, Block, EnvSlot, Environments, ImageSlices, Shard, StepSlices};
use super::worker::Worker;
use super::{Autoreset, OnFault, VecConfig, VecEnv, VecImages, VecStep};
use crate::action::{ActionDecoder, ActionType};
use crate::control::CollisionCone;
use crate::engine::flight::{Decoding, Flow, LANES, LaneParams, Lanes};
use crate::engine::{ClearanceCache, Engine, EngineKind, Substeps};
use crate::env::{
    Aviary, AviaryBuilder, BoxSpace, DroneEnv, Env, EnvError, Episode, EpisodeSummary, Info, LaneFunctions,
    ObservationSpace, Phase, Task,
};
use crate::observation::{KIN_SIZE, Observation, kinematic};
use crate::physics::battery::BatteryState;
use crate::simulation::{SimData, SimView, Simulation};
use crate::world::Forcing;
use crate::wrappers::VelocityFilter;

/// A batch of M environments of one task.
///
/// The batch accepts all options of a single environment: physics mode, wind, obstacles, randomization, cameras and
/// the options of the task. The default engine is the hybrid engine. Environment i uses the random stream i of the
/// seed and is therefore bit-identical to a single environment built with `builder.stream(i)`.
///
/// The batch decodes actions of every type eight environments at a time in SIMD registers, including their controllers.
/// Only the safety filter ([`safety`](Self::safety)) changes the actions of one environment at a time.
///
/// Environments that fly clear of obstacles advance eight at a time in SIMD registers, and the tasks of this crate are
/// evaluated there, if the observation has no parts other than the vector of the task and no markers move. Otherwise,
/// and for a task of your own, the batch evaluates one environment at a time, which adds about 100 ns to the step of an
/// environment.
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
/// // access one environment as a single environment
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
    /// True if every environment has started an episode.
    all_started: bool,
    /// Number of completed steps.
    steps: u64,
    /// Faults of the last step, in the order of the environments.
    faults: Vec<(usize, EnvError)>,
}

impl<T: Task + Clone + Send + Sync> VecAviary<T> {
    /// Creates the environments. They must be [reset](VecEnv::reset) before the first step.
    ///
    /// # Errors
    /// [`EnvError::Option`] if an option of the batch or of the environment is invalid, and the errors of
    /// [`AviaryBuilder::build`].
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
        let requested = config.threads;
        let threads = if requested == 0 { cores } else { requested };
        if threads > 1024 {
            let got = threads.to_string();
            return Err(EnvError::Option { option: "threads", got, expected: "up to 1024" });
        }
        /// Number of environments in lanes that keeps a thread busy for longer than it takes to wake.
        const WORTH_A_THREAD: usize = 64;
        let builder = builder.engine_or(EngineKind::Hybrid);
        let make = || -> Result<Aviary<T>, EnvError> {
            let mut env = builder.clone().build()?;
            env.simulation.data.refresh(&env.simulation.model);
            Ok(env)
        };
        let first = make()?;
        let flies = flies_in_lanes(&first.simulation);
        let space = first.observation_space();
        // images, rays and MuJoCo steps are slow enough to give every block its own thread
        let quick = flies && !space.kind.has_images() && !space.kind.ranges;
        let per_thread = if requested == 0 && quick { WORTH_A_THREAD } else { LANES };
        let threads = threads.min(count.div_ceil(per_thread));
        let functions = lane_functions(&first, flies);
        let model = batch_model(&first, &config, flies, functions);
        Environments::check_memory(&first, &model, count)?;
        let environments = Environments::of(&first, &model, count);
        let (name, episode_steps, control_period) =
            (first.name(), first.episode_steps(), first.simulation.control_period());
        let (observation_space, action_space) = (space.clone(), first.action_space().clone());
        let mut workers = vec![Worker::new(first, functions)];
        while workers.len() < threads {
            workers.push(Worker::new(make()?, functions));
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
            all_started: false,
            steps: 0,
            faults: Vec::new(),
        })
    }

    /// Applies a velocity filter to the commands of every environment, as a
    /// [`SafetyWrapper`](crate::wrappers::SafetyWrapper) does. The filter solves a quadratic program for one environment
    /// at a time; the controllers that track its velocities run in SIMD registers. `response` is the rate at which the
    /// controller tracks a velocity command, 1/s.
    ///
    /// # Errors
    /// Returns the errors of [`SafetyWrapper::new`](crate::wrappers::SafetyWrapper::new).
    pub fn safety(mut self, filter: CollisionCone, response: f64) -> Result<Self, EnvError> {
        for worker in &mut self.pool.workers {
            let worker = worker.get_mut().unwrap_or_else(PoisonError::into_inner);
            let action_type = worker.env.action_type();
            worker.velocity_filter = Some(VelocityFilter::new(filter, response, action_type, self.model.drones)?);
        }
        Ok(self)
    }

    /// Returns the number of steps, without steps that were rejected before any environment moved.
    pub(super) fn steps(&self) -> u64 {
        self.steps
    }

    /// Returns the configuration. `threads` is the actual number of threads.
    pub fn config(&self) -> &VecConfig {
        &self.config
    }

    /// Calls `look` with one environment as a single environment, for reading and for changes of its task, wind or
    /// randomization. `look` must not step, reset or restore the environment. The environment does not hold the
    /// observation and the contacts of the last step: the caller's buffers hold the observations, and the task has
    /// evaluated the contacts. Unless environments differ in their obstacles,
    /// [`started_from`](crate::simulation::SimView::started_from) returns the present states. The environments of a
    /// batch have no [external forces](DroneEnv::set_external_force).
    ///
    /// # Errors
    /// [`EnvError::NoEnvironment`] for an index outside the batch, and [`EnvError::Panicked`] after a panic in a task or
    /// in `look`. [`EnvError::Option`] if `look` leaves an external force on a drone: the force is removed, and all
    /// other changes stay.
    pub fn with<R>(&mut self, environment: usize, look: impl FnOnce(&mut Aviary<T>) -> R) -> Result<R, EnvError> {
        let Self { model, environments, pool, .. } = self;
        let count = environments.slots.len();
        if environment >= count {
            return Err(EnvError::NoEnvironment { got: environment, environments: count });
        }
        // the lock is poisoned if `look` panics
        let Ok(mut worker) = pool.workers[0].lock() else { return Err(EnvError::Panicked) };
        let functions = worker.functions;
        let env = &mut worker.env;
        let shares = environments.slots[environment].data.is_none();
        if shares {
            // the data of a worker has the sampled parameters of its last environment
            let started = environments.blocks[environment / LANES].started[environment % LANES];
            let mut data = Box::new(if started { env.simulation.snapshot() } else { model.fresh.clone() });
            environments.slices().load(model, &env.simulation.model, environment, &mut data);
            data.forget_start();
            environments.slots[environment].data = Some(data);
        } else {
            environments.slices().load(model, &env.simulation.model, environment, &mut env.simulation.data);
        }
        let before = environments.slots[environment].data.clone().filter(|_| shares);
        environments.slices().load_task(model, functions, environment);
        read_memories(environments.slices().control_memories(model, environment), environment, &mut env.decoders);
        let slot = &mut environments.slots[environment];
        let mut exchange = |env: &mut Aviary<T>| {
            std::mem::swap(&mut env.episode, &mut slot.episode);
            if let Some(data) = &mut slot.data {
                std::mem::swap(&mut env.simulation.data, data);
            }
        };
        exchange(env);
        let result = look(env);
        exchange(env);
        let mut pushed = false;
        if let Some(own) = &mut slot.data {
            pushed = own.clear_external_forces();
            own.refresh(&env.simulation.model);
        }
        let same = |before: &SimData| slot.data.as_ref().is_some_and(|own| own.has_parameters_of(before));
        // the next reset of a changed randomization writes parameters that must not reach the shared data
        let unchanged = before.is_some_and(|before| same(&before)) && slot.episode.shares_randomization(&env.episode);
        if !unchanged && environments.lane_params.is_empty() {
            environments.lane_params = repeated(&model.lane_params, count.div_ceil(LANES));
        }
        if let Some(data) = environments.slots[environment].data.as_deref() {
            let motor_latency = env.simulation.model.motor_latency();
            let needs = Needs::of(&environments.slots[environment].episode, data, model.dt, motor_latency);
            if environments.conditions.needs.and(needs) != environments.conditions.needs {
                environments.conditions.extend(needs, model, environments.blocks.len());
            }
        }
        let mut envs = environments.slices();
        envs.store(model, environment, None, Some(&env.simulation));
        write_memories(envs.control_memories(model, environment), environment, &env.decoders);
        if let Some(data) = envs.slots[environment].data.take() {
            envs.store_task(model, functions, environment, SimView::new(&env.simulation.model, &data));
            envs.slots[environment].data = Some(data);
        }
        envs.forget_clearances(model, environment);
        let slot = &mut envs.slots[environment];
        if unchanged {
            slot.data = None;
        }
        // motor lag and effects of the airframe need the longer forms of the kernel
        if let Some(flow) = &mut model.flow {
            let data = slot.data.as_deref();
            flow.lag |= data.is_some_and(SimData::has_lag) || randomizes_lag(&slot.episode);
            flow.airframe_effects |= data.is_some_and(|data| data.has_airframe_effects(&env.simulation.model));
        }
        if pushed {
            let (got, expected) = ("set in an environment of a batch".into(), "an environment that is not in a batch");
            return Err(EnvError::Option { option: "external_force", got, expected });
        }
        Ok(result)
    }
}

/// Returns the parameters of every block, where all blocks are equal.
fn repeated(lane_params: &[LaneParams], blocks: usize) -> Vec<LaneParams> {
    (0..blocks).flat_map(|_| lane_params).cloned().collect()
}

/// Returns true if the lag of the motors may be sampled.
fn randomizes_lag<T>(episode: &Episode<T>) -> bool {
    episode.randomizations().any(|config| config.draws_actuators())
}

/// Returns true if the engine of a simulation can fly in lanes.
fn flies_in_lanes(simulation: &Simulation) -> bool {
    matches!(simulation.engine(), Engine::Hybrid(engine) if engine.can_fly())
}

/// Returns the SIMD form of the task if the batch can evaluate its environments with it.
fn lane_functions<T: Task>(first: &Aviary<T>, flies: bool) -> Option<LaneFunctions<T>> {
    let kind = first.model.observation_space.kind;
    let only_numbers_of_the_task = kind.kinematic && !kind.adjacency && !kind.obstacle && !kind.ranges;
    let usable = flies && only_numbers_of_the_task && first.workspace.moving.is_empty();
    T::lane_functions().filter(|_| usable)
}

/// Returns the conversion of the numbers of each drone to motor speeds: those of an action, or of its control loops.
fn decoding<T>(first: &Aviary<T>) -> Vec<Decoding> {
    let decoding = |decoder: &ActionDecoder| match (first.model.action_type, decoder.duty_scale()) {
        (ActionType::Rpm | ActionType::OneDRpm, _) => Decoding::Scaled(*decoder.scale()),
        (_, Some(scale)) => Decoding::Duty(*scale),
        _ => Decoding::Raw,
    };
    first.decoders.iter().map(decoding).collect()
}

fn batch_model<T: Task>(
    first: &Aviary<T>,
    config: &VecConfig,
    flies: bool,
    functions: Option<LaneFunctions<T>>,
) -> BatchModel {
    let simulation = &first.simulation;
    let (drones, effects, world) = (simulation.num_drones(), simulation.effects(), simulation.world());
    let lag = simulation.data.has_lag() || randomizes_lag(&first.episode);
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
        keep_observations: config.keep_observations,
        flow: flies.then(|| Flow {
            dt: world.timestep,
            body_fixed: world.forcing == Forcing::BodyFixed,
            medium: world.medium.is_some(),
            lag,
            air: effects.ground || effects.drag || effects.downwash && drones > 1,
            width: config.width,
            airframe_effects: simulation.data.has_airframe_effects(&simulation.model),
        }),
        width: config.width,
        downwash: effects.downwash && drones > 1,
        decoding: decoding(first),
        control_loops: first.decoders.iter().any(ActionDecoder::has_memory),
        action_bounds: {
            let space = &first.model.action_space;
            space.low().iter().zip(space.high()).map(|(&low, &high)| [low, high]).collect()
        },
        one_action: first.model.action_type == ActionType::OneDRpm,
        dt: world.timestep,
        control_period: simulation.control_period(),
        episode_steps: first.model.episode_steps,
        bounds: first.model.row_space.bounds_before_rounding(),
        task_rows: functions.map_or(0, |functions| functions.rows * drones),
        substeps: simulation.substeps(),
        fresh: simulation.snapshot(),
        lane_params: (0..drones)
            .map(|drone| LaneParams::all(&simulation.data.airframe(&simulation.model, drone)))
            .collect(),
        images: [on(kind.rgb, 4 * pixels), on(kind.depth, pixels), on(kind.segmentation, pixels)],
    }
}

impl<T: Task + Clone> Environments<T> {
    /// Checks that the system can allocate the memory of a number of environments.
    fn check_memory(first: &Aviary<T>, model: &BatchModel, count: usize) -> Result<(), EnvError> {
        let fits = |bytes: usize| Vec::<u8>::new().try_reserve_exact(bytes).is_ok();
        let (simulation, blocks) = (&first.simulation, count.div_ceil(LANES));
        let needs = Needs::of(&first.episode, &simulation.data, model.dt, simulation.model.motor_latency());
        // one block determines the size of the others
        let bytes = || Self::of(first, model, LANES).bytes_per_env().saturating_mul(count);
        if fits(needs.delay_bytes(model, blocks)) && (count <= LANES || fits(bytes())) {
            return Ok(());
        }
        Err(EnvError::Option {
            option: "environments",
            got: count.to_string(),
            expected: "a batch that fits in memory: fewer environments or drones, or shorter latencies",
        })
    }

    /// Creates copies of the first environment, each with its own random stream.
    fn of(first: &Aviary<T>, model: &BatchModel, count: usize) -> Self {
        let (simulation, drones) = (&first.simulation, model.drones);
        let flies = model.flow.is_some();
        let randomized = first.episode.is_randomized();
        let individual = first.model.moves_obstacles()
            || !first.workspace.moving.is_empty()
            || randomized && !simulation.obstacles().is_empty();
        let keeps_memory = first.decoders.iter().any(ActionDecoder::keeps_memory);
        let slot = |index: usize| {
            let mut episode = first.episode.clone();
            episode.set_stream(first.episode.stream.wrapping_add(index as u64));
            EnvSlot {
                episode,
                data: individual.then(|| Box::new(simulation.snapshot())),
                wind_seed: simulation.wind_seed(),
                summary: None,
            }
        };
        let blocks = count.div_ceil(LANES);
        // also for environments that do not fly in lanes: between steps the lanes hold the state of their conditions
        let mut conditions = ConditionLanes::default();
        let motor_latency = simulation.model.motor_latency();
        conditions.extend(Needs::of(&first.episode, &simulation.data, model.dt, motor_latency), model, blocks);
        conditions.start_batteries(&simulation.data);
        let clearance_caches = if flies && !simulation.obstacles().is_empty() { count * drones } else { 0 };
        let mut lanes = vec![Lanes::default(); blocks * drones];
        for (index, lanes) in lanes.iter_mut().enumerate() {
            let state = &simulation.initial_states()[index % drones];
            (0..LANES).for_each(|lane| lanes.set(lane, state, &[0.0; 4], &[0.0; 4]));
            if model.downwash {
                lanes.clear_downwash();
            }
        }
        let finals = if model.autoreset == Autoreset::SameStep { count } else { 0 };
        Self {
            slots: (0..count).map(slot).collect(),
            blocks: vec![Block::default(); blocks],
            task_rows: vec![[0.0; LANES]; blocks * model.task_rows],
            lanes,
            conditions,
            lane_params: if individual || randomized { repeated(&model.lane_params, blocks) } else { Vec::new() },
            control_memories: if keeps_memory { vec![LoopLanes::default(); blocks * drones] } else { Vec::new() },
            warm_starts: vec![0.0; 6 * drones * count],
            clearance_caches: vec![ClearanceCache::default(); clearance_caches],
            kept_observations: vec![0.0; model.observation_size * if model.keep_observations { count } else { 0 }],
            finals: vec![0.0; model.observation_size * finals],
            final_infos: vec![None; count],
            final_images: if model.images == [0; 3] { Vec::new() } else { vec![None; finals] },
        }
    }
}

fn check_len(what: &'static str, got: usize, expected: usize) -> Result<(), EnvError> {
    if got == expected { Ok(()) } else { Err(EnvError::Buffer { what, got, expected }) }
}

impl<T: Task + Clone + Send + Sync> VecAviary<T> {
    /// Collects the faults since the last call. Returns the first one as an error if `fatal` is set.
    fn take_faults(&mut self, fatal: bool) -> Result<(), EnvError> {
        self.faults.clear();
        let faults = self.pool.faults.get_mut().unwrap_or_else(PoisonError::into_inner);
        if faults.is_empty() {
            return Ok(());
        }
        self.faults.append(faults);
        self.faults.sort_by_key(|(environment, _)| *environment);
        match self.faults.first() {
            Some((environment, error)) if fatal => {
                Err(EnvError::InBatch { environment: *environment, error: Box::new(error.clone()) })
            }
            _ => Ok(()),
        }
    }

    /// Rejects a step before any environment moves.
    fn check_actions(&mut self, actions: Actions<'_>) -> Result<(), EnvError> {
        let bad = |environment, error| Err(EnvError::InBatch { environment, error: Box::new(error) });
        // the loop over all environments is slow compared with a step, and finds nothing once all have started and
        // reset automatically
        if !self.all_started || self.config.autoreset == Autoreset::Disabled {
            for (environment, slot) in self.environments.slots.iter().enumerate() {
                let block = &self.environments.blocks[environment / LANES];
                match slot.episode.phase {
                    Phase::Running => {}
                    Phase::New if !block.started[environment % LANES] => {
                        return bad(environment, EnvError::NeedsReset { when: "on a new environment" });
                    }
                    _ if self.config.autoreset == Autoreset::Disabled => {
                        return bad(environment, EnvError::NeedsReset { when: "after the end of the episode" });
                    }
                    _ => {}
                }
            }
            self.all_started = true;
        }
        if actions.are_finite() {
            return Ok(());
        }
        let Some(entry) = actions.first_bad() else { return Ok(()) };
        let (environment, index) = (entry / self.model.action_size, entry % self.model.action_size);
        let phase = self.environments.slots[environment].episode.phase;
        if self.environments.blocks[environment / LANES].awaits_episode(environment % LANES, phase) {
            // this environment ignores its action, but the actions of later environments count
            let size = self.model.action_size;
            for (environment, slot) in self.environments.slots.iter().enumerate() {
                let action = actions.slice(size * environment..size * (environment + 1));
                if let (Some(index), Phase::Running) = (action.first_bad(), slot.episode.phase) {
                    let (got, time) = (action.get(index), self.time_of(environment));
                    return bad(environment, EnvError::Action { index, got, time });
                }
            }
            return Ok(());
        }
        bad(environment, EnvError::Action { index, got: actions.get(entry), time: self.time_of(environment) })
    }

    /// Starts an episode in every environment that the mask selects, with the seeds that `seed_of` returns for the
    /// indices of the environments.
    fn reset_with(
        &mut self,
        mask: &[bool],
        seed_of: impl Fn(usize) -> Option<u64> + Sync,
        observations: &mut [f32],
    ) -> Result<(), EnvError> {
        self.faults.clear();
        check_len("mask", mask.len(), self.num_envs())?;
        check_len("observations", observations.len(), self.num_envs() * self.model.observation_size)?;
        let (model, envs) = (&self.model, self.environments.slices());
        let step = StepSlices { observations, ..StepSlices::default() };
        let shard = Shard { first: 0, mask, envs, step, images: ImageSlices::default() };
        self.pool.run(model, shard, &|worker, shard, faults| worker.reset_where(model, shard, &seed_of, faults))?;
        self.take_faults(true)
    }

    /// Advances every environment by one control step.
    fn step_with(&mut self, actions: Actions<'_>, out: VecStep<'_>) -> Result<(), EnvError> {
        self.faults.clear();
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
        let VecStep { observations, rewards, terminated, truncated } = out;
        let (model, envs) = (&self.model, self.environments.slices());
        let step = StepSlices { actions, observations, rewards, terminated, truncated };
        let shard = Shard { first: 0, mask: &[], envs, step, images: ImageSlices::default() };
        self.pool.run(model, shard, &|worker, shard, faults| worker.step(model, shard, faults))?;
        self.steps += 1;
        self.take_faults(fatal)
    }

    fn time_of(&self, environment: usize) -> f64 {
        let steps = self.environments.blocks[environment / LANES].steps[environment % LANES];
        steps as f64 * self.control_period
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
        self.reset_with(mask, |_| seed, observations)
    }

    fn reset_with_seeds(
        &mut self,
        mask: &[bool],
        seeds: &[Option<u64>],
        observations: &mut [f32],
    ) -> Result<(), EnvError> {
        check_len("seeds", seeds.len(), self.num_envs())?;
        self.reset_with(mask, |environment| seeds[environment], observations)
    }

    fn step(&mut self, actions: &[f32], out: VecStep<'_>) -> Result<(), EnvError> {
        self.step_with(Actions::Single(actions), out)
    }

    fn step_f64(&mut self, actions: &[f64], out: VecStep<'_>) -> Result<(), EnvError> {
        self.step_with(Actions::Double(actions), out)
    }

    fn render_images_where(&mut self, mask: &[bool], out: VecImages<'_>) -> Result<(), EnvError> {
        self.faults.clear();
        check_len("mask", mask.len(), self.num_envs())?;
        let (count, [rgb, depth, objects]) = (self.num_envs(), self.model.images);
        check_len("rgb", out.rgb.len(), count * rgb)?;
        check_len("depth", out.depth.len(), count * depth)?;
        check_len("segmentation", out.segmentation.len(), count * objects)?;
        let images = ImageSlices { rgb: out.rgb, depth: out.depth, segmentation: out.segmentation };
        let (model, envs) = (&self.model, self.environments.slices());
        let shard = Shard { first: 0, mask, envs, step: StepSlices::default(), images };
        self.pool.run(model, shard, &|worker, shard, faults| worker.render(model, shard, faults))?;
        self.take_faults(true)
    }

    fn final_observations(&self) -> &[f32] {
        &self.environments.finals
    }

    fn final_images(&self, environment: usize) -> Option<&Observation> {
        self.environments.final_images.get(environment)?.as_deref()
    }

    fn final_info(&self, environment: usize) -> Option<&Info> {
        self.episode_summary(environment)?;
        self.environments.final_infos.get(environment)?.as_ref()
    }

    fn kinematic(&self, environment: usize, drone: usize) -> Option<[f64; KIN_SIZE]> {
        if environment >= self.num_envs() || drone >= self.model.drones {
            return None;
        }
        let lanes = &self.environments.lanes[environment / LANES * self.model.drones + drone];
        let lane = environment % LANES;
        Some(kinematic(&lanes.state(lane), &lanes.command(lane)))
    }

    fn battery(&self, environment: usize, drone: usize) -> Option<BatteryState> {
        if environment >= self.num_envs() || drone >= self.model.drones {
            return None;
        }
        self.environments.conditions.battery(environment / LANES * self.model.drones + drone, environment % LANES)
    }

    fn episode_summary(&self, environment: usize) -> Option<&EpisodeSummary> {
        let slot = self.environments.slots.get(environment)?;
        slot.summary.as_ref().filter(|_| self.environments.blocks[environment / LANES].ended[environment % LANES])
    }

    fn faults(&self) -> &[(usize, EnvError)] {
        &self.faults
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
