//! Derived numbers of an airframe with plausible ranges.

use super::DroneParams;

/// A number derived from an airframe's parameters.
#[derive(Debug, Clone, PartialEq)]
#[non_exhaustive]
pub struct DerivedNumber {
    /// Name in lower snake case.
    pub name: &'static str,
    /// Label in plain text.
    pub label: &'static str,
    /// Value in `unit`.
    pub value: f64,
    /// Unit; empty for a ratio.
    pub unit: &'static str,
    /// Smallest and largest value for quadrotors from 10 g to 500 kg; `None` for a number without a typical range.
    pub plausible: Option<[f64; 2]>,
    /// Names of the parameters that determine the number.
    pub fields: &'static str,
}

impl DerivedNumber {
    /// Returns true if the value is in the plausible range, or if there is no such range.
    pub fn is_plausible(&self) -> bool {
        self.plausible.is_none_or(|[min, max]| (min..=max).contains(&self.value))
    }

    /// Returns the plausible range as text: `10 to 500 N/m²`.
    pub fn range(&self) -> Option<String> {
        let [min, max] = self.plausible?;
        let unit = if self.unit.is_empty() { String::new() } else { format!(" {}", self.unit) };
        Some(if max.is_finite() { format!("{min} to {max}{unit}") } else { format!("at least {min}{unit}") })
    }

    /// Returns the value with four significant digits and its unit.
    pub fn text(&self) -> String {
        let unit = if self.unit.is_empty() { String::new() } else { format!(" {}", self.unit) };
        format!("{}{unit}", four_digits(self.value))
    }
}

/// Formats a number with four significant digits, in exponent form if it is very large or small.
fn four_digits(value: f64) -> String {
    let exponent = if value == 0.0 { 0 } else { value.abs().log10().floor() as i32 };
    match exponent {
        -4..=3 => format!("{value:.*}", usize::try_from(3 - exponent).unwrap_or(0)),
        4..=6 => format!("{value:.0}"),
        _ => format!("{value:.3e}"),
    }
}

/// Common unit mistakes: the parameters, the factor to SI units, and the wrong unit.
const SLIPS: [(&[&str], f64, &str); 13] = [
    (&["mass"], 1e-3, "grams"),
    (&["arm_length"], 1e-3, "millimetres"),
    (&["arm_length"], 1e-2, "centimetres"),
    (&["propeller_radius"], 1e-3, "millimetres"),
    (&["propeller_radius"], 1e-2, "centimetres"),
    (&["propeller_radius"], 0.0254, "inches"),
    (&["inertia"], 1e-7, "g cm²"),
    (&["inertia"], 1e-6, "kg mm²"),
    (&["inertia"], 1e-9, "g mm²"),
    (&["collision_radius", "collision_height"], 1e-3, "millimetres"),
    (&["thrust_coefficient", "torque_coefficient"], PER_RADIAN, "N / (rad/s)² and N m / (rad/s)²"),
    (&["thrust_coefficient"], PER_RADIAN, "N / (rad/s)²"),
    (&["torque_coefficient"], PER_RADIAN, "N m / (rad/s)²"),
];

/// Factor from a coefficient per (rad/s)² to the coefficient per rpm².
const PER_RADIAN: f64 = (std::f64::consts::TAU / 60.0) * (std::f64::consts::TAU / 60.0);

