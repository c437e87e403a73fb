//! Products of matrices in blocks of registers.
//!
//! Functions are inlined into one function per instruction set. Closures and iterators of the standard library are not
//! always inlined, so that the inner loops use neither.

#![allow(clippy::needless_range_loop)]

use pulp::{Simd, WithSimd};

use super::multiply_add;

/// Left factor of a product.
pub(super) trait Left {
    /// Adds the product of `M` rows from row `first` on and of a block of columns of the right factor to `sums`.
    fn multiply<S: Simd, const M: usize, const N: usize>(
        &self,
        simd: S,
        first: usize,
        right: Block<'_, S::f32s>,
        sums: [[S::f32s; N]; M],
    ) -> [[S::f32s; N]; M];
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
    fn multiply<S: Simd, const M: usize, const N: usize>(
        &self,
        simd: S,
        first: usize,
        right: Block<'_, S::f32s>,
        mut sums: [[S::f32s; N]; M],
    ) -> [[S::f32s; N]; M] {
        let depth = self.depth;
        let mut rows: [&[f32]; M] = [&[]; M];
        for m in 0..M {
            rows[m] = &self.data[(first + m) * self.stride..][..depth];
        }
        for k in 0..depth {
            let terms = right.row::<N>(k);
            for m in 0..M {
                let factor = simd.splat_f32s(rows[m][k]);
                for n in 0..N {
                    sums[m][n] = multiply_add(simd, factor, terms[n], sums[m][n]);
                }
            }
        }
        sums
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
    fn multiply<S: Simd, const M: usize, const N: usize>(
        &self,
        simd: S,
        first: usize,
        right: Block<'_, S::f32s>,
        mut sums: [[S::f32s; N]; M],
    ) -> [[S::f32s; N]; M] {
        for k in 0..self.depth {
            let factors = &self.data[k * self.stride + first..][..M];
            let terms = right.row::<N>(k);
            for m in 0..M {
                let factor = simd.splat_f32s(factors[m]);
                for n in 0..N {
                    sums[m][n] = multiply_add(simd, factor, terms[n], sums[m][n]);
                }
            }
        }
        sums
    }
}

/// Columns of a row-major matrix in registers.
#[derive(Clone, Copy)]
pub(super) struct Block<'a, R> {
    /// Registers from the first row of the first column on.
    data: &'a [R],
    stride: usize,
}

impl<R: Copy> Block<'_, R> {
    #[inline(always)]
    fn row<const N: usize>(self, row: usize) -> [R; N] {
        let row = &self.data[row * self.stride..][..N];
        let mut copy = [row[0]; N];
        copy.copy_from_slice(row);
        copy
    }
}

/// Start and end of the sums of a product.
pub(super) trait Ends<S: Simd>: Copy {
    /// Returns the start of the sums of a column; `out` is the register that the result replaces.
    fn begin(self, simd: S, column: usize, out: S::f32s) -> S::f32s;

    /// Returns the result for a sum; `index` is the register's index in the output.
    fn end(self, simd: S, index: usize, sum: S::f32s) -> S::f32s;
}

/// Product without its output.
pub(super) struct Product<'a, S: Simd, L, E> {
    pub simd: S,
    /// Numbers of rows and columns.
    pub shape: (usize, usize),
    pub left: L,
    /// Right factor, row-major.
    pub right: &'a [f32],
    /// Distance of rows of the right factor and of the output, a multiple of the lanes.
    pub stride: usize,
    pub ends: E,
}

/// Product with its output.
struct Write<'a, 'b, S: Simd, L, E> {
    product: Product<'a, S, L, E>,
    out: &'b mut [f32],
}

impl<S: Simd, L: Left, E: Ends<S>> WithSimd for Write<'_, '_, S, L, E> {
    type Output = ();

    #[inline(always)]
    fn with_simd<T: Simd>(self, _: T) {
        self.product.compute(self.out);
    }
}

