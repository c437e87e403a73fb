//! Motors: gains, saturation and first-order lag of the rotor speed.

use crate::math::{Real, clamped};

/// Returns the rotor speed (rpm) that a motor approaches under a command (rpm): the command times a gain, clamped to 0
/// to `max` (rpm).
#[inline(always)]
pub fn target<R: Real>(command: R, gain: R, max: R) -> R {
    clamped(command * gain, max.all(0.0), max)
}

/// Returns the rotor speed (rpm) after a physics step: n + (n_cmd − n)·share.
///
/// `share` is 1 − exp(−dt/τ), the fraction of the remaining speed difference that the lag closes in a physics step; 1
/// without lag. Motors whose speed rises and falls with different time constants have the share of [`share`].
#[inline(always)]
pub fn follow<R: Real>(rpm: R, target: R, share: R) -> R {
    let lag = share.less(share.all(1.0));
    let slow = rpm + (target - rpm) * share;
    // without lag the speed is exactly the target; the formula would add a rounding error
    R::choose(lag, slow, target)
}

/// Returns the share of [`follow`]: `rise` where the speed is below its target, and `fall` elsewhere.
#[inline(always)]
pub fn share<R: Real>(rpm: R, target: R, rise: R, fall: R) -> R {
    R::choose(rpm.less(target), rise, fall)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_speed_closes_its_share_of_the_difference() {
        assert_eq!(follow(1000.0, 2000.0, 0.25), 1250.0);
        assert_eq!(follow(0.1, 0.3, 1.0), 0.3, "no rounding error without lag");
        assert_eq!([share(1.0, 2.0, 0.1, 0.2), share(2.0, 1.0, 0.1, 0.2)], [0.1, 0.2]);
    }

    #[test]
    fn the_target_stays_within_the_range_of_the_motor() {
        assert_eq!([-5.0, 100.0, 1e9].map(|command| target(command, 1.5, 300.0)), [0.0, 150.0, 300.0]);
        assert!(target(f64::NAN, 1.0, 300.0).is_nan());
    }
}
