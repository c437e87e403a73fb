//! Deviations of predictions from a flight, for eight sets of parameters at once in the lanes of SIMD registers.

use flight::airframe::AirframeEffects;
use flight::body::FreeBody;
use flight::rotor::RotorModel;
use pulp::{Simd, WithSimd};

use crate::drone::DroneParams;
use crate::engine::flight::Width;
use crate::flights::dynamics::{Dynamics, FastStep, rotor_speeds, substeps};
use crate::flights::observer::{Estimate, FastSteps, Gain, Observer, RowGains};
use crate::flights::predict::{Inputs, integrate};
use crate::flights::window::{HORIZONS, Window};
use crate::flights::{Flight, FlightError};
use crate::math::{LANES, Pack, Real, Row, Turn, V3};
use crate::state::FlightState;

/// Number of deviations of a prediction at a horizon: position and velocity with the recorded attitude; position,
/// velocity, attitude and body rate with the predicted attitude.
const RECORDED: usize = 6;
const PREDICTED: usize = 12;

/// Number of slow disturbances at the start of a window: along body z, and about the three axes.
const SLOW: usize = 4;

/// Sources of the attitude in the predictions.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Tracks {
    /// Prediction with the recorded attitude.
    pub recorded: bool,
    /// Prediction of the attitude.
    pub predicted: bool,
}

impl Tracks {
    /// Returns the number of deviations of a window.
    pub fn deviations(self, window: &Window) -> usize {
        let horizons = window.is_valid.iter().filter(|is_valid| **is_valid).count();
        SLOW + horizons * (if self.recorded { RECORDED } else { 0 } + if self.predicted { PREDICTED } else { 0 })
    }
}

/// A flight with the windows in which it is compared with predictions.
#[derive(Debug, Clone)]
pub(super) struct FittedFlight {
    pub flight: Flight,
    /// Windows, in the order of time.
    pub windows: Vec<Window>,
    /// Number of physics steps between two rows.
    pub substeps: usize,
    measured: Vec<FlightState<f64>>,
}

impl FittedFlight {
    /// Creates a flight with windows that start every `between` seconds from `first` seconds after its first row. A
    /// window is left out if it starts near a glitch, and a horizon if it ends near one.
    pub fn new(flight: Flight, first: f64, between: f64) -> Self {
        let rows = HORIZONS.map(|horizon| (horizon / flight.step).round() as usize);
        let glitches = flight.glitches();
        let apart = ((between / flight.step).round() as usize).max(1);
        let starts = ((first / flight.step).round() as usize..).step_by(apart);
        let windows = starts
            .take_while(|row| row + rows[HORIZONS.len() - 1] < flight.rows())
            .filter(|row| !glitches[*row])
            .map(|row| {
                let ends = rows.map(|rows| row + rows);
                Window { t0: flight.time(row), row, ends, is_valid: ends.map(|end| !glitches[end]) }
            })
            .collect();
        let measured = (0..flight.rows()).map(|row| FlightState::from(&flight.state(row))).collect();
        let substeps = substeps(&flight);
        Self { flight, windows, substeps, measured }
    }

    /// Returns the number of rows up to the start of the last window.
    pub fn observed_rows(&self) -> usize {
        self.windows.last().map_or(0, |window| window.row + 1)
    }
}

/// Gains and transitions of the estimator, common to all sets of parameters.
#[derive(Debug, Clone)]
pub(super) struct Filter {
    /// Gains of every row.
    pub gains: Vec<RowGains<f64>>,
    /// Transitions over a row and over a physics step.
    pub per_row: FastSteps<f64>,
    pub per_step: FastSteps<f64>,
}

/// Returns the deviations of the predictions of a flight from its measurements, one row per deviation and one lane per
/// set of parameters (at most eight; further lanes are undefined). For every window they are the slow disturbances,
/// then those of the recorded track at every valid horizon, then those of the predicted track.
pub(super) fn deviations(
    fitted: &FittedFlight,
    sets: &[DroneParams],
    filter: &Filter,
    tracks: Tracks,
) -> Result<Vec<Row>, FlightError> {
    let dt = fitted.flight.step / fitted.substeps as f64;
    let mut speeds: Vec<Vec<[f64; 4]>> = Vec::with_capacity(sets.len());
    for params in sets {
        // most parameters do not change the speeds of the rotors
        let same = sets[..speeds.len()].iter().position(|other| other.motors == params.motors);
        let own = same.map_or_else(|| rotor_speeds(params, &fitted.flight), |same| Ok(speeds[same].clone()))?;
        speeds.push(own);
    }
    let lanes: [Dynamics; LANES] = std::array::from_fn(|lane| Dynamics::new(&sets[lane.min(sets.len() - 1)], dt));
    let speeds: [&[[f64; 4]]; LANES] = std::array::from_fn(|lane| &*speeds[lane.min(sets.len() - 1)]);
    let count = fitted.windows.iter().map(|window| tracks.deviations(window)).sum();
    let mut out = vec![[0.0; LANES]; count];
    let job = Job { fitted, lanes: &lanes, speeds: &speeds, filter, tracks };
    Width::best().run(sets.len(), InLanes { job: &job, count: sets.len(), out: &mut out });
    Ok(out)
}

