//! Airframe parameters: four built-in models, custom airframes from TOML, and derived constants.
//!
//! "The paper" is *MuJoCo-Drones-Gym* (Tayal).

mod air;
mod battery;
mod motor_law;
mod motors;
mod plausibility;

use std::path::{Path, PathBuf};
use std::sync::OnceLock;

use nalgebra::{Matrix4, Vector3};
use serde::{Deserialize, Serialize};

pub use air::AirParams;
pub use battery::BatteryParams;
pub(crate) use battery::cell_voltage;
pub(crate) use motor_law::MotorLaw;
pub use motors::MotorParams;
pub use plausibility::DerivedNumber;

use crate::SystemError;
use crate::names::named_enum;

/// Gravitational acceleration for all derived constants, m/s².
pub const GRAVITY: f64 = 9.81;

named_enum! {
    "drone model"
    /// The built-in airframes: three of the paper (table 2), and a real drone.
    ///
    /// ```
    /// use aviary::drone::DroneModel;
    ///
    /// let model: DroneModel = "race".parse()?;
    /// let params = model.params();
    /// assert_eq!((model.name(), params.mass), ("race", 0.25));
    /// // a thrust-to-weight ratio of 4 means twice the hover speed
    /// assert!((params.max_rpm() - 2.0 * params.hover_rpm()).abs() < 1e-9);
    /// # Ok::<(), aviary::UnknownName>(())
    /// ```
    pub enum DroneModel {
        /// Bitcraze Crazyflie 2.x, motors on the diagonals.
        Cf2x = "cf2x",
        /// Bitcraze Crazyflie 2.x, motors on the axes.
        Cf2p = "cf2p",
        /// 250 g racing quadcopter, motors on the diagonals.
        Race = "race",
        /// Crazyflie 2.1 [identified](crate::flights::identify) from recorded flights, with [motors](MotorParams) and
        /// [forces of the air](AirParams) that the paper does not have.
        Cf21 = "cf21",
    }
}

impl DroneModel {
    /// The airframes of the paper, which are symmetric and have no airframe effects.
    pub const PAPER: [Self; 3] = [Self::Cf2x, Self::Cf2p, Self::Race];

    /// Returns the parameters of the model, as in `assets/airframes`.
    pub fn params(self) -> DroneParams {
        // a test reads all files, so this never fails for a caller
        let read = |text| DroneParams::from_toml(text).expect("a built-in airframe is valid");
        static CF2X: OnceLock<DroneParams> = OnceLock::new();
        static CF2P: OnceLock<DroneParams> = OnceLock::new();
        static RACE: OnceLock<DroneParams> = OnceLock::new();
        static CF21: OnceLock<DroneParams> = OnceLock::new();
        let params = match self {
            Self::Cf2x => CF2X.get_or_init(|| read(include_str!("../../assets/airframes/cf2x.toml"))),
            Self::Cf2p => CF2P.get_or_init(|| read(include_str!("../../assets/airframes/cf2p.toml"))),
            Self::Race => RACE.get_or_init(|| read(include_str!("../../assets/airframes/race.toml"))),
            Self::Cf21 => CF21.get_or_init(|| read(include_str!("../../assets/airframes/cf21.toml"))),
        };
        params.clone()
    }
}

/// Motor layout, seen from above with x forward and y left.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Layout {
    /// Motors on the diagonals, at ±L/√2 along x and y.
    X,
    /// Motors on the axes, at distance L from the centre.
    Plus,
}

/// Direction of rotation of the propellers, as the sign of the reaction torque about body z.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum YawConvention {
    /// Positive torque (nose to the left) of motors 1 and 3, negative torque of motors 0 and 2.
    Crazyflie,
    /// Positive torque of motors 0 and 2, negative torque of motors 1 and 3.
    Reversed,
}

impl YawConvention {
    /// Returns 1 or −1: the sign of the reaction torque of motors 1 and 3 about body z.
    pub(crate) fn sign(self) -> f64 {
        match self {
            Self::Crazyflie => 1.0,
            Self::Reversed => -1.0,
        }
    }
}

/// Meshes of an airframe in rendered images, scaled to its arm length. The physics does not use them.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Appearance {
    /// Meshes of the Crazyflie.
    #[default]
    Crazyflie,
    /// Meshes of the racing quadcopter.
    Racer,
}

