//! Drawing of plots: backends, dashed lines, labels and legends.

use std::sync::Once;

use plotters::coord::Shift;
use plotters::coord::types::RangedCoordf64;
use plotters::prelude::*;
use plotters::style::register_font;
use plotters::style::text_anchor::{HPos, Pos, VPos};

use super::{Plot, rgb};
use crate::record::RecordError;
use crate::record::images::png_rgb;
use crate::vision::ImageSize;

/// Drawing backend of plots.
pub(super) trait Canvas: DrawingBackend {
    /// True if the backend draws lines in pieces. The bitmap backend of plotters fills a thick line as one polygon,
    /// which has holes where the line crosses itself and spikes where it reverses. SVG has lines.
    const PIECEWISE: bool;
}

impl Canvas for SVGBackend<'_> {
    const PIECEWISE: bool = false;
}

impl Canvas for BitMapBackend<'_> {
    const PIECEWISE: bool = true;
}

/// Result of drawing with a backend.
pub(super) type Drawn<B> = Result<(), DrawingAreaErrorKind<<B as DrawingBackend>::ErrorType>>;

/// Scale of all coordinates. The coordinates of plotters are whole pixels, so a larger scale makes them finer.
pub(super) const FINE: i32 = 4;

/// Number of PNG pixels per SVG pixel.
const PNG_SCALE: i32 = 2;

/// Converts a length from pixels to fine pixels.
pub(super) fn px(length: i32) -> i32 {
    length * FINE
}

/// Returns the font of plots in a size in pixels.
pub(super) fn font(size: i32) -> FontDesc<'static> {
    ("sans-serif", px(size)).into_font()
}

/// Returns the style of dark text that is anchored at a point.
pub(super) fn text(size: i32, horizontal: HPos, vertical: VPos) -> TextStyle<'static> {
    TextStyle::from(font(size)).color(&RGBColor(40, 40, 40)).pos(Pos::new(horizontal, vertical))
}

/// Registers the font, which is part of the program.
fn register() {
    static ONCE: Once = Once::new();
    ONCE.call_once(|| {
        // registration fails only for invalid font data, and then every plot returns an error about its text
        let _ = register_font("sans-serif", FontStyle::Normal, dejavu::sans::regular());
    });
}

fn failed(error: &dyn std::fmt::Display) -> RecordError {
    RecordError::Plot(error.to_string())
}

pub(super) fn svg(plot: &Plot) -> Result<String, RecordError> {
    register();
    let (width, height) = plot.size;
    let fine = (width * FINE as u32, height * FINE as u32);
    let mut svg = String::new();
    {
        let area = SVGBackend::with_string(&mut svg, fine).into_drawing_area();
        plot.draw(&area).and_then(|()| area.present()).map_err(|error| failed(&error))?;
    }
    // the SVG has the size of the plot and fine coordinates
    let (as_drawn, as_shown) =
        (format!("width=\"{}\" height=\"{}\"", fine.0, fine.1), format!("width=\"{width}\" height=\"{height}\""));
    Ok(svg.replacen(&as_drawn, &as_shown, 1))
}

pub(super) fn png(plot: &Plot) -> Result<Vec<u8>, RecordError> {
    register();
    let (width, height) = plot.size;
    let fine = (width * FINE as u32, height * FINE as u32);
    let mut pixels = vec![255; 3 * fine.0 as usize * fine.1 as usize];
    {
        let area = BitMapBackend::with_buffer(&mut pixels, fine).into_drawing_area();
        plot.draw(&area).and_then(|()| area.present()).map_err(|error| failed(&error))?;
    }
    let size = ImageSize { width: width * PNG_SCALE as u32, height: height * PNG_SCALE as u32 };
    png_rgb(size, &shrink(&pixels, fine.0 as usize, (FINE / PNG_SCALE) as usize))
}

