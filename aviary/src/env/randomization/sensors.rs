//! Sensor errors: the measurement of a state, generic over a double and a SIMD register of doubles.

use std::f64::consts::PI;

use pulp::Simd;

use super::Randomizer;
use crate::math::{LANES, Pack, PackBits, Real, Row, Turn, V3};
use crate::random::counter::{Key, Noise, Purpose};

/// State of a drone, true or measured.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Sensed<R> {
    /// Position, world frame, m.
    pub position: V3<R>,
    /// Rotation from the body to the world frame.
    pub attitude: Turn<R>,
    /// Roll, pitch and yaw of `attitude`, rad.
    pub rpy: V3<R>,
    /// Velocity, world frame, m/s.
    pub velocity: V3<R>,
    /// Angular velocity, body frame, rad/s.
    pub rate: V3<R>,
}

/// Errors of the sensors of one drone in an episode. The order is position (m), velocity (m/s), roll-pitch-yaw (rad),
/// angular velocity (rad/s).
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct SensorParams<R> {
    /// Standard deviations of the noise.
    pub sigmas: [R; 4],
    /// Biases.
    pub biases: [[R; 3]; 4],
}

impl<R> SensorParams<R> {
    /// Applies a function to every number.
    #[inline(always)]
    fn map<T>(&self, f: impl Fn(&R) -> T) -> SensorParams<T> {
        let [a, b, c, d] = &self.sigmas;
        let [[e, f0, g], [h, i, j], [k, l, m], [n, o, p]] = &self.biases;
        SensorParams {
            sigmas: [f(a), f(b), f(c), f(d)],
            biases: [[f(e), f(f0), f(g)], [f(h), f(i), f(j)], [f(k), f(l), f(m)], [f(n), f(o), f(p)]],
        }
    }
}

impl<R: Real> SensorParams<R> {
    /// Returns the measured state. The step of `noise` is the number of control steps since the start of the episode.
    #[inline(always)]
    pub fn measure(&self, noise: Noise<R::Bits>, truth: &Sensed<R>) -> Sensed<R> {
        /// Pitch up to which the angles are unique beyond rounding, half turns.
        const MAX_PITCH: f64 = 0.499_999;
        let [a, b, c, d] = noise.normals::<R>(Purpose::Sensor, 0);
        let [e, f, g, h] = noise.normals::<R>(Purpose::Sensor, 1);
        let [i, j, k, l] = noise.normals::<R>(Purpose::Sensor, 2);
        let error = |index: usize, [a, b, c]: [R; 3]| {
            let (sigma, [x, y, z]) = (self.sigmas[index], self.biases[index]);
            V3::new(sigma * a + x, sigma * b + y, sigma * c + z)
        };
        let angles = truth.rpy + error(2, [g, h, i]);
        // angles beyond the vertical or beyond half a turn are those of another roll, pitch and yaw
        let half = angles.x.all(PI);
        let usual = angles.x.abs().less(half) & angles.z.abs().less(half) & angles.y.abs().less(half * MAX_PITCH);
        let rpy = if R::any(!usual) {
            let turned = Turn::from_rpy(angles).rpy();
            V3::new(
                R::choose(usual, angles.x, turned.x),
                R::choose(usual, angles.y, turned.y),
                R::choose(usual, angles.z, turned.z),
            )
        } else {
            angles
        };
        Sensed {
            position: truth.position + error(0, [a, b, c]),
            attitude: Turn::from_rpy(angles),
            rpy,
            velocity: truth.velocity + error(1, [d, e, f]),
            rate: truth.rate + error(3, [j, k, l]),
        }
    }
}

/// Sensors of [`LANES`] drones, each in its own environment with its own settings, as a structure of arrays.
#[derive(Debug, Clone, Default)]
#[repr(align(64))]
pub(crate) struct SensorLanes {
    params: SensorParams<Row>,
    key: [Row<u64>; 2],
    /// 1 in lanes with sensor errors, 0 in lanes with exact sensors.
    inexact: Row,
}

impl SensorLanes {
    /// Sets a lane to the sensors of a drone; a randomizer without sensor errors clears it.
    pub fn set(&mut self, lane: usize, randomizer: &Randomizer, drone: usize) {
        let Some((params, Key([a, b]))) = randomizer.sensors(drone) else { return self.clear(lane) };
        self.set_params(lane, &params);
        (self.key[0][lane], self.key[1][lane], self.inexact[lane]) = (a, b, 1.0);
    }

    /// Sets a lane to exact sensors.
    pub fn clear(&mut self, lane: usize) {
        self.set_params(lane, &SensorParams::default());
        self.inexact[lane] = 0.0;
    }

    /// Returns true if any lane has sensor errors.
    pub fn is_inexact(&self) -> bool {
        self.inexact != [0.0; LANES]
    }

    fn set_params(&mut self, lane: usize, params: &SensorParams<f64>) {
        for (row, sigma) in self.params.sigmas.iter_mut().zip(params.sigmas) {
            row[lane] = sigma;
        }
        for (rows, biases) in self.params.biases.iter_mut().zip(params.biases) {
            rows.iter_mut().zip(biases).for_each(|(row, bias)| row[lane] = bias);
        }
    }

    /// Returns the measured states of the drones in the register with this index. A lane with exact sensors keeps the
    /// true state. `steps` are the control steps since the start of each episode, `truth` are the states that the
    /// sensors observe, delayed by their latency.
    #[inline(always)]
    pub fn measure<S: Simd>(
        &self,
        simd: S,
        index: usize,
        steps: &Row<u64>,
        truth: &Sensed<Pack<S>>,
    ) -> Sensed<Pack<S>> {
        let params = self.params.map(
            #[inline(always)]
            |row| Pack::load(simd, row, index),
        );
        let key = Key([PackBits::load(simd, &self.key[0], index), PackBits::load(simd, &self.key[1], index)]);
        let measured = params.measure(key.at(PackBits::load(simd, steps, index)), truth);
        let inexact = Pack::load(simd, &self.inexact, index);
        let inexact = inexact.all(0.0).less(inexact);
        let choose = |yes: V3<Pack<S>>, no: V3<Pack<S>>| {
            let [x, y, z] = [(yes.x, no.x), (yes.y, no.y), (yes.z, no.z)];
            V3::new(Real::choose(inexact, x.0, x.1), Real::choose(inexact, y.0, y.1), Real::choose(inexact, z.0, z.1))
        };
        Sensed {
            position: choose(measured.position, truth.position),
            attitude: Turn {
                w: Real::choose(inexact, measured.attitude.w, truth.attitude.w),
                v: choose(measured.attitude.v, truth.attitude.v),
            },
            rpy: choose(measured.rpy, truth.rpy),
            velocity: choose(measured.velocity, truth.velocity),
            rate: choose(measured.rate, truth.rate),
        }
    }
}

#[cfg(test)]
mod tests;
