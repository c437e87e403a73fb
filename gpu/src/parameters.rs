//! Parameters of a drone that a kernel reads.

use flight::body::{Fluid, FreeBody};
use flight::clearance::CollisionCylinder;
use flight::downwash::Wake;
use flight::ground_effect::GroundEffect;
use flight::math::{Real, Turn, V3};
use flight::rotor::RotorModel;
use flight::state::FlightState;
use flight::wind::WindParams;

/// Parameters of a drone, in the units of the fields of `flight`.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Parameters<R = f64> {
    pub body: FreeBody<R>,
    pub rotors: RotorModel<R>,
    pub ground: GroundEffect<R>,
    /// Coefficients of the blade drag, body frame, N/(m/s)/(rad/s).
    pub drag: V3<R>,
    pub wake: Wake<R>,
    /// Share of the remaining speed difference that a rotor closes in one physics step.
    pub lag_share: R,
    /// Hover speed of the nominal airframe, rpm.
    pub hover_rpm: R,
    /// Full speed minus hover speed of the nominal airframe, rpm.
    pub rpm_above_hover: R,
    /// Factors on the commanded speeds.
    pub gains: [R; 4],
    /// The factors minus 1. In single precision their difference would keep few digits.
    pub gain_errors: [R; 4],
    /// Speed at which the rotors saturate, minus the hover speed, rpm.
    pub max_change: R,
    /// Speed of the rotors at the start of an episode, minus the hover speed, rpm.
    pub initial_change: R,
    /// Latency of the commands, physics steps.
    pub motor_latency: R,
    /// Latency of the observed states, physics steps.
    pub sensor_latency: R,
    /// Biases of the sensors: position (m), velocity (m/s), roll-pitch-yaw (rad), angular velocity (rad/s).
    pub biases: [[R; 3]; 4],
    pub wind: WindParams<R>,
    pub cylinder: CollisionCylinder<R>,
    /// State at the start of an episode, before all draws.
    pub start: FlightState<R>,
}

/// Function that [`Parameters::each`] calls with every parameter.
type Visit<'a, R> = &'a mut dyn FnMut(&mut R);

impl<R: Copy> Parameters<R> {
    /// Calls a function with every parameter, in a fixed order.
    pub fn each(&mut self, visit: Visit<'_, R>) {
        let Self { body, rotors, ground, drag, wake, wind, cylinder, start, .. } = self;
        let FreeBody { inverse_mass, gravity, inverse_inertia, gyration, fluid } = body;
        let Fluid { viscous, quadratic, viscous_rate, quadratic_rate } = fluid;
        for number in [inverse_mass, gravity, viscous, &mut rotors.thrust] {
            visit(number);
        }
        for number in [inverse_inertia, gyration, quadratic, viscous_rate, quadratic_rate].into_iter().flatten() {
            visit(number);
        }
        rotors.torque.as_flattened_mut().iter_mut().for_each(&mut *visit);
        for number in [&mut ground.coefficient, &mut ground.clip, &mut drag.x, &mut drag.y, &mut drag.z] {
            visit(number);
        }
        for number in [&mut wake.strength, &mut wake.spread, &mut wake.offset, &mut wake.cap] {
            visit(number);
        }
        for number in [&mut self.lag_share, &mut self.hover_rpm, &mut self.rpm_above_hover, &mut self.max_change] {
            visit(number);
        }
        self.gains.iter_mut().chain(&mut self.gain_errors).for_each(&mut *visit);
        for number in [&mut self.initial_change, &mut self.motor_latency, &mut self.sensor_latency] {
            visit(number);
        }
        self.biases.as_flattened_mut().iter_mut().for_each(&mut *visit);
        let WindParams { mean, constant, along, .. } = wind;
        mean.iter_mut().chain(constant).chain(along).for_each(&mut *visit);
        for number in [
            &mut wind.sigma,
            &mut wind.second_order,
            &mut wind.drag,
            &mut wind.gust_force,
            &mut wind.gust_hazard,
            &mut wind.gust_share,
            &mut wind.sinusoidal_force,
            &mut wind.sinusoidal_turns,
            &mut cylinder.radius,
            &mut cylinder.height,
        ] {
            visit(number);
        }
        let mut motion = motion_numbers(start);
        motion.iter_mut().for_each(visit);
        *start = motion_of(&motion);
    }

    /// Returns the parameters as a list, in the order of [`each`](Self::each).
    pub fn numbers(mut self) -> Vec<R> {
        let mut list = Vec::new();
        self.each(&mut |number| list.push(*number));
        list
    }
}

impl Parameters {
    /// Number of parameters.
    pub const COUNT: usize = 98;
}

impl<R: Real> Parameters<R> {
    /// Reads the parameters from a list. `next` returns its numbers in order.
    pub fn read(mut next: impl FnMut() -> R) -> Self {
        // the first number is a placeholder of its type until the visit has replaced it
        let first = next();
        let none = V3::zero(first);
        let mut parameters = Self {
            body: FreeBody::without_medium(first, first, [first; 3], [first; 3]),
            rotors: RotorModel { thrust: first, torque: [[first; 4]; 3] },
            ground: GroundEffect { coefficient: first, clip: first },
            drag: none,
            wake: Wake { strength: first, spread: first, offset: first, cap: first },
            lag_share: first,
            hover_rpm: first,
            rpm_above_hover: first,
            gains: [first; 4],
            gain_errors: [first; 4],
            max_change: first,
            initial_change: first,
            motor_latency: first,
            sensor_latency: first,
            biases: [[first; 3]; 4],
            wind: WindParams::default().map(|_: &f64| first),
            cylinder: CollisionCylinder { radius: first, height: first },
            start: FlightState { position: none, attitude: Turn { w: first, v: none }, velocity: none, rate: none },
        };
        let mut is_first = true;
        parameters.each(&mut |number| *number = if std::mem::take(&mut is_first) { first } else { next() });
        parameters
    }
}

/// Number of numbers of a state: position 3, attitude 4, velocity 3, body rate 3.
pub(crate) const MOTION: usize = 13;

/// Returns a state as numbers.
pub(crate) fn motion_numbers<R: Copy>(motion: &FlightState<R>) -> [R; MOTION] {
    let FlightState { position: p, attitude: q, velocity: v, rate: w } = motion;
    [p.x, p.y, p.z, q.w, q.v.x, q.v.y, q.v.z, v.x, v.y, v.z, w.x, w.y, w.z]
}

/// Returns the state of its numbers.
pub(crate) fn motion_of<R: Copy>(&[x, y, z, w, qx, qy, qz, vx, vy, vz, p, q, r]: &[R; MOTION]) -> FlightState<R> {
    FlightState {
        position: V3 { x, y, z },
        attitude: Turn { w, v: V3 { x: qx, y: qy, z: qz } },
        velocity: V3 { x: vx, y: vy, z: vz },
        rate: V3 { x: p, y: q, z: r },
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_list_of_parameters_is_read_in_its_order() {
        let list: Vec<f64> = (0..Parameters::COUNT).map(|index| 1.5 + index as f64).collect();
        let mut next = list.iter();
        let parameters = Parameters::read(|| *next.next().unwrap());
        assert!(next.next().is_none());
        assert_eq!(parameters.numbers(), list);
    }
}
