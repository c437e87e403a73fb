//! Memory of the results of a batch, and the numpy arrays that show it.

use std::ops::Range;

use aviary::vector::{VecEnv, VecImages, VecStep};
use numpy::{IntoPyArray as _, PyArray1, PyArray2, PyArrayDyn, PyArrayMethods as _};
use pyo3::prelude::*;
use pyo3::types::PyDict;

/// Memory of arrays: a Rust vector that a one-dimensional array owns. The other arrays of the memory are views of the
/// owner and keep it alive.
struct Memory<T> {
    /// `None` for no memory.
    owner: Option<Py<PyArray1<T>>>,
    start: *mut T,
    len: usize,
}

// SAFETY: the memory is that of a vector, which has no relation to a thread. `Outputs` is behind a mutex.
#[allow(unsafe_code)]
unsafe impl<T: Send> Send for Memory<T> {}

impl<T: numpy::Element + Copy + Default> Memory<T> {
    /// Creates zeros.
    fn new(py: Python<'_>, len: usize) -> Self {
        let owner = vec![T::default(); len].into_pyarray(py);
        Self { start: owner.data(), len, owner: Some(owner.unbind()) }
    }

    fn empty() -> Self {
        Self { owner: None, start: std::ptr::NonNull::dangling().as_ptr(), len: 0 }
    }

    /// Returns a new array that shows the memory.
    fn array<'py>(&self, py: Python<'py>, shape: &[usize]) -> PyResult<Bound<'py, PyArrayDyn<T>>> {
        match &self.owner {
            // a reshape of contiguous memory is a view, whose base is the owner
            Some(owner) => owner.bind(py).reshape(shape),
            None => Ok(PyArrayDyn::zeros(py, shape, false)),
        }
    }

    /// Returns true if no array shows the memory.
    fn is_free(&self, _: Python<'_>) -> bool {
        // SAFETY: the caller holds the GIL, and the owner is alive.
        #[allow(unsafe_code)]
        self.owner.as_ref().is_none_or(|owner| unsafe { pyo3::ffi::Py_REFCNT(owner.as_ptr()) } == 1)
    }

    /// Returns true if the memory has a byte in common with a range of addresses.
    fn overlaps(&self, addresses: &Range<usize>) -> bool {
        let start = self.start.addr();
        self.len > 0 && start < addresses.end && addresses.start < start + self.len * size_of::<T>()
    }

    fn slice(&mut self) -> &mut [T] {
        // SAFETY: the owner keeps the memory alive, and its numbers have been initialized. Python code of another
        // thread that reads or writes an array during a step may see or leave any numbers, as in numpy itself.
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

/// Observations, rewards, terminations and truncations of a step.
pub type StepArrays<'py> =
    (Bound<'py, PyArray2<f32>>, Bound<'py, PyArray1<f32>>, Bound<'py, PyArray1<bool>>, Bound<'py, PyArray1<bool>>);

/// Arrays of a step that do not change.
type FixedArrays = (Py<PyArray2<f32>>, Py<PyArray1<f32>>, Py<PyArray1<bool>>, Py<PyArray1<bool>>);

/// Memory of the results of one step.
pub struct StepMemory {
    observations: Memory<f32>,
    rewards: Memory<f32>,
    terminated: Memory<bool>,
    truncated: Memory<bool>,
}

impl StepMemory {
    fn new(py: Python<'_>, count: usize, size: usize) -> Self {
        Self {
            observations: Memory::new(py, count * size),
            rewards: Memory::new(py, count),
            terminated: Memory::new(py, count),
            truncated: Memory::new(py, count),
        }
    }

    fn is_free(&self, py: Python<'_>) -> bool {
        self.observations.is_free(py)
            && self.rewards.is_free(py)
            && self.terminated.is_free(py)
            && self.truncated.is_free(py)
    }

    fn arrays<'py>(&self, py: Python<'py>, count: usize, size: usize) -> PyResult<StepArrays<'py>> {
        Ok((
            self.observations.array(py, &[count, size])?.cast_into()?,
            self.rewards.array(py, &[count])?.cast_into()?,
            self.terminated.array(py, &[count])?.cast_into()?,
            self.truncated.array(py, &[count])?.cast_into()?,
        ))
    }

    /// Returns the observations.
    pub fn observations(&mut self) -> &mut [f32] {
        self.observations.slice()
    }

    /// Returns the output of a step. It holds the results of an earlier step until the next one writes them: a step
    /// that is rejected changes nothing.
    pub fn step(&mut self) -> VecStep<'_> {
        VecStep {
            observations: self.observations.slice(),
            rewards: self.rewards.slice(),
            terminated: self.terminated.flags(),
            truncated: self.truncated.flags(),
        }
    }

    /// Returns true if the memory has a byte in common with a range of addresses.
    pub fn overlaps(&self, addresses: &Range<usize>) -> bool {
        let Self { observations, rewards, terminated, truncated } = self;
        let floats = observations.overlaps(addresses) || rewards.overlaps(addresses);
        floats || terminated.overlaps(addresses) || truncated.overlaps(addresses)
    }

    /// Replaces `ended` with the indices of the environments whose episodes ended in the last step.
    pub fn find_ended(&self, ended: &mut Vec<usize>) {
        ended.clear();
        let (terminated, truncated) = (self.terminated.bytes(), self.truncated.bytes());
        // most steps end no episode
        if [terminated, truncated].iter().any(|flags| flags.iter().fold(0, |any, flag| any | flag) != 0) {
            let flags = terminated.iter().zip(truncated).enumerate();
            ended.extend(flags.filter(|(_, (terminated, truncated))| **terminated | **truncated != 0).map(|(i, _)| i));
        }
    }
}

