use crate::math::{Real, V3};

/// State that the control loops of one drone keep between control steps. Every controller uses a part of it.
///
/// `R` is a double for one drone, a row or a SIMD register for the drones in lanes, or a number of a program that is
/// being built for another device. See [`ActionDecoder::speeds`](crate::action::ActionDecoder::speeds).
#[derive(Debug, Clone, Copy)]
pub struct ControlMemory<R> {
    /// Yaw setpoint of a commanded yaw rate, rad; NaN or a number above 10³⁰ before the first command.
    pub heading: R,
    /// Integral of the position errors.
    pub position_integral: V3<R>,
    /// Integral of the attitude errors, rad·s.
    pub attitude_integral: V3<R>,
    /// Position of the rate-limited setpoint, world frame, m.
    pub setpoint: V3<R>,
    /// Yaw of the rate-limited setpoint, rad; NaN or a number above 10³⁰ before the first control step.
    pub setpoint_yaw: R,
    /// Chart of the attitude: ±1 for the heading's left, ±2 for its forward direction, with the sign of the chart.
    pub chart: R,
}

impl Default for ControlMemory<f64> {
    /// State at the start of an episode.
    fn default() -> Self {
        let zero = V3::zero(0.0);
        Self {
            heading: f64::NAN,
            position_integral: zero,
            attitude_integral: zero,
            setpoint: zero,
            setpoint_yaw: f64::NAN,
            chart: 1.0,
        }
    }
}

impl<R> ControlMemory<R> {
    /// Applies a function to every number.
    #[inline(always)]
    pub fn map<T>(&self, f: impl Fn(&R) -> T) -> ControlMemory<T> {
        let Self { heading, position_integral: p, attitude_integral: a, setpoint: s, setpoint_yaw, chart } = self;
        ControlMemory {
            heading: f(heading),
            position_integral: V3 { x: f(&p.x), y: f(&p.y), z: f(&p.z) },
            attitude_integral: V3 { x: f(&a.x), y: f(&a.y), z: f(&a.z) },
            setpoint: V3 { x: f(&s.x), y: f(&s.y), z: f(&s.z) },
            setpoint_yaw: f(setpoint_yaw),
            chart: f(chart),
        }
    }

    /// Applies a function to every number and its counterpart.
    #[inline(always)]
    pub fn update<T: Copy>(&mut self, from: &ControlMemory<T>, f: impl Fn(&mut R, T)) {
        let Self { position_integral: p, attitude_integral: a, setpoint: s, .. } = self;
        for (to, from) in [(p, from.position_integral), (a, from.attitude_integral), (s, from.setpoint)] {
            f(&mut to.x, from.x);
            f(&mut to.y, from.y);
            f(&mut to.z, from.z);
        }
        f(&mut self.heading, from.heading);
        f(&mut self.setpoint_yaw, from.setpoint_yaw);
        f(&mut self.chart, from.chart);
    }
}

impl ControlMemory<f64> {
    /// Returns the two integrals as numbers.
    pub fn integrals(&self) -> [f64; 6] {
        let (V3 { x, y, z }, V3 { x: a, y: b, z: c }) = (self.position_integral, self.attitude_integral);
        [x, y, z, a, b, c]
    }

    /// Creates the memory of a controller that uses at most the integrals.
    pub fn of_integrals([x, y, z, a, b, c]: [f64; 6]) -> Self {
        Self { position_integral: V3 { x, y, z }, attitude_integral: V3 { x: a, y: b, z: c }, ..Self::default() }
    }
}

impl<R: Real> ControlMemory<R> {
    /// Replaces the memory by another one where the mask is true.
    #[inline(always)]
    pub fn replace_where(&mut self, mask: R::Mask, other: &Self) {
        self.update(
            other,
            #[inline(always)]
            |old, new| *old = R::choose(mask, new, *old),
        );
    }
}

/// Returns true where a number is finite.
#[inline(always)]
pub(super) fn is_finite<R: Real>(number: R) -> R::Mask {
    number.abs().less(number.all(f64::INFINITY))
}

/// Returns true where a setpoint has been set. Devices whose programs have no NaN mark a missing one with a large
/// number.
#[inline(always)]
pub(super) fn is_set<R: Real>(setpoint: R) -> R::Mask {
    setpoint.abs().less(setpoint.all(1e30))
}
