use std::f64::consts::TAU;

use super::{TrajectoryError, jet::Jet};

/// Time law of a periodic trajectory: the angle as a function of time.
///
/// At full speed a turn takes one period. With a ramp the angle starts at rest and, if the number of turns is finite,
/// ends at rest. Its derivatives are continuous up to the fourth.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct TimeLaw {
    /// Angle at the start, rad.
    pub phase: f64,
    /// Angular rate at full speed, rad/s.
    pub rate: f64,
    /// Time from rest to full speed, s.
    pub ramp: f64,
    /// Number of turns; infinite without an end.
    pub turns: f64,
}

impl TimeLaw {
    /// Coefficients of the integral of the seventh-order smoothstep 35τ⁴ − 84τ⁵ + 70τ⁶ − 20τ⁷. The first three
    /// derivatives of the smoothstep are zero at 0 and 1.
    const RAMP: [f64; 9] = [0.0, 0.0, 0.0, 0.0, 0.0, 7.0, -14.0, 10.0, -2.5];

    pub(super) fn validate(&self) -> Result<(), TrajectoryError> {
        let Self { phase, rate, ramp, turns } = *self;
        TrajectoryError::validate("phase", phase, phase.abs() <= 1e6, "a finite angle, rad")?;
        TrajectoryError::validate(
            "period",
            TAU / rate,
            rate.is_finite() && (1e-6..=1e6).contains(&rate.abs()),
            "1e-5 to 6e6 s, negative to reverse the direction",
        )?;
        TrajectoryError::validate("ramp", ramp, (0.0..=1e6).contains(&ramp), "zero or a positive number of seconds")?;
        TrajectoryError::validate("turns", turns, turns > 0.0, "a positive number")?;
        // each ramp covers half of the angle that full speed covers in the same time
        TrajectoryError::validate(
            "turns",
            turns,
            turns * TAU >= ramp * rate.abs(),
            "at least ramp / period, or full speed is never reached",
        )
    }

    /// Returns the time at which the last turn ends, s.
    pub(super) fn end(&self) -> f64 {
        self.turns * TAU / self.rate.abs() + self.ramp
    }

    /// Returns the angle at a time (s), rad.
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
