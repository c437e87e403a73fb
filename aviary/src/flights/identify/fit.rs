//! The stages of the identification.

use nalgebra::{DMatrix, DVector};

use super::align::{Alignment, MIN_MOTOR_SHIFT, align, shift_motors, significant};
use super::parameters::{PARAMETERS, Role, Stage};
use super::problem::{Problem, Weights, filters};
use super::propagate::{Filter, FittedFlight, Tracks};
use super::solve::{Residuals, minimize};
use super::statistics::{Estimate, Information, jackknife};
use super::{FittedParameter, Identification, IdentifyOptions, LeftOut, Status, Unidentified};
use crate::drone::{DroneParams, YawConvention};
use crate::flights::compare::compare_any;
use crate::flights::{AttitudeSource, Flight, FlightError, HORIZONS, Window};

/// First start of a window after the first row of a flight, s. The estimator settles before it.
const FIRST_START: f64 = 2.0;

/// Time between the starts of windows, s.
const BETWEEN_STARTS: f64 = 0.25;

/// Relative change of the cost at which a stage of the fit, and the last fit, ends.
const STAGE_TOLERANCE: f64 = 1e-3;
const TOLERANCE: f64 = 1e-9;

/// Largest number of fits of the motion with a new trim, or with newly aligned motors.
const MAX_ROUNDS: usize = 5;

/// Largest standard error of an identifiable parameter, as a part of its scale.
const MAX_ERROR: f64 = 0.5;

/// Largest change of a value if a flight is left out, as a multiple of its scale.
const MAX_CHANGE: f64 = 10.0;

/// Number of standard errors by which an additional parameter differs from its default.
const SIGNIFICANCE: f64 = 3.0;

/// Number of flights from which the jackknife over flights is a standard error.
const JACKKNIFE_FLIGHTS: usize = 4;

/// Returns the indices of the basic parameters of a stage.
fn basic(stage: Stage) -> Vec<usize> {
    let is_basic = |index: &usize| PARAMETERS[*index].stage == stage && PARAMETERS[*index].role == Role::Basic;
    (0..PARAMETERS.len()).filter(is_basic).collect()
}

const RECORDED: Tracks = Tracks { recorded: true, predicted: false };
const PREDICTED: Tracks = Tracks { recorded: false, predicted: true };
const BOTH: Tracks = Tracks { recorded: true, predicted: true };
const NEITHER: Tracks = Tracks { recorded: false, predicted: false };

/// Returns the airframe from which the fit starts: the mass and the dimensions of `base`, ideal air, and motors that
/// hover at the mean duty and voltage of the flights.
fn initial(base: &DroneParams, flights: &[Flight]) -> DroneParams {
    let (mut rows, mut drive, mut volts) = (0.0, 0.0, 0.0);
    for flight in flights {
        let duty = flight.duty.as_deref().unwrap_or_default();
        for (row, duty) in duty.iter().enumerate() {
            let voltage = flight.voltage.as_ref().map_or(base.motors.voltage, |voltage| voltage[row]);
            drive += 0.25 * duty.iter().sum::<f64>() * voltage;
            volts += voltage;
            rows += 1.0;
        }
    }
    let mut params = base.clone();
    params.motors.speed_at_zero = 0.0;
    params.motors.speed_per_volt = base.hover_rpm() * rows / f64::max(drive, 1e-6 * rows);
    params.motors.voltage = (volts / rows * 1e3).round() * 1e-3;
    params.motors.rise_time = 0.05;
    params.motors.fall_time = 0.05;
    params.motors.latency = 0.03;
    params.motors.rotor_inertia = 0.0;
    params.center_of_mass = [0.0; 2];
    params.air = Default::default();
    params.air.linear_drag = [0.3 * params.mass; 3];
    params.inertia[1] = params.inertia[0];
    params.air.rotational_damping = params.inertia.map(|inertia| 10.0 * inertia);
    // the linear drag of the flights contains the blade drag
    params.drag_coefficients = [0.0; 3];
    params
}

