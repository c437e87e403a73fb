//! Standard errors and identifiability of least-squares estimates from correlated windows.

use nalgebra::{DMatrix, DVector, SymmetricEigen};

/// A number with its standard error.
#[derive(Debug, Clone, Copy, PartialEq, serde::Serialize)]
pub struct Estimate {
    /// Value.
    pub value: f64,
    /// Standard error; infinite for a number that the data do not determine.
    #[serde(serialize_with = "crate::flights::identify::finite_or_null")]
    pub error: f64,
}

/// Eigenvalues of a normalized information matrix below this number are treated as zero.
const RANK_TOLERANCE: f64 = 1e-12;

/// Sums of a least-squares problem at its minimum: JᵀJ, and the gradient Jᵀr of every block of residuals. Residuals in
/// different blocks are taken as independent, residuals in a block may be correlated.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Information {
    /// JᵀJ.
    pub matrix: DMatrix<f64>,
    /// Jᵀr of every block; zero for a block without residuals.
    pub scores: Vec<DVector<f64>>,
}

impl Information {
    /// Creates the sums from a Jacobian, its residuals and the block of every residual, which is below `count`.
    pub fn new(jacobian: &DMatrix<f64>, residuals: &DVector<f64>, blocks: &[usize], count: usize) -> Self {
        let mut scores = vec![DVector::zeros(jacobian.ncols()); count];
        for (index, column) in jacobian.column_iter().enumerate() {
            for ((slope, residual), block) in column.iter().zip(residuals.iter()).zip(blocks) {
                scores[*block][index] += slope * residual;
            }
        }
        Self { matrix: jacobian.tr_mul(jacobian), scores }
    }

    /// Adds the sums of other residuals with the same blocks, `times` times.
    pub fn add(&mut self, other: &Self, times: f64) {
        self.matrix += &other.matrix * times;
        for (score, other) in self.scores.iter_mut().zip(&other.scores) {
            *score += other * times;
        }
    }

    /// Returns the block of JᵀJ of some parameters with others.
    pub fn cross(&self, rows: &[usize], columns: &[usize]) -> DMatrix<f64> {
        DMatrix::from_fn(rows.len(), columns.len(), |row, column| self.matrix[(rows[row], columns[column])])
    }

    /// Returns the number of parameters.
    fn len(&self) -> usize {
        self.matrix.nrows()
    }

    /// Returns the sums for some of the parameters, the others held constant.
    pub fn of(&self, parameters: &[usize]) -> Self {
        let pick =
            |score: &DVector<f64>| DVector::from_iterator(parameters.len(), parameters.iter().map(|&i| score[i]));
        Self {
            matrix: DMatrix::from_fn(parameters.len(), parameters.len(), |row, column| {
                self.matrix[(parameters[row], parameters[column])]
            }),
            scores: self.scores.iter().map(pick).collect(),
        }
    }

    /// Returns the scales 1/√(JᵀJ)ᵢᵢ of the parameters; zero for a parameter without effect.
    fn scales(&self) -> DVector<f64> {
        self.matrix.diagonal().map(|x| if x > 0.0 { 1.0 / x.sqrt() } else { 0.0 })
    }

    /// Returns the eigenvalues and eigenvectors of JᵀJ with columns of J of norm 1.
    fn eigen(&self) -> SymmetricEigen<f64, nalgebra::Dyn> {
        let scales = DMatrix::from_diagonal(&self.scales());
        SymmetricEigen::new(&scales * &self.matrix * &scales)
    }

    /// Returns the pseudo-inverse of JᵀJ, and for every parameter whether the data determine it.
    fn inverse(&self) -> (DMatrix<f64>, Vec<bool>) {
        // the decomposition of an empty matrix panics
        if self.len() == 0 {
            return (DMatrix::zeros(0, 0), Vec::new());
        }
        let (scales, eigen) = (self.scales(), self.eigen());
        let count = self.len();
        let mut inverse = DMatrix::zeros(count, count);
        let mut determined: Vec<bool> = scales.iter().map(|scale| *scale > 0.0).collect();
        for (value, vector) in eigen.eigenvalues.iter().zip(eigen.eigenvectors.column_iter()) {
            if *value > RANK_TOLERANCE {
                inverse += vector * vector.transpose() / *value;
            } else {
                for (flag, part) in determined.iter_mut().zip(vector.iter()) {
                    *flag &= part.abs() < 1e-4;
                }
            }
        }
        let scales = DMatrix::from_diagonal(&scales);
        (&scales * inverse * &scales, determined)
    }

    /// Returns the standard errors of all parameters: the sandwich H⁻¹·(Σ g·gᵀ)·H⁻¹·B/(B − 1) with H = JᵀJ and the
    /// gradients g of B blocks minus their mean, which is not zero away from the minimum. They are infinite with less
    /// than two blocks.
    pub fn standard_errors(&self) -> Vec<f64> {
        let (inverse, determined) = self.inverse();
        let mut squares = DVector::zeros(self.len());
        let mean = self.gradient() / self.blocks().count().max(1) as f64;
        for score in self.blocks() {
            squares += (&inverse * (score - &mean)).map(|x| x * x);
        }
        let error = |(square, determined): (&f64, bool)| {
            if determined { (square * self.correction()).sqrt() } else { f64::INFINITY }
        };
        squares.iter().zip(determined).map(error).collect()
    }

