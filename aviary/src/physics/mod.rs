//! Forces on a drone: pure functions of parameters, state and rotor speeds. Nothing here knows MuJoCo or tasks.

pub mod actuators;
pub mod downwash;
pub mod drag;
pub mod ground_effect;
pub mod rotor;
pub mod wind;

use nalgebra::Vector3;
use serde::{Deserialize, Serialize};

use crate::names::named_enum;

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

named_enum! {
    "physics mode"
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
    #[derive(Default)]
    pub enum Physics {
        /// MuJoCo.
        #[default]
        Mjc = "mjc",
        /// MuJoCo with ground effect.
        MjcGnd = "mjc_gnd",
        /// MuJoCo with blade drag.
        MjcDrag = "mjc_drag",
        /// MuJoCo with downwash.
        MjcDw = "mjc_dw",
        /// MuJoCo with all three.
        MjcGndDragDw = "mjc_gnd_drag_dw",
        /// Explicit integration without effects, medium or contacts.
        Dyn = "dyn",
    }
}

impl Physics {
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