/// Parameters of an airframe, in SI units with rotor speeds in rpm.
///
/// `thrust_coefficient` and `torque_coefficient` are per rpm². The header of the paper's table says (rad/s)², but
/// only values per rpm² give the Crazyflie a hover speed of 14,476 rpm.
///
/// ```
/// use aviary::drone::{DroneModel, DroneParams};
///
/// let cf2x = DroneModel::Cf2x.params();
/// assert!((cf2x.hover_rpm() - 14_475.8).abs() < 0.1);
/// let heavier = DroneParams { mass: 0.033, ..cf2x };
/// assert!(heavier.validate().is_ok());
/// ```
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct DroneParams {
    /// Name of the airframe in logs.
    pub name: String,
    /// Mass m, kg.
    pub mass: f64,
    /// Principal moments of inertia `[Jxx, Jyy, Jzz]` about the centre of mass, body frame, kg·m².
    #[serde(deserialize_with = "crate::error::triple")]
    pub inertia: [f64; 3],
    /// Distance L of each motor from the centre, m.
    pub arm_length: f64,
    /// Motor layout.
    pub layout: Layout,
    /// Direction of rotation of the propellers.
    pub yaw_convention: YawConvention,
    /// Thrust coefficient k_f of one rotor, N/rpm².
    pub thrust_coefficient: f64,
    /// Reaction-torque coefficient k_m of one rotor, N·m/rpm².
    pub torque_coefficient: f64,
    /// Maximum thrust over weight, dimensionless.
    pub thrust_to_weight: f64,
    /// Propeller radius r_p, m.
    pub propeller_radius: f64,
    /// Ground-effect coefficient C_gnd, dimensionless.
    pub ground_effect_coefficient: f64,
    /// Blade-drag coefficients `[c_xy, c_xy, c_z]` along the body axes, N/(m/s)/(rad/s).
    #[serde(deserialize_with = "crate::error::triple")]
    pub drag_coefficients: [f64; 3],
    /// Downwash coefficients `[C1, C2, C3]`, in N, dimensionless, and in m.
    #[serde(deserialize_with = "crate::error::triple")]
    pub downwash_coefficients: [f64; 3],
    /// Radius of the collision cylinder, m.
    pub collision_radius: f64,
    /// Height of the collision cylinder, centred on the body, m.
    pub collision_height: f64,
    /// Scale of velocity commands, m/s. The physics does not limit the speed to it.
    pub max_speed: f64,
    /// Drag area C_d·A for wind, m²; the default is the side area of the collision cylinder with C_d = 1.
    #[serde(default, rename = "drag_area", skip_serializing_if = "Option::is_none")]
    pub drag_area_override: Option<f64>,
    /// Meshes in rendered images.
    #[serde(default)]
    pub appearance: Appearance,
    /// Source of the values, as free text.
    #[serde(default)]
    pub provenance: String,
    /// Position `[x, y]` of the centre of mass relative to the centre of the motors, body frame, m. It shifts the
    /// lever arms of the motors in [`allocation`](Self::allocation), and has no other effect.
    #[serde(default, deserialize_with = "crate::error::pair", skip_serializing_if = "is_centred")]
    pub center_of_mass: [f64; 2],
    /// Motors.
    #[serde(default, skip_serializing_if = "MotorParams::is_default")]
    pub motors: MotorParams,
    /// Forces and torques of the air in addition to blade drag.
    #[serde(default, skip_serializing_if = "AirParams::is_default")]
    pub air: AirParams,
    /// Battery; `None` for the constant voltage [`MotorParams::voltage`].
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub battery: Option<BatteryParams>,
}

fn is_centred(center_of_mass: &[f64; 2]) -> bool {
    *center_of_mass == [0.0; 2]
}

/// Returns an error for the first of several fields whose value is outside its range. An entry has the name, the value,
/// the range and the range as text.
fn check_ranges(ranges: &[(&'static str, f64, f64, f64, &'static str)]) -> Result<(), DroneError> {
    // a range never contains NaN
    match ranges.iter().find(|(_, got, min, max, _)| !(*min..=*max).contains(got)) {
        Some(&(field, got, _, _, expected)) => Err(DroneError::Parameter { field, got, expected }),
        None => Ok(()),
    }
}

impl DroneParams {
    /// Reads and validates an airframe from TOML text.
    ///
    /// # Errors
    /// [`DroneError::Toml`] with line and column, or an error of [`validate`](Self::validate).
    pub fn from_toml(text: &str) -> Result<Self, DroneError> {
        let params: Self = toml::from_str(text)
            .map_err(|error| DroneError::Toml { message: crate::error::toml_message(text, &error) })?;
        params.validate()?;
        Ok(params)
    }

