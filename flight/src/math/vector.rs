use std::f64::consts::{FRAC_PI_2, PI, TAU};
use std::ops::{Add, Mul, Neg, Sub};

use super::{Real, asin, atan2, clamped, sin_cos_of_turns};

/// A vector of three numbers.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct V3<R> {
    /// Component along x.
    pub x: R,
    /// Component along y.
    pub y: R,
    /// Component along z.
    pub z: R,
}

impl<R: Real> V3<R> {
    /// Creates a vector.
    #[inline(always)]
    pub fn new(x: R, y: R, z: R) -> Self {
        Self { x, y, z }
    }

    /// Returns the scalar product.
    #[inline(always)]
    pub fn dot(self, other: Self) -> R {
        self.x * other.x + self.y * other.y + self.z * other.z
    }

    /// Returns the vector product.
    #[inline(always)]
    pub fn cross(self, other: Self) -> Self {
        Self {
            x: self.y * other.z - self.z * other.y,
            y: self.z * other.x - self.x * other.z,
            z: self.x * other.y - self.y * other.x,
        }
    }

    /// Returns the component-wise product.
    #[inline(always)]
    pub fn times(self, other: Self) -> Self {
        Self { x: self.x * other.x, y: self.y * other.y, z: self.z * other.z }
    }

    /// Returns the norm of the x and y components.
    #[inline(always)]
    pub fn level_norm(self) -> R {
        (self.x * self.x + self.y * self.y).sqrt()
    }

    /// Returns the norm.
    #[inline(always)]
    pub fn norm(self) -> R {
        self.dot(self).sqrt()
    }

    /// Returns a vector of zeros in a register of the same width as a number.
    #[inline(always)]
    pub fn zero(like: R) -> Self {
        let zero = like.all(0.0);
        Self { x: zero, y: zero, z: zero }
    }

    /// Returns a vector along z.
    #[inline(always)]
    pub fn vertical(z: R) -> Self {
        let zero = z.all(0.0);
        Self { x: zero, y: zero, z }
    }

    /// Divides every component by a number.
    #[inline(always)]
    pub fn over(self, divisor: R) -> Self {
        Self { x: self.x / divisor, y: self.y / divisor, z: self.z / divisor }
    }

    /// Clamps every component to ±`limit`; NaN stays NaN.
    #[inline(always)]
    pub fn clamped(self, limit: f64) -> Self {
        let (low, high) = (self.x.all(-limit), self.x.all(limit));
        Self { x: clamped(self.x, low, high), y: clamped(self.y, low, high), z: clamped(self.z, low, high) }
    }

    /// Selects lane by lane: `yes` where the mask is true, `no` elsewhere.
    #[inline(always)]
    pub fn choose(mask: R::Mask, yes: Self, no: Self) -> Self {
        Self { x: R::choose(mask, yes.x, no.x), y: R::choose(mask, yes.y, no.y), z: R::choose(mask, yes.z, no.z) }
    }
}

impl<R: Real> Add for V3<R> {
    type Output = Self;

    #[inline(always)]
    fn add(self, other: Self) -> Self {
        Self { x: self.x + other.x, y: self.y + other.y, z: self.z + other.z }
    }
}

impl<R: Real> Sub for V3<R> {
    type Output = Self;

    #[inline(always)]
    fn sub(self, other: Self) -> Self {
        Self { x: self.x - other.x, y: self.y - other.y, z: self.z - other.z }
    }
}

impl<R: Real> Neg for V3<R> {
    type Output = Self;

    #[inline(always)]
    fn neg(self) -> Self {
        Self { x: -self.x, y: -self.y, z: -self.z }
    }
}

/// Scales a vector by a double or by one factor per lane.
impl<R: Real + Mul<F, Output = R>, F: Copy> Mul<F> for V3<R> {
    type Output = Self;

    #[inline(always)]
    fn mul(self, factor: F) -> Self {
        Self { x: self.x * factor, y: self.y * factor, z: self.z * factor }
    }
}

/// A rotation as a unit quaternion.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Turn<R> {
    /// Scalar part.
    pub w: R,
    /// Vector part.
    pub v: V3<R>,
}

