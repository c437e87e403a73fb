//! Fuzz targets.

use aviary::control::trajectory;
use aviary::drone::{DroneModel, DroneParams};
use aviary::env::{Conditions, Env as _, EnvConfig, Rng};
use aviary::flights::{self, CrazyflieLog};
use aviary::physics::Physics;
use aviary::physics::wind::{WindConfig, WindModel};
use aviary::policy::PolicyNetwork;
use aviary::record::{Flight, RecordError, Scenario, read_actions};
use aviary::simulation::{SimData, Simulation};
use aviary::tasks;
use aviary::world::{Obstacle, ObstacleConfig, Shape, check_obj};
use learn::TrainConfig;
use mujoco_rs::{Assets, Data, Model};
use nalgebra::Vector3;
use rand_chacha::rand_core::SeedableRng as _;

/// Fuzz target: one kind of input.
#[derive(Debug, Clone, Copy)]
pub struct Target {
    /// Name in the command line and of the directory in `fuzz/corpus`.
    pub name: &'static str,
    /// Input format, and the checks of an accepted input.
    pub about: &'static str,
    /// Repository files that extend the corpus, relative to the repository root.
    pub more: &'static [&'static str],
    /// Processes an input; returns the error message of a rejected input. A panic is a finding.
    pub run: fn(&[u8]) -> Result<(), String>,
}

/// All targets.
pub static ALL: [Target; 14] = [
    Target { name: "actions", about: "motor speeds as CSV", more: &[], run: actions },
    Target {
        name: "airframe",
        about: "an airframe as TOML: round trip, then two control steps",
        more: &["assets/airframes/cf2x.toml", "assets/airframes/cf2p.toml", "assets/airframes/race.toml"],
        run: airframe,
    },
    Target {
        name: "conditions",
        about: "wind, obstacles and randomization as TOML: round trip, then two control steps",
        more: &[],
        run: conditions,
    },
    Target {
        name: "data",
        about: "data of a simulation as JSON: round trip, restored, then two control steps",
        more: &[],
        run: data,
    },
    Target { name: "flight", about: "a recorded flight as CSV", more: &[], run: flight },
    Target { name: "log", about: "a log of a Crazyflie, binary or CSV: its table", more: &[], run: log },
    Target { name: "mesh", about: "an OBJ mesh: compiled by MuJoCo if it is valid", more: &[], run: mesh },
    Target { name: "mjcf", about: "a scene as MJCF text: compiled and stepped", more: &[], run: mjcf },
    Target {
        name: "obstacles",
        about: "obstacles as TOML: round trip, then a flight among them",
        more: &[],
        run: obstacles,
    },
    Target {
        name: "policy",
        about: "a policy in safetensors: round trip, then one action",
        more: &["assets/policies/hover.safetensors"],
        run: policy,
    },
    Target {
        name: "recorded",
        about: "a recorded flight of a real drone as CSV: round trip, then the windows of a comparison",
        more: &[],
        run: recorded,
    },
    Target {
        name: "scenario",
        about: "the scenario of a replay as TOML: one control step",
        more: &[
            "tests/reference/mjc_cf2x.toml",
            "tests/reference/mjc_dw_close.toml",
            "tests/reference/body_fixed_cf2x.toml",
        ],
        run: scenario,
    },
    Target {
        name: "training",
        about: "a training configuration as TOML: validation, then a round trip",
        more: &["assets/policies/hover_randomized.toml", "assets/policies/disturbed.toml"],
        run: training,
    },
    Target { name: "trajectory", about: "a trajectory as TOML: sampled over its duration", more: &[], run: trajectory },
];

/// Returns the names of all targets.
pub fn names() -> impl Iterator<Item = &'static str> {
    ALL.iter().map(|target| target.name)
}

fn text(input: &[u8]) -> Result<&str, String> {
    std::str::from_utf8(input).map_err(|error| error.to_string())
}

fn message(error: impl std::fmt::Display) -> String {
    error.to_string()
}

fn actions(input: &[u8]) -> Result<(), String> {
    // the first byte determines the number of drones
    let drones = input.first().map_or(1, |byte| 1 + usize::from(byte % 3));
    let rows = read_actions(input.get(1..).unwrap_or_default(), drones).map_err(message)?;
    assert!(rows.iter().all(|row| row.len() == drones && row.iter().flatten().all(|x| x.is_finite())));
    Ok(())
}

