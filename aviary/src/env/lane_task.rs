//! Tasks in SIMD lanes: reward, end and observation of eight environments at once, from the lanes of a batch.
//!
//! The built-in tasks have this form next to their scalar one. A batch evaluates flying environments with it and
//! leaves rare events, such as a crash or a reached waypoint, to the scalar form: the lanes only detect that an event
//! is possible.

use flight::tasks::Observation;
use pulp::{Simd, WithSimd};

use super::Task;
use super::randomization::{Sensed, SensorLanes};
use crate::engine::flight::{Lanes, Part, Width};
use crate::math::{LANES, Pack, Real, Row, V3};
use crate::simulation::SimView;
use crate::state::FlightState;

/// Register of lanes that are true or false.
pub(crate) type LaneMask<S> = <Pack<S> as Real>::Mask;

/// Task with a form in SIMD lanes.
///
/// Each drone has [`ROWS`](Self::ROWS) rows: the options and the state of the task that the evaluation reads. While
/// environments fly in lanes, the rows hold the state of the task, and the scalar task is behind.
pub(crate) trait LaneTask: Task {
    /// Number of rows of one drone.
    const ROWS: usize;
    /// True if [`observe_lanes`](Self::observe_lanes) reads attitudes besides roll, pitch and yaw. Otherwise it sees
    /// them without the errors of the sensors.
    const OBSERVES_ATTITUDE: bool;

    /// Writes the rows of a drone from the task, during an episode.
    fn write_rows(&self, simulation: SimView<'_>, drone: usize, rows: &mut [f64]);

    /// Reads the state of a drone from its rows, after at least one step that the lanes have completed. The batch
    /// calls this function for every drone, in order.
    fn read_rows(&mut self, drone: usize, rows: &[f64]);

    /// Evaluates a control step of a drone. Returns its reward without the penalty for a crash, and 1 in lanes where
    /// the scalar task must evaluate the step instead, 0 elsewhere: where a drone may have ended or reached something.
    /// Calls are in the order of the drones. Rows may change here only if a second evaluation of the same step, also
    /// by the scalar task, does not depend on the change.
    fn evaluate<S: Simd>(scene: &LaneScene<'_, S>, drone: usize, rows: &mut TaskRows<'_, S>) -> (Pack<S>, Pack<S>);

    /// Writes the state of the task after a control step to the rows of all drones, in the lanes that have completed
    /// the step, those of the mask.
    #[inline(always)]
    fn complete<S: Simd>(scene: &LaneScene<'_, S>, rows: &mut TaskRows<'_, S>, completed: LaneMask<S>) {
        let _ = (scene, rows, completed);
    }

    /// Writes the observation of a drone.
    fn observe_lanes<S: Simd>(
        scene: &LaneScene<'_, S>,
        drone: usize,
        rows: &mut TaskRows<'_, S>,
        out: &mut LaneRows<'_, S>,
    );
}

/// States of the drones in one register of lanes.
pub(crate) struct LaneScene<'a, S: Simd> {
    part: Part<S>,
    lanes: &'a [Lanes],
    /// Control steps since the start of the episode.
    steps: Pack<S>,
    /// Control rate, Hz.
    rate: f64,
}

impl<S: Simd> LaneScene<'_, S> {
    /// Returns the number of drones.
    #[inline(always)]
    pub fn num_drones(&self) -> usize {
        self.lanes.len()
    }

    /// Returns the state of a drone.
    #[inline(always)]
    pub fn state(&self, drone: usize) -> FlightState<Pack<S>> {
        self.part.motion(&self.lanes[drone])
    }

    /// Returns the position of a drone, world frame, m.
    #[inline(always)]
    pub fn position(&self, drone: usize) -> V3<Pack<S>> {
        self.state(drone).position
    }

    /// Returns the time since the start of the episode, s, as [`SimView::time`] computes it.
    #[inline(always)]
    pub fn time(&self) -> Pack<S> {
        self.steps / self.steps.all(self.rate)
    }

    /// Returns roll, pitch and yaw of a drone, rad.
    #[inline(always)]
    pub fn rpy(&self, drone: usize) -> V3<Pack<S>> {
        self.part.rpy(&self.lanes[drone])
    }
}

