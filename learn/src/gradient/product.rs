//! Products of matrices in blocks of registers.

use std::array::from_fn;

use pulp::Simd;

use super::multiply_add;

/// Left factor of a product.
pub(super) trait Left {
    /// Returns the columns of `M` rows from row `first` on.
    fn columns<const M: usize>(&self, first: usize) -> impl Iterator<Item = [f32; M]>;
}

/// Row-major matrix with `depth` columns.
pub(super) struct Rows<'a> {
    pub data: &'a [f32],
    /// Distance of rows.
    pub stride: usize,
    pub depth: usize,
}

impl Left for Rows<'_> {
    #[inline(always)]
    fn columns<const M: usize>(&self, first: usize) -> impl Iterator<Item = [f32; M]> {
        let depth = self.depth;
        let rows: [&[f32]; M] = from_fn(|m| &self.data[(first + m) * self.stride..][..depth]);
        (0..depth).map(move |k| from_fn(|m| rows[m][k]))
    }
}

/// Transpose of a row-major matrix with `depth` rows.
pub(super) struct Transpose<'a> {
    pub data: &'a [f32],
    /// Distance of rows of the matrix.
    pub stride: usize,
    pub depth: usize,
}

impl Left for Transpose<'_> {
    #[inline(always)]
    fn columns<const M: usize>(&self, first: usize) -> impl Iterator<Item = [f32; M]> {
        (0..self.depth).map(move |k| {
            let column = &self.data[k * self.stride + first..][..M];
            from_fn(|m| column[m])
        })
    }
}

/// Matrix in registers, row-major.
#[derive(Clone, Copy)]
pub(super) struct Registers<'a, R> {
    data: &'a [R],
    stride: usize,
}

impl<'a, R> Registers<'a, R> {
    /// Returns the registers of a row-major matrix whose rows are `stride` numbers, a multiple of the lanes.
    #[inline(always)]
    pub fn new<S: Simd<f32s = R>>(data: &'a [f32], stride: usize) -> Self {
        Self { data: S::as_simd_f32s(data).0, stride: stride / S::F32_LANES }
    }
}

/// Computes `rows` rows and `width` columns of a product. Every sum begins with `begin(column, register of out)`, and
/// the result is `finish(index of the register in out, sum)`; columns and indices count registers.
#[inline(always)]
pub(super) fn multiply<S: Simd>(
    simd: S,
    (rows, width): (usize, usize),
    left: &impl Left,
    right: Registers<'_, S::f32s>,
    (out, stride): (&mut [f32], usize),
    begin: impl Fn(usize, S::f32s) -> S::f32s,
    finish: impl Fn(usize, S::f32s) -> S::f32s,
) {
    let width = width.div_ceil(S::F32_LANES);
    let (out, stride) = (S::as_mut_simd_f32s(out).0, stride / S::F32_LANES);
    let mut column = 0;
    macro_rules! strips {
        ($columns:literal) => {
            while width - column >= $columns {
                strip::<S, $columns>(simd, rows, left, right, column, out, stride, &begin, &finish);
                column += $columns;
            }
        };
    }
    // with the six rows of a block, these fill 16 and 32 registers
    if S::REGISTER_COUNT >= 32 {
        strips!(4);
    }
    strips!(2);
    strips!(1);
}

/// Computes `N` columns of a product.
#[inline(always)]
#[allow(clippy::too_many_arguments)]
fn strip<S: Simd, const N: usize>(
    simd: S,
    rows: usize,
    left: &impl Left,
    right: Registers<'_, S::f32s>,
    column: usize,
    out: &mut [S::f32s],
    stride: usize,
    begin: &impl Fn(usize, S::f32s) -> S::f32s,
    finish: &impl Fn(usize, S::f32s) -> S::f32s,
) {
    let mut row = 0;
    macro_rules! block {
        ($rows:literal) => {
            block::<S, $rows, N>(simd, row, left, right, column, out, stride, begin, finish)
        };
    }
    while row + 6 <= rows {
        block!(6);
        row += 6;
    }
    match rows - row {
        5 => block!(5),
        4 => block!(4),
        3 => block!(3),
        2 => block!(2),
        1 => block!(1),
        _ => {}
    }
}

/// Computes a block of `M` rows and `N` columns of a product, whose sums stay in registers.
#[inline(always)]
#[allow(clippy::too_many_arguments)]
fn block<S: Simd, const M: usize, const N: usize>(
    simd: S,
    row: usize,
    left: &impl Left,
    right: Registers<'_, S::f32s>,
    column: usize,
    out: &mut [S::f32s],
    stride: usize,
    begin: &impl Fn(usize, S::f32s) -> S::f32s,
    finish: &impl Fn(usize, S::f32s) -> S::f32s,
) {
    let start = |m: usize| (row + m) * stride + column;
    let mut sums: [[S::f32s; N]; M] = from_fn(|m| from_fn(|n| begin(column + n, out[start(m)..][..N][n])));
    for (k, factors) in left.columns::<M>(row).enumerate() {
        let terms = &right.data[k * right.stride + column..][..N];
        let terms: [S::f32s; N] = from_fn(|n| terms[n]);
        for (sums, factor) in sums.iter_mut().zip(factors) {
            let factor = simd.splat_f32s(factor);
            for (sum, term) in sums.iter_mut().zip(terms) {
                *sum = multiply_add(simd, factor, term, *sum);
            }
        }
    }
    for (m, sums) in sums.into_iter().enumerate() {
        let out = &mut out[start(m)..][..N];
        for (n, sum) in sums.into_iter().enumerate() {
            out[n] = finish(start(m) + n, sum);
        }
    }
}

/// Adds the rows of a row-major matrix to `sums`, row by row.
#[inline(always)]
pub(super) fn add_rows<S: Simd>(simd: S, rows: usize, matrix: Registers<'_, S::f32s>, sums: &mut [f32]) {
    let sums = S::as_mut_simd_f32s(sums).0;
    let mut column = 0;
    macro_rules! strips {
        ($columns:literal) => {
            while sums.len() - column >= $columns {
                let sums = &mut sums[column..][..$columns];
                let mut sum: [S::f32s; $columns] = from_fn(|n| sums[n]);
                for row in 0..rows {
                    let terms = &matrix.data[row * matrix.stride + column..][..$columns];
                    for (sum, &term) in sum.iter_mut().zip(terms) {
                        *sum = simd.add_f32s(*sum, term);
                    }
                }
                sums.copy_from_slice(&sum);
                column += $columns;
            }
        };
    }
    strips!(8);
    strips!(4);
    strips!(2);
    strips!(1);
}
