mod log;
mod result;

use std::path::{Path, PathBuf};
use std::time::Instant;

use anyhow::anyhow;
use aviary::env::DroneEnv;
use aviary::record::plot::Plot;
use aviary::record::{Flight as Samples, Scenario};
use clap::{Args, ValueHint};
use indicatif::ProgressBar;
use viewer::{Flown, LiveFlight, Turn, Viewer, ViewerError, ViewerOptions};

use crate::animation::{AnimationOptions, AnimationWriter};
use crate::failure::Failure;
use crate::options::FlightOptions;
use crate::output::{self, OutputDir};
use crate::pilot::Pilot;
use crate::rerun::{RerunOptions, RerunWriter};
use log::Log;
use result::{Errors, Flight, nominal};

/// Fly a task with a built-in controller and print the tracking error
///
/// The exit status is 1 if a drone crashes. Missing the goal is not an error.
#[derive(Debug, Args)]
#[command(verbatim_doc_comment)]
#[command(after_help = "Examples:
  aviary fly --task hover
  aviary fly --task hover --drone race --out out/hover --json
  aviary fly --task hover --controller geometric --trajectory circle
  aviary fly --task hover --wind combined --obstacles forest
  aviary fly --task race --drone race --out out/race --plot
  aviary fly --task hover --duration 3 --gif out/hover.gif --camera front
  aviary fly --task fly_through --gif out/gates.gif --overlay trails,references")]
pub struct Fly {
    #[command(flatten)]
    flight: FlightCommand,
    /// Window that shows the flight in real time
    ///
    /// Space pauses the flight, H lists the keys. The flight goes on without the window when it
    /// is closed. `aviary view` has a window in which the flight can be changed.
    #[arg(long, verbatim_doc_comment)]
    view: bool,
    #[command(flatten)]
    rerun: RerunOptions,
}

// not a doc comment, which would replace the description of a command: a flight with its output
#[derive(Debug, Args)]
pub struct FlightCommand {
    #[command(flatten)]
    pub options: FlightOptions,
    /// Directory for the log, the scenario and the summary
    ///
    /// The log is drone0.csv, drone1.csv, …, one file per drone. Each row is written during
    /// the flight, so that the log survives a crash of the program. scenario.toml is the
    /// scenario that `aviary replay` reads. summary.json has the results of the flight.
    #[arg(long, verbatim_doc_comment, value_name = "DIR", value_hint = ValueHint::DirPath)]
    out: Option<PathBuf>,
    /// Plots of the flight over time and of its path
    ///
    /// The files are flight.svg, flight.png, path.svg and path.png in the directory of --out,
    /// or in out/fly/TASK without --out.
    #[arg(long, verbatim_doc_comment)]
    plot: bool,
    #[command(flatten)]
    animation: AnimationOptions,
    /// JSON output instead of a table
    #[arg(long)]
    json: bool,
}

/// Window of a flight.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum InWindow {
    /// No window.
    No,
    /// The window shows the flight.
    Watched,
    /// The person at the window can change the flight and start further episodes.
    Changed,
}

impl Fly {
    pub fn run(&self) -> Result<(), Failure> {
        self.flight.run(if self.view { InWindow::Watched } else { InWindow::No }, &self.rerun)
    }
}