/// Flights with the state of the fit.
struct Fit<'a> {
    options: &'a IdentifyOptions,
    flights: Vec<FittedFlight>,
    weights: Weights,
    airframe: DroneParams,
    evaluations: usize,
}

impl Fit<'_> {
    fn problem<'b>(&'b self, fitted: &'b [usize], tracks: Tracks, filters: &'b [Filter]) -> Problem<'b> {
        Problem { flights: &self.flights, airframe: &self.airframe, fitted, tracks, filters, weights: &self.weights }
    }

    /// Fits some parameters and returns half the sum of the squared residuals.
    fn run(&mut self, fitted: &[usize], tracks: Tracks, tolerance: f64) -> f64 {
        let filters = filters(&self.options.observer, &self.airframe, &self.flights);
        let problem = self.problem(fitted, tracks, &filters);
        let minimum = minimize(&problem, &problem.values(&self.airframe), &problem.scales(), tolerance);
        let airframe = problem.airframe(&minimum.parameters);
        self.airframe = airframe;
        self.evaluations += minimum.evaluations;
        minimum.cost
    }

    /// Returns the cost of an airframe.
    fn cost(&self, airframe: &DroneParams, tracks: Tracks) -> f64 {
        let filters = filters(&self.options.observer, airframe, &self.flights);
        let problem = Problem { airframe, ..self.problem(&[], tracks, &filters) };
        problem.residuals(&[]).iter().map(|x| 0.5 * x * x).sum()
    }

    /// Sets numbers below their smallest valid ones to these, and returns the other parameters.
    fn keep_inside(&mut self, fitted: &[usize]) -> Vec<usize> {
        let mut inside = Vec::new();
        for &index in fitted {
            if bound(&mut self.airframe, index) {
                inside.push(index);
            }
        }
        inside
    }

    /// Selects parameters from candidates, sets the other additional ones to their defaults, and fits the selected
    /// ones. Other basic parameters stay as they are: their values fit these flights, as others would.
    fn solve(&mut self, candidates: &[usize], tracks: Tracks, defaults: &DroneParams) -> (Group, Vec<Dropped>) {
        let parts = self.information(candidates, tracks);
        let (mut free, dropped) = select(&parts, candidates, &self.airframe, defaults);
        for (index, _) in dropped.iter().filter(|(index, _)| PARAMETERS[*index].role == Role::Additional) {
            // the present values of these parameters are noise
            (PARAMETERS[*index].set)(&mut self.airframe, (PARAMETERS[*index].get)(defaults));
        }
        let mut cost;
        loop {
            cost = self.run(&free, tracks, TOLERANCE);
            let inside = self.keep_inside(&free);
            if inside.len() == free.len() {
                break;
            }
            free = inside;
        }
        (Group { free, cost }, dropped)
    }

    /// Returns the sums of the least-squares problem of some parameters, for every flight.
    fn information(&self, fitted: &[usize], tracks: Tracks) -> Vec<Information> {
        let filters = filters(&self.options.observer, &self.airframe, &self.flights);
        let problem = self.problem(fitted, tracks, &filters);
        let (residuals, derivatives) = problem.jacobian(&problem.values(&self.airframe));
        let jacobian = DMatrix::from_vec(residuals.len(), fitted.len(), derivatives);
        let residuals = DVector::from_vec(residuals);
        let (blocks, owners) = problem.blocks();
        // the flights have blocks of their own
        let mut first = 0;
        (0..self.flights.len())
            .map(|flight| {
                let count = blocks[first..].iter().take_while(|block| owners[**block] == flight).count();
                let rows = first..first + count;
                first += count;
                let part = jacobian.rows(rows.start, count).into_owned();
                Information::new(&part, &residuals.rows(rows.start, count).into_owned(), &blocks[rows], owners.len())
            })
            .collect()
    }
}

