//! Interventions in the flight.

use aviary::control::ControllerKind;
use aviary::physics::wind::{WindConfig, WindModel};
use aviary::rollout::PilotMode;
use nalgebra::Vector3;

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
    /// Wind of the flight that the values show, world frame, m/s.
    wind: Vector3<f64>,
    pub mode: PilotMode,
}

impl Act {
    pub fn new(flight: &Flight) -> Self {
        let mut act = Self { speed: 0.0, direction: 0.0, upwards: 0.0, wind: Vector3::zeros(), mode: PilotMode::Vel };
        act.read(flight.frame().wind);
        act
    }

    /// Shows a wind that the flight has.
    fn read(&mut self, wind: Vector3<f64>) {
        if wind == self.wind {
            return;
        }
        (self.wind, self.speed, self.upwards) = (wind, wind.xy().norm(), wind.z);
        if self.speed > 0.0 {
            self.direction = wind.y.atan2(wind.x).to_degrees();
        }
    }
}

impl Ui {
    pub(super) fn act_panel(&mut self, ui: &mut egui::Ui, flight: &Flight) {
        if !flight.status.is_interactive {
            ui.label("The loop of the program steps this flight. `aviary view` flies with these controls.");
            return;
        }
        let frame = flight.frame();
        let drone = self.camera_drone().min(frame.drones.len() - 1);
        ui.strong("Wind");
        // the flight answers a moment after the person has moved a slider
        if !ui.input(|input| input.pointer.any_down()) {
            self.act.read(frame.wind);
        }
        let is_moved = ui.add(slider(&mut self.act.speed, 0.0..=10.0, "m/s")).changed()
            | ui.add(slider(&mut self.act.direction, -180.0..=180.0, "° direction (0: +x, 90: +y)")).changed()
            | ui.add(slider(&mut self.act.upwards, -3.0..=3.0, "m/s upwards")).changed();
        if is_moved {
            let (sin, cos) = self.act.direction.to_radians().sin_cos();
            let velocity = [self.act.speed * cos, self.act.speed * sin, self.act.upwards];
            let is_calm = velocity.iter().all(|x| x.abs() < 1e-9);
            // gusts of a wind with a steady part stay
            let steady = |wind: &&WindConfig| matches!(wind.model, WindModel::Constant | WindModel::Combined);
            let wind = match frame.wind_config.as_ref().filter(steady) {
                Some(wind) => WindConfig { velocity, ..*wind },
                None => WindConfig { model: WindModel::Constant, velocity, ..WindConfig::default() },
            };
            let is_none = is_calm && wind.model == WindModel::Constant;
            self.send(Command::Wind((!is_none).then_some(wind)));
        }
        ui.separator();
        if !frame.obstacles.is_empty() && ui.button("New layout of the obstacles").clicked() {
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
            let mut gain = frame.drones[drone].motor_gains[motor];
            ui.horizontal(|ui| {
                let mut changed = ui.add(slider(&mut gain, 0.0..=1.2, &format!("gain of motor {motor}"))).changed();
                if ui.button(if gain > 0.0 { "Stop" } else { "Start" }).clicked() {
                    gain = if gain > 0.0 { 0.0 } else { 1.0 };
                    changed = true;
                }
                if changed {
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

/// Returns a slider. A value outside the range stays until the person moves the slider.
fn slider<'a>(value: &'a mut f64, range: std::ops::RangeInclusive<f64>, text: &str) -> egui::Slider<'a> {
    egui::Slider::new(value, range).clamping(egui::SliderClamping::Edits).text(text.to_string())
}
