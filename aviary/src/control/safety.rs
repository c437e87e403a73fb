use clarabel::algebra::CscMatrix;
use clarabel::solver::{DefaultSettingsBuilder, DefaultSolver, IPSolver as _, NonnegativeConeT, SolverStatus};
use nalgebra::{Vector2, Vector3};

/// Safety filter that keeps drones apart in the horizontal plane by minimal changes of their commanded accelerations.
///
/// The filter applies two control barrier functions to every pair of drones, with p and v the relative position and
/// velocity in the horizontal plane and r the `radius`:
///
/// - the collision cone (Tayal et al. 2024), h = p·v + ‖v‖·√(‖p‖² − r²), ḣ + γ·h ≥ 0, which keeps the relative velocity
///   outside the cone of directions that lead into a circle of radius r about the other drone;
/// - the distance, b = ‖p‖² − r², b̈ + 2·k·ḃ + k²·b ≥ 0, which also separates drones that are already too close.
///
/// A quadratic program computes the accelerations that satisfy the barriers of all pairs and are closest to the
/// commanded ones, with components within `max_acceleration`. If the program is infeasible, slack variables relax the
/// barriers by the smallest amount.
///
/// The filter does not change vertical accelerations, because the downwash makes it unsafe to pass below a drone.
///
/// ```
/// use aviary::control::CollisionCone;
/// use nalgebra::Vector3;
///
/// let filter = CollisionCone::new(0.3);
/// let positions = [Vector3::zeros(), Vector3::new(1.0, 0.02, 0.0)];
/// let velocities = [Vector3::new(1.0, 0.0, 0.0), Vector3::new(-1.0, 0.0, 0.0)];
/// let mut accelerations = [Vector3::zeros(); 2];
/// filter.filter(&positions, &velocities, &mut accelerations)?;
/// assert!(accelerations[0].y < 0.0 && accelerations[1].y > 0.0, "the drones pass each other");
/// # Ok::<(), aviary::control::SafetyError>(())
/// ```
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct CollisionCone {
    /// Minimum horizontal distance r between the centres of two drones, m.
    pub radius: f64,
    /// Gain γ of the collision-cone barrier, 1/s. A larger gain permits a faster approach.
    pub decay: f64,
    /// Gain k of the distance barrier, 1/s. A larger gain permits a faster approach.
    pub approach: f64,
    /// Maximum acceleration along world x and along world y, m/s².
    pub max_acceleration: f64,
    /// Distance in excess of the braking distance beyond which the filter ignores a pair, m.
    pub sight: f64,
}

/// Error of a safety filter.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum SafetyError {
    /// An option outside its range.
    #[error("the safety filter's {option} is {}, expected {expected}", crate::number(*got))]
    Option {
        /// Name of the option.
        option: &'static str,
        /// Value of the option.
        got: f64,
        /// Valid values.
        expected: &'static str,
    },
    /// Lists of different lengths, or values that are not finite or exceed 1e9.
    #[error("the safety filter was given {what}")]
    Input {
        /// Description of the invalid input.
        what: &'static str,
    },
    /// The solver found no solution.
    #[error("the safety filter's quadratic program was not solved ({status})")]
    Unsolved {
        /// Status of the solver.
        status: String,
    },
}

/// A linear constraint on the relative acceleration of the pair (i, j): gradient·(u_j − u_i) ≥ min.
struct Condition {
    pair: (usize, usize),
    gradient: Vector2<f64>,
    min: f64,
}

impl CollisionCone {
    /// Creates a filter with a safety radius (m), and defaults for drones of the size of a Crazyflie.
    pub fn new(radius: f64) -> Self {
        Self { radius, decay: 2.0, approach: 4.0, max_acceleration: 5.0, sight: 4.0 }
    }

    /// Validates the options.
    ///
    /// # Errors
    /// [`SafetyError::Option`] unless every option is in (0, 1e6].
    pub fn validate(&self) -> Result<(), SafetyError> {
        for (option, got) in [
            ("radius", self.radius),
            ("decay", self.decay),
            ("approach", self.approach),
            ("max_acceleration", self.max_acceleration),
            ("sight", self.sight),
        ] {
            if !(got > 0.0 && got <= 1e6) {
                return Err(SafetyError::Option { option, got, expected: "a positive number" });
            }
        }
        Ok(())
    }

