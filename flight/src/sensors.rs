//! Sensor errors: the measurement of a state.

use std::f64::consts::PI;

use crate::math::{Turn, V3};
use crate::random::{Noise, Purpose, Sampled};

/// State of a drone, true or measured.
#[derive(Debug, Clone, Copy)]
pub struct Sensed<R> {
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
pub struct SensorParams<R> {
    /// Standard deviations of the noise.
    pub sigmas: [R; 4],
    /// Biases.
    pub biases: [[R; 3]; 4],
}

impl<R> SensorParams<R> {
    /// Applies a function to every number.
    #[inline(always)]
    pub fn map<T>(&self, f: impl Fn(&R) -> T) -> SensorParams<T> {
        let [a, b, c, d] = &self.sigmas;
        let [[e, f0, g], [h, i, j], [k, l, m], [n, o, p]] = &self.biases;
        SensorParams {
            sigmas: [f(a), f(b), f(c), f(d)],
            biases: [[f(e), f(f0), f(g)], [f(h), f(i), f(j)], [f(k), f(l), f(m)], [f(n), f(o), f(p)]],
        }
    }
}

impl<R: Sampled> SensorParams<R> {
    /// Returns the measured state. The step of `noise` is the number of control steps since the start of the episode.
    #[inline(always)]
    pub fn measure(&self, noise: Noise<R::Integer>, truth: &Sensed<R>) -> Sensed<R> {
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