impl DroneParams {
    /// Returns the derived numbers of the airframe with their plausible ranges.
    ///
    /// A number outside its range is not an error. Usually it indicates a parameter in a wrong unit.
    ///
    /// ```
    /// use aviary::drone::{DroneModel, DroneParams};
    ///
    /// let in_grams = DroneParams { mass: 27.0, ..DroneModel::Cf2x.params() };
    /// assert!(in_grams.validate().is_ok(), "a body that MuJoCo can fly");
    /// let implausible: Vec<_> = in_grams.derived().into_iter().filter(|number| !number.is_plausible()).collect();
    /// assert!(implausible.iter().all(|number| number.fields.contains("mass")));
    /// assert_eq!(in_grams.unit_slip().as_deref(), Some("mass in grams (in kg it is 0.027)"));
    /// ```
    pub fn derived(&self) -> Vec<DerivedNumber> {
        let mut numbers = Vec::new();
        let mut add = |name, label, value, unit, plausible, fields| {
            numbers.push(DerivedNumber { name, label, value, unit, plausible, fields });
        };
        let radius = self.propeller_radius;
        let turn = std::f64::consts::TAU / 60.0;
        let (hover, max) = (self.hover_rpm(), self.max_rpm());
        add("weight", "weight", self.weight(), "N", None, "mass");
        add("max_thrust", "maximum thrust", self.max_thrust(), "N", None, "mass, thrust_to_weight");
        let fields = "thrust_to_weight";
        add("thrust_to_weight", "thrust to weight", self.thrust_to_weight, "", Some([1.2, 16.0]), fields);
        let fields = "mass, thrust_coefficient";
        add("hover_rpm", "hover speed", hover, "rpm", None, fields);
        add("max_rpm", "maximum speed", max, "rpm", None, "mass, thrust_coefficient, thrust_to_weight");
        add("hover_share", "hover speed over maximum speed", hover / max, "", None, "thrust_to_weight");
        let fields = "mass, thrust_coefficient, thrust_to_weight, propeller_radius";
        add("tip_speed", "maximum propeller tip speed", max * turn * radius, "m/s", Some([20.0, 340.0]), fields);
        let discs = 4.0 * std::f64::consts::PI * radius * radius;
        let fields = "mass, propeller_radius";
        add("disc_loading", "weight per propeller area", self.weight() / discs, "N/m²", Some([8.0, 800.0]), fields);
        // T = C_T·ρ·n²·D⁴ with n in revolutions per second
        let thrust_number = self.thrust_coefficient * 3600.0 / (1.225 * (2.0 * radius).powi(4));
        let fields = "thrust_coefficient, propeller_radius";
        add("thrust_number", "thrust coefficient C_T", thrust_number, "", Some([0.02, 0.5]), fields);
        let arm = self.torque_coefficient / self.thrust_coefficient / radius;
        let fields = "torque_coefficient, thrust_coefficient, propeller_radius";
        add("torque_ratio", "rotor torque over thrust × radius", arm, "", Some([0.05, 2.0]), fields);
        let fields = "propeller_radius, arm_length";
        add("propeller_ratio", "propeller radius over arm", radius / self.arm_length, "", Some([0.15, 0.8]), fields);
        for (axis, name, label, fields) in [
            (0, "gyration_ratio_x", "radius of gyration over arm, roll", "inertia[0], mass, arm_length"),
            (1, "gyration_ratio_y", "radius of gyration over arm, pitch", "inertia[1], mass, arm_length"),
            (2, "gyration_ratio_z", "radius of gyration over arm, yaw", "inertia[2], mass, arm_length"),
        ] {
            let ratio = (self.inertia[axis] / self.mass).sqrt() / self.arm_length;
            add(name, label, ratio, "", Some([0.15, 1.2]), fields);
        }
        // the motors on one side at full speed, the others stopped
        let left: f64 = self.motor_positions().iter().map(|[_, y]| y.max(0.0)).sum();
        let roll = left * self.max_thrust() / 4.0 / self.inertia[0];
        let fields = "inertia[0], arm_length, mass, thrust_to_weight";
        add("roll_acceleration", "maximum roll acceleration", roll, "rad/s²", Some([5.0, 8000.0]), fields);
        // accelerates over half of the angle and decelerates over the other half
        let tilt = 2.0 * (30_f64.to_radians() / roll).sqrt();
        add("tilt_time", "time to tilt by 30° and stop", tilt, "s", None, fields);
        let drag = self.drag_coefficients[0].max(self.drag_coefficients[1]) * 4.0 * hover * turn;
        if drag > 0.0 {
            let fields = "drag_coefficients, mass, thrust_coefficient";
            let label = "time constant of blade drag in hover";
            add("drag_time_constant", label, self.mass / drag, "s", Some([0.2, f64::INFINITY]), fields);
        }
        let push = 0.5 * 1.225 * self.drag_area() * 10.0 * 10.0 / self.weight();
        let fields = "drag_area (or collision_radius, collision_height), mass";
        add("wind_ratio", "force of a 10 m/s wind over weight", push, "", Some([0.01, 5.0]), fields);
        if self.ground_effect_coefficient > 0.0 {
            let clip = self.ground_effect_clip() / radius;
            let label = "ground-effect clip height over propeller radius";
            add("ground_effect_ratio", label, clip, "", Some([0.05, 5.0]), "ground_effect_coefficient");
        }
        let span = self.arm_length + radius;
        let fields = "collision_radius, arm_length, propeller_radius";
        let label = "collision radius over arm + propeller radius";
        add("collision_ratio", label, self.collision_radius / span, "", Some([0.5, 2.0]), fields);
        let flat = self.collision_height / self.collision_radius;
        let fields = "collision_height, collision_radius";
        add("collision_flatness", "collision height over radius", flat, "", Some([0.05, 3.0]), fields);
        add("max_speed", "top speed of velocity commands", self.max_speed, "m/s", Some([0.2, 80.0]), "max_speed");
        numbers.extend(self.derived_from_motors());
        numbers.extend(self.derived_from_air());
        numbers
    }

