//! The state as numbers.

use crate::flight::Flight;

/// Shows the state of a drone and the metrics of the task.
pub(super) fn show(ui: &mut egui::Ui, flight: &Flight, drone: usize) {
    let frame = flight.frame();
    let drone = drone.min(frame.drones.len() - 1);
    let of_drone = &frame.drones[drone];
    let state = &of_drone.state;
    let last = frame.drones.len() - 1;
    ui.strong(if last > 0 { format!("Drone {drone} of 0 to {last}") } else { format!("Drone {drone}") });
    let rows = |ui: &mut egui::Ui, rows: &[(&str, String)]| {
        for (name, value) in rows {
            ui.label(*name);
            ui.monospace(value);
            ui.end_row();
        }
    };
    // without the sign of numbers that are rounded to zero
    let rounded = |x: f64, one: f64| (one * x).round() / one + 0.0;
    let three = |x: &[f64]| {
        let [a, b, c] = [0, 1, 2].map(|index| rounded(x[index], 1e3));
        format!("{a:8.3} {b:8.3} {c:8.3}")
    };
    let [w, i, j, k] = aviary::state::wxyz(&state.attitude).map(|x| rounded(x, 1e3));
    let degrees = of_drone.rpy.map(f64::to_degrees);
    let reference = of_drone.reference;
    let error = reference.map(|reference| (state.position - reference).norm());
    egui::Grid::new("state").num_columns(2).striped(true).show(ui, |ui| {
        rows(
            ui,
            &[
                ("position (m)", three(state.position.as_slice())),
                ("reference (m)", reference.map_or("–".into(), |reference| three(reference.as_slice()))),
                ("distance (m)", error.map_or("–".into(), |error| format!("{error:8.3}"))),
                ("roll, pitch, yaw (°)", three(degrees.as_slice())),
                ("attitude wxyz", format!("{w:6.3} {i:6.3} {j:6.3} {k:6.3}")),
                ("velocity (m/s)", three(state.velocity.as_slice())),
                ("body rates (rad/s)", three(state.angular_velocity.as_slice())),
                ("thrust (N)", format!("{:8.4}", of_drone.load.rotors.thrust)),
            ],
        );
        if let Some(voltage) = of_drone.voltage {
            rows(ui, &[("battery (V)", format!("{voltage:8.3}"))]);
        }
    });
    ui.add_space(6.0);
    for (motor, speed) in of_drone.rotor_speeds.iter().enumerate() {
        let share = (speed / of_drone.max_rpm.max(1.0)) as f32;
        let text = format!("motor {motor}: {speed:.0} rpm");
        ui.add(egui::ProgressBar::new(share.clamp(0.0, 1.0)).text(text).desired_width(ui.available_width()));
    }
    ui.add_space(6.0);
    ui.strong("Episode");
    egui::Grid::new("episode").num_columns(2).striped(true).show(ui, |ui| {
        let status = &flight.status;
        let seed = status.seed.map_or("–".into(), |seed| seed.to_string());
        let end = match (frame.end, of_drone.end) {
            (Some(end), _) | (None, Some(end)) => end.name(),
            _ => "–",
        };
        let steps = match flight.episode.max_steps {
            Some(max) => format!("{} of {max}", frame.step),
            None => frame.step.to_string(),
        };
        rows(
            ui,
            &[
                ("task", flight.episode.task.clone()),
                ("pilot", if status.pilot.is_empty() { "–".into() } else { status.pilot.clone() }),
                ("episode, seed", format!("{}, {seed}", flight.episode.number)),
                ("control step", steps),
            ],
        );
        // a replay has no task
        if flight.episode.max_steps.is_some() {
            rows(
                ui,
                &[
                    ("reward", format!("{:.4}", rounded(of_drone.reward, 1e4))),
                    ("reward of the episode", format!("{:.2}", frame.episode_reward)),
                    ("success", if frame.success { "yes" } else { "no" }.into()),
                    ("end", end.into()),
                ],
            );
        }
        for (name, value) in &frame.metrics {
            let is_count = matches!(*name, "gates_passed" | "waypoints_captured" | "crashed" | "contacts");
            let text = if is_count { format!("{value:.0}") } else { format!("{value:.4}") };
            rows(ui, &[(&name.replace('_', " "), text)]);
        }
    });
    if !of_drone.reward_terms.is_empty() {
        ui.add_space(6.0);
        ui.strong("Reward terms");
        egui::Grid::new("reward terms").num_columns(2).striped(true).show(ui, |ui| {
            for (name, value) in &of_drone.reward_terms {
                rows(ui, &[(&name.replace('_', " "), format!("{value:8.4}"))]);
            }
        });
    }
    if !frame.contacts.is_empty() {
        ui.add_space(6.0);
        ui.strong("Contacts");
        for contact in &frame.contacts {
            ui.label(format!("drone {} with {:?}", contact.drone, contact.with));
        }
    }
}
