use nalgebra::Vector3;

use super::memory::is_finite;
use super::{ControlMemory, ControlOutput, Controller, Goal, LaneController, Mixer, Reference, Target, run};
use crate::drone::{DroneParams, GRAVITY};
use crate::math::{Real, ToFlight as _, ToNalgebra as _, Turn, V3, Weighted as _, clamped, finite_zero, sin_cos};
use crate::state::{DroneState, FlightState};

/// Natural frequencies of the loops of a [`GeometricControl`], rad/s.
///
/// The gains follow from these frequencies and from the mass and inertia of the airframe.
///
/// ```
/// use aviary::control::{Bandwidths, GeometricControl};
/// use aviary::drone::DroneModel;
///
/// // integral action against steady wind
/// let bandwidths = Bandwidths { integral: 0.1, ..Bandwidths::default() };
/// let control = GeometricControl::with_bandwidths(&DroneModel::Cf2x.params(), bandwidths);
/// assert_eq!(control.bandwidths().integral, 0.1);
/// ```
#[derive(Debug, Clone, Copy, PartialEq, serde::Serialize, serde::Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Bandwidths {
    /// Frequency of the position loop along world x and y, rad/s.
    pub horizontal: f64,
    /// Frequency of the position loop along world z, rad/s.
    pub vertical: f64,
    /// Frequency of the attitude loop about body x and y, rad/s.
    pub tilt: f64,
    /// Frequency of the attitude loop about body z, rad/s.
    pub yaw: f64,
    /// Gain of the integral of the position error, relative to the cube of the frequency of its axis; 0 disables it.
    pub integral: f64,
}

impl Default for Bandwidths {
    /// Returns the frequencies for ideal motors.
    fn default() -> Self {
        Self { horizontal: 5.0, vertical: 11.0, tilt: 18.0, yaw: 10.0, integral: 0.0 }
    }
}

impl Bandwidths {
    /// Largest crossover frequency of a loop times the time constant and latency of the motors.
    const FASTEST_CROSSOVER: f64 = 0.5;
    /// Largest ratio of the frequency of the horizontal loop to that of the attitude loop within it.
    const FASTEST_HORIZONTAL: f64 = 0.45;

    /// Returns the default frequencies, limited by the [motors](crate::drone::MotorParams) of an airframe: a loop that
    /// is faster than the thrust oscillates. [Rotational damping](crate::drone::AirParams::rotational_damping) permits
    /// a faster attitude loop.
    ///
    /// ```
    /// use aviary::control::Bandwidths;
    /// use aviary::drone::DroneModel;
    ///
    /// assert_eq!(Bandwidths::for_airframe(&DroneModel::Race.params()), Bandwidths::default());
    /// let slow = Bandwidths::for_airframe(&DroneModel::Cf21.params());
    /// assert!(slow.vertical < 0.5 * Bandwidths::default().vertical);
    /// ```
    pub fn for_airframe(params: &DroneParams) -> Self {
        let (default, motors) = (Self::default(), &params.motors);
        let delay = motors.rise_time.max(motors.fall_time) + motors.latency;
        if delay == 0.0 {
            return default;
        }
        let crossover = Self::FASTEST_CROSSOVER / delay;
        let rate_gain = 2.0 * GeometricControl::ATTITUDE_DAMPING;
        // the loop of the body rate has the crossover rate_gain·ω − d, that of the attitude ω²/(d + rate_gain·ω)
        let limit = |frequency: f64, damping: f64| {
            let half = 0.5 * rate_gain * crossover;
            let by_angle = half + (half * half + crossover * damping).sqrt();
            frequency.min((damping + crossover) / rate_gain).min(by_angle)
        };
        let [x, y, z] = [0, 1, 2].map(|axis| params.air.rotational_damping[axis] / params.inertia[axis]);
        let damping = x.min(y);
        let tilt = limit(default.tilt, damping);
        let attitude = tilt * tilt / (damping + rate_gain * tilt);
        Self {
            horizontal: default.horizontal.min(Self::FASTEST_HORIZONTAL * attitude),
            vertical: default.vertical.min(crossover),
            tilt,
            yaw: limit(default.yaw, z),
            ..default
        }
    }
}

