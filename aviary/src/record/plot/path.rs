//! Plots of flown paths, from above and in 3D.

use nalgebra::Vector3;
use plotters::coord::Shift;
use plotters::prelude::*;
use plotters::style::text_anchor::{HPos, VPos};

use super::canvas::{
    Axis, Canvas, Drawn, Stroke, draw_axes, draw_line, font, label_of, legend, px, span, text, thin_path,
};
use super::{check, rgb};
use crate::record::{Flight, RecordError};

#[derive(Debug, Clone)]
struct DronePath {
    points: Vec<Vector3<f64>>,
    stroke: Stroke,
}

#[derive(Debug, Clone)]
pub(super) struct Paths {
    flown: Vec<DronePath>,
    references: Vec<DronePath>,
    /// Centre and half extent of all paths, world frame, m.
    middle: Vector3<f64>,
    half: Vector3<f64>,
}

impl Paths {
    pub fn of(flight: &Flight) -> Result<Self, RecordError> {
        let count = flight.drones.len();
        let flown: Vec<_> = (0..count)
            .map(|drone| DronePath { points: flight.positions(drone), stroke: Stroke::of(drone, count) })
            .collect();
        let references: Vec<_> = (flight.drones.iter())
            .map(|samples| DronePath {
                points: samples.iter().filter_map(|sample| sample.reference).map(|(at, _)| at.into()).collect(),
                stroke: Stroke::REFERENCE,
            })
            .collect();
        let points = || flown.iter().chain(&references).flat_map(|path| &path.points);
        check(points().flatten())?;
        let axis = |i: usize| span(points().map(|point| point[i]), 0.2, 0.06);
        let (x, y, z) = (axis(0), axis(1), axis(2));
        let middle = 0.5 * Vector3::new(x.0 + x.1, y.0 + y.1, z.0 + z.1);
        let half = 0.5 * Vector3::new(x.1 - x.0, y.1 - y.0, z.1 - z.0);
        Ok(Self { flown, references, middle, half })
    }

    pub fn draw<B: Canvas>(&self, area: &DrawingArea<B, Shift>) -> Drawn<B> {
        let mut area = area.clone();
        let mut entries: Vec<_> = Vec::new();
        if self.flown.len() > 1 {
            let drones = self.flown.iter().enumerate().take(16);
            entries.extend(drones.map(|(drone, path)| (format!("drone {drone}"), path.stroke)));
        }
        if self.references.iter().any(|path| !path.points.is_empty()) {
            if entries.is_empty() {
                entries.push(("flown".into(), self.flown[0].stroke));
            }
            entries.push(("reference".into(), Stroke::REFERENCE));
        }
        for entries in entries.chunks(9) {
            let (head, rest) = area.split_vertically(px(22));
            legend(&head, (head.dim_in_pixel().0 as i32 - px(14), px(10)), entries)?;
            area = rest;
        }
        let (left, right) = area.split_horizontally(px(520));
        self.draw_from_above(&left)?;
        self.draw_in_space(&right)
    }

    fn draw_from_above<B: Canvas>(&self, area: &DrawingArea<B, Shift>) -> Drawn<B> {
        let (width, height) = area.dim_in_pixel();
        // the area without labels and margins, so that a metre has the same length on both axes
        let (across, up) = (f64::from(width as i32 - px(90)), f64::from(height as i32 - px(64)));
        let metre = (across / (2.0 * self.half.x)).min(up / (2.0 * self.half.y));
        let (x, y) = (0.5 * across / metre, 0.5 * up / metre);
        let (x, y) = ((self.middle.x - x, self.middle.x + x), (self.middle.y - y, self.middle.y + y));
        let mut chart = ChartBuilder::on(area)
            .margin_left(px(8))
            .margin_right(px(14))
            .margin_top(px(14))
            .margin_bottom(px(4))
            .x_label_area_size(px(46))
            .y_label_area_size(px(68))
            .build_cartesian_2d(x.0..x.1, y.0..y.1)?;
        let (across, up) = (Axis { range: x, ticks: 7, name: "x (m)" }, Axis { range: y, ticks: 7, name: "y (m)" });
        draw_axes(&mut chart, &across, &up)?;
        let range = chart.plotting_area().get_pixel_range();
        let inner = chart.plotting_area().strip_coord_spec();
        let map = |point: &Vector3<f64>| {
            let (x, y) = chart.plotting_area().map_coordinate(&(point.x, point.y));
            (x - range.0.start, y - range.1.start)
        };
        self.draw_paths(&inner, &map)
    }