    /// Returns the gradients of the blocks with residuals.
    fn blocks(&self) -> impl Iterator<Item = &DVector<f64>> {
        self.scores.iter().filter(|score| score.iter().any(|x| *x != 0.0))
    }

    /// Returns the factor B/(B − 1) for the number of blocks.
    pub fn correction(&self) -> f64 {
        let blocks = self.blocks().count();
        if blocks < 2 { f64::INFINITY } else { blocks as f64 / (blocks - 1) as f64 }
    }

    /// Returns the change of the parameters by a Gauss–Newton step for a gradient Jᵀr.
    pub fn step_for(&self, gradients: &[DVector<f64>]) -> Vec<DVector<f64>> {
        let (inverse, _) = self.inverse();
        gradients.iter().map(|gradient| -(&inverse * gradient)).collect()
    }

    /// Returns the gradient Jᵀr of all blocks.
    pub fn gradient(&self) -> DVector<f64> {
        self.scores.iter().fold(DVector::zeros(self.len()), |sum, score| sum + score)
    }

    /// Returns the standard error of a parameter if all others were known.
    pub fn error_alone(&self, parameter: usize) -> f64 {
        self.of(&[parameter]).standard_errors()[0]
    }

    /// Returns the change of the parameters by a Gauss–Newton step.
    pub fn step(&self) -> DVector<f64> {
        -(self.inverse().0 * self.gradient())
    }

    /// Returns the parameters that a change of one parameter can be compensated with, strongest first: those with
    /// a share above 0.3 in the eigenvectors of small eigenvalues in which the parameter has one.
    pub fn partners(&self, parameter: usize) -> Vec<usize> {
        let eigen = self.eigen();
        let mut shares = vec![0.0_f64; self.len()];
        for (value, vector) in eigen.eigenvalues.iter().zip(eigen.eigenvectors.column_iter()) {
            let largest = vector.amax();
            if *value < 0.05 && vector[parameter].abs() > 0.3 * largest {
                let weight = 1.0 / value.max(RANK_TOLERANCE);
                for (share, part) in shares.iter_mut().zip(vector.iter()) {
                    let part = part.abs() / largest;
                    *share += if part > 0.3 { part * weight } else { 0.0 };
                }
            }
        }
        let mut partners: Vec<usize> = (0..self.len()).filter(|&i| i != parameter && shares[i] > 0.0).collect();
        partners.sort_by(|a, b| shares[*b].total_cmp(&shares[*a]));
        partners.truncate(3);
        partners
    }
}

/// Returns the linear least-squares solution of `design · x = target`, with standard errors by blocks.
pub(super) fn block_regression(design: &DMatrix<f64>, target: &DVector<f64>, blocks: &[usize]) -> Vec<Estimate> {
    two_stages(design, design, target, blocks)
}

/// Returns the solution of `design · x = target` by two-stage least squares, with standard errors by blocks: noise of
/// the design that is independent of the instruments does not bias it.
pub(super) fn instrumented_regression(
    design: &DMatrix<f64>,
    instruments: &DMatrix<f64>,
    target: &DVector<f64>,
    blocks: &[usize],
) -> Vec<Estimate> {
    let products = Information { matrix: instruments.tr_mul(instruments), scores: Vec::new() };
    let explained = instruments * (products.inverse().0 * instruments.tr_mul(design));
    two_stages(design, &explained, target, blocks)
}

/// Solves `explained · x = target`. The standard errors follow from the residuals of `design`.
fn two_stages(
    design: &DMatrix<f64>,
    explained: &DMatrix<f64>,
    target: &DVector<f64>,
    blocks: &[usize],
) -> Vec<Estimate> {
    let count = blocks.iter().max().map_or(0, |last| last + 1);
    let solution = Information::new(explained, &-target, blocks, count).step();
    let rest = design * &solution - target;
    let errors = Information::new(explained, &rest, blocks, count).standard_errors();
    solution.iter().zip(errors).map(|(&value, error)| Estimate { value, error }).collect()
}