fn airframe(input: &[u8]) -> Result<(), String> {
    let params = DroneParams::from_toml(text(input)?).map_err(message)?;
    let derived = [params.hover_rpm(), params.max_rpm(), params.max_thrust(), params.ground_effect_clip()];
    assert!(derived.iter().all(|x| x.is_finite() && *x >= 0.0), "{derived:?}");
    let written = toml::to_string(&params).map_err(message)?;
    assert_eq!(DroneParams::from_toml(&written).as_ref(), Ok(&params), "{written}");
    let hover = params.hover_rpm();
    let height = 2.0 * params.collision_height + params.collision_radius;
    let mut simulation =
        Simulation::builder(params).initial_positions([[0.0, 0.0, height]]).build().map_err(message)?;
    for _ in 0..2 {
        simulation.step(&[[hover; 4]]).map_err(message)?;
    }
    Ok(())
}

fn data(input: &[u8]) -> Result<(), String> {
    let ball = Obstacle::new(Shape::Sphere { radius: 0.2 }, Vector3::new(3.0, 0.0, 1.0));
    let wind = WindConfig::new(WindModel::Combined);
    let builder = Simulation::builder(DroneModel::Cf2x).num_drones(2).physics(Physics::MjcGndDragDw);
    let mut simulation = builder.obstacles([ball]).wind(wind).build().map_err(message)?;
    let mut value: serde_json::Value = serde_json::from_str(text(input)?).map_err(message)?;
    // replace the fingerprint by that of this simulation, so that data of all versions pass it
    let own = serde_json::to_value(simulation.snapshot()).map_err(message)?;
    value.as_object_mut().ok_or("no object")?.insert("model".into(), own["model"].clone());
    let data: SimData = serde_json::from_value(value).map_err(message)?;
    let written = serde_json::to_string(&data).map_err(message)?;
    let read: SimData = serde_json::from_str(&written).map_err(message)?;
    assert_eq!(serde_json::to_string(&read).map_err(message)?, written);
    simulation.restore(&read).map_err(message)?;
    for _ in 0..2 {
        simulation.step(&[[14_000.0; 4]; 2]).map_err(message)?;
    }
    Ok(())
}

fn conditions(input: &[u8]) -> Result<(), String> {
    let conditions = Conditions::from_toml(text(input)?).map_err(message)?;
    let written = toml::to_string(&conditions).map_err(message)?;
    assert_eq!(Conditions::from_toml(&written).as_ref(), Ok(&conditions), "{written}");
    let mut env = tasks::make("hover", EnvConfig::default().conditions(&conditions)).map_err(message)?;
    env.reset(Some(1)).map_err(message)?;
    for _ in 0..2 {
        env.step(&[0.0; 4]).map_err(message)?;
    }
    Ok(())
}

fn flight(input: &[u8]) -> Result<(), String> {
    let file = tempfile::NamedTempFile::new().map_err(message)?;
    std::fs::write(file.path(), input).map_err(message)?;
    // the file name differs in every run
    let nameless = |error: RecordError| error.to_string().replace(&*file.path().to_string_lossy(), "");
    let flight = Flight::read(file.path()).map_err(nameless)?;
    assert!(flight.drones.iter().flatten().all(|sample| sample.state.is_finite()));
    Ok(())
}

fn log(input: &[u8]) -> Result<(), String> {
    let mut input = input.to_vec();
    // a valid checksum, so that mutations reach the parser
    if let (Some(0xBC), Some((content, _))) = (input.first(), input.split_last_chunk::<4>()) {
        let checksum = crc32fast::hash(content).to_le_bytes();
        let end = content.len();
        input[end..].copy_from_slice(&checksum);
    }
    let log = CrazyflieLog::from_bytes("log", &input).map_err(message)?;
    let table = log.table("log", 0.01).map_err(message)?;
    assert!(table.rows() > 0 && table.column("t").is_some_and(|times| times.iter().all(|time| time.is_finite())));
    Ok(())
}

fn mesh(input: &[u8]) -> Result<(), String> {
    check_obj(input)?;
    let scene = "<mujoco><asset><mesh name='m' file='m.obj'/></asset>\
        <worldbody><geom type='mesh' mesh='m' contype='0' conaffinity='0'/></worldbody></mujoco>";
    let model = Model::from_xml_with_assets(scene, &Assets::new().with("m.obj", input)).map_err(message)?;
    let numbers = model.mesh_vert().iter().chain(model.mesh_normal());
    assert!(numbers.copied().all(f32::is_finite));
    Ok(())
}

