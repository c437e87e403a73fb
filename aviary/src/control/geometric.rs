use nalgebra::{Matrix3, Rotation3, UnitQuaternion, Vector3};

use super::{ControlOutput, Controller, Mixer, Reference};
use crate::drone::{DroneParams, GRAVITY};
use crate::state::{DroneState, body_z};

/// How fast the loops of a [`GeometricControl`] answer: natural frequencies, rad/s. Gains follow from them and from the
/// airframe's mass and inertia.
///
/// ```
/// use aviary::control::{Bandwidths, GeometricControl};
/// use aviary::drone::DroneModel;
///
/// // an integral, against steady wind
/// let bandwidths = Bandwidths { integral: 0.1, ..Bandwidths::default() };
/// let control = GeometricControl::with_bandwidths(&DroneModel::Cf2x.params(), bandwidths);
/// assert_eq!(control.bandwidths().integral, 0.1);
/// ```
#[derive(Debug, Clone, Copy, PartialEq, serde::Serialize, serde::Deserialize)]
pub struct Bandwidths {
    /// Position, world x and y.
    pub horizontal: f64,
    /// Position, world z.
    pub vertical: f64,
    /// Attitude about body x and y.
    pub tilt: f64,
    /// Attitude about body z.
    pub yaw: f64,
    /// Integral of the position error, as a share of the frequency of its axis; 0 for none.
    pub integral: f64,
}

impl Default for Bandwidths {
    fn default() -> Self {
        Self { horizontal: 5.0, vertical: 11.0, tilt: 18.0, yaw: 10.0, integral: 0.0 }
    }
}

/// Tracking control on SE(3) (Lee, Leok and McClamroch 2010, *Geometric tracking control of a quadrotor UAV on SE(3)*),
/// with feed-forward of the trajectory's jerk and snap through differential flatness.
///
/// The thrust is to produce A = a\* + g·ẑ + k_x·e_x + k_v·e_v, per unit of mass. Body z is to point along A, and A's first and
/// second derivatives, with the accelerations that the present thrust gives, say at which body rates and angular
/// accelerations it does so. The torque is that of the paper, with the whole rotation vector of the attitude
/// error in place of its sine: the two agree for small errors, and this one does not fade for large ones.
///
/// It flies any attitude: where body z comes near the heading's left or right, where yaw says nothing, a second chart of the
/// attitude takes over, and back where it comes near the heading (the paper's desired heading must never be parallel to
/// the thrust).
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
    /// Most acceleration that errors of position and velocity may ask for, m/s².
    max_feedback: f64,
    chart: Chart,
    /// Whether its bandwidths are positive numbers.
    sound: bool,
    #[serde(with = "crate::serial::vector")]
    integral: Vector3<f64>,
}

impl GeometricControl {
    /// Damping ratio of the position loop.
    const POSITION_DAMPING: f64 = 1.0;
    /// Damping ratio of the attitude loop.
    const ATTITUDE_DAMPING: f64 = 0.9;
    /// Fastest attitude and position loop that a control rate carries, as natural frequency times control period.
    const FASTEST_ATTITUDE: f64 = 0.55;
    const FASTEST_POSITION: f64 = 0.25;
    /// Position errors beyond this are on their way home and do not enter the integral, m.
    const INTEGRATED: f64 = 0.15;
    /// Below this thrust per mass, m/s², its direction says nothing.
    const FREE_FALL: f64 = 0.3;

    /// For an airframe.
    pub fn new(params: &DroneParams) -> Self {
        Self::with_bandwidths(params, Bandwidths::default())
    }

    /// With loops that answer as fast as one wants them to, within what the control rate carries. Frequencies that are not
    /// positive numbers, and shares of the integral outside 0 to 1, give speeds that are not numbers.
    pub fn with_bandwidths(params: &DroneParams, bandwidths: Bandwidths) -> Self {
        Self {
            bandwidths,
            mass: params.mass,
            inertia: params.inertia_vector(),
            mixer: Mixer::new(params),
            // less than g, so that errors never turn a level drone over, and within what the motors have to spare
            max_feedback: GRAVITY * (0.8 * (params.thrust_to_weight - 1.0)).clamp(0.1, 0.7),
            chart: Chart::Left(1.0),
            sound: [bandwidths.horizontal, bandwidths.vertical, bandwidths.tilt, bandwidths.yaw]
                .iter()
                .all(|&frequency| frequency > 0.0 && frequency.is_finite())
                && (0.0..=1.0).contains(&bandwidths.integral),
            integral: Vector3::zeros(),
        }
    }

