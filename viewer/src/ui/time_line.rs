//! Controls of time: pause, speed, and the time line.

use super::Ui;
use crate::command::Command;
use crate::flight::Flight;

impl Ui {
    pub(super) fn time_line(&mut self, ui: &mut egui::Ui, flight: &mut Flight) {
        let status = flight.status.clone();
        ui.add_space(2.0);
        ui.horizontal(|ui| {
            if status.is_paced {
                let name = if status.is_paused { "Continue" } else { "Pause" };
                let is_over = flight.frame().end.is_some() && flight.shown.is_none();
                if ui.add_enabled(!is_over, egui::Button::new(name)).on_hover_text("Space").clicked() {
                    self.pause(!status.is_paused);
                }
                if ui.add_enabled(status.is_paused, egui::Button::new("Step")).on_hover_text(".").clicked() {
                    self.send(Command::Step);
                }
            }
            if status.is_interactive {
                if ui.button("Restart").on_hover_text("Backspace").clicked() {
                    self.send(Command::Restart { next_seed: false });
                }
                if ui.button("Next seed").on_hover_text("N").clicked() {
                    self.send(Command::Restart { next_seed: true });
                }
                let shows_past = flight.shown.is_some();
                let button = egui::Button::new("Continue from here");
                if ui.add_enabled(shows_past, button).on_hover_text("C").clicked() {
                    self.continue_from_shown(flight);
                }
            }
            if status.is_paced {
                let mut speed = status.speed;
                let slider = egui::Slider::new(&mut speed, 1.0 / 64.0..=64.0).logarithmic(true).suffix(" ×");
                if ui.add(slider.custom_formatter(|x, _| format!("{x:.3}"))).on_hover_text("+ − 0").changed() {
                    self.send(Command::Speed(speed));
                }
            }
            ui.label(format!("{:.0} images/s", self.images_per_second));
        });
        let last = flight.frames.len() - 1;
        let mut at = flight.shown.unwrap_or(last);
        ui.spacing_mut().slider_width = (ui.available_width() - 150.0).max(40.0);
        let times: Vec<f64> = flight.frames.first().into_iter().chain(flight.frames.last()).map(|f| f.time).collect();
        let time = flight.frame().time;
        ui.horizontal(|ui| {
            let response = ui.add(egui::Slider::new(&mut at, 0..=last.max(1)).show_value(false));
            ui.monospace(format!("{time:.2} / {:.2} s", times.last().copied().unwrap_or(0.0)));
            if response.changed() {
                self.show_state(flight, at.min(last));
            }
        });
        ui.add_space(2.0);
    }
}
