//! Panels of the window, its mouse and its keys.

mod act;
mod keys;
mod mouse;
mod numbers;
mod plots;
mod time_line;
mod view;

use std::time::{Duration, Instant};

use aviary::vision::{ImageSize, View};
use egui::{Align2, Color32, FontId, Pos2, Rect, pos2, vec2};

use crate::command::Command;
use crate::flight::Flight;
use crate::frame::Frame;
use crate::orbit::OrbitCamera;
use crate::recording::RecordingKind;
use crate::scene::SceneImages;
use crate::shared::ViewStatus;
use crate::sticks::Gamepads;
use crate::viewer::ViewerOptions;

/// Wish of the person at the window.
#[derive(Debug, Clone, PartialEq)]
pub(crate) enum Wish {
    /// Command to the flight.
    Flight(Command),
    /// Starts or ends an animation.
    Record(RecordingKind),
    /// Shadows, reflections and several samples per pixel.
    Quality(bool),
    Close,
}

/// Overlays and onboard images of the scene.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Shows {
    pub trails: bool,
    pub references: bool,
    pub labels: bool,
    pub wind: bool,
    pub contacts: bool,
    pub forces: bool,
    /// Images of the onboard camera: colour, depth, segmentation.
    pub onboard: [bool; 3],
    /// Onboard images of the first drones in place of those of the selected one.
    pub all_cameras: bool,
}

impl Default for Shows {
    fn default() -> Self {
        Self {
            trails: true,
            references: true,
            labels: true,
            wind: true,
            contacts: false,
            forces: false,
            onboard: [false; 3],
            all_cameras: false,
        }
    }
}

/// Panels at the right side.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Tab {
    Numbers,
    Plots,
    View,
    Act,
}

/// State of the panels, of the camera and of the mouse.
pub(crate) struct Ui {
    pub camera: OrbitCamera,
    /// Preset of the camera; `None` for one that the mouse moves.
    pub preset: Option<View>,
    pub followed: Option<usize>,
    pub selected: Option<usize>,
    pub shows: Shows,
    pub wishes: Vec<Wish>,
    pub save_image: bool,
    pub is_recording: bool,
    pub images_per_second: f64,
    pub is_pretty: bool,
    /// True if the flight is paused because an earlier state is shown.
    pub is_paused_to_look: bool,
    panels: bool,
    tab: Tab,
    help: bool,
    /// Place of the scene in the window, points.
    scene: Rect,
    pixels_per_point: f32,
    notice: Option<(Instant, String)>,
    push: Option<mouse::Push>,
    act: act::Act,
    plots: plots::Plots,
    gamepads: Gamepads,
    keyboard: keys::StickKeys,
}

impl Ui {
    pub fn new(options: &ViewerOptions, flight: &Flight) -> Self {
        let [width, height] = options.size.map(|side| side as f32);
        Self {
            camera: ViewStatus::default().camera,
            preset: Some(View::Track),
            followed: None,
            selected: None,
            shows: Shows::default(),
            wishes: Vec::new(),
            save_image: false,
            is_recording: false,
            images_per_second: 0.0,
            is_pretty: options.is_pretty.unwrap_or(false),
            is_paused_to_look: false,
            panels: options.panels,
            tab: Tab::Numbers,
            help: false,
            scene: Rect::from_min_size(pos2(0.0, 0.0), vec2(width, height)),
            pixels_per_point: 1.0,
            notice: None,
            push: None,
            act: act::Act::new(flight),
            plots: plots::Plots::default(),
            gamepads: Gamepads::default(),
            keyboard: keys::StickKeys::default(),
        }
    }

    /// Returns the size of the image of the scene, pixels.
    pub fn image_size(&self) -> ImageSize {
        let side = |points: f32| (points * self.pixels_per_point).round().clamp(1.0, ImageSize::MAX_SIDE as f32) as u32;
        ImageSize { width: side(self.scene.width()), height: side(self.scene.height()) }
    }

    /// Returns true if the next image is to be saved.
    pub fn wants_image(&self) -> bool {
        self.save_image
    }

    /// Adapts the selection to the drones of the flight.
    pub fn prepare(&mut self, flight: &Flight) {
        let count = flight.frame().drones.len();
        self.followed = self.followed.filter(|&drone| drone < count);
        self.selected = self.selected.filter(|&drone| drone < count);
        if self.push.as_ref().is_some_and(|push| push.drone >= count) {
            self.push = None;
        }
    }

    /// Returns the drone whose onboard camera is shown.
    pub fn camera_drone(&self) -> usize {
        self.selected.or(self.followed).unwrap_or(0)
    }

