//! Settings of the view.

use aviary::vision::View;

use super::{Ui, Wish};
use crate::flight::Flight;
use crate::recording::RecordingKind;

impl Ui {
    pub(super) fn view_panel(&mut self, ui: &mut egui::Ui, flight: &Flight) {
        ui.strong("Camera");
        ui.horizontal_wrapped(|ui| {
            for (key, view) in (1..).zip(View::ALL) {
                if ui.selectable_label(self.preset == Some(view), view.name()).on_hover_text(format!("{key}")).clicked()
                {
                    self.preset = Some(view);
                }
            }
            if ui.selectable_label(self.preset.is_none(), "free").clicked() {
                self.preset = None;
            }
        });
        let count = flight.frame().drones.len();
        let name = |drone: Option<usize>| drone.map_or("none".to_string(), |drone| format!("drone {drone}"));
        for (label, is_selection) in [("selected", true), ("followed", false)] {
            let mut value = if is_selection { self.selected } else { self.followed };
            egui::ComboBox::from_label(label).selected_text(name(value)).show_ui(ui, |ui| {
                for drone in std::iter::once(None).chain((0..count).map(Some)) {
                    ui.selectable_value(&mut value, drone, name(drone));
                }
            });
            if is_selection {
                self.selected = value;
            } else if value != self.followed {
                self.followed = value;
                self.preset = None;
            }
        }
        let camera = &self.camera;
        ui.label(format!(
            "looks at ({:.2}, {:.2}, {:.2}) m from {:.2} m, azimuth {:.0}°, elevation {:.0}°",
            camera.lookat.x, camera.lookat.y, camera.lookat.z, camera.distance, camera.azimuth, camera.elevation
        ));
        ui.separator();
        ui.strong("Shows");
        ui.checkbox(&mut self.shows.trails, "trails (T)");
        ui.checkbox(&mut self.shows.references, "references and planned paths");
        ui.checkbox(&mut self.shows.labels, "labels of the drones (L)");
        ui.checkbox(&mut self.shows.wind, "wind");
        ui.checkbox(&mut self.shows.contacts, "contact points and normals (X)");
        ui.checkbox(&mut self.shows.forces, "thrust and external forces (G)");
        ui.separator();
        ui.strong("Onboard camera");
        for (shown, name) in self.shows.onboard.iter_mut().zip(["colour (V)", "depth (D)", "segmentation (M)"]) {
            ui.checkbox(shown, name);
        }
        if count > 1 {
            ui.checkbox(&mut self.shows.all_cameras, "of all drones, at most six (B)");
        }
        ui.separator();
        if ui.checkbox(&mut self.is_pretty, "shadows, reflections, smooth edges").changed() {
            self.wishes.push(Wish::Quality(self.is_pretty));
        }
        ui.horizontal(|ui| {
            if ui.button("Save image").on_hover_text("P").clicked() {
                self.save_image = true;
            }
            let record = |kind: &str| if self.is_recording { "Stop".to_string() } else { format!("Record {kind}") };
            let (gif, mp4) = (record("GIF"), record("MP4"));
            if ui.button(gif).on_hover_text("R").clicked() {
                self.wishes.push(Wish::Record(RecordingKind::Gif));
            }
            if !self.is_recording && ui.button(mp4).on_hover_text("Shift + R").clicked() {
                self.wishes.push(Wish::Record(RecordingKind::Mp4));
            }
        });
    }
}
