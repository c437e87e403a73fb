use std::sync::{Mutex, PoisonError};

use smallvec::SmallVec;

use super::piece::{Common, Desk, Faults, Piece, Worker};
use super::stage::{Ended, Slot, Stage};
use super::threads::Threads;
use super::{Autoreset, OnFault, VecConfig, VecEnv, VecPictures, VecStep};
use crate::control::CollisionCone;
use crate::engine::flight::{Airframes, Flow, LANES, Lanes, Width};
use crate::engine::{EngineKind, Lookout, Substeps};
use crate::env::{Aviary, AviaryBuilder, BoxSpace, Env, EnvError, ObservationSpace, Phase, Task};
use crate::world::Forcing;
use crate::wrappers::Guard;

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
/// # use aviary::env::Env;
/// # Ok::<(), aviary::env::EnvError>(())
/// ```
#[derive(Debug)]
pub struct VecAviary<T> {
    common: Common,
    config: VecConfig,
    seats: Seats<T>,
    crew: Crew<T>,
    name: &'static str,
    observation_space: ObservationSpace,
    action_space: BoxSpace,
    episode_steps: u64,
    control_period: f64,
    /// Whether every environment has ever begun an episode.
    all_begun: bool,
    /// Those of the last step, in order.
    found: Vec<(usize, EnvError)>,
}

/// What a thread works with.
#[derive(Debug)]
struct Place<T> {
    stage: Stage<T>,
    desk: Desk,
    flown: u64,
}

/// The environments.
#[derive(Debug)]
struct Seats<T> {
    slots: Vec<Slot<T>>,
    lanes: Vec<Lanes>,
    frames: Vec<Airframes>,
    warm_starts: Vec<f64>,
    lookouts: Vec<Lookout>,
    finals: Vec<f32>,
}

impl<T> Seats<T> {
    fn piece(&mut self) -> Piece<'_, T> {
        Piece {
            first: 0,
            slots: &mut self.slots,
            lanes: &mut self.lanes,
            frames: &mut self.frames,
            warm_starts: &mut self.warm_starts,
            lookouts: &mut self.lookouts,
            actions: &[],
            mask: &[],
            observations: &mut [],
            finals: &mut self.finals,
            rewards: &mut [],
            terminated: &mut [],
            truncated: &mut [],
            rgb: &mut [],
            depth: &mut [],
            objects: &mut [],
        }
    }
}