/// Returns the means of squares of pixels, which smooth the edges.
fn shrink(pixels: &[u8], width: usize, by: usize) -> Vec<u8> {
    let mut out = Vec::with_capacity(pixels.len() / (by * by));
    for rows in pixels.chunks_exact(3 * width * by) {
        for column in 0..width / by {
            for channel in 0..3 {
                let square = (0..by * by).map(|i| 3 * (i / by * width + column * by + i % by) + channel);
                let sum: usize = square.map(|at| usize::from(rows[at])).sum();
                out.push((sum / (by * by)) as u8);
            }
        }
    }
    out
}

/// Draws a title at the top of an area and returns the rest of the area.
pub(super) fn titled<B: Canvas>(
    area: &DrawingArea<B, Shift>,
    title: &str,
) -> Result<DrawingArea<B, Shift>, DrawingAreaErrorKind<B::ErrorType>> {
    area.fill(&WHITE)?;
    if title.is_empty() {
        return Ok(area.clone());
    }
    let (head, rest) = area.split_vertically(px(40));
    let middle = head.dim_in_pixel().0 as i32 / 2;
    head.draw(&Text::new(title.to_string(), (middle, px(24)), text(19, HPos::Center, VPos::Center)))?;
    Ok(rest)
}

/// A chart with two numeric axes.
pub(super) type Chart<'a, B> = ChartContext<'a, B, Cartesian2d<RangedCoordf64, RangedCoordf64>>;

/// An axis with its range, its approximate number of ticks and its name.
pub(super) struct Axis<'a> {
    pub range: (f64, f64),
    pub ticks: usize,
    pub name: &'a str,
}

/// Draws axes, ticks and a light grid.
pub(super) fn draw_axes<B: Canvas>(chart: &mut Chart<'_, B>, x: &Axis<'_>, y: &Axis<'_>) -> Drawn<B> {
    let dark = RGBColor(40, 40, 40);
    chart
        .configure_mesh()
        .axis_style(RGBColor(150, 150, 150).stroke_width(px(1) as u32))
        .bold_line_style(RGBColor(225, 225, 225).stroke_width(px(1) as u32 / 2))
        .light_line_style(TRANSPARENT)
        .label_style(TextStyle::from(font(11)).color(&dark))
        .x_labels(x.ticks)
        .y_labels(y.ticks)
        .set_all_tick_mark_size(px(4))
        .x_label_formatter(&label_of(x.range))
        .y_label_formatter(&label_of(y.range))
        .axis_desc_style(TextStyle::from(font(12)).color(&dark))
        .x_desc(x.name)
        .y_desc(y.name)
        .draw()
}

/// Style of a line.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Stroke {
    pub colour: [u8; 3],
    /// Line width, quarters of a pixel.
    pub width: u32,
    /// Alternating lengths of dashes and gaps, pixels; empty for a solid line.
    pub dashes: &'static [i32],
}

impl Stroke {
    /// Returns the style of line `index` of `count`. Colour and dashes both distinguish the lines.
    pub fn of(index: usize, count: usize) -> Self {
        const DASHES: [&[i32]; 4] = [&[], &[9, 3], &[3, 2], &[12, 3, 3, 3]];
        // many lines differ only in colour, because overlapping dashes are unreadable
        let dashes = if count <= DASHES.len() { DASHES[index % DASHES.len()] } else { &[] };
        Self { colour: super::bytes_of(index, count), width: if count > 7 { 5 } else { 7 }, dashes }
    }

    /// Style of references: thin, grey, short dashes.
    pub const REFERENCE: Self = Self { colour: [110, 110, 110], width: 4, dashes: &[4, 3] };
}

/// Draws a line through points in fine pixels of the area.
pub(super) fn draw_line<B: Canvas>(area: &DrawingArea<B, Shift>, points: Vec<(i32, i32)>, stroke: Stroke) -> Drawn<B> {
    let style = rgb(stroke.colour).stroke_width(stroke.width);
    let lines = if stroke.dashes.is_empty() { vec![points] } else { dashed(&points, stroke.dashes) };
    for line in lines {
        if !B::PIECEWISE {
            area.draw(&PathElement::new(line, style))?;
            continue;
        }
        for pair in line.windows(2) {
            area.draw(&PathElement::new(pair, style))?;
        }
        // round corners close the gaps between the pieces
        for &corner in line.iter().skip(1).take(line.len().saturating_sub(2)) {
            area.draw(&Circle::new(corner, stroke.width as i32 / 2, rgb(stroke.colour).filled()))?;
        }
    }
    Ok(())
}