/// Geometric tracking control on SE(3) (Lee, Leok and McClamroch 2010, *Geometric tracking control of a quadrotor UAV
/// on SE(3)*), with feed-forward of jerk and snap through differential flatness.
///
/// The target thrust per unit mass is A = a\* + g·ẑ + k_x·e_x + k_v·e_v, and the target body z axis points along A.
/// The first and second time derivatives of A give the target body rates and angular accelerations. They are
/// evaluated with the acceleration that the present thrust causes. The torque law is that of Lee et al., with the
/// rotation vector of the attitude error instead of its sine: the two agree for small errors, and the rotation vector
/// does not vanish for large ones.
///
/// The controller compensates the linear drag, the moment of the velocity, the rotational damping and the trim torque
/// of an airframe that has them, in still air.
///
/// The controller tracks any attitude. Yaw is undefined where body z points to the left or right of the heading, so
/// the controller switches to a second chart of the attitude near these directions. It switches back where body z
/// points along the heading, which is the singularity of the second chart (and of Lee et al.).
///
/// ```
/// use aviary::control::{Controller, GeometricControl, Reference};
/// use aviary::drone::DroneModel;
/// use aviary::state::DroneState;
///
/// let params = DroneModel::Race.params();
/// let mut control = GeometricControl::new(&params);
/// let output = control.control(1.0 / 48.0, &DroneState::default(), &Reference::default());
/// assert!((output.rpm[0] - params.hover_rpm()).abs() < 1e-6);
/// ```
#[derive(Debug, Clone, PartialEq, serde::Serialize, serde::Deserialize)]
pub struct GeometricControl {
    bandwidths: Bandwidths,
    mass: f64,
    #[serde(with = "crate::serial::vector")]
    inertia: Vector3<f64>,
    mixer: Mixer,
    /// Largest acceleration from the feedback of position and velocity errors, m/s².
    max_feedback: f64,
    /// Effects of the air that the controller compensates; `None` for an airframe without them.
    #[serde(default)]
    air: Option<Compensation>,
    chart: Chart,
    /// True if the bandwidths are in their ranges.
    valid: bool,
    #[serde(with = "crate::serial::vector")]
    integral: Vector3<f64>,
}

impl GeometricControl {
    /// Damping ratio of the position loop.
    const POSITION_DAMPING: f64 = 1.0;
    /// Damping ratio of the attitude loop.
    const ATTITUDE_DAMPING: f64 = 0.9;
    /// Largest natural frequency of the attitude loop times the control period.
    const FASTEST_ATTITUDE: f64 = 0.55;
    /// Largest natural frequency of the position loop times the control period.
    const FASTEST_POSITION: f64 = 0.25;
    /// Largest position error that enters the integral, m. Larger errors are transients, which would wind it up.
    const INTEGRATED: f64 = 0.15;
    /// Target thrust per unit mass below which its direction is undefined, m/s².
    const FREE_FALL: f64 = 0.3;

    /// Creates a controller with the [bandwidths for the airframe](Bandwidths::for_airframe).
    pub fn new(params: &DroneParams) -> Self {
        Self::with_bandwidths(params, Bandwidths::for_airframe(params))
    }

    /// Creates a controller with the given bandwidths.
    ///
    /// The control rate limits them: the attitude loop to 0.55 and the position loop to 0.25 divided by the control
    /// period. The controller returns NaN speeds if a frequency is not positive and finite, or if
    /// [`integral`](Bandwidths::integral) is outside 0 to 1.
    pub fn with_bandwidths(params: &DroneParams, bandwidths: Bandwidths) -> Self {
        Self {
            bandwidths,
            mass: params.mass,
            inertia: params.inertia_vector(),
            mixer: Mixer::new(params),
            // less than g, so that feedback never turns a drone over, and within the thrust margin of the motors
            max_feedback: GRAVITY * (0.8 * (params.thrust_to_weight - 1.0)).clamp(0.1, 0.7),
            air: Compensation::new(params),
            chart: Chart::Left(1.0),
            valid: [bandwidths.horizontal, bandwidths.vertical, bandwidths.tilt, bandwidths.yaw]
                .iter()
                .all(|&frequency| frequency > 0.0 && frequency.is_finite())
                && (0.0..=1.0).contains(&bandwidths.integral),
            integral: Vector3::zeros(),
        }
    }