/// Memory of the results of a batch. With `copy`, every step writes to memory that no array shows, and returns new
/// arrays of it. Memory is used again after the caller has dropped all of its arrays. It is then still in the caches of
/// the threads that write it. Without `copy`, there is one memory with one array of each kind.
pub struct Outputs {
    count: usize,
    size: usize,
    memories: Vec<StepMemory>,
    /// Entry of `memories` that was replaced last.
    replaced: usize,
    /// The arrays, without `copy`.
    fixed: Option<FixedArrays>,
}

impl Outputs {
    /// Memories that are kept for later steps: those of the last observations and the present ones, and one that the
    /// step writes.
    const KEPT: usize = 3;

    /// Creates the memory of a batch.
    pub fn new(py: Python<'_>, env: &dyn VecEnv, copy: bool) -> PyResult<Self> {
        let (count, size) = (env.num_envs(), env.observation_size());
        let (mut memories, mut fixed) = (Vec::new(), None);
        if !copy {
            let memory = StepMemory::new(py, count, size);
            let (observations, rewards, terminated, truncated) = memory.arrays(py, count, size)?;
            fixed = Some((observations.unbind(), rewards.unbind(), terminated.unbind(), truncated.unbind()));
            memories.push(memory);
        }
        Ok(Self { count, size, memories, replaced: 0, fixed })
    }

    /// Returns the memory of the next step, and its arrays.
    pub fn next<'py>(&mut self, py: Python<'py>) -> PyResult<(StepArrays<'py>, &mut StepMemory)> {
        if let Some((observations, rewards, terminated, truncated)) = &self.fixed {
            let arrays = (
                observations.bind(py).clone(),
                rewards.bind(py).clone(),
                terminated.bind(py).clone(),
                truncated.bind(py).clone(),
            );
            return Ok((arrays, &mut self.memories[0]));
        }
        let free = self.memories.iter().position(|memory| memory.is_free(py));
        let index = free.unwrap_or_else(|| {
            let memory = StepMemory::new(py, self.count, self.size);
            if self.memories.len() < Self::KEPT {
                self.memories.push(memory);
                return self.memories.len() - 1;
            }
            // the arrays of the replaced memory keep it alive
            self.replaced = (self.replaced + 1) % Self::KEPT;
            self.memories[self.replaced] = memory;
            self.replaced
        });
        let memory = &mut self.memories[index];
        Ok((memory.arrays(py, self.count, self.size)?, memory))
    }
}

/// Memory of the images of a batch, and the arrays that show it.
pub struct Images {
    rgb: Memory<u8>,
    depth: Memory<f32>,
    segmentation: Memory<i32>,
}

impl Images {
    /// Creates the memory of the images of a batch, and its arrays by name.
    pub fn new<'py>(py: Python<'py>, env: &dyn VecEnv) -> PyResult<(Self, Bound<'py, PyDict>)> {
        let (count, space) = (env.num_envs(), env.observation_space());
        let arrays = PyDict::new(py);
        let mut images = Self { rgb: Memory::empty(), depth: Memory::empty(), segmentation: Memory::empty() };
        let shape = |one: &[usize]| [&[count], one].concat();
        if let Some(one) = space.rgb_shape() {
            images.rgb = Memory::new(py, shape(&one).iter().product());
            arrays.set_item("rgb", images.rgb.array(py, &shape(&one))?)?;
        }
        if let Some(one) = space.depth_shape() {
            images.depth = Memory::new(py, shape(&one).iter().product());
            arrays.set_item("depth", images.depth.array(py, &shape(&one))?)?;
        }
        if let Some(one) = space.segmentation_shape() {
            images.segmentation = Memory::new(py, shape(&one).iter().product());
            arrays.set_item("segmentation", images.segmentation.array(py, &shape(&one))?)?;
        }
        Ok((images, arrays))
    }

    /// Returns true if the memory has a byte in common with a range of addresses.
    pub fn overlaps(&self, addresses: &Range<usize>) -> bool {
        let Self { rgb, depth, segmentation } = self;
        rgb.overlaps(addresses) || depth.overlaps(addresses) || segmentation.overlaps(addresses)
    }

    /// Returns the output of a rendering.
    pub fn output(&mut self) -> VecImages<'_> {
        let (pairs, _) = self.segmentation.slice().as_chunks_mut();
        VecImages { rgb: self.rgb.slice(), depth: self.depth.slice(), segmentation: pairs }
    }
}