    /// Changes the commanded accelerations (world frame, m/s²) so that drones at the given positions (world frame, m)
    /// and velocities (world frame, m/s) keep apart.
    ///
    /// Returns true if the accelerations changed. The filter does not change accelerations that are already safe.
    ///
    /// # Errors
    /// [`SafetyError`], with the accelerations unchanged.
    pub fn filter(
        &self,
        positions: &[Vector3<f64>],
        velocities: &[Vector3<f64>],
        accelerations: &mut [Vector3<f64>],
    ) -> Result<bool, SafetyError> {
        self.validate()?;
        let count = positions.len();
        if velocities.len() != count || accelerations.len() != count {
            return Err(SafetyError::Input { what: "lists of different lengths" });
        }
        let mut numbers = positions.iter().chain(velocities).chain(accelerations.iter()).flatten();
        if !numbers.all(|x| x.abs() < 1e9) {
            return Err(SafetyError::Input { what: "a value that is not finite or exceeds 1e9" });
        }
        let mut conditions = Vec::new();
        for j in 0..count {
            for i in 0..j {
                let (p, v) = ((positions[j] - positions[i]).xy(), (velocities[j] - velocities[i]).xy());
                // fast drones need more distance: both braking stop in v²/4a
                if p.norm() < self.sight + v.norm_squared() / (2.0 * self.max_acceleration) {
                    conditions.extend(self.conditions((i, j), p, v));
                }
            }
        }
        let holds = |condition: &Condition| {
            let (i, j) = condition.pair;
            condition.gradient.dot(&(accelerations[j] - accelerations[i]).xy()) >= condition.min
        };
        if conditions.iter().all(holds) {
            return Ok(false);
        }
        // drops constraints that hold for all accelerations within the bounds
        conditions.retain(|condition| condition.min > -3.0 * self.max_acceleration || !holds(condition));
        self.solve(&conditions, accelerations)?;
        Ok(true)
    }

    /// Returns the constraints of both barriers on a pair.
    fn conditions(&self, pair: (usize, usize), p: Vector2<f64>, v: Vector2<f64>) -> Vec<Condition> {
        let mut conditions = Vec::with_capacity(2);
        let (distance2, r2, k) = (p.norm_squared(), self.radius * self.radius, self.approach);
        // drones at the same position separate along x
        let away = if distance2 > 1e-12 { p } else { Vector2::new(1e-6, 0.0) };
        let min = -v.norm_squared() - 2.0 * k * p.dot(&v) - 0.5 * k * k * (distance2 - r2);
        conditions.push(self.scaled(pair, away, min));
        // the cone exists outside the circle, for drones that approach each other
        let tangent2 = distance2 - r2;
        let speed = v.norm();
        if tangent2 > 0.02 * r2 && speed > 1e-3 && p.dot(&v) < 0.0 {
            let tangent = tangent2.sqrt();
            let h = p.dot(&v) + speed * tangent;
            let gradient = p + v * (tangent / speed);
            let min = -v.norm_squared() - speed * p.dot(&v) / tangent - self.decay * h;
            // at the axis of the cone the gradient vanishes, and neither side is preferred
            if gradient.norm() > 1e-6 {
                conditions.push(self.scaled(pair, gradient, min));
            }
        }
        conditions
    }

    /// Returns a constraint with a unit gradient, so that all slack variables have the same weight. The bound is
    /// limited to what two drones can achieve together.
    fn scaled(&self, pair: (usize, usize), gradient: Vector2<f64>, min: f64) -> Condition {
        let size = gradient.norm();
        Condition { pair, gradient: gradient / size, min: (min / size).min(3.0 * self.max_acceleration) }
    }

    /// Weight of the squared slack of a constraint, relative to a squared change of an acceleration.
    const PENALTY: f64 = 1e4;

