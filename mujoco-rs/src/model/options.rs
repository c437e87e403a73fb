use super::Model;

/// Options that determine the forces of contacts; MuJoCo's `mjOption`, and the mean inertia of `mjStatistic`.
#[derive(Debug, Clone, Copy, PartialEq)]
#[non_exhaustive]
pub struct ConstraintOptions {
    /// True for the Newton solver.
    pub newton: bool,
    /// True for pyramidal friction cones, false for elliptic ones.
    pub pyramidal: bool,
    /// Largest number of iterations of the solver.
    pub iterations: u32,
    /// Largest number of iterations of the solver that prevents slip.
    pub noslip_iterations: u32,
    /// Scaled improvement and gradient at which the solver stops.
    pub tolerance: f64,
    /// Ratio of the impedances of friction and normal forces.
    pub impratio: f64,
    /// Bits of `mjtDisableBit`.
    pub disabled: i32,
    /// Bits of `mjtEnableBit`.
    pub enabled: i32,
    /// Pairs of geoms that can collide; a number of `mjtCollision`.
    pub collision: i32,
    /// Mean of the diagonal of the mass matrix in the initial configuration, which scales the solver's tolerance.
    pub mean_inertia: f64,
}

impl Model {
    /// Returns the options that determine the forces of contacts.
    ///
    /// ```
    /// let model = mujoco_rs::Model::from_xml("<mujoco><option tolerance='1e-10' cone='elliptic'/></mujoco>")?;
    /// let options = model.constraint_options();
    /// assert_eq!((options.newton, options.pyramidal, options.tolerance), (true, false, 1e-10));
    /// # Ok::<(), mujoco_rs::Error>(())
    /// ```
    pub fn constraint_options(&self) -> ConstraintOptions {
        let raw = self.raw();
        let option = &raw.opt;
        let count = |number: i32| u32::try_from(number).unwrap_or(0);
        ConstraintOptions {
            newton: option.solver == mujoco_sys::mjtSolver_::mjSOL_NEWTON as i32,
            pyramidal: option.cone == mujoco_sys::mjtCone_::mjCONE_PYRAMIDAL as i32,
            iterations: count(option.iterations),
            noslip_iterations: count(option.noslip_iterations),
            tolerance: option.tolerance,
            impratio: option.impratio,
            disabled: option.disableflags,
            enabled: option.enableflags,
            collision: option.collision,
            mean_inertia: raw.stat.meaninertia,
        }
    }
}
