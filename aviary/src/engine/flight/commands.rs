//! Commands of a control step in lanes, and what the batteries supply.

use pulp::{Simd, WithSimd};

use super::Width;
use super::lanes::{LaneParams, Lanes, Part};
use crate::action::{DutyScale, MotorScale};
use crate::math::{Real, Row, clamped};
use crate::physics::battery::BatteryLanes;

/// Conversion of the numbers of a control step to motor speeds; see [`set_commands`].
#[derive(Debug, Clone, Copy)]
pub(crate) enum Decoding {
    /// Normalized speeds.
    Scaled(MotorScale),
    /// Duties.
    Duty(DutyScale),
    /// Speeds, rpm.
    Raw,
}

struct Commands<'a> {
    lanes: &'a mut Lanes,
    lane_params: &'a LaneParams,
    batteries: Option<&'a BatteryLanes>,
    count: usize,
    decoding: Decoding,
    actions: &'a [Row; 4],
}

impl WithSimd for Commands<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        let Self { lanes, lane_params, batteries, count, decoding, actions } = self;
        for part in Part::first(simd, count) {
            let mut max = part.get(&lane_params.max_command);
            let mut voltage = match decoding {
                Decoding::Duty(scale) => max.all(scale.voltage()),
                _ => max,
            };
            if let Some(batteries) = batteries {
                let (simd, index) = part.register();
                let (own, reach) = batteries.supply(simd, index, voltage);
                (voltage, max) = (own, max.lesser(reach));
            }
            for (motor, row) in actions.iter().enumerate() {
                let action = part.get(row);
                let speed = match decoding {
                    Decoding::Scaled(scale) => scale.speed(action),
                    Decoding::Duty(scale) => scale.speed(action, voltage),
                    Decoding::Raw => action,
                };
                part.put(&mut lanes.command[motor], clamped(speed, max.all(0.0), max));
            }
        }
    }
}

/// Decodes actions to the commanded motor speeds of the first `count` lanes. `actions` has a row per motor. Batteries
/// limit the speeds.
pub(crate) fn set_commands(
    width: Width,
    decoding: Decoding,
    lanes: &mut Lanes,
    lane_params: &LaneParams,
    batteries: Option<&BatteryLanes>,
    count: usize,
    actions: &[Row; 4],
) {
    width.run(count, Commands { lanes, lane_params, batteries, count, decoding, actions });
}

struct Advance<'a> {
    batteries: &'a mut BatteryLanes,
    lanes: &'a Lanes,
    dt: f64,
    count: usize,
}

impl WithSimd for Advance<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        let Self { batteries, lanes, dt, count } = self;
        for part in Part::first(simd, count) {
            let (simd, index) = part.register();
            batteries.advance(simd, index, dt, &part.get4(&lanes.rpm));
        }
    }
}

/// Advances the batteries of the first `count` lanes by a control step of `dt` seconds.
pub(crate) fn advance_batteries(width: Width, batteries: &mut BatteryLanes, lanes: &Lanes, dt: f64, count: usize) {
    width.run(count, Advance { batteries, lanes, dt, count });
}