/// Parameters that were fitted together.
struct Group {
    free: Vec<usize>,
    /// Half the sum of the squared residuals.
    cost: f64,
}

/// Changes of the parameters of both groups, by which standard errors and leave-one-out fits are computed.
struct Influence {
    /// Parameters of both groups, and their values.
    free: Vec<usize>,
    values: Vec<f64>,
    /// Changes of the values by the residuals of every block.
    blocks: Vec<DVector<f64>>,
    /// Factor on squared errors for the number of blocks.
    correction: f64,
    /// Changes of the values if a flight is left out: one Gauss–Newton step.
    without: Vec<DVector<f64>>,
}

impl Influence {
    /// Computes the changes. The trim depends on the motion, and the motion does not depend on the trim, which the
    /// estimator finds in every flight.
    fn of(fit: &Fit<'_>, motion: &[usize], trim: &[usize]) -> Self {
        let free: Vec<usize> = motion.iter().chain(trim).copied().collect();
        let (first, second): (Vec<usize>, Vec<usize>) =
            ((0..motion.len()).collect(), (motion.len()..free.len()).collect());
        let of_motion = fit.information(motion, BOTH);
        let of_trim = fit.information(&free, NEITHER);
        let step = |of_motion: &Information, of_trim: &Information, by_block: bool| {
            let gradients = |information: &Information| match by_block {
                true => information.scores.clone(),
                false => vec![information.gradient()],
            };
            let trim = of_trim.of(&second);
            let cross = of_trim.cross(&second, &first);
            let motion = of_motion.step_for(&gradients(of_motion));
            let gradients = gradients(&trim).into_iter().zip(&motion).map(|(own, motion)| own + &cross * motion);
            let trim = trim.step_for(&gradients.collect::<Vec<_>>());
            let join = |(motion, trim): (&DVector<f64>, &DVector<f64>)| {
                DVector::from_iterator(free.len(), motion.iter().chain(trim.iter()).copied())
            };
            motion.iter().zip(&trim).map(join).collect::<Vec<_>>()
        };
        let totals = (sum(&of_motion), sum(&of_trim));
        let without = of_motion
            .iter()
            .zip(&of_trim)
            .flat_map(|(motion, trim)| step(&difference(&totals.0, motion), &difference(&totals.1, trim), false));
        Self {
            values: free.iter().map(|&index| (PARAMETERS[index].get)(&fit.airframe)).collect(),
            blocks: step(&totals.0, &totals.1, true),
            correction: totals.0.correction(),
            without: without.collect(),
            free,
        }
    }

    /// Returns an airframe with changed values. A change has at most [`MAX_CHANGE`] times its scale: flights that
    /// hardly determine a value lead to any change, and to an infinite number where the value is a logarithm.
    fn changed(&self, airframe: &DroneParams, change: &DVector<f64>) -> DroneParams {
        let mut params = airframe.clone();
        for ((&index, value), &change) in self.free.iter().zip(&self.values).zip(change.iter()) {
            let max = MAX_CHANGE * (PARAMETERS[index].scale)(airframe).abs();
            let change = if change.abs() > max { max.copysign(change) } else { change };
            (PARAMETERS[index].set)(&mut params, value + change);
        }
        params
    }

    /// Returns the standard error of a number by the blocks of windows: from its derivatives by the values.
    fn error(&self, index: usize, airframe: &DroneParams) -> f64 {
        let slopes = DVector::from_fn(self.free.len(), |place, _| {
            let by = 1e-4 * (PARAMETERS[self.free[place]].scale)(airframe);
            let mut change = DVector::zeros(self.free.len());
            change[place] = by;
            let (above, below) = (self.changed(airframe, &change), self.changed(airframe, &-change));
            (get_number(&above, index) - get_number(&below, index)) / (2.0 * by)
        });
        let squares: f64 = self.blocks.iter().map(|change| change.dot(&slopes).powi(2)).sum();
        (squares * self.correction).sqrt()
    }
}

