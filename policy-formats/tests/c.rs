//! Generated C, compiled by the machine's compiler.

mod common;

use std::io::{Read as _, Write as _};
use std::path::Path;
use std::process::{Child, Command, Stdio};

use aviary::action::ActionType;
use aviary::drone::{DroneModel, DroneParams, YawConvention};
use aviary::env::{DroneEnv as _, Env as _};
use aviary::policy::PolicyNetwork;
use aviary::tasks::Hover;
use policy_formats::c::{FirmwareOptions, Weights, firmware, source};
use policy_formats::quantization::rounded;

/// Options that the generated code passes without a warning.
const STRICT: [&str; 6] = ["-std=c99", "-Wall", "-Wextra", "-Werror", "-pedantic", "-O2"];

/// Number of observations of a comparison.
const ROWS: usize = 100_000;

fn compile(directory: &Path, arguments: &[&str]) {
    let output = Command::new("cc").current_dir(directory).args(arguments).output().unwrap();
    assert!(output.status.success(), "{arguments:?}: {}", String::from_utf8_lossy(&output.stderr));
}

/// Compiles the code of a policy, and returns its actions for observations.
fn evaluate(policy: &PolicyNetwork, weights: Weights, observations: &[f32]) -> Vec<f32> {
    let directory = tempfile::tempdir().unwrap();
    let code = source(policy, "trained", weights).unwrap();
    std::fs::write(directory.path().join("trained.h"), &code.header).unwrap();
    std::fs::write(directory.path().join("trained.c"), &code.source).unwrap();
    std::fs::write(directory.path().join("main.c"), include_str!("main.c")).unwrap();
    std::fs::write(directory.path().join("in"), observations.iter().flat_map(|x| x.to_le_bytes()).collect::<Vec<_>>())
        .unwrap();
    compile(directory.path(), &[&STRICT[..], &["trained.c", "main.c", "-o", "main"]].concat());
    let input = std::fs::File::open(directory.path().join("in")).unwrap();
    let output = Command::new(directory.path().join("main")).stdin(input).output().unwrap();
    assert!(output.status.success());
    output.stdout.chunks_exact(4).map(|x| f32::from_le_bytes([x[0], x[1], x[2], x[3]])).collect()
}

#[test]
fn generated_code_computes_the_actions_of_the_policy_bit_for_bit() {
    let policies = ["hover", "race", "velocity", "hover_cf21"].map(common::asset);
    for policy in policies.into_iter().chain([common::random(), common::recurrent()]) {
        let observations = common::observations(&policy, ROWS);
        let expected = common::actions(&policy, &observations);
        let found = evaluate(&policy, Weights::Float32, &observations);
        assert_eq!(found.len(), ROWS * policy.action_size());
        // every operation is rounded as in `Mlp`
        let bits = |actions: &[f32]| actions.iter().map(|x| (x + 0.0).to_bits()).collect::<Vec<_>>();
        assert!(bits(&found) == bits(&expected), "{}", policy.info().task);
    }
}

#[test]
fn weights_of_eight_bits_compute_the_actions_of_the_rounded_policy() {
    for policy in [common::asset("hover"), common::asset("race"), common::random(), common::recurrent()] {
        let observations = common::observations(&policy, ROWS / 10);
        let expected = common::actions(&rounded(&policy).unwrap(), &observations);
        let found = evaluate(&policy, Weights::Int8, &observations);
        let (low, high) = policy.bounds();
        for (index, (found, expected)) in found.iter().zip(&expected).enumerate() {
            let component = index % policy.action_size();
            let range = high[component] - low[component];
            let scale = if range.is_finite() { range } else { 1.0 + expected.abs() };
            assert!((found - expected).abs() <= 2e-5 * scale, "{}: {found} {expected}", policy.info().task);
        }
    }
}

