//! Plots of time series in a grid of panels.

use nalgebra::Vector3;
use plotters::coord::Shift;
use plotters::prelude::*;
use plotters::style::text_anchor::{HPos, VPos};

use super::canvas::{Axis, Canvas, Drawn, Stroke, draw_axes, draw_line, legend, px, span, text, thin};
use super::{Series, check};
use crate::record::{Flight, RecordError, Sample};

#[derive(Debug, Clone)]
struct Line {
    /// Name in the legend; empty for lines without an entry.
    name: String,
    points: Vec<(f64, f64)>,
    stroke: Stroke,
}

#[derive(Debug, Clone)]
struct Panel {
    label: String,
    lines: Vec<Line>,
    /// Minimum length of the value axis.
    min: f64,
}

/// Default label of the common axis.
const TIME: &str = "time (s)";

/// Panels over a common axis.
#[derive(Debug, Clone)]
pub(super) struct Panels {
    panels: Vec<Panel>,
    columns: usize,
    /// Label of the common axis.
    pub over: String,
    /// Common legend for panels without their own.
    legend: Vec<(String, Stroke)>,
}

/// Quantity that a line shows. Indices of components start at 0.
#[derive(Debug, Clone, Copy, PartialEq)]
enum Quantity {
    /// Position, world frame, m.
    Position(usize),
    /// Reference position, world frame, m.
    ReferencePosition(usize),
    /// Distance from the reference position, m.
    Distance,
    /// Roll, pitch or yaw, degrees.
    Attitude(usize),
    /// Angle between the body's z axis and the vertical, degrees.
    Tilt,
    /// Velocity, world frame, m/s.
    Velocity(usize),
    /// Norm of the velocity, m/s.
    Speed,
    /// Motor speed, rpm.
    Motor(usize),
}
use Quantity::{Attitude, Distance, Motor, Position, ReferencePosition, Speed, Tilt, Velocity};

impl Panels {
    pub fn of_series(panels: &[(&str, Vec<Series>)]) -> Result<Self, RecordError> {
        let points = panels.iter().flat_map(|(_, lines)| lines).flat_map(|line| &line.points);
        check(points.flat_map(|(x, y)| [x, y]))?;
        let panel = |(label, lines): &(&str, Vec<Series>)| Panel {
            label: label.to_string(),
            lines: (lines.iter().enumerate())
                .map(|(index, line)| Line {
                    name: line.name.clone(),
                    points: line.points.clone(),
                    stroke: Stroke::of(index, lines.len()),
                })
                .collect(),
            min: 0.0,
        };
        Ok(Self { panels: panels.iter().map(panel).collect(), columns: 1, over: TIME.into(), legend: Vec::new() })
    }

    pub fn of_flight(flight: &Flight) -> Result<Self, RecordError> {
        let samples = flight.drones.iter().flatten();
        check(samples.flat_map(|sample| {
            let state = &sample.state;
            let reference = sample.reference.iter().flat_map(|(position, yaw)| position.iter().chain([yaw]));
            (std::iter::once(&sample.time).chain(&state.position).chain(state.attitude.coords.iter()))
                .chain(&state.velocity)
                .chain(&sample.motor_speeds)
                .chain(reference)
        }))?;
        Ok(match &flight.drones[..] {
            [alone] => Self::of_one(alone),
            drones => Self::of_several(drones),
        })
    }

    /// Creates four panels for one drone, with a line per component.
    fn of_one(samples: &[Sample]) -> Self {
        let panel = |label: &str, min: f64, names: &[&str], quantity: fn(usize) -> Quantity| {
            let lines = names.iter().enumerate().map(|(index, name)| Line {
                name: name.to_string(),
                points: quantity(index).series(samples),
                stroke: Stroke::of(index, names.len()),
            });
            Panel { label: label.into(), lines: lines.collect(), min }
        };
        let mut position = panel("position (m)", 0.1, &["x", "y", "z"], Position);
        for axis in 0..3 {
            let points = ReferencePosition(axis).series(samples);
            if !points.is_empty() {
                // one legend entry stands for all references, whose thin lines are drawn on top
                let name = if axis == 0 { "reference" } else { "" };
                position.lines.push(Line { name: name.into(), points, stroke: Stroke::REFERENCE });
            }
        }
        Self {
            panels: vec![
                position,
                panel("attitude (°)", 2.0, &["roll", "pitch", "yaw"], Attitude),
                panel("velocity (m/s)", 0.1, &["vx", "vy", "vz"], Velocity),
                panel("motor speed (rpm)", 200.0, &["0", "1", "2", "3"], Motor),
            ],
            columns: 2,
            over: TIME.into(),
            legend: Vec::new(),
        }
    }