/// Returns true if a number is valid; otherwise sets it to the smallest valid one.
fn bound(params: &mut DroneParams, index: usize) -> bool {
    let parameter = &PARAMETERS[index];
    let off = parameter.min - (parameter.number)(params);
    if off > 0.0 {
        // a fitted value with a bound is the number or a difference
        let value = (parameter.get)(params) + off;
        (parameter.set)(params, value);
    }
    off <= 0.0
}

/// A parameter out of the fit, with the reason.
type Dropped = (usize, Status);

/// Selects the parameters that the flights determine, and of the additional ones those that differ from their default.
/// `parameters` have the values that a Gauss–Newton step reaches, `defaults` is the airframe of all defaults.
fn select(
    parts: &[Information],
    parameters: &[usize],
    airframe: &DroneParams,
    defaults: &DroneParams,
) -> (Vec<usize>, Vec<Dropped>) {
    let mut kept: Vec<usize> = (0..parameters.len()).collect();
    let mut dropped = Vec::new();
    let scale = |index: usize| (PARAMETERS[index].scale)(airframe);
    let is_additional = |index: usize| PARAMETERS[index].role == Role::Additional;
    loop {
        let (part, errors) = errors_of(parts, &kept);
        let ratio = |place: usize| errors[place] / scale(parameters[kept[place]]);
        // NaN is an error that is too large; additional parameters are dropped first
        let is_known = |place: usize| ratio(place) <= MAX_ERROR;
        let worst = (0..kept.len()).filter(|&place| !is_known(place)).max_by(|&a, &b| {
            let key = |place: usize| is_additional(parameters[kept[place]]);
            key(a).cmp(&key(b)).then(ratio(a).total_cmp(&ratio(b)))
        });
        let Some(place) = worst else { break };
        let index = parameters[kept[place]];
        let name = |place: &usize| PARAMETERS[parameters[kept[*place]]].name;
        let reason = if part.error_alone(place) <= MAX_ERROR * scale(index) {
            Unidentified::Collinear(part.partners(place).iter().map(name).collect())
        } else {
            Unidentified::NoEffect
        };
        dropped.push((index, Status::NotIdentifiable(reason)));
        kept.remove(place);
    }
    loop {
        let (part, errors) = errors_of(parts, &kept);
        let step = part.step();
        let deviation = |place: usize| {
            let get = PARAMETERS[parameters[kept[place]]].get;
            get(airframe) + step[place] - get(defaults)
        };
        let ratio = |place: usize| {
            let wrong_side = PARAMETERS[parameters[kept[place]]].min >= get_number(defaults, parameters[kept[place]])
                && deviation(place) < 0.0;
            if wrong_side { 0.0 } else { deviation(place).abs() / errors[place] }
        };
        let additional = (0..kept.len()).filter(|&place| is_additional(parameters[kept[place]]));
        let least = additional.min_by(|&a, &b| ratio(a).total_cmp(&ratio(b)));
        let is_significant = |place: usize| ratio(place) >= SIGNIFICANCE;
        let Some(place) = least.filter(|&place| !is_significant(place)) else { break };
        let deviation = Estimate { value: deviation(place), error: errors[place] };
        dropped.push((parameters[kept[place]], Status::Insignificant(deviation)));
        kept.remove(place);
    }
    (kept.into_iter().map(|place| parameters[place]).collect(), dropped)
}

/// Returns the sums of all flights for some parameters, with the standard errors.
fn errors_of(parts: &[Information], parameters: &[usize]) -> (Information, Vec<f64>) {
    let parts: Vec<_> = parts.iter().map(|part| part.of(parameters)).collect();
    let total = sum(&parts);
    let mut errors = total.standard_errors();
    if parts.len() >= JACKKNIFE_FLIGHTS {
        let without: Vec<_> = parts.iter().map(|part| difference(&total, part).step()).collect();
        for (place, error) in errors.iter_mut().enumerate() {
            *error = error.max(jackknife(&without.iter().map(|step| step[place]).collect::<Vec<_>>()));
        }
    }
    (total, errors)
}