    /// Minimizes ½·Σ‖u − u\*‖² + ½·penalty·Σ slack² subject to the constraints, over the drones that occur in them.
    fn solve(&self, conditions: &[Condition], accelerations: &mut [Vector3<f64>]) -> Result<(), SafetyError> {
        let mut involved: Vec<usize> = conditions.iter().flat_map(|c| [c.pair.0, c.pair.1]).collect();
        involved.sort_unstable();
        involved.dedup();
        // the list contains every drone of the constraints, so the search never fails
        let place = |drone: usize| involved.binary_search(&drone).unwrap_or_default();
        let (inputs, slacks) = (2 * involved.len(), conditions.len());
        let columns = inputs + slacks;
        let mut rows = (Vec::new(), Vec::new(), Vec::new());
        let mut right = Vec::with_capacity(2 * slacks + 2 * inputs);
        let mut entry = |row: usize, column: usize, value: f64| {
            rows.0.push(row);
            rows.1.push(column);
            rows.2.push(value);
        };
        for (index, condition) in conditions.iter().enumerate() {
            let (i, j) = (place(condition.pair.0), place(condition.pair.1));
            for axis in 0..2 {
                entry(right.len(), 2 * j + axis, -condition.gradient[axis]);
                entry(right.len(), 2 * i + axis, condition.gradient[axis]);
            }
            entry(right.len(), inputs + index, -1.0);
            right.push(-condition.min);
            entry(right.len(), inputs + index, -1.0);
            right.push(0.0);
        }
        for column in 0..inputs {
            for sign in [1.0, -1.0] {
                entry(right.len(), column, sign);
                right.push(self.max_acceleration);
            }
        }
        let (rows, cols, values) = rows;
        let a = CscMatrix::new_from_triplets(right.len(), columns, rows, cols, values);
        let diagonal: Vec<_> = (0..columns).collect();
        let weights = (0..columns).map(|column| if column < inputs { 1.0 } else { Self::PENALTY }).collect();
        let p = CscMatrix::new_from_triplets(columns, columns, diagonal.clone(), diagonal, weights);
        let mut q = vec![0.0; columns];
        for (pair, &drone) in q[..inputs].chunks_exact_mut(2).zip(&involved) {
            pair.copy_from_slice(&[-accelerations[drone].x, -accelerations[drone].y]);
        }
        // a tolerance of about 1 µm/s² is sufficient, and the limit of iterations bounds the time
        let settings = DefaultSettingsBuilder::default()
            .verbose(false)
            .max_iter(200)
            .tol_gap_abs(1e-7)
            .tol_gap_rel(1e-7)
            .tol_feas(1e-7)
            .build();
        let unsolved = |status: &dyn std::fmt::Debug| SafetyError::Unsolved { status: format!("{status:?}") };
        let settings = settings.map_err(|error| unsolved(&error))?;
        let cones = [NonnegativeConeT(right.len())];
        let mut solver = DefaultSolver::new(&p, &q, &a, &right, &cones, settings).map_err(|error| unsolved(&error))?;
        solver.solve();
        let status = solver.solution.status;
        // an approximate solution is accurate enough for a command
        let found = matches!(
            status,
            SolverStatus::Solved
                | SolverStatus::AlmostSolved
                | SolverStatus::MaxIterations
                | SolverStatus::InsufficientProgress
        );
        if !found || solver.solution.x.iter().any(|x| !x.is_finite()) {
            return Err(unsolved(&status));
        }
        let mut solution: Vec<_> =
            solver.solution.x[..inputs].chunks_exact(2).map(|pair| Vector2::new(pair[0], pair[1])).collect();
        if status != SolverStatus::Solved {
            let wishes: Vec<_> = involved.iter().map(|&drone| accelerations[drone].xy()).collect();
            let conditions: Vec<_> = (conditions.iter())
                .map(|condition| Condition { pair: (place(condition.pair.0), place(condition.pair.1)), ..*condition })
                .collect();
            self.refine(&conditions, &wishes, &mut solution);
        }
        for (&drone, u) in involved.iter().zip(&solution) {
            let [x, y] = [u.x, u.y].map(|x| x.clamp(-self.max_acceleration, self.max_acceleration));
            (accelerations[drone].x, accelerations[drone].y) = (x, y);
        }
        Ok(())
    }