/// Cross-compiles for the processor of a Crazyflie, where the compiler is installed.
#[test]
fn generated_code_compiles_for_a_cortex_m4() {
    let compiler = "arm-none-eabi-gcc";
    if Command::new(compiler).arg("--version").output().is_err() {
        return;
    }
    let directory = tempfile::tempdir().unwrap();
    for weights in [Weights::Float32, Weights::Int8] {
        let code = source(&common::asset("hover"), "trained", weights).unwrap();
        std::fs::write(directory.path().join("trained.h"), &code.header).unwrap();
        std::fs::write(directory.path().join("trained.c"), &code.source).unwrap();
        let target = ["-mcpu=cortex-m4", "-mthumb", "-mfloat-abi=hard", "-mfpu=fpv4-sp-d16", "-ffreestanding"];
        // no conversion to double precision, which the processor does in software
        let arguments = [&STRICT[..], &target, &["-Wdouble-promotion", "-c", "trained.c", "-o", "trained.o"]].concat();
        let output = Command::new(compiler).current_dir(directory.path()).args(arguments).output().unwrap();
        assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    }
}

/// The application of a policy, compiled against the headers of `tests/crazyflie`.
struct Application {
    program: Child,
    _directory: tempfile::TempDir,
}

impl Application {
    fn new(policy: &PolicyNetwork, drone: &DroneParams) -> Self {
        let directory = tempfile::tempdir().unwrap();
        let options = FirmwareOptions { name: "trained", weights: Weights::Float32, drone, target: [0.0, 0.0, 1.0] };
        for file in firmware(policy, &options).unwrap() {
            let path = directory.path().join(&file.path);
            std::fs::create_dir_all(path.parent().unwrap()).unwrap();
            std::fs::write(path, file.content).unwrap();
        }
        let headers = std::env::current_dir().unwrap().join("tests/crazyflie");
        let (include, main) = (format!("-I{}", headers.display()), headers.join("main.c").display().to_string());
        let sources = ["src/trained.c", "src/trained_app.c", &main, "-o", "app", "-lm"];
        compile(directory.path(), &[&STRICT[..], &[&include], &sources].concat());
        let program = Command::new(directory.path().join("app")).stdin(Stdio::piped()).stdout(Stdio::piped()).spawn();
        Self { program: program.unwrap(), _directory: directory }
    }

    /// Makes one step of the stabilizer task, and returns the forces of M1 to M4.
    fn step(&mut self, input: [f32; 17]) -> [f32; 4] {
        let bytes: Vec<u8> = input.iter().flat_map(|x| x.to_le_bytes()).collect();
        self.program.stdin.as_mut().unwrap().write_all(&bytes).unwrap();
        let mut answer = [0; 16];
        self.program.stdout.as_mut().unwrap().read_exact(&mut answer).unwrap();
        std::array::from_fn(|motor| f32::from_le_bytes(answer[4 * motor..][..4].try_into().unwrap()))
    }
}

impl Drop for Application {
    fn drop(&mut self) {
        let _ = self.program.kill();
        let _ = self.program.wait();
    }
}

/// The application flies a drone whose propellers turn as those of the Crazyflie, from its estimate in its own frames,
/// to setpoints away from the origin and at another yaw. The policy was trained with propellers that turn the other
/// way.
#[test]
fn the_application_hovers_at_setpoints() {
    let trained_for = DroneModel::Cf2x.params();
    let real = DroneParams { yaw_convention: YawConvention::Reversed, ..trained_for.clone() };
    let policy = common::asset("hover");
    for (setpoint, yaw) in [([0.0, 0.0, 1.0], 0.0), ([0.4, -0.7, 1.5], 0.1), ([-0.2, 0.3, 0.8], -0.1)] {
        let mut app = Application::new(&policy, &trained_for);
        let start = [setpoint[0] - 0.15, setpoint[1] + 0.1, setpoint[2] - 0.2];
        let mut env = Hover::builder()
            .drone(real.clone())
            .action_type(ActionType::RawRpm)
            .initial_positions([start])
            .initial_rpys([[0.02, -0.03, yaw]])
            .sim_freq(1000)
            .ctrl_freq(1000)
            .build()
            .unwrap();
        env.reset(Some(1)).unwrap();
        // motors of the simulator at the places of M1 to M4: front right, back right, back left, front left
        let at = [3, 2, 1, 0];
        for _ in 0..8000 {
            let state = env.simulation().states()[0];
            let q = state.attitude.quaternion();
            let numbers = [state.position.x, state.position.y, state.position.z, q.w, q.i, q.j, q.k]
                .into_iter()
                .chain(state.velocity.iter().copied())
                .chain(state.angular_velocity.iter().map(|rate| rate.to_degrees()))
                .chain(setpoint)
                .chain([1.0]);
            let mut input = [0.0; 17];
            input.iter_mut().zip(numbers).for_each(|(input, x)| *input = x as f32);
            let forces = app.step(input);
            let mut action = [0.0; 4];
            for (force, motor) in forces.into_iter().zip(at) {
                action[motor] = (f64::from(force) * 0.16 / real.thrust_coefficient).sqrt();
            }
            env.step(&action).unwrap();
        }
        let state = env.simulation().states()[0];
        let error = (state.position - nalgebra::Vector3::from(setpoint)).norm();
        assert!(error < 0.05 && state.velocity.norm() < 0.1, "{setpoint:?}: {error} m, {:?}", state.position);
    }
}