fn get_number(params: &DroneParams, index: usize) -> f64 {
    (PARAMETERS[index].number)(params)
}

/// Identifies an airframe; see [`super::identify`].
pub(super) fn run(
    flights: &[Flight],
    base: &DroneParams,
    options: &IdentifyOptions,
    progress: &mut dyn FnMut(f64),
) -> Result<Identification, FlightError> {
    for flight in flights {
        flight.require(&["m1", "m2", "m3", "m4"], "the identification of the motors")?;
        flight.require(&["gx", "gy", "gz"], "the identification of the rotation")?;
        if base.motors.voltage <= 0.0 {
            flight.require(&["vbat"], "the identification of the motors")?;
        }
        let duties = flight.duty.iter().flatten().flatten();
        if duties.clone().sum::<f64>() <= 0.01 * duties.count() as f64 {
            let message = "m1 to m4 are zero, expected the duties of a flight".into();
            return Err(FlightError::Windows { flight: flight.name.clone(), message });
        }
        flight.check_units()?;
        Window::of(flight)?;
    }
    let (mut alignments, corrected): (Vec<Alignment>, Vec<Flight>) = flights.iter().map(align).unzip();
    let start = initial(base, &corrected);
    let fitted: Vec<_> =
        corrected.into_iter().map(|flight| FittedFlight::new(flight, FIRST_START, BETWEEN_STARTS)).collect();
    if let Some(fitted) = fitted.iter().find(|fitted| fitted.windows.is_empty()) {
        let seconds = fitted.flight.time(fitted.flight.rows() - 1) - fitted.flight.start;
        let shortest = FIRST_START + HORIZONS[HORIZONS.len() - 1];
        let message = if seconds < shortest {
            format!("the flight lasts {seconds:.2} s, expected at least {shortest} s")
        } else {
            "every window starts near a jump of the markers, expected a window without one".into()
        };
        return Err(FlightError::Windows { flight: fitted.flight.name.clone(), message });
    }
    let weights = Weights::of(&fitted);
    let mut fit = Fit { options, flights: fitted, weights, airframe: start.clone(), evaluations: 0 };
    progress(0.05);

    let (translation, rotation, trim) = (basic(Stage::Translation), basic(Stage::Rotation), basic(Stage::Trim));
    fit.run(&translation, RECORDED, STAGE_TOLERANCE);
    fit.keep_inside(&translation);
    progress(0.15);
    let conventions = [YawConvention::Crazyflie, YawConvention::Reversed].map(|yaw_convention| {
        let airframe = DroneParams { yaw_convention, ..fit.airframe.clone() };
        (fit.cost(&airframe, PREDICTED), airframe)
    });
    let [(a, first), (b, second)] = conventions;
    fit.airframe = if a < b { first } else { second };
    fit.run(&rotation, PREDICTED, STAGE_TOLERANCE);
    fit.keep_inside(&rotation);
    // the estimator finds the trim for the present thrust only, so that a large one must be in the airframe
    fit.run(&trim, NEITHER, STAGE_TOLERANCE);
    progress(0.35);

    let basics: Vec<usize> = translation.iter().chain(&rotation).copied().collect();
    fit.run(&basics, BOTH, STAGE_TOLERANCE);
    let mut inside = fit.keep_inside(&basics);
    fit.run(&trim, NEITHER, STAGE_TOLERANCE);
    progress(0.55);
    for _ in 0..MAX_ROUNDS {
        if !shift_apart(&mut fit, &mut alignments) {
            break;
        }
        fit.run(&basics, BOTH, STAGE_TOLERANCE);
        inside = fit.keep_inside(&basics);
    }
    let of_motion = |index: &usize| PARAMETERS[*index].stage != Stage::Trim;
    let at_bound = |index: &usize| basics.contains(index) && !inside.contains(index);
    let candidates: Vec<usize> = (0..PARAMETERS.len()).filter(|index| of_motion(index) && !at_bound(index)).collect();
    let (mut motion, mut dropped) = fit.solve(&candidates, BOTH, &start);
    progress(0.85);
    let candidates: Vec<usize> = (0..PARAMETERS.len()).filter(|index| !of_motion(index)).collect();
    fit.run(&trim, NEITHER, TOLERANCE);
    let (trim, others) = fit.solve(&candidates, NEITHER, &start);
    dropped.extend(others);
    // motion and trim depend on each other slightly
    let mut cost = motion.cost;
    for _ in 0..MAX_ROUNDS {
        let before = cost;
        cost = fit.run(&motion.free, BOTH, TOLERANCE);
        motion.free = fit.keep_inside(&motion.free);
        fit.run(&trim.free, NEITHER, TOLERANCE);
        if (before - cost).abs() <= STAGE_TOLERANCE * before {
            break;
        }
    }
    let influence = Influence::of(&fit, &motion.free, &trim.free);
    // the airframes of fits without one flight each
    let without = influence.without.iter().map(|change| {
        let mut params = influence.changed(&fit.airframe, change);
        influence.free.iter().for_each(|&index| _ = bound(&mut params, index));
        params
    });
    let without: Vec<DroneParams> = without.collect();
    let error = |index: usize| {
        let error = influence.error(index, &fit.airframe);
        let estimates: Vec<f64> = without.iter().map(|params| get_number(params, index)).collect();
        if flights.len() >= JACKKNIFE_FLIGHTS { error.max(jackknife(&estimates)) } else { error }
    };
    let is_free = |index: usize| influence.free.contains(&index);
    let airframe = finished(fit.airframe.clone(), options);
    let sources = [AttitudeSource::Recorded, AttitudeSource::Predicted];
    let compared = compare_any(&airframe, flights, &sources)?;
    let mut leave_one_out = Vec::new();
    if flights.len() > 1 {
        for (flight, params) in flights.iter().zip(&without) {
            let airframe = finished(params.clone(), options);
            // an airframe of too few flights may be out of range, which the identification does not depend on
            let compared = compare_any(&airframe, std::slice::from_ref(flight), &sources);
            let Some(compared) = compared.ok().filter(|_| airframe.validate().is_ok()) else {
                leave_one_out.clear();
                break;
            };
            // one flight has one element
            leave_one_out.extend(compared.into_iter().map(|compared| LeftOut { airframe: airframe.clone(), compared }));
        }
    }
    let parameters = (0..PARAMETERS.len()).map(|index| {
        let parameter = &PARAMETERS[index];
        let status = match dropped.iter().find(|(other, _)| *other == index) {
            _ if is_free(index) => Status::Identified,
            Some((_, status)) => status.clone(),
            None => Status::AtBound,
        };
        let is_first_free = |like: &&str| (0..index).any(|index| PARAMETERS[index].name == *like && is_free(index));
        let as_other = parameter.like.filter(is_first_free).filter(|_| status != Status::Identified);
        let is_fitted = is_free(index) || as_other.is_some();
        let error = if is_fitted { error(index) } else { f64::INFINITY };
        let estimate = Estimate { value: get_number(&airframe, index), error };
        FittedParameter { name: parameter.name, unit: parameter.unit, estimate, like: as_other, status }
    });
    let parameters = parameters.collect();
    let windows = fit.flights.iter().map(|fitted| fitted.windows.len()).sum();
    progress(1.0);
    Ok(Identification {
        airframe,
        parameters,
        alignments,
        windows,
        cost,
        evaluations: fit.evaluations,
        compared,
        leave_one_out,
    })
}

