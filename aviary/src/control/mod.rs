//! Controllers: map a drone state and a reference to motor speeds.
//!
//! "The paper" is *MuJoCo-Drones-Gym* (Tayal). A controller depends on the parameters of an airframe and not on an
//! environment.
//!
//! | controller | use |
//! | --- | --- |
//! | [`PidControl`] | the paper's cascade and gains: hover and slow references |
//! | [`DslPidControl`] | the cascade with stiffer gains, rate limits and feed-forward: waypoints |
//! | [`GeometricControl`] | SE(3) control with full feed-forward: aggressive trajectories, flips |
//! | [`AttitudeControl`], [`RateControl`] | inner loops: attitude or body rates at a given thrust |
//!
//! [`CollisionCone`] keeps drones apart. [`trajectory`] contains moving references with exact derivatives.

mod attitude;
mod dsl;
mod geometric;
mod kind;
mod memory;
mod mixer;
mod pid;
mod rate;
mod reference;
mod safety;
pub mod trajectory;

pub use attitude::{AttitudeControl, AttitudeGains, HeadingHold};
pub use dsl::DslPidControl;
pub use geometric::{Bandwidths, GeometricControl};
pub use kind::{AnyController, ControllerKind, Integrals};
pub use memory::ControlMemory;
pub use mixer::Mixer;
pub use pid::{PidControl, PidGains, PositionGains};
pub use rate::RateControl;
pub use reference::Reference;
pub use safety::{CollisionCone, SafetyError};

pub(crate) use reference::{Goal, Target};

use nalgebra::Vector3;

use crate::math::Real;
use crate::state::{DroneState, FlightState, wrap_angle};

/// Output of a controller for one control step.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ControlOutput {
    /// Motor speeds, rpm, within [0, `MAX_RPM`].
    pub rpm: [f64; 4],
    /// Position error: reference minus actual, world frame, m.
    pub position_error: Vector3<f64>,
    /// Yaw error: reference minus actual, rad, in (−π, π].
    pub yaw_error: f64,
}

impl ControlOutput {
    /// Returns the tracking errors with NaN motor speeds.
    fn of_errors(state: &DroneState, reference: &Reference) -> Self {
        Self {
            rpm: [f64::NAN; 4],
            position_error: reference.position - state.position,
            yaw_error: wrap_angle(reference.yaw - state.yaw()),
        }
    }
}

/// A controller of one drone.
///
/// Controllers have internal state such as integrals: use one instance per drone, and call [`reset`](Self::reset)
/// between episodes.
///
/// ```
/// use aviary::control::{Controller, GeometricControl, Reference};
/// use aviary::drone::DroneModel;
/// use aviary::simulation::Simulation;
/// use nalgebra::Vector3;
///
/// let mut simulation = Simulation::builder(DroneModel::Cf2x).build()?;
/// let mut controller = GeometricControl::new(simulation.params(0));
/// let target = Reference::hover(Vector3::new(0.0, 0.0, 1.0), 0.0);
/// while simulation.time() < 4.0 {
///     let output = controller.control(simulation.control_period(), &simulation.states()[0], &target);
///     simulation.step(&[output.rpm])?;
/// }
/// assert!(simulation.distance(0, &target.position) < 0.01);
/// # Ok::<(), aviary::simulation::SimulationError>(())
/// ```
pub trait Controller: std::fmt::Debug + Send {
    /// Clears the internal state.
    fn reset(&mut self);

    /// Returns the motor speeds for the next control step of `dt` seconds.
    ///
    /// A non-finite state or reference returns NaN speeds, which a simulation rejects, and leaves the internal state
    /// unchanged.
    fn control(&mut self, dt: f64, state: &DroneState, reference: &Reference) -> ControlOutput;

    /// Returns the motor speeds that track the velocity of the reference and ignore its position.
    fn control_velocity(&mut self, dt: f64, state: &DroneState, reference: &Reference) -> ControlOutput {
        self.control(dt, state, &Reference { position: state.position, ..*reference })
    }

    /// Returns the numbers of the internal state, without gains and other settings, for a copy that
    /// [`set_internal_state`](Self::set_internal_state) restores. A controller without internal state returns none,
    /// which is the default. Your own controller with internal state overrides both functions. Otherwise a flight from
    /// a snapshot differs from the flight after the snapshot.
    ///
    /// ```
    /// use aviary::control::{Controller, ControllerKind, Reference};
    /// use aviary::drone::DroneModel;
    /// use aviary::state::DroneState;
    /// use nalgebra::Vector3;
    ///
    /// let mut control = ControllerKind::Dsl.build(&DroneModel::Cf2x.params());
    /// let (state, target) = (DroneState::default(), Reference::hover(Vector3::new(0.1, 0.2, 0.3), 0.5));
    /// control.control(0.02, &state, &target);
    /// let before = control.internal_state();
    /// let speeds = control.control(0.02, &state, &target).rpm;
    /// assert!(control.set_internal_state(&before));
    /// assert_eq!(control.control(0.02, &state, &target).rpm, speeds);
    /// ```
    fn internal_state(&self) -> Vec<f64> {
        Vec::new()
    }

    /// Restores an internal state that [`internal_state`](Self::internal_state) of a controller of the same kind has
    /// returned. Returns false, and keeps the present state, for a list of another length.
    fn set_internal_state(&mut self, state: &[f64]) -> bool {
        state.is_empty()
    }
}

/// Controller whose formulas are generic over a double and a SIMD register. The motor speeds in a lane are
/// bit-identical to those of the controller of a single drone.
pub(crate) trait LaneController {
    /// Returns the internal state; the parts that the controller does not use have their default values.
    fn memory(&self) -> ControlMemory<f64>;

    /// Sets the internal state.
    fn set_memory(&mut self, memory: &ControlMemory<f64>);

    /// Returns the motor speeds (rpm) for the next control step of `dt` seconds, from finite states and targets.
    fn track<R: Real>(
        &self,
        dt: f64,
        memory: &mut ControlMemory<R>,
        state: &FlightState<R>,
        target: &Target<R>,
        goal: Goal,
    ) -> [R; 4];
}

/// Runs a controller on one drone.
fn run(
    controller: &mut impl LaneController,
    dt: f64,
    state: &DroneState,
    reference: &Reference,
    goal: Goal,
) -> ControlOutput {
    let here = Reference { position: state.position, ..*reference };
    let reference = if goal == Goal::Velocity { &here } else { reference };
    let errors = ControlOutput::of_errors(state, reference);
    if !(state.is_finite() && reference.is_finite() && dt > 0.0 && dt.is_finite()) {
        // a NaN in an integral would stay there until the next reset
        return errors;
    }
    let mut memory = controller.memory();
    let rpm = controller.track(dt, &mut memory, &FlightState::from(state), &Target::from(reference), goal);
    controller.set_memory(&memory);
    ControlOutput { rpm, ..errors }
}