/// Inputs of [`deviations`].
struct Job<'a> {
    fitted: &'a FittedFlight,
    lanes: &'a [Dynamics; LANES],
    speeds: &'a [&'a [[f64; 4]]; LANES],
    filter: &'a Filter,
    tracks: Tracks,
}

struct InLanes<'a> {
    job: &'a Job<'a>,
    count: usize,
    out: &'a mut [Row],
}

impl WithSimd for InLanes<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        for index in 0..self.count.div_ceil(S::F64_LANES) {
            run(&PackLoader { simd, index }, self.job, self.out);
        }
    }
}

/// Converts rows with one number per set of parameters to registers.
trait Loader {
    type Register: Real;

    fn load(&self, row: &Row) -> Self::Register;

    fn store(&self, value: Self::Register, row: &mut Row);

    /// Returns a register with the same number for all sets.
    #[inline(always)]
    fn all(&self, x: f64) -> Self::Register {
        self.load(&[x; LANES])
    }
}

struct PackLoader<S> {
    simd: S,
    /// Index of the register in a row.
    index: usize,
}

impl<S: Simd> Loader for PackLoader<S> {
    type Register = Pack<S>;

    #[inline(always)]
    fn load(&self, row: &Row) -> Pack<S> {
        Pack::load(self.simd, row, self.index)
    }

    #[inline(always)]
    fn store(&self, value: Pack<S>, row: &mut Row) {
        value.store(row, self.index);
    }

    #[inline(always)]
    fn all(&self, x: f64) -> Pack<S> {
        Pack::new(self.simd, self.simd.splat_f64s(x))
    }
}

/// Loads a number of every lane's coefficients.
macro_rules! gathered {
    ($loader:ident, $lanes:ident, $($field:tt)+) => {
        $loader.load(&[
            $lanes[0].$($field)+,
            $lanes[1].$($field)+,
            $lanes[2].$($field)+,
            $lanes[3].$($field)+,
            $lanes[4].$($field)+,
            $lanes[5].$($field)+,
            $lanes[6].$($field)+,
            $lanes[7].$($field)+,
        ])
    };
}

#[inline(always)]
fn dynamics_of<L: Loader>(l: &L, lanes: &[Dynamics; LANES]) -> Dynamics<L::Register> {
    macro_rules! three {
        ($($field:tt)+) => {
            [gathered!(l, lanes, $($field)+[0]), gathered!(l, lanes, $($field)+[1]), gathered!(l, lanes, $($field)+[2])]
        };
    }
    macro_rules! four {
        ($($field:tt)+) => {
            [
                gathered!(l, lanes, $($field)+[0]),
                gathered!(l, lanes, $($field)+[1]),
                gathered!(l, lanes, $($field)+[2]),
                gathered!(l, lanes, $($field)+[3]),
            ]
        };
    }
    Dynamics {
        dt: lanes[0].dt,
        rotors: RotorModel {
            thrust: gathered!(l, lanes, rotors.thrust),
            torque: [four!(rotors.torque[0]), four!(rotors.torque[1]), four!(rotors.torque[2])],
        },
        effects: AirframeEffects {
            linear_drag: three!(effects.linear_drag),
            translational_lift: gathered!(l, lanes, effects.translational_lift),
            velocity_moment: gathered!(l, lanes, effects.velocity_moment),
            rotational_damping: three!(effects.rotational_damping),
            trim_torque: three!(effects.trim_torque),
            momentum_per_rpm: gathered!(l, lanes, effects.momentum_per_rpm),
        },
        body: FreeBody::without_medium(
            gathered!(l, lanes, body.inverse_mass),
            gathered!(l, lanes, body.gravity),
            three!(body.inverse_inertia),
            three!(body.gyration),
        ),
        mass: gathered!(l, lanes, mass),
        inertia: three!(inertia),
    }
}

#[inline(always)]
fn state_of<L: Loader>(l: &L, state: &FlightState<f64>) -> FlightState<L::Register> {
    FlightState {
        position: vector_of(l, &state.position),
        attitude: turn_of(l, &state.attitude),
        velocity: vector_of(l, &state.velocity),
        rate: vector_of(l, &state.rate),
    }
}

#[inline(always)]
fn vector_of<L: Loader>(l: &L, vector: &V3<f64>) -> V3<L::Register> {
    V3::new(l.all(vector.x), l.all(vector.y), l.all(vector.z))
}

#[inline(always)]
fn turn_of<L: Loader>(l: &L, turn: &Turn<f64>) -> Turn<L::Register> {
    Turn { w: l.all(turn.w), v: vector_of(l, &turn.v) }
}

#[inline(always)]
fn fast_of<L: Loader>(l: &L, fast: &FastSteps<f64>) -> FastSteps<L::Register> {
    FastSteps { translation: step_of(l, &fast.translation), rotation: step_of(l, &fast.rotation) }
}