fn sum(parts: &[Information]) -> Information {
    let mut total = parts[0].clone();
    parts[1..].iter().for_each(|part| total.add(part, 1.0));
    total
}

/// Returns the sums without those of a flight.
fn difference(total: &Information, part: &Information) -> Information {
    let mut rest = total.clone();
    rest.add(part, -1.0);
    rest
}

/// Estimates the time shift of the motors of every flight against the common latency, and moves the motors of flights
/// whose shift is significant. Returns true if it moved any.
fn shift_apart(fit: &mut Fit<'_>, alignments: &mut [Alignment]) -> bool {
    let latency: Vec<usize> =
        (0..PARAMETERS.len()).filter(|&index| PARAMETERS[index].name == "motors.latency").collect();
    let shifts: Vec<Estimate> = fit
        .information(&latency, BOTH)
        .iter()
        // columns that lag need less latency
        .map(|part| Estimate { value: -part.step()[0], error: part.standard_errors()[0] })
        .collect();
    let mut has_moved = false;
    for ((fitted, alignment), shift) in fit.flights.iter_mut().zip(alignments).zip(shifts) {
        let applied = &mut alignment.applied.motor_shift;
        alignment.motor_shift = Some(Estimate { value: *applied + shift.value, ..shift });
        let by = significant(&shift, MIN_MOTOR_SHIFT, f64::INFINITY);
        if by != 0.0 {
            shift_motors(&mut fitted.flight, by);
            *applied += by;
            has_moved = true;
        }
    }
    has_moved
}

