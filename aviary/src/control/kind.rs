use nalgebra::Vector3;

use super::{
    ControlMemory, ControlOutput, Controller, DslPidControl, GeometricControl, Goal, LaneController, PidControl,
    PidGains, Reference, Target,
};
use crate::drone::DroneParams;
use crate::math::{Real, ToFlight as _, ToNalgebra as _};
use crate::names::named_enum;
use crate::state::{DroneState, FlightState};

named_enum! {
    "controller"
    /// The built-in controllers that track a [`Reference`](super::Reference).
    ///
    /// ```
    /// use aviary::control::{Controller as _, ControllerKind, Reference};
    /// use aviary::drone::DroneModel;
    /// use aviary::state::DroneState;
    ///
    /// let kind: ControllerKind = "dsl".parse()?;
    /// let params = DroneModel::Race.params();
    /// // no error, so the motors turn at hover speed
    /// let output = kind.build(&params).control(0.02, &DroneState::default(), &Reference::default());
    /// assert!((output.rpm[0] - params.hover_rpm()).abs() < 1e-6);
    /// # Ok::<(), aviary::UnknownName>(())
    /// ```
    #[derive(Default)]
    pub enum ControllerKind {
        /// The paper's cascaded PID: [`PidControl`].
        #[default]
        Pid = "pid",
        /// The cascade with stiffer gains and a rate-limited setpoint: [`DslPidControl`].
        Dsl = "dsl",
        /// Geometric tracking control on SE(3): [`GeometricControl`].
        Geometric = "geometric",
    }
}

impl ControllerKind {
    /// Creates a controller of this kind for an airframe.
    pub fn build(self, params: &DroneParams) -> AnyController {
        match self {
            Self::Pid => AnyController::Pid(PidControl::new(params)),
            Self::Dsl => AnyController::Dsl(DslPidControl::new(params)),
            Self::Geometric => AnyController::Geometric(GeometricControl::new(params)),
        }
    }
}

/// Integral terms of a controller.
#[derive(Debug, Clone, Copy, PartialEq, Default, serde::Serialize, serde::Deserialize)]
pub struct Integrals {
    /// Integral of the position errors, world frame: m·s, or the acceleration that it causes (m/s²) in a
    /// [`GeometricControl`].
    #[serde(with = "crate::serial::vector")]
    pub position: Vector3<f64>,
    /// Integral of the attitude errors, body frame, rad·s; zero in a [`GeometricControl`].
    #[serde(with = "crate::serial::vector")]
    pub attitude: Vector3<f64>,
}

/// A built-in controller of a kind that is chosen at run time.
///
/// ```
/// use aviary::control::{AnyController, ControllerKind, GeometricControl};
/// use aviary::drone::DroneModel;
///
/// // one type, so that a list can mix kinds
/// let params = DroneModel::Cf2x.params();
/// let all: Vec<AnyController> = ControllerKind::ALL.iter().map(|kind| kind.build(&params)).collect();
/// assert_eq!(all[2], AnyController::Geometric(GeometricControl::new(&params)));
/// ```
#[derive(Debug, Clone, PartialEq, serde::Serialize, serde::Deserialize)]
pub enum AnyController {
    /// A [`PidControl`].
    Pid(PidControl),
    /// A [`DslPidControl`].
    Dsl(DslPidControl),
    /// A [`GeometricControl`].
    Geometric(GeometricControl),
}

impl AnyController {
    /// Returns the gains of a cascade; `None` for a [`GeometricControl`], which has
    /// [`Bandwidths`](super::Bandwidths).
    pub fn gains(&self) -> Option<PidGains> {
        match self {
            Self::Pid(control) => Some(control.gains()),
            Self::Dsl(control) => Some(control.current_gains()),
            Self::Geometric(_) => None,
        }
    }

    /// Replaces the gains of a cascade. The integrals stay the same. Returns false for a [`GeometricControl`].
    ///
    /// ```
    /// use aviary::control::{ControllerKind, Integrals};
    /// use aviary::drone::DroneModel;
    /// use nalgebra::Vector3;
    ///
    /// let mut control = ControllerKind::Dsl.build(&DroneModel::Cf2x.params());
    /// let integrals = Integrals { position: Vector3::new(0.1, 0.0, -0.2), ..Integrals::default() };
    /// control.set_integrals(&integrals);
    /// let mut gains = control.gains().unwrap();
    /// gains.position.integral.z = 5.0;
    /// assert!(control.set_gains(gains));
    /// assert_eq!((control.gains(), control.integrals()), (Some(gains), integrals));
    /// ```
    pub fn set_gains(&mut self, gains: PidGains) -> bool {
        match self {
            Self::Pid(control) => control.set_gains(gains),
            Self::Dsl(control) => control.set_gains(gains),
            Self::Geometric(_) => return false,
        }
        true
    }

