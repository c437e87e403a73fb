//! An application for the firmware of a Crazyflie that flies a policy.

use std::f64::consts::TAU;
use std::fmt::Write as _;

use aviary::action::ActionType;
use aviary::drone::{DroneParams, Layout};
use aviary::policy::PolicyNetwork;

use super::text::{comment, number};
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

/// Headers of the firmware that the application includes, without their endings.
const FIRMWARE_NAMES: [&str; 5] = ["app", "controller", "platform_defaults", "stabilizer_types", "task"];

/// Positions of M1 to M4 in the body frame, in units of their distance from the axes: front right, back right, back left
/// and front left.
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
        let got = format!("`{}` with {} drones", info.task, info.num_drones);
        return Err(unsupported(
            "the task",
            got,
            "`hover` with one drone, whose observation a state estimate determines",
        ));
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
    let code = generate(policy, options.name, options.weights, true)?;
    let app = App { policy, options, mapping: mapping(options.drone)?, scale };
    let name = options.name;
    let file = |path: String, content: String| TextFile { path, content };
    Ok(vec![
        file("README.md".into(), app.readme()),
        file("Makefile".into(), app.makefile()),
        file(
            "app-config".into(),
            "CONFIG_APP_ENABLE=y\nCONFIG_APP_PRIORITY=1\nCONFIG_APP_STACKSIZE=350\nCONFIG_CONTROLLER_OOT=y\n".into(),
        ),
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
        let name = self.options.name;
        format!(
            "# Out-of-tree build of {name}: `make CRAZYFLIE_BASE=PATH` with the path of the firmware.\n\
             CRAZYFLIE_BASE ?= ../crazyflie-firmware\n\n\
             OOT_CONFIG := $(PWD)/app-config\n\ninclude $(CRAZYFLIE_BASE)/tools/make/oot.mk\n"
        )
    }

    /// Returns the frames of the policy in words.
    fn frames(&self) -> &'static str {
        if self.mapping.turned {
            "The propellers of this airframe turn against those of the Crazyflie. Turned by 90 degrees about z they turn alike, \
             so the policy sees world and drone in frames whose x axis is y of the Crazyflie and whose y axis is -x. Yaw is \
             the same in both."
        } else {
            "The frames of the policy are those of the Crazyflie: x forward, y to the left, z up."
        }
    }

    fn readme(&self) -> String {
        let (info, name) = (self.policy.info(), self.options.name);
        let [x, y, z] = self.options.target;
        let motors: Vec<_> =
            self.mapping.motors.iter().enumerate().map(|(at, motor)| format!("| M{} | {motor} |", at + 1)).collect();
        format!(
            "# {name}\n\nAn application for the firmware of the Crazyflie that flies the policy of `{command}`.\n\n\
             ```text\nmake CRAZYFLIE_BASE=PATH_OF_THE_FIRMWARE\ncfloader flash build/cf2.bin stm32-fw -w radio://0/80/2M/E7E7E7E7E7\n```\n\n\
             `app-config` selects the out-of-tree controller. Select it at run time with the parameter `stabilizer.controller`.\n\n\
             - **Estimate**: the policy needs position, velocity and attitude, from a positioning system or a flow deck.\n\
             - **Setpoint**: absolute positions, as the high-level commander sends them. The drone hovers at the setpoint, which the\n  \
             policy sees as ({x}, {y}, {z}) m. With any other setpoint the motors stop. Distant setpoints are outside of what the\n  \
             policy was trained for: move them in steps of at most 0.5 m.\n\
             - **Rate**: {rate} Hz, in the stabilizer task.\n\
             - **Motors**: the policy sets motor speeds. The application turns them into forces with the thrust coefficient of the\n  \
             airframe `{drone}`, as shares of the firmware's `THRUST_MAX`; motors that lag or are weaker than the simulated ones\n  \
             fly otherwise than in simulation.\n\
             - **Frames**: {frames}\n\n| Crazyflie | motor of the policy |\n| --- | --- |\n{motors}\n\n\
             Try it first without propellers, then at low height above something soft, with a hand on the emergency stop.\n",
            command = info.command.replace(['`', '\n'], " "),
            rate = info.ctrl_freq,
            drone = info.drone,
            frames = self.frames(),
            motors = motors.join("\n"),
        )
    }

    fn controller(&self) -> String {
        let (info, name) = (self.policy.info(), self.options.name);
        let prefix = name.to_uppercase();
        let drone = self.options.drone;
        let frames = |x: &str, y: &str| {
            if self.mapping.turned { (y.to_string(), format!("-{x}")) } else { (x.into(), y.into()) }
        };
        let mut text = format!(
            "/*\n * Out-of-tree controller that flies the policy of {name}.h.\n *\n{} */\n\n\
             #include <math.h>\n#include <stdbool.h>\n#include <stdint.h>\n\n\
             #include \"FreeRTOS.h\"\n#include \"app.h\"\n#include \"controller.h\"\n#include \"platform_defaults.h\"\n#include \"stabilizer_types.h\"\n#include \"task.h\"\n\n\
             #include \"{name}.h\"\n\n",
            super::text::wrapped(self.frames())
        );
        let _ = write!(
            text,
            "/* Rate of the stabilizer task, which calls the controller, Hz. */\n#define STABILIZER_RATE {STABILIZER_RATE}\n\n\
             /* Target of the policy, m. The setpoint of the drone is moved to it. */\n\
             static const float target[3] = {{ {}, {}, {} }};\n\n\
             /* Thrust coefficient of a rotor of {}, N/rpm^2. */\n#define THRUST_COEFFICIENT {}\n\
             /* Thrust of a motor of the Crazyflie at full power, N. */\n\
             #ifndef THRUST_MAX\n#define THRUST_MAX {}\n#endif\n",
            number(self.options.target[0] as f32),
            number(self.options.target[1] as f32),
            number(self.options.target[2] as f32),
            comment(&info.drone),
            number(drone.thrust_coefficient as f32),
            number((drone.max_thrust() / 4.0) as f32),
        );
        if self.scale == Scale::Normalized {
            let _ = write!(
                text,
                "/* Speeds of a motor for the actions 0 and 1, rpm. */\n#define HOVER_SPEED {}\n#define MAX_SPEED {}\n",
                number(drone.hover_rpm() as f32),
                number(drone.max_rpm() as f32),
            );
        }
        let _ = write!(
            text,
            "/* rad/s per deg/s. */\n#define RADIANS {}\n\n\
             /* Motor of the policy for M1 to M4. */\nstatic const int motor_of[4] = {{ {} }};\n\n\
             static float forces[4];\n{}\n",
            number((TAU / 360.0) as f32),
            (self.mapping.motors.iter())
                .map(|&motor| if self.policy.action_size() == 1 { "0".into() } else { motor.to_string() })
                .collect::<Vec<_>>()
                .join(", "),
            if self.policy.memory_size() > 0 {
                format!("static float memory[{prefix}_MEMORY_SIZE];\n")
            } else {
                String::new()
            },
        );
        text += "/* Returns the speed of a motor for an action, rpm. */\nstatic float speed(float action)\n{\n";
        text += match self.scale {
            Scale::Normalized => {
                "    return action <= 0.0f ? (action + 1.0f) * HOVER_SPEED : HOVER_SPEED + action * (MAX_SPEED - HOVER_SPEED);\n}\n\n"
            }
            Scale::Speed => "    return action;\n}\n\n",
        };
        let (px, py) =
            frames("(state->position.x - setpoint->position.x)", "(state->position.y - setpoint->position.y)");
        let (vx, vy) = frames("state->velocity.x", "state->velocity.y");
        let (wx, wy) = frames("sensors->gyro.x", "sensors->gyro.y");
        let (qx, qy) = frames("state->attitudeQuaternion.x", "state->attitudeQuaternion.y");
        let _ = write!(
            text,
            "/* Computes the observation from the estimate and the setpoint. */\n\
             static void observe(const state_t *state, const sensorData_t *sensors, const setpoint_t *setpoint,\n                    \
             float observation[{prefix}_OBSERVATION_SIZE])\n{{\n    \
             const float w = state->attitudeQuaternion.w;\n    const float x = {qx};\n    const float y = {qy};\n    \
             const float z = state->attitudeQuaternion.z;\n    const float sine = 2.0f * (w * y - z * x);\n\n    \
             observation[{prefix}_OBSERVATION_POSITION_X] = target[0] + {px};\n    \
             observation[{prefix}_OBSERVATION_POSITION_Y] = target[1] + {py};\n    \
             observation[{prefix}_OBSERVATION_POSITION_Z] = target[2] + state->position.z - setpoint->position.z;\n    \
             observation[{prefix}_OBSERVATION_ROLL] = atan2f(2.0f * (w * x + y * z), 1.0f - 2.0f * (x * x + y * y));\n    \
             observation[{prefix}_OBSERVATION_PITCH] = asinf(sine < -1.0f ? -1.0f : sine > 1.0f ? 1.0f : sine);\n    \
             observation[{prefix}_OBSERVATION_YAW] = atan2f(2.0f * (w * z + x * y), 1.0f - 2.0f * (y * y + z * z));\n    \
             observation[{prefix}_OBSERVATION_VELOCITY_X] = {vx};\n    \
             observation[{prefix}_OBSERVATION_VELOCITY_Y] = {vy};\n    \
             observation[{prefix}_OBSERVATION_VELOCITY_Z] = state->velocity.z;\n    \
             observation[{prefix}_OBSERVATION_ANGULAR_VELOCITY_X] = RADIANS * {wx};\n    \
             observation[{prefix}_OBSERVATION_ANGULAR_VELOCITY_Y] = RADIANS * {wy};\n    \
             observation[{prefix}_OBSERVATION_ANGULAR_VELOCITY_Z] = RADIANS * sensors->gyro.z;\n}}\n\n"
        );
        let (memory, clear) = match self.policy.memory_size() {
            0 => ("", String::new()),
            _ => (
                "memory, ",
                format!("    for (int i = 0; i < {prefix}_MEMORY_SIZE; i++) {{\n        memory[i] = 0.0f;\n    }}\n"),
            ),
        };
        let _ = write!(
            text,
            "void appMain(void)\n{{\n    while (true) {{\n        vTaskDelay(M2T(1000));\n    }}\n}}\n\n\
             void controllerOutOfTreeInit(void)\n{{\n    for (int motor = 0; motor < 4; motor++) {{\n        forces[motor] = 0.0f;\n    }}\n{clear}}}\n\n\
             bool controllerOutOfTreeTest(void)\n{{\n    return true;\n}}\n\n\
             void controllerOutOfTree(control_t *control, const setpoint_t *setpoint, const sensorData_t *sensors,\n                         \
             const state_t *state, const uint32_t step)\n{{\n    \
             const bool has_target =\n        setpoint->mode.x == modeAbs && setpoint->mode.y == modeAbs && setpoint->mode.z == modeAbs;\n    \
             /* {prefix}_RATE does not divide the rate of the task: the evaluations are spread evenly. */\n    \
             const bool due = (step % STABILIZER_RATE) * {prefix}_RATE % STABILIZER_RATE < {prefix}_RATE;\n\n    \
             if (!has_target) {{\n        controllerOutOfTreeInit();\n    }} else if (due) {{\n        \
             float observation[{prefix}_OBSERVATION_SIZE];\n        float action[{prefix}_ACTION_SIZE];\n\n        \
             observe(state, sensors, setpoint, observation);\n        {name}_evaluate(observation, {memory}action);\n        \
             for (int motor = 0; motor < 4; motor++) {{\n            const float rpm = speed(action[motor_of[motor]]);\n            \
             const float share = THRUST_COEFFICIENT * rpm * rpm / THRUST_MAX;\n\n            \
             forces[motor] = share > 1.0f ? 1.0f : share;\n        }}\n    }}\n    \
             control->controlMode = controlModeForce;\n    for (int motor = 0; motor < 4; motor++) {{\n        \
             control->normalizedForces[motor] = forces[motor];\n    }}\n}}\n"
        );
        text
    }
}

#[cfg(test)]
mod tests {
    use aviary::drone::DroneModel;

    use super::*;

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
