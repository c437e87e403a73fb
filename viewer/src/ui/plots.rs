//! Live plots of the flight.

use std::sync::Arc;

use egui::Color32;
use egui_plot::{Line, LineStyle, Plot, PlotPoints};

use crate::flight::Flight;
use crate::frame::Frame;

/// Plots that are shown.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Plots {
    shown: [bool; 6],
    metric: Option<&'static str>,
    /// Time before the present that the plots show, s.
    window: f64,
}

impl Default for Plots {
    fn default() -> Self {
        Self { shown: [true, true, false, true, true, false], metric: None, window: 10.0 }
    }
}

const NAMES: [&str; 6] =
    ["position (m)", "attitude (°)", "velocity (m/s)", "rotor speeds (rpm)", "reward", "body rates (rad/s)"];

/// Largest number of points of a line.
const POINTS: usize = 600;

impl Plots {
    pub fn show(&mut self, ui: &mut egui::Ui, flight: &Flight, drone: usize) {
        let drone = drone.min(flight.frame().drones.len() - 1);
        ui.horizontal_wrapped(|ui| {
            for (name, shown) in NAMES.iter().zip(&mut self.shown) {
                ui.toggle_value(shown, *name);
            }
        });
        ui.add(egui::Slider::new(&mut self.window, 1.0..=120.0).logarithmic(true).text("last seconds"));
        let frames = self.frames(flight);
        let names: Vec<_> = flight.frame().metrics.iter().map(|(name, _)| *name).collect();
        egui::ComboBox::from_label("metric").selected_text(self.metric.unwrap_or("none")).show_ui(ui, |ui| {
            ui.selectable_value(&mut self.metric, None, "none");
            for name in names {
                ui.selectable_value(&mut self.metric, Some(name), name);
            }
        });
        let of = |get: &dyn Fn(&Frame) -> f64| -> PlotPoints<'static> {
            frames.iter().map(|frame| [frame.time, get(frame)]).collect()
        };
        let axes = |letter: &'static str, get: &dyn Fn(&Frame, usize) -> f64| -> Vec<(String, PlotPoints<'static>)> {
            let line = |axis: usize| (format!("{letter}{}", ["x", "y", "z"][axis]), of(&|frame| get(frame, axis)));
            (0..3).map(line).collect()
        };
        for (index, name) in NAMES.iter().enumerate().filter(|(index, _)| self.shown[*index]) {
            let lines = match index {
                0 => {
                    let mut lines = axes("", &|frame, axis| frame.drones[drone].state.position[axis]);
                    if flight.frame().drones[drone].reference.is_some() {
                        let reference = |frame: &Frame, axis: usize| {
                            frame.drones[drone].reference.map_or(f64::NAN, |reference| reference[axis])
                        };
                        lines.extend(axes("reference ", &reference));
                    }
                    lines
                }
                1 => {
                    let line = |axis: usize| {
                        let name = ["roll", "pitch", "yaw"][axis].to_string();
                        (name, of(&|frame| frame.drones[drone].rpy[axis].to_degrees()))
                    };
                    (0..3).map(line).collect()
                }
                2 => axes("", &|frame, axis| frame.drones[drone].state.velocity[axis]),
                3 => {
                    let line = |motor: usize| (motor.to_string(), of(&|frame| frame.drones[drone].rotor_speeds[motor]));
                    (0..4).map(line).collect()
                }
                4 => vec![("reward".to_string(), of(&|frame| frame.drones[drone].reward))],
                _ => axes("", &|frame, axis| frame.drones[drone].state.angular_velocity[axis]),
            };
            plot(ui, name, lines);
        }
        if let Some(metric) = self.metric {
            let value = |frame: &Frame| {
                let found = frame.metrics.iter().find(|(name, _)| *name == metric);
                found.map_or(f64::NAN, |(_, value)| *value)
            };
            plot(ui, metric, vec![(metric.to_string(), of(&value))]);
        }
    }

    /// Returns the frames of the plots, at most [`POINTS`] of them. The same frames remain in the plot while time
    /// goes on, so that lines do not flicker.
    fn frames(&self, flight: &Flight) -> Vec<Arc<Frame>> {
        let past = flight.past();
        let end = flight.frame().time;
        let first = past.partition_point(|frame| frame.time < end - self.window);
        let every = (past.len() - first).div_ceil(POINTS).max(1);
        let last = past.last().filter(|last| !last.step.is_multiple_of(every as u64));
        let kept = past[first..].iter().filter(|frame| frame.step.is_multiple_of(every as u64));
        kept.chain(last).cloned().collect()
    }
}

/// Draws a plot under a line with the names of its lines.
fn plot(ui: &mut egui::Ui, name: &str, lines: Vec<(String, PlotPoints<'static>)>) {
    let is_reference = |name: &str| name.starts_with("reference");
    ui.horizontal_wrapped(|ui| {
        ui.label(name);
        for (index, (name, _)) in lines.iter().enumerate().filter(|(_, (name, _))| !is_reference(name)) {
            ui.colored_label(COLOURS[index % 4], name);
        }
        if lines.iter().any(|(name, _)| is_reference(name)) {
            ui.weak("reference dashed");
        }
    });
    Plot::new(name).height(120.0).allow_scroll(false).allow_drag(false).allow_zoom(false).show(ui, |plot| {
        let count = lines.iter().filter(|(name, _)| !is_reference(name)).count();
        for (index, (name, points)) in lines.into_iter().enumerate() {
            let style = if is_reference(&name) { LineStyle::dashed_loose() } else { LineStyle::Solid };
            plot.line(Line::new(name, points).color(COLOURS[index % count % 4]).style(style).width(1.5));
        }
    });
    ui.add_space(4.0);
}

/// Colours of the lines: red, green and blue for x, y and z.
const COLOURS: [Color32; 4] = [
    Color32::from_rgb(235, 100, 90),
    Color32::from_rgb(110, 200, 110),
    Color32::from_rgb(95, 155, 245),
    Color32::from_rgb(225, 185, 80),
];
