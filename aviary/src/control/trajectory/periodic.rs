use std::f64::consts::TAU;

use nalgebra::Vector3;

use super::jet::Jet;
use super::time_law::TimeLaw;
use super::{Trajectory, TrajectoryError};
use crate::control::Reference;
use crate::state::wrap_angle;

/// Yaw along a periodic trajectory.
///
/// ```
/// use std::f64::consts::FRAC_PI_2;
///
/// use aviary::control::trajectory::{PeriodicTrajectory, Heading, Trajectory};
///
/// let circle = PeriodicTrajectory::circle(1.0, 10.0)?.heading(Heading::Forward)?;
/// // the circle starts at (1, 0, 1) in direction of y
/// assert!((circle.reference(0.0).yaw - FRAC_PI_2).abs() < 1e-12);
/// # Ok::<(), aviary::control::trajectory::TrajectoryError>(())
/// ```
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Heading {
    /// A constant yaw, rad.
    Fixed(f64),
    /// A constant yaw rate.
    Turning {
        /// Yaw at the start, rad.
        yaw: f64,
        /// Yaw rate, rad/s.
        rate: f64,
    },
    /// The direction of the horizontal velocity; yaw 0 where the trajectory is vertical.
    Forward,
}

/// Plane of a periodic trajectory: the two axes between which its angle is measured.
///
/// ```
/// use aviary::control::trajectory::{PeriodicTrajectory, Plane, Trajectory};
///
/// assert_eq!(Plane::normal([2.0, 0.0, 0.0])?, Plane::YZ);
/// // the plane is inclined by 45°, and the circle is highest after a quarter turn
/// let circle = PeriodicTrajectory::circle(0.5, 4.0)?.plane(Plane::normal([1.0, 0.0, 1.0])?);
/// assert!((circle.reference(1.0).position.z - (1.0 + 0.5 * 0.5_f64.sqrt())).abs() < 1e-12);
/// # Ok::<(), aviary::control::trajectory::TrajectoryError>(())
/// ```
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Plane {
    first: Vector3<f64>,
    second: Vector3<f64>,
}

impl Plane {
    /// Horizontal plane; the angle turns from x to y.
    pub const XY: Self = Self { first: Vector3::new(1.0, 0.0, 0.0), second: Vector3::new(0.0, 1.0, 0.0) };
    /// Vertical plane perpendicular to x; the angle turns from y to z.
    pub const YZ: Self = Self { first: Vector3::new(0.0, 1.0, 0.0), second: Vector3::new(0.0, 0.0, 1.0) };
    /// Vertical plane perpendicular to y; the angle turns from x to z.
    pub const XZ: Self = Self { first: Vector3::new(1.0, 0.0, 0.0), second: Vector3::new(0.0, 0.0, 1.0) };

    /// Creates the plane with a normal (world frame, any length). The angle turns about the normal and starts at a
    /// horizontal axis.
    ///
    /// # Errors
    /// [`TrajectoryError::Value`] for a normal of zero or infinite length.
    pub fn normal(normal: [f64; 3]) -> Result<Self, TrajectoryError> {
        let normal = Vector3::from(normal);
        let size = normal.norm();
        TrajectoryError::validate("the length of normal", size, (1e-9..1e9).contains(&size), "a positive number")?;
        let normal = normal / size;
        let level = Vector3::z().cross(&normal);
        let first = if level.norm() < 1e-9 { Vector3::x() } else { level.normalize() };
        Ok(Self { first, second: normal.cross(&first) })
    }

    fn axis(&self) -> Vector3<f64> {
        self.first.cross(&self.second)
    }
}

#[derive(Debug, Clone, Copy, PartialEq)]
enum PathShape {
    Circle { radius: f64 },
    Lemniscate { half_length: f64, half_width: f64 },
    Helix { radius: f64, climb: f64 },
}

/// A circle, a lemniscate (figure eight) or a helix, at a constant angular rate or from rest to rest.
///
/// ```
/// use aviary::control::trajectory::{PeriodicTrajectory, Plane, Trajectory};
///
/// // the paper's vertical circle: 0.3 m, 8 s, in the YZ plane
/// let circle = PeriodicTrajectory::circle(0.3, 8.0)?.plane(Plane::YZ).centre([0.0, 0.0, 1.0]);
/// let start = circle.reference(0.0);
/// assert_eq!(start.position.as_slice(), [0.0, 0.3, 1.0]);
/// assert!((start.velocity.z - 0.3 * std::f64::consts::TAU / 8.0).abs() < 1e-12);
/// # Ok::<(), aviary::control::trajectory::TrajectoryError>(())
/// ```
#[derive(Debug, Clone, PartialEq)]
pub struct PeriodicTrajectory {
    shape: PathShape,
    centre: Vector3<f64>,
    plane: Plane,
    heading: Heading,
    time_law: TimeLaw,
}