    /// Reads and validates an airframe file.
    ///
    /// # Errors
    /// [`DroneError::File`] with the path, around an error of [`from_toml`](Self::from_toml) or of the system.
    pub fn from_file(path: impl AsRef<Path>) -> Result<Self, DroneError> {
        let path = path.as_ref();
        let in_file = |error| DroneError::File { path: path.into(), error: Box::new(error) };
        let text = std::fs::read_to_string(path).map_err(|error| in_file(SystemError::from(error).into()))?;
        Self::from_toml(&text).map_err(in_file)
    }

    /// Checks that the parameters describe a rigid body that exists and can hover.
    ///
    /// # Errors
    /// [`DroneError::Parameter`], [`DroneError::Range`] or [`DroneError::Name`] for the first invalid field.
    pub fn validate(&self) -> Result<(), DroneError> {
        // values outside these ranges are wrong units, and can overflow in the mixer or in MuJoCo
        let ranges = [
            ("mass", self.mass, 1e-6, 1e6),
            ("inertia[0]", self.inertia[0], 1e-12, 1e9),
            ("inertia[1]", self.inertia[1], 1e-12, 1e9),
            ("inertia[2]", self.inertia[2], 1e-12, 1e9),
            ("arm_length", self.arm_length, 1e-4, 1e3),
            ("thrust_coefficient", self.thrust_coefficient, 1e-18, 1e3),
            ("torque_coefficient", self.torque_coefficient, 1e-18, 1e3),
            ("thrust_to_weight", self.thrust_to_weight, 1.0, 1e3),
            ("propeller_radius", self.propeller_radius, 1e-4, 1e3),
            ("collision_radius", self.collision_radius, 1e-4, 1e3),
            ("collision_height", self.collision_height, 1e-4, 1e3),
            ("max_speed", self.max_speed, 1e-3, 1e4),
        ];
        for (field, got, min, max) in ranges {
            // a range never contains NaN
            if (min..=max).contains(&got) {
                continue;
            }
            return Err(match field {
                "thrust_to_weight" if got < 1.0 => {
                    DroneError::Parameter { field, got, expected: "at least 1, or the drone cannot hover" }
                }
                _ if !(got.is_finite() && got > 0.0) => {
                    DroneError::Parameter { field, got, expected: "a positive number" }
                }
                _ => DroneError::Range { field, got, min, max },
            });
        }
        let [x, y, z] = self.inertia;
        for (field, largest, others) in [("inertia[0]", x, y + z), ("inertia[1]", y, x + z), ("inertia[2]", z, x + y)] {
            if largest > others {
                return Err(DroneError::Parameter {
                    field,
                    got: largest,
                    expected: "at most the sum of the other two moments (no body of positive mass has more)",
                });
            }
        }
        let not_negative = [
            ("ground_effect_coefficient", self.ground_effect_coefficient),
            ("drag_coefficients[0]", self.drag_coefficients[0]),
            ("drag_coefficients[1]", self.drag_coefficients[1]),
            ("drag_coefficients[2]", self.drag_coefficients[2]),
            ("downwash_coefficients[0]", self.downwash_coefficients[0]),
            ("drag_area", self.drag_area()),
        ];
        for (field, got) in not_negative {
            if !(0.0..=1e9).contains(&got) {
                return Err(DroneError::Parameter { field, got, expected: "zero or a positive number up to 1e9" });
            }
        }
        for (field, got) in [
            ("downwash_coefficients[1]", self.downwash_coefficients[1]),
            ("downwash_coefficients[2]", self.downwash_coefficients[2]),
        ] {
            if !got.is_finite() {
                return Err(DroneError::Parameter { field, got, expected: "a finite number" });
            }
        }
        // farther away a motor would have to pull down to balance the weight without a yaw torque
        let [x, y] = self.center_of_mass;
        let room = match self.layout {
            Layout::X => self.arm_length / std::f64::consts::SQRT_2 - x.abs() - y.abs(),
            Layout::Plus => 0.5 * self.arm_length - x.abs().max(y.abs()),
        };
        if !(room > 0.0 && x.is_finite() && y.is_finite()) {
            let is_second = y.abs() > x.abs() || y.is_nan();
            let (field, got) = if is_second { ("center_of_mass[1]", y) } else { ("center_of_mass[0]", x) };
            return Err(DroneError::Parameter { field, got, expected: "a position where all motors carry weight, m" });
        }
        self.motors.validate()?;
        self.battery.as_ref().map_or(Ok(()), BatteryParams::validate)?;
        self.validate_supply()?;
        self.air.validate()?;
        if self.name.is_empty() || !self.name.chars().all(|c| c.is_ascii_alphanumeric() || c == '_' || c == '-') {
            return Err(DroneError::Name { name: self.name.clone() });
        }
        Ok(())
    }