    fn draw_in_space<B: Canvas>(&self, area: &DrawingArea<B, Shift>) -> Drawn<B> {
        const PITCH: f64 = 0.42;
        const YAW: f64 = 0.6;
        // flat flights get a minimum height
        let half = self.half.map(|half| half.max(0.4 * self.half.max()));
        let range = |i: usize| self.middle[i] - half[i]..self.middle[i] + half[i];
        // the third axis of plotters points towards the viewer; −y makes x, y and z a right-handed frame
        let towards = -self.middle.y - half.y..-self.middle.y + half.y;
        let mut chart =
            ChartBuilder::on(area).margin(px(10)).build_cartesian_3d(range(0), range(2), towards.clone())?;
        // a metre has the same length on all axes, and the projected box fills the area without the labels
        let (width, height) = area.dim_in_pixel();
        let across = 2.0 * (half.x * YAW.cos() + half.y * YAW.sin());
        let up = 2.0 * (half.z * PITCH.cos() + (half.x * YAW.sin() + half.y * YAW.cos()) * PITCH.sin());
        let metre = (f64::from(width as i32 - px(150)) / across).min(f64::from(height as i32 - px(130)) / up);
        let length = |half: f64| (2.0 * metre * half) as i32;
        chart.set_3d_pixel_range((length(half.x), length(half.z), length(half.y)));
        chart.with_projection(|mut projection| {
            (projection.pitch, projection.yaw, projection.scale) = (PITCH, YAW, 1.0);
            projection.into_matrix()
        });
        // a short axis has room for few numbers
        let ticks = |of: f64| if of < 0.6 * half.max() { 2 } else { 5 };
        let line = |grey: u8| RGBColor(grey, grey, grey).stroke_width(px(1) as u32 / 2);
        let (x, y, z) = (range(0), range(1), range(2));
        let y_label = label_of((y.start, y.end));
        chart
            .configure_axes()
            .axis_panel_style(TRANSPARENT)
            .bold_grid_style(line(205))
            .light_grid_style(TRANSPARENT)
            .label_style(TextStyle::from(font(11)).color(&RGBColor(40, 40, 40)))
            .tick_size(px(4))
            .x_labels(ticks(half.x))
            .y_labels(ticks(half.z))
            .z_labels(ticks(half.y))
            .x_formatter(&label_of((x.start, x.end)))
            .y_formatter(&label_of((z.start, z.end)))
            .z_formatter(&|minus_y: &f64| y_label(&-minus_y))
            .draw()?;
        let range = chart.plotting_area().get_pixel_range();
        let corner_of_area = (range.0.start, range.1.start);
        let inner = chart.plotting_area().strip_coord_spec();
        let map = |point: &Vector3<f64>| {
            let (across, down) = chart.plotting_area().map_coordinate(&(point.x, point.z, -point.y));
            (across - corner_of_area.0, down - corner_of_area.1)
        };
        // axis names stand next to the middle of the edge that has the ticks: of the edges of the three rear walls,
        // plotters uses the nearest one and, of equally near ones, the highest one in the image
        let walls = [[x.start, x.end], [z.start, z.end], [towards.start, towards.end]];
        let depth = |corner: [f64; 3]| {
            chart.plotting_area().as_coord_spec().projected_depth(&corner[0], &corner[1], &corner[2])
        };
        let pixel = |corner: [f64; 3]| {
            let (across, down) = chart.plotting_area().map_coordinate(&(corner[0], corner[1], corner[2]));
            (across - corner_of_area.0, down - corner_of_area.1)
        };
        let far = [0, 1, 2].map(|axis| {
            let mut other = walls.map(|wall| wall[0]);
            let here = depth(other);
            other[axis] = walls[axis][1];
            if here >= depth(other) { walls[axis][0] } else { walls[axis][1] }
        });
        let (width, height) = inner.dim_in_pixel();
        for (axis, name) in ["x (m)", "z (m)", "y (m)"].into_iter().enumerate() {
            let edges = (0..3).filter(|&wall| wall != axis).flat_map(|wall| {
                let other = 3 - axis - wall;
                walls[other].map(|side| {
                    let mut ends = [[0.0; 3]; 2];
                    for (end, place) in ends.iter_mut().zip(walls[axis]) {
                        (end[axis], end[wall], end[other]) = (place, far[wall], side);
                    }
                    ends
                })
            });
            let nearness =
                |ends: &[[f64; 3]; 2]| (depth(ends[0]) + depth(ends[1]), pixel(ends[0]).1 + pixel(ends[1]).1);
            let Some([from, to]) = edges.min_by_key(nearness) else { continue };
            let (from, to) = (pixel(from), pixel(to));
            // ticks are next to a steep edge and above or below a flat one
            let is_steep = (to.0 - from.0).abs() < (to.1 - from.1).abs();
            let left = if from.0 < width as i32 / 2 { -1 } else { 1 };
            let above = if from.1 < height as i32 / 2 { -1 } else { 1 };
            let aside = if is_steep { (52 * left, 0) } else { (0, 34 * above) };
            let at = ((from.0 + to.0) / 2 + px(aside.0), (from.1 + to.1) / 2 + px(aside.1));
            inner.draw(&Text::new(name, at, text(13, HPos::Center, VPos::Center)))?;
        }
        self.draw_paths(&inner, &map)
    }

    fn draw_paths<B: Canvas>(
        &self,
        area: &DrawingArea<B, Shift>,
        map: &dyn Fn(&Vector3<f64>) -> (i32, i32),
    ) -> Drawn<B> {
        for path in self.flown.iter().chain(&self.references) {
            let pixels = thin_path(path.points.iter().map(map));
            match pixels[..] {
                [] => {}
                // a constant reference is a cross
                [(x, y)] => {
                    let style = rgb(path.stroke.colour).stroke_width(px(1) as u32);
                    let arm = px(5);
                    area.draw(&PathElement::new([(x - arm, y), (x + arm, y)], style))?;
                    area.draw(&PathElement::new([(x, y - arm), (x, y + arm)], style))?;
                }
                _ => draw_line(area, pixels, path.stroke)?,
            }
        }
        for path in &self.flown {
            if let (Some(first), Some(last)) = (path.points.first(), path.points.last()) {
                let colour = rgb(path.stroke.colour);
                area.draw(&Circle::new(map(first), px(5), WHITE.filled()))?;
                area.draw(&Circle::new(map(first), px(5), colour.stroke_width(px(1) as u32)))?;
                area.draw(&Circle::new(map(last), px(4), colour.filled()))?;
            }
        }
        Ok(())
    }
}
