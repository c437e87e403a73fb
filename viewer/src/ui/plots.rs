//! Live plots of the flight.

use std::sync::Arc;

use egui::Color32;
use egui_plot::{Line, LineStyle, Plot, PlotPoints};

use crate::flight::Flight;
use crate::frame::{DroneFrame, Frame};

/// Plots that are shown.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Plots {
    shown: [bool; 7],
    metric: Option<&'static str>,
    /// Reward terms that are not in the plot of the reward terms.
    hidden_terms: Vec<&'static str>,
    /// Time before the present that the plots show, s.
    window: f64,
}

impl Default for Plots {
    fn default() -> Self {
        Self {
            shown: [true, true, false, true, true, true, false],
            metric: None,
            hidden_terms: Vec::new(),
            window: 10.0,
        }
    }
}

const NAMES: [&str; 7] = [
    "position (m)",
    "attitude (°)",
    "velocity (m/s)",
    "rotor speeds (rpm)",
    "reward",
    "reward terms",
    "body rates (rad/s)",
];

/// Index of the plot of the reward terms.
const TERMS: usize = 5;

/// Largest number of points of a line.
const POINTS: usize = 600;

/// Plot with its lines.
#[derive(Debug, PartialEq)]
struct Chart {
    name: &'static str,
    lines: Vec<Series>,
}

/// Line of a plot.
#[derive(Debug, PartialEq)]
struct Series {
    name: String,
    /// Index of the colour.
    colour: usize,
    /// True for references, which are dashed.
    is_reference: bool,
    /// Times (s) and values.
    points: Vec<[f64; 2]>,
}

impl Plots {
    pub fn show(&mut self, ui: &mut egui::Ui, flight: &Flight, drone: usize) {
        let drone = drone.min(flight.frame().drones.len() - 1);
        ui.horizontal_wrapped(|ui| {
            for (name, shown) in NAMES.iter().zip(&mut self.shown) {
                ui.toggle_value(shown, *name);
            }
        });
        ui.add(egui::Slider::new(&mut self.window, 1.0..=120.0).logarithmic(true).text("last seconds"));
        let names: Vec<_> = flight.frame().metrics.iter().map(|(name, _)| *name).collect();
        egui::ComboBox::from_label("metric").selected_text(self.metric.unwrap_or("none")).show_ui(ui, |ui| {
            ui.selectable_value(&mut self.metric, None, "none");
            for name in names {
                ui.selectable_value(&mut self.metric, Some(name), name);
            }
        });
        for (index, chart) in self.charts(&self.frames(flight), drone) {
            if index == Some(TERMS) {
                self.select_terms(ui, flight, drone);
            }
            plot(ui, chart);
        }
    }

    /// Shows a button for every reward term, which shows or hides the term.
    fn select_terms(&mut self, ui: &mut egui::Ui, flight: &Flight, drone: usize) {
        ui.horizontal_wrapped(|ui| {
            for name in terms(flight.past(), drone) {
                let mut is_shown = !self.hidden_terms.contains(&name);
                if ui.toggle_value(&mut is_shown, spaced(name)).changed() {
                    self.hidden_terms.retain(|hidden| *hidden != name);
                    if !is_shown {
                        self.hidden_terms.push(name);
                    }
                }
            }
        });
    }

