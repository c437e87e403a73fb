//! An application for the firmware of a Crazyflie that flies a policy.

use std::f64::consts::TAU;

use aviary::action::ActionType;
use aviary::drone::{DroneParams, Layout};
use aviary::policy::PolicyNetwork;

use super::text::{comment, fill, number, wrapped};
use super::{TextFile, Weights, generate};
use crate::{FormatError, unsupported};

/// Options of [`firmware`].
#[derive(Debug, Clone)]
pub struct FirmwareOptions<'a> {
    /// Name of the policy in the code.
    pub name: &'a str,
    /// Type of the weights.
    pub weights: Weights,
    /// Airframe of the policy.
    pub drone: &'a DroneParams,
    /// Target of the task `hover`, m, world frame. The application moves it to the setpoint.
    pub target: [f64; 3],
}

/// Motor of the airframe that is at the place of a motor of the Crazyflie.
struct Mapping {
    /// Motor of the simulator for M1 to M4.
    motors: [usize; 4],
    /// True if the frames of the policy are those of the Crazyflie, turned by 90° about z.
    turned: bool,
}

/// Rate of the firmware's stabilizer task, which calls the controller, Hz.
const STABILIZER_RATE: u32 = 1000;

/// Build options of the application.
const APP_CONFIG: &str =
    "CONFIG_APP_ENABLE=y\nCONFIG_APP_PRIORITY=1\nCONFIG_APP_STACKSIZE=350\nCONFIG_CONTROLLER_OOT=y\n";

/// Headers of the firmware that the application includes, without their endings.
const FIRMWARE_NAMES: [&str; 5] = ["app", "controller", "platform_defaults", "stabilizer_types", "task"];

/// Positions of M1 to M4 in the body frame, in units of their distance from the axes: front right, back right, back
/// left and front left.
const MOTORS: [[f64; 2]; 4] = [[1.0, -1.0], [-1.0, -1.0], [-1.0, 1.0], [1.0, 1.0]];

/// Signs of the reaction torques of M1 to M4 about z.
const REACTIONS: [f64; 4] = [-1.0, 1.0, -1.0, 1.0];

/// Returns the mapping of the motors of an airframe.
///
/// The propellers of the Crazyflie turn against those of the airframes with the yaw convention of the paper. Turned by
/// 90° about z, the motors of both turn alike: the policy then sees the drone, the world and the setpoint in turned
/// frames, where the yaw is the same.
fn mapping(drone: &DroneParams) -> Result<Mapping, FormatError> {
    if drone.layout != Layout::X {
        return Err(unsupported("the layout of the airframe", "plus", "x, the layout of the Crazyflie"));
    }
    let (positions, reactions) = (drone.motor_positions(), drone.allocation().row(3).clone_owned());
    for turned in [false, true] {
        // the place in the frame of the policy
        let place = |[x, y]: [f64; 2]| if turned { [y, -x] } else { [x, y] };
        let motor_at =
            |at: [f64; 2]| positions.iter().position(|motor| (0..2).all(|axis| motor[axis] * at[axis] > 0.0));
        let motors = MOTORS.map(|at| motor_at(place(at)).unwrap_or(0));
        if (0..4).all(|motor| reactions[motors[motor]] * REACTIONS[motor] > 0.0) {
            return Ok(Mapping { motors, turned });
        }
    }
    Err(unsupported("the airframe", comment(&drone.name), "four motors that turn alternately"))
}

