//! Keys of the window.

use aviary::rollout::PilotMode;
use aviary::vision::View;
use egui::Key;

use super::Ui;
use crate::command::Command;
use crate::flight::Flight;
use crate::recording::RecordingKind;
use crate::ui::Wish;

/// All keys, for the help.
const KEYS: [(&str, &str); 27] = [
    ("drag left", "turn the camera"),
    ("drag right", "move the camera"),
    ("scroll", "zoom"),
    ("double click", "select a drone, or none"),
    ("Ctrl + drag", "push the selected drone"),
    ("1 2 3 4 5", "cameras: track, fpv, fixed, front, top"),
    ("F", "follow the selected drone, or stop following"),
    ("Page Down, Page Up", "select the next or previous drone"),
    ("Space", "pause, continue"),
    (".", "one control step while paused"),
    ("+ −", "faster, slower"),
    ("0", "real time"),
    ("← →", "show the previous or the next state (by hand: , and Shift + .)"),
    ("C", "continue from the shown state"),
    ("Backspace", "restart with the same seed"),
    ("N", "restart with the next seed"),
    ("T, L", "trails, labels"),
    ("X, G", "contacts, forces"),
    ("V, D, M", "onboard camera: colour, depth, segmentation"),
    ("B", "onboard cameras of all drones (at most six)"),
    ("P", "save an image (PNG)"),
    ("R, Shift + R", "record: GIF, MP4; again to stop"),
    ("K", "fly the selected drone by hand, or stop"),
    ("W S, A E", "by hand: up, down; turn left, right"),
    ("arrows", "by hand: forward, back, left, right"),
    ("Tab", "show or hide the panels"),
    ("H, Q", "this help, close the window"),
];

/// Keys that are sticks.
#[derive(Debug, Default)]
pub(super) struct StickKeys {
    last: Option<[f64; 4]>,
}

impl Ui {
    pub(super) fn handle_keys(&mut self, context: &egui::Context, flight: &mut Flight) {
        // keys are commands: Tab and arrows do not move a focus among the buttons
        context.memory_mut(|memory| memory.move_focus(egui::FocusDirection::None));
        self.sticks(context, flight);
        if context.egui_wants_keyboard_input() {
            return;
        }
        let pressed: Vec<_> = context.input(|input| {
            let is_press = |event: &egui::Event| match event {
                egui::Event::Key { key, pressed: true, modifiers, .. } => Some((*key, *modifiers)),
                _ => None,
            };
            input.events.iter().filter_map(is_press).collect()
        });
        let by_hand = flight.status.piloted.is_some();
        for (key, modifiers) in pressed {
            if modifiers.ctrl || modifiers.alt {
                continue;
            }
            match key {
                Key::Num1 => self.preset = Some(View::Track),
                Key::Num2 => self.preset = Some(View::Fpv),
                Key::Num3 => self.preset = Some(View::Fixed),
                Key::Num4 => self.preset = Some(View::Front),
                Key::Num5 => self.preset = Some(View::Top),
                Key::F => self.toggle_following(),
                Key::PageDown => self.select_by(flight, 1),
                Key::PageUp => self.select_by(flight, -1),
                Key::T => self.shows.trails ^= true,
                Key::L => self.shows.labels ^= true,
                Key::X => self.shows.contacts ^= true,
                Key::G => self.shows.forces ^= true,
                Key::V => self.shows.onboard[0] ^= true,
                Key::D => self.shows.onboard[1] ^= true,
                Key::M => self.shows.onboard[2] ^= true,
                Key::B => {
                    self.shows.all_cameras ^= true;
                    if self.shows.all_cameras && !self.shows.onboard.contains(&true) {
                        self.shows.onboard[0] = true;
                    }
                }
                Key::P => self.save_image = true,
                Key::R => {
                    let kind = if modifiers.shift { RecordingKind::Mp4 } else { RecordingKind::Gif };
                    self.wishes.push(Wish::Record(kind));
                }
                Key::Tab => self.panels ^= true,
                Key::H | Key::F1 => self.help ^= true,
                Key::Escape => self.help = false,
                Key::Q => self.wishes.push(Wish::Close),
                Key::Comma => self.show_by(flight, -1),
                Key::Period if modifiers.shift => self.show_by(flight, 1),
                Key::ArrowLeft if !by_hand => self.show_by(flight, -1),
                Key::ArrowRight if !by_hand => self.show_by(flight, 1),
                _ => self.handle_flight_key(key, flight),
            }
        }
    }

    fn handle_flight_key(&mut self, key: Key, flight: &mut Flight) {
        let status = &flight.status;
        if status.is_paced {
            match key {
                // after the end of an episode there is nothing to pause
                Key::Space if flight.frame().end.is_some() && flight.shown.is_none() => {}
                Key::Space => self.pause(!status.is_paused),
                Key::Period => self.send(Command::Step),
                Key::Plus | Key::Equals => self.send(Command::Speed((2.0 * status.speed).min(64.0))),
                Key::Minus => self.send(Command::Speed((0.5 * status.speed).max(1.0 / 64.0))),
                Key::Num0 => self.send(Command::Speed(1.0)),
                _ => {}
            }
        }
        if status.is_interactive {
            match key {
                Key::Backspace => self.send(Command::Restart { next_seed: false }),
                Key::N => self.send(Command::Restart { next_seed: true }),
                Key::C => self.continue_from_shown(flight),
                Key::K => {
                    let drone = status.piloted.unwrap_or(self.camera_drone());
                    let mode = if status.piloted.is_some() { None } else { Some(self.act.mode) };
                    self.send(Command::Pilot { drone, mode });
                }
                _ => {}
            }
        }
    }