    /// Returns the bandwidths.
    pub fn bandwidths(&self) -> Bandwidths {
        self.bandwidths
    }

    /// Returns the natural frequency of the position loop, world axes, rad/s.
    fn frequency(&self, dt: f64) -> Vector3<f64> {
        let max = Self::FASTEST_POSITION / dt;
        let (xy, z) = (self.bandwidths.horizontal.min(max), self.bandwidths.vertical.min(max));
        Vector3::new(xy, xy, z)
    }

    /// Adds a position error to the integral, where it is small enough.
    #[inline(always)]
    fn integrate<R: Real>(&self, dt: f64, integral: &mut V3<R>, error: V3<R>) {
        let frequency = self.frequency(dt);
        let gain = self.bandwidths.integral * frequency.component_mul(&frequency).component_mul(&frequency);
        let next = *integral + error.weighted(&gain) * dt;
        let one = error.x.all(1.0);
        let excess = next.norm() / one.all(0.5 * self.max_feedback);
        let next = V3::choose(one.less(excess), next.over(excess), next);
        *integral = V3::choose(one.all(Self::INTEGRATED).less(error.norm()), *integral, next);
    }

    /// Returns the acceleration from position and velocity errors, and true where it is below all limits, that is,
    /// where it still depends on the errors.
    #[inline(always)]
    fn feedback<R: Real>(
        &self,
        gains: &[Vector3<f64>; 2],
        integral: V3<R>,
        [position, velocity]: [V3<R>; 2],
    ) -> (V3<R>, R::Mask) {
        let [stiffness, damping] = gains;
        // limits the error so that the maximum feedback is sufficient to brake at the end of the approach
        let reach = |stiffness: f64| 4.0 * self.max_feedback / stiffness.max(1e-9);
        let (one, max) = (position.x.all(1.0), position.x.all(self.max_feedback));
        let (level, vertical) = (one.all(reach(stiffness.x)), one.all(reach(stiffness.z)));
        let sideways = position.level_norm();
        let is_far = level.less(sideways);
        let share = R::choose(is_far, level / sideways, one);
        let near = V3::new(position.x * share, position.y * share, clamped(position.z, -vertical, vertical));
        let value = near.weighted(stiffness) + velocity.weighted(damping) + integral;
        let size = value.norm();
        let is_large = max.less(size);
        let is_limited = is_large | is_far | vertical.less(position.z.abs());
        (V3::choose(is_large, value * (max / size), value), !is_limited)
    }

    /// Returns the torque about the body axes, N·m, that tracks a target attitude.
    #[inline(always)]
    fn torque<R: Real>(&self, dt: f64, state: &FlightState<R>, wanted: &Attitude<R>) -> V3<R> {
        let max = Self::FASTEST_ATTITUDE / dt;
        let (tilt, yaw) = (self.bandwidths.tilt.min(max), self.bandwidths.yaw.min(max));
        let frequency = Vector3::new(tilt, tilt, yaw);
        let to_body = state.attitude.turn_to(&wanted.attitude);
        let error = to_body.rotation_vector();
        let rate = to_body.forth(wanted.body_rate);
        let omega = state.rate;
        let angular_acceleration = error.weighted(&frequency.component_mul(&frequency))
            + (rate - omega).weighted(&(2.0 * Self::ATTITUDE_DAMPING * frequency))
            + to_body.forth(wanted.angular_acceleration)
            - omega.cross(rate);
        let torque = angular_acceleration.weighted(&self.inertia) + omega.cross(omega.weighted(&self.inertia));
        match &self.air {
            Some(air) => torque + air.torque(state.attitude.back(state.velocity), rate),
            None => torque,
        }
    }
}

/// Thrust and torques against the [air](crate::drone::AirParams) of an airframe.
#[derive(Debug, Clone, Copy, PartialEq, serde::Serialize, serde::Deserialize)]
struct Compensation {
    /// Linear drag over mass along the body axes, 1/s.
    #[serde(with = "crate::serial::vector")]
    drag: Vector3<f64>,
    /// Moment of the velocity, N·m/(m/s).
    moment: f64,
    /// Rotational damping, N·m/(rad/s).
    #[serde(with = "crate::serial::vector")]
    damping: Vector3<f64>,
    /// Trim torque, N·m.
    #[serde(with = "crate::serial::vector")]
    trim: Vector3<f64>,
}