impl FlightCommand {
    pub fn run(&self, window: InWindow, rerun: &RerunOptions) -> Result<(), Failure> {
        self.animation.validate()?;
        rerun.validate()?;
        let mut pilot = Pilot::new(&self.options)?;
        pilot.validate(&self.options)?;
        // all files of a directory belong to one flight, so that plots and log have the same directory
        let default = self.plot.then(|| Path::new("out/fly").join(pilot.env().name()));
        let out = self.out.clone().or(default).as_deref().map(OutputDir::create).transpose()?;
        let kept = if self.animation.wants_preview(pilot.env().simulation()) { pilot.preview()? } else { Vec::new() };
        let mut animation = self.animation.begin(pilot.env().simulation(), &kept, |drone| pilot.path(drone))?;
        if let Some(animation) = animation.as_mut().filter(|_| window == InWindow::Changed) {
            animation.allow_rewind()?;
        }
        if let Some(out) = &out {
            out.remove(&["summary.json", SCENARIO])?;
            out.remove(&PLOTS)?;
        }
        if let Some(out) = &out {
            write_scenario(out, pilot.env())?;
        }
        let live = window.open(&pilot, self.options.seed, out.as_ref())?;
        let recording = rerun.begin(&pilot)?;
        let outputs = Outputs { animation, live, recording };
        let (flight, samples) = self.flight(&mut pilot, out.as_ref(), outputs)?;

        let mut written = self.animation.files();
        written.extend(rerun.file());
        let summary = flight.json(pilot.env(), &self.options);
        if let Some(out) = &out {
            // equal seeds give equal files only without the wall time
            let mut file = summary.clone();
            if let Some(object) = file.as_object_mut() {
                object.remove("wall_seconds");
            }
            out.write("summary.json", format!("{file:#}\n").as_bytes())?;
            written.extend(aviary::record::files(out.path()));
            let obstacles = out.path().join("obstacles.csv");
            written.extend(obstacles.exists().then_some(obstacles));
            written.extend([SCENARIO, "summary.json"].map(|name| out.path().join(name)));
        }
        if let (Some(out), Some(samples), true) = (&out, &samples, self.plot) {
            written.extend(self.draw(out, pilot.env(), samples)?);
        }
        if self.json {
            let mut summary = summary;
            // file names need not be UTF-8
            summary["files"] = written.iter().map(|path| path.to_string_lossy()).collect();
            output::print_json(&summary)?;
        } else {
            output::print(&flight.table(pilot.env()))?;
            output::print_written(&written)?;
        }
        if let Some(error) = flight.unsaved {
            return Err(Failure::work(error));
        }
        match flight.info.end {
            // the person may have let it crash
            Some(_) if window == InWindow::Changed => Ok(()),
            Some(end) if end.is_crash() => {
                let env = pilot.env();
                let drones = env.simulation().num_drones();
                let crashed = (0..drones).find(|&drone| env.drone_end(drone).is_some_and(|end| end.is_crash()));
                let which = crashed.filter(|_| drones > 1).map_or("the drone".into(), |drone| format!("drone {drone}"));
                Err(Failure::work(anyhow!("{which} crashed ({end}) at t = {:.3} s", flight.info.time)))
            }
            _ => Ok(()),
        }
    }

    /// Draws the plots of a flight and returns their paths.
    fn draw(&self, to: &OutputDir, env: &dyn DroneEnv, samples: &Samples) -> Result<Vec<PathBuf>, Failure> {
        let simulation = env.simulation();
        let what = self.options.trajectory.as_ref().map_or(env.name().into(), ToString::to_string);
        let title = format!("{what} with {} ({})", simulation.params(0).name, output::physics(simulation));
        let mut written = Vec::new();
        for (name, plot) in [("flight", Plot::of_flight(&title, samples)), ("path", Plot::of_paths(&title, samples))] {
            let plot = plot.map_err(Failure::work)?;
            let (svg, png) = (plot.svg().map_err(Failure::work)?, plot.png().map_err(Failure::work)?);
            for (ending, bytes) in [("svg", svg.as_bytes()), ("png", &png)] {
                let file = format!("{name}.{ending}");
                to.write(&file, bytes)?;
                written.push(to.path().join(file));
            }
        }
        Ok(written)
    }

