//! Line search of MuJoCo's Newton solver.

use super::{POINTS, Problem, Settings, dot, minus, negative};

/// Cost along a line, with its first two derivatives.
#[derive(Debug, Clone, Copy, Default)]
struct LinePoint {
    step: f64,
    cost: f64,
    slope: f64,
    curvature: f64,
}

impl LinePoint {
    /// Returns the step to the minimum of the parabola through this point.
    #[inline(always)]
    fn newton(&self) -> f64 {
        self.step - self.slope / self.curvature
    }
}

/// Largest number of evaluations in a line search.
const MAX_EVALUATIONS: u32 = 50;

/// Cost along the search direction.
struct Line<'a> {
    problems: &'a [Problem],
    /// Coefficients of the part without contacts, constant first.
    parabola: [f64; 3],
    evaluations: u32,
}

impl Line<'_> {
    fn at(&mut self, step: f64) -> LinePoint {
        self.evaluations += 1;
        let [constant, linear, square] = self.parabola;
        let (mut cost, mut slope, mut curvature) = (0.0, 0.0, 0.0);
        for Problem { weight, work, .. } in self.problems {
            let (mut costs, mut slopes, mut curvatures) = ([0.0; POINTS], [0.0; POINTS], [0.0; POINTS]);
            for (start, change) in work.residual.iter().zip(&work.slope) {
                for point in 0..POINTS {
                    let residual = negative(start[point] + step * change[point]);
                    let active = if residual < 0.0 { change[point] } else { 0.0 };
                    costs[point] += residual * residual;
                    slopes[point] += active * residual;
                    curvatures[point] += active * active;
                }
            }
            for point in 0..POINTS {
                cost += weight[point] * costs[point];
                slope += weight[point] * slopes[point];
                curvature += weight[point] * curvatures[point];
            }
        }
        cost = 0.5 * cost + (step * square + linear) * step + constant;
        slope += 2.0 * step * square + linear;
        curvature += 2.0 * square;
        LinePoint { step, cost, slope, curvature }
    }

    /// Replaces a bracket by the nearest candidates on its side of the minimum, and `next` by the step from there.
    /// Returns false if no candidate is nearer.
    fn narrow(&mut self, bracket: &mut LinePoint, next: &mut LinePoint, candidates: &[LinePoint; 3]) -> bool {
        let mut nearer = false;
        for candidate in candidates {
            let (here, there) = (bracket.slope, candidate.slope);
            if (here < 0.0 && there < 0.0 && here < there) || (here > 0.0 && there > 0.0 && here > there) {
                *bracket = *candidate;
                nearer = true;
            }
        }
        if nearer {
            *next = self.at(bracket.newton());
        }
        nearer
    }
}

/// Returns the step along the search direction to the minimum of the cost, or 0 if no step lowers the cost, by
/// MuJoCo's line search. `descent` is the derivative of the cost, and `length` the norm of the search direction.
#[cold]
pub(super) fn search_line(settings: &Settings, problems: &[Problem], cost: f64, descent: f64, length: f64) -> f64 {
    let tolerance = 0.01 * settings.tolerance * settings.scale * length;
    let mut parabola = [0.0; 3];
    for problem in problems {
        let from_smooth = minus(&problem.acceleration, &problem.smooth);
        let pull = problem.times_inertia(&problem.work.search);
        parabola[0] += 0.5 * dot(&problem.times_inertia(&from_smooth), &from_smooth);
        parabola[1] += dot(&pull, &from_smooth);
        parabola[2] += 0.5 * dot(&pull, &problem.work.search);
    }
    // the start counts as an evaluation; the curvature is that of the Hessian
    let mut line = Line { problems, parabola, evaluations: 1 };
    let start = LinePoint { step: 0.0, cost, slope: descent, curvature: -descent };
    let mut near = line.at(start.newton());
    if start.cost < near.cost {
        near = start;
    }
    let converged = |point: &LinePoint| point.slope.abs() < tolerance;
    if converged(&near) {
        return near.step;
    }
    let forward = near.slope < 0.0;
    let mut far = near;
    while (if forward { near.slope } else { -near.slope }) <= -tolerance && line.evaluations < MAX_EVALUATIONS {
        far = near;
        near = line.at(near.newton());
        if converged(&near) {
            return near.step;
        }
    }
    if line.evaluations >= MAX_EVALUATIONS {
        return near.step;
    }
    // the minimum is between the two brackets
    let (mut far_next, mut near_next) = (near, line.at(near.newton()));
    while line.evaluations < MAX_EVALUATIONS {
        let middle = line.at(0.5 * (near.step + far.step));
        let candidates = [near_next, far_next, middle];
        let mut best: Option<LinePoint> = None;
        for candidate in candidates.iter().filter(|candidate| converged(candidate)) {
            if best.is_none_or(|best| candidate.cost < best.cost) {
                best = Some(*candidate);
            }
        }
        if let Some(best) = best {
            return best.step;
        }
        let nearer = line.narrow(&mut near, &mut near_next, &candidates);
        if !line.narrow(&mut far, &mut far_next, &candidates) && !nearer {
            return middle.step;
        }
    }
    let better = if near.cost <= far.cost { near } else { far };
    if better.cost < start.cost { better.step } else { 0.0 }
}