impl<R: Real> Turn<R> {
    /// Creates a rotation from roll, pitch and yaw, rad: yaw about z, then pitch about y', then roll about x''.
    #[inline(always)]
    pub fn from_rpy(rpy: V3<R>) -> Self {
        const HALF_TURNS: f64 = 0.5 / TAU;
        let (sr, cr) = sin_cos_of_turns(rpy.x * HALF_TURNS);
        let (sp, cp) = sin_cos_of_turns(rpy.y * HALF_TURNS);
        let (sy, cy) = sin_cos_of_turns(rpy.z * HALF_TURNS);
        let (upright, inverted) = (cr * cp, sr * sp);
        let (rolled, pitched) = (sr * cp, cr * sp);
        Self {
            w: upright * cy + inverted * sy,
            v: V3::new(rolled * cy - pitched * sy, pitched * cy + rolled * sy, upright * sy - inverted * cy),
        }
    }

    /// Creates the rotation whose frame has these axes: orthogonal unit vectors, right-handed.
    #[inline(always)]
    pub fn from_axes(x: V3<R>, y: V3<R>, z: V3<R>) -> Self {
        let one = x.x.all(1.0);
        let trace = x.x + y.y + z.z;
        let (rolled, pitched, yawed) = (y.z - z.y, z.x - x.z, x.y - y.x);
        // four times the square of the largest component, and four times its products with the other ones
        let (mut square, mut w, mut v) = (trace + 1.0, trace + 1.0, V3::new(rolled, pitched, yawed));
        let is_small = !one.all(0.0).less(trace);
        if R::any(is_small) {
            let (xy, xz, yz) = (y.x + x.y, z.x + x.z, z.y + y.z);
            let along = V3::new(one + x.x - y.y - z.z, one + y.y - x.x - z.z, one + z.z - x.x - y.y);
            let (x_above, y_above) = (y.y.less(x.x) & z.z.less(x.x), z.z.less(y.y));
            let pick = V3::choose(y_above, V3::new(xy, along.y, yz), V3::new(xz, yz, along.z));
            let pick = V3::choose(x_above, V3::new(along.x, xy, xz), pick);
            let pick_w = R::choose(x_above, rolled, R::choose(y_above, pitched, yawed));
            let pick_square = R::choose(x_above, along.x, R::choose(y_above, along.y, along.z));
            square = R::choose(is_small, pick_square, square);
            w = R::choose(is_small, pick_w, w);
            v = V3::choose(is_small, pick, v);
        }
        let scale = one.all(0.5) / square.sqrt();
        Self { w: w * scale, v: v * scale }
    }

    /// Returns the rotation from this frame to another one, in this frame: the inverse of this rotation times `other`.
    #[inline(always)]
    pub fn turn_to(&self, other: &Self) -> Self {
        let (a, b) = (self, other);
        Self { w: a.w * b.w + a.v.dot(b.v), v: b.v * a.w - a.v * b.w - a.v.cross(b.v) }
    }

    /// Returns the rotation vector: the axis times the angle, which is at most π, rad.
    #[inline(always)]
    pub fn rotation_vector(&self) -> V3<R> {
        let zero = self.w.all(0.0);
        // a quaternion and its negative are the same rotation
        let v = V3::choose(self.w.less(zero), -self.v, self.v);
        let sine = v.norm();
        let angle = atan2(sine, self.w.abs()) * 2.0;
        v * R::choose(zero.less(sine), angle / sine, zero.all(2.0))
    }

    /// Rotates a vector from the rotated frame (body) to the fixed frame (world).
    #[inline(always)]
    pub fn forth(&self, v: V3<R>) -> V3<R> {
        let across = self.v.cross(v) * 2.0;
        v + across * self.w + self.v.cross(across)
    }

    /// Rotates a vector from the fixed frame (world) to the rotated frame (body).
    #[inline(always)]
    pub fn back(&self, v: V3<R>) -> V3<R> {
        let across = self.v.cross(v) * 2.0;
        v - across * self.w + self.v.cross(across)
    }