impl Compensation {
    fn new(params: &DroneParams) -> Option<Self> {
        let air = &params.air;
        let (drag, damping) = (Vector3::from(air.linear_drag) / params.mass, Vector3::from(air.rotational_damping));
        let (moment, trim) = (air.velocity_moment, Vector3::from(air.trim_torque));
        let has_effect = [drag, damping, trim] != [Vector3::zeros(); 3] || moment != 0.0;
        has_effect.then_some(Self { drag, moment, damping, trim })
    }

    /// Returns the acceleration against the drag of a velocity, world frame, m/s².
    #[inline(always)]
    fn acceleration<R: Real>(&self, attitude: &Turn<R>, velocity: V3<R>) -> V3<R> {
        attitude.forth(attitude.back(velocity).weighted(&self.drag))
    }

    /// Returns the torque against the air at a velocity and a body rate, both in the body frame, N·m.
    #[inline(always)]
    fn torque<R: Real>(&self, velocity: V3<R>, rate: V3<R>) -> V3<R> {
        let zero = velocity.x.all(0.0);
        let moment = V3::new(-velocity.y, velocity.x, zero) * self.moment;
        let trim = V3::new(zero.all(self.trim.x), zero.all(self.trim.y), zero.all(self.trim.z));
        rate.weighted(&self.damping) + moment - trim
    }
}

impl LaneController for GeometricControl {
    fn memory(&self) -> ControlMemory<f64> {
        let chart = match self.chart {
            Chart::Left(sign) => sign,
            Chart::Forward(sign) => 2.0 * sign,
        };
        ControlMemory { position_integral: self.integral.to_flight(), chart, ..ControlMemory::default() }
    }

    fn set_memory(&mut self, memory: &ControlMemory<f64>) {
        self.integral = memory.position_integral.to_nalgebra();
        let chart = LaneChart(memory.chart);
        self.chart = if chart.is_forward() { Chart::Forward(chart.sign()) } else { Chart::Left(chart.sign()) };
    }

    #[inline(always)]
    fn track<R: Real>(
        &self,
        dt: f64,
        memory: &mut ControlMemory<R>,
        state: &FlightState<R>,
        target: &Target<R>,
        goal: Goal,
    ) -> [R; 4] {
        let zero = target.yaw.all(0.0);
        let up = state.attitude.up();
        let up_rate = state.attitude.forth(state.rate.cross(V3::vertical(zero.all(1.0))));
        let gravity = V3::vertical(zero.all(GRAVITY));

        let frequency = self.frequency(dt);
        let stiffness = if goal == Goal::Position { frequency.component_mul(&frequency) } else { Vector3::zeros() };
        let damping = 2.0 * Self::POSITION_DAMPING * frequency;
        let (position, velocity) = (target.position - state.position, target.velocity - state.velocity);
        let mut integral = memory.position_integral;
        if self.bandwidths.integral > 0.0 {
            self.integrate(dt, &mut integral, position);
        }
        let (feedback, is_live) = self.feedback(&[stiffness, damping], integral, [position, velocity]);
        let mut value = target.acceleration + gravity + feedback;
        if let Some(air) = &self.air {
            value = value + air.acceleration(&state.attitude, target.velocity);
        }
        // finite errors can overflow, and invalid controllers have NaN speeds
        let valid = if self.valid { zero } else { zero.all(f64::NAN) };
        let valid = valid + finite_zero([value.x, value.y, value.z]);
        memory.position_integral = V3::choose(is_finite(valid), integral, memory.position_integral);
        let thrust = value.dot(up).greater(zero);

        // the acceleration and jerk of the drone under the present thrust give the derivatives of the errors
        let acceleration = target.acceleration - (up * thrust - gravity);
        let rate = target.jerk + velocity.weighted(&stiffness) + acceleration.weighted(&damping);
        let rate = V3::choose(is_live, rate, target.jerk);
        let thrust_rate = rate.dot(up) + value.dot(up_rate);
        let jerk = target.jerk - (up * thrust_rate + up_rate * thrust);
        let second = target.snap + acceleration.weighted(&stiffness) + jerk.weighted(&damping);
        let wanted = MovingVector { value, rate, acceleration: V3::choose(is_live, second, target.snap) };

        let falls = !zero.all(Self::FREE_FALL).less(value.norm());
        let direction = MovingVector::choose(falls, &MovingVector::still(up), &wanted.unit());
        let mut chart = LaneChart(memory.chart);
        let attitude = chart.attitude(&direction, target);
        memory.chart = R::choose(is_finite(valid), chart.0, memory.chart);
        let mut speeds = self.mixer.speeds(thrust * self.mass, self.torque(dt, state, &attitude));
        for speed in &mut speeds {
            *speed = *speed + valid;
        }
        speeds
    }
}

