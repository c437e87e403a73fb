//! Speed of a motor from its duty and the voltage, and the inverse.

use super::{DroneError, DroneParams, MotorParams};
use crate::math::Real;

impl MotorParams {
    /// Returns true if the airframe has a law from duty to speed.
    pub fn has_duty(&self) -> bool {
        self.speed_per_volt > 0.0
    }

    /// Returns the motor speed (rpm) at a duty from 0 to 1 and a voltage (V):
    /// `speed_at_zero + speed_per_volt · duty · voltage`, at least 0. Without a voltage the motor stands still.
    ///
    /// ```
    /// use aviary::drone::MotorParams;
    ///
    /// let motors = MotorParams { speed_at_zero: 4000.0, speed_per_volt: 5000.0, ..MotorParams::default() };
    /// assert_eq!(motors.speed(0.5, 4.0), 14_000.0);
    /// // the lower the voltage, the more duty it takes
    /// assert_eq!([4.0, 3.2].map(|voltage| motors.duty(14_000.0, voltage)), [0.5, 0.625]);
    /// ```
    pub fn speed(&self, duty: f64, voltage: f64) -> f64 {
        MotorLaw::from(self).speed(duty, voltage)
    }

    /// Returns the duty from 0 to 1 at which a motor turns at a speed (rpm) under a voltage (V): the inverse of
    /// [`speed`](Self::speed) for the speeds that the voltage reaches. Faster speeds give 1, and without a voltage or
    /// a law every speed gives 0.
    pub fn duty(&self, rpm: f64, voltage: f64) -> f64 {
        let full = self.speed_per_volt * voltage;
        if full > 0.0 { ((rpm - self.speed_at_zero) / full).clamp(0.0, 1.0) } else { 0.0 }
    }
}

impl DroneParams {
    /// Returns the voltage of the charged battery, or the constant voltage of an airframe without a battery, V.
    pub fn nominal_voltage(&self) -> f64 {
        self.battery.map_or(self.motors.voltage, |battery| battery.open_circuit_voltage(battery.initial_charge))
    }

    /// Returns the largest motor speed that a command can set, rpm: [`max_rpm`](Self::max_rpm), or the speed at full
    /// duty if the constant voltage does not suffice. The voltage of a battery limits commands further.
    pub fn max_command_rpm(&self) -> f64 {
        let max = self.max_rpm();
        if self.motors.has_duty() && self.battery.is_none() {
            max.min(self.motors.speed(1.0, self.motors.voltage))
        } else {
            max
        }
    }

    /// Checks that motors and battery fit together.
    pub(super) fn validate_supply(&self) -> Result<(), DroneError> {
        let motors = &self.motors;
        let wrong = |field, got, expected| Err(DroneError::Parameter { field, got, expected });
        if self.battery.is_some() && !motors.has_duty() {
            let expected = "a positive number of rpm/V, without which [battery] has no effect";
            return wrong("motors.speed_per_volt", motors.speed_per_volt, expected);
        }
        if self.battery.is_none() && motors.has_duty() && motors.voltage == 0.0 {
            return wrong("motors.voltage", motors.voltage, "a positive voltage, or a section [battery]");
        }
        let full = motors.speed(1.0, self.nominal_voltage());
        // an empty battery is a valid start
        let is_empty = self.battery.is_some_and(|battery| battery.initial_charge == 0.0);
        if motors.has_duty() && !is_empty && full <= 0.0 {
            return wrong("motors.speed_at_zero", motors.speed_at_zero, "a speed that full duty raises above 0");
        }
        Ok(())
    }
}

/// Law from duty and voltage to the speed of a motor.
#[derive(Debug, Clone, Copy, PartialEq, Default, serde::Serialize, serde::Deserialize)]
pub(crate) struct MotorLaw<R = f64> {
    /// Speed at zero duty, rpm.
    pub at_zero: R,
    /// Speed per volt, rpm/V.
    pub per_volt: R,
}

impl From<&MotorParams> for MotorLaw {
    fn from(motors: &MotorParams) -> Self {
        Self { at_zero: motors.speed_at_zero, per_volt: motors.speed_per_volt }
    }
}

impl MotorLaw {
    /// Returns the law with the same numbers in every lane of a register like `x`.
    #[inline(always)]
    pub fn all<R: Real>(&self, x: R) -> MotorLaw<R> {
        MotorLaw { at_zero: x.all(self.at_zero), per_volt: x.all(self.per_volt) }
    }
}

impl<R: Real> MotorLaw<R> {
    /// Computes [`MotorParams::speed`], scalar or SIMD.
    #[inline(always)]
    pub fn speed(&self, duty: R, voltage: R) -> R {
        let zero = duty.all(0.0);
        let speed = zero.greater(self.at_zero + self.per_volt * (duty * voltage));
        R::choose(zero.less(voltage), speed, zero)
    }
}
