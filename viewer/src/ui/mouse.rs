//! Mouse over the scene: camera, selection and pushes, as in MuJoCo's viewer.

use aviary::vision::View;
use egui::{PointerButton, Response};
use nalgebra::Vector3;

use super::Ui;
use crate::command::Command;
use crate::flight::Flight;

/// Push of a drone by the mouse.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Push {
    pub drone: usize,
    /// Point that the drone is pulled to, world frame, m.
    pub target: Vector3<f64>,
}

/// Degrees by which the camera turns for a movement over the image's height.
const TURN: f64 = 180.0;

impl Ui {
    pub(super) fn handle_mouse(&mut self, context: &egui::Context, response: &Response, flight: &Flight) {
        let frame = flight.frame();
        let height = f64::from(self.scene.height().max(1.0));
        let (modifiers, scroll) = context.input(|input| (input.modifiers, input.smooth_scroll_delta()));
        if response.hovered() && scroll.y != 0.0 {
            self.free_camera();
            self.camera.zoom((f64::from(scroll.y) / 240.0).exp());
        }
        // the onboard camera has no camera of the mouse
        let is_outside = self.preset != Some(View::Fpv);
        if response.double_clicked()
            && is_outside
            && let Some(at) = response.interact_pointer_pos()
        {
            let offset = at - self.scene.center();
            let x = 2.0 * f64::from(offset.x / self.scene.width().max(1.0));
            let y = -2.0 * f64::from(offset.y / self.scene.height().max(1.0));
            let places: Vec<_> = frame.drones.iter().map(|drone| drone.state.position).collect();
            let reach = |drone: usize| flight.episode.world.drones[drone].params.collision_radius;
            let radius = (0..places.len()).map(reach).fold(0.0, f64::max);
            // a small drone can be selected within 14 points
            self.selected = self.camera.pick(&places, radius, 28.0 / height, [x, y], self.image_size());
        }
        let delta = response.drag_delta();
        let (right, up) = (f64::from(delta.x) / height, -f64::from(delta.y) / height);
        let can_push = flight.status.is_interactive && flight.shown.is_none() && is_outside;
        let pushed = self.selected.filter(|_| modifiers.command && can_push);
        if let (Some(drone), true) = (pushed, response.dragged()) {
            let place = frame.drones[drone].state.position;
            let target = match &self.push {
                Some(push) if push.drone == drone => push.target,
                _ => place,
            };
            let depth = self.camera.depth(&place).max(1e-3);
            if let Some(old) = self.push.as_ref().map(|push| push.drone).filter(|&old| old != drone) {
                self.send(Command::Push { drone: old, target: None });
            }
            let target = target + self.camera.displacement(depth, right, up);
            self.push = Some(Push { drone, target });
            self.send(Command::Push { drone, target: Some(target) });
            return;
        }
        if let Some(push) = self.push.take() {
            self.send(Command::Push { drone: push.drone, target: None });
        }
        if delta == egui::Vec2::ZERO {
            return;
        }
        if response.dragged_by(PointerButton::Primary) {
            self.free_camera();
            self.camera.orbit(-TURN * right, TURN * up);
        } else if response.dragged_by(PointerButton::Secondary) || response.dragged_by(PointerButton::Middle) {
            self.free_camera();
            self.followed = None;
            self.camera.pan(-right, -up);
        }
    }

    /// Lets the mouse move the camera from its present pose.
    fn free_camera(&mut self) {
        if self.preset == Some(View::Fpv) {
            self.followed = Some(self.camera_drone());
        }
        self.preset = None;
    }
}
