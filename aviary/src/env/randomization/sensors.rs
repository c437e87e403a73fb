//! Sensor errors of eight drones in SIMD lanes.

use flight::random::Key;
pub(crate) use flight::sensors::{Sensed, SensorParams};
use pulp::Simd;

use super::Randomizer;
use crate::math::{LANES, Pack, PackBits, Real, Row, Turn, V3};

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