    /// Creates a panel for every quantity, with a line per drone.
    fn of_several(drones: &[Vec<Sample>]) -> Self {
        let count = drones.len();
        let panel = |(label, quantity): (&str, Quantity), min: f64| {
            let mut lines = Vec::new();
            for (drone, samples) in drones.iter().enumerate() {
                let stroke = Stroke::of(drone, count);
                lines.push(Line { name: String::new(), points: quantity.series(samples), stroke });
            }
            if let Position(axis) = quantity {
                for samples in drones {
                    let points = ReferencePosition(axis).series(samples);
                    lines.push(Line { name: String::new(), points, stroke: Stroke::REFERENCE });
                }
            }
            Panel { label: label.into(), lines, min }
        };
        let rows: [([(&str, Quantity); 4], f64); 4] = [
            (
                [
                    ("x (m)", Position(0)),
                    ("y (m)", Position(1)),
                    ("z (m)", Position(2)),
                    ("distance from reference (m)", Distance),
                ],
                0.1,
            ),
            (
                [("roll (°)", Attitude(0)), ("pitch (°)", Attitude(1)), ("yaw (°)", Attitude(2)), ("tilt (°)", Tilt)],
                2.0,
            ),
            (
                [
                    ("vx (m/s)", Velocity(0)),
                    ("vy (m/s)", Velocity(1)),
                    ("vz (m/s)", Velocity(2)),
                    ("speed (m/s)", Speed),
                ],
                0.1,
            ),
            (
                [
                    ("motor 0 (rpm)", Motor(0)),
                    ("motor 1 (rpm)", Motor(1)),
                    ("motor 2 (rpm)", Motor(2)),
                    ("motor 3 (rpm)", Motor(3)),
                ],
                200.0,
            ),
        ];
        let panels = rows.into_iter().flat_map(|(row, min)| row.map(|entry| panel(entry, min)));
        let mut legend: Vec<_> =
            (0..count.min(16)).map(|drone| (format!("drone {drone}"), Stroke::of(drone, count))).collect();
        if drones.iter().flatten().any(|sample| sample.reference.is_some()) {
            legend.push(("reference".into(), Stroke::REFERENCE));
        }
        Self { panels: panels.collect(), columns: 4, over: TIME.into(), legend }
    }

    /// Arranges the panels in columns, with a common legend if all panels have lines of the same names.
    pub fn arrange(&mut self, columns: usize) {
        self.columns = columns;
        let entries =
            |panel: &Panel| -> Vec<_> { panel.lines.iter().map(|line| (line.name.clone(), line.stroke)).collect() };
        let Some(first) = self.panels.first().map(entries) else { return };
        if self.legend.is_empty() && self.panels.iter().all(|panel| entries(panel) == first) {
            self.legend = first;
            for line in self.panels.iter_mut().flat_map(|panel| &mut panel.lines) {
                line.name.clear();
            }
        }
    }

    pub fn columns(&self) -> usize {
        self.columns
    }

    pub fn rows(&self) -> u32 {
        self.panels.len().div_ceil(self.columns) as u32
    }

    pub fn draw<B: Canvas>(&self, area: &DrawingArea<B, Shift>) -> Drawn<B> {
        let mut area = area.clone();
        if !self.legend.is_empty() {
            // rows hold as many entries as fit
            for entries in self.legend.chunks(13) {
                let (head, rest) = area.split_vertically(px(22));
                legend(&head, (head.dim_in_pixel().0 as i32 - px(14), px(10)), entries)?;
                area = rest;
            }
        }
        let points = || self.panels.iter().flat_map(|panel| &panel.lines).flat_map(|line| &line.points);
        let times = span(points().map(|(t, _)| *t), 0.0, 0.0);
        let rows = self.rows() as usize;
        let cells = area.split_evenly((rows, self.columns));
        for (index, (cell, panel)) in cells.iter().zip(&self.panels).enumerate() {
            let lowest = index / self.columns + 1 == rows;
            panel.draw(cell, times, lowest.then_some(&*self.over))?;
        }
        Ok(())
    }
}