    /// Returns the drones whose onboard images are shown, at most [`CAMERAS`].
    pub fn camera_drones(&self, frame: &Frame) -> std::ops::Range<usize> {
        if self.shows.all_cameras {
            0..frame.drones.len().min(CAMERAS)
        } else {
            let drone = self.onboard_drone(frame);
            drone..drone + 1
        }
    }

    /// Returns the drone whose onboard camera fills the window.
    pub fn onboard_drone(&self, frame: &Frame) -> usize {
        self.camera_drone().min(frame.drones.len() - 1)
    }

    /// Shows the result of an action of the window.
    pub fn notify(&mut self, result: Result<String, String>) {
        let message = match result {
            Ok(message) => message,
            Err(error) => format!("error: {error}"),
        };
        self.notice = Some((Instant::now(), message));
    }

    /// Writes the state of the window.
    pub fn report(&self, status: &mut ViewStatus, flight: &Flight) {
        let scale = self.pixels_per_point;
        let Rect { min, max } = self.scene;
        status.scene = [min.x, min.y, max.x - min.x, max.y - min.y].map(|x| (x * scale).round() as u32);
        status.camera = self.camera;
        status.preset = self.preset.map_or("free", View::name);
        status.followed = self.followed;
        status.selected = self.selected;
        status.step = flight.frame().step;
    }

    /// Lays out the panels and handles mouse and keys.
    pub fn show(&mut self, root: &mut egui::Ui, flight: &mut Flight, images: &SceneImages) {
        self.pixels_per_point = root.ctx().pixels_per_point();
        self.handle_keys(root.ctx(), flight);
        if self.panels {
            egui::Panel::bottom("time line").show(root, |ui| self.time_line(ui, flight));
            egui::Panel::right("panels").default_size(370.0).show(root, |ui| self.tabs(ui, flight));
        }
        let frame = egui::Frame::default().fill(Color32::BLACK);
        egui::CentralPanel::default().frame(frame).show(root, |ui| self.scene(ui, flight, images));
        if self.help {
            keys::help(root.ctx(), &mut self.help);
        }
        // notices disappear without an event
        if self.notice.as_ref().is_some_and(|(since, _)| since.elapsed() > NOTICE) {
            self.notice = None;
        }
        if self.notice.is_some() {
            root.ctx().request_repaint_after(Duration::from_millis(250));
        }
    }

    fn tabs(&mut self, ui: &mut egui::Ui, flight: &mut Flight) {
        ui.horizontal(|ui| {
            for (tab, name) in
                [(Tab::Numbers, "Numbers"), (Tab::Plots, "Plots"), (Tab::View, "View"), (Tab::Act, "Act")]
            {
                ui.selectable_value(&mut self.tab, tab, name);
            }
        });
        ui.separator();
        egui::ScrollArea::vertical().auto_shrink([false, false]).show(ui, |ui| match self.tab {
            Tab::Numbers => numbers::show(ui, flight, self.camera_drone()),
            Tab::Plots => self.plots.show(ui, flight, self.camera_drone()),
            Tab::View => self.view_panel(ui, flight),
            Tab::Act => self.act_panel(ui, flight),
        });
    }

    /// Shows the image of the scene with its labels.
    fn scene(&mut self, ui: &mut egui::Ui, flight: &Flight, images: &SceneImages) {
        let rect = ui.available_rect_before_wrap();
        let response = ui.allocate_rect(rect, egui::Sense::click_and_drag());
        let painter = ui.painter_at(rect);
        if let Some(image) = &images.main {
            let whole = Rect::from_min_max(pos2(0.0, 0.0), pos2(1.0, 1.0));
            painter.image(image.id(), rect, whole, Color32::WHITE);
        }
        if rect != self.scene {
            // the next image has the new size
            self.scene = rect;
            ui.ctx().request_repaint();
        }
        self.handle_mouse(ui.ctx(), &response, flight);
        let frame = flight.frame();
        if self.shows.labels && frame.drones.len() > 1 && self.preset != Some(View::Fpv) {
            let pose = self.camera.pose();
            for (drone, of_drone) in frame.drones.iter().enumerate() {
                if let Some([x, y]) = pose.project(&of_drone.state.position, self.image_size()) {
                    let at = rect.center() + vec2(0.5 * x as f32 * rect.width(), -0.5 * y as f32 * rect.height());
                    let colour = aviary::record::plot::colour_of(drone, frame.drones.len());
                    let [r, g, b] = [0, 1, 2].map(|i| (255.0 * colour[i]) as u8);
                    let font = FontId::proportional(13.0);
                    let rgb = Color32::from_rgb(r, g, b);
                    outlined(&painter, at + vec2(10.0, -10.0), Align2::LEFT_BOTTOM, &drone.to_string(), font, rgb);
                }
            }
        }
        self.overlay(&painter, rect, flight);
        show_onboard(&painter, rect, images, frame.drones.len());
    }