    /// Returns the drag area C_d·A for wind, m².
    pub fn drag_area(&self) -> f64 {
        self.drag_area_override.unwrap_or(2.0 * self.collision_radius * self.collision_height)
    }

    /// Returns the weight m·g, N.
    pub fn weight(&self) -> f64 {
        self.mass * GRAVITY
    }

    /// Returns the rotor speed in hover: √(m·g / 4·k_f), rpm (paper §3.3).
    pub fn hover_rpm(&self) -> f64 {
        (self.weight() / (4.0 * self.thrust_coefficient)).sqrt()
    }

    /// Returns the maximum rotor speed `MAX_RPM`: √(T/W · m·g / 4·k_f), rpm (paper §3.3).
    pub fn max_rpm(&self) -> f64 {
        (self.thrust_to_weight * self.weight() / (4.0 * self.thrust_coefficient)).sqrt()
    }

    /// Returns the maximum collective thrust `MAX_THRUST`: 4·k_f·MAX_RPM², N.
    pub fn max_thrust(&self) -> f64 {
        let rpm = self.max_rpm();
        4.0 * self.thrust_coefficient * rpm * rpm
    }

    /// Returns the minimum height in the ground-effect formula, m: ¼·r_p·√(15·MAX_RPM²·k_f·C_gnd / MAX_THRUST).
    ///
    /// The ground effect does not increase further below this height.
    pub fn ground_effect_clip(&self) -> f64 {
        let rpm = self.max_rpm();
        0.25 * self.propeller_radius
            * (15.0 * rpm * rpm * self.thrust_coefficient * self.ground_effect_coefficient / self.max_thrust()).sqrt()
    }

    /// Returns the principal moments of inertia as a vector, body frame, kg·m².
    pub fn inertia_vector(&self) -> Vector3<f64> {
        Vector3::from(self.inertia)
    }

    /// Returns the positions of the motors relative to their centre, `[x, y]` in the body frame, m.
    pub fn motor_positions(&self) -> [[f64; 2]; 4] {
        match self.layout {
            Layout::X => {
                let l = self.arm_length / std::f64::consts::SQRT_2;
                [[l, l], [-l, l], [-l, -l], [l, -l]]
            }
            Layout::Plus => {
                let l = self.arm_length;
                [[l, 0.0], [0.0, l], [-l, 0.0], [0.0, -l]]
            }
        }
    }

    /// Returns the allocation matrix, which maps the four rotor thrusts F (N) to `[T, τx, τy, τz]` (N and N·m, body
    /// frame).
    ///
    /// A force F along body z at (x, y) from the [centre of mass](Self::center_of_mass) has the torque (y·F, −x·F, 0).
    /// In the X layout with a centred mass this gives the equations of the paper, τx = L/√2·(F0 + F1 − F2 − F3) and
    /// τy = L/√2·(−F0 + F1 + F2 − F3). The reaction torque of a rotor is k_m/k_f times its thrust.
    ///
    /// ```
    /// use aviary::drone::DroneModel;
    /// use nalgebra::Vector4;
    ///
    /// let params = DroneModel::Cf2x.params();
    /// // more thrust of motors 0 and 1, on the left, rolls to the right
    /// let wrench = params.allocation() * Vector4::new(0.08, 0.08, 0.06, 0.06);
    /// assert!((wrench[0] - 0.28).abs() < 1e-12 && wrench[1] > 0.0);
    /// assert!(wrench[2].abs() < 1e-12 && wrench[3].abs() < 1e-12);
    /// ```
    pub fn allocation(&self) -> Matrix4<f64> {
        let yaw = self.yaw_convention.sign() * self.torque_coefficient / self.thrust_coefficient;
        let [x, y] = self.center_of_mass;
        let m = self.motor_positions().map(|[mx, my]| [mx - x, my - y]);
        #[rustfmt::skip]
        let matrix = Matrix4::new(
            1.0,       1.0,       1.0,       1.0,
            m[0][1],   m[1][1],   m[2][1],   m[3][1],
            -m[0][0],  -m[1][0],  -m[2][0],  -m[3][0],
            -yaw,      yaw,       -yaw,      yaw,
        );
        matrix
    }
}