/// Rows of the task in all drones, seen through one register.
pub(crate) struct TaskRows<'a, S: Simd> {
    part: Part<S>,
    rows: &'a mut [Row],
    /// Number of rows of one drone.
    size: usize,
}

impl<S: Simd> TaskRows<'_, S> {
    /// Returns the rows of a drone.
    #[inline(always)]
    pub fn drone(&mut self, drone: usize) -> LaneRows<'_, S> {
        LaneRows { part: self.part, rows: &mut self.rows[self.size * drone..][..self.size] }
    }
}

/// Rows of one drone, seen through one register.
pub(crate) struct LaneRows<'a, S: Simd> {
    part: Part<S>,
    rows: &'a mut [Row],
}

impl<S: Simd> LaneRows<'_, S> {
    #[inline(always)]
    pub fn get(&self, index: usize) -> Pack<S> {
        self.part.get(&self.rows[index])
    }

    #[inline(always)]
    pub fn put(&mut self, index: usize, value: Pack<S>) {
        self.part.put(&mut self.rows[index], value);
    }

    #[inline(always)]
    pub fn get3(&self, index: usize) -> V3<Pack<S>> {
        V3::new(self.get(index), self.get(index + 1), self.get(index + 2))
    }
}

impl<S: Simd> Observation<Pack<S>> for LaneRows<'_, S> {
    #[inline(always)]
    fn put(&mut self, entry: usize, value: Pack<S>) {
        self.part.put(&mut self.rows[entry], value);
    }
}

/// A step of one block of environments to evaluate.
pub(crate) struct LaneStep<'a> {
    /// Instruction set.
    pub width: Width,
    /// Number of environments.
    pub count: usize,
    /// Lanes of every drone.
    pub lanes: &'a mut [Lanes],
    /// Rows of the task, drone by drone.
    pub rows: &'a mut [Row],
    /// Control steps since the start of the episode.
    pub steps: &'a Row<u64>,
    /// True for environments whose step the lanes can evaluate.
    pub evaluable: &'a [bool; LANES],
    /// Measured states, if they differ from the true ones.
    pub sensing: Option<Sensing<'a>>,
    /// Length of a control step, s.
    pub period: f64,
    /// Control steps of an episode.
    pub episode_steps: f64,
    /// Entry, smallest and largest number of the observations that single precision would round out of bounds.
    pub bounds: &'a [(usize, f64, f64)],
    /// Receives the reward of every environment.
    pub rewards: &'a mut Row,
    /// Receives a number above 0 for every environment that the scalar task must evaluate.
    pub events: &'a mut Row,
    /// Receives the observation, a row per entry.
    pub observation: &'a mut [Row],
}

/// Measurement of the states of one block.
pub(crate) struct Sensing<'a> {
    /// Errors of the sensors of every drone.
    pub sensors: &'a [SensorLanes],
    /// True if `seen` has the states that the sensors observe, with their latency; otherwise they observe the present
    /// ones.
    pub late: bool,
    /// Receives the measured states.
    pub seen: &'a mut [Lanes],
}

impl Sensing<'_> {
    /// Measures the states of a register.
    #[inline(always)]
    fn measure<S: Simd, const ATTITUDE: bool>(&mut self, part: Part<S>, lanes: &[Lanes], steps: &Row<u64>) {
        for ((sensors, seen), lanes) in self.sensors.iter().zip(&mut *self.seen).zip(lanes) {
            if self.late {
                part.update_rpy(seen);
            }
            let observed = if self.late { &*seen } else { lanes };
            let FlightState { position, attitude, velocity, rate } = part.motion(observed);
            let truth = Sensed { position, attitude, rpy: part.rpy(observed), velocity, rate };
            let (simd, index) = part.register();
            let Sensed { position, attitude: measured, rpy, velocity, rate } =
                sensors.measure(simd, index, steps, &truth);
            let attitude = if ATTITUDE { measured } else { attitude };
            part.put_motion(seen, &FlightState { position, attitude, velocity, rate });
            part.put_rpy(seen, rpy);
        }
    }
}

