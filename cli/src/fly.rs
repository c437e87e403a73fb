use std::path::{Path, PathBuf};
use std::time::Instant;

use anyhow::anyhow;
use aviary::control::{Controller, PidControl};
use aviary::drone::{DroneModel, DroneParams};
use aviary::env::{Env, Info};
use aviary::record::CsvLog;
use aviary::tasks::Hover;
use clap::Args;
use serde_json::{Value, json};

use crate::failure::Failure;
use crate::output::{self, OutputDir};

/// Fly a task with a built-in controller and report how well
///
/// Exit status 1 if a drone crashes.
#[derive(Debug, Args)]
#[command(
    after_help = "Examples:\n  aviary fly --task hover\n  aviary fly --task hover --drone race --out out/hover --json"
)]
pub struct Fly {
    /// Task to fly; `aviary tasks` lists them
    #[arg(long)]
    task: String,
    /// Airframe: cf2x, cf2p, race, or a TOML file with one of your own
    #[arg(long, default_value = "cf2x")]
    drone: String,
    /// Controller: pid
    #[arg(long, default_value = "pid")]
    controller: String,
    /// Simulated seconds; the task's episode by default
    #[arg(long, allow_negative_numbers = true)]
    duration: Option<f64>,
    /// Physics rate, Hz, a multiple of the control rate
    #[arg(long, default_value_t = 240)]
    sim_freq: u32,
    /// Control rate, Hz
    #[arg(long, default_value_t = 48)]
    ctrl_freq: u32,
    /// Seed of everything random
    #[arg(long, default_value_t = 0)]
    seed: u64,
    /// Directory for the flight's log (log.csv) and summary (summary.json)
    #[arg(long)]
    out: Option<PathBuf>,
    /// Print JSON instead of a table
    #[arg(long)]
    json: bool,
}

impl Fly {
    pub fn run(&self) -> Result<(), Failure> {
        let drone = drone(&self.drone)?;
        one_of("controller", &self.controller, &["pid"])?;
        let mut env = self.environment(drone)?;
        let out = self.out.as_deref().map(OutputDir::create).transpose()?;
        let flight = self.flight(&mut *env, out.as_ref())?;

        let summary = flight.json(&*env, self);
        if let Some(out) = &out {
            // what depends on the machine's speed stays out of the file: equal seeds give equal files
            let mut file = summary.clone();
            if let Some(object) = file.as_object_mut() {
                object.remove("wall_seconds");
            }
            out.write("summary.json", format!("{file:#}\n").as_bytes())?;
        }
        if self.json {
            output::print_json(&summary)?
        } else {
            output::print(&flight.table(&*env))?
        }
        match flight.info.end {
            Some(end) if end.is_crash() => {
                Err(Failure::work(anyhow!("the drone crashed ({end}) at t = {:.3} s", flight.info.time)))
            }
            _ => Ok(()),
        }
    }

    fn environment(&self, drone: DroneParams) -> Result<Box<dyn Env>, Failure> {
        one_of("task", &self.task, &aviary::tasks::all().iter().map(|task| task.name).collect::<Vec<_>>())?;
        let mut builder = Hover::builder().drone(drone).sim_freq(self.sim_freq).ctrl_freq(self.ctrl_freq);
        if let Some(seconds) = self.duration {
            builder = builder.episode_seconds(seconds);
        }
        Ok(Box::new(builder.build().map_err(Failure::input)?))
    }

    /// Flies one episode.
    fn flight(&self, env: &mut dyn Env, out: Option<&OutputDir>) -> Result<Flight, Failure> {
        let drones = env.simulation().num_drones();
        let dt = env.simulation().control_period();
        let mut controllers: Vec<_> =
            (0..drones).map(|drone| PidControl::new(env.simulation().params(drone))).collect();
        let mut speeds = vec![[0.0; 4]; drones];
        let mut action = vec![0.0; env.action_space().size()];
        let mut errors = Errors::default();
        let mut reward = 0.0;
        let mut log = out.map(|dir| Ok((dir, CsvLog::new(dir.begin()?).map_err(Failure::work)?))).transpose()?;

        let start = Instant::now();
        env.reset(Some(self.seed)).map_err(Failure::work)?;
        loop {
            if let Some((_, log)) = &mut log {
                log.record(env.simulation()).map_err(Failure::work)?;
            }
            for (drone, (controller, speeds)) in controllers.iter_mut().zip(&mut speeds).enumerate() {
                *speeds = controller.control(dt, &env.simulation().states()[drone], &env.reference(drone)).rpm;
            }
            env.action_of_motor_speeds(&speeds, &mut action).map_err(Failure::work)?;
            let step = env.step(&action).map_err(Failure::work)?;
            reward += step.reward;
            let over = step.terminated || step.truncated;
            errors.note(env);
            if over {
                break;
            }
        }
        let wall_seconds = start.elapsed().as_secs_f64();
        if let Some((dir, mut log)) = log {
            log.record(env.simulation()).map_err(Failure::work)?;
            dir.keep(log.finish().map_err(Failure::work)?, "log.csv")?;
        }
        Ok(Flight { info: env.info(), reward, wall_seconds, errors })
    }
}