impl<T: Task + Clone + Send> VecAviary<T> {
    /// Makes the environments. They must be [reset](VecEnv::reset) before the first step.
    ///
    /// # Errors
    /// [`EnvError`] naming the option that is impossible.
    pub fn new(builder: AviaryBuilder<T>, config: VecConfig) -> Result<Self, EnvError> {
        let count = config.environments;
        if !(1..=VecConfig::MAX_ENVIRONMENTS).contains(&count) {
            return Err(EnvError::Option {
                option: "the number of environments",
                got: count.to_string(),
                expected: "1 to 16,777,216",
            });
        }
        let cores = std::thread::available_parallelism().map_or(1, usize::from);
        let asked = config.threads;
        let threads = if asked == 0 { cores } else { asked };
        if threads > 1024 {
            let got = threads.to_string();
            return Err(EnvError::Option { option: "the number of threads", got, expected: "up to 1024" });
        }
        /// Environments in flight that keep a thread busy for longer than it takes to wake.
        const WORTH_A_THREAD: usize = 256;
        let builder = builder.engine_or(EngineKind::Hybrid);
        let make = || -> Result<Aviary<T>, EnvError> {
            let mut env = builder.clone().build()?;
            env.simulation.refresh();
            Ok(env)
        };
        let first = make()?;
        let simulation = &first.simulation;
        let drones = simulation.num_drones();
        let effects = simulation.effects();
        let flies = Worker::<T>::knows_lanes(simulation.engine());
        let world = simulation.world();
        let lag = (0..drones).any(|drone| simulation.actuator_params(drone).lag > 0.0) || first.episode.is_randomized();
        let space = first.observation_space();
        // pictures and MuJoCo's steps are worth a thread for every block
        let quick = flies && !space.kind.has_images() && !space.kind.ranges;
        let least = if asked == 0 && quick { WORTH_A_THREAD } else { LANES };
        let threads = threads.min(count.div_ceil(least));
        let numbers = space.vector.size()
            + if space.kind.obstacle { drones } else { 0 }
            + if space.kind.ranges { drones * space.rays.0 } else { 0 }
            + if space.kind.adjacency { drones * drones } else { 0 };
        let pixels = drones * space.camera_size.pixels();
        let on = |on: bool, size: usize| if on { size } else { 0 };
        let kind = space.kind;
        let common = Common {
            drones,
            action_size: first.action_space().size(),
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
            frames: (0..drones).map(|drone| Airframes::all(&simulation.equipment().airframe(drone, effects))).collect(),
            pictures: [on(kind.rgb, 4 * pixels), on(kind.depth, pixels), on(kind.segmentation, pixels)],
        };
        let own_obstacles = first.moves_obstacles() || first.has_moving_obstacles();
        let individual = first.episode.is_randomized() || own_obstacles || !simulation.equipment().is_common();
        let memory = first.decoders.iter().any(|decoder| decoder.has_memory());
        let base = first.episode.stream;
        let slot = |index: usize| {
            let mut episode = first.episode.clone();
            episode.set_stream(base.wrapping_add(index as u64));
            let equipment = individual.then(|| {
                let mut equipment = Box::new(simulation.equipment().clone());
                if own_obstacles {
                    equipment.keep_obstacles(&world.obstacles);
                }
                equipment
            });
            Slot {
                episode,
                equipment,
                decoders: if memory { first.decoders.clone() } else { Vec::new() },
                control_steps: 0,
                begun: false,
                start_failed: false,
                reward: 0.0,
                ended: None,
                ends: Default::default(),
                in_mujoco: false,
                plain: flies && simulation.equipment().is_plain(),
            }
        };
        let blocks = count.div_ceil(LANES);
        let lookouts = if flies && !world.obstacles.is_empty() { count * drones } else { 0 };
        let mut lanes = vec![Lanes::default(); blocks * drones];
        for (index, lanes) in lanes.iter_mut().enumerate() {
            let state = &simulation.initial_states()[index % drones];
            (0..LANES).for_each(|lane| lanes.set(lane, state, &[0.0; 4], &[0.0; 4]));
        }
        let seats = Seats {
            slots: (0..count).map(slot).collect(),
            lanes,
            frames: if individual { common.frames.repeat(blocks) } else { Vec::new() },
            warm_starts: vec![0.0; 6 * drones * count],
            lookouts: vec![Lookout::default(); lookouts],
            finals: vec![0.0; if config.autoreset == Autoreset::SameStep { numbers * count } else { 0 }],
        };
        let (name, episode_steps, control_period) = (first.name(), first.episode_steps(), simulation.control_period());
        let (observation_space, action_space) = (space.clone(), first.action_space().clone());
        let mut places = Vec::with_capacity(threads);
        let place = |env| Mutex::new(Place { stage: Stage { env }, desk: Desk::new(drones), flown: 0 });
        places.push(place(first));
        while places.len() < threads {
            places.push(place(make()?));
        }
        let pool = (threads > 1).then(|| Threads::new(threads)).transpose().map_err(|error| EnvError::Option {
            option: "the number of threads",
            got: format!("{threads} ({error})"),
            expected: "no more than the machine gives",
        })?;
        Ok(Self {
            common,
            config: VecConfig { threads, ..config },
            seats,
            crew: Crew { places, pool, faults: Faults::default() },
            name,
            observation_space,
            action_space,
            episode_steps,
            control_period,
            all_begun: false,
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
        for place in &mut self.crew.places {
            let place = place.get_mut().unwrap_or_else(PoisonError::into_inner);
            let action_type = place.stage.env.action_type();
            place.desk.set_guard(Guard::new(filter, response, action_type, self.common.drones)?);
        }
        Ok(self)
    }

    /// How it was made.
    pub fn config(&self) -> &VecConfig {
        &self.config
    }

    /// Puts an environment where it can be looked at and changed as if it were alone: its task, its wind, its randomization. It
    /// should not be stepped or reset there. Its observation and its contacts are not those of the last step: observations are in the
    /// caller's buffers, contacts were seen by the task.
    ///
    /// # Errors
    /// [`EnvError::NoEnvironment`]; [`EnvError::InBatch`] where it cannot be put there; [`EnvError::Panicked`] where a task, or
    /// `look`, has panicked before.
    pub fn with<R>(&mut self, environment: usize, look: impl FnOnce(&mut Aviary<T>) -> R) -> Result<R, EnvError> {
        let Self { common, seats, crew, .. } = self;
        if environment >= seats.slots.len() {
            return Err(EnvError::NoEnvironment { got: environment, environments: seats.slots.len() });
        }
        // a lock, which knows when `look` panics
        let Ok(mut place) = crew.places[0].lock() else { return Err(EnvError::Panicked) };
        let stage = &mut place.stage;
        let slot = &mut seats.slots[environment];
        let common_one = slot.equipment.is_none();
        if common_one {
            let mut equipment = Box::new(stage.env.simulation.equipment().clone());
            // the thread's own are those of whatever environment was there last
            for drone in 0..common.drones {
                let lanes = &seats.lanes[environment / LANES * common.drones + drone];
                equipment.command(drone, &lanes.target(environment % LANES));
            }
            slot.equipment = Some(equipment);
        }
        let entered = stage.enter(&mut seats.piece().seat(common, environment));
        let result = match entered {
            Ok(()) => Ok(look(&mut stage.env)),
            Err(error) => Err(EnvError::InBatch { environment, error: Box::new(error) }),
        };
        let simulation = &mut stage.env.simulation;
        simulation.refresh();
        // while it is here, the thread's own is in its place
        let thread_s = seats.slots[environment].equipment.as_deref();
        let same = common_one && thread_s.is_some_and(|own| own.is_like(simulation.equipment()));
        // what will be drawn at its next reset must not be drawn into the thread's own
        let unchanged = same && !stage.env.episode.is_randomized();
        if !unchanged && seats.frames.is_empty() {
            seats.frames = common.frames.repeat(seats.slots.len().div_ceil(LANES));
        }
        let mut piece = seats.piece();
        stage.leave(&mut piece.seat(common, environment));
        let lookouts = piece.lookouts.iter_mut().skip(common.drones * environment);
        lookouts.take(common.drones).for_each(|lookout| *lookout = Lookout::default());
        let slot = &mut piece.slots[environment];
        if unchanged {
            slot.equipment = None;
        }
        // motors that are slow now need the longer form of the kernel
        if let Some(flow) = &mut common.flow {
            flow.air |= slot.equipment.as_ref().is_some_and(|equipment| equipment.has_lag());
            flow.air |= slot.episode.is_randomized();
        }
        result
    }
}

/// Threads and what they work with.
#[derive(Debug)]
struct Crew<T> {
    places: Vec<Mutex<Place<T>>>,
    pool: Option<Threads>,
    faults: Faults,
}

impl<T: Task + Send> Crew<T> {
    /// Does something with every piece of the batch, on all threads.
    fn run(
        &self,
        common: &Common,
        piece: Piece<'_, T>,
        work: &(impl Fn(&mut Worker<'_, T>, Piece<'_, T>) + Sync),
    ) -> Result<(), EnvError> {
        if self.places.iter().any(Mutex::is_poisoned) {
            return Err(EnvError::Panicked);
        }
        // every place has a share of its own, step after step the same one, which is still in its thread's cache; what others
        // are late with is taken from the far end of theirs, in small pieces
        let (blocks, count) = (piece.slots.len().div_ceil(LANES), self.places.len());
        let grain = blocks.div_ceil(8 * count).max(1);
        let mut shares: SmallVec<[Mutex<Option<Piece<'_, T>>>; 16]> = SmallVec::new();
        let mut rest = piece;
        for place in 0..count {
            let (share, others) = rest.split(common, blocks * (place + 1) / count - blocks * place / count);
            shares.push(Mutex::new(Some(share)));
            rest = others;
        }
        let from = |place: usize, own: bool| {
            let mut share = shares[place].lock().unwrap_or_else(PoisonError::into_inner);
            let piece = share.take()?;
            let blocks = piece.slots.len().div_ceil(LANES);
            let front = if own { grain } else { blocks.saturating_sub(grain) };
            let (front, back) = piece.split(common, front.min(blocks));
            let (taken, left) = if own { (front, back) } else { (back, front) };
            *share = (!left.slots.is_empty()).then_some(left);
            (!taken.slots.is_empty()).then_some(taken)
        };
        let next =
            |place: usize| from(place, true).or_else(|| (1..count).find_map(|by| from((place + by) % count, false)));
        // every place is taken once, by whatever thread, and keeps at it until nothing is left: a task that uses the threads
        // itself may find its thread at another place, never at its own
        let take = |index: usize| {
            let mut place = self.places[index].lock().unwrap_or_else(PoisonError::into_inner);
            let Place { stage, desk, flown } = &mut *place;
            while let Some(piece) = next(index) {
                work(&mut Worker { common, stage, desk, flown, faults: &self.faults }, piece);
            }
        };
        match &self.pool {
            None => take(0),
            Some(pool) => pool.run(|| each(0..self.places.len(), &take)),
        }
        Ok(())
    }
}

/// Something with every index, on as many threads as there are.
fn each(range: std::ops::Range<usize>, act: &(impl Fn(usize) + Sync)) {
    match range.len() {
        0 => {}
        1 => act(range.start),
        count => {
            let middle = range.start + count / 2;
            rayon::join(|| each(range.start..middle, act), || each(middle..range.end, act));
        }
    }
}

fn check(what: &'static str, got: usize, expected: usize) -> Result<(), EnvError> {
    if got == expected { Ok(()) } else { Err(EnvError::Buffer { what, got, expected }) }
}

impl<T: Task + Clone + Send> VecAviary<T> {
    /// Takes what went wrong since the last call; in a step that shall be without a fault, the first one is an error.
    fn take_faults(&mut self, fatal: bool) -> Result<(), EnvError> {
        self.found.clear();
        self.found.append(self.crew.faults.get_mut().unwrap_or_else(PoisonError::into_inner));
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
            for (environment, slot) in self.seats.slots.iter().enumerate() {
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
        let (environment, index) = (entry / self.common.action_size, entry % self.common.action_size);
        let slot = &self.seats.slots[environment];
        if slot.awaits_episode() {
            // it will not be looked at; those behind it may be
            let row = |environment: usize| &actions[environment * self.common.action_size..][..self.common.action_size];
            for (environment, slot) in self.seats.slots.iter().enumerate() {
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

    fn time_of(&self, slot: &Slot<T>) -> f64 {
        slot.control_steps as f64 * self.control_period
    }
}

impl<T: Task + Clone + Send> VecEnv for VecAviary<T> {
    fn name(&self) -> &'static str {
        self.name
    }

    fn num_envs(&self) -> usize {
        self.seats.slots.len()
    }

    fn num_threads(&self) -> usize {
        self.crew.places.len()
    }

    fn observation_space(&self) -> &ObservationSpace {
        &self.observation_space
    }

    fn action_space(&self) -> &BoxSpace {
        &self.action_space
    }

    fn observation_size(&self) -> usize {
        self.common.observation_size
    }

    fn episode_steps(&self) -> u64 {
        self.episode_steps
    }

    fn control_period(&self) -> f64 {
        self.control_period
    }

    fn reset_where(&mut self, mask: &[bool], seed: Option<u64>, observations: &mut [f32]) -> Result<(), EnvError> {
        check("the mask", mask.len(), self.num_envs())?;
        check("the buffer of observations", observations.len(), self.num_envs() * self.common.observation_size)?;
        let piece = Piece { mask, observations, ..self.seats.piece() };
        self.crew.run(&self.common, piece, &|worker, piece| worker.reset(piece, seed))?;
        self.take_faults(true)
    }

    fn step(&mut self, actions: &[f32], out: VecStep<'_>) -> Result<(), EnvError> {
        let count = self.num_envs();
        check("the buffer of actions", actions.len(), count * self.common.action_size)?;
        check("the buffer of observations", out.observations.len(), count * self.common.observation_size)?;
        check("the buffer of rewards", out.rewards.len(), count)?;
        check("the buffer of terminated", out.terminated.len(), count)?;
        check("the buffer of truncated", out.truncated.len(), count)?;
        let fatal = self.common.on_fault == OnFault::Error;
        if fatal {
            self.check_actions(actions)?;
        }
        let VecStep { observations, rewards, terminated, truncated } = out;
        let piece = Piece { actions, observations, rewards, terminated, truncated, ..self.seats.piece() };
        self.crew.run(&self.common, piece, &|worker, piece| worker.step(piece))?;
        self.take_faults(fatal)
    }

    fn pictures(&mut self, out: VecPictures<'_>) -> Result<(), EnvError> {
        let (count, [rgb, depth, objects]) = (self.num_envs(), self.common.pictures);
        check("the buffer of colours", out.rgb.len(), count * rgb)?;
        check("the buffer of depths", out.depth.len(), count * depth)?;
        check("the buffer of objects", out.segmentation.len(), count * objects)?;
        let piece = Piece { rgb: out.rgb, depth: out.depth, objects: out.segmentation, ..self.seats.piece() };
        self.crew.run(&self.common, piece, &|worker, piece| worker.draw(piece))?;
        self.take_faults(true)
    }

    fn final_observations(&self) -> &[f32] {
        &self.seats.finals
    }

    fn ended(&self, environment: usize) -> Option<&Ended> {
        self.seats.slots.get(environment)?.ended.as_ref()
    }

    fn faults(&self) -> &[(usize, EnvError)] {
        &self.found
    }

    fn with_env(&mut self, environment: usize, look: &mut dyn FnMut(&mut dyn Env)) -> Result<(), EnvError> {
        self.with(environment, |env| look(env))
    }

    fn bytes_per_env(&self) -> usize {
        let Seats { slots, lanes, frames, warm_starts, lookouts, finals } = &self.seats;
        let own = |slot: &Slot<T>| slot.equipment.as_ref().map_or(0, |equipment| equipment.bytes());
        let sum = size_of_val(&slots[..])
            + slots.iter().map(own).sum::<usize>()
            + slots.iter().map(|slot| slot.episode.bytes()).sum::<usize>()
            + slots.iter().map(|slot| size_of_val(&slot.decoders[..])).sum::<usize>()
            + size_of_val(&lanes[..])
            + size_of_val(&frames[..])
            + size_of_val(&warm_starts[..])
            + size_of_val(&lookouts[..])
            + size_of_val(&finals[..]);
        sum.div_ceil(slots.len())
    }

    fn engine_substeps(&self) -> Substeps {
        let mut sum = Substeps::default();
        for place in &self.crew.places {
            let place = place.lock().unwrap_or_else(PoisonError::into_inner);
            sum += place.stage.env.simulation.engine_substeps();
            sum.flight += place.flown;
        }
        sum
    }
}
