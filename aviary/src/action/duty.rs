//! Conversion of the action type `duty`.

use crate::drone::{DroneParams, MotorLaw};
use crate::error::OptionError;
use crate::math::{Real, clamped};

/// Conversion between duties and motor speeds.
#[derive(Debug, Clone, Copy, PartialEq, serde::Serialize, serde::Deserialize)]
pub(crate) struct DutyScale {
    law: MotorLaw,
    /// Voltage of the charged battery, or the constant voltage of an airframe without a battery, V.
    voltage: f64,
}

impl DutyScale {
    /// Creates the conversion of an airframe that has a law from duty to speed.
    pub fn new(params: &DroneParams) -> Result<Self, OptionError> {
        if !params.motors.has_duty() {
            return Err(OptionError {
                option: "action_type",
                got: format!("duty for the airframe {}, which has no law from duty to motor speed", params.name),
                expected: "an airframe with [motors] speed_per_volt, or another action type",
            });
        }
        Ok(Self { law: MotorLaw::from(&params.motors), voltage: params.nominal_voltage() })
    }

    /// Returns the voltage without a battery, V.
    pub fn voltage(&self) -> f64 {
        self.voltage
    }

    /// Returns the motor speed (rpm) of a duty, which the function clamps to [0, 1], at a voltage (V).
    #[inline(always)]
    pub fn speed<R: Real>(&self, duty: R, voltage: R) -> R {
        let zero = duty.all(0.0);
        self.law.all(duty).speed(clamped(duty, zero, zero.all(1.0)), voltage)
    }
}
