//! Every array of mjModel and mjData as a slice, generated from MuJoCo's own list of them.
#![allow(non_snake_case)] // MuJoCo's own names
#![allow(unused_parens, clippy::all)] // written by a program, to be read as documentation

use crate::{Data, Model, ModelMut};

/// # Safety
/// `pointer` is null or holds `length` initialised elements for as long as `'a`, and nobody writes them meanwhile.
#[inline]
unsafe fn view<'a, T>(pointer: *const T, length: usize) -> &'a [T] {
    if pointer.is_null() || length == 0 {
        return &[];
    }
    // SAFETY: the caller's promise.
    unsafe { std::slice::from_raw_parts(pointer, length) }
}

/// # Safety
/// As for [`view`], and nobody else reads them meanwhile.
#[inline]
unsafe fn view_mut<'a, T>(pointer: *mut T, length: usize) -> &'a mut [T] {
    if pointer.is_null() || length == 0 {
        return &mut [];
    }
    // SAFETY: the caller's promise.
    unsafe { std::slice::from_raw_parts_mut(pointer, length) }
}

include!(concat!(env!("OUT_DIR"), "/arrays.rs"));
