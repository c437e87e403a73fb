//! Live plots of the flight.

use std::sync::Arc;

use egui_plot::{Legend, Line, Plot, PlotPoints, VLine};

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
        let now = flight.frame().time;
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
                    lines.extend(axes("reference ", &|frame, axis| frame.drones[drone].reference[axis]));
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
                    let line = |motor: usize| {
                        (format!("motor {motor}"), of(&|frame| frame.drones[drone].rotor_speeds[motor]))
                    };
                    (0..4).map(line).collect()
                }
                4 => vec![("reward".to_string(), of(&|frame| frame.drones[drone].reward))],
                _ => axes("", &|frame, axis| frame.drones[drone].state.angular_velocity[axis]),
            };
            plot(ui, name, lines, now);
        }
        if let Some(metric) = self.metric {
            let value = |frame: &Frame| {
                let found = frame.metrics.iter().find(|(name, _)| *name == metric);
                found.map_or(f64::NAN, |(_, value)| *value)
            };
            plot(ui, metric, vec![(metric.to_string(), of(&value))], now);
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

fn plot(ui: &mut egui::Ui, name: &str, lines: Vec<(String, PlotPoints<'static>)>, now: f64) {
    ui.label(name);
    Plot::new(name)
        .height(130.0)
        .legend(Legend::default())
        .allow_scroll(false)
        .allow_drag(false)
        .allow_zoom(false)
        .show(ui, |plot| {
            for (name, points) in lines {
                plot.line(Line::new(name, points));
            }
            plot.vline(VLine::new("now", now));
        });
}
