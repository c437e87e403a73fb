//! Batteries of eight drones in SIMD lanes.

use pulp::Simd;

use super::{Battery, BatteryState};
use crate::drone::MotorLaw;
use crate::math::{LANES, Pack, Real as _, Row};

/// Batteries of [`LANES`] drones, each in its own environment, as a structure of arrays. A lane may have none.
///
/// The battery in a lane is bit-identical to that of [`Battery::advance`].
#[derive(Debug, Clone)]
#[repr(align(64))]
pub(crate) struct BatteryLanes {
    battery: Battery<Row>,
    state: BatteryState<Row>,
    /// Largest motor speed that the voltage allows, rpm; infinite without a battery.
    reach: Row,
}

impl Default for BatteryLanes {
    fn default() -> Self {
        Self { battery: Battery::default(), state: BatteryState::default(), reach: [f64::INFINITY; LANES] }
    }
}

impl BatteryLanes {
    /// Sets a lane to a battery and its state.
    pub fn set(&mut self, lane: usize, battery: &Battery, state: &BatteryState) {
        let Battery { cells, resistance, idle_current, drain, power, law } = &mut self.battery;
        cells[lane] = battery.cells;
        resistance[lane] = battery.resistance;
        idle_current[lane] = battery.idle_current;
        drain[lane] = battery.drain;
        power[lane] = battery.power;
        (law.at_zero[lane], law.per_volt[lane]) = (battery.law.at_zero, battery.law.per_volt);
        self.state.charge[lane] = state.charge;
        self.state.voltage[lane] = state.voltage;
        self.state.current[lane] = state.current;
        self.reach[lane] = battery.reach(state.voltage);
    }

    /// Removes the battery of a lane.
    pub fn clear(&mut self, lane: usize) {
        self.set(lane, &Battery::default(), &BatteryState::default());
        self.reach[lane] = f64::INFINITY;
    }

    /// Returns the state of the battery in a lane, if it has one.
    pub fn state(&self, lane: usize) -> Option<BatteryState> {
        let BatteryState { charge, voltage, current } = &self.state;
        let state = BatteryState { charge: charge[lane], voltage: voltage[lane], current: current[lane] };
        (self.battery.drain[lane] > 0.0).then_some(state)
    }

    /// Copies the states of the lanes that the flags do not select from other batteries.
    pub fn keep(&mut self, before: &Self, advanced: &[bool; LANES]) {
        for lane in (0..LANES).filter(|&lane| !advanced[lane]) {
            self.state.charge[lane] = before.state.charge[lane];
            self.state.voltage[lane] = before.state.voltage[lane];
            self.state.current[lane] = before.state.current[lane];
            self.reach[lane] = before.reach[lane];
        }
    }

    /// Returns the voltages, and the largest motor speeds (rpm) that they allow, in the register with an index.
    /// Without a battery they are `voltage` and infinity.
    #[inline(always)]
    pub fn supply<S: Simd>(&self, simd: S, index: usize, voltage: Pack<S>) -> (Pack<S>, Pack<S>) {
        let drain = Pack::load(simd, &self.battery.drain, index);
        let own = Pack::load(simd, &self.state.voltage, index);
        (Pack::choose(drain.all(0.0).less(drain), own, voltage), Pack::load(simd, &self.reach, index))
    }

    /// Advances the register with an index by `dt` seconds, from the rotor speeds at their end, rpm.
    #[inline(always)]
    pub fn advance<S: Simd>(&mut self, simd: S, index: usize, dt: f64, rpm: &[Pack<S>; 4]) {
        // a macro, because a closure is not always inlined and then lacks the instruction set
        macro_rules! load {
            ($row:expr) => {
                Pack::load(simd, &$row, index)
            };
        }
        let rows = &self.battery;
        let battery = Battery {
            cells: load!(rows.cells),
            resistance: load!(rows.resistance),
            idle_current: load!(rows.idle_current),
            drain: load!(rows.drain),
            power: load!(rows.power),
            law: MotorLaw { at_zero: load!(rows.law.at_zero), per_volt: load!(rows.law.per_volt) },
        };
        let state = BatteryState {
            charge: load!(self.state.charge),
            voltage: load!(self.state.voltage),
            current: load!(self.state.current),
        };
        let next = battery.advance(dt, &state, rpm);
        next.charge.store(&mut self.state.charge, index);
        next.voltage.store(&mut self.state.voltage, index);
        next.current.store(&mut self.state.current, index);
        let zero = next.charge.all(0.0);
        let reach = Pack::choose(zero.less(battery.drain), battery.reach(next.voltage), zero.all(f64::INFINITY));
        reach.store(&mut self.reach, index);
    }
}