impl Panel {
    fn draw<B: Canvas>(&self, area: &DrawingArea<B, Shift>, times: (f64, f64), over: Option<&str>) -> Drawn<B> {
        let values = span(self.lines.iter().flat_map(|line| &line.points).map(|(_, y)| *y), self.min, 0.06);
        let (head, body) = area.split_vertically(px(26));
        head.draw(&Text::new(self.label.clone(), (px(14), px(16)), text(13, HPos::Left, VPos::Center)))?;
        let named: Vec<_> = self
            .lines
            .iter()
            .filter(|line| !line.name.is_empty())
            .map(|line| (line.name.clone(), line.stroke))
            .collect();
        if named.len() > 1 {
            legend(&head, (head.dim_in_pixel().0 as i32 - px(14), px(16)), &named)?;
        }
        let mut chart = ChartBuilder::on(&body)
            .margin_left(px(6))
            .margin_right(px(14))
            .margin_top(px(2))
            .x_label_area_size(px(if over.is_some() { 40 } else { 24 }))
            .y_label_area_size(px(58))
            .build_cartesian_2d(times.0..times.1, values.0..values.1)?;
        let many = body.dim_in_pixel().0 > px(450) as u32;
        let name = over.unwrap_or("");
        let time = Axis { range: times, ticks: if many { 11 } else { 6 }, name };
        draw_axes(&mut chart, &time, &Axis { range: values, ticks: 6, name: "" })?;
        let inner = chart.plotting_area().strip_coord_spec();
        let (left, top) =
            (chart.plotting_area().get_pixel_range().0.start, chart.plotting_area().get_pixel_range().1.start);
        for line in self.lines.iter().filter(|line| !line.points.is_empty()) {
            let pixels: Vec<_> = (line.points.iter())
                .map(|point| chart.plotting_area().map_coordinate(point))
                .map(|(x, y)| (x - left, y - top))
                .collect();
            draw_line(&inner, thin(&pixels), line.stroke)?;
        }
        Ok(())
    }
}

impl Quantity {
    /// Returns the value of the quantity; `None` for a sample without the required reference.
    fn of(self, sample: &Sample) -> Option<f64> {
        let Sample { state, reference, motor_speeds, .. } = sample;
        Some(match self {
            Position(axis) => state.position[axis],
            ReferencePosition(axis) => reference.as_ref()?.0[axis],
            Distance => (state.position - Vector3::from(reference.as_ref()?.0)).norm(),
            Attitude(axis) => state.rpy()[axis].to_degrees(),
            Tilt => state.tilt().to_degrees(),
            Velocity(axis) => state.velocity[axis],
            Speed => state.velocity.norm(),
            Motor(motor) => motor_speeds[motor],
        })
    }

    /// Returns the quantity over time. Angles are unwrapped.
    fn series(self, samples: &[Sample]) -> Vec<(f64, f64)> {
        // the first sample precedes all motor commands
        let skipped = usize::from(matches!(self, Motor(_)) && samples.len() > 1);
        let points = samples.iter().skip(skipped).filter_map(|sample| Some((sample.time, self.of(sample)?)));
        let mut points: Vec<_> = points.collect();
        if matches!(self, Attitude(_)) {
            let mut turns = 0.0;
            for i in 1..points.len() {
                let jump: f64 = points[i].1 + turns - points[i - 1].1;
                turns -= 360.0 * (jump / 360.0).round();
                points[i].1 += turns;
            }
        }
        points
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::state::DroneState;

    #[test]
    fn yaw_is_continuous_where_it_wraps() {
        let sample = |i: u32| Sample {
            time: f64::from(i),
            state: DroneState::at_rest(Vector3::zeros(), Vector3::new(0.0, 0.0, -0.5 * f64::from(i))),
            acceleration: Vector3::zeros(),
            motor_speeds: [0.0; 4],
            reward: 0.0,
            reference: None,
        };
        let samples: Vec<_> = (0..40).map(sample).collect();
        for (t, yaw) in Attitude(2).series(&samples) {
            assert!((yaw + (0.5 * t).to_degrees()).abs() < 1e-6, "{t}: {yaw}");
        }
        assert!(Distance.series(&samples).is_empty() && Motor(0).series(&samples).len() == 39);
    }
}