impl PeriodicTrajectory {
    /// Creates a circle from its radius (m) and period (s per turn; negative to reverse the direction).
    ///
    /// # Errors
    /// [`TrajectoryError::Value`] for a value outside its range.
    pub fn circle(radius: f64, period: f64) -> Result<Self, TrajectoryError> {
        length("radius", radius)?;
        Self::new(PathShape::Circle { radius }, period)
    }

    /// Creates a lemniscate: `half_length`·sin θ along the first axis of the plane and `half_width`·sin 2θ along the
    /// second, m, with the period in s per turn. It starts at its centre, where the speed is highest.
    ///
    /// # Errors
    /// [`TrajectoryError::Value`] for a value outside its range.
    pub fn lemniscate(half_length: f64, half_width: f64, period: f64) -> Result<Self, TrajectoryError> {
        length("half_length", half_length)?;
        length("half_width", half_width)?;
        Self::new(PathShape::Lemniscate { half_length, half_width }, period)
    }

    /// Creates a lemniscate from its peak speed, m/s, instead of its period.
    ///
    /// # Errors
    /// [`TrajectoryError::Value`] for a value outside its range.
    pub fn lemniscate_at(half_length: f64, half_width: f64, peak_speed: f64) -> Result<Self, TrajectoryError> {
        length("peak_speed", peak_speed)?;
        // ‖(A·cos θ, 2B·cos 2θ)‖ is largest at the centre
        let peak = half_length.hypot(2.0 * half_width);
        Self::lemniscate(half_length, half_width, TAU * peak / peak_speed)
    }

    /// Creates a helix from its radius (m), period (s per turn) and pitch (m along the normal per turn).
    ///
    /// # Errors
    /// [`TrajectoryError::Value`] for a value outside its range.
    pub fn helix(radius: f64, period: f64, climb: f64) -> Result<Self, TrajectoryError> {
        length("radius", radius)?;
        TrajectoryError::validate("climb", climb, climb.abs() <= 1e6, "a finite number of metres up to 1e6")?;
        Self::new(PathShape::Helix { radius, climb }, period)
    }

    fn new(shape: PathShape, period: f64) -> Result<Self, TrajectoryError> {
        let time_law = TimeLaw { phase: 0.0, rate: TAU / period, ramp: 0.0, turns: f64::INFINITY };
        time_law.validate()?;
        let centre = Vector3::new(0.0, 0.0, 1.0);
        Ok(Self { shape, centre, plane: Plane::XY, heading: Heading::Fixed(0.0), time_law })
    }

    /// Sets the centre, world frame, m; default (0, 0, 1). A helix starts in the plane through its centre.
    #[must_use]
    pub fn centre(self, centre: [f64; 3]) -> Self {
        Self { centre: centre.into(), ..self }
    }

    /// Sets the plane; default horizontal.
    #[must_use]
    pub fn plane(self, plane: Plane) -> Self {
        Self { plane, ..self }
    }

    /// Sets the angle at the start, rad; default 0.
    ///
    /// # Errors
    /// [`TrajectoryError::Value`] for a value outside its range.
    pub fn phase(mut self, phase: f64) -> Result<Self, TrajectoryError> {
        self.time_law.phase = phase;
        self.time_law.validate()?;
        Ok(self)
    }

    /// Sets the yaw; default a constant 0.
    ///
    /// # Errors
    /// [`TrajectoryError::Value`] for an angle or rate outside its range, and for [`Heading::Forward`] in a vertical
    /// plane.
    pub fn heading(self, heading: Heading) -> Result<Self, TrajectoryError> {
        let (yaw, rate) = match heading {
            Heading::Fixed(yaw) => (yaw, 0.0),
            Heading::Turning { yaw, rate } => (yaw, rate),
            Heading::Forward => (0.0, 0.0),
        };
        TrajectoryError::validate("yaw", yaw, yaw.abs() <= 1e6, "a finite angle, rad")?;
        TrajectoryError::validate("yaw_rate", rate, rate.abs() <= 1e3, "a finite rate up to 1000 rad/s")?;
        let slope = self.plane.axis().z.abs();
        if heading == Heading::Forward {
            let expected = "at least 0.1 for a forward heading, which is undefined where a trajectory goes straight up";
            TrajectoryError::validate("the vertical component of normal", slope, slope >= 0.1, expected)?;
        }
        Ok(Self { heading, ..self })
    }