/// Position errors over a flight, one entry per control step and drone.
#[derive(Debug, Default)]
struct Errors {
    /// Time of the step's end and the drone's distance from its reference.
    samples: Vec<(f64, f64)>,
}

impl Errors {
    fn note(&mut self, env: &dyn Env) {
        let simulation = env.simulation();
        for drone in 0..simulation.num_drones() {
            self.samples.push((simulation.time(), simulation.distance(drone, &env.reference(drone).position)));
        }
    }

    fn rms_since(&self, time: f64) -> f64 {
        let (sum, count) = (self.samples.iter())
            .filter(|(t, _)| *t >= time)
            .fold((0.0, 0_u32), |(sum, count), (_, error)| (sum + error * error, count + 1));
        (sum / f64::from(count.max(1))).sqrt()
    }

    fn peak(&self) -> f64 {
        self.samples.iter().map(|(_, error)| *error).fold(0.0, f64::max)
    }
}

/// How a flight went.
#[derive(Debug)]
struct Flight {
    info: Info,
    reward: f64,
    wall_seconds: f64,
    errors: Errors,
}

impl Flight {
    fn json(&self, env: &dyn Env, options: &Fly) -> Value {
        let simulation = env.simulation();
        let crashed = self.info.crashed();
        let drones: Vec<_> = (simulation.states().iter())
            .map(|state| json!({ "final_position": state.position.as_slice(), "crashed": crashed }))
            .collect();
        json!({
            "task": env.name(),
            "drone_model": simulation.params(0).name,
            "physics": "mjc",
            "engine": "mujoco",
            "controller": options.controller,
            "seed": options.seed,
            "success": self.info.success,
            "end": self.info.end.map(|end| end.name()),
            "reward": self.reward,
            "simulated_seconds": self.info.time,
            "wall_seconds": self.wall_seconds,
            "final_position_error": self.info.position_error,
            "rms_position_error": self.errors.rms_since(0.0),
            "rms_position_error_last_2s": self.errors.rms_since(self.info.time - 2.0),
            "peak_position_error": self.errors.peak(),
            "drones": drones,
        })
    }

    fn table(&self, env: &dyn Env) -> String {
        let centimetres = |metres: f64| format!("{:.2} cm", 100.0 * metres);
        let success = match (self.info.success, self.info.end) {
            (true, _) => "yes".to_string(),
            (false, Some(end)) => format!("no ({end})"),
            (false, None) => "no".to_string(),
        };
        output::table(&[
            ("task", format!("{} with {}", env.name(), env.simulation().params(0).name)),
            ("success", success),
            ("final position error", centimetres(self.info.position_error)),
            ("RMS position error, last 2 s", centimetres(self.errors.rms_since(self.info.time - 2.0))),
            ("reward", format!("{:.2}", self.reward)),
            ("simulated time", format!("{:.2} s", self.info.time)),
            ("simulated s per wall s", format!("{:.0}", self.info.time / self.wall_seconds.max(1e-9))),
        ])
    }
}

/// A built-in airframe by name, or one from a file.
fn drone(name: &str) -> Result<DroneParams, Failure> {
    if let Ok(model) = name.parse::<DroneModel>() {
        return Ok(model.params());
    }
    if Path::new(name).extension().is_some_and(|extension| extension == "toml") {
        return DroneParams::from_file(name).map_err(Failure::input);
    }
    let models: Vec<_> = DroneModel::ALL.iter().map(|model| model.name()).collect();
    one_of("drone", name, &models)?;
    Err(Failure::input(anyhow!("--drone is `{name}`")))
}

/// Refuses a name that is not in the list, with the nearest one that is.
fn one_of(option: &str, name: &str, names: &[&str]) -> Result<(), Failure> {
    if names.contains(&name) {
        return Ok(());
    }
    let near = names
        .iter()
        .map(|candidate| (strsim::jaro_winkler(name, candidate), candidate))
        .filter(|(likeness, _)| *likeness > 0.7)
        .max_by(|a, b| a.0.total_cmp(&b.0))
        .map(|(_, candidate)| format!("; did you mean `{candidate}`?"))
        .unwrap_or_default();
    Err(Failure::input(anyhow!("--{option} is `{name}`, expected one of: {}{near}", names.join(", "))))
}