/// Returns an application for the out-of-tree build of the Crazyflie's firmware, with an out-of-tree controller that
/// flies the policy: `Makefile`, `Kbuild`, `app-config` and `src/`, and a `README.md`.
///
/// The controller reads the state estimate and the gyroscope, evaluates the policy at its control rate, and sets the
/// forces of the motors. The setpoint is the position of a `hover` policy's target: without an absolute position in the
/// setpoint the motors stop.
///
/// # Errors
/// [`FormatError::Unsupported`] for another task than `hover`, other actions than motor speeds, several drones, or an
/// airframe whose motors are not those of a Crazyflie.
pub fn firmware(policy: &PolicyNetwork, options: &FirmwareOptions<'_>) -> Result<Vec<TextFile>, FormatError> {
    let info = policy.info();
    if info.task != "hover" || info.num_drones != 1 {
        let got = format!("`{}` (num_drones = {})", info.task, info.num_drones);
        return Err(unsupported("the task", got, "`hover` with one drone"));
    }
    if policy.observation_size() != 12 {
        let got = format!("{} entries", policy.observation_size());
        return Err(unsupported("the observation", got, "the 12 entries of `hover`"));
    }
    let scale = match policy.action_type() {
        Some(ActionType::Rpm | ActionType::OneDRpm) => Scale::Normalized,
        Some(ActionType::RawRpm) => Scale::Speed,
        _ => {
            let got = format!("`{}`", info.action_type);
            return Err(unsupported("the action type", got, "motor speeds: rpm, one_d_rpm or raw_rpm"));
        }
    };
    if info.ctrl_freq > STABILIZER_RATE {
        return Err(unsupported("the control rate", format_args!("{} Hz", info.ctrl_freq), "at most 1000 Hz"));
    }
    if FIRMWARE_NAMES.contains(&options.name) {
        let expected = "another name than those of the firmware's headers";
        return Err(unsupported("the name", format_args!("`{}`", options.name), expected));
    }
    // the stack of the firmware's stabilizer task has less than 2 kB
    let code = generate(policy, options.name, options.weights, Some(options.drone), true)?;
    let app = App { policy, options, mapping: mapping(options.drone)?, scale };
    let name = options.name;
    let file = |path: String, content: String| TextFile { path, content };
    Ok(vec![
        file("README.md".into(), app.readme()),
        file("Makefile".into(), app.makefile()),
        file("app-config".into(), APP_CONFIG.into()),
        file("Kbuild".into(), "obj-y += src/\n".into()),
        file("src/Kbuild".into(), format!("obj-y += {name}.o\nobj-y += {name}_app.o\n")),
        file(format!("src/{name}.h"), code.header),
        file(format!("src/{name}.c"), code.source),
        file(format!("src/{name}_app.c"), app.controller()),
    ])
}

/// Meaning of an action.
#[derive(Clone, Copy, PartialEq)]
enum Scale {
    /// Normalized motor speed.
    Normalized,
    /// Motor speed, rpm.
    Speed,
}

struct App<'a> {
    policy: &'a PolicyNetwork,
    options: &'a FirmwareOptions<'a>,
    mapping: Mapping,
    scale: Scale,
}

impl App<'_> {
    fn makefile(&self) -> String {
        fill(include_str!("../../templates/app.mk"), &[("name", self.options.name.into())])
    }

    /// Returns the frames of the policy in words.
    fn frames(&self) -> &'static str {
        if self.mapping.turned {
            "The propellers of this airframe turn against those of the Crazyflie. Turned by 90 degrees about z they \
             turn alike, so the policy sees world and drone in frames whose x axis is y of the Crazyflie and whose y \
             axis is -x. Yaw is the same in both."
        } else {
            "The frames of the policy are those of the Crazyflie: x forward, y to the left, z up."
        }
    }

    fn readme(&self) -> String {
        let info = self.policy.info();
        let motors = self.mapping.motors.iter().enumerate();
        let motors: Vec<_> = motors.map(|(at, motor)| format!("| M{} | {motor} |", at + 1)).collect();
        let values = [
            ("name", self.options.name.into()),
            ("command", comment(&info.command).replace('`', " ")),
            ("target", self.options.target.map(|x| x.to_string()).join(", ")),
            ("rate", info.ctrl_freq.to_string()),
            ("drone", comment(&self.options.drone.name)),
            ("frames", of_item(self.frames())),
            ("thrust_max", format!("{:.3}", self.options.drone.max_thrust() / 4.0)),
            ("motors", motors.join("\n")),
        ];
        fill(include_str!("../../templates/app.md"), &values)
    }

    fn controller(&self) -> String {
        let (drone, name) = (self.options.drone, self.options.name);
        let prefix = name.to_uppercase();
        let single = |x: f64| number(x as f32);
        let (speeds, speed) = match self.scale {
            Scale::Normalized => (
                format!(
                    "/* Speeds of a motor for the actions 0 and 1, rpm. */\n\
                     #define HOVER_SPEED {}\n#define MAX_SPEED {}\n",
                    single(drone.hover_rpm()),
                    single(drone.max_rpm())
                ),
                "action <= 0.0f ? (action + 1.0f) * HOVER_SPEED : HOVER_SPEED + action * (MAX_SPEED - HOVER_SPEED)",
            ),
            Scale::Speed => (String::new(), "action"),
        };
        let (memory, clear, memory_argument) = match self.policy.memory_size() {
            0 => (String::new(), String::new(), ""),
            _ => (
                format!("static float memory[{prefix}_MEMORY_SIZE];\n"),
                format!("    for (int i = 0; i < {prefix}_MEMORY_SIZE; i++) {{\n        memory[i] = 0.0f;\n    }}\n"),
                "memory, ",
            ),
        };
        // one entry for all motors, or one for each
        let entry = |&motor: &usize| if self.policy.action_size() == 1 { 0 } else { motor };
        let entries: Vec<_> = self.mapping.motors.iter().map(|motor| entry(motor).to_string()).collect();
        let mut values = vec![
            ("name", name.to_string()),
            ("frames", wrapped(self.frames())),
            ("NAME", prefix),
            ("stabilizer_rate", STABILIZER_RATE.to_string()),
            ("target", self.options.target.map(single).join(", ")),
            ("drone", comment(&drone.name)),
            ("thrust_coefficient", single(drone.thrust_coefficient)),
            ("thrust_max", single(drone.max_thrust() / 4.0)),
            ("speeds", speeds),
            ("radians", single(TAU / 360.0)),
            ("entries", entries.join(", ")),
            ("memory", memory),
            ("speed", speed.into()),
            ("clear", clear),
            ("memory_argument", memory_argument.into()),
        ];
        let axes = [
            ["dx", "dy", "dx", "dy"],
            ["quaternion_x", "quaternion_y", "state->attitudeQuaternion.x", "state->attitudeQuaternion.y"],
            ["velocity_x", "velocity_y", "state->velocity.x", "state->velocity.y"],
            ["rate_x", "rate_y", "sensors->gyro.x", "sensors->gyro.y"],
        ];
        for [x, y, along_x, along_y] in axes {
            let turned = [along_y.to_string(), format!("-{along_x}")];
            let [in_x, in_y] = if self.mapping.turned { turned } else { [along_x.into(), along_y.into()] };
            values.extend([(x, in_x), (y, in_y)]);
        }
        fill(include_str!("../../templates/app.c"), &values)
    }
}