struct Evaluation<'a, T> {
    step: LaneStep<'a>,
    task: std::marker::PhantomData<T>,
}

impl<T: LaneTask> WithSimd for Evaluation<'_, T> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        let LaneStep { count, lanes, rows, steps, mut sensing, period, episode_steps, bounds, .. } = self.step;
        let LaneStep { evaluable, rewards, events, observation, .. } = self.step;
        let control_steps = steps.map(|step| step as f64);
        let left_out = evaluable.map(|evaluable| if evaluable { 0.0 } else { 1.0 });
        // control rates are integers
        let rate = (1.0 / period).round();
        let block = observation.len() / lanes.len();
        for part in Part::first(simd, count) {
            for lanes in &mut *lanes {
                part.update_rpy(lanes);
            }
            let scene = LaneScene { part, lanes: &*lanes, steps: part.get(&control_steps), rate };
            let (zero, one) = (scene.steps.all(0.0), scene.steps.all(1.0));
            let mut rows = TaskRows { part, rows: &mut *rows, size: T::ROWS };
            let mut event = Real::choose(scene.steps.less(one.all(episode_steps)), part.get(&left_out), one);
            let mut sum = zero;
            for drone in 0..scene.num_drones() {
                let (reward, own_event) = T::evaluate(&scene, drone, &mut rows);
                sum = if drone == 0 { reward } else { sum + reward };
                event = event.greater(own_event);
            }
            T::complete(&scene, &mut rows, event.less(one));
            if let Some(sensing) = &mut sensing {
                // the compiler does not compute what is not used
                if T::OBSERVES_ATTITUDE {
                    sensing.measure::<S, true>(part, lanes, steps);
                } else {
                    sensing.measure::<S, false>(part, lanes, steps);
                }
            }
            let lanes = sensing.as_ref().map_or(&*lanes, |sensing| &*sensing.seen);
            let scene = LaneScene { part, lanes, steps: part.get(&control_steps), rate };
            for drone in 0..scene.num_drones() {
                let mut out = LaneRows { part, rows: &mut observation[block * drone..][..block] };
                T::observe_lanes(&scene, drone, &mut rows, &mut out);
            }
            for &(entry, low, high) in bounds {
                let x = part.get(&observation[entry]);
                part.put(&mut observation[entry], one.all(low).greater(x).lesser(one.all(high)));
            }
            part.put(rewards, sum);
            part.put(events, event);
        }
    }
}

/// SIMD form of a task in a batch. Only the tasks of this crate have one.
pub struct LaneFunctions<T> {
    pub(crate) rows: usize,
    pub(crate) write_rows: fn(&T, SimView<'_>, usize, &mut [f64]),
    pub(crate) read_rows: fn(&mut T, usize, &[f64]),
    pub(crate) evaluate: fn(LaneStep<'_>),
}

impl<T> Clone for LaneFunctions<T> {
    fn clone(&self) -> Self {
        *self
    }
}

impl<T> Copy for LaneFunctions<T> {}

impl<T> std::fmt::Debug for LaneFunctions<T> {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("LaneFunctions").field("rows", &self.rows).finish_non_exhaustive()
    }
}

#[allow(private_bounds)] // only the tasks of this crate
impl<T: LaneTask> LaneFunctions<T> {
    /// Returns the functions of a task.
    pub(crate) fn of() -> Self {
        Self {
            rows: T::ROWS,
            write_rows: T::write_rows,
            read_rows: T::read_rows,
            evaluate: |step| step.width.run(step.count, Evaluation::<T> { step, task: std::marker::PhantomData }),
        }
    }
}
