//! Limits of MuJoCo's C code: numbers outside of them would make it access memory out of bounds.

use mujoco_sys::mjtGeom_ as geom;

use crate::error::Error;

/// Smallest length of a geom (`mjMINVAL`), m.
pub(crate) const MIN_LENGTH: f64 = 1e-15;

/// Largest coordinate (`mjMAXVAL`), m.
pub(crate) const MAX_COORDINATE: f64 = 1e10;

/// Largest length of a geom, m. For sizes from 1e8 m on, libccd's search for a penetration depth may not terminate:
/// rounding errors exceed its tolerance, and it does not count iterations.
pub(crate) const MAX_LENGTH: f64 = 1e6;

/// Largest number of points of a height field, texture or mesh. A cube texture takes 18 times as many bytes, which
/// MuJoCo's integers can still hold.
pub(crate) const MAX_COUNT: i64 = 1 << 26;

/// Returns how many of a geom's three sizes its type uses, and true if they may be 0.
fn sizes(geom_type: i32) -> (usize, bool) {
    match u32::try_from(geom_type).unwrap_or(u32::MAX) {
        geom::mjGEOM_SPHERE => (1, false),
        geom::mjGEOM_CAPSULE | geom::mjGEOM_CYLINDER => (2, false),
        geom::mjGEOM_ELLIPSOID | geom::mjGEOM_BOX => (3, false),
        // a plane of size 0 is infinite; meshes and height fields have bounding boxes
        _ => (3, true),
    }
}

#[inline]
pub(crate) fn geom_size(geom_type: i32, size: &[f64; 3]) -> Result<(), Error> {
    let (count, may_vanish) = sizes(geom_type);
    for (index, &got) in size.iter().enumerate() {
        let min = if index < count && !may_vanish { MIN_LENGTH } else { 0.0 };
        if !(min..=MAX_LENGTH).contains(&got) {
            return Err(Error::Value {
                what: "a geom's size",
                got,
                expected: "1e-15 m to 1e6 m, or 0 where the type has no such size",
            });
        }
    }
    Ok(())
}

#[inline]
pub(crate) fn position(position: &[f64]) -> Result<(), Error> {
    match position.iter().find(|value| !(-MAX_COORDINATE..=MAX_COORDINATE).contains(*value)) {
        None => Ok(()),
        Some(&got) => {
            Err(Error::Value { what: "a coordinate", got, expected: "a finite number of metres of at most 1e10" })
        }
    }
}

#[inline]
pub(crate) fn unit_quaternion(quaternion: &[f64; 4]) -> Result<(), Error> {
    let square: f64 = quaternion.iter().map(|value| value * value).sum();
    if (square - 1.0).abs() <= 2e-6 {
        Ok(())
    } else {
        Err(Error::Value { what: "the length of a quaternion", got: square.sqrt(), expected: "1 within 1e-6" })
    }
}

#[inline]
pub(crate) fn bounding_radius(got: f64) -> Result<(), Error> {
    if (0.0..=10.0 * MAX_LENGTH).contains(&got) {
        Ok(())
    } else {
        Err(Error::Value { what: "a geom's bounding radius", got, expected: "0 m to 1e7 m" })
    }
}

pub(crate) fn hfield_size(size: &[f64; 4]) -> Result<(), Error> {
    match size.iter().find(|value| !(MIN_LENGTH..=MAX_LENGTH).contains(*value)) {
        None => Ok(()),
        Some(&got) => Err(Error::Value { what: "a height field's size", got, expected: "1e-15 m to 1e6 m" }),
    }
}