/// Returns text as lines of an item of a list in Markdown, with the item's indentation.
fn of_item(text: &str) -> String {
    /// Width of the lines of the file.
    const WIDTH: usize = 118;
    // after `- **Frames**: `
    let mut column = 14;
    let mut lines = String::new();
    for word in text.split(' ') {
        if column + word.len() + 1 > WIDTH {
            lines += "\n  ";
            column = 2;
        } else if !lines.is_empty() {
            lines += " ";
            column += 1;
        }
        lines += word;
        column += word.len();
    }
    lines
}

#[cfg(test)]
mod tests {
    use aviary::drone::DroneModel;

    use super::*;

    #[test]
    fn every_key_of_a_template_has_a_value() {
        let policy = PolicyNetwork::load("../assets/policies/hover.safetensors").unwrap();
        let drone = DroneModel::Cf2x.params();
        let options = FirmwareOptions { name: "a", weights: Weights::Float32, drone: &drone, target: [0.0, 0.0, 1.0] };
        for file in firmware(&policy, &options).unwrap() {
            assert!(!file.content.contains('@'), "{}", file.path);
        }
    }

    /// A motor of the policy pushes at the place of the motor of the Crazyflie, and turns it in the same direction.
    #[test]
    fn motors_have_the_places_and_directions_of_the_crazyflie() {
        for (model, turned) in [(DroneModel::Cf2x, true), (DroneModel::Cf21, false)] {
            let drone = model.params();
            let mapping = mapping(&drone).unwrap();
            assert_eq!(mapping.turned, turned, "{model}");
            for (at, &motor) in mapping.motors.iter().enumerate() {
                let [x, y] = drone.motor_positions()[motor];
                // back from the frame of the policy
                let [x, y] = if turned { [-y, x] } else { [x, y] };
                assert!(x * MOTORS[at][0] > 0.0 && y * MOTORS[at][1] > 0.0, "{model} M{}", at + 1);
                assert!(drone.allocation()[(3, motor)] * REACTIONS[at] > 0.0, "{model} M{}", at + 1);
            }
        }
        let plus = mapping(&DroneModel::Cf2p.params()).err().unwrap().to_string();
        assert!(plus.contains("layout"), "{plus}");
    }
}
