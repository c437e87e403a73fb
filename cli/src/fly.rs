use std::collections::VecDeque;
use std::path::PathBuf;
use std::time::Instant;

use anyhow::anyhow;
use aviary::control::ControllerKind;
use aviary::env::{Env, Info};
use aviary::record::CsvLog;
use aviary::record::picture::GifAnimation;
use aviary::vision::{ImageSize, View};
use clap::Args;
use serde_json::{Value, json};

use crate::failure::Failure;
use crate::options::{FlightOptions, named, size, vision_failure};
use crate::output::{self, OutputDir, OutputFile};
use crate::pilot::Pilot;

/// Fly a task with a built-in controller and report how well
///
/// Exit status 1 if a drone crashes.
#[derive(Debug, Args)]
#[command(after_help = "Examples:
  aviary fly --task hover
  aviary fly --task hover --drone race --out out/hover --json
  aviary fly --task hover --controller geometric --trajectory circle
  aviary fly --task hover --wind combined --obstacles forest
  aviary fly --task hover --duration 3 --gif out/hover.gif --camera front")]
pub struct Fly {
    #[command(flatten)]
    options: FlightOptions,
    /// Directory for the flight's log (log.csv) and summary (summary.json)
    #[arg(long)]
    out: Option<PathBuf>,
    /// Animation to write
    #[arg(long)]
    gif: Option<PathBuf>,
    /// Camera of the animation: track, fpv, fixed, front, top
    #[arg(long, default_value = "track", requires = "gif")]
    camera: String,
    /// Size of the animation, pixels
    #[arg(long, value_parser = size, default_value = "320x240", requires = "gif")]
    size: ImageSize,
    /// Print JSON instead of a table
    #[arg(long)]
    json: bool,
}

impl Fly {
    pub fn run(&self) -> Result<(), Failure> {
        let view = named::<View>("camera", &self.camera, &View::ALL.map(View::name))?;
        let mut pilot = Pilot::new(&self.options)?;
        let out = self.out.as_deref().map(OutputDir::create).transpose()?;
        let film = self.gif.as_deref().map(|path| Film::begin(OutputFile::begin(path)?, &pilot, view, self.size));
        let flight = self.flight(&mut pilot, out.as_ref(), film.transpose()?)?;

        let summary = flight.json(pilot.env(), &self.options);
        if let Some(out) = &out {
            // what depends on the machine's speed stays out of the file: equal seeds give equal files
            let mut file = summary.clone();
            if let Some(object) = file.as_object_mut() {
                object.remove("wall_seconds");
            }
            out.write("summary.json", format!("{file:#}\n").as_bytes())?;
        }
        if self.json {
            output::print_json(&summary)?;
        } else {
            output::print(&flight.table(pilot.env()))?;
        }
        match flight.info.end {
            Some(end) if end.is_crash() => {
                let env = pilot.env();
                let drones = env.simulation().num_drones();
                let lost = (0..drones).find(|&drone| env.drone_end(drone).is_some_and(|end| end.is_crash()));
                let which = lost.filter(|_| drones > 1).map_or("the drone".into(), |drone| format!("drone {drone}"));
                Err(Failure::work(anyhow!("{which} crashed ({end}) at t = {:.3} s", flight.info.time)))
            }
            _ => Ok(()),
        }
    }

    /// Flies one episode.
    fn flight(&self, pilot: &mut Pilot, out: Option<&OutputDir>, mut film: Option<Film>) -> Result<Flight, Failure> {
        let mut log = match out {
            Some(dir) => Some(CsvLog::new(dir.begin("log.csv")?.into_writer()).map_err(Failure::work)?),
            None => None,
        };
        let steps = pilot.env().episode_steps();
        let bar = output::progress(steps, "flying");
        let mut errors = Errors::default();
        let mut reward = 0.0;
        let mut wall_seconds = 0.0;
        loop {
            if let Some(log) = &mut log {
                log.record(pilot.env().simulation()).map_err(Failure::work)?;
            }
            if let Some(film) = &mut film {
                film.look(pilot.env_mut())?;
            }
            let start = Instant::now();
            let flown = pilot.step()?;
            wall_seconds += start.elapsed().as_secs_f64();
            reward += flown.reward;
            errors.note(pilot);
            if pilot.env().simulation().control_steps().is_multiple_of(64) {
                bar.set_position(pilot.env().simulation().control_steps());
            }
            if flown.over {
                break;
            }
        }
        bar.finish_and_clear();
        if let Some(mut log) = log {
            log.record(pilot.env().simulation()).map_err(Failure::work)?;
            log.finish().map_err(Failure::work)?.keep()?;
        }
        if let Some(film) = film {
            film.finish(pilot.env_mut())?;
        }
        let mut info = pilot.env().info();
        if pilot.has_plan() {
            // the error that is told is that from the way flown
            info.position_error = pilot.position_error();
        }
        if pilot.trajectory().is_some() {
            // the trajectory, not the task, says where to be
            info.position_error = pilot.position_error();
            info.progress = 1.0;
            info.success = !info.crashed() && info.position_error < ON_TRAJECTORY;
        }
        Ok(Flight { controller: pilot.kind(), info, reward, wall_seconds, errors })
    }
}

/// Position error below which a flight along a trajectory has ended where it should, m.
const ON_TRAJECTORY: f64 = 0.05;

/// An animation being made: a frame every so many control steps, about 24 a second.
struct Film {
    animation: GifAnimation<output::FileWriter>,
    view: View,
    size: ImageSize,
    every: u64,
    next: u64,
    rgb: Vec<u8>,
}

