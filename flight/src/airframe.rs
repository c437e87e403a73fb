//! Forces and torques that a file of an airframe adds: linear drag, translational lift, the torque of a velocity,
//! rotational damping, trim, and the angular momentum of the rotors.
//!
//! With the velocity v relative to the air and the body rate ω, both in the body frame, and the angular momentum H of
//! the rotors about body z:
//!
//! ```text
//! F    = −diag(d)·v                                 drag, body frame
//! T   += c·(v_x² + v_y²)                            translational lift
//! τ   += c_m·(v_y, −v_x, 0) − diag(d_r)·ω + τ_trim   air and trim, body frame
//! τ   += −ω × H·ẑ − dH/dt·ẑ                         gyroscopic torque, reaction torque of spinning up
//! H    = J_r·Σ sᵢ·2π/60·nᵢ                          sᵢ: direction of rotation, opposite to the reaction torque
//! ```
//!
//! Like blade drag, they follow from the state at the start of a physics step and stay constant during the step.

use crate::math::{Real, Turn, V3};

/// Coefficients of the forces and torques of an airframe and of its rotors' inertia.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct AirframeEffects<R = f64> {
    /// Linear drag along the body axes, N/(m/s).
    pub linear_drag: [R; 3],
    /// Translational lift, N/(m/s)².
    pub translational_lift: R,
    /// Torque about roll and pitch by a velocity, N·m/(m/s).
    pub velocity_moment: R,
    /// Damping of a body rate, N·m/(rad/s).
    pub rotational_damping: [R; 3],
    /// Constant torque, body frame, N·m.
    pub trim_torque: [R; 3],
    /// Angular momentum of rotor 0 per speed, about body z, N·m·s/rpm. That of rotors 1 and 3 has the other sign.
    pub momentum_per_rpm: R,
}

/// Number of coefficients of [`AirframeEffects`].
pub const EFFECTS: usize = 12;

/// Motion of a drone in [`AirframeEffects::add`] at the start of a physics step.
#[derive(Debug, Clone, Copy)]
pub struct AirframeMotion<'a, R> {
    /// Attitude.
    pub attitude: &'a Turn<R>,
    /// Velocity relative to the air, world frame, m/s.
    pub relative: V3<R>,
    /// Body rate, rad/s.
    pub rate: V3<R>,
    /// Angular momentum of the rotors in the physics step before and in this one, about body z, N·m·s.
    pub momentum: [R; 2],
}

impl<R: Real> AirframeEffects<R> {
    /// Returns all coefficients, in the order of [`of`](Self::of).
    pub fn numbers(&self) -> [R; EFFECTS] {
        let Self { linear_drag: [a, b, c], rotational_damping: [d, e, f], trim_torque: [g, h, i], .. } = *self;
        [a, b, c, d, e, f, g, h, i, self.translational_lift, self.velocity_moment, self.momentum_per_rpm]
    }

    /// Creates the effects of [`numbers`](Self::numbers).
    #[inline(always)]
    pub fn of([a, b, c, d, e, f, g, h, i, lift, moment, momentum]: [R; EFFECTS]) -> Self {
        Self {
            linear_drag: [a, b, c],
            rotational_damping: [d, e, f],
            trim_torque: [g, h, i],
            translational_lift: lift,
            velocity_moment: moment,
            momentum_per_rpm: momentum,
        }
    }

    /// Returns the angular momentum of the rotors at these speeds (rpm) about body z, N·m·s.
    #[inline(always)]
    pub fn momentum(&self, rpm: &[R; 4]) -> R {
        self.momentum_per_rpm * (rpm[0] - rpm[1] + rpm[2] - rpm[3])
    }

    /// Adds the effects of a physics step of `dt` seconds to the rotors' thrust (N) and torque (body frame, N·m), and
    /// returns the drag, world frame, N.
    #[inline(always)]
    pub fn add(&self, dt: f64, motion: &AirframeMotion<'_, R>, thrust: &mut R, torque: &mut V3<R>) -> V3<R> {
        let (v, rate, [before, now]) = (motion.attitude.back(motion.relative), motion.rate, motion.momentum);
        let [damping, trim] = [self.rotational_damping, self.trim_torque];
        *thrust = *thrust + self.translational_lift * (v.x * v.x + v.y * v.y);
        torque.x = torque.x + (self.velocity_moment * v.y - damping[0] * rate.x + trim[0] - now * rate.y);
        torque.y = torque.y + (trim[1] - self.velocity_moment * v.x - damping[1] * rate.y + now * rate.x);
        torque.z = torque.z + (trim[2] - damping[2] * rate.z - (now - before) * (1.0 / dt));
        let [x, y, z] = self.linear_drag;
        motion.attitude.forth(-V3::new(x * v.x, y * v.y, z * v.z))
    }
}
