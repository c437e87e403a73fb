use std::fs;
use std::path::{Path, PathBuf};

use anyhow::{Context as _, anyhow};
use aviary::control::ControllerKind;
use aviary::physics::wind::WindConfig;
use aviary::record::{CsvLog, ObstaclePose, RecordError, Scenario, read_motor_speeds, read_obstacle_poses};
use aviary::simulation::Simulation;
use clap::{Args, ValueHint};
use indicatif::ProgressBar;
use nalgebra::Vector3;
use serde_json::json;
use viewer::{Flown, LiveFlight, PilotMode, Source, Turn, Viewer, ViewerOptions};

use crate::failure::Failure;
use crate::output::{self, OutputFile};

/// Fly recorded motor speeds in open loop and write the states
///
/// `aviary fly --out DIR` writes DIR/scenario.toml and the log. The output has one row per
/// control step and drone, after the step, with the columns of a log up to the motor speeds.
/// The replay of a log in its own scenario is bit-exact.
#[derive(Debug, Args)]
#[command(verbatim_doc_comment)]
#[command(after_help = "Examples:
  aviary replay --scenario tests/reference/mjc_cf2x.toml \\
    --actions tests/reference/mjc_cf2x.actions.csv --out out/flight.csv
  aviary replay --scenario out/hover/scenario.toml --actions out/hover --out out/again.csv --view")]
pub struct Replay {
    /// Scenario of the flight (TOML)
    #[arg(long, value_name = "FILE", value_hint = ValueHint::FilePath)]
    scenario: PathBuf,
    /// Motor speeds: a flight's directory, its log files or a table (CSV)
    ///
    /// The log files are drone0.csv, drone1.csv, …, or the output of this command. A table has
    /// the columns drone0_rpm0,drone0_rpm1,… (rpm) and one row per control step.
    #[arg(
        long,
        verbatim_doc_comment,
        value_name = "PATH",
        value_hint = ValueHint::AnyPath,
        num_args = 1..,
        required = true
    )]
    actions: Vec<PathBuf>,
    /// Output file (CSV)
    #[arg(long, value_name = "FILE", value_hint = ValueHint::FilePath)]
    out: PathBuf,
    /// Window that shows the flight in real time
    ///
    /// Space pauses the flight, H lists the keys. The flight goes on without the window when it
    /// is closed.
    #[arg(long, verbatim_doc_comment)]
    view: bool,
    /// JSON output instead of a table
    #[arg(long)]
    json: bool,
}

impl Replay {
    pub fn run(&self) -> Result<(), Failure> {
        let text = read(&self.scenario)?;
        let scenario = Scenario::from_toml(&text).map_err(|error| in_file(&self.scenario, error))?;
        let simulation = scenario.simulation().map_err(|error| in_file(&self.scenario, error))?;
        let actions = read_motor_speeds(&self.actions, scenario.num_drones, scenario.ctrl_freq);
        let actions = actions.map_err(Failure::input)?;
        let poses = self.obstacle_poses(&scenario)?;

        let file = OutputFile::begin_apart(&self.out, self.inputs())?;
        let mut log = CsvLog::new(file.into_writer()).map_err(Failure::work)?;
        let mut live = if self.view { Some(self.open(&simulation)?) } else { None };
        let mut moving = poses.iter().peekable();
        let mut obstacles = simulation.obstacles().to_vec();
        let mut flight = ReplayedFlight { simulation };
        let bar = if self.view { ProgressBar::hidden() } else { output::progress(actions.len() as u64, "flying") };
        let unwritten = |error: RecordError| Failure::Work(anyhow!(error).context(self.out.display().to_string()));
        for (index, row) in actions.iter().enumerate() {
            live = live.and_then(|window| flight.show(window));
            flight.simulation.step(row).map_err(|error| {
                let step = index + 1;
                Failure::Work(anyhow!("{}: control step {step}: {error}", self.actions[0].display()))
            })?;
            if scenario.moving_obstacles > 0 {
                let (time, half) = (flight.simulation.time(), 0.5 * flight.simulation.control_period());
                let before = moving.len();
                while let Some(moved) = moving.next_if(|moved| (moved.time - time).abs() < half) {
                    let body = &mut obstacles[moved.obstacle];
                    (body.position, body.rpy) = (moved.pose.position, moved.pose.rpy);
                }
                if moving.len() == before {
                    return Err(Failure::input(anyhow!(
                        "{}: obstacles.csv has no row at t = {} s, expected one of every control step",
                        self.actions[0].display(),
                        output::decimals(time, 4)
                    )));
                }
                flight.simulation.move_obstacles(&obstacles).map_err(Failure::input)?;
            }
            log.record(&flight.simulation).map_err(unwritten)?;
            bar.inc(1);
        }
        if let Some(Err(error)) = live.as_mut().map(|window| window.show_end(&flight)) {
            tracing::warn!("{error}; the last state is not shown");
        }
        bar.finish_and_clear();
        log.finish().map_err(unwritten)?.keep()?;
        let simulation = &flight.simulation;
        if self.json {
            let positions: Vec<_> = simulation.states().iter().map(|state| state.position.as_slice()).collect();
            return output::print_json(&json!({
                "drone_model": scenario.drone_model,
                "physics": simulation.physics(),
                "effects": simulation.effects().to_string(),
                "engine": simulation.engine().name(),
                "control_steps": actions.len(),
                "simulated_seconds": simulation.time(),
                "final_positions": positions,
                "files": [self.out.to_string_lossy()],
            }));
        }
        output::print(&output::table(&[
            ("drones", format!("{} {}", simulation.num_drones(), scenario.drone_model)),
            ("physics", output::physics(simulation)),
            ("engine", simulation.engine().name().to_string()),
            ("control steps", actions.len().to_string()),
            ("simulated time", format!("{:.2} s", simulation.time())),
        ]))?;
        output::print_written(std::slice::from_ref(&self.out))
    }

