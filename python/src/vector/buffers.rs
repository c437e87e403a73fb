//! Buffers of a batch as numpy arrays, and the numbers of actions.

use std::ops::Range;

use aviary::env::ObservationSpace;
use aviary::observation::Observation;
use aviary::vector::{VecEnv, VecImages, VecStep};
use numpy::{
    IntoPyArray as _, PyArray1, PyArray2, PyArrayDyn, PyArrayMethods as _, PyUntypedArrayMethods as _, ToPyArray as _,
};
use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;
use pyo3::types::PyDict;

/// Arrays that view the buffers of a batch. The memory belongs to a Rust vector, which the base object of the arrays
/// owns.
pub struct Arrays {
    pub observations: Py<PyArray2<f32>>,
    pub rewards: Py<PyArray1<f32>>,
    pub terminated: Py<PyArray1<bool>>,
    pub truncated: Py<PyArray1<bool>>,
    images: Vec<(&'static str, Py<PyAny>)>,
}

/// Memory of an array. The array must outlive it.
struct Memory<T> {
    start: *mut T,
    len: usize,
}

// SAFETY: the memory is that of a vector, which has no relation to a thread. `Outputs` is behind a mutex.
#[allow(unsafe_code)]
unsafe impl<T: Send> Send for Memory<T> {}

impl<T: numpy::Element + Copy + Default> Memory<T> {
    /// Creates an array of zeros and its memory.
    fn new<'py>(py: Python<'py>, shape: &[usize]) -> PyResult<(Bound<'py, PyArrayDyn<T>>, Self)> {
        let len = shape.iter().product();
        let owner = vec![T::default(); len].into_pyarray(py);
        let start = owner.data();
        // a reshape of contiguous memory is a view, whose base owns the memory
        Ok((owner.reshape(shape)?, Self { start, len }))
    }

    fn empty() -> Self {
        Self { start: std::ptr::NonNull::dangling().as_ptr(), len: 0 }
    }

    /// Returns true if the memory has a byte in common with a range of addresses.
    fn overlaps(&self, addresses: &Range<usize>) -> bool {
        let start = self.start.addr();
        self.len > 0 && start < addresses.end && addresses.start < start + self.len * size_of::<T>()
    }

    fn slice(&mut self) -> &mut [T] {
        // SAFETY: the arrays of the batch keep the memory alive, and its numbers have been initialized. Python code of
        // another thread that reads or writes an array during a step may see or leave any numbers, as in numpy itself.
        #[allow(unsafe_code)]
        unsafe {
            std::slice::from_raw_parts_mut(self.start, self.len)
        }
    }
}

impl Memory<bool> {
    /// Returns the flags as bytes, because Python code may have written bytes other than 0 and 1.
    fn bytes(&self) -> &[u8] {
        // SAFETY: as for `slice`; a byte may have any value.
        #[allow(unsafe_code)]
        unsafe {
            std::slice::from_raw_parts(self.start.cast(), self.len)
        }
    }

    /// Returns the flags. A byte that Python code has written counts as true unless it is 0.
    fn flags(&mut self) -> &mut [bool] {
        // SAFETY: as for `slice`; a byte may have any value.
        #[allow(unsafe_code)]
        let bytes: &mut [u8] = unsafe { std::slice::from_raw_parts_mut(self.start.cast(), self.len) };
        bytes.iter_mut().for_each(|byte| *byte = u8::from(*byte != 0));
        self.slice()
    }
}

/// Memory to which a step writes.
pub struct Outputs {
    observations: Memory<f32>,
    rewards: Memory<f32>,
    terminated: Memory<bool>,
    truncated: Memory<bool>,
    rgb: Memory<u8>,
    depth: Memory<f32>,
    segmentation: Memory<i32>,
}

impl Outputs {
    /// Returns the observations.
    pub fn observations(&mut self) -> &mut [f32] {
        self.observations.slice()
    }

