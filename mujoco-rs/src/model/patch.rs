use super::{Integrator, Model};
use crate::error::Error;
use crate::id::{GeomId, ObjectKind};
use crate::limits;

/// Mutable access to the numbers of a model; its structure is fixed.
///
/// Arrays that MuJoCo only computes with are mutable slices. Numbers by which MuJoCo addresses memory (sizes and
/// orientations of geoms, height fields) have setters that validate them, and mutable slices that are `unsafe`.
///
/// MuJoCo's compiler derives some numbers from others (`body_subtreemass`, `dof_M0`, `body_invweight0`, …): a
/// caller that changes a mass must update those as well.
///
/// ```
/// use mujoco_rs::Model;
///
/// let mut model = Model::from_xml("<mujoco><worldbody><geom size='.1'/></worldbody></mujoco>")?;
/// model.patch().set_gravity([0.0, 0.0, -1.62])?;
/// assert_eq!(model.gravity(), [0.0, 0.0, -1.62], "on the Moon");
/// # Ok::<(), mujoco_rs::Error>(())
/// ```
pub struct ModelMut<'a> {
    pub(super) model: &'a mut Model,
}

impl ModelMut<'_> {
    #[inline]
    pub(crate) fn raw(&self) -> &mujoco_sys::mjModel {
        self.model.raw()
    }

    fn options(&mut self) -> &mut mujoco_sys::mjOption {
        // SAFETY: the model is borrowed mutably.
        unsafe { &mut self.model.pointer.as_mut().opt }
    }

    /// Sets the time step, s.
    ///
    /// # Errors
    /// [`Error::Value`] unless positive and finite.
    pub fn set_timestep(&mut self, timestep: f64) -> Result<(), Error> {
        if !(timestep.is_finite() && timestep > 0.0) {
            return Err(Error::Value {
                what: "the time step",
                got: timestep,
                expected: "a positive number of seconds",
            });
        }
        self.options().timestep = timestep;
        Ok(())
    }

    /// Sets the gravitational acceleration, world frame, m/s².
    ///
    /// # Errors
    /// [`Error::Value`] unless finite.
    pub fn set_gravity(&mut self, gravity: [f64; 3]) -> Result<(), Error> {
        if let Some(&got) = gravity.iter().find(|value| !value.is_finite()) {
            return Err(Error::Value { what: "gravity", got, expected: "a finite number of m/s²" });
        }
        self.options().gravity = gravity;
        Ok(())
    }

    /// Sets the sizes of a geom in MuJoCo's order for its type, m: radius of a sphere; radius and half length of a
    /// capsule or cylinder; half sizes of an ellipsoid or box; half sizes (0 for infinite) and grid spacing of a
    /// plane. Entries that the type does not use are 0.
    ///
    /// # Errors
    /// [`Error::NotOfModel`]; [`Error::Value`] if a size is negative, non-finite, or outside 1e-15 m to 1e6 m for
    /// an entry that the type uses.
    #[inline]
    pub fn set_geom_size(&mut self, geom: GeomId, size: [f64; 3]) -> Result<(), Error> {
        let row = self.geom_row(geom)?;
        limits::geom_size(self.raw_geom_type(row), &size)?;
        // SAFETY: the compiler accepts these sizes.
        let values = unsafe { self.geom_size_mut() };
        values[3 * row..][..3].copy_from_slice(&size);
        Ok(())
    }

    /// Sets the position of a geom in its body's frame, m.
    ///
    /// # Errors
    /// [`Error::NotOfModel`]; [`Error::Value`] if a coordinate is not finite or exceeds 1e10.
    #[inline]
    pub fn set_geom_pos(&mut self, geom: GeomId, position: [f64; 3]) -> Result<(), Error> {
        let row = self.geom_row(geom)?;
        limits::position(&position)?;
        // SAFETY: the compiler accepts these coordinates.
        let values = unsafe { self.geom_pos_mut() };
        values[3 * row..][..3].copy_from_slice(&position);
        Ok(())
    }

    /// Sets the orientation of a geom in its body's frame, `[w, x, y, z]`.
    ///
    /// # Errors
    /// [`Error::NotOfModel`]; [`Error::Value`] unless the quaternion has length 1 within 1e-6.
    #[inline]
    pub fn set_geom_quat(&mut self, geom: GeomId, quaternion: [f64; 4]) -> Result<(), Error> {
        let row = self.geom_row(geom)?;
        limits::unit_quaternion(&quaternion)?;
        // SAFETY: the quaternion has length 1, as the compiler's quaternions.
        let values = unsafe { self.geom_quat_mut() };
        values[4 * row..][..4].copy_from_slice(&quaternion);
        Ok(())
    }

    /// Sets the radius of a geom's bounding sphere, which MuJoCo uses in broad-phase collision detection, m; 0 for
    /// a plane.
    ///
    /// # Errors
    /// [`Error::NotOfModel`]; [`Error::Value`] if the radius is negative, non-finite or above 1e7.
    #[inline]
    pub fn set_geom_rbound(&mut self, geom: GeomId, radius: f64) -> Result<(), Error> {
        let row = self.geom_row(geom)?;
        limits::bounding_radius(radius)?;
        // SAFETY: the compiler can compute this radius.
        let values = unsafe { self.geom_rbound_mut() };
        values[row] = radius;
        Ok(())
    }

    /// Sets the sizes of a height field, given by its index in the model's list, m: half sizes along x and y,
    /// maximum height, thickness of the base.
    ///
    /// # Errors
    /// [`Error::Value`] if the index is out of range or a size is outside 1e-15 m to 1e6 m.
    pub fn set_hfield_size(&mut self, hfield: usize, size: [f64; 4]) -> Result<(), Error> {
        if hfield >= self.model.nhfield() {
            return Err(Error::Value {
                what: "the index of a height field",
                got: hfield as f64,
                expected: "less than the model has",
            });
        }
        limits::hfield_size(&size)?;
        // SAFETY: the compiler accepts these sizes.
        let values = unsafe { self.hfield_size_mut() };
        values[4 * hfield..][..4].copy_from_slice(&size);
        Ok(())
    }

    #[inline]
    fn geom_row(&self, geom: GeomId) -> Result<usize, Error> {
        let count = self.model.ngeom();
        if geom.index() < count {
            Ok(geom.index())
        } else {
            Err(Error::NotOfModel { kind: ObjectKind::Geom, index: geom.index(), count })
        }
    }

    #[inline]
    fn raw_geom_type(&self, row: usize) -> i32 {
        self.model.geom_type()[row]
    }

    /// Sets the integrator.
    pub fn set_integrator(&mut self, integrator: Integrator) {
        self.options().integrator = integrator.code() as i32;
    }
}
