//! Battery: charge, voltage under load, and the speed that the motors reach.
//!
//! The voltage is V = E(s) − R·I with the open-circuit voltage E at the charge s, the internal resistance R and the
//! current I = P/V + I₀. P is the electric power of the motors and I₀ the idle current. The charge decreases by ∫ I dt.
//!
//! The battery advances once per control step, with the rotor speeds at its end. The power depends on the speeds, the
//! speeds on the voltage, and the voltage on the power. Taken one after the other, step by step, a strong sag would make
//! them oscillate. The step therefore assumes that the speeds follow the voltage within the step, as those of motors at
//! constant duty do: a power that is P at the last voltage U is P·(V/U)³ at V. Then V solves the quadratic equation
//! R·P/U³·V² + V = E − R·I₀. Its positive solution always exists. If the speeds stay constant, V converges within a few
//! steps to the stationary solution, where P·(V/U)³ is P, unless P exceeds the largest power of the battery.

mod lanes;

pub(crate) use lanes::BatteryLanes;

use crate::drone::{DroneParams, MotorLaw, cell_voltage};
use crate::math::Real;

/// State of the battery of one drone.
#[derive(Debug, Clone, Copy, PartialEq, Default, serde::Serialize, serde::Deserialize)]
#[serde(deny_unknown_fields)]
pub struct BatteryState<R = f64> {
    /// Charge as a fraction of the capacity, 0 to 1.
    pub charge: R,
    /// Voltage at the motors, V.
    pub voltage: R,
    /// Current during the last control step, A.
    pub current: R,
}

impl BatteryState {
    /// Returns true if every number is in its range.
    pub(crate) fn is_valid(&self) -> bool {
        (0.0..=1.0).contains(&self.charge) && [self.voltage, self.current].iter().all(|x| (0.0..1e300).contains(x))
    }
}

/// Constants of a battery, of the power of the rotors that it drives, and of their motors.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub(crate) struct Battery<R = f64> {
    /// Number of cells.
    pub cells: R,
    /// Internal resistance, Ω.
    pub resistance: R,
    /// Idle current, A.
    pub idle_current: R,
    /// Share of the capacity that one ampere draws in a second.
    pub drain: R,
    /// Electric power of a motor over the cube of its speed, W/rpm³.
    pub power: R,
    /// Law of the motors.
    pub law: MotorLaw<R>,
}

impl Battery {
    /// Returns the battery of a drone, if it has one.
    pub fn of(params: &DroneParams) -> Option<Self> {
        let battery = params.battery?;
        // mechanical power of a rotor: torque k_m·n² times angular velocity
        let mechanical = params.torque_coefficient * (std::f64::consts::TAU / 60.0);
        Some(Self {
            cells: f64::from(battery.cells),
            resistance: battery.resistance,
            idle_current: battery.idle_current,
            drain: 1.0 / (3600.0 * battery.capacity),
            power: mechanical / battery.efficiency,
            law: MotorLaw::from(&params.motors),
        })
    }

    /// Returns the state with a charge while the rotors turn at constant speeds, rpm.
    pub fn at_rest(&self, charge: f64, rpm: &[f64; 4]) -> BatteryState {
        let open = self.open_voltage(charge);
        // the stationary voltage, or that of the largest power
        let root = (open * open - 4.0 * self.resistance * self.power_of(rpm)).max(0.0).sqrt();
        let state = BatteryState { charge, voltage: 0.5 * (open + root), current: 0.0 };
        self.advance(0.0, &state, rpm)
    }
}

impl<R: Real> Battery<R> {
    /// Returns the voltage with the idle current alone, V; 0 for an empty battery.
    #[inline(always)]
    fn open_voltage(&self, charge: R) -> R {
        let zero = charge.all(0.0);
        let voltage = self.cells * cell_voltage(charge) - self.resistance * self.idle_current;
        R::choose(zero.less(charge), voltage, zero)
    }

    /// Returns the electric power of the motors, W.
    #[inline(always)]
    fn power_of(&self, rpm: &[R; 4]) -> R {
        let [a, b, c, d] = *rpm;
        self.power * (a * a * a + b * b * b + c * c * c + d * d * d)
    }

    /// Returns the state after `dt` seconds, from the rotor speeds at their end, rpm.
    #[inline(always)]
    pub fn advance(&self, dt: f64, state: &BatteryState<R>, rpm: &[R; 4]) -> BatteryState<R> {
        let (zero, one) = (state.charge.all(0.0), state.charge.all(1.0));
        let open = self.open_voltage(state.charge);
        let is_empty = !zero.less(state.charge);
        // bounds the load of rotors that turn faster than the battery could drive them
        let last = state.voltage.greater(open * 0.1);
        // an empty battery must not divide by zero
        let last = R::choose(is_empty, one, last);
        // current of the motors over the square of the voltage, A/V²; finite for speeds of any airframe
        let load = (self.power_of(rpm) / (last * last * last)).lesser(one * 1e100);
        let root = (self.resistance * load * open * 4.0 + 1.0).sqrt();
        let voltage = open * 2.0 / (root + 1.0);
        let current = R::choose(is_empty, zero, load * voltage * voltage + self.idle_current);
        let charge = zero.greater(state.charge - current * dt * self.drain);
        BatteryState { charge, voltage, current }
    }

    /// Returns the largest motor speed that can be commanded at a voltage, rpm.
    #[inline(always)]
    pub fn reach(&self, voltage: R) -> R {
        self.law.speed(voltage.all(1.0), voltage)
    }
}

#[cfg(test)]
mod tests;