/// Returns the points of a path that are at least a pixel apart, and the last point.
pub(super) fn thin_path(points: impl Iterator<Item = (i32, i32)>) -> Vec<(i32, i32)> {
    let mut thinned: Vec<(i32, i32)> = Vec::new();
    let mut left_out = None;
    for point in points {
        let near = |last: &(i32, i32)| (last.0 - point.0).abs().max((last.1 - point.1).abs()) < FINE;
        left_out = thinned.last().is_some_and(near).then_some(point);
        if left_out.is_none() {
            thinned.push(point);
        }
    }
    thinned.extend(left_out.filter(|point| thinned.last() != Some(point)));
    thinned
}

/// Reduces a time series. Of consecutive points in the same pixel column, it keeps the first, the lowest, the
/// highest and the last, in their order.
pub(super) fn thin(points: &[(i32, i32)]) -> Vec<(i32, i32)> {
    let mut thinned: Vec<(i32, i32)> = Vec::new();
    let mut add = |point: (i32, i32)| {
        if thinned.last() != Some(&point) {
            thinned.push(point);
        }
    };
    for column in points.chunk_by(|a, b| a.0 / FINE == b.0 / FINE) {
        let (first, last) = (column[0], column[column.len() - 1]);
        let low = (0..column.len()).min_by_key(|&i| column[i].1).unwrap_or(0);
        let high = (0..column.len()).max_by_key(|&i| column[i].1).unwrap_or(0);
        add(first);
        if column.len() > 4 {
            add(column[low.min(high)]);
            add(column[low.max(high)]);
        } else {
            column.iter().copied().for_each(&mut add);
        }
        add(last);
    }
    thinned
}

/// Returns the dashes of a line.
fn dashed(points: &[(i32, i32)], pattern: &[i32]) -> Vec<Vec<(i32, i32)>> {
    let mut dashes = Vec::new();
    let Some(&first) = points.first() else { return dashes };
    let (mut index, mut left) = (0, f64::from(px(pattern[0])));
    let mut dash = vec![first];
    for pair in points.windows(2) {
        let (from, to) = ((f64::from(pair[0].0), f64::from(pair[0].1)), (f64::from(pair[1].0), f64::from(pair[1].1)));
        let length = (to.0 - from.0).hypot(to.1 - from.1);
        let mut gone = 0.0;
        while length - gone > left {
            gone += left;
            let share = gone / length;
            let here =
                ((from.0 + share * (to.0 - from.0)).round() as i32, (from.1 + share * (to.1 - from.1)).round() as i32);
            if index % 2 == 0 {
                dash.push(here);
                dashes.push(std::mem::take(&mut dash));
            } else {
                dash = vec![here];
            }
            index += 1;
            left = f64::from(px(pattern[index % pattern.len()]));
        }
        left -= length - gone;
        if index % 2 == 0 {
            dash.push(pair[1]);
        }
    }
    if dash.len() > 1 {
        dashes.push(dash);
    }
    dashes
}

/// Draws a legend in one row that ends at a point in fine pixels of the area. Returns the left end of the legend.
pub(super) fn legend<B: Canvas>(
    area: &DrawingArea<B, Shift>,
    (right, middle): (i32, i32),
    entries: &[(String, Stroke)],
) -> Result<i32, DrawingAreaErrorKind<B::ErrorType>> {
    const SAMPLE: i32 = 26;
    let mut right = right;
    for (name, stroke) in entries.iter().rev() {
        let style = text(12, HPos::Right, VPos::Center);
        let (width, _) = area.estimate_text_size(name, &style)?;
        area.draw(&Text::new(name.clone(), (right, middle), style))?;
        let left = right - width as i32 - px(5);
        draw_line(area, vec![(left - px(SAMPLE), middle), (left, middle)], *stroke)?;
        right = left - px(SAMPLE + 14);
    }
    Ok(right)
}

