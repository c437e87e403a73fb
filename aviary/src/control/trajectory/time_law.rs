use std::f64::consts::TAU;

use super::{TrajectoryError, jet::Jet};

/// How a closed curve is run through: the angle as a function of time.
///
/// At full speed a turn takes one period. With a ramp the angle starts from rest and, where the number of turns is
/// limited, comes to rest again, with continuous derivatives up to the fourth.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct TimeLaw {
    /// Angle at the start, rad.
    pub phase: f64,
    /// Angular rate at full speed, rad/s.
    pub rate: f64,
    /// Time to get there, s.
    pub ramp: f64,
    /// Turns until the end, infinite for none.
    pub turns: f64,
}

impl TimeLaw {
    /// Integral of the seventh-order smoothstep 35τ⁴ − 84τ⁵ + 70τ⁶ − 20τ⁷, whose first three derivatives vanish at 0 and 1.
    const RAMP: [f64; 9] = [0.0, 0.0, 0.0, 0.0, 0.0, 7.0, -14.0, 10.0, -2.5];

    pub(super) fn validate(&self) -> Result<(), TrajectoryError> {
        let Self { phase, rate, ramp, turns } = *self;
        TrajectoryError::validate("phase", phase, phase.abs() <= 1e6, "a finite angle, rad")?;
        TrajectoryError::validate(
            "period",
            TAU / rate,
            rate.is_finite() && (1e-6..=1e6).contains(&rate.abs()),
            "a number of seconds up to a few days, negative to turn the other way",
        )?;
        TrajectoryError::validate("ramp", ramp, (0.0..=1e6).contains(&ramp), "zero or a positive number of seconds")?;
        TrajectoryError::validate("turns", turns, turns > 0.0, "a positive number")?;
        // ramping up and down takes half of the ramp's time at full speed each
        TrajectoryError::validate(
            "turns",
            turns,
            turns * TAU >= ramp * rate.abs(),
            "at least the ramp over the period, or full speed is never reached",
        )
    }

    /// When the last turn is over, s.
    pub(super) fn end(&self) -> f64 {
        self.turns * TAU / self.rate.abs() + self.ramp
    }

    /// The angle at a time, rad.
    pub(super) fn angle(&self, time: f64) -> Jet {
        let (rate, ramp, end) = (self.rate, self.ramp, self.end());
        let total = self.turns * TAU * rate.signum();
        if time.is_nan() {
            return Jet::constant(f64::NAN);
        }
        let ramped = |tau: Jet| tau.polynomial(&Self::RAMP) * (rate * ramp);
        let angle = if time <= 0.0 && (ramp > 0.0 || time < 0.0) {
            Jet::constant(0.0)
        } else if time < ramp {
            ramped(Jet::time(time) * (1.0 / ramp))
        } else if time < end - ramp {
            (Jet::time(time) - Jet::constant(0.5 * ramp)) * rate
        } else if time < end {
            Jet::constant(total) - ramped((Jet::constant(end) - Jet::time(time)) * (1.0 / ramp))
        } else {
            Jet::constant(total)
        };
        angle + Jet::constant(self.phase)
    }
}
