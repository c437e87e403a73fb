//! Actions of a batch, in the precision of the caller.

use std::ops::Range;

use crate::math::Row;

/// Actions of consecutive environments. Single precision is exact in double precision, so that both give equal
/// results where they hold equal numbers.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) enum Actions<'a> {
    Single(&'a [f32]),
    Double(&'a [f64]),
}

impl Default for Actions<'_> {
    fn default() -> Self {
        Self::Single(&[])
    }
}

/// Evaluates an expression for the slice of either precision.
macro_rules! for_slice {
    ($actions:expr, |$slice:ident| $body:expr) => {
        match $actions {
            Actions::Single($slice) => $body,
            Actions::Double($slice) => $body,
        }
    };
}

impl Actions<'_> {
    pub fn len(&self) -> usize {
        for_slice!(self, |slice| slice.len())
    }

    /// Returns an entry in double precision.
    pub fn get(&self, entry: usize) -> f64 {
        match self {
            Self::Single(slice) => f64::from(slice[entry]),
            Self::Double(slice) => slice[entry],
        }
    }

    /// Returns the entries of a range.
    pub fn slice(&self, range: Range<usize>) -> Self {
        match self {
            Self::Single(slice) => Self::Single(&slice[range]),
            Self::Double(slice) => Self::Double(&slice[range]),
        }
    }

    /// Splits the actions; the parts of an empty slice are empty.
    pub fn cut(self, at: usize) -> (Self, Self) {
        let at = at.min(self.len());
        (self.slice(0..at), self.slice(at..self.len()))
    }

    /// Returns the index of the first entry that is not finite.
    pub fn first_bad(&self) -> Option<usize> {
        for_slice!(self, |slice| slice.iter().position(|x| !x.is_finite()))
    }

    /// Returns true if every entry is finite.
    pub fn are_finite(&self) -> bool {
        // the loops have no early exit, so that the compiler vectorizes them
        !for_slice!(self, |slice| {
            slice.chunks(512).any(|chunk| chunk.iter().fold(false, |bad, x| bad | !x.is_finite()))
        })
    }

    /// Writes the actions of a block, `size` numbers per environment, to four rows per drone. With `one`, one number
    /// commands all motors of a drone.
    pub fn transpose(&self, size: usize, one: bool, rows: &mut [[Row; 4]]) {
        for_slice!(self, |slice| transpose(slice, size, one, rows));
    }
}

#[inline(always)]
fn transpose<X: Copy + Into<f64>>(actions: &[X], size: usize, one: bool, rows: &mut [[Row; 4]]) {
    for (lane, action) in actions.chunks_exact(size).enumerate() {
        if one {
            for (rows, &x) in rows.iter_mut().zip(action) {
                rows.iter_mut().for_each(|row| row[lane] = x.into());
            }
        } else {
            for (row, &x) in rows.as_flattened_mut().iter_mut().zip(action) {
                row[lane] = x.into();
            }
        }
    }
}