    /// Returns the integrals.
    pub fn integrals(&self) -> Integrals {
        let ControlMemory { position_integral, attitude_integral, .. } = self.memory();
        Integrals { position: position_integral.to_nalgebra(), attitude: attitude_integral.to_nalgebra() }
    }

    /// Replaces the integrals, for example to start with the trim of an earlier flight. The next control step clamps
    /// them. A [`GeometricControl`] has no integral of the attitude.
    pub fn set_integrals(&mut self, integrals: &Integrals) {
        let mut memory = self.memory();
        memory.position_integral = integrals.position.to_flight();
        memory.attitude_integral = integrals.attitude.to_flight();
        self.set_memory(&memory);
    }

    fn get(&mut self) -> &mut dyn Controller {
        match self {
            Self::Pid(control) => control,
            Self::Dsl(control) => control,
            Self::Geometric(control) => control,
        }
    }
}

impl Controller for AnyController {
    fn reset(&mut self) {
        self.get().reset();
    }

    fn control(&mut self, dt: f64, state: &DroneState, reference: &Reference) -> ControlOutput {
        self.get().control(dt, state, reference)
    }

    fn control_velocity(&mut self, dt: f64, state: &DroneState, reference: &Reference) -> ControlOutput {
        self.get().control_velocity(dt, state, reference)
    }

    fn internal_state(&self) -> Vec<f64> {
        match self {
            Self::Pid(control) => control.internal_state(),
            Self::Dsl(control) => control.internal_state(),
            Self::Geometric(control) => control.internal_state(),
        }
    }

    fn set_internal_state(&mut self, state: &[f64]) -> bool {
        self.get().set_internal_state(state)
    }
}

impl LaneController for AnyController {
    fn memory(&self) -> ControlMemory<f64> {
        match self {
            Self::Pid(control) => control.memory(),
            Self::Dsl(control) => control.memory(),
            Self::Geometric(control) => control.memory(),
        }
    }

    fn set_memory(&mut self, memory: &ControlMemory<f64>) {
        match self {
            Self::Pid(control) => control.set_memory(memory),
            Self::Dsl(control) => control.set_memory(memory),
            Self::Geometric(control) => control.set_memory(memory),
        }
    }

    #[inline(always)]
    fn track<R: Real>(
        &self,
        dt: f64,
        memory: &mut ControlMemory<R>,
        state: &FlightState<R>,
        target: &Target<R>,
        goal: Goal,
    ) -> [R; 4] {
        match self {
            Self::Pid(control) => control.track(dt, memory, state, target, goal),
            Self::Dsl(control) => control.track(dt, memory, state, target, goal),
            Self::Geometric(control) => control.track(dt, memory, state, target, goal),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::drone::DroneModel;

    /// A controller with the gains and the integrals of another one computes its motor speeds.
    #[test]
    fn gains_and_integrals_carry_over_between_controllers() {
        let params = DroneModel::Race.params();
        let state = DroneState::at_rest(Vector3::new(0.1, -0.2, 1.0), Vector3::new(0.1, 0.2, 2.0));
        let reference = Reference::hover(Vector3::new(0.15, -0.15, 1.1), 2.5);
        for kind in ControllerKind::ALL {
            let mut first = kind.build(&params);
            if let Some(mut gains) = first.gains() {
                gains.position.integral *= 3.0;
                gains.attitude.integral = gains.attitude.proportional;
                assert!(first.set_gains(gains), "{kind}");
            }
            for _ in 0..20 {
                first.control(0.02, &state, &reference);
            }
            let mut second = kind.build(&params);
            second.control(0.02, &state, &reference);
            if let Some(gains) = first.gains() {
                second.set_gains(gains);
                for _ in 1..20 {
                    second.control(0.02, &state, &reference);
                }
                second.set_integrals(&Integrals::default());
                let [with, without] =
                    [&first, &second].map(|control| control.clone().control(0.02, &state, &reference));
                assert_ne!(with, without, "{kind}");
            }
            second.set_integrals(&first.integrals());
            assert_eq!(second.integrals(), first.integrals(), "{kind}");
            assert_eq!(second.control(0.02, &state, &reference), first.control(0.02, &state, &reference), "{kind}");
        }
    }

    #[test]
    fn integrals_out_of_range_are_clamped_by_the_next_step() {
        let mut control = ControllerKind::Pid.build(&DroneModel::Cf2x.params());
        control.set_integrals(&Integrals { position: Vector3::new(9.0, 0.0, -9.0), attitude: Vector3::repeat(7.0) });
        control.control(0.02, &DroneState::default(), &Reference::default());
        assert_eq!(control.integrals().position, Vector3::new(2.0, 0.0, -2.0));
        assert_eq!(control.integrals().attitude, Vector3::repeat(0.5));
    }
}