    /// Writes clock, state of the flight and notices over the scene.
    fn overlay(&self, painter: &egui::Painter, rect: Rect, flight: &Flight) {
        let frame = flight.frame();
        let mut lines = vec![format!("{:.3} s   {}", frame.time, flight.episode.task)];
        let status = &flight.status;
        if flight.shown.is_some() {
            let hint = if status.is_interactive { ": continue from here with C" } else { "" };
            lines.push(format!("earlier state{hint}"));
        } else if frame.end.is_none() {
            if status.is_paused {
                lines.push("paused".into());
            } else if status.is_paced {
                lines.push(format!("{:.2} × real time", status.measured_speed));
            }
        }
        if let Some(drone) = status.piloted {
            lines.push(format!("drone {drone} is flown by hand"));
        }
        if let Some(end) = frame.end {
            let hint = if status.is_interactive { "; Backspace restarts it, N starts the next seed" } else { "" };
            lines.push(format!("episode over: {}{hint}", end.name()));
        }
        if self.is_recording {
            lines.push("recording".into());
        }
        let notice = self.notice.as_ref().map(|(_, notice)| notice);
        lines.extend(notice.or(status.message.as_ref()).cloned());
        let mut at = rect.left_top() + vec2(12.0, 10.0);
        for line in lines {
            let font = FontId::monospace(14.0);
            outlined(painter, at, Align2::LEFT_TOP, &line, font, Color32::WHITE);
            at.y += 18.0;
        }
        let hint = if self.panels { "H: keys" } else { "H: keys   Tab: panels" };
        let (font, corner) = (FontId::proportional(13.0), rect.left_bottom() + vec2(12.0, -8.0));
        outlined(painter, corner, Align2::LEFT_BOTTOM, hint, font, Color32::WHITE);
    }

    fn send(&mut self, command: Command) {
        self.wishes.push(Wish::Flight(command));
    }
}

/// Writes a text that can be read on every background.
fn outlined(painter: &egui::Painter, at: Pos2, align: Align2, text: &str, font: FontId, colour: Color32) {
    painter.text(at + vec2(1.0, 1.0), align, text, font.clone(), Color32::BLACK);
    painter.text(at, align, text, font, colour);
}

/// Time for which a notice is shown.
const NOTICE: Duration = Duration::from_secs(5);

/// Largest number of drones whose onboard images are shown at once.
const CAMERAS: usize = 6;

/// Shows the onboard images at the right side: a row for every drone, from the top, and a column for every kind.
fn show_onboard(painter: &egui::Painter, rect: Rect, images: &SceneImages, drones: usize) {
    const GAP: f32 = 6.0;
    let rows = images.onboard.chunk_by(|a, b| a.drone == b.drone);
    let (height, width) = (rows.clone().count(), rows.clone().map(<[_]>::len).max().unwrap_or(1));
    let share = |whole: f32, count: usize| (whole - GAP) / count.max(1) as f32 - GAP;
    let fit = (share(rect.height(), height) / 180.0).min(share(0.6 * rect.width(), width) / 240.0).clamp(0.0, 1.0);
    let size = vec2(240.0, 180.0) * fit;
    for (row, of_drone) in rows.enumerate() {
        for (column, image) in of_drone.iter().rev().enumerate() {
            let offset = vec2(-GAP - (column + 1) as f32 * (size.x + GAP), GAP + row as f32 * (size.y + GAP));
            let place = Rect::from_min_size(rect.right_top() + offset, size);
            let whole = Rect::from_min_max(pos2(0.0, 0.0), pos2(1.0, 1.0));
            painter.image(image.texture.id(), place, whole, Color32::WHITE);
            let (at, font) = (place.left_top() + vec2(4.0, 2.0), FontId::proportional(13.0));
            let (caption, rgb) = if drones > 1 {
                let colour = aviary::record::plot::colour_of(image.drone, drones);
                let [r, g, b] = [0, 1, 2].map(|i| (255.0 * colour[i]) as u8);
                (format!("{} {}", image.drone, image.caption), Color32::from_rgb(r, g, b))
            } else {
                (image.caption.clone(), Color32::WHITE)
            };
            outlined(painter, at, Align2::LEFT_TOP, &caption, font, rgb);
        }
    }
}