impl<S: Simd, L: Left, E: Ends<S>> Product<'_, S, L, E> {
    /// Computes the product, in a function of its own: copies of the blocks in every pass would take most of the time
    /// of a build.
    #[inline(always)]
    pub fn write(self, out: &mut [f32]) {
        let simd = self.simd;
        simd.vectorize(Write { product: self, out });
    }

    #[inline(always)]
    fn compute(&self, out: &mut [f32]) {
        let width = self.shape.1.div_ceil(S::F32_LANES);
        let (out, _) = S::as_mut_simd_f32s(out);
        let mut column = 0;
        // with the six rows of a block, four columns fill 32 registers, and two columns fill 16
        if S::REGISTER_COUNT >= 32 {
            while width - column >= 4 {
                self.strip::<4>(column, out);
                column += 4;
            }
        }
        while width - column >= 2 {
            self.strip::<2>(column, out);
            column += 2;
        }
        if column < width {
            self.strip::<1>(column, out);
        }
    }

    /// Computes `N` columns.
    #[inline(always)]
    fn strip<const N: usize>(&self, column: usize, out: &mut [S::f32s]) {
        let (rows, _) = self.shape;
        let mut row = 0;
        while rows - row >= 6 {
            self.block::<6, N>(row, column, out);
            row += 6;
        }
        match rows - row {
            5 => self.block::<5, N>(row, column, out),
            4 => self.block::<4, N>(row, column, out),
            3 => self.block::<3, N>(row, column, out),
            2 => self.block::<2, N>(row, column, out),
            1 => self.block::<1, N>(row, column, out),
            _ => {}
        }
    }

    /// Computes a block of `M` rows and `N` columns, whose sums stay in registers.
    #[inline(always)]
    fn block<const M: usize, const N: usize>(&self, row: usize, column: usize, out: &mut [S::f32s]) {
        let stride = self.stride / S::F32_LANES;
        let mut sums = [[self.simd.splat_f32s(0.0); N]; M];
        for m in 0..M {
            let out = &out[(row + m) * stride + column..][..N];
            for n in 0..N {
                sums[m][n] = self.ends.begin(self.simd, column + n, out[n]);
            }
        }
        let right = Block { data: &S::as_simd_f32s(self.right).0[column..], stride };
        let sums = self.left.multiply(self.simd, row, right, sums);
        for m in 0..M {
            let start = (row + m) * stride + column;
            let out = &mut out[start..][..N];
            for n in 0..N {
                out[n] = self.ends.end(self.simd, start + n, sums[m][n]);
            }
        }
    }
}

/// Adds the rows of a row-major matrix to `sums`, row by row.
#[inline(always)]
pub(super) fn add_rows<S: Simd>(simd: S, rows: usize, matrix: &[f32], sums: &mut [f32]) {
    let (sums, _) = S::as_mut_simd_f32s(sums);
    let block = Block { data: S::as_simd_f32s(matrix).0, stride: sums.len() };
    let mut column = 0;
    while sums.len() - column >= 4 {
        add_strip::<S, 4>(simd, rows, block, column, sums);
        column += 4;
    }
    while column < sums.len() {
        add_strip::<S, 1>(simd, rows, block, column, sums);
        column += 1;
    }
}

#[inline(always)]
fn add_strip<S: Simd, const N: usize>(
    simd: S,
    rows: usize,
    matrix: Block<'_, S::f32s>,
    column: usize,
    sums: &mut [S::f32s],
) {
    let block = Block { data: &matrix.data[column..], stride: matrix.stride };
    let sums = &mut sums[column..][..N];
    let mut total = [simd.splat_f32s(0.0); N];
    total.copy_from_slice(sums);
    for row in 0..rows {
        let terms = block.row::<N>(row);
        for n in 0..N {
            total[n] = simd.add_f32s(total[n], terms[n]);
        }
    }
    sums.copy_from_slice(&total);
}