    /// Sends the sticks of the keyboard and the gamepad.
    fn sticks(&mut self, context: &egui::Context, flight: &Flight) {
        let Some(drone) = flight.status.piloted else {
            self.keyboard.last = None;
            return;
        };
        let axis = |plus: Key, minus: Key| {
            context.input(|input| {
                let down = |key: Key| f64::from(u8::from(input.key_down(key)));
                down(plus) - down(minus)
            })
        };
        let keys = [
            axis(Key::W, Key::S),
            axis(Key::A, Key::E),
            axis(Key::ArrowUp, Key::ArrowDown),
            axis(Key::ArrowRight, Key::ArrowLeft),
        ];
        let pad = self.gamepads.read();
        let [up, left, forward, right] = std::array::from_fn(|i| (keys[i] + pad[i]).clamp(-1.0, 1.0));
        let Some(model) = flight.episode.world.drones.get(drone) else { return };
        let max_speed = model.params.max_speed;
        let sticks = stick_action(self.act.mode, [up, left, forward, right], max_speed);
        if self.keyboard.last != Some(sticks) {
            self.keyboard.last = Some(sticks);
            self.send(Command::Sticks(sticks));
        }
        // gamepads have no events in the window
        context.request_repaint_after(std::time::Duration::from_millis(20));
    }

    /// Pauses or continues the flight as the person wants.
    pub(super) fn pause(&mut self, pause: bool) {
        self.is_paused_to_look = false;
        self.send(Command::Pause(pause));
    }

    fn toggle_following(&mut self) {
        let drone = self.camera_drone();
        self.followed = if self.followed == Some(drone) { None } else { Some(drone) };
        self.preset = None;
    }

    fn select_by(&mut self, flight: &Flight, by: isize) {
        let count = flight.frame().drones.len() as isize;
        let start = if by > 0 { -1 } else { count };
        let next = self.selected.map_or(start, |drone| drone as isize) + by;
        self.selected = Some(next.rem_euclid(count) as usize);
        if self.followed.is_some() {
            self.followed = self.selected;
        }
    }

    /// Moves the shown state by control steps; pauses a flight that can be paused.
    fn show_by(&mut self, flight: &mut Flight, by: isize) {
        let last = flight.frames.len() - 1;
        let at = flight.shown.unwrap_or(last).saturating_add_signed(by).min(last);
        self.show_state(flight, at);
    }

    /// Shows an earlier state, by its index.
    pub(super) fn show_state(&mut self, flight: &mut Flight, index: usize) {
        let last = flight.frames.len() - 1;
        flight.shown = (index < last).then_some(index);
        if flight.status.is_paced && !flight.status.is_paused {
            self.is_paused_to_look = true;
            self.send(Command::Pause(true));
        }
    }

    /// Continues the flight from the shown state.
    pub(super) fn continue_from_shown(&mut self, flight: &mut Flight) {
        if let Some(shown) = flight.shown.take() {
            let step = flight.frames[shown].step;
            self.send(Command::Rewind { step });
            if std::mem::take(&mut self.is_paused_to_look) {
                self.send(Command::Pause(false));
            }
        }
    }
}

/// Returns the action of a drone that is flown by hand. The sticks (up, left turn, forward, right) are from −1 to 1.
/// Velocities reach 1 m/s, attitudes half of their range, and body rates 15 % of it.
fn stick_action(mode: PilotMode, [up, left, forward, right]: [f64; 4], max_speed: f64) -> [f64; 4] {
    match mode {
        PilotMode::Ctbr => [0.3 * up, 0.15 * right, 0.15 * forward, 0.15 * left],
        PilotMode::Attitude => [0.3 * up, 0.5 * right, 0.5 * forward, 0.5 * left],
        PilotMode::Vel => {
            let share = (1.0 / max_speed.max(1e-9)).min(1.0);
            [share * forward, -share * right, share * up, 0.3 * left]
        }
    }
}

/// Shows all keys.
pub(super) fn help(context: &egui::Context, is_open: &mut bool) {
    egui::Window::new("Keys").open(is_open).collapsible(false).resizable(false).show(context, |ui| {
        egui::Grid::new("keys").num_columns(2).spacing([24.0, 4.0]).show(ui, |ui| {
            for (key, effect) in KEYS {
                ui.strong(key);
                ui.label(effect);
                ui.end_row();
            }
        });
    });
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Signs follow the frames: x forward, y left, z up, and a positive pitch or roll tilts the thrust forwards or to
    /// the right.
    #[test]
    fn sticks_have_the_signs_of_the_frames() {
        assert_eq!(stick_action(PilotMode::Vel, [1.0, 0.0, 0.0, 0.0], 2.0), [0.0, -0.0, 0.5, 0.0]);
        assert_eq!(stick_action(PilotMode::Vel, [0.0, 0.0, 1.0, 0.0], 2.0), [0.5, -0.0, 0.0, 0.0]);
        assert_eq!(stick_action(PilotMode::Vel, [0.0, 0.0, 0.0, 1.0], 0.5), [0.0, -1.0, 0.0, 0.0]);
        assert_eq!(stick_action(PilotMode::Vel, [0.0, 1.0, 0.0, 0.0], 2.0)[3], 0.3);
        for mode in [PilotMode::Attitude, PilotMode::Ctbr] {
            let [thrust, roll, pitch, yaw] = stick_action(mode, [1.0, 1.0, 1.0, 1.0], 2.0);
            assert!(thrust > 0.0 && roll > 0.0 && pitch > 0.0 && yaw > 0.0);
        }
    }
}
