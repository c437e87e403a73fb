//! Results of a flight, as a table and as JSON.

use std::collections::VecDeque;

use aviary::control::ControllerKind;
use aviary::drone::DroneParams;
use aviary::env::{DroneEnv, Info};
use aviary::record::state_numbers;
use serde_json::{Value, json};
use viewer::ViewerError;

use crate::options::FlightOptions;
use crate::output::{self, decimals};
use crate::pilot::Pilot;

/// Position errors over a flight, one sample per control step and drone.
#[derive(Debug, Default)]
pub(super) struct Errors {
    sum: f64,
    squares: f64,
    count: u64,
    peak: f64,
    /// Times (s) and squared errors (m²) of the last 2 s.
    recent: VecDeque<(f64, f64)>,
}

impl Errors {
    pub(super) fn note(&mut self, pilot: &Pilot) {
        let simulation = pilot.env().simulation();
        let time = simulation.time();
        for drone in 0..simulation.num_drones() {
            self.add(time, simulation.distance(drone, &pilot.reference(drone).position));
        }
        self.forget(time);
    }

    /// Adds the error of one drone, m.
    pub(super) fn add(&mut self, time: f64, error: f64) {
        self.sum += error;
        self.squares += error * error;
        self.count += 1;
        self.peak = self.peak.max(error);
        self.recent.push_back((time, error * error));
    }

    /// Removes what is older than the last 2 s.
    pub(super) fn forget(&mut self, time: f64) {
        while self.recent.front().is_some_and(|(t, _)| *t < time - 2.0) {
            self.recent.pop_front();
        }
    }

    pub(super) fn mean(&self) -> f64 {
        self.sum / self.count.max(1) as f64
    }

    pub(super) fn rms(&self) -> f64 {
        (self.squares / self.count.max(1) as f64).sqrt()
    }

    pub(super) fn rms_last_2s(&self) -> f64 {
        let sum: f64 = self.recent.iter().map(|(_, square)| square).sum();
        (sum / self.recent.len().max(1) as f64).sqrt()
    }
}

/// Result of a flight.
#[derive(Debug)]
pub(super) struct Flight {
    pub(super) controller: ControllerKind,
    /// Seed of the episode.
    pub(super) seed: u64,
    pub(super) info: Info,
    pub(super) reward: f64,
    pub(super) wall_seconds: f64,
    pub(super) errors: Errors,
    /// Error of an animation of the window.
    pub(super) unsaved: Option<ViewerError>,
}

impl Flight {
    pub(super) fn json(&self, env: &dyn DroneEnv, options: &FlightOptions) -> Value {
        let simulation = env.simulation();
        let drones: Vec<_> = (simulation.states().iter().enumerate())
            .map(|(drone, state)| {
                let crashed = env.drone_end(drone).is_some_and(|end| end.is_crash());
                json!({ "final_position": state_numbers(state)[..3], "crashed": crashed })
            })
            .collect();
        let mut metrics: serde_json::Map<_, _> =
            env.info_map().into_iter().map(|(name, value)| (name.to_string(), json!(value))).collect();
        // the values of the flight refer to the trajectory or the plan, those of the environment to the task
        for (name, value) in self.info.values() {
            metrics.insert(name.into(), json!(value));
        }
        json!({
            "task": env.name(),
            "drone_model": simulation.params(0).name,
            "hover_rpm": nominal(env).hover_rpm(),
            "hover_share": nominal(env).hover_rpm() / nominal(env).max_rpm(),
            "physics": simulation.physics(),
            "effects": simulation.effects().to_string(),
            "engine": simulation.engine().name(),
            "controller": self.controller.name(),
            "trajectory": options.trajectory.as_ref().map(ToString::to_string),
            "seed": self.seed,
            "wind": simulation.wind().map_or("none", |wind| wind.model.name()),
            "obstacles": simulation.obstacles().len(),
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
            "info": metrics,
            "drones": drones,
        })
    }

    pub(super) fn table(&self, env: &dyn DroneEnv) -> String {
        let centimetres = |metres: f64| format!("{} cm", decimals(100.0 * metres, 2));
        let success = match (self.info.success, self.info.end) {
            (true, _) => "yes".to_string(),
            (false, Some(end)) => format!("no ({end})"),
            (false, None) => "no".to_string(),
        };
        let mut metrics: Vec<_> = Vec::new();
        env.metrics(&mut |name, value| metrics.push((name.replace('_', " "), metric(name, value))));
        let mut rows = vec![
            (
                "task",
                format!("{} with {} {}", env.name(), env.simulation().num_drones(), env.simulation().params(0).name),
            ),
            ("hover speed", hover_speed(nominal(env))),
            ("controller", self.controller.to_string()),
            ("physics", output::physics(env.simulation())),
            ("engine", env.simulation().engine().name().to_string()),
            ("success", success),
            ("final position error", centimetres(self.info.position_error)),
            ("RMS position error, last 2 s", centimetres(self.errors.rms_last_2s())),
            ("mean position error", centimetres(self.errors.mean())),
            ("peak position error", centimetres(self.errors.peak)),
            ("reward", decimals(self.reward, 2)),
            ("simulated time", format!("{:.2} s", self.info.time)),
            ("simulated s per wall s", format!("{:.0}", self.info.time / self.wall_seconds.max(1e-9))),
        ];
        let implausible = nominal(env).derived().iter().filter(|number| !number.is_plausible()).count();
        if implausible > 0 {
            let numbers = if implausible == 1 { "number is" } else { "numbers are" };
            rows.push(("warning", format!("{implausible} {numbers} implausible: see `aviary airframe`")));
        }
        rows.extend(metrics.iter().map(|(name, value)| (&**name, value.clone())));
        output::table(&rows)
    }
}

/// Returns the nominal parameters of the drones, before randomization.
pub(super) fn nominal(env: &dyn DroneEnv) -> &DroneParams {
    &env.simulation().world().drones[0].params
}

/// Returns the hover speed of an airframe and its fraction of the maximum speed.
pub(super) fn hover_speed(params: &DroneParams) -> String {
    let (hover, max) = (params.hover_rpm(), params.max_rpm());
    format!("{hover:.0} rpm, {:.0} % of the maximum", 100.0 * hover / max)
}

/// Returns a metric of a task with its unit. Counts have no decimals. Sampled parameters are factors.
fn metric(name: &str, value: f64) -> String {
    let number = decimals(value, 3);
    match name {
        "gates_passed" | "waypoints_captured" => decimals(value, 0),
        "minimum_distance" | "mean_formation_error" | "tracking_error" => format!("{number} m"),
        "speed" | "velocity_error" => format!("{number} m/s"),
        "body_rate" => format!("{number} rad/s"),
        "sampled_lag" | "sampled_latency" => format!("{number} s"),
        name if name.starts_with("sampled_") => format!("{number} × nominal"),
        _ => number,
    }
}