fn mjcf(input: &[u8]) -> Result<(), String> {
    let text = text(input)?;
    // other targets cover the content of files
    if text.contains("file") || text.contains("dir") {
        return Err("the scene refers to files".into());
    }
    let mut data = Data::new(Model::from_xml(text).map_err(message)?).map_err(message)?;
    for _ in 0..3 {
        data.step().map_err(message)?;
    }
    let _ = data.ray([0.1, 0.2, 3.0], [0.1, 0.0, -1.0], [true; 6], None).map_err(message)?;
    Ok(())
}

fn obstacles(input: &[u8]) -> Result<(), String> {
    let config: ObstacleConfig = toml::from_str(text(input)?).map_err(|error| error.message().to_string())?;
    config.validate().map_err(message)?;
    let written = toml::to_string(&config).map_err(message)?;
    assert_eq!(toml::from_str(&written).as_ref(), Ok(&config), "{written}");
    let start = [0.0, 0.0, 0.5];
    let obstacles = config.generate(&[start], &mut Rng::seed_from_u64(1)).map_err(message)?;
    let mut simulation = Simulation::builder(DroneModel::Cf2x)
        .initial_positions([start])
        .initial_velocities([[1.0, 0.5, -2.0]])
        .obstacles(obstacles)
        .build()
        .map_err(message)?;
    for _ in 0..3 {
        simulation.step(&[[10_000.0; 4]]).map_err(message)?;
    }
    Ok(())
}

fn policy(input: &[u8]) -> Result<(), String> {
    let policy = PolicyNetwork::from_bytes(input).map_err(message)?;
    let mut action = vec![0.0; policy.action_size()];
    let mut memory = vec![0.0; policy.memory_size()];
    policy.forward_with(&vec![0.5; policy.observation_size()], &mut memory, &mut action);
    let written = policy.to_bytes().map_err(message)?;
    assert_eq!(PolicyNetwork::from_bytes(&written).and_then(|again| again.to_bytes()).as_ref(), Ok(&written));
    Ok(())
}

fn recorded(input: &[u8]) -> Result<(), String> {
    let flight = flights::Flight::from_csv("recorded", input).map_err(message)?;
    let mut written = Vec::new();
    flight.write(&mut written).map_err(message)?;
    let again = flights::Flight::from_csv("recorded", &written[..]).map_err(message)?;
    assert_eq!((again.rows(), again.missing()), (flight.rows(), flight.missing()));
    assert_eq!((&again.position, &again.velocity, &again.duty), (&flight.position, &flight.velocity, &flight.duty));
    // a flight of some rows is valid, and too short for a window
    let _ = flights::Window::of(&flight);
    Ok(())
}

fn scenario(input: &[u8]) -> Result<(), String> {
    let scenario = Scenario::from_toml(text(input)?).map_err(message)?;
    if scenario.drone_model.ends_with(".toml") {
        return Err("the scenario refers to an airframe file".into());
    }
    // skip inputs that would take seconds: many drones, and many physics steps
    if scenario.num_drones > 8 && scenario.num_drones <= Simulation::MAX_DRONES {
        return Err("many drones".into());
    }
    let mut simulation = scenario.simulation().map_err(message)?;
    if simulation.substeps() <= 100 {
        let commands = vec![[12_000.0; 4]; simulation.num_drones()];
        simulation.step(&commands).map_err(message)?;
    }
    Ok(())
}

fn training(input: &[u8]) -> Result<(), String> {
    let mut config = TrainConfig::of_task("hover").map_err(message)?;
    config.read_toml(text(input)?).map_err(message)?;
    config.validate().map_err(message)?;
    let written = config.to_toml().map_err(message)?;
    let mut again = TrainConfig::of_task("hover").map_err(message)?;
    again.read_toml(&written).unwrap_or_else(|error| panic!("{error}\n{written}"));
    assert_eq!(again.to_toml().as_deref().ok(), Some(&*written));
    Ok(())
}

fn trajectory(input: &[u8]) -> Result<(), String> {
    let trajectory = trajectory::from_toml(text(input)?).map_err(message)?;
    let duration = trajectory.duration();
    for part in 0..=20 {
        let reference = trajectory.reference(duration * f64::from(part) / 20.0);
        assert!(reference.position.iter().all(|x| x.is_finite()), "{reference:?}");
    }
    Ok(())
}