    /// Returns the input files, with those of a flight's directory.
    fn inputs(&self) -> Vec<PathBuf> {
        let of_directory = |path: &PathBuf| [aviary::record::files(path), vec![path.join("obstacles.csv")]].concat();
        let logs = self.actions.iter().flat_map(of_directory);
        [&self.scenario].into_iter().chain(&self.actions).cloned().chain(logs).collect()
    }

    /// Reads the poses of the moving obstacles of the scenario.
    fn obstacle_poses(&self, scenario: &Scenario) -> Result<Vec<ObstaclePose>, Failure> {
        if scenario.moving_obstacles == 0 {
            return Ok(Vec::new());
        }
        let [directory] = &self.actions[..] else {
            return Err(self.needs_directory());
        };
        if !directory.is_dir() {
            return Err(self.needs_directory());
        }
        let poses = read_obstacle_poses(directory).map_err(Failure::input)?;
        let all = scenario.obstacles.as_ref().map_or(0, |obstacles| obstacles.custom.len());
        let moving = all - scenario.moving_obstacles.min(all)..all;
        if let Some(pose) = poses.iter().find(|pose| !moving.contains(&pose.obstacle)) {
            return Err(Failure::input(anyhow!(
                "{}: obstacles.csv has obstacle {}, expected one of the moving obstacles {} to {}",
                directory.display(),
                pose.obstacle,
                moving.start,
                all - 1
            )));
        }
        Ok(poses)
    }

    fn needs_directory(&self) -> Failure {
        Failure::input(anyhow!(
            "{}: the scenario has moving obstacles, expected the flight's directory with obstacles.csv",
            self.actions[0].display()
        ))
    }

    /// Opens the window.
    fn open(&self, simulation: &Simulation) -> Result<Live, Failure> {
        let name = self.scenario.file_name().unwrap_or(self.scenario.as_os_str()).to_string_lossy();
        let options = ViewerOptions { title: format!("aviary: replay of {name}"), ..ViewerOptions::default() };
        let viewer = Viewer::open_simulation(simulation, options).map_err(Failure::work)?;
        Ok(LiveFlight::new(viewer, None, false))
    }
}

/// Flight of recorded motor speeds, for a window.
struct ReplayedFlight {
    simulation: Simulation,
}

/// Window of a replay.
type Live = LiveFlight<<ReplayedFlight as Flown>::Saved>;

impl ReplayedFlight {
    /// Shows the state and waits until the next control step is due. Returns the window while it is open.
    fn show(&mut self, mut window: Live) -> Option<Live> {
        match window.turn(self, false) {
            Ok(Turn::Closed) => None,
            Ok(_) => Some(window),
            Err(error) => {
                // the flight does not need its window
                tracing::warn!("{error}; the flight goes on without a window");
                None
            }
        }
    }
}

/// Message of a command that would change a replay.
const FIXED: &str = "a replay cannot be changed";

impl Flown for ReplayedFlight {
    type Saved = ();

    fn source(&self) -> Source<'_> {
        Source::Simulation(&self.simulation)
    }

    fn pilot(&self) -> String {
        "recorded motor speeds".into()
    }

    fn save(&self) -> Self::Saved {}

    fn restore(&mut self, (): &Self::Saved) -> Result<(), String> {
        Err(FIXED.into())
    }

    fn restart(&mut self, _: Option<u64>) -> Result<(), String> {
        Err(FIXED.into())
    }

    fn set_force(&mut self, _: usize, _: Vector3<f64>) -> Result<(), String> {
        Err(FIXED.into())
    }

    fn set_wind(&mut self, _: Option<WindConfig>) -> Result<(), String> {
        Err(FIXED.into())
    }

    fn new_obstacles(&mut self, _: u64) -> Result<(), String> {
        Err(FIXED.into())
    }

    fn set_motor_gain(&mut self, _: usize, _: usize, _: f64) -> Result<(), String> {
        Err(FIXED.into())
    }

    fn set_controller(&mut self, _: ControllerKind) -> Result<(), String> {
        Err(FIXED.into())
    }

    fn take(&mut self, _: usize, _: Option<PilotMode>) -> Result<(), String> {
        Err(FIXED.into())
    }

    fn set_sticks(&mut self, _: usize, _: [f64; 4]) {}
}

fn read(path: &Path) -> Result<String, Failure> {
    fs::read_to_string(path).with_context(|| path.display().to_string()).map_err(Failure::Input)
}

fn in_file(path: &Path, error: impl std::fmt::Display) -> Failure {
    Failure::Input(anyhow!("{}: {error}", path.display()))
}
