//! Parameters of an airframe that recorded flights can determine.

use crate::drone::DroneParams;

/// Motion that a parameter acts on.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Stage {
    /// Translation, with the recorded attitude.
    Translation,
    /// Rotation.
    Rotation,
    /// Constant torques, which the estimator finds in every flight.
    Trim,
}

/// Role of a parameter in the fit.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Role {
    /// The parameter is in the fit from its first stage.
    Basic,
    /// The parameter is in the fit only if the flights show that it differs from its default.
    Additional,
}

/// A number of an airframe that is fitted.
#[derive(Debug, Clone, Copy)]
pub(super) struct Parameter {
    /// Key in the airframe file.
    pub name: &'static str,
    /// Unit.
    pub unit: &'static str,
    /// Motion that the parameter acts on.
    pub stage: Stage,
    /// Role in the fit.
    pub role: Role,
    /// Smallest valid number.
    pub min: f64,
    /// Returns the number of an airframe.
    pub number: fn(&DroneParams) -> f64,
    /// Returns the fitted value of an airframe: the number, its logarithm, or its difference from another number.
    pub get: fn(&DroneParams) -> f64,
    /// Sets the fitted value of an airframe.
    pub set: fn(&mut DroneParams, f64),
    /// Returns the magnitude of a plausible deviation of the fitted value between airframes of similar size and mass.
    pub scale: fn(&DroneParams) -> f64,
    /// Parameter from which the fitted value is a difference. Without the difference, both numbers are equal.
    pub like: Option<&'static str>,
}

/// Torque of one percent of the weight at the length of the arm, N·m.
fn torque(params: &DroneParams) -> f64 {
    0.01 * params.weight() * params.arm_length
}

/// Declares parameters. A number whose fitted value is the number itself needs only its place.
macro_rules! parameters {
    ($($name:literal $unit:literal $stage:ident $role:ident
        min $min:expr, scale $scale:expr, $kind:ident($($place:tt)+);)*) => {
        &[$(parameters!(@ $kind $name, $unit, $stage, $role, $min, $scale, $($place)+)),*]
    };
    (@ plain $name:literal, $unit:literal, $stage:ident, $role:ident, $min:expr, $scale:expr, $($place:tt)+) => {
        Parameter {
            name: $name,
            unit: $unit,
            stage: Stage::$stage,
            role: Role::$role,
            min: $min,
            number: |params| params.$($place)+,
            get: |params| params.$($place)+,
            set: |params, x| params.$($place)+ = x,
            scale: $scale,
            like: None,
        }
    };
    (@ logarithm $name:literal, $unit:literal, $stage:ident, $role:ident, $min:expr, $scale:expr, $($place:tt)+) => {
        Parameter {
            name: $name,
            unit: $unit,
            stage: Stage::$stage,
            role: Role::$role,
            min: $min,
            number: |params| params.$($place)+,
            get: |params| params.$($place)+.ln(),
            set: |params, x| params.$($place)+ = x.exp(),
            scale: $scale,
            like: None,
        }
    };
    // the first of two equal numbers: setting it keeps the difference
    (@ first $name:literal, $unit:literal, $stage:ident, $role:ident, $min:expr, $scale:expr,
        [$($one:tt)+] [$($two:tt)+]) => {
        Parameter {
            name: $name,
            unit: $unit,
            stage: Stage::$stage,
            role: Role::$role,
            min: $min,
            number: |params| params.$($one)+,
            get: |params| params.$($one)+,
            set: |params, x| {
                params.$($two)+ += x - params.$($one)+;
                params.$($one)+ = x;
            },
            scale: $scale,
            like: None,
        }
    };
    (@ second $name:literal, $unit:literal, $stage:ident, $role:ident, $min:expr, $scale:expr,
        [$($one:tt)+] [$($two:tt)+] like $like:literal) => {
        Parameter {
            name: $name,
            unit: $unit,
            stage: Stage::$stage,
            role: Role::$role,
            min: $min,
            number: |params| params.$($two)+,
            get: |params| params.$($two)+ - params.$($one)+,
            set: |params, x| params.$($two)+ = params.$($one)+ + x,
            scale: $scale,
            like: Some($like),
        }
    };
    // the same with the ratio, for positive numbers
    (@ first_of_ratio $name:literal, $unit:literal, $stage:ident, $role:ident, $min:expr, $scale:expr,
        [$($one:tt)+] [$($two:tt)+]) => {
        Parameter {
            name: $name,
            unit: $unit,
            stage: Stage::$stage,
            role: Role::$role,
            min: $min,
            number: |params| params.$($one)+,
            get: |params| params.$($one)+.ln(),
            set: |params, x| {
                params.$($two)+ *= x.exp() / params.$($one)+;
                params.$($one)+ = x.exp();
            },
            scale: $scale,
            like: None,
        }
    };
    (@ second_of_ratio $name:literal, $unit:literal, $stage:ident, $role:ident, $min:expr, $scale:expr,
        [$($one:tt)+] [$($two:tt)+] like $like:literal) => {
        Parameter {
            name: $name,
            unit: $unit,
            stage: Stage::$stage,
            role: Role::$role,
            min: $min,
            number: |params| params.$($two)+,
            get: |params| (params.$($two)+ / params.$($one)+).ln(),
            set: |params, x| params.$($two)+ = params.$($one)+ * x.exp(),
            scale: $scale,
            like: Some($like),
        }
    };
}

const ANY: f64 = f64::NEG_INFINITY;