    /// Returns the derived numbers of the centre of mass and of the motors that differ from zero.
    fn derived_from_motors(&self) -> Vec<DerivedNumber> {
        let (motors, [x, y]) = (&self.motors, self.center_of_mass);
        let max_spin = motors.rotor_inertia * self.max_rpm() * (std::f64::consts::TAU / 60.0);
        let lag = Some([0.002, 1.0]);
        let all = [
            DerivedNumber {
                name: "center_of_mass_ratio",
                label: "offset of the centre of mass over arm",
                value: x.hypot(y) / self.arm_length,
                unit: "",
                plausible: Some([0.0, 0.3]),
                fields: "center_of_mass, arm_length",
            },
            DerivedNumber {
                name: "rise_time",
                label: "time constant of a rising motor speed",
                value: motors.rise_time,
                unit: "s",
                plausible: lag,
                fields: "motors.rise_time",
            },
            DerivedNumber {
                name: "fall_time",
                label: "time constant of a falling motor speed",
                value: motors.fall_time,
                unit: "s",
                plausible: lag,
                fields: "motors.fall_time",
            },
            DerivedNumber {
                name: "motor_latency",
                label: "latency of the motors",
                value: motors.latency,
                unit: "s",
                plausible: Some([0.0, 0.2]),
                fields: "motors.latency",
            },
            DerivedNumber {
                name: "rotor_inertia_ratio",
                label: "inertia of four rotors over yaw inertia",
                value: 4.0 * motors.rotor_inertia / self.inertia[2],
                unit: "",
                plausible: Some([1e-5, 0.2]),
                fields: "motors.rotor_inertia, inertia[2]",
            },
            DerivedNumber {
                name: "spin_rate",
                label: "yaw rate of a rotor's momentum at full speed",
                value: max_spin / self.inertia[2],
                unit: "rad/s",
                plausible: None,
                fields: "motors.rotor_inertia, inertia[2], mass, thrust_coefficient, thrust_to_weight",
            },
        ];
        all.into_iter().filter(|number| number.value != 0.0).collect()
    }