impl From<DroneModel> for DroneParams {
    fn from(model: DroneModel) -> Self {
        model.params()
    }
}

/// Error of an airframe.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum DroneError {
    /// A parameter that no drone can have.
    #[error("{field} is {}, expected {expected}", crate::number(*got))]
    Parameter {
        /// Name of the field.
        field: &'static str,
        /// Value of the field.
        got: f64,
        /// Valid values.
        expected: &'static str,
    },
    /// A parameter whose magnitude indicates a wrong unit.
    #[error("{field} is {}, expected {min:e} to {max:e} (SI units, rotor speeds in rpm)", crate::number(*got))]
    Range {
        /// Name of the field.
        field: &'static str,
        /// Value of the field.
        got: f64,
        /// Smallest valid value.
        min: f64,
        /// Largest valid value.
        max: f64,
    },
    /// A name that is invalid in a scene or a file name.
    #[error("name is `{name}`, expected letters, digits, `_` and `-`")]
    Name {
        /// Invalid name.
        name: String,
    },
    /// Text that is not an airframe in TOML.
    #[error("{message}")]
    Toml {
        /// Line, column and expected value.
        message: String,
    },
    /// A file that the system cannot read or write.
    #[error(transparent)]
    System(#[from] SystemError),
    /// A file without a valid airframe.
    #[error("{}: {error}", path.display())]
    File {
        /// Path of the file.
        path: PathBuf,
        /// Error in the file.
        #[source]
        error: Box<Self>,
    },
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn derived_constants_match_the_paper() {
        let cf = DroneModel::Cf2x.params();
        assert!((cf.hover_rpm() - 14_475.809_152_959_684).abs() < 1e-6);
        assert!((cf.max_rpm() - 1.5 * cf.hover_rpm()).abs() < 1e-9, "√2.25 = 1.5");
        assert!((cf.max_thrust() - 2.25 * 0.027 * 9.81).abs() < 1e-12);
        // with MAX_THRUST = 4·k_f·MAX_RPM² the root is √(15/4·C_gnd) for every airframe
        assert!((cf.ground_effect_clip() - 0.25 * 0.02325 * (15.0 / 4.0 * 11.36859_f64).sqrt()).abs() < 1e-12);
        let race = DroneModel::Race.params();
        assert!((race.hover_rpm() - (0.25 * 9.81 / (4.0 * 1.28e-8_f64)).sqrt()).abs() < 1e-9);
        assert!((race.max_rpm() - 2.0 * race.hover_rpm()).abs() < 1e-9, "√4 = 2");
    }

    #[test]
    fn allocation_matches_the_paper_for_every_layout() {
        let thrusts = nalgebra::Vector4::new(0.1, 0.2, 0.4, 0.8);
        let [f0, f1, f2, f3] = [0.1, 0.2, 0.4, 0.8];
        for model in DroneModel::PAPER {
            let p = model.params();
            let ratio = p.torque_coefficient / p.thrust_coefficient;
            let l = p.arm_length;
            let d = l / 2.0_f64.sqrt();
            let yaw = ratio * (-f0 + f1 - f2 + f3);
            let expected = match model {
                DroneModel::Cf2x => [d * (f0 + f1 - f2 - f3), d * (-f0 + f1 + f2 - f3), yaw],
                DroneModel::Cf2p => [l * (f1 - f3), l * (-f0 + f2), yaw],
                _ => [d * (f0 + f1 - f2 - f3), d * (-f0 + f1 + f2 - f3), -yaw],
            };
            let wrench = p.allocation() * thrusts;
            assert!((wrench[0] - 1.5).abs() < 1e-12);
            for axis in 0..3 {
                assert!((wrench[axis + 1] - expected[axis]).abs() < 1e-15, "{model} axis {axis}");
            }
        }
    }

    #[test]
    fn names_round_trip_and_unknown_ones_are_errors() {
        for model in DroneModel::ALL {
            assert_eq!(model.name().parse::<DroneModel>().unwrap(), model);
            assert_eq!(model.params().name, model.name());
        }
        assert!("CF2X".parse::<DroneModel>().unwrap_err().to_string().contains("cf2x, cf2p, race or cf21"));
    }

    #[test]
    fn errors_of_invalid_airframes_name_the_field() {
        let refused = |params: DroneParams, field: &str| {
            let text = params.validate().unwrap_err().to_string();
            assert!(text.starts_with(field), "{text}");
        };
        let good = || DroneModel::Cf2x.params();
        refused(DroneParams { mass: 0.0, ..good() }, "mass is 0");
        refused(DroneParams { mass: f64::NAN, ..good() }, "mass is NaN");
        refused(DroneParams { inertia: [1e-5, 1e-5, 3e-5], ..good() }, "inertia[2]");
        refused(DroneParams { inertia: [1e-5, -1e-5, 1e-5], ..good() }, "inertia[1]");
        refused(DroneParams { thrust_to_weight: 0.99, ..good() }, "thrust_to_weight");
        refused(DroneParams { thrust_coefficient: f64::INFINITY, ..good() }, "thrust_coefficient");
        refused(DroneParams { drag_coefficients: [0.0, -1.0, 0.0], ..good() }, "drag_coefficients[1]");
        refused(DroneParams { name: "a<b".into(), ..good() }, "name");
        refused(DroneParams { arm_length: 1e-300, ..good() }, "arm_length is 1e-300");
        refused(DroneParams { mass: 27e9, ..good() }, "mass is 27000000000, expected 1e-6 to 1e6");
        refused(DroneParams { inertia: [0.1e-5, 0.2e-5, 3.000_000_000_000_001e-6], ..good() }, "inertia[2]");
        assert!(DroneParams { inertia: [1e-5, 1e-5, 2e-5], ..good() }.validate().is_ok(), "a flat plate");
    }

    #[test]
    fn toml_errors_name_the_line_and_the_key() {
        let text = include_str!("../../assets/airframes/cf2x.toml");
        let error = |from: &str, to: &str| {
            let text = DroneParams::from_toml(&text.replace(from, to)).unwrap_err().to_string();
            assert!(!text.contains('\n'), "{text}");
            text
        };
        assert!(
            error("mass = 0.027", "mass = \"heavy\"").contains("line 3"),
            "{}",
            error("mass = 0.027", "mass = \"heavy\"")
        );
        assert!(error("mass = 0.027", "").contains("mass"));
        assert!(error("mass = 0.027", "mass = 0.027\nwings = 2").contains("wings"));
        assert!(error("layout = \"x\"", "layout = \"y\"").contains("line 6"));
        assert!(error("mass = 0.027", "mass = ").contains("line 3"));
        assert!(error("2.17e-5]", "2.17e-5, 1.0]").contains("4 numbers, expected 3"));
        let missing = DroneParams::from_file("no/such/file.toml").unwrap_err().to_string();
        assert!(missing.starts_with("no/such/file.toml: No such file"), "{missing}");
    }

    proptest! {
        #[test]
        fn valid_airframes_have_finite_constants_and_a_mixer(
            exponents in prop::array::uniform8(-320.0..310.0f64), narrow in prop::bool::ANY, ratio in 0.0..1e4,
        ) {
            let value = |i: usize| 10f64.powf(if narrow { exponents[i] / 40.0 } else { exponents[i] });
            let params = DroneParams {
                mass: value(0), inertia: [value(1); 3], arm_length: value(2), thrust_coefficient: value(3),
                torque_coefficient: value(4), thrust_to_weight: ratio, collision_radius: value(5),
                collision_height: value(6), propeller_radius: value(7), ..DroneModel::Cf2x.params()
            };
            if params.validate().is_ok() {
                let speeds = [params.hover_rpm(), params.max_rpm()];
                for constant in speeds.into_iter().chain([params.max_thrust(), params.ground_effect_clip()]) {
                    prop_assert!(constant.is_finite() && constant > 0.0, "{params:?}");
                }
                let mixer = crate::control::Mixer::new(&params);
                let rpm = mixer.rpm(params.weight(), Vector3::new(1e-3, -1e-3, 1e-4));
                prop_assert!(rpm.iter().all(|n| (0.0..=params.max_rpm()).contains(n)), "{rpm:?} {params:?}");
            }
        }

        #[test]
        fn damaged_airframes_are_errors_or_valid(at in 0usize..600, letter in 32u8..127) {
            let mut bytes = include_str!("../../assets/airframes/race.toml").as_bytes().to_vec();
            bytes[at] = letter;
            if let Ok(text) = std::str::from_utf8(&bytes) && let Ok(params) = DroneParams::from_toml(text) {
                prop_assert!(params.validate().is_ok() && params.max_rpm() >= params.hover_rpm());
            }
        }
    }
}
