use crate::math::V3;

/// Symmetric matrix of three rows: xx, yy, zz, xy, xz, yz.
#[derive(Debug, Clone, Copy)]
pub(super) struct Symmetric(pub [f64; 6]);

impl Symmetric {
    /// Returns the cofactors and the reciprocal of the determinant.
    #[inline(always)]
    pub(super) fn cofactors(&self) -> (Self, f64) {
        let [xx, yy, zz, xy, xz, yz] = self.0;
        let (cxx, cxy, cxz) = (yy * zz - yz * yz, xz * yz - xy * zz, xy * yz - xz * yy);
        let cofactors = [cxx, xx * zz - xz * xz, xx * yy - xy * xy, cxy, cxz, xy * xz - xx * yz];
        (Self(cofactors), 1.0 / (xx * cxx + (xy * cxy + xz * cxz)))
    }

    #[inline(always)]
    pub(super) fn inverse(&self) -> Self {
        let (Self([xx, yy, zz, xy, xz, yz]), scale) = self.cofactors();
        Self([xx * scale, yy * scale, zz * scale, xy * scale, xz * scale, yz * scale])
    }

    #[inline(always)]
    pub(super) fn times(&self, v: V3<f64>) -> V3<f64> {
        let [xx, yy, zz, xy, xz, yz] = self.0;
        V3::new(xx * v.x + xy * v.y + xz * v.z, xy * v.x + yy * v.y + yz * v.z, xz * v.x + yz * v.y + zz * v.z)
    }
}