/// Returns the standard error of an estimate by the jackknife: from the estimates without one flight each.
pub(super) fn jackknife(without: &[f64]) -> f64 {
    let count = without.len() as f64;
    let mean = without.iter().sum::<f64>() / count;
    let squares: f64 = without.iter().map(|x| (x - mean) * (x - mean)).sum();
    ((count - 1.0) / count * squares).sqrt()
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;
    use rand::{RngExt, SeedableRng};

    /// Standard normal number, by the sum of twelve uniform ones.
    fn normal(rng: &mut impl RngExt) -> f64 {
        (0..12).map(|_| rng.random_range(0.0..1.0)).sum::<f64>() - 6.0
    }

    #[test]
    fn instruments_remove_the_attenuation_by_noise() {
        let (truth, blocks, rows) = (2.0, 40, 50);
        let mut rng = rand_chacha::ChaCha8Rng::seed_from_u64(4);
        let count = blocks * rows;
        let (mut design, mut instruments) = (DMatrix::zeros(count, 1), DMatrix::zeros(count, 1));
        let mut target = DVector::zeros(count);
        for line in 0..count {
            let signal = normal(&mut rng);
            design[(line, 0)] = signal + 0.7 * normal(&mut rng);
            instruments[(line, 0)] = 0.5 * signal + 0.2 * normal(&mut rng);
            target[line] = truth * signal + 0.1 * normal(&mut rng);
        }
        let ids: Vec<usize> = (0..count).map(|line| line / rows).collect();
        // noise of variance 0.49 makes the slope smaller by a factor of 1.49
        let plain = block_regression(&design, &target, &ids)[0];
        assert!((plain.value - truth / 1.49).abs() < 4.0 * plain.error, "{plain:?}");
        let found = instrumented_regression(&design, &instruments, &target, &ids)[0];
        assert!((found.value - truth).abs() < 4.0 * found.error && found.error < 0.1, "{found:?}");
    }

    #[test]
    fn errors_of_correlated_residuals_cover_the_truth() {
        // ten rows of equal noise a block: an error that takes rows as independent is √10 times too small
        let (truth, blocks, rows, runs) = ([2.0, -0.5], 40, 10, 300);
        let mut rng = rand_chacha::ChaCha8Rng::seed_from_u64(3);
        let (mut inside, mut mean_error) = (0, 0.0);
        for _ in 0..runs {
            let count = blocks * rows;
            let (mut design, mut target) = (DMatrix::zeros(count, 2), DVector::zeros(count));
            let mut ids = Vec::new();
            for block in 0..blocks {
                let (slope, noise) = (normal(&mut rng), normal(&mut rng));
                for row in 0..rows {
                    let line = block * rows + row;
                    design[(line, 0)] = 1.0;
                    design[(line, 1)] = slope;
                    target[line] = truth[0] + truth[1] * slope + noise;
                    ids.push(block);
                }
            }
            let estimates = block_regression(&design, &target, &ids);
            inside += i32::from((estimates[0].value - truth[0]).abs() < 2.0 * estimates[0].error);
            mean_error += estimates[0].error / f64::from(runs);
        }
        // the mean of 40 independent numbers
        assert!((mean_error - (1.0 / 40.0_f64).sqrt()).abs() < 0.01, "{mean_error}");
        assert!((0.91..0.98).contains(&(f64::from(inside) / f64::from(runs))), "{inside} of {runs}");
    }

    #[test]
    fn collinear_and_ineffective_parameters_are_not_determined() {
        // the second column is twice the first, the third has no effect, the fourth is independent
        let design = DMatrix::from_fn(20, 4, |row, column| {
            let x = (row as f64 * 0.7).sin();
            [x, 2.0 * x, 0.0, (row as f64 * 1.9).cos()][column]
        });
        let target = DVector::from_fn(20, |row, _| (row as f64 * 0.3).cos());
        let blocks: Vec<_> = (0..20).collect();
        let information = Information::new(&design, &target, &blocks, blocks.len());
        let errors = information.standard_errors();
        assert!(errors[..3].iter().all(|error| error.is_infinite()), "{errors:?}");
        assert!(errors[3].is_finite() && information.error_alone(0).is_finite());
        assert!(information.error_alone(2).is_infinite());
        assert_eq!((information.partners(0), information.partners(1)), (vec![1], vec![0]));
        assert!(information.partners(3).is_empty());
        let alone = information.of(&[1, 3]);
        let errors = alone.standard_errors();
        assert!(errors.iter().all(|error| error.is_finite()));
        let other_order = information.of(&[3, 1]).standard_errors()[0];
        assert!((errors[1] / other_order - 1.0).abs() < 1e-9);
    }

    proptest! {
        #[test]
        fn a_step_solves_a_linear_problem(truth in prop::array::uniform3(-5.0..5.0_f64), seed in 0_u64..1000) {
            let mut rng = rand_chacha::ChaCha8Rng::seed_from_u64(seed);
            let design = DMatrix::from_fn(30, 3, |_, column| normal(&mut rng) * [1.0, 1e4, 1e-3][column]);
            let target = &design * DVector::from_row_slice(&truth);
            let estimates = block_regression(&design, &target, &(0..30).collect::<Vec<_>>());
            for (estimate, truth) in estimates.iter().zip(truth) {
                prop_assert!((estimate.value - truth).abs() < 1e-7 && estimate.error < 1e-7, "{estimate:?} {truth}");
            }
        }
    }

    #[test]
    fn the_jackknife_of_a_mean_is_its_standard_error() {
        let numbers = [1.0, 4.0, 2.0, 8.0, 5.0];
        let without: Vec<_> = numbers.iter().map(|x| (20.0 - x) / 4.0).collect();
        let variance: f64 = numbers.iter().map(|x| (x - 4.0) * (x - 4.0)).sum::<f64>() / 4.0;
        assert!((jackknife(&without) - (variance / 5.0).sqrt()).abs() < 1e-12);
    }
}
