//! Every array of mjModel and mjData as a slice, generated from MuJoCo's list of fields.
#![allow(non_snake_case)] // MuJoCo's own names
#![allow(unused_parens, clippy::all)] // generated code, formatted for documentation

use crate::{Data, Model, ModelMut};

/// # Safety
/// `pointer` is null or points to `length` initialized elements that live for `'a`; nothing writes them during
/// `'a`.
#[inline]
unsafe fn view<'a, T>(pointer: *const T, length: usize) -> &'a [T] {
    if pointer.is_null() || length == 0 {
        return &[];
    }
    // SAFETY: guaranteed by the caller.
    unsafe { std::slice::from_raw_parts(pointer, length) }
}

/// # Safety
/// As for [`view`], and nothing else reads the elements during `'a`.
#[inline]
unsafe fn view_mut<'a, T>(pointer: *mut T, length: usize) -> &'a mut [T] {
    if pointer.is_null() || length == 0 {
        return &mut [];
    }
    // SAFETY: guaranteed by the caller.
    unsafe { std::slice::from_raw_parts_mut(pointer, length) }
}

include!(concat!(env!("OUT_DIR"), "/arrays.rs"));