/// Returns the range of values, extended by the fraction `room` of its length on both sides. The range is at least
/// `min` long. A constant value gets a range whose ticks have distinct labels.
pub(super) fn span(values: impl Iterator<Item = f64>, min: f64, room: f64) -> (f64, f64) {
    let (low, high) = values.fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), x| (low.min(x), high.max(x)));
    if low > high {
        return (0.0, 1.0);
    }
    let middle = 0.5 * (low + high);
    let constant = high - low <= 1e-9 * middle.abs() + 1e-12;
    let min = if constant { min.max(1e-3 * middle.abs()).max(1e-3) } else { min };
    let half = (0.5 * (high - low)).max(0.5 * min) * (1.0 + 2.0 * room);
    (middle - half, middle + half)
}

/// Returns the formatter of an axis, with enough decimals to distinguish its ticks.
pub(super) fn label_of((low, high): (f64, f64)) -> impl Fn(&f64) -> String {
    let places = (-((high - low) / 10.0).log10().floor()).clamp(0.0, 9.0) as usize;
    move |x| {
        let text = format!("{x:.places$}");
        // zero has no minus sign
        let nothing = text.trim_start_matches('-').chars().all(|letter| matches!(letter, '0' | '.'));
        if nothing { text.trim_start_matches('-').to_string() } else { text }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn dashes_have_their_lengths_across_corners() {
        let points = [(0, 0), (100, 0), (100, 100), (50, 100)];
        let dashes = dashed(&points, &[9, 3]);
        let length = |dash: &Vec<(i32, i32)>| -> f64 {
            dash.windows(2).map(|p| f64::from(p[1].0 - p[0].0).hypot(f64::from(p[1].1 - p[0].1))).sum()
        };
        // // 250 fine pixels, with dashes of 36 and gaps of 12
        assert_eq!(dashes.len(), 6);
        assert!(dashes[..5].iter().all(|dash| (length(dash) - 36.0).abs() < 2.0), "{dashes:?}");
        assert_eq!(dashed(&points[..1], &[9, 3]).len(), 0);
    }

    #[test]
    fn thinning_keeps_ends_and_extremes() {
        let points: Vec<_> = (0..1000).map(|i| (i / 100, (i * 7919) % 512)).collect();
        let thinned = thin(&points);
        assert!(thinned.len() < 20 && thinned[0] == points[0] && thinned.last() == points.last());
        let extreme = |points: &[(i32, i32)]| (points.iter().map(|p| p.1).min(), points.iter().map(|p| p.1).max());
        assert_eq!(extreme(&thinned), extreme(&points));
        // // a rising column needs no second pass
        let rising: Vec<_> = (0..100).map(|i| (0, i)).collect();
        assert!(thin(&rising).windows(2).all(|pair| pair[1].1 > pair[0].1));
    }

    #[test]
    fn thinned_paths_keep_their_ends_and_drop_points_within_a_pixel() {
        let circle: Vec<_> = (0..10_000)
            .map(|i| (f64::from(i) * 1e-3).sin_cos())
            .map(|(sin, cos)| ((200.0 * cos) as i32, (200.0 * sin) as i32))
            .collect();
        let thinned = thin_path(circle.iter().copied());
        assert!(thinned.len() < 1000 && thinned[0] == circle[0] && thinned.last() == circle.last());
        assert_eq!(thin_path(std::iter::repeat_n((3, 3), 50)), [(3, 3)]);
    }

    #[test]
    fn labels_have_enough_decimals_to_distinguish_ticks() {
        assert_eq!(label_of((0.0, 10.0))(&5.0), "5");
        assert_eq!(label_of((0.0, 1.0))(&0.25), "0.2");
        assert_eq!(label_of((0.99, 1.01))(&0.995), "0.995");
        assert_eq!(label_of((-1.0, 1.0))(&-0.0), "0.0");
        assert_eq!(label_of((14_000.0, 15_000.0))(&14_500.0), "14500");
    }
}