    /// Returns the derived numbers of the air that differ from zero.
    fn derived_from_air(&self) -> Vec<DerivedNumber> {
        let air = &self.air;
        let drag = air.linear_drag.into_iter().fold(0.0, f64::max);
        let damping = (0..3).map(|axis| air.rotational_damping[axis] / self.inertia[axis]).fold(0.0, f64::max);
        // the motors on one side at full speed, the others stopped
        let left: f64 = self.motor_positions().iter().map(|[_, y]| y.max(0.0)).sum();
        let max_torque = left * self.max_thrust() / 4.0;
        let trim = air.trim_torque.into_iter().map(f64::abs).fold(0.0, f64::max);
        let of = |value: f64, number: DerivedNumber| (value != 0.0).then_some(number);
        let all = [
            of(
                drag,
                DerivedNumber {
                    name: "linear_drag_time_constant",
                    label: "shortest time constant of linear drag",
                    value: self.mass / drag,
                    unit: "s",
                    plausible: Some([0.1, f64::INFINITY]),
                    fields: "air.linear_drag, mass",
                },
            ),
            of(
                damping,
                DerivedNumber {
                    name: "damping_time_constant",
                    label: "shortest time constant of rotational damping",
                    value: 1.0 / damping,
                    unit: "s",
                    plausible: Some([0.01, f64::INFINITY]),
                    fields: "air.rotational_damping, inertia",
                },
            ),
            of(
                air.translational_lift,
                DerivedNumber {
                    name: "lift_ratio",
                    label: "translational lift at 1 m/s over weight",
                    value: air.translational_lift / self.weight(),
                    unit: "",
                    plausible: Some([-0.1, 0.1]),
                    fields: "air.translational_lift, mass",
                },
            ),
            of(
                air.velocity_moment,
                DerivedNumber {
                    name: "velocity_moment_ratio",
                    label: "torque of 1 m/s over the largest of the motors",
                    value: air.velocity_moment / max_torque,
                    unit: "",
                    plausible: Some([-0.2, 0.2]),
                    fields: "air.velocity_moment, arm_length, mass, thrust_to_weight",
                },
            ),
            of(
                trim,
                DerivedNumber {
                    name: "trim_ratio",
                    label: "trim torque over the largest of the motors",
                    value: trim / max_torque,
                    unit: "",
                    plausible: Some([0.0, 0.3]),
                    fields: "air.trim_torque, arm_length, mass, thrust_to_weight",
                },
            ),
        ];
        all.into_iter().flatten().collect()
    }

    /// Returns a unit mistake that explains every implausible number, or `None` if no single mistake does.
    ///
    /// The text names the parameters, their apparent unit and their values in SI units.
    pub fn unit_slip(&self) -> Option<String> {
        let is_plausible = |params: &Self| params.derived().iter().all(DerivedNumber::is_plausible);
        if is_plausible(self) {
            return None;
        }
        SLIPS.iter().find_map(|&(fields, factor, unit)| {
            let mut params = self.clone();
            let mut values = Vec::new();
            for &field in fields {
                let (numbers, si): (&mut [f64], _) = match field {
                    "mass" => (std::slice::from_mut(&mut params.mass), "kg"),
                    "arm_length" => (std::slice::from_mut(&mut params.arm_length), "m"),
                    "propeller_radius" => (std::slice::from_mut(&mut params.propeller_radius), "m"),
                    "collision_radius" => (std::slice::from_mut(&mut params.collision_radius), "m"),
                    "collision_height" => (std::slice::from_mut(&mut params.collision_height), "m"),
                    "thrust_coefficient" => (std::slice::from_mut(&mut params.thrust_coefficient), "N / rpm²"),
                    "torque_coefficient" => (std::slice::from_mut(&mut params.torque_coefficient), "N m / rpm²"),
                    _ => (&mut params.inertia[..], "kg m²"),
                };
                numbers.iter_mut().for_each(|number| *number *= factor);
                // no measurement has more than six significant digits
                let text: Vec<_> = numbers.iter().map(|number| short(*number)).collect();
                values.push(format!("in {si} it is {}", text.join(", ")));
            }
            (params.validate().is_ok() && is_plausible(&params))
                .then(|| format!("{} in {unit} ({})", fields.join(" and "), values.join("; ")))
        })
    }
}