/// Returns a number with six significant digits.
fn rounded(x: f64) -> f64 {
    format!("{x:.5e}").parse().unwrap_or(x)
}

/// Returns an airframe with its name, its ratio of thrust to weight at full duty and the nominal voltage, and rounded
/// parameters.
fn finished(mut params: DroneParams, options: &IdentifyOptions) -> DroneParams {
    let motors = &mut params.motors;
    let numbers = [
        &mut motors.speed_at_zero,
        &mut motors.speed_per_volt,
        &mut motors.rise_time,
        &mut motors.fall_time,
        &mut motors.latency,
        &mut motors.rotor_inertia,
        &mut params.air.translational_lift,
        &mut params.air.velocity_moment,
        &mut params.torque_coefficient,
    ];
    let lists = [&mut params.air.linear_drag, &mut params.air.rotational_damping, &mut params.air.trim_torque];
    let numbers = numbers.into_iter().chain(lists.into_iter().flatten());
    numbers.chain(&mut params.center_of_mass).chain(&mut params.inertia).for_each(|number| *number = rounded(*number));
    let [x, y, z] = params.inertia;
    // no body has a larger moment than the sum of the others
    params.inertia[2] = z.min(x + y).max((x - y).abs());
    let full = params.motors.speed_at_zero + params.motors.speed_per_volt * params.motors.voltage;
    params.thrust_to_weight = rounded((full / params.hover_rpm()).powi(2)).max(1.0);
    params.name.clone_from(&options.name);
    params
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::drone::DroneModel;

    /// Without one flight, the others may not determine a parameter: the change of its value is any number.
    #[test]
    fn airframes_without_a_flight_are_finite_after_any_change() {
        let mut base = DroneModel::Cf2x.params();
        (base.motors.speed_per_volt, base.motors.voltage) = (5589.0, 3.7);
        let free: Vec<usize> = (0..PARAMETERS.len()).collect();
        let values = free.iter().map(|&index| (PARAMETERS[index].get)(&base)).collect();
        let influence = Influence { free, values, blocks: Vec::new(), correction: 1.0, without: Vec::new() };
        for change in [1e3, -1e3, 1e300, f64::INFINITY, f64::NEG_INFINITY, f64::NAN] {
            let change = DVector::from_element(PARAMETERS.len(), change);
            let airframe = finished(influence.changed(&base, &change), &IdentifyOptions::default());
            let is_finite = (0..PARAMETERS.len()).all(|index| get_number(&airframe, index).is_finite());
            assert_eq!(is_finite, !change[0].is_nan(), "{airframe:?}");
        }
    }
}
