use nalgebra::{Matrix3, Rotation3, UnitQuaternion, Vector3};

use super::{ControlOutput, Controller, Mixer, Reference};
use crate::drone::{DroneParams, GRAVITY};
use crate::state::{DroneState, body_z};

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
    fn default() -> Self {
        Self { horizontal: 5.0, vertical: 11.0, tilt: 18.0, yaw: 10.0, integral: 0.0 }
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

    /// Creates a controller with the default [`Bandwidths`].
    pub fn new(params: &DroneParams) -> Self {
        Self::with_bandwidths(params, Bandwidths::default())
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

    fn integrate(&mut self, dt: f64, frequency: &Vector3<f64>, error: &Vector3<f64>) {
        if self.bandwidths.integral > 0.0 && error.norm() <= Self::INTEGRATED {
            let gain = self.bandwidths.integral * frequency.component_mul(frequency).component_mul(frequency);
            self.integral += gain.component_mul(error) * dt;
            let excess = self.integral.norm() / (0.5 * self.max_feedback);
            if excess > 1.0 {
                self.integral /= excess;
            }
        }
    }

    /// Returns the acceleration from position and velocity errors, and true if it is below all limits, that is, if it
    /// still depends on the errors.
    fn feedback(
        &self,
        gains: &[Vector3<f64>; 2],
        position: &Vector3<f64>,
        velocity: &Vector3<f64>,
    ) -> (Vector3<f64>, bool) {
        let [stiffness, damping] = gains;
        // limits the error so that the maximum feedback is sufficient to brake at the end of the approach
        let reach = [stiffness.x, stiffness.z].map(|stiffness| 4.0 * self.max_feedback / stiffness.max(1e-9));
        let sideways = position.xy().norm();
        let clipped = sideways > reach[0] || position.z.abs() > reach[1];
        let share = if sideways > reach[0] { reach[0] / sideways } else { 1.0 };
        let near = Vector3::new(position.x * share, position.y * share, position.z.max(-reach[1]).min(reach[1]));
        let value = stiffness.component_mul(&near) + damping.component_mul(velocity) + self.integral;
        let size = value.norm();
        if size > self.max_feedback { (value * (self.max_feedback / size), false) } else { (value, !clipped) }
    }

    /// Returns the torque about the body axes, N·m, that tracks a target attitude.
    fn torque(&self, dt: f64, state: &DroneState, wanted: &Attitude) -> Vector3<f64> {
        let max = Self::FASTEST_ATTITUDE / dt;
        let (tilt, yaw) = (self.bandwidths.tilt.min(max), self.bandwidths.yaw.min(max));
        let frequency = Vector3::new(tilt, tilt, yaw);
        let to_body = state.attitude.inverse() * wanted.attitude;
        let error = to_body.scaled_axis();
        let to_body = to_body.to_rotation_matrix();
        let rate = to_body * wanted.body_rate;
        let omega = state.angular_velocity;
        let angular_acceleration = frequency.component_mul(&frequency).component_mul(&error)
            + 2.0 * Self::ATTITUDE_DAMPING * frequency.component_mul(&(rate - omega))
            + to_body * wanted.angular_acceleration
            - omega.cross(&rate);
        self.inertia.component_mul(&angular_acceleration) + omega.cross(&self.inertia.component_mul(&omega))
    }

    /// Tracks a reference, or only its velocity if `position_held` is false.
    fn follow(&mut self, dt: f64, state: &DroneState, reference: &Reference, position_held: bool) -> ControlOutput {
        let output = ControlOutput::of_errors(state, reference);
        if !(self.valid && state.is_finite() && reference.is_finite() && dt > 0.0 && dt.is_finite()) {
            return output;
        }
        let up = body_z(&state.attitude);
        let up_rate = state.attitude * state.angular_velocity.cross(&Vector3::z());
        let gravity = Vector3::new(0.0, 0.0, GRAVITY);

        let frequency = self.frequency(dt);
        self.integrate(dt, &frequency, &output.position_error);
        let stiffness = if position_held { frequency.component_mul(&frequency) } else { Vector3::zeros() };
        let damping = 2.0 * Self::POSITION_DAMPING * frequency;
        let gains = [stiffness, damping];
        let (position, velocity) = (output.position_error, reference.velocity - state.velocity);
        let (feedback, live) = self.feedback(&gains, &position, &velocity);
        let mut wanted = MovingVector {
            value: reference.acceleration + gravity + feedback,
            rate: reference.jerk,
            acceleration: reference.snap,
        };
        if !wanted.value.iter().all(|x| x.is_finite()) {
            return output;
        }
        let thrust = wanted.value.dot(&up).max(0.0);
        if live {
            // the acceleration and jerk of the drone under the present thrust give the derivatives of the errors
            let acceleration = reference.acceleration - (up * thrust - gravity);
            wanted.rate += stiffness.component_mul(&velocity) + damping.component_mul(&acceleration);
            let thrust_rate = wanted.rate.dot(&up) + wanted.value.dot(&up_rate);
            let jerk = reference.jerk - (up * thrust_rate + up_rate * thrust);
            wanted.acceleration += stiffness.component_mul(&acceleration) + damping.component_mul(&jerk);
        }
        let direction = if wanted.value.norm() > Self::FREE_FALL { wanted.unit() } else { MovingVector::still(up) };
        let attitude = self.chart.attitude(&direction, reference);
        let torque = self.torque(dt, state, &attitude);
        ControlOutput { rpm: self.mixer.rpm(self.mass * thrust, torque), ..output }
    }
}

impl Controller for GeometricControl {
    fn reset(&mut self) {
        self.chart = Chart::Left(1.0);
        self.integral = Vector3::zeros();
    }

    fn control(&mut self, dt: f64, state: &DroneState, reference: &Reference) -> ControlOutput {
        self.follow(dt, state, reference, true)
    }

    fn control_velocity(&mut self, dt: f64, state: &DroneState, reference: &Reference) -> ControlOutput {
        self.follow(dt, state, &Reference { position: state.position, ..*reference }, false)
    }
}

/// A vector with its first two time derivatives.
#[derive(Debug, Clone, Copy, PartialEq)]
struct MovingVector {
    value: Vector3<f64>,
    rate: Vector3<f64>,
    acceleration: Vector3<f64>,
}

impl MovingVector {
    fn still(value: Vector3<f64>) -> Self {
        Self { value, rate: Vector3::zeros(), acceleration: Vector3::zeros() }
    }

    fn cross(&self, other: &Self) -> Self {
        Self {
            value: self.value.cross(&other.value),
            rate: self.rate.cross(&other.value) + self.value.cross(&other.rate),
            acceleration: self.acceleration.cross(&other.value)
                + 2.0 * self.rate.cross(&other.rate)
                + self.value.cross(&other.acceleration),
        }
    }

    /// Returns the unit vector u = v/‖v‖: with s = ‖v‖, s·u' = v' − s'·u and s·u'' = v'' − s''·u − 2·s'·u'.
    fn unit(&self) -> Self {
        let size = self.value.norm();
        let value = self.value / size;
        let size_rate = self.rate.dot(&value);
        let rate = (self.rate - size_rate * value) / size;
        let size_acceleration = self.acceleration.dot(&value) + self.rate.dot(&rate);
        let acceleration = (self.acceleration - size_acceleration * value - 2.0 * size_rate * rate) / size;
        Self { value, rate, acceleration }
    }
}

/// A target attitude, body to world, with its first two derivatives.
struct Attitude {
    attitude: UnitQuaternion<f64>,
    /// Body rates, body frame, rad/s.
    body_rate: Vector3<f64>,
    /// Angular acceleration, body frame, rad/s².
    angular_acceleration: Vector3<f64>,
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

impl Chart {
    /// Sine of the angle to the singular direction below which the controller leaves a chart.
    const SWITCH: f64 = 0.35;

    fn attitude(&mut self, z: &MovingVector, reference: &Reference) -> Attitude {
        let (sin, cos) = reference.yaw.sin_cos();
        let (forward, left) = (Vector3::new(cos, sin, 0.0), Vector3::new(-sin, cos, 0.0));
        let (rate, acceleration) = (reference.yaw_rate, reference.yaw_acceleration);
        // unit vector r that turns about z: r' = ψ'·n, r'' = ψ''·n − ψ'²·r, with n a quarter turn ahead of r
        let turning = |value: Vector3<f64>, ahead: Vector3<f64>| MovingVector {
            value,
            rate: rate * ahead,
            acceleration: acceleration * ahead - rate * rate * value,
        };
        let forward = turning(forward, left);
        let left = turning(left, -forward.value);
        self.choose(&z.value, &forward.value, &left.value);
        let (x, y) = match *self {
            Self::Left(sign) => {
                let x = left.scaled(sign).cross(z).unit();
                (x, z.cross(&x))
            }
            Self::Forward(sign) => {
                let y = z.cross(&forward.scaled(sign)).unit();
                (y.cross(z), y)
            }
        };
        let matrix = |part: fn(&MovingVector) -> Vector3<f64>| Matrix3::from_columns(&[part(&x), part(&y), part(z)]);
        let (r, r1, r2) = (matrix(|m| m.value), matrix(|m| m.rate), matrix(|m| m.acceleration));
        // R' = R·ω̂ and R'' = R·(ω̂² + ω̂')
        let hat = r.tr_mul(&r1);
        let vee =
            |m: &Matrix3<f64>| 0.5 * Vector3::new(m[(2, 1)] - m[(1, 2)], m[(0, 2)] - m[(2, 0)], m[(1, 0)] - m[(0, 1)]);
        Attitude {
            attitude: UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix_unchecked(r)),
            body_rate: vee(&hat),
            angular_acceleration: vee(&r.tr_mul(&r2)),
        }
    }

    /// Switches the chart near its singularity, to the closer of the two attitudes of the other chart.
    fn choose(&mut self, z: &Vector3<f64>, forward: &Vector3<f64>, left: &Vector3<f64>) {
        let turned = matches!(*self, Self::Left(sign) | Self::Forward(sign) if sign < 0.0);
        if z.z > 0.99 || (turned && z.z > 0.5) {
            // both charts agree close to upright, and an upright drone must not keep a chart of reversed heading
            *self = Self::Left(1.0);
        }
        match *self {
            Self::Left(sign) if z.cross(left).norm() < Self::SWITCH => {
                let x = (sign * left).cross(z);
                *self = Self::Forward(if x.dot(forward) >= 0.0 { 1.0 } else { -1.0 });
            }
            Self::Forward(sign) if z.cross(forward).norm() < Self::SWITCH => {
                let y = z.cross(&(sign * forward));
                *self = Self::Left(if y.dot(left) >= 0.0 { 1.0 } else { -1.0 });
            }
            _ => {}
        }
    }
}

impl MovingVector {
    fn scaled(&self, factor: f64) -> Self {
        Self { value: factor * self.value, rate: factor * self.rate, acceleration: factor * self.acceleration }
    }
}
