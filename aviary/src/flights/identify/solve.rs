//! Levenberg–Marquardt minimization: MINPACK's algorithm in the crate `levenberg-marquardt`.

use std::cell::RefCell;

use levenberg_marquardt::{LeastSquaresProblem, LevenbergMarquardt};
// the version of nalgebra in the interface of `levenberg-marquardt`
use nalgebra_of_solver::{DMatrix, DVector, Dyn, VecStorage};

/// A nonlinear least-squares problem.
pub(super) trait Residuals {
    /// Returns the residuals. They are finite for all parameters.
    fn residuals(&self, parameters: &[f64]) -> Vec<f64>;

    /// Returns the residuals and the derivatives by every parameter, one column after the other.
    fn jacobian(&self, parameters: &[f64]) -> (Vec<f64>, Vec<f64>);
}

/// Minimum of a problem.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Minimum {
    /// Parameters.
    pub parameters: Vec<f64>,
    /// Half the sum of the squared residuals.
    pub cost: f64,
    /// Number of evaluations of the residuals.
    pub evaluations: usize,
    /// True if the step became small; false if the evaluations were exhausted.
    pub converged: bool,
}

/// Weight of a change of a parameter by its scale. It keeps parameters without effect where they are.
const RIDGE: f64 = 0.05;

/// Minimizes the sum of the squared residuals from `start`, with parameters in units of `scales`. It stops when the
/// relative change of the sum or of the parameters is below `tolerance`, or after about 60 evaluations.
pub(super) fn minimize(problem: &impl Residuals, start: &[f64], scales: &[f64], tolerance: f64) -> Minimum {
    let state = Scaled { problem, start, scales, changes: DVector::zeros(start.len()), residuals: RefCell::new(None) };
    let solver = LevenbergMarquardt::new().with_tol(tolerance).with_patience(MAX_EVALUATIONS.div_ceil(start.len() + 1));
    let (state, report) = solver.minimize(state);
    Minimum {
        parameters: state.parameters(),
        cost: report.objective_function,
        evaluations: report.number_of_evaluations,
        converged: report.termination.was_successful(),
    }
}

/// Largest number of evaluations.
const MAX_EVALUATIONS: usize = 60;

/// A problem whose parameters are changes from the start in units of the scales, with the ridge as further residuals.
struct Scaled<'a, P> {
    problem: &'a P,
    start: &'a [f64],
    scales: &'a [f64],
    changes: DVector<f64>,
    /// Residuals of the last changes.
    residuals: RefCell<Option<DVector<f64>>>,
}

impl<P> Scaled<'_, P> {
    fn parameters(&self) -> Vec<f64> {
        let changes = self.changes.iter().zip(self.scales).map(|(x, scale)| x * scale);
        self.start.iter().zip(changes).map(|(start, change)| start + change).collect()
    }
}

impl<P: Residuals> LeastSquaresProblem<f64, Dyn, Dyn> for Scaled<'_, P> {
    type ResidualStorage = VecStorage<f64, Dyn, nalgebra_of_solver::U1>;
    type JacobianStorage = VecStorage<f64, Dyn, Dyn>;
    type ParameterStorage = VecStorage<f64, Dyn, nalgebra_of_solver::U1>;

    fn set_params(&mut self, changes: &DVector<f64>) {
        if self.changes != *changes {
            self.changes.copy_from(changes);
            self.residuals.replace(None);
        }
    }

    fn params(&self) -> DVector<f64> {
        self.changes.clone()
    }

    fn residuals(&self) -> Option<DVector<f64>> {
        let mut known = self.residuals.borrow_mut();
        let compute = || {
            let mut residuals = self.problem.residuals(&self.parameters());
            residuals.extend(self.changes.iter().map(|change| RIDGE * change));
            DVector::from_vec(residuals)
        };
        Some(known.get_or_insert_with(compute).clone())
    }

    fn jacobian(&self) -> Option<DMatrix<f64>> {
        let (residuals, derivatives) = self.problem.jacobian(&self.parameters());
        let (rows, count) = (residuals.len(), self.changes.len());
        let mut jacobian = DMatrix::zeros(rows + count, count);
        let columns = jacobian.column_iter_mut().zip(derivatives.chunks(rows.max(1))).zip(self.scales);
        for (index, ((mut column, derivatives), scale)) in columns.enumerate() {
            for (entry, derivative) in column.iter_mut().zip(derivatives) {
                *entry = derivative * scale;
            }
            column[rows + index] = RIDGE;
        }
        Some(jacobian)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Samples of a·e^(−b·t) at t = 0, 1, …, with a and b of different magnitudes.
    struct Decay(Vec<f64>);

    impl Residuals for Decay {
        fn residuals(&self, x: &[f64]) -> Vec<f64> {
            let predicted = (0..).map(|t| x[0] * (-x[1] * f64::from(t)).exp());
            self.0.iter().zip(predicted).map(|(measured, predicted)| predicted - measured).collect()
        }

        fn jacobian(&self, x: &[f64]) -> (Vec<f64>, Vec<f64>) {
            let shapes: Vec<_> = (0..self.0.len()).map(|t| (-x[1] * t as f64).exp()).collect();
            let by_rate = shapes.iter().enumerate().map(|(t, shape)| -(t as f64) * x[0] * shape);
            let derivatives = shapes.iter().copied().chain(by_rate).collect();
            (self.residuals(x), derivatives)
        }
    }

    #[test]
    fn the_minimum_of_an_exact_problem_is_the_truth_for_any_scales() {
        let truth = [3e4, 2e-2];
        let problem = Decay((0..40).map(|t| truth[0] * (-truth[1] * f64::from(t)).exp()).collect());
        for scales in [[1e4, 1e-2], [1e3, 1.0], [1e5, 1e-3]] {
            let found = minimize(&problem, &[1e3, 0.2], &scales, 1e-12);
            assert!(found.converged, "{found:?}");
            // the ridge has next to no weight
            for (found, truth) in found.parameters.iter().zip(truth) {
                assert!((found / truth - 1.0).abs() < 1e-5, "{found} {truth}");
            }
        }
    }
}