    /// Returns the output of a step. It holds the results of the last step until the next one writes them: a step that
    /// is rejected changes nothing.
    pub fn step(&mut self) -> VecStep<'_> {
        VecStep {
            observations: self.observations.slice(),
            rewards: self.rewards.slice(),
            terminated: self.terminated.flags(),
            truncated: self.truncated.flags(),
        }
    }

    /// Returns true if numbers lie in one of the buffers, at least in part.
    pub fn overlap(&self, numbers: Numbers<'_>) -> bool {
        let addresses = match numbers {
            Numbers::Single(numbers) => addresses(numbers),
            Numbers::Double(numbers) => addresses(numbers),
        };
        let Self { observations, rewards, terminated, truncated, rgb, depth, segmentation } = self;
        let floats = [observations, rewards, depth].into_iter().any(|memory| memory.overlaps(&addresses));
        let flags = [terminated, truncated].into_iter().any(|memory| memory.overlaps(&addresses));
        floats || flags || rgb.overlaps(&addresses) || segmentation.overlaps(&addresses)
    }

    /// Returns the indices of the environments whose flags say that the last step has ended an episode.
    pub fn ends(&self) -> impl Iterator<Item = usize> {
        let flags = self.terminated.bytes().iter().zip(self.truncated.bytes()).enumerate();
        flags.filter(|(_, (terminated, truncated))| **terminated | **truncated != 0).map(|(index, _)| index)
    }

    /// Returns true if the last step has ended an episode.
    pub fn has_ends(&self) -> bool {
        let any = |flags: &[u8]| flags.iter().fold(0, |any, flag| any | flag) != 0;
        any(self.terminated.bytes()) || any(self.truncated.bytes())
    }

    /// Returns the output of a rendering.
    pub fn images(&mut self) -> VecImages<'_> {
        let (pairs, _) = self.segmentation.slice().as_chunks_mut();
        VecImages { rgb: self.rgb.slice(), depth: self.depth.slice(), segmentation: pairs }
    }
}

impl Arrays {
    /// Creates the buffers of a batch.
    pub fn new(py: Python<'_>, env: &dyn VecEnv) -> PyResult<(Self, Outputs)> {
        let (count, space) = (env.num_envs(), env.observation_space());
        let (observations, observation_memory) = Memory::new(py, &[count, env.observation_size()])?;
        let (rewards, reward_memory) = Memory::new(py, &[count])?;
        let (terminated, terminated_memory) = Memory::new(py, &[count])?;
        let (truncated, truncated_memory) = Memory::new(py, &[count])?;
        let mut outputs = Outputs {
            observations: observation_memory,
            rewards: reward_memory,
            terminated: terminated_memory,
            truncated: truncated_memory,
            rgb: Memory::empty(),
            depth: Memory::empty(),
            segmentation: Memory::empty(),
        };
        let mut images = Vec::new();
        let shape = |one: &[usize]| [&[count], one].concat();
        if let Some(one) = space.rgb_shape() {
            let (array, memory) = Memory::new(py, &shape(&one))?;
            images.push(("rgb", array.into_any().unbind()));
            outputs.rgb = memory;
        }
        if let Some(one) = space.depth_shape() {
            let (array, memory) = Memory::new(py, &shape(&one))?;
            images.push(("depth", array.into_any().unbind()));
            outputs.depth = memory;
        }
        if let Some(one) = space.segmentation_shape() {
            let (array, memory) = Memory::new(py, &shape(&one))?;
            images.push(("segmentation", array.into_any().unbind()));
            outputs.segmentation = memory;
        }
        let arrays = Self {
            observations: observations.cast_into()?.unbind(),
            rewards: rewards.cast_into()?.unbind(),
            terminated: terminated.cast_into()?.unbind(),
            truncated: truncated.cast_into()?.unbind(),
            images,
        };
        Ok((arrays, outputs))
    }

    /// Returns the images by name.
    pub fn images<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyDict>> {
        let dict = PyDict::new(py);
        for (name, array) in &self.images {
            dict.set_item(name, array)?;
        }
        Ok(dict)
    }
}

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