    /// Returns the plots of a drone, with their indices in [`NAMES`]; `None` for the plot of a metric.
    fn charts(&self, frames: &[Arc<Frame>], drone: usize) -> Vec<(Option<usize>, Chart)> {
        let of_frame = |name: &str, colour: usize, get: &dyn Fn(&Frame) -> Option<f64>| Series {
            name: name.into(),
            colour,
            is_reference: false,
            points: frames.iter().filter_map(|frame| Some([frame.time, get(frame)?])).collect(),
        };
        let of = |name: &str, colour: usize, get: &dyn Fn(&DroneFrame) -> Option<f64>| {
            of_frame(name, colour, &|frame| get(&frame.drones[drone]))
        };
        let axes = |get: &dyn Fn(&DroneFrame, usize) -> Option<f64>| -> Vec<Series> {
            let line = |(axis, name): (usize, &&str)| of(name, axis, &|frame| get(frame, axis));
            ["x", "y", "z"].iter().enumerate().map(line).collect()
        };
        let lines = |index: usize| match index {
            0 => {
                let mut lines = axes(&|frame, axis| Some(frame.state.position[axis]));
                let references = axes(&|frame, axis| frame.reference.map(|reference| reference[axis]));
                let references = references.into_iter().filter(|line| !line.points.is_empty());
                let renamed = |line: Series| Series { name: format!("reference {}", line.name), ..line };
                lines.extend(references.map(|line| Series { is_reference: true, ..renamed(line) }));
                lines
            }
            1 => {
                let line = |(axis, name): (usize, &&str)| of(name, axis, &|frame| Some(frame.rpy[axis].to_degrees()));
                ["roll", "pitch", "yaw"].iter().enumerate().map(line).collect()
            }
            2 => axes(&|frame, axis| Some(frame.state.velocity[axis])),
            3 => (0..4).map(|motor| of(&motor.to_string(), motor, &|frame| Some(frame.rotor_speeds[motor]))).collect(),
            // the state before the first control step has no reward
            4 => vec![of_frame("reward", 0, &|frame| (frame.step > 0).then(|| frame.drones[drone].reward))],
            TERMS => {
                let names = terms(frames, drone).into_iter().enumerate();
                let shown = names.filter(|(_, name)| !self.hidden_terms.contains(name));
                shown
                    .map(|(colour, name)| {
                        let value = |frame: &DroneFrame| value_of(&frame.reward_terms, name);
                        of(&spaced(name), colour, &value)
                    })
                    .collect()
            }
            _ => axes(&|frame, axis| Some(frame.state.angular_velocity[axis])),
        };
        let shown = (0..NAMES.len()).filter(|index| self.shown[*index]);
        let mut charts: Vec<_> =
            shown.map(|index| (Some(index), Chart { name: NAMES[index], lines: lines(index) })).collect();
        if let Some(metric) = self.metric {
            let line = of_frame(metric, 0, &|frame| value_of(&frame.metrics, metric));
            charts.push((None, Chart { name: metric, lines: vec![line] }));
        }
        charts
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

/// Returns the names of the reward terms of a drone; none before the first control step.
fn terms(frames: &[Arc<Frame>], drone: usize) -> Vec<&'static str> {
    let last = frames.last().map_or(&[][..], |frame| &frame.drones[drone].reward_terms);
    last.iter().map(|(name, _)| *name).collect()
}

/// Returns a value by its name.
fn value_of(values: &[(&'static str, f64)], name: &str) -> Option<f64> {
    values.iter().find(|(own, _)| *own == name).map(|(_, value)| *value)
}

/// Returns a name in lower snake case with spaces.
fn spaced(name: &str) -> String {
    name.replace('_', " ")
}

/// Draws a plot under a line with the names of its lines.
fn plot(ui: &mut egui::Ui, Chart { name, lines }: Chart) {
    ui.horizontal_wrapped(|ui| {
        ui.label(name);
        for line in lines.iter().filter(|line| !line.is_reference) {
            ui.colored_label(COLOURS[line.colour % COLOURS.len()], &line.name);
        }
        if lines.iter().any(|line| line.is_reference) {
            ui.weak("reference dashed");
        }
    });
    Plot::new(name).height(120.0).allow_scroll(false).allow_drag(false).allow_zoom(false).show(ui, |plot| {
        for Series { name, colour, is_reference, points } in lines {
            let style = if is_reference { LineStyle::dashed_loose() } else { LineStyle::Solid };
            let line = Line::new(name, PlotPoints::from(points)).color(COLOURS[colour % COLOURS.len()]);
            plot.line(line.style(style).width(1.5));
        }
    });
    ui.add_space(4.0);
}

/// Colours of the lines: red, green and blue for x, y and z.
const COLOURS: [Color32; 8] = [
    Color32::from_rgb(235, 100, 90),
    Color32::from_rgb(110, 200, 110),
    Color32::from_rgb(95, 155, 245),
    Color32::from_rgb(225, 185, 80),
    Color32::from_rgb(190, 130, 230),
    Color32::from_rgb(90, 205, 205),
    Color32::from_rgb(240, 150, 195),
    Color32::from_rgb(170, 170, 170),
];

#[cfg(test)]
mod tests {
    use aviary::env::{DroneEnv, EnvConfig};
    use aviary::tasks::{NAMES as TASKS, make};

    use super::*;
    use crate::frame::Source;

    /// Flies some control steps and returns the frames, the first one before the first control step.
    fn frames(task: &str) -> (Box<dyn DroneEnv + Send>, Vec<Arc<Frame>>) {
        let mut env = make(task, EnvConfig::default()).unwrap();
        env.reset(Some(3)).unwrap();
        let mut frames: Vec<Arc<Frame>> = Vec::new();
        let mut add = |env: &dyn DroneEnv| {
            let before = frames.last().cloned();
            frames.push(Arc::new(Frame::new(Source::Env(env), before.as_deref(), |_| None)));
        };
        add(&*env);
        let action = vec![0.2; env.action_space().size()];
        for _ in 0..5 {
            env.step(&action).unwrap();
            add(&*env);
        }
        (env, frames)
    }

    fn chart_of_terms(plots: &Plots, frames: &[Arc<Frame>], drone: usize) -> Option<Chart> {
        let mut charts = plots.charts(frames, drone).into_iter();
        charts.find(|(index, _)| *index == Some(TERMS)).map(|(_, chart)| chart)
    }

    #[test]
    fn every_reward_term_of_every_task_has_a_line_of_its_own_colour() {
        for task in TASKS {
            let (env, frames) = frames(task);
            for drone in 0..env.simulation().num_drones() {
                let chart = chart_of_terms(&Plots::default(), &frames, drone).unwrap();
                let terms = env.reward_terms(drone);
                assert!(!terms.is_empty() && chart.lines.len() == terms.len(), "{task}: {chart:?}");
                for (index, (line, (name, value))) in chart.lines.iter().zip(&terms).enumerate() {
                    assert_eq!(line.name, name.replace('_', " "));
                    assert!(line.colour == index && index < COLOURS.len());
                    // no term belongs to the state before the first step
                    let times: Vec<_> = frames[1..].iter().map(|frame| frame.time).collect();
                    assert_eq!(line.points.iter().map(|point| point[0]).collect::<Vec<_>>(), times);
                    assert_eq!(line.points[4][1], *value);
                }
                let of_step = |step: usize| chart.lines.iter().map(|line| line.points[step][1]).sum::<f64>();
                for step in 0..5 {
                    assert_eq!(of_step(step), frames[step + 1].drones[drone].reward, "{task}");
                }
            }
        }
    }

    #[test]
    fn hidden_terms_and_plots_have_no_lines() {
        let (_, frames) = frames("hover");
        let mut plots = Plots { hidden_terms: vec!["tilt"], ..Plots::default() };
        let chart = chart_of_terms(&plots, &frames, 0).unwrap();
        let names: Vec<_> = chart.lines.iter().map(|line| (line.name.as_str(), line.colour)).collect();
        // the colours of the other terms stay
        let expected = [("height error", 0), ("horizontal error", 1), ("speed", 2), ("at target", 4), ("crash", 5)];
        assert_eq!(names, expected);
        plots.shown[TERMS] = false;
        assert_eq!(chart_of_terms(&plots, &frames, 0), None);
        let before_the_first_step = chart_of_terms(&Plots::default(), &frames[..1], 0).unwrap();
        assert_eq!(before_the_first_step.lines, []);
    }

    #[test]
    fn a_metric_has_a_plot() {
        let (env, frames) = frames("formation");
        let plots = Plots { metric: Some("position_error"), ..Plots::default() };
        let (index, chart) = plots.charts(&frames, 0).pop().unwrap();
        assert_eq!((index, chart.name, chart.lines.len()), (None, "position_error", 1));
        assert_eq!(chart.lines[0].points[5][1], env.info().position_error);
    }
}