    /// Returns the z axis of the rotated frame in the fixed frame.
    #[inline(always)]
    pub fn up(&self) -> V3<R> {
        let (w, V3 { x, y, z }) = (self.w, self.v);
        V3::new((x * z + w * y) * 2.0, (y * z - w * x) * 2.0, w.all(1.0) - (x * x + y * y) * 2.0)
    }

    /// Sine of the pitch, 0.06° from ±90°, above which roll and yaw are computed from half angles. Closer to ±90° the
    /// entries of the rotation matrix cancel almost completely.
    const STEEP: f64 = 1.0 - 5e-7;

    /// Threshold of the gimbal lock, about 1.4e-14 rad from a pitch of ±90°. Closer to ±90° only the sum or the
    /// difference of roll and yaw is defined.
    const LOCKED: f64 = 1e-14;

    /// Returns roll, pitch and yaw, rad. In gimbal lock, at a pitch of ±90°, roll is 0 and yaw is the rest of the
    /// rotation.
    #[inline(always)]
    pub fn rpy(&self) -> V3<R> {
        let (w, V3 { x, y, z }) = (self.w, self.v);
        let one = w.all(1.0);
        let sine = (w * y - z * x) * 2.0;
        let plain = V3::new(
            atan2((w * x + y * z) * 2.0, one - (x * x + y * y) * 2.0),
            asin(sine),
            atan2((w * z + x * y) * 2.0, one - (y * y + z * z) * 2.0),
        );
        let steep = one.all(Self::STEEP).less(sine.abs());
        if R::any(steep) {
            let exact = self.steep_rpy();
            V3::new(
                R::choose(steep, exact.x, plain.x),
                R::choose(steep, exact.y, plain.y),
                R::choose(steep, exact.z, plain.z),
            )
        } else {
            plain
        }
    }

    /// Returns the yaw, rad, bit-identical to that of [`rpy`](Self::rpy).
    #[inline(always)]
    pub fn yaw(&self) -> R {
        let (w, V3 { x, y, z }) = (self.w, self.v);
        let one = w.all(1.0);
        let steep = one.all(Self::STEEP).less(((w * y - z * x) * 2.0).abs());
        let plain = atan2((w * z + x * y) * 2.0, one - (y * y + z * z) * 2.0);
        if R::any(steep) { R::choose(steep, self.steep_rpy().z, plain) } else { plain }
    }

    /// Computes roll, pitch and yaw from half angles, accurate at any pitch (Bernardes and Viollet, "Quaternion to
    /// Euler angles conversion", PLoS ONE 17(11), 2022). With roll φ, pitch θ and yaw ψ:
    ///
    /// - (w − y, x + z) = √2·cos(θ/2 + π/4)·(cos, sin)((φ + ψ)/2)
    /// - (w + y, x − z) = √2·sin(θ/2 + π/4)·(cos, sin)((φ − ψ)/2)
    #[inline(always)]
    fn steep_rpy(&self) -> V3<R> {
        let (w, V3 { x, y, z }) = (self.w, self.v);
        let (sum_cos, sum_sin, difference_cos, difference_sin) = (w - y, x + z, w + y, x - z);
        let above = (sum_cos * sum_cos + sum_sin * sum_sin).sqrt();
        let below = (difference_cos * difference_cos + difference_sin * difference_sin).sqrt();
        let pitch = atan2(below, above) * 2.0 - FRAC_PI_2;
        let sum = atan2(sum_sin, sum_cos);
        let difference = atan2(difference_sin, difference_cos);
        // in gimbal lock the remaining half angle determines the yaw
        let locked = w.all(Self::LOCKED);
        let sum = R::choose(above.less(locked), -difference, sum);
        let difference = R::choose(below.less(locked), -sum, difference);
        V3::new(wrapped(sum + difference), pitch, wrapped(sum - difference))
    }
}

/// Wraps an angle between −3π and 3π to [−π, π].
#[inline(always)]
fn wrapped<R: Real>(angle: R) -> R {
    let half = angle.all(PI);
    let angle = R::choose(half.less(angle), angle - TAU, angle);
    R::choose(angle.less(-half), angle + TAU, angle)
}
