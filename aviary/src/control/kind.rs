use super::{
    ControlMemory, ControlOutput, Controller, DslPidControl, GeometricControl, Goal, LaneController, PidControl,
    Reference, Target,
};
use crate::drone::DroneParams;
use crate::math::Real;
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
