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

/// Minimizes the sum of the squared residuals from `start`, with parameters in units of `scales`. It stops when the
/// relative change of the sum or of the parameters is below `tolerance`, or after about 60 evaluations.
pub(super) fn minimize(problem: &impl Residuals, start: &[f64], scales: &[f64], tolerance: f64) -> Minimum {
    let scaled = start.iter().zip(scales).map(|(x, scale)| x / scale);
    let state = Scaled {
        problem,
        scales,
        parameters: DVector::from_iterator(start.len(), scaled),
        residuals: RefCell::new(None),
    };
    let solver = LevenbergMarquardt::new().with_tol(tolerance).with_patience(MAX_EVALUATIONS.div_ceil(start.len() + 1));
    let (state, report) = solver.minimize(state);
    Minimum {
        parameters: state.unscaled(&state.parameters),
        cost: report.objective_function,
        evaluations: report.number_of_evaluations,
        converged: report.termination.was_successful(),
    }
}

/// Largest number of evaluations.
const MAX_EVALUATIONS: usize = 60;

/// A problem with parameters in units of their scales.
struct Scaled<'a, P> {
    problem: &'a P,
    scales: &'a [f64],
    parameters: DVector<f64>,
    /// Residuals of the last parameters.
    residuals: RefCell<Option<DVector<f64>>>,
}

impl<P> Scaled<'_, P> {
    fn unscaled(&self, parameters: &DVector<f64>) -> Vec<f64> {
        parameters.iter().zip(self.scales).map(|(x, scale)| x * scale).collect()
    }
}

impl<P: Residuals> LeastSquaresProblem<f64, Dyn, Dyn> for Scaled<'_, P> {
    type ResidualStorage = VecStorage<f64, Dyn, nalgebra_of_solver::U1>;
    type JacobianStorage = VecStorage<f64, Dyn, Dyn>;
    type ParameterStorage = VecStorage<f64, Dyn, nalgebra_of_solver::U1>;

    fn set_params(&mut self, parameters: &DVector<f64>) {
        if self.parameters != *parameters {
            self.parameters.copy_from(parameters);
            self.residuals.replace(None);
        }
    }

    fn params(&self) -> DVector<f64> {
        self.parameters.clone()
    }

    fn residuals(&self) -> Option<DVector<f64>> {
        let mut known = self.residuals.borrow_mut();
        let compute = || DVector::from_vec(self.problem.residuals(&self.unscaled(&self.parameters)));
        Some(known.get_or_insert_with(compute).clone())
    }

    fn jacobian(&self) -> Option<DMatrix<f64>> {
        let (residuals, derivatives) = self.problem.jacobian(&self.unscaled(&self.parameters));
        let mut jacobian = DMatrix::from_vec(residuals.len(), self.parameters.len(), derivatives);
        for (mut column, scale) in jacobian.column_iter_mut().zip(self.scales) {
            column *= *scale;
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
            assert!(found.converged && found.cost < 1e-12, "{found:?}");
            for (found, truth) in found.parameters.iter().zip(truth) {
                assert!((found / truth - 1.0).abs() < 1e-8, "{found} {truth}");
            }
        }
    }
}
