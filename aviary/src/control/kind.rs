use std::fmt;
use std::str::FromStr;

use super::{ControlOutput, Controller, DslPidControl, GeometricControl, PidControl, Reference};
use crate::drone::DroneParams;
use crate::state::DroneState;

/// The controllers that follow a [`Reference`](super::Reference), by name.
///
/// ```
/// use aviary::control::{Controller as _, ControllerKind, Reference};
/// use aviary::drone::DroneModel;
/// use aviary::state::DroneState;
///
/// let kind: ControllerKind = "dsl".parse()?;
/// let params = DroneModel::Race.params();
/// // at rest where it should be: hover speed
/// let output = kind.build(&params).control(0.02, &DroneState::default(), &Reference::default());
/// assert!((output.rpm[0] - params.hover_rpm()).abs() < 1e-6);
/// # Ok::<(), aviary::control::UnknownController>(())
/// ```
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default)]
pub enum ControllerKind {
    /// [`PidControl`].
    #[default]
    Pid,
    /// [`DslPidControl`].
    Dsl,
    /// [`GeometricControl`].
    Geometric,
}

impl ControllerKind {
    /// All of them.
    pub const ALL: [Self; 3] = [Self::Pid, Self::Dsl, Self::Geometric];

    /// The name in lower snake case.
    pub fn name(self) -> &'static str {
        match self {
            Self::Pid => "pid",
            Self::Dsl => "dsl",
            Self::Geometric => "geometric",
        }
    }

    /// A controller of this kind for an airframe.
    pub fn build(self, params: &DroneParams) -> AnyController {
        match self {
            Self::Pid => AnyController::Pid(PidControl::new(params)),
            Self::Dsl => AnyController::Dsl(DslPidControl::new(params)),
            Self::Geometric => AnyController::Geometric(GeometricControl::new(params)),
        }
    }
}

/// A controller whose kind was chosen at run time.
///
/// ```
/// use aviary::control::{AnyController, ControllerKind, GeometricControl};
/// use aviary::drone::DroneModel;
///
/// // one type for all, so that they fit into one list
/// let params = DroneModel::Cf2x.params();
/// let all: Vec<AnyController> = ControllerKind::ALL.iter().map(|kind| kind.build(&params)).collect();
/// assert_eq!(all[2], AnyController::Geometric(GeometricControl::new(&params)));
/// ```
#[derive(Debug, Clone, PartialEq)]
pub enum AnyController {
    /// [`PidControl`].
    Pid(PidControl),
    /// [`DslPidControl`].
    Dsl(DslPidControl),
    /// [`GeometricControl`].
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

impl fmt::Display for ControllerKind {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}

/// A name that is no controller's.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("no controller `{name}`, expected pid, dsl or geometric{near}", name = .0, near = crate::did_you_mean(.0, &ControllerKind::ALL.map(ControllerKind::name)))]
pub struct UnknownController(pub String);

impl FromStr for ControllerKind {
    type Err = UnknownController;

    fn from_str(name: &str) -> Result<Self, UnknownController> {
        Self::ALL.into_iter().find(|kind| kind.name() == name).ok_or_else(|| UnknownController(name.to_string()))
    }
}
