//! Images of an observation as numpy arrays, and the numbers of actions.

use std::ops::Range;

use aviary::env::ObservationSpace;
use aviary::observation::Observation;
use numpy::{PyArrayDyn, PyArrayMethods as _, PyUntypedArrayMethods as _, ToPyArray as _};
use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;
use pyo3::types::PyDict;

/// Copies the images of an observation into new arrays, by name.
pub fn image_dict<'py>(
    py: Python<'py>,
    observation: &Observation,
    space: &ObservationSpace,
) -> PyResult<Bound<'py, PyDict>> {
    let dict = PyDict::new(py);
    if let Some(shape) = space.rgb_shape() {
        dict.set_item("rgb", observation.rgb.to_pyarray(py).reshape(shape)?)?;
    }
    if let Some(shape) = space.depth_shape() {
        dict.set_item("depth", observation.depth.to_pyarray(py).reshape(shape)?)?;
    }
    if let Some(shape) = space.segmentation_shape() {
        dict.set_item("segmentation", observation.segmentation.as_flattened().to_pyarray(py).reshape(shape)?)?;
    }
    Ok(dict)
}

/// Numbers in the precision of the caller.
#[derive(Clone, Copy)]
pub enum Numbers<'a> {
    Single(&'a [f32]),
    Double(&'a [f64]),
}

impl Numbers<'_> {
    /// Returns the addresses of the bytes of the numbers.
    pub fn addresses(self) -> Range<usize> {
        match self {
            Self::Single(numbers) => addresses(numbers),
            Self::Double(numbers) => addresses(numbers),
        }
    }
}

/// Returns the addresses of the bytes of a slice.
fn addresses<T>(slice: &[T]) -> Range<usize> {
    let start = slice.as_ptr().addr();
    start..start + size_of_val(slice)
}

/// Calls a function with the shape and the numbers of an array-like object in the order of their indices. Numbers of
/// other types than float32 are converted to float64. Arrays that are not C-contiguous or not aligned are copied.
pub fn with_array<R>(
    object: &Bound<'_, PyAny>,
    then: impl FnOnce(&[usize], Numbers<'_>) -> PyResult<R>,
) -> PyResult<R> {
    if let Ok(array) = object.cast::<PyArrayDyn<f32>>()
        && is_plain(array)
    {
        return then(array.shape(), Numbers::Single(array.try_readonly()?.as_slice()?));
    }
    let converted;
    let array = match object.cast::<PyArrayDyn<f64>>() {
        Ok(array) if is_plain(array) => array,
        _ => {
            let options = PyDict::new(object.py());
            options.set_item("dtype", "float64")?;
            options.set_item("order", "C")?;
            options.set_item("ndmin", 1)?;
            // a copy is aligned
            let array = object.py().import("numpy")?.call_method("array", (object,), Some(&options))?;
            converted = array.cast_into::<PyArrayDyn<f64>>()?;
            &converted
        }
    };
    then(array.shape(), Numbers::Double(array.try_readonly()?.as_slice()?))
}

/// Returns true if a slice can represent the numbers of an array in the order of their indices.
fn is_plain<T>(array: &Bound<'_, PyArrayDyn<T>>) -> bool {
    array.is_c_contiguous() && array.is_aligned()
}

/// Calls a function with the numbers of an array-like object of `rows` rows with `size` numbers each.
pub fn with_numbers<R>(
    object: &Bound<'_, PyAny>,
    rows: usize,
    size: usize,
    then: impl FnOnce(Numbers<'_>) -> PyResult<R>,
) -> PyResult<R> {
    with_array(object, |shape, numbers| {
        check_shape(shape, rows, size)?;
        then(numbers)
    })
}

/// Returns the numbers of an array-like object in double precision.
pub fn to_vec(object: &Bound<'_, PyAny>) -> PyResult<Vec<f64>> {
    with_array(object, |_, numbers| {
        Ok(match numbers {
            Numbers::Single(numbers) => numbers.iter().copied().map(f64::from).collect(),
            Numbers::Double(numbers) => numbers.to_vec(),
        })
    })
}

fn check_shape(shape: &[usize], rows: usize, size: usize) -> PyResult<()> {
    if shape.first() == Some(&rows) && shape[1..].iter().product::<usize>() == size {
        return Ok(());
    }
    let got: Vec<_> = shape.iter().map(usize::to_string).collect();
    let comma = if got.len() == 1 { "," } else { "" };
    Err(PyValueError::new_err(format!("actions have the shape ({}{comma}), expected ({rows}, {size})", got.join(", "))))
}