impl Film {
    fn begin(file: OutputFile, pilot: &Pilot, view: View, size: ImageSize) -> Result<Self, Failure> {
        let simulation = pilot.env().simulation();
        let every = u64::from((simulation.ctrl_freq() / 24).max(1));
        let seconds = every as f64 * simulation.control_period();
        let animation = GifAnimation::new(file.into_writer(), size, seconds).map_err(Failure::work)?;
        Ok(Self { animation, view, size, every, next: 0, rgb: vec![0; 3 * size.pixels()] })
    }

    /// Takes a frame if it is time for one.
    fn look(&mut self, env: &mut dyn Env) -> Result<(), Failure> {
        if env.simulation().control_steps() < self.next {
            return Ok(());
        }
        self.next += self.every;
        self.frame(env)
    }

    fn frame(&mut self, env: &mut dyn Env) -> Result<(), Failure> {
        env.render(self.view, self.size, &mut self.rgb).map_err(vision_failure)?;
        self.animation.frame(&self.rgb).map_err(Failure::work)
    }

    /// Adds the last moment and gives the file its name.
    fn finish(mut self, env: &mut dyn Env) -> Result<(), Failure> {
        self.frame(env)?;
        self.animation.finish().map_err(Failure::work)?.keep()
    }
}

/// Position errors over a flight, one sample per control step and drone.
#[derive(Debug, Default)]
struct Errors {
    sum: f64,
    squares: f64,
    count: u64,
    peak: f64,
    /// Times and squared errors of the last two seconds.
    recent: VecDeque<(f64, f64)>,
}

impl Errors {
    fn note(&mut self, pilot: &Pilot) {
        let simulation = pilot.env().simulation();
        let time = simulation.time();
        for drone in 0..simulation.num_drones() {
            let error = simulation.distance(drone, &pilot.reference(drone).position);
            self.sum += error;
            self.squares += error * error;
            self.count += 1;
            self.peak = self.peak.max(error);
            self.recent.push_back((time, error * error));
        }
        while self.recent.front().is_some_and(|(t, _)| *t < time - 2.0) {
            self.recent.pop_front();
        }
    }

    fn mean(&self) -> f64 {
        self.sum / self.count.max(1) as f64
    }

    fn rms(&self) -> f64 {
        (self.squares / self.count.max(1) as f64).sqrt()
    }

    fn rms_last_2s(&self) -> f64 {
        let sum: f64 = self.recent.iter().map(|(_, square)| square).sum();
        (sum / self.recent.len().max(1) as f64).sqrt()
    }
}

/// How a flight went.
#[derive(Debug)]
struct Flight {
    controller: ControllerKind,
    info: Info,
    reward: f64,
    wall_seconds: f64,
    errors: Errors,
}

impl Flight {
    fn json(&self, env: &dyn Env, options: &FlightOptions) -> Value {
        let simulation = env.simulation();
        let drones: Vec<_> = (simulation.states().iter().enumerate())
            .map(|(drone, state)| {
                let crashed = env.drone_end(drone).is_some_and(|end| end.is_crash());
                json!({ "final_position": state.position.as_slice(), "crashed": crashed })
            })
            .collect();
        let mut measures: serde_json::Map<_, _> =
            env.info_map().into_iter().map(|(name, value)| (name.to_string(), json!(value))).collect();
        // where a trajectory or a plan is followed, these are about it
        for (name, value) in self.info.values() {
            measures.insert(name.into(), json!(value));
        }
        json!({
            "task": env.name(),
            "drone_model": simulation.params(0).name,
            "physics": simulation.physics().name(),
            "engine": simulation.engine().name(),
            "controller": self.controller.name(),
            "trajectory": options.trajectory,
            "seed": options.seed,
            "wind": simulation.wind().map_or("none", |wind| wind.model.name()),
            "obstacles": simulation.world().obstacles.len(),
            "success": self.info.success,
            "end": self.info.end.map(|end| end.name()),
            "reward": self.reward,
            "simulated_seconds": self.info.time,
            "wall_seconds": self.wall_seconds,
            "final_position_error": self.info.position_error,
            "rms_position_error": self.errors.rms(),
            "rms_position_error_last_2s": self.errors.rms_last_2s(),
            "mean_position_error": self.errors.mean(),
            "peak_position_error": self.errors.peak,
            "progress": self.info.progress,
            "info": measures,
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
        let mut measures: Vec<_> = Vec::new();
        env.measures(&mut |name, value| measures.push((name.replace('_', " "), format!("{value:.3}"))));
        let mut rows = vec![
            (
                "task",
                format!("{} with {} {}", env.name(), env.simulation().num_drones(), env.simulation().params(0).name),
            ),
            ("controller", self.controller.to_string()),
            ("physics", env.simulation().physics().to_string()),
            ("engine", env.simulation().engine().name().to_string()),
            ("success", success),
            ("final position error", centimetres(self.info.position_error)),
            ("RMS position error, last 2 s", centimetres(self.errors.rms_last_2s())),
            ("mean position error", centimetres(self.errors.mean())),
            ("peak position error", centimetres(self.errors.peak)),
            ("reward", format!("{:.2}", self.reward)),
            ("simulated time", format!("{:.2} s", self.info.time)),
            ("simulated s per wall s", format!("{:.0}", self.info.time / self.wall_seconds.max(1e-9))),
        ];
        rows.extend(measures.iter().map(|(name, value)| (&**name, value.clone())));
        output::table(&rows)
    }
}
