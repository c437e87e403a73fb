//! Wind at eight drones in SIMD lanes.

use flight::random::Key;
use flight::wind::{WindParams, WindParts, WindState};
use pulp::Simd;

use super::WindField;
use crate::math::{Bits, LANES, Pack, PackBits, Row, V3};

/// Wind at [`LANES`] drones, each in its own environment with its own settings, as a structure of arrays.
///
/// The wind in a lane is bit-identical to that of [`WindField::advance`].
#[derive(Debug, Clone)]
#[repr(align(64))]
pub(crate) struct WindLanes {
    params: WindParams<Row>,
    state: WindState<Row>,
    key: [Row<u64>; 2],
    /// Physics steps since the start of the episode.
    steps: Row<u64>,
    /// Length of a physics step, s.
    dt: f64,
    /// Parts that each lane needs.
    parts: Row<WindParts>,
    /// Parts that any lane needs.
    any: WindParts,
    /// True for the lanes in moving air or with any force.
    windy: Row<bool>,
}

/// State and clock of [`WindLanes`] before a step.
#[derive(Debug, Clone, Copy)]
pub(crate) struct MovingWind {
    state: WindState<Row>,
    steps: Row<u64>,
}

impl WindLanes {
    /// Creates lanes in still air, for physics steps of `dt` seconds.
    pub fn new(dt: f64) -> Self {
        let mut lanes = Self {
            params: WindParams::default(),
            state: WindState::default().map(|&number: &f64| [number; LANES]),
            key: [[0; LANES]; 2],
            steps: [0; LANES],
            dt,
            parts: [WindParts::default(); LANES],
            any: WindParts::default(),
            windy: [false; LANES],
        };
        (0..LANES).for_each(|lane| lanes.clear(lane));
        lanes
    }

    /// Sets a lane to the wind at a drone: settings, random numbers, state and clock.
    pub fn set(&mut self, lane: usize, field: &WindField, drone: usize) {
        let (params, noise, state) = field.local(self.dt, drone);
        self.params.update(&params, |row, number| row[lane] = number);
        self.state.update(state, |row, number| row[lane] = number);
        (self.key[0][lane], self.key[1][lane]) = (noise.key.0[0], noise.key.0[1]);
        self.steps[lane] = noise.step;
        self.parts[lane] = params.parts();
        self.windy[lane] = true;
        self.update_parts();
    }

    /// Sets a lane to still air.
    pub fn clear(&mut self, lane: usize) {
        self.params.update(&WindParams::default(), |row, number: f64| row[lane] = number);
        self.state.update(&WindState::default(), |row, number: f64| row[lane] = number);
        self.parts[lane] = WindParts::default();
        self.windy[lane] = false;
        self.update_parts();
    }

    /// Copies the random numbers, the state and the clock of a lane to the wind at a drone.
    pub fn read(&self, lane: usize, field: &mut WindField, drone: usize) {
        let key = Key([self.key[0][lane], self.key[1][lane]]);
        field.set_local(drone, key, self.state.map(|row| row[lane]), self.steps[lane]);
    }

    /// Returns what [`advance`](Self::advance) changes: the state and the clock.
    pub fn moving(&self) -> MovingWind {
        MovingWind { state: self.state, steps: self.steps }
    }

    /// Restores a lane after [`advance`](Self::advance).
    pub fn restore_lane(&mut self, lane: usize, before: &MovingWind) {
        self.state.update(&before.state.map(|row| row[lane]), |row, number| row[lane] = number);
        self.steps[lane] = before.steps[lane];
    }

    /// Returns true if any lane has wind. Without wind the results of [`advance`](Self::advance) are zero.
    pub fn is_windy(&self) -> bool {
        self.windy.contains(&true)
    }

    fn update_parts(&mut self) {
        self.any = self.parts.iter().fold(WindParts::default(), |any, &parts| any.or(parts));
    }

    /// Advances the wind in the lanes of the register with this index by one physics step and returns the force on the
    /// airframe (world frame, N) and the velocity of the air (world frame, m/s). `height` (m) and `velocity` (world
    /// frame, m/s) are those of the drones at the start of the step.
    #[inline(always)]
    pub fn advance<S: Simd>(
        &mut self,
        simd: S,
        index: usize,
        height: Pack<S>,
        velocity: V3<Pack<S>>,
    ) -> (V3<Pack<S>>, V3<Pack<S>>) {
        let params = self.params.map(
            #[inline(always)]
            |row| Pack::load(simd, row, index),
        );
        let mut state = self.state.map(
            #[inline(always)]
            |row| Pack::load(simd, row, index),
        );
        let key = Key([PackBits::load(simd, &self.key[0], index), PackBits::load(simd, &self.key[1], index)]);
        let steps = PackBits::load(simd, &self.steps, index);
        let wind = state.advance(self.any, self.dt, &params, key.at(steps), height, velocity);
        self.state.update(
            &state,
            #[inline(always)]
            |row, number| number.store(row, index),
        );
        steps.next().store(&mut self.steps, index);
        wind
    }
}

#[cfg(test)]
mod tests;
