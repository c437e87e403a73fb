//! Gradients of multilayer perceptrons and recurrent layers by backpropagation, in SIMD registers.
//!
//! A [`Pass`] runs a [`Network`] over a tile of up to [`TILE`] rows, whose activations fit into a core's cache:
//! [`Pass::forward`] computes the outputs, and [`Pass::backward`] adds the gradient of the tile to the sums of the pass.
//! A [`RecurrentPass`] runs a [`Recurrent`] layer over a tile of sequences, forwards and backwards through time.
//! All matrix products are one loop over blocks of registers ([`product`]). Every sum adds its terms in the order of
//! the rows or neurons, with fused multiplications and additions where the machine has them. Gradients are therefore
//! bit-identical for AVX2 and AVX-512 and for every size of tiles; the baseline, without fused operations, rounds
//! differently.

mod aligned;
mod layer;
mod network;
mod product;
mod recurrent;

pub(crate) use aligned::Aligned;
pub(crate) use network::{Network, Pass};
pub(crate) use recurrent::{Place, Recurrent, RecurrentPass, Tile};

use std::any::TypeId;

use aviary::engine::flight::Width;
use pulp::{Scalar128b, Simd, WithSimd};

/// Maximum number of rows of a tile, a multiple of the rows of a block of registers.
pub(crate) const TILE: usize = 96;

/// Length of a row of numbers is a multiple of this: the numbers in the widest register.
const PADDING: usize = 16;

/// Returns the length of a row of `size` numbers with its padding.
pub(crate) fn padded(size: usize) -> usize {
    size.next_multiple_of(PADDING)
}

/// Runs work with an instruction set, or with the baseline if this machine does not have it.
pub(crate) fn run<W: WithSimd>(width: Width, work: W) -> W::Output {
    #[cfg(target_arch = "x86_64")]
    match width {
        Width::Avx512 => {
            if let Some(simd) = pulp::x86::V4::try_new() {
                return Simd::vectorize(simd, work);
            }
        }
        Width::Avx2 => {
            if let Some(simd) = pulp::x86::V3::try_new() {
                return Simd::vectorize(simd, work);
            }
        }
        Width::Portable => {}
    }
    #[cfg(not(target_arch = "x86_64"))]
    let _ = width;
    work.with_simd(Scalar128b)
}

/// Returns x·y + sum: fused, except on the baseline, where a fused operation is a call of a function.
#[inline(always)]
fn multiply_add<S: Simd>(simd: S, x: S::f32s, y: S::f32s, sum: S::f32s) -> S::f32s {
    if TypeId::of::<S>() == TypeId::of::<Scalar128b>() {
        simd.add_f32s(simd.mul_f32s(x, y), sum)
    } else {
        simd.mul_add_f32s(x, y, sum)
    }
}