    /// Sets the time from rest to full speed at the start, and back to rest at the end, s; default 0 (constant
    /// speed).
    ///
    /// # Errors
    /// [`TrajectoryError::Value`] for a value outside its range, and for ramps that do not fit into the turns.
    pub fn ramp(mut self, seconds: f64) -> Result<Self, TrajectoryError> {
        self.time_law.ramp = seconds;
        self.time_law.validate()?;
        Ok(self)
    }

    /// Sets the number of turns; default infinite.
    ///
    /// # Errors
    /// [`TrajectoryError::Value`] for a value that is not positive, and for ramps that do not fit into the turns.
    pub fn turns(mut self, turns: f64) -> Result<Self, TrajectoryError> {
        self.time_law.turns = turns;
        self.time_law.validate()?;
        Ok(self)
    }

    /// Returns the coordinates of the position along the axes and the normal of the plane, and those of the tangent.
    fn local(&self, angle: Jet) -> ([Jet; 3], [Jet; 3]) {
        let (sin, cos) = angle.sin_cos();
        let zero = Jet::constant(0.0);
        match self.shape {
            PathShape::Circle { radius } => ([cos * radius, sin * radius, zero], [sin * -radius, cos * radius, zero]),
            PathShape::Lemniscate { half_length, half_width } => {
                let (sin2, cos2) = (angle * 2.0).sin_cos();
                ([sin * half_length, sin2 * half_width, zero], [cos * half_length, cos2 * (2.0 * half_width), zero])
            }
            PathShape::Helix { radius, climb } => {
                // the climb is positive in both directions of rotation
                let step = climb / TAU * self.time_law.rate.signum();
                let rise = (angle - Jet::constant(self.time_law.phase)) * step;
                let step = Jet::constant(step);
                ([cos * radius, sin * radius, rise], [sin * -radius, cos * radius, step])
            }
        }
    }

    fn world(&self, local: &[Jet; 3]) -> [Jet; 3] {
        let (u, v, n) = (self.plane.first, self.plane.second, self.plane.axis());
        std::array::from_fn(|axis| local[0] * u[axis] + local[1] * v[axis] + local[2] * n[axis])
    }
}

fn length(what: &'static str, metres: f64) -> Result<(), TrajectoryError> {
    TrajectoryError::validate(what, metres, metres > 0.0 && metres <= 1e6, "a positive number up to 1e6")
}

impl Trajectory for PeriodicTrajectory {
    fn reference(&self, time: f64) -> Reference {
        let (position, tangent) = self.local(self.time_law.angle(time));
        let position = self.world(&position);
        let derivative = |k: usize| Vector3::from_fn(|axis, _| position[axis].derivative(k));
        let [yaw, yaw_rate, yaw_acceleration] = match self.heading {
            Heading::Fixed(yaw) => [yaw, 0.0, 0.0],
            Heading::Turning { yaw, rate } => {
                let inside = time.max(0.0).min(self.time_law.end());
                [wrap_angle(yaw + rate * inside), if time == inside { rate } else { 0.0 }, 0.0]
            }
            Heading::Forward => {
                let [x, y, _] = self.world(&tangent.map(|part| part * self.time_law.rate.signum()));
                direction(x, y)
            }
        };
        Reference {
            position: self.centre + derivative(0),
            velocity: derivative(1),
            acceleration: derivative(2),
            jerk: derivative(3),
            snap: derivative(4),
            yaw,
            yaw_rate,
            yaw_acceleration,
        }
    }

    fn duration(&self) -> f64 {
        let end = self.time_law.end();
        if end.is_finite() { end } else { TAU / self.time_law.rate.abs() + self.time_law.ramp }
    }
}

/// Returns atan2(y, x) and its first two derivatives.
fn direction(x: Jet, y: Jet) -> [f64; 3] {
    let [x0, x1, x2] = [0, 1, 2].map(|k| x.derivative(k));
    let [y0, y1, y2] = [0, 1, 2].map(|k| y.derivative(k));
    let size = x0 * x0 + y0 * y0;
    if size < 1e-12 {
        // vertical: the heading is undefined
        return [0.0; 3];
    }
    let rate = (x0 * y1 - y0 * x1) / size;
    let acceleration = (x0 * y2 - y0 * x2) / size - 2.0 * rate * (x0 * x1 + y0 * y1) / size;
    [y0.atan2(x0), rate, acceleration]
}