    /// Refines a solution that the solver left inexact, by accelerated projected gradient steps on the same cost
    /// without slack variables (Nesterov 2004, *Introductory Lectures on Convex Optimization*, §2.2, constant step
    /// scheme). Pairs of the constraints are indices into `wishes` and `solution`.
    fn refine(&self, conditions: &[Condition], wishes: &[Vector2<f64>], solution: &mut [Vector2<f64>]) {
        let mut degrees = vec![0.0_f64; wishes.len()];
        for condition in conditions {
            degrees[condition.pair.0] += 1.0;
            degrees[condition.pair.1] += 1.0;
        }
        // bounds of the curvature: 1 from the accelerations, and at most two per constraint of a drone (Gershgorin)
        let curvature = 1.0 + 2.0 * Self::PENALTY * degrees.into_iter().fold(0.0, f64::max);
        let momentum = (curvature.sqrt() - 1.0) / (curvature.sqrt() + 1.0);
        let (mut point, mut gradient) = (solution.to_vec(), vec![Vector2::zeros(); wishes.len()]);
        for _ in 0..20_000 {
            for ((gradient, u), wish) in gradient.iter_mut().zip(&point).zip(wishes) {
                *gradient = u - wish;
            }
            for condition in conditions {
                let (i, j) = condition.pair;
                let slack = condition.min - condition.gradient.dot(&(point[j] - point[i]));
                if slack > 0.0 {
                    let push = condition.gradient * (Self::PENALTY * slack);
                    gradient[j] -= push;
                    gradient[i] += push;
                }
            }
            let mut change: f64 = 0.0;
            for ((u, point), gradient) in solution.iter_mut().zip(&mut point).zip(&gradient) {
                let bound = self.max_acceleration;
                let next = (*point - gradient / curvature).map(|x| x.clamp(-bound, bound));
                change = change.max((next - *u).amax());
                *point = next + (next - *u) * momentum;
                *u = next;
            }
            if change < 1e-10 {
                break;
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    /// Flies double integrators to the opposite points of a circle, and returns the smallest distance between two of
    /// them and the largest distance from a goal, m.
    fn swap(count: usize, turn: f64) -> (f64, f64) {
        let filter = CollisionCone::new(0.3);
        let place = |i: usize| {
            let (sin, cos) = (turn + std::f64::consts::TAU * i as f64 / count as f64).sin_cos();
            Vector3::new(2.0 * cos, 2.0 * sin, 1.0)
        };
        let mut positions: Vec<_> = (0..count).map(place).collect();
        let mut velocities = vec![Vector3::zeros(); count];
        let (dt, mut nearest) = (1.0 / 48.0, f64::MAX);
        for _ in 0..48 * 25 {
            let mut accelerations: Vec<_> = (0..count)
                .map(|i| {
                    let goal = Vector3::new(-place(i).x, -place(i).y, 1.0);
                    let path: Vector3<f64> = goal - positions[i];
                    // a bias to the right breaks the symmetry
                    let path = Vector3::new(path.x + 0.2 * path.y, path.y - 0.2 * path.x, path.z);
                    let wanted = path * (1.0 / path.norm().max(1.0));
                    2.0 * (wanted - velocities[i])
                })
                .collect();
            filter.filter(&positions, &velocities, &mut accelerations).unwrap();
            for i in 0..count {
                velocities[i] += accelerations[i] * dt;
                positions[i] += velocities[i] * dt;
            }
            for i in 0..count {
                for j in 0..i {
                    nearest = f64::min(nearest, (positions[i] - positions[j]).norm());
                }
            }
        }
        let goals = (0..count).map(|i| (positions[i] + place(i) - Vector3::new(0.0, 0.0, 2.0)).norm());
        (nearest, goals.fold(0.0, f64::max))
    }

    #[test]
    fn drones_that_swap_positions_arrive_and_keep_apart() {
        for count in [2, 3, 7, 12] {
            let (nearest, off) = swap(count, 0.3);
            assert!(nearest > 0.3 - 0.005 && off < 0.1, "{count}: nearest {nearest} m, {off} m from the goal");
        }
    }

    proptest! {
        #[test]
        fn filtered_accelerations_are_optimal_and_within_their_bounds(
            numbers in prop::collection::vec(-2.0..2.0f64, 24), wish in prop::collection::vec(-3.0..3.0f64, 12),
            nudges in prop::collection::vec(-0.3..0.3f64, 80),
        ) {
            let filter = CollisionCone::new(0.3);
            let vectors = |x: &[f64]| x.chunks_exact(3).map(|c| Vector3::new(c[0], c[1], c[2])).collect::<Vec<_>>();
            let (positions, velocities, asked) = (vectors(&numbers[..12]), vectors(&numbers[12..]), vectors(&wish));
            let mut given = asked.clone();
            let changed = filter.filter(&positions, &velocities, &mut given).unwrap();
            prop_assert_eq!(changed, given != asked);
            for (given, asked) in given.iter().zip(&asked) {
                prop_assert_eq!(given.z, asked.z);
                prop_assert!(given == asked || given.xy().amax() < filter.max_acceleration + 1e-4);
            }
            // no acceleration near the result has a lower cost, slack included
            let mut conditions = Vec::new();
            for j in 0..4 {
                for i in 0..j {
                    let (p, v) = ((positions[j] - positions[i]).xy(), (velocities[j] - velocities[i]).xy());
                    if p.norm() < filter.sight + v.norm_squared() / (2.0 * filter.max_acceleration) {
                        conditions.extend(filter.conditions((i, j), p, v));
                    }
                }
            }
            let cost = |given: &[Vector3<f64>]| {
                let missing = conditions.iter().map(|condition| {
                    let (i, j) = condition.pair;
                    (condition.min - condition.gradient.dot(&(given[j] - given[i]).xy())).max(0.0)
                });
                let moved: f64 = given.iter().zip(&asked).map(|(a, b)| (a - b).norm_squared()).sum();
                0.5 * moved + 0.5e4 * missing.map(|slack| slack * slack).sum::<f64>()
            };
            let max = filter.max_acceleration;
            for step in nudges.chunks_exact(8) {
                let mut other = given.clone();
                for (drone, nudge) in other.iter_mut().zip(step.chunks_exact(2)) {
                    drone.x = (drone.x + nudge[0]).clamp(-max, max);
                    drone.y = (drone.y + nudge[1]).clamp(-max, max);
                }
                let (best, cost) = (cost(&given), cost(&other));
                prop_assert!(best <= cost * (1.0 + 1e-5) + 1e-3, "{best} {cost}");
            }
        }
    }

    /// The interior-point method does not converge on this one.
    #[test]
    fn a_solution_that_the_solver_leaves_inexact_is_refined() {
        let vectors = |x: &[f64]| x.chunks_exact(3).map(|c| Vector3::new(c[0], c[1], c[2])).collect::<Vec<_>>();
        let positions = vectors(&[
            -1.077289477274988,
            -0.03709290475217883,
            0.0,
            0.0,
            0.0,
            0.0,
            -0.9905029373186024,
            1.0965631243441483,
            0.0,
            -1.3217842351159725,
            0.319828245608526,
            0.0,
        ]);
        let velocities = vectors(&[
            -1.8871676181478694,
            0.8681517075281182,
            0.0,
            1.3712542495390063,
            0.0,
            0.0,
            -0.7111411939940067,
            1.2632674024471913,
            0.0,
            -0.20282542773011403,
            -1.9137253581806986,
            0.0,
        ]);
        let filter = CollisionCone::new(0.3);
        let mut given = vec![Vector3::zeros(); 4];
        assert!(filter.filter(&positions, &velocities, &mut given).unwrap());
        // the gradient of the cost is zero, or points out of the bounds
        let mut gradient = given.clone();
        for j in 0..4 {
            for i in 0..j {
                let (p, v) = ((positions[j] - positions[i]).xy(), (velocities[j] - velocities[i]).xy());
                for condition in filter.conditions((i, j), p, v) {
                    let slack = (condition.min - condition.gradient.dot(&(given[j] - given[i]).xy())).max(0.0);
                    let push = condition.gradient * (CollisionCone::PENALTY * slack);
                    gradient[j] -= Vector3::new(push.x, push.y, 0.0);
                    gradient[i] += Vector3::new(push.x, push.y, 0.0);
                }
            }
        }
        for (u, gradient) in given.iter().zip(&gradient) {
            for axis in 0..2 {
                let at_bound = u[axis].abs() > filter.max_acceleration - 1e-9 && gradient[axis] * u[axis] < 0.0;
                assert!(at_bound || gradient[axis].abs() < 1e-3, "{u} {gradient}");
            }
        }
    }

    #[test]
    fn distant_drones_are_unchanged_and_large_accelerations_are_limited() {
        let positions = [Vector3::zeros(), Vector3::new(0.5, 0.01, 0.0), Vector3::new(1000.0, 0.0, 0.0)];
        let velocities = [Vector3::x(), -Vector3::x(), Vector3::zeros()];
        let mut wishes = [Vector3::zeros(), Vector3::zeros(), Vector3::new(10.0, 0.0, 0.0)];
        assert!(CollisionCone::new(0.3).filter(&positions, &velocities, &mut wishes).unwrap());
        assert_eq!(wishes[2].x, 10.0);
        let (still, two) = ([Vector3::zeros(); 2], [Vector3::zeros(), Vector3::new(2.0, 0.0, 0.0)]);
        let mut wild = [Vector3::new(40.0, 0.0, 0.0), Vector3::new(-40.0, 0.0, 0.0)];
        assert!(CollisionCone::new(0.3).filter(&two, &still, &mut wild).unwrap());
        assert!(wild[0].x < 10.0 && wild[1].x > -10.0, "{wild:?}");
    }

    #[test]
    fn invalid_options_and_inputs_are_rejected() {
        let mut none = [Vector3::zeros(); 2];
        let here = [Vector3::zeros(); 2];
        assert!(CollisionCone::new(-1.0).filter(&here, &here, &mut none).is_err());
        assert!(CollisionCone::new(0.3).filter(&here[..1], &here, &mut none).is_err());
        let mut nan = [Vector3::repeat(f64::NAN); 2];
        assert!(CollisionCone::new(0.3).filter(&here, &here, &mut nan).is_err());
        // drones at the same position separate
        CollisionCone::new(0.3).filter(&here, &here, &mut none).unwrap();
        assert!((none[1] - none[0]).norm() > 1.0);
    }
}