impl Controller for GeometricControl {
    fn reset(&mut self) {
        self.chart = Chart::Left(1.0);
        self.integral = Vector3::zeros();
    }

    fn control(&mut self, dt: f64, state: &DroneState, reference: &Reference) -> ControlOutput {
        run(self, dt, state, reference, Goal::Position)
    }

    fn control_velocity(&mut self, dt: f64, state: &DroneState, reference: &Reference) -> ControlOutput {
        run(self, dt, state, reference, Goal::Velocity)
    }

    /// Returns the integral of the position errors and the chart of the attitude.
    fn internal_state(&self) -> Vec<f64> {
        let memory = self.memory();
        let V3 { x, y, z } = memory.position_integral;
        vec![x, y, z, memory.chart]
    }

    fn set_internal_state(&mut self, state: &[f64]) -> bool {
        let Ok([x, y, z, chart]) = <[f64; 4]>::try_from(state) else { return false };
        self.set_memory(&ControlMemory { position_integral: V3 { x, y, z }, chart, ..ControlMemory::default() });
        true
    }
}

/// A vector with its first two time derivatives.
#[derive(Debug, Clone, Copy)]
struct MovingVector<R> {
    value: V3<R>,
    rate: V3<R>,
    acceleration: V3<R>,
}

impl<R: Real> MovingVector<R> {
    #[inline(always)]
    fn still(value: V3<R>) -> Self {
        let zero = V3::zero(value.x);
        Self { value, rate: zero, acceleration: zero }
    }

    /// Selects lane by lane: `yes` where the mask is true, `no` elsewhere.
    #[inline(always)]
    fn choose(mask: R::Mask, yes: &Self, no: &Self) -> Self {
        Self {
            value: V3::choose(mask, yes.value, no.value),
            rate: V3::choose(mask, yes.rate, no.rate),
            acceleration: V3::choose(mask, yes.acceleration, no.acceleration),
        }
    }

    #[inline(always)]
    fn cross(&self, other: &Self) -> Self {
        Self {
            value: self.value.cross(other.value),
            rate: self.rate.cross(other.value) + self.value.cross(other.rate),
            acceleration: self.acceleration.cross(other.value)
                + self.rate.cross(other.rate) * 2.0
                + self.value.cross(other.acceleration),
        }
    }

    #[inline(always)]
    fn scaled(&self, factor: R) -> Self {
        Self { value: self.value * factor, rate: self.rate * factor, acceleration: self.acceleration * factor }
    }

    /// Returns the unit vector u = v/‖v‖: with s = ‖v‖, s·u' = v' − s'·u and s·u'' = v'' − s''·u − 2·s'·u'.
    #[inline(always)]
    fn unit(&self) -> Self {
        let size = self.value.norm();
        let value = self.value.over(size);
        let size_rate = self.rate.dot(value);
        let rate = (self.rate - value * size_rate).over(size);
        let size_acceleration = self.acceleration.dot(value) + self.rate.dot(rate);
        let acceleration = (self.acceleration - value * size_acceleration - rate * (size_rate * 2.0)).over(size);
        Self { value, rate, acceleration }
    }
}

/// Returns the axial vector of Rᵀ·D, with the columns of R and of its derivative D: R' = R·ω̂ and R'' = R·(ω̂² + ω̂').
#[inline(always)]
fn axial<R: Real>([x, y, z]: [V3<R>; 3], [x1, y1, z1]: [V3<R>; 3]) -> V3<R> {
    V3::new(z.dot(y1) - y.dot(z1), x.dot(z1) - z.dot(x1), y.dot(x1) - x.dot(y1)) * 0.5
}

