//! Forces on a drone: pure functions of parameters, state and rotor speeds. Nothing here knows MuJoCo or tasks.

pub mod actuators;
pub mod downwash;
pub mod drag;
pub mod ground_effect;
pub mod rotor;
pub mod wind;

use std::fmt;
use std::str::FromStr;

use nalgebra::Vector3;
use serde::{Deserialize, Serialize};

/// Force and torque on one drone's centre of mass.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Wrench {
    /// Force, world frame, N.
    pub force_world: Vector3<f64>,
    /// Torque, world frame, N·m.
    pub torque_world: Vector3<f64>,
}

impl Wrench {
    /// No force, no torque.
    pub const ZERO: Self = Self { force_world: Vector3::new(0.0, 0.0, 0.0), torque_world: Vector3::new(0.0, 0.0, 0.0) };
}

impl std::ops::Add for Wrench {
    type Output = Self;

    fn add(self, other: Self) -> Self {
        Self { force_world: self.force_world + other.force_world, torque_world: self.torque_world + other.torque_world }
    }
}

/// Which aerodynamic effects act beside the rotors' thrust and torque.
///
/// ```
/// use aviary::drone::DroneModel;
/// use aviary::physics::Effects;
/// use aviary::simulation::Simulation;
///
/// // a subset that no mode of the paper has
/// let effects = Effects { drag: true, downwash: true, ..Effects::NONE };
/// let simulation = Simulation::builder(DroneModel::Cf2x).effects(effects).build()?;
/// assert_eq!(simulation.effects(), effects);
/// # Ok::<(), aviary::simulation::SimulationError>(())
/// ```
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Effects {
    /// [Ground effect](ground_effect).
    #[serde(default)]
    pub ground: bool,
    /// [Blade drag](drag).
    #[serde(default)]
    pub drag: bool,
    /// [Downwash](downwash) of drones above.
    #[serde(default)]
    pub downwash: bool,
}

impl Effects {
    /// None of them.
    pub const NONE: Self = Self { ground: false, drag: false, downwash: false };
    /// All of them.
    pub const ALL: Self = Self { ground: true, drag: true, downwash: true };
}

/// The paper's physics modes (its table 1): who integrates, under which effects.
///
/// ```
/// use aviary::drone::DroneModel;
/// use aviary::physics::Physics;
/// use aviary::simulation::{Simulation, SimulationError};
///
/// // half a second at hover speed, 10 cm above the floor
/// let climb = |physics| -> Result<f64, SimulationError> {
///     let mut simulation = Simulation::builder(DroneModel::Cf2x).physics(physics).build()?;
///     for _ in 0..24 {
///         simulation.step(&[[DroneModel::Cf2x.params().hover_rpm(); 4]])?;
///     }
///     Ok(simulation.states()[0].velocity.z)
/// };
/// assert!(climb(Physics::Mjc)?.abs() < 1e-6 && climb("mjc_gnd".parse().unwrap())? > 0.01);
/// # Ok::<(), SimulationError>(())
/// ```
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Physics {
    /// MuJoCo.
    #[default]
    Mjc,
    /// MuJoCo with ground effect.
    MjcGnd,
    /// MuJoCo with blade drag.
    MjcDrag,
    /// MuJoCo with downwash.
    MjcDw,
    /// MuJoCo with all three.
    MjcGndDragDw,
    /// Explicit integration without effects, medium or contacts.
    Dyn,
}

impl Physics {
    /// All of them.
    pub const ALL: [Self; 6] = [Self::Mjc, Self::MjcGnd, Self::MjcDrag, Self::MjcDw, Self::MjcGndDragDw, Self::Dyn];

    /// The name in lower snake case.
    pub fn name(self) -> &'static str {
        match self {
            Self::Mjc => "mjc",
            Self::MjcGnd => "mjc_gnd",
            Self::MjcDrag => "mjc_drag",
            Self::MjcDw => "mjc_dw",
            Self::MjcGndDragDw => "mjc_gnd_drag_dw",
            Self::Dyn => "dyn",
        }
    }

    /// The effects that it switches on.
    pub fn effects(self) -> Effects {
        match self {
            Self::Mjc | Self::Dyn => Effects::NONE,
            Self::MjcGnd => Effects { ground: true, ..Effects::NONE },
            Self::MjcDrag => Effects { drag: true, ..Effects::NONE },
            Self::MjcDw => Effects { downwash: true, ..Effects::NONE },
            Self::MjcGndDragDw => Effects::ALL,
        }
    }
}

impl fmt::Display for Physics {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}

/// A name that is no physics mode's.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("no physics mode `{name}`, expected mjc, mjc_gnd, mjc_drag, mjc_dw, mjc_gnd_drag_dw or dyn{near}", name = .0, near = crate::did_you_mean(.0, &Physics::ALL.map(Physics::name)))]
pub struct UnknownPhysics(pub String);

impl FromStr for Physics {
    type Err = UnknownPhysics;

    fn from_str(name: &str) -> Result<Self, UnknownPhysics> {
        Self::ALL.into_iter().find(|mode| mode.name() == name).ok_or_else(|| UnknownPhysics(name.to_string()))
    }
}
