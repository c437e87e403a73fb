use std::ops::{Deref, DerefMut};

/// Zeroed numbers that begin at a cache line, so that no register is loaded from two lines.
#[derive(Debug, Default)]
pub(crate) struct Aligned {
    buffer: Vec<f32>,
    start: usize,
    length: usize,
}

impl Aligned {
    /// Length of a cache line, bytes.
    const LINE: usize = 64;

    pub fn new(length: usize) -> Self {
        let buffer = vec![0.0; length + Self::LINE / size_of::<f32>()];
        let start = buffer.as_ptr().align_offset(Self::LINE).min(buffer.len() - length);
        Self { buffer, start, length }
    }
}

impl Deref for Aligned {
    type Target = [f32];

    #[inline(always)]
    fn deref(&self) -> &[f32] {
        &self.buffer[self.start..self.start + self.length]
    }
}

impl DerefMut for Aligned {
    #[inline(always)]
    fn deref_mut(&mut self) -> &mut [f32] {
        &mut self.buffer[self.start..self.start + self.length]
    }
}
