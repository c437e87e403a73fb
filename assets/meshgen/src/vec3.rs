//! Minimal vector arithmetic for building meshes.

use std::ops::{Add, Mul, Neg, Sub};

/// A point, in metres, or a direction, in the body frame: x forward, y left, z up.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Vec3 {
    /// Forward.
    pub x: f64,
    /// Left.
    pub y: f64,
    /// Up.
    pub z: f64,
}

/// Creates a [`Vec3`].
pub const fn vec3(x: f64, y: f64, z: f64) -> Vec3 {
    Vec3 { x, y, z }
}

impl Vec3 {
    /// The origin.
    pub const ZERO: Vec3 = vec3(0.0, 0.0, 0.0);

    /// Returns the dot product.
    pub fn dot(self, other: Vec3) -> f64 {
        self.x * other.x + self.y * other.y + self.z * other.z
    }

    /// Returns the cross product.
    pub fn cross(self, other: Vec3) -> Vec3 {
        vec3(
            self.y * other.z - self.z * other.y,
            self.z * other.x - self.x * other.z,
            self.x * other.y - self.y * other.x,
        )
    }

    /// Returns the Euclidean length.
    pub fn length(self) -> f64 {
        self.dot(self).sqrt()
    }

    /// Returns the unit vector, or zero for a zero vector.
    pub fn normalized(self) -> Vec3 {
        let length = self.length();
        if length > 0.0 { self * (1.0 / length) } else { Vec3::ZERO }
    }

    /// Returns the angle to `other`, in radians.
    pub fn angle_to(self, other: Vec3) -> f64 {
        self.cross(other).length().atan2(self.dot(other))
    }

    /// Returns the vector rotated about the z axis (x towards y) by an angle in radians.
    pub fn rotated_z(self, angle: f64) -> Vec3 {
        let (s, c) = angle.sin_cos();
        vec3(c * self.x - s * self.y, s * self.x + c * self.y, self.z)
    }

    /// Returns the vector rotated about the y axis (z towards x) by an angle in radians.
    pub fn rotated_y(self, angle: f64) -> Vec3 {
        let (s, c) = angle.sin_cos();
        vec3(c * self.x + s * self.z, self.y, c * self.z - s * self.x)
    }
}

impl Add for Vec3 {
    type Output = Vec3;

    fn add(self, other: Vec3) -> Vec3 {
        vec3(self.x + other.x, self.y + other.y, self.z + other.z)
    }
}

impl Sub for Vec3 {
    type Output = Vec3;

    fn sub(self, other: Vec3) -> Vec3 {
        vec3(self.x - other.x, self.y - other.y, self.z - other.z)
    }
}

impl Mul<f64> for Vec3 {
    type Output = Vec3;

    fn mul(self, factor: f64) -> Vec3 {
        vec3(self.x * factor, self.y * factor, self.z * factor)
    }
}

impl Neg for Vec3 {
    type Output = Vec3;

    fn neg(self) -> Vec3 {
        self * -1.0
    }
}