/// Formats a number with up to six significant digits, without trailing zeros.
fn short(number: f64) -> String {
    let rounded: f64 = format!("{number:.5e}").parse().unwrap_or(number);
    if (1e-3..1e6).contains(&rounded.abs()) { rounded.to_string() } else { format!("{rounded:e}") }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::drone::{AirParams, DroneModel, MotorParams};

    /// Reads an airframe from the first TOML block of a text.
    fn toml_of(text: &str, start: &str, end: &str) -> DroneParams {
        let rest = text.split_once(start).unwrap().1;
        DroneParams::from_toml(rest.split_once(end).unwrap().0).unwrap()
    }

    #[test]
    fn built_in_and_documented_airframes_are_plausible() {
        let guide = toml_of(include_str!("../../../docs/airframes.md"), "```toml\n", "```");
        let example = toml_of(include_str!("../../../examples/custom_airframe.rs"), "r#\"\n", "\"#;");
        for params in DroneModel::PAPER.map(DroneModel::params).into_iter().chain([guide, example]) {
            for number in params.derived() {
                assert!(number.is_plausible(), "{}: {number:?}", params.name);
            }
            assert_eq!(params.unit_slip(), None);
        }
    }

    #[test]
    fn derived_numbers_match_closed_forms() {
        let numbers = DroneModel::Cf2x.params().derived();
        let of = |name: &str| numbers.iter().find(|number| number.name == name).unwrap().value;
        assert!((of("hover_rpm") - 14_475.8).abs() < 0.1 && (of("hover_share") - 1.0 / 1.5).abs() < 1e-12);
        assert!((of("gyration_ratio_x") - (1.4e-5_f64 / 0.027).sqrt() / 0.0397).abs() < 1e-12);
        // two motors at full thrust at a distance L/√2 from the axis
        let torque = 2.0 * (2.25 * 0.027 * 9.81 / 4.0) * 0.0397 / 2_f64.sqrt();
        assert!((of("roll_acceleration") - torque / 1.4e-5).abs() < 1e-9);
        let alpha = torque / 1.4e-5;
        assert!((0.25 * alpha * of("tilt_time").powi(2) - 30_f64.to_radians()).abs() < 1e-12, "both halves");
    }

    #[test]
    fn optional_parameters_have_numbers_only_if_they_are_present() {
        let count = DroneModel::Cf2x.params().derived().len();
        let motors = MotorParams { rise_time: 0.05, latency: 0.01, rotor_inertia: 4e-8, ..MotorParams::default() };
        let air = AirParams {
            linear_drag: [0.01, 0.02, 0.01],
            rotational_damping: [1.4e-5, 0.0, 0.0],
            velocity_moment: 2e-4,
            ..AirParams::default()
        };
        let measured = DroneParams { motors, air, center_of_mass: [3e-4, 4e-4], ..DroneModel::Cf2x.params() };
        let numbers = measured.derived();
        let of = |name: &str| numbers.iter().find(|number| number.name == name).unwrap();
        for (name, value) in [
            ("center_of_mass_ratio", 5e-4 / 0.0397),
            ("rise_time", 0.05),
            ("motor_latency", 0.01),
            ("rotor_inertia_ratio", 1.6e-7 / 2.17e-5),
            ("linear_drag_time_constant", 0.027 / 0.02),
            ("damping_time_constant", 1.0),
            ("velocity_moment_ratio", 2e-4 * 2_f64.sqrt() / (0.5 * 2.25 * 0.027 * 9.81 * 0.0397)),
        ] {
            assert!((of(name).value / value - 1.0).abs() < 1e-3 && of(name).is_plausible(), "{:?}", of(name));
        }
        assert_eq!(numbers.len(), count + 8, "with the yaw rate of a rotor's momentum");
        for wrong in [
            DroneParams { center_of_mass: [0.02, 0.0], ..DroneModel::Cf2x.params() },
            DroneParams { motors: MotorParams { fall_time: 50.0, ..motors }, ..DroneModel::Cf2x.params() },
            DroneParams { motors: MotorParams { rotor_inertia: 4e-5, ..motors }, ..DroneModel::Cf2x.params() },
            DroneParams { air: AirParams { linear_drag: [1.0; 3], ..air }, ..DroneModel::Cf2x.params() },
            DroneParams { air: AirParams { trim_torque: [0.1, 0.0, 0.0], ..air }, ..DroneModel::Cf2x.params() },
        ] {
            assert!(wrong.derived().iter().any(|number| !number.is_plausible()), "{wrong:?}");
        }
    }

    #[test]
    fn unit_mistakes_make_a_number_of_their_field_implausible() {
        type Slip = fn(&mut DroneParams);
        let slips: [(&str, Slip); 16] = [
            ("mass", |p| p.mass *= 1e3),
            ("mass", |p| p.mass *= 1e-3),
            ("inertia[0]", |p| p.inertia = p.inertia.map(|x| x * 1e3)),
            ("inertia[2]", |p| p.inertia = p.inertia.map(|x| x * 1e-3)),
            ("arm_length", |p| p.arm_length *= 1e3),
            ("arm_length", |p| p.arm_length *= 1e-3),
            ("propeller_radius", |p| p.propeller_radius *= 1e3),
            ("propeller_radius", |p| p.propeller_radius *= 10.0),
            ("thrust_coefficient", |p| p.thrust_coefficient /= PER_RADIAN),
            ("torque_coefficient", |p| p.torque_coefficient /= PER_RADIAN),
            ("torque_coefficient", |p| p.torque_coefficient *= 1e-3),
            ("thrust_to_weight", |p| p.thrust_to_weight *= 100.0),
            ("collision_radius", |p| p.collision_radius *= 1e3),
            ("collision_height", |p| p.collision_height *= 1e3),
            ("drag_coefficients", |p| p.drag_coefficients = p.drag_coefficients.map(|x| x * 1e3)),
            ("max_speed", |p| p.max_speed *= 1e3),
        ];
        for model in [DroneModel::Cf2x, DroneModel::Race] {
            for (index, (field, slip)) in slips.iter().enumerate() {
                let mut params = model.params();
                slip(&mut params);
                let named = |number: &DerivedNumber| !number.is_plausible() && number.fields.contains(field);
                // the racer uses the drag of the Crazyflie, so a factor of 1000 is still plausible
                let unnoticed = model == DroneModel::Race && *field == "drag_coefficients";
                assert!(unnoticed || params.derived().iter().any(named), "{model}: slip {index} of {field}");
            }
        }
    }

    #[test]
    fn the_unit_that_explains_all_implausible_numbers_is_suggested() {
        let good = || DroneModel::Cf2x.params();
        for (params, wanted) in [
            (DroneParams { mass: 27.0, ..good() }, "mass in grams (in kg it is 0.027)"),
            (DroneParams { arm_length: 39.7, ..good() }, "arm_length in millimetres (in m it is 0.0397)"),
            (DroneParams { inertia: [140.0, 140.0, 217.0], ..good() }, "inertia in g cm²"),
            (DroneParams { propeller_radius: 0.915, ..good() }, "propeller_radius in inches"),
            (
                DroneParams {
                    thrust_coefficient: good().thrust_coefficient / PER_RADIAN,
                    torque_coefficient: good().torque_coefficient / PER_RADIAN,
                    ..good()
                },
                "thrust_coefficient and torque_coefficient in N / (rad/s)²",
            ),
        ] {
            let slip = params.unit_slip().unwrap();
            assert!(slip.starts_with(wanted), "{slip}");
        }
        assert_eq!(DroneParams { mass: 1200.0, thrust_to_weight: 900.0, ..good() }.unit_slip(), None, "two mistakes");
    }
}