/// All parameters, in the order of reports. A parameter comes after the one that it is compared with.
pub(super) static PARAMETERS: &[Parameter] = parameters! {
    "motors.speed_at_zero" "rpm" Translation Additional
        min ANY, scale |params| 0.3 * params.hover_rpm(), plain(motors.speed_at_zero);
    "motors.speed_per_volt" "rpm/V" Translation Basic
        min 0.0, scale |_| 0.3, logarithm(motors.speed_per_volt);
    "motors.rise_time" "s" Translation Basic
        min 0.0, scale |_| 0.05, first([motors.rise_time] [motors.fall_time]);
    "motors.fall_time" "s" Translation Additional
        min 0.0, scale |_| 0.03, second([motors.rise_time] [motors.fall_time] like "motors.rise_time");
    // the attitude shows the delay of a command, the height hardly does
    "motors.latency" "s" Rotation Basic
        min 0.0, scale |_| 0.03, plain(motors.latency);
    // the yaw torque of a change of the speed by 10 % in 0.1 s is that of 10 % of the thrust
    "motors.rotor_inertia" "kg·m²" Rotation Additional
        min 0.0, scale |params| params.torque_coefficient * params.hover_rpm() * 6.0 / std::f64::consts::TAU,
        plain(motors.rotor_inertia);
    "air.linear_drag[0]" "N/(m/s)" Translation Basic
        min 0.0, scale |params| 0.5 * params.mass, first([air.linear_drag[0]] [air.linear_drag[1]]);
    "air.linear_drag[1]" "N/(m/s)" Translation Additional
        min 0.0, scale |params| 0.2 * params.mass,
        second([air.linear_drag[0]] [air.linear_drag[1]] like "air.linear_drag[0]");
    "air.linear_drag[2]" "N/(m/s)" Translation Basic
        min 0.0, scale |params| 0.5 * params.mass, plain(air.linear_drag[2]);
    "air.translational_lift" "N/(m/s)²" Translation Additional
        min ANY, scale |params| 0.02 * params.weight(), plain(air.translational_lift);
    "air.velocity_moment" "N·m/(m/s)" Rotation Basic
        min ANY, scale |params| 20.0 * params.inertia[0], plain(air.velocity_moment);
    "air.rotational_damping[0]" "N·m/(rad/s)" Rotation Basic
        min 0.0, scale |params| 20.0 * params.inertia[0],
        first([air.rotational_damping[0]] [air.rotational_damping[1]]);
    "air.rotational_damping[1]" "N·m/(rad/s)" Rotation Additional
        min 0.0, scale |params| 10.0 * params.inertia[1],
        second([air.rotational_damping[0]] [air.rotational_damping[1]] like "air.rotational_damping[0]");
    "air.rotational_damping[2]" "N·m/(rad/s)" Rotation Basic
        min 0.0, scale |params| 20.0 * params.inertia[2], plain(air.rotational_damping[2]);
    "air.trim_torque[0]" "N·m" Trim Additional
        min ANY, scale |params| 5.0 * torque(params), plain(air.trim_torque[0]);
    "air.trim_torque[1]" "N·m" Trim Additional
        min ANY, scale |params| 5.0 * torque(params), plain(air.trim_torque[1]);
    "air.trim_torque[2]" "N·m" Trim Basic
        min ANY, scale |params| torque(params), plain(air.trim_torque[2]);
    "center_of_mass[0]" "m" Trim Basic
        min ANY, scale |params| 0.05 * params.arm_length, plain(center_of_mass[0]);
    "center_of_mass[1]" "m" Trim Basic
        min ANY, scale |params| 0.05 * params.arm_length, plain(center_of_mass[1]);
    "inertia[0]" "kg·m²" Rotation Basic
        min 0.0, scale |_| 0.7, first_of_ratio([inertia[0]] [inertia[1]]);
    "inertia[1]" "kg·m²" Rotation Additional
        min 0.0, scale |_| 0.3, second_of_ratio([inertia[0]] [inertia[1]] like "inertia[0]");
    "inertia[2]" "kg·m²" Rotation Additional
        min 0.0, scale |_| 0.7, logarithm(inertia[2]);
    "torque_coefficient" "N·m/rpm²" Rotation Basic
        min 0.0, scale |_| 1.0, logarithm(torque_coefficient);
};

#[cfg(test)]
mod tests {
    use super::*;
    use crate::drone::DroneModel;

    #[test]
    fn every_parameter_changes_only_itself() {
        let mut base = DroneModel::Cf2x.params();
        base.motors.speed_per_volt = 5000.0;
        base.motors.voltage = 3.6;
        base.motors.rise_time = 0.04;
        base.motors.fall_time = 0.05;
        base.inertia[1] *= 1.1;
        base.air.linear_drag = [0.01, 0.02, 0.03];
        base.air.rotational_damping = [1e-5, 2e-5, 3e-5];
        for parameter in PARAMETERS {
            let mut params = base.clone();
            let value = (parameter.get)(&base) + 0.01 * (parameter.scale)(&base);
            (parameter.set)(&mut params, value);
            assert!(((parameter.get)(&params) - value).abs() < 1e-12 * value.abs().max(1.0), "{}", parameter.name);
            assert!((parameter.number)(&params) != (parameter.number)(&base), "{}", parameter.name);
            assert!(params.validate().is_ok(), "{}", parameter.name);
            for other in PARAMETERS.iter().filter(|other| other.name != parameter.name) {
                let (before, after) = ((other.get)(&base), (other.get)(&params));
                assert!((after - before).abs() <= 1e-12 * before.abs(), "{} changes {}", parameter.name, other.name);
            }
        }
    }

    #[test]
    fn a_parameter_follows_the_one_that_it_is_compared_with() {
        for (index, parameter) in PARAMETERS.iter().enumerate() {
            let first = parameter.like.map(|like| PARAMETERS.iter().position(|other| other.name == like).unwrap());
            assert!(first.is_none_or(|first| first < index), "{}", parameter.name);
        }
    }
}