#[inline(always)]
fn step_of<L: Loader>(l: &L, step: &FastStep<f64>) -> FastStep<L::Register> {
    FastStep { level: l.all(step.level), vertical: l.all(step.vertical) }
}

#[inline(always)]
fn gains_of<L: Loader>(l: &L, gains: &RowGains<f64>) -> RowGains<L::Register> {
    let ([level, vertical], [roll_pitch, yaw]) = (&gains.translation, &gains.rotation);
    RowGains {
        translation: [gain_of(l, level), gain_of(l, vertical)],
        rotation: [roll_pitch.map(|x| l.all(x)), yaw.map(|x| l.all(x))],
    }
}

#[inline(always)]
fn gain_of<L: Loader>(l: &L, gain: &Gain) -> Gain<L::Register> {
    let mut registers = [[l.all(0.0); 2]; std::mem::size_of::<Gain>() / std::mem::size_of::<[f64; 2]>()];
    for (registers, numbers) in registers.iter_mut().zip(gain) {
        *registers = [l.all(numbers[0]), l.all(numbers[1])];
    }
    registers
}

/// Writes the components of a vector to the next rows.
#[inline(always)]
fn write<L: Loader>(l: &L, vector: V3<L::Register>, out: &mut std::slice::IterMut<'_, Row>) {
    for component in [vector.x, vector.y, vector.z] {
        if let Some(row) = out.next() {
            l.store(component, row);
        }
    }
}

/// Computes [`deviations`] for the sets of one register.
#[inline(always)]
fn run<L: Loader>(l: &L, job: &Job<'_>, out: &mut [Row]) {
    let Job { fitted, lanes, speeds, filter, tracks } = job;
    let dynamics = dynamics_of(l, lanes);
    let (per_row, per_step) = (fast_of(l, &filter.per_row), fast_of(l, &filter.per_step));
    let count = fitted.substeps;
    let mut registers = Vec::with_capacity(speeds[0].len());
    for step in 0..speeds[0].len() {
        registers.push([
            gathered!(l, speeds, get(step).map_or(0.0, |s| s[0])),
            gathered!(l, speeds, get(step).map_or(0.0, |s| s[1])),
            gathered!(l, speeds, get(step).map_or(0.0, |s| s[2])),
            gathered!(l, speeds, get(step).map_or(0.0, |s| s[3])),
        ]);
    }
    let speeds = registers;
    let mut attitudes = Vec::new();
    if tracks.recorded {
        attitudes.reserve(fitted.measured.len());
        for state in &fitted.measured {
            attitudes.push(turn_of(l, &state.attitude));
        }
    }
    let mut observer = Observer::new(&state_of(l, &fitted.measured[0]));
    let mut observed = 0;
    let mut out = out.iter_mut();
    for window in &fitted.windows {
        while observed < window.row {
            let since = &speeds[observed * count..=(observed + 1) * count];
            observed += 1;
            let measured = state_of(l, &fitted.measured[observed]);
            observer.advance(&dynamics, since, &per_row, &gains_of(l, &filter.gains[observed]), &measured);
        }
        let start = observer.estimate();
        if let Some(row) = out.next() {
            l.store(start.translation.slow.z, row);
        }
        write(l, start.rotation.slow, &mut out);
        let end = window.ends[HORIZONS.len() - 1];
        let speeds = &speeds[window.row * count..=end * count];
        if tracks.recorded {
            let inputs = Inputs { speeds, attitudes: Some(&attitudes[window.row..=end]), substeps: count };
            predict::<L, false>(l, job, window, (&dynamics, &per_step, start), &inputs, &mut out);
        }
        if tracks.predicted {
            let inputs = Inputs { speeds, attitudes: None, substeps: count };
            predict::<L, true>(l, job, window, (&dynamics, &per_step, start), &inputs, &mut out);
        }
    }
}

/// Dynamics, decay of the fast disturbances, and start of a prediction.
type Start<'a, R> = (&'a Dynamics<R>, &'a FastSteps<R>, &'a Estimate<R>);

/// Writes the deviations of one prediction.
#[inline(always)]
fn predict<L: Loader, const WITH_ATTITUDE: bool>(
    l: &L,
    job: &Job<'_>,
    window: &Window,
    (dynamics, fast, start): Start<'_, L::Register>,
    inputs: &Inputs<'_, L::Register>,
    out: &mut std::slice::IterMut<'_, Row>,
) {
    let mut horizon = 0;
    integrate(
        dynamics,
        fast,
        start,
        inputs,
        #[inline(always)]
        |row, state| {
            if window.row + row != window.ends[horizon] {
                return;
            }
            if window.is_valid[horizon] {
                let measured = state_of(l, &job.fitted.measured[window.row + row]);
                write(l, state.position - measured.position, out);
                write(l, state.velocity - measured.velocity, out);
                if WITH_ATTITUDE {
                    let turn = state.attitude.turn_to(&measured.attitude);
                    let sign = l.all(2.0).with_sign_of(turn.w);
                    write(l, turn.v * sign, out);
                    write(l, state.rate - measured.rate, out);
                }
            }
            horizon += 1;
        },
    );
}
