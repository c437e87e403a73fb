//! What an agent says, and the motor speeds that follow.

use std::fmt;
use std::str::FromStr;

use crate::drone::DroneParams;

/// How an agent commands a drone (paper, action table).
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default)]
#[non_exhaustive]
pub enum ActionType {
    /// Four normalized motor speeds in [−1, 1], see [`MotorScale`].
    #[default]
    Rpm,
    /// One normalized motor speed in [−1, 1] for all four motors.
    OneDRpm,
}

impl ActionType {
    /// All of them.
    pub const ALL: [Self; 2] = [Self::Rpm, Self::OneDRpm];

    /// The name in lower snake case.
    pub fn name(self) -> &'static str {
        match self {
            Self::Rpm => "rpm",
            Self::OneDRpm => "one_d_rpm",
        }
    }

    /// Numbers per drone.
    pub fn size(self) -> usize {
        match self {
            Self::Rpm => 4,
            Self::OneDRpm => 1,
        }
    }
}

impl fmt::Display for ActionType {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}

impl FromStr for ActionType {
    type Err = UnknownActionType;

    fn from_str(name: &str) -> Result<Self, UnknownActionType> {
        Self::ALL.into_iter().find(|kind| kind.name() == name).ok_or_else(|| UnknownActionType(name.to_string()))
    }
}

/// A name that is no action type's.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("no action type `{0}`, expected rpm or one_d_rpm")]
pub struct UnknownActionType(pub String);

/// The mapping between normalized commands and motor speeds:
/// `a ≤ 0: (a + 1)·HOVER_RPM`, otherwise `HOVER_RPM + a·(MAX_RPM − HOVER_RPM)`.
///
/// −1 is standing still, 0 is hovering, 1 is full speed. It keeps the constants of the nominal airframe even where
/// the flown one is randomized: otherwise 0 would be the perfect trim and there would be nothing to learn.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct MotorScale {
    hover_rpm: f64,
    max_rpm: f64,
}

impl MotorScale {
    /// Of an airframe.
    pub fn new(params: &DroneParams) -> Self {
        Self { hover_rpm: params.hover_rpm(), max_rpm: params.max_rpm() }
    }

    /// Motor speed (rpm) of a normalized command, which is clipped to [−1, 1].
    #[inline]
    pub fn rpm(&self, command: f64) -> f64 {
        let command = command.clamp(-1.0, 1.0);
        if command <= 0.0 {
            (command + 1.0) * self.hover_rpm
        } else {
            self.hover_rpm + command * (self.max_rpm - self.hover_rpm)
        }
    }

    /// The normalized command of a motor speed (rpm), which is clipped to what the motor can do.
    #[inline]
    pub fn command(&self, rpm: f64) -> f64 {
        let rpm = rpm.clamp(0.0, self.max_rpm);
        if rpm <= self.hover_rpm {
            rpm / self.hover_rpm - 1.0
        } else {
            (rpm - self.hover_rpm) / (self.max_rpm - self.hover_rpm)
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::drone::DroneModel;
    use proptest::prelude::*;

    #[test]
    fn the_ends_and_the_middle_are_still_hover_and_full_speed() {
        for model in DroneModel::ALL {
            let params = model.params();
            let scale = MotorScale::new(&params);
            assert_eq!([-1.0, 0.0, -9.0].map(|a| scale.rpm(a)), [0.0, params.hover_rpm(), 0.0]);
            assert!(
                (scale.rpm(1.0) - params.max_rpm()).abs() < 1e-9 && (scale.rpm(7.0) - params.max_rpm()).abs() < 1e-9
            );
            assert!((scale.rpm(-0.5) - 0.5 * params.hover_rpm()).abs() < 1e-9);
        }
    }

    #[test]
    fn a_drone_that_can_only_just_hover_has_a_scale_too() {
        let params = DroneParams { thrust_to_weight: 1.0, ..DroneModel::Cf2x.params() };
        let scale = MotorScale::new(&params);
        assert_eq!(scale.rpm(1.0), params.hover_rpm());
        assert_eq!(scale.command(params.max_rpm()), 0.0);
    }

    proptest! {
        #[test]
        fn commands_and_speeds_are_inverse(command in -1.0..1.0) {
            let scale = MotorScale::new(&DroneModel::Race.params());
            prop_assert!((scale.command(scale.rpm(command)) - command).abs() < 1e-12);
        }
    }
}