    /// Flies one episode.
    fn flight(
        &self,
        pilot: &mut Pilot,
        out: Option<&OutputDir>,
        Outputs { mut animation, mut live, mut recording }: Outputs,
    ) -> Result<(Flight, Option<Samples>), Failure> {
        let drones = pilot.env().simulation().num_drones();
        let is_changed = live.as_ref().is_some_and(|live| live.status().is_interactive);
        let mut log = Log::begin(out, drones, self.plot || is_changed)?;
        let steps = pilot.env().episode_steps();
        let bar = if live.is_some() { ProgressBar::hidden() } else { output::progress(steps, "flying") };
        let mut errors = Errors::default();
        let mut reward = 0.0;
        let mut wall_seconds = 0.0;
        log.note(pilot)?;
        let mut seed = self.options.seed;
        // a step that failed in a flight that can be changed ends the episode
        let mut has_failed = false;
        let mut unsaved = None;
        loop {
            let is_over = pilot.rollout.is_over() || has_failed;
            // a flight that can be changed ends when the window is closed
            if is_over && !is_changed || is_changed && live.is_none() {
                if let Some(Err(error)) = live.as_mut().map(|window| window.show_end(pilot)) {
                    tracing::warn!("{error}; the last state is not shown");
                }
                break;
            }
            if let Some(window) = &mut live {
                match window.turn(pilot, is_over) {
                    Ok(Turn::Step) => {}
                    Ok(Turn::Restarted) => {
                        has_failed = false;
                        seed = window.status().seed.unwrap_or(seed);
                        if let Some(animation) = &mut animation {
                            animation.end_episode()?;
                        }
                        log.restart(out, drones)?;
                        log.note(pilot)?;
                        if let Some(out) = out {
                            write_scenario(out, pilot.env())?;
                        }
                        (errors, reward, wall_seconds) = (Errors::default(), 0.0, 0.0);
                        continue;
                    }
                    Ok(Turn::Rewound) => {
                        has_failed = false;
                        if let Some(animation) = &mut animation {
                            animation.rewind(pilot.env().simulation().control_steps());
                        }
                        log.rewind(out, pilot.env().simulation())?;
                        (errors, reward) = log.totals();
                        continue;
                    }
                    Ok(Turn::Closed) => {
                        live = None;
                        continue;
                    }
                    // the person has closed the window, and the flight is complete
                    Err(error @ ViewerError::Recording { .. }) if is_changed => {
                        unsaved = Some(error);
                        live = None;
                        continue;
                    }
                    Err(error) if is_changed => return Err(Failure::work(error)),
                    Err(error) => {
                        // the flight does not need its window
                        tracing::warn!("{error}; the flight goes on without a window");
                        live = None;
                    }
                }
            }
            if let Some(animation) = &mut animation {
                animation.look(pilot.env().simulation(), |drone| pilot.reference(drone))?;
            }
            let start = Instant::now();
            let of_task = match pilot.rollout.step() {
                Ok(step) => step.reward,
                Err(error) if is_changed => {
                    tracing::warn!("{error}; the episode is over");
                    has_failed = true;
                    continue;
                }
                Err(error) => {
                    // the flight up to the failure is worth a look; its own error would hide the first one
                    let _ = recording.map(RerunWriter::finish);
                    return Err(Failure::work(error));
                }
            };
            wall_seconds += start.elapsed().as_secs_f64();
            // a trajectory replaces the target of the task, and so its reward
            reward +=
                if pilot.is_on_trajectory() { (0..drones).map(|drone| pilot.reward(drone)).sum() } else { of_task };
            errors.note(pilot);
            log.note(pilot)?;
            if let Some(recording) = &mut recording {
                recording.note(pilot)?;
            }
            if pilot.env().simulation().control_steps().is_multiple_of(64) {
                bar.set_position(pilot.env().simulation().control_steps());
            }
        }
        bar.finish_and_clear();
        if let Some(recording) = recording {
            recording.finish()?;
        }
        if let Some(animation) = animation {
            animation.finish(pilot.env().simulation(), |drone| pilot.reference(drone))?;
        }
        let simulation = pilot.env().simulation();
        let mut info = pilot.env().info();
        if pilot.has_path() {
            // the reported error is the distance from the planned path
            info.position_error = pilot.position_error();
        }
        if pilot.is_on_trajectory() {
            // a trajectory replaces the goal of the task
            info.progress = simulation.control_steps() as f64 / pilot.env().episode_steps() as f64;
            info.success = !info.crashed() && info.position_error < ON_TRAJECTORY;
        }
        let controller = pilot.kind();
        Ok((Flight { controller, seed, info, reward, wall_seconds, errors, unsaved }, log.samples))
    }
}

/// Outputs of a flight in addition to its log.
struct Outputs {
    animation: Option<AnimationWriter>,
    live: Option<Live>,
    recording: Option<RerunWriter>,
}

/// Flight in a window.
pub type Live = LiveFlight<<Pilot as Flown>::Saved>;

impl InWindow {
    /// Opens the window of a flight; images and animations of the window go to the directory of the flight.
    fn open(self, pilot: &Pilot, seed: u64, out: Option<&OutputDir>) -> Result<Option<Live>, Failure> {
        if self == Self::No {
            return Ok(None);
        }
        let title = format!("aviary: {} with {}", pilot.env().name(), nominal(pilot.env()).name);
        let mut options = ViewerOptions { title, ..ViewerOptions::default() };
        if let Some(out) = out {
            options.output = out.path().into();
        }
        let viewer = Viewer::open(pilot.env(), options).map_err(Failure::work)?;
        Ok(Some(LiveFlight::new(viewer, Some(seed), self == Self::Changed)))
    }
}

/// Writes the scenario of an episode that begins.
fn write_scenario(out: &OutputDir, env: &dyn DroneEnv) -> Result<(), Failure> {
    let scenario = Scenario::of(env.simulation()).and_then(|scenario| scenario.to_toml());
    out.write(SCENARIO, scenario.map_err(Failure::work)?.as_bytes())
}

/// Scenario file of a flight, which `aviary replay` reads.
const SCENARIO: &str = "scenario.toml";

/// Files of `--plot`.
const PLOTS: [&str; 4] = ["flight.svg", "flight.png", "path.svg", "path.png"];

/// Largest final position error of a successful flight along a trajectory, m.
const ON_TRAJECTORY: f64 = 0.05;