/// The application of a recurrent policy keeps its memory between steps, and clears it with the motors.
#[test]
fn the_application_of_a_recurrent_policy_has_a_memory() {
    let mut app = Application::new(&common::recurrent(), &DroneModel::Cf2x.params());
    let mut input = [0.0; 17];
    (input[2], input[3], input[15], input[16]) = (0.9, 1.0, 1.0, 1.0);
    let fly = |app: &mut Application| (0..200).map(|_| app.step(input)).collect::<Vec<_>>();
    let first = fly(&mut app);
    assert_ne!(first[0], first[199], "the actions for equal observations depend on the memory");
    let mut stop = [0.0; 17];
    stop[3] = 1.0;
    // to a whole second, so that the evaluations have the same places
    for _ in 200..1000 {
        app.step(stop);
    }
    assert_eq!(fly(&mut app), first);
}

#[test]
fn the_application_stops_the_motors_without_a_position_setpoint() {
    let drone = DroneModel::Cf2x.params();
    let mut app = Application::new(&common::asset("hover"), &drone);
    let mut input = [0.0; 17];
    (input[2], input[3], input[15]) = (0.5, 1.0, 1.0);
    assert_eq!(app.step(input), [0.0; 4], "no setpoint");
    input[16] = 1.0;
    let flying: Vec<_> = (0..30).map(|_| app.step(input)).collect();
    assert!(flying[29].iter().all(|&force| force > 0.0 && force <= 1.0), "{flying:?}");
    // 48 evaluations per second in a task of 1000 Hz: the forces change only then
    input[2] = 0.9;
    let changes = (0..1000)
        .map(|step| {
            input[2] = 0.5 + 1e-4 * step as f32;
            app.step(input)
        })
        .collect::<Vec<_>>();
    let count = changes.windows(2).filter(|pair| pair[0] != pair[1]).count();
    assert!((46..=48).contains(&count), "{count}");
    input[16] = 0.0;
    assert_eq!(app.step(input), [0.0; 4]);
}

#[test]
fn policies_that_a_crazyflie_cannot_fly_are_errors() {
    let refused = |policy: &PolicyNetwork, drone: DroneModel| {
        let drone = drone.params();
        let options = FirmwareOptions { name: "a", weights: Weights::Float32, drone: &drone, target: [0.0, 0.0, 1.0] };
        firmware(policy, &options).unwrap_err().to_string()
    };
    assert!(refused(&common::asset("race"), DroneModel::Cf2x).contains("the task is `race`"));
    assert!(refused(&common::random(), DroneModel::Cf2x).contains("the task is `my task`"));
    assert!(refused(&common::asset("hover"), DroneModel::Cf2p).contains("layout"));
    let drone = DroneModel::Cf2x.params();
    let options = FirmwareOptions { name: "app", weights: Weights::Int8, drone: &drone, target: [0.0, 0.0, 1.0] };
    let shadowing = firmware(&common::asset("hover"), &options).unwrap_err().to_string();
    assert!(shadowing.contains("the name is `app`"), "{shadowing}");
}