    /// How fast its loops are.
    pub fn bandwidths(&self) -> Bandwidths {
        self.bandwidths
    }

    /// Natural frequency of the position loop, world axes, rad/s.
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

    /// The acceleration that errors ask for, within what is allowed, and whether it still changes with them.
    fn feedback(
        &self,
        gains: &[Vector3<f64>; 2],
        position: &Vector3<f64>,
        velocity: &Vector3<f64>,
    ) -> (Vector3<f64>, bool) {
        let [stiffness, damping] = gains;
        // an error so large that its way home would need more than the most feedback to brake at its end counts as that
        let reach = [stiffness.x, stiffness.z].map(|stiffness| 4.0 * self.max_feedback / stiffness.max(1e-9));
        let sideways = position.xy().norm();
        let clipped = sideways > reach[0] || position.z.abs() > reach[1];
        let share = if sideways > reach[0] { reach[0] / sideways } else { 1.0 };
        let near = Vector3::new(position.x * share, position.y * share, position.z.max(-reach[1]).min(reach[1]));
        let value = stiffness.component_mul(&near) + damping.component_mul(velocity) + self.integral;
        let size = value.norm();
        if size > self.max_feedback { (value * (self.max_feedback / size), false) } else { (value, !clipped) }
    }

    /// Torque about the body axes, N·m, for a wanted attitude and its body rates and their derivative.
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

    /// Follows a reference, or its velocity alone.
    fn follow(&mut self, dt: f64, state: &DroneState, reference: &Reference, position_held: bool) -> ControlOutput {
        let output = ControlOutput::of_errors(state, reference);
        if !(self.sound && state.is_finite() && reference.is_finite() && dt > 0.0 && dt.is_finite()) {
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
            // the acceleration and the jerk that the present thrust gives say how the errors change
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

    /// The direction: with u = v/‖v‖ and s = ‖v‖, s·u' = v' − s'·u and s·u'' = v'' − s''·u − 2·s'·u'.
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

/// An attitude, body to world, and how it turns.
struct Attitude {
    attitude: UnitQuaternion<f64>,
    /// Body frame, rad/s.
    body_rate: Vector3<f64>,
    /// Body frame, rad/s².
    angular_acceleration: Vector3<f64>,
}

/// How a yaw and a direction of body z make an attitude. Neither way is good for every direction, and near a direction
/// where one fails the other one is good.
#[derive(Debug, Clone, Copy, PartialEq, serde::Serialize, serde::Deserialize)]
enum Chart {
    /// Body x is perpendicular to the heading's left (times the sign): the yaw of roll-pitch-yaw is the heading.
    Left(f64),
    /// Body y is perpendicular to the heading (times the sign): Lee's choice.
    Forward(f64),
}

impl Chart {
    /// A chart is left where its sine of the angle to the failing direction falls below this.
    const WORN: f64 = 0.35;

    fn attitude(&mut self, z: &MovingVector, reference: &Reference) -> Attitude {
        let (sin, cos) = reference.yaw.sin_cos();
        let (forward, left) = (Vector3::new(cos, sin, 0.0), Vector3::new(-sin, cos, 0.0));
        let (rate, acceleration) = (reference.yaw_rate, reference.yaw_acceleration);
        // a unit vector that turns about z: r' = ψ'·n, r'' = ψ''·n − ψ'²·r, n a quarter turn ahead of r
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

    /// Keeps the chart while it is good, and otherwise goes on in the other one, to the nearer of its two attitudes.
    fn choose(&mut self, z: &Vector3<f64>, forward: &Vector3<f64>, left: &Vector3<f64>) {
        let turned = matches!(*self, Self::Left(sign) | Self::Forward(sign) if sign < 0.0);
        if z.z > 0.99 || (turned && z.z > 0.5) {
            // nearly upright both agree, and this one is what yaw means; and upright none may point backwards
            *self = Self::Left(1.0);
        }
        match *self {
            Self::Left(sign) if z.cross(left).norm() < Self::WORN => {
                let x = (sign * left).cross(z);
                *self = Self::Forward(if x.dot(forward) >= 0.0 { 1.0 } else { -1.0 });
            }
            Self::Forward(sign) if z.cross(forward).norm() < Self::WORN => {
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
