//! Interventions in the flight.

use aviary::control::ControllerKind;
use aviary::physics::wind::{WindConfig, WindModel};
use aviary::rollout::PilotMode;

use super::Ui;
use crate::command::Command;
use crate::flight::Flight;

/// Settings of the panel.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Act {
    /// Wind speed, m/s.
    speed: f64,
    /// Direction of the wind about world z, degrees: 0 blows along +x, 90 along +y.
    direction: f64,
    /// Vertical wind speed, m/s.
    upwards: f64,
    pub mode: PilotMode,
    /// Gains of the motors of every drone, as this panel has set them.
    gains: Vec<[f64; 4]>,
    episode: u64,
}

impl Act {
    pub fn new(flight: &Flight) -> Self {
        let wind = flight.frame().wind;
        Self {
            speed: wind.xy().norm(),
            direction: wind.y.atan2(wind.x).to_degrees(),
            upwards: wind.z,
            mode: PilotMode::Vel,
            gains: vec![[1.0; 4]; flight.frame().drones.len()],
            episode: flight.episode.number,
        }
    }
}

impl Ui {
    pub(super) fn act_panel(&mut self, ui: &mut egui::Ui, flight: &Flight) {
        if !flight.status.is_interactive {
            ui.label("The loop of the program steps this flight. `aviary view` flies with these controls.");
            return;
        }
        let count = flight.frame().drones.len();
        if self.act.episode != flight.episode.number || self.act.gains.len() != count {
            // a new episode has its own motors
            self.act.gains = vec![[1.0; 4]; count];
            self.act.episode = flight.episode.number;
        }
        let drone = self.camera_drone().min(count - 1);
        ui.strong("Wind");
        let before = self.act.clone();
        ui.add(egui::Slider::new(&mut self.act.speed, 0.0..=10.0).text("m/s"));
        ui.add(egui::Slider::new(&mut self.act.direction, -180.0..=180.0).text("° to +x, 90 to +y"));
        ui.add(egui::Slider::new(&mut self.act.upwards, -3.0..=3.0).text("m/s upwards"));
        if before != self.act {
            let (sin, cos) = self.act.direction.to_radians().sin_cos();
            let velocity = [self.act.speed * cos, self.act.speed * sin, self.act.upwards];
            let is_calm = velocity.iter().all(|x| x.abs() < 1e-9);
            let wind = WindConfig { model: WindModel::Constant, velocity, ..WindConfig::default() };
            self.send(Command::Wind((!is_calm).then_some(wind)));
        }
        ui.separator();
        if !flight.frame().obstacles.is_empty() && ui.button("New layout of the obstacles").clicked() {
            self.send(Command::NewObstacles);
        }
        ui.strong("Controller");
        ui.horizontal(|ui| {
            for kind in ControllerKind::ALL {
                if ui.selectable_label(flight.status.pilot == kind.name(), kind.name()).clicked() {
                    self.send(Command::Controller(kind));
                }
            }
        });
        ui.separator();
        ui.strong(format!("Motors of drone {drone}"));
        for motor in 0..4 {
            let mut gain = self.act.gains[drone][motor];
            ui.horizontal(|ui| {
                let slider = egui::Slider::new(&mut gain, 0.0..=1.2).text(format!("gain of motor {motor}"));
                let mut changed = ui.add(slider).changed();
                if ui.button(if gain > 0.0 { "Stop" } else { "Start" }).clicked() {
                    gain = if gain > 0.0 { 0.0 } else { 1.0 };
                    changed = true;
                }
                if changed {
                    self.act.gains[drone][motor] = gain;
                    self.send(Command::MotorGain { drone, motor, gain });
                }
            });
        }
        ui.separator();
        ui.strong("By hand");
        ui.horizontal(|ui| {
            let modes = [(PilotMode::Vel, "velocity"), (PilotMode::Attitude, "attitude"), (PilotMode::Ctbr, "rates")];
            for (mode, name) in modes {
                if ui.selectable_value(&mut self.act.mode, mode, name).changed()
                    && let Some(drone) = flight.status.piloted
                {
                    self.send(Command::Pilot { drone, mode: Some(mode) });
                }
            }
        });
        let name = match flight.status.piloted {
            Some(drone) => format!("Return drone {drone} to its controller"),
            None => format!("Fly drone {drone}"),
        };
        if ui.button(name).on_hover_text("K").clicked() {
            let mode = if flight.status.piloted.is_some() { None } else { Some(self.act.mode) };
            self.send(Command::Pilot { drone: flight.status.piloted.unwrap_or(drone), mode });
        }
        ui.label("Keys: W S up and down, A E turn, arrows forward, back, left, right. A gamepad works, too.");
        ui.separator();
        ui.label("To push a drone, select it with a double click and drag with Ctrl.");
    }
}