/// A target attitude, body to world, with its first two derivatives.
struct Attitude<R> {
    attitude: Turn<R>,
    /// Body rates, body frame, rad/s.
    body_rate: V3<R>,
    /// Angular acceleration, body frame, rad/s².
    angular_acceleration: V3<R>,
}

/// Chart that maps a yaw and a direction of body z to an attitude.
///
/// Each chart is singular for some directions of body z, where the other one is regular.
#[derive(Debug, Clone, Copy, PartialEq, serde::Serialize, serde::Deserialize)]
enum Chart {
    /// Body x is perpendicular to the left of the heading, with this sign: roll-pitch-yaw has the yaw of the heading.
    Left(f64),
    /// Body y is perpendicular to the heading, with this sign: the chart of Lee et al.
    Forward(f64),
}

/// A [`Chart`] as a number: its sign for [`Chart::Left`], twice its sign for [`Chart::Forward`].
struct LaneChart<R>(R);

impl<R: Real> LaneChart<R> {
    /// Sine of the angle to the singular direction below which the controller leaves a chart.
    const SWITCH: f64 = 0.35;

    #[inline(always)]
    fn is_forward(&self) -> R::Mask {
        self.0.all(1.5).less(self.0.abs())
    }

    #[inline(always)]
    fn sign(&self) -> R {
        self.0.all(1.0).with_sign_of(self.0)
    }

    #[inline(always)]
    fn attitude(&mut self, z: &MovingVector<R>, target: &Target<R>) -> Attitude<R> {
        let (sin, cos) = sin_cos(target.yaw);
        let zero = sin.all(0.0);
        let (forward, left) = (V3::new(cos, sin, zero), V3::new(-sin, cos, zero));
        let (rate, acceleration) = (target.yaw_rate, target.yaw_acceleration);
        // unit vector r that turns about z: r' = ψ'·n, r'' = ψ''·n − ψ'²·r, with n a quarter turn ahead of r
        let forward = MovingVector {
            value: forward,
            rate: left * rate,
            acceleration: left * acceleration - forward * (rate * rate),
        };
        let left = MovingVector {
            value: left,
            rate: -forward.value * rate,
            acceleration: -forward.value * acceleration - left * (rate * rate),
        };
        self.choose(z.value, forward.value, left.value);
        let (sign, is_forward) = (self.sign(), self.is_forward());
        let mut x = left.scaled(sign).cross(z).unit();
        let mut y = z.cross(&x);
        if R::any(is_forward) {
            let other = z.cross(&forward.scaled(sign)).unit();
            x = MovingVector::choose(is_forward, &other.cross(z), &x);
            y = MovingVector::choose(is_forward, &other, &y);
        }
        let axes = [x.value, y.value, z.value];
        Attitude {
            attitude: Turn::from_axes(x.value, y.value, z.value),
            body_rate: axial(axes, [x.rate, y.rate, z.rate]),
            angular_acceleration: axial(axes, [x.acceleration, y.acceleration, z.acceleration]),
        }
    }

    /// Switches the chart near its singularity, to the closer of the two attitudes of the other chart.
    #[inline(always)]
    fn choose(&mut self, z: V3<R>, forward: V3<R>, left: V3<R>) {
        let (zero, one, switch) = (z.x.all(0.0), z.x.all(1.0), z.x.all(Self::SWITCH));
        // both charts agree close to upright, and an upright drone must not keep a chart of reversed heading
        let is_upright = one.all(0.99).less(z.z) | (self.0.less(zero) & one.all(0.5).less(z.z));
        self.0 = R::choose(is_upright, one, self.0);
        let (sign, is_forward) = (self.sign(), self.is_forward());
        let from_left = !is_forward & z.cross(left).norm().less(switch);
        let from_forward = is_forward & z.cross(forward).norm().less(switch);
        if R::any(from_left | from_forward) {
            let (x, y) = ((left * sign).cross(z), z.cross(forward * sign));
            let to_forward = R::choose(x.dot(forward).less(zero), one.all(-2.0), one.all(2.0));
            let to_left = R::choose(y.dot(left).less(zero), -one, one);
            self.0 = R::choose(from_left, to_forward, R::choose(from_forward, to_left, self.0));
        }
    }
}
