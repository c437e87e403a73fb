//! Forces on a drone: pure functions of parameters, state and rotor speeds, independent of MuJoCo and of tasks.

pub mod actuators;
pub mod airframe;
pub mod battery;
pub mod downwash;
pub mod drag;
pub mod ground_effect;
pub mod rotor;
pub mod wind;

use nalgebra::Vector3;
use serde::{Deserialize, Serialize};

use crate::names::{UnknownName, named_enum};

/// Force and torque on the centre of mass of a drone.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Wrench {
    /// Force, world frame, N.
    pub force_world: Vector3<f64>,
    /// Torque, world frame, N·m.
    pub torque_world: Vector3<f64>,
}

impl Wrench {
    /// Zero force and torque.
    pub const ZERO: Self = Self { force_world: Vector3::new(0.0, 0.0, 0.0), torque_world: Vector3::new(0.0, 0.0, 0.0) };
}

impl std::ops::Add for Wrench {
    type Output = Self;

    fn add(self, other: Self) -> Self {
        Self { force_world: self.force_world + other.force_world, torque_world: self.torque_world + other.torque_world }
    }
}

/// Aerodynamic effects that act in addition to the rotors' thrust and torque.
///
/// The text form lists the enabled effects, for example `ground,drag`, or is `none`.
///
/// ```
/// use aviary::drone::DroneModel;
/// use aviary::physics::Effects;
/// use aviary::simulation::Simulation;
///
/// // a combination without a physics mode in the paper
/// let effects = Effects { drag: true, downwash: true, ..Effects::NONE };
/// let simulation = Simulation::builder(DroneModel::Cf2x).effects(effects).build()?;
/// assert_eq!((simulation.effects(), simulation.physics()), (effects, None));
/// assert_eq!("drag,downwash".parse(), Ok(effects));
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
    /// [Downwash](downwash) from drones above.
    #[serde(default)]
    pub downwash: bool,
}

impl Effects {
    /// No effect.
    pub const NONE: Self = Self { ground: false, drag: false, downwash: false };
    /// All effects.
    pub const ALL: Self = Self { ground: true, drag: true, downwash: true };
    /// Names of the effects, in the order of the fields.
    pub const NAMES: &'static [&'static str] = &["ground", "drag", "downwash"];

    fn switches(self) -> [bool; 3] {
        [self.ground, self.drag, self.downwash]
    }
}

impl std::fmt::Display for Effects {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let names = Self::NAMES.iter().copied().zip(self.switches());
        let names: Vec<_> = names.filter_map(|(name, on)| on.then_some(name)).collect();
        f.pad(&if names.is_empty() { "none".into() } else { names.join(",") })
    }
}

impl std::str::FromStr for Effects {
    type Err = UnknownName;

    fn from_str(text: &str) -> Result<Self, UnknownName> {
        let mut effects = Self::NONE;
        if text == "none" {
            return Ok(effects);
        }
        for name in text.split(',') {
            match name.trim() {
                "ground" => effects.ground = true,
                "drag" => effects.drag = true,
                "downwash" => effects.downwash = true,
                name => {
                    // `none` cannot be combined with other names
                    let names: &[&str] =
                        if text.contains(',') { Self::NAMES } else { &["none", "ground", "drag", "downwash"] };
                    return Err(UnknownName { noun: "aerodynamic effect", name: name.into(), names });
                }
            }
        }
        Ok(effects)
    }
}

named_enum! {
    "physics mode"
    /// Physics modes of *MuJoCo-Drones-Gym* (Tayal), table 1.
    ///
    /// Each mode is a shorthand for an engine and a set of aerodynamic [`Effects`]. MuJoCo integrates the modes
    /// `mjc…`, alone or within the hybrid engine. The explicit engine integrates the mode `dyn`. The options
    /// `effects` and `engine` set other combinations. A mode together with effects or an engine that contradict it is
    /// an error.
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
        /// MuJoCo with ground effect, blade drag and downwash.
        MjcGndDragDw = "mjc_gnd_drag_dw",
        /// Explicit engine (semi-implicit Euler) without aerodynamic effects, medium or contacts.
        Dyn = "dyn",
    }
}

impl Physics {
    /// Returns the mode with these effects under the explicit engine or under MuJoCo, or `None` if the paper has no
    /// such mode.
    pub fn of(effects: Effects, explicit: bool) -> Option<Self> {
        Self::ALL.into_iter().find(|mode| (mode.effects(), mode.is_explicit()) == (effects, explicit))
    }

    /// Returns true if the explicit engine integrates the mode, and false if MuJoCo does.
    pub fn is_explicit(self) -> bool {
        self == Self::Dyn
    }

    /// Returns the aerodynamic effects of the mode.
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
