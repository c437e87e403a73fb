//! Plots of flights: time series and paths, as SVG and PNG.
//!
//! The colours are distinguishable for colour-blind readers (Okabe and Ito 2008). Lines also differ in their
//! dashes, so that they are distinguishable in greyscale.

mod canvas;
mod panels;
mod path;

use std::path::Path;

use plotters::coord::Shift;
use plotters::prelude::{DrawingArea, RGBColor};

use self::canvas::Canvas;
use self::panels::Panels;
use self::path::Paths;
use super::{Flight, RecordError};

/// A line of a plot.
#[derive(Debug, Clone, PartialEq)]
pub struct Series {
    /// Name in the legend.
    pub name: String,
    /// Points, from left to right.
    pub points: Vec<(f64, f64)>,
}

/// Colours that are distinguishable for colour-blind readers and in greyscale (Okabe and Ito 2008).
const COLOURS: [[u8; 3]; 7] =
    [[0, 114, 178], [213, 94, 0], [0, 158, 115], [204, 121, 167], [86, 180, 233], [230, 159, 0], [70, 70, 70]];

/// Returns the colour of line or drone `index` of `count`: red, green, blue and alpha from 0 to 1.
pub fn colour_of(index: usize, count: usize) -> [f32; 4] {
    let [r, g, b] = bytes_of(index, count).map(|x| f32::from(x) / 255.0);
    [r, g, b, 1.0]
}

/// Returns the colour of line `index` of `count`, red, green and blue from 0 to 255.
fn bytes_of(index: usize, count: usize) -> [u8; 3] {
    if count <= COLOURS.len() {
        return COLOURS[index % COLOURS.len()];
    }
    // hues evenly around the colour circle, alternately lighter and darker
    let wave = |shift: f64| {
        let turn = index as f64 / count as f64 + shift;
        let light = if index.is_multiple_of(2) { 0.55 } else { 0.4 };
        (255.0 * (light + 0.38 * (std::f64::consts::TAU * turn).cos())).round() as u8
    };
    [wave(0.0), wave(1.0 / 3.0), wave(2.0 / 3.0)]
}

/// A plot of time series or paths.
#[derive(Debug, Clone)]
pub struct Plot {
    title: String,
    size: (u32, u32),
    kind: Kind,
}

#[derive(Debug, Clone)]
enum Kind {
    Panels(Panels),
    Paths(Paths),
}

impl Plot {
    /// Creates a plot of stacked panels over a common time axis. A panel is `(label of the y axis, lines)`.
    ///
    /// ```
    /// use aviary::record::plot::{Plot, Series};
    ///
    /// let fall = (0..50).map(|i| 0.02 * f64::from(i)).map(|t| (t, 5.0 - 4.905 * t * t)).collect();
    /// let plot = Plot::time_series("A fall", &[("height (m)", vec![Series { name: "z".into(), points: fall }])])?;
    /// assert!(plot.svg()?.contains("height (m)"));
    /// assert!(plot.png()?.starts_with(b"\x89PNG"));
    /// # Ok::<(), aviary::record::RecordError>(())
    /// ```
    ///
    /// # Errors
    /// [`RecordError::Plot`] if there are no points or a point is not finite.
    pub fn time_series(title: &str, panels: &[(&str, Vec<Series>)]) -> Result<Self, RecordError> {
        let panels = Panels::of_series(panels)?;
        Ok(Self { title: title.into(), size: (800, 50 + 250 * panels.rows()), kind: Kind::Panels(panels) })
    }

    /// Sets the label of the common axis, with its unit; default `time (s)`. Plots of paths ignore it.
    #[must_use]
    pub fn over(mut self, name: &str) -> Self {
        if let Kind::Panels(panels) = &mut self.kind {
            panels.over = name.into();
        }
        self
    }

    /// Arranges the panels of a time series in columns, row by row. A legend above all panels replaces those of the
    /// panels if all panels have lines of the same names. Plots of paths ignore it.
    #[must_use]
    pub fn in_columns(mut self, columns: usize) -> Self {
        if let Kind::Panels(panels) = &mut self.kind {
            panels.arrange(columns.max(1));
            self.size = (1100, 80 + 250 * panels.rows());
        }
        self
    }

    /// Creates a plot of position, attitude, velocity and motor speeds over time, with dashed references. A flight
    /// of one drone has one panel for each. A flight of several drones has a panel for each component, with a line
    /// per drone.
    ///
    /// # Errors
    /// Returns the errors of [`time_series`](Self::time_series).
    pub fn of_flight(title: &str, flight: &Flight) -> Result<Self, RecordError> {
        let panels = Panels::of_flight(flight)?;
        let size = if panels.columns() > 2 { (1500, 1000) } else { (1100, 700) };
        Ok(Self { title: title.into(), size, kind: Kind::Panels(panels) })
    }

    /// Creates a plot of the paths of all drones from above and in 3D, with dashed references. A ring marks the
    /// start of a path, a dot its end.
    ///
    /// # Errors
    /// Returns the errors of [`time_series`](Self::time_series).
    pub fn of_paths(title: &str, flight: &Flight) -> Result<Self, RecordError> {
        Ok(Self { title: title.into(), size: (1100, 600), kind: Kind::Paths(Paths::of(flight)?) })
    }

    /// Draws the plot as SVG.
    ///
    /// # Errors
    /// [`RecordError::Plot`] if the plot cannot be drawn.
    pub fn svg(&self) -> Result<String, RecordError> {
        canvas::svg(self)
    }

    /// Draws the plot as PNG, with two pixels per pixel of the SVG.
    ///
    /// # Errors
    /// Returns the errors of [`svg`](Self::svg).
    pub fn png(&self) -> Result<Vec<u8>, RecordError> {
        canvas::png(self)
    }

    /// Writes the plot to a file. The extension of its name, `.png` or `.svg`, selects the format.
    ///
    /// # Errors
    /// [`RecordError::File`] if the file cannot be written, and [`RecordError::Plot`] for another extension.
    pub fn save(&self, path: impl AsRef<Path>) -> Result<(), RecordError> {
        let path = path.as_ref();
        let bytes = match path.extension().and_then(std::ffi::OsStr::to_str) {
            Some("svg") => self.svg()?.into_bytes(),
            Some("png") => self.png()?,
            _ => {
                let expected = "expected a name that ends in .svg or .png";
                return Err(RecordError::Plot(format!("{}: {expected}", path.display())));
            }
        };
        std::fs::write(path, bytes).map_err(|error| RecordError::file(path, error))
    }

    fn draw<B: Canvas>(&self, area: &DrawingArea<B, Shift>) -> canvas::Drawn<B> {
        let area = canvas::titled(area, &self.title)?;
        match &self.kind {
            Kind::Panels(panels) => panels.draw(&area),
            Kind::Paths(paths) => paths.draw(&area),
        }
    }
}

/// Returns an error if there are no points or a point is not finite.
fn check<'a>(mut points: impl Iterator<Item = &'a f64>) -> Result<(), RecordError> {
    let Some(first) = points.next() else {
        return Err(RecordError::Plot("no points, expected at least one".into()));
    };
    // larger values have no readable axis
    match std::iter::once(first).chain(points).any(|x| x.is_nan() || x.abs() > 1e100) {
        true => Err(RecordError::Plot("a point is not finite or exceeds 1e100, expected finite points".into())),
        false => Ok(()),
    }
}

fn rgb([r, g, b]: [u8; 3]) -> RGBColor {
    RGBColor(r, g, b)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::drone::DroneModel;
    use crate::record::Sample;
    use crate::state::DroneState;
    use nalgebra::Vector3;

    fn line(points: &[(f64, f64)]) -> Vec<Series> {
        ["a line", "another"].map(|name| Series { name: name.into(), points: points.to_vec() }).into()
    }

    /// Returns a flight of drones in circles.
    fn circles(drones: usize) -> Flight {
        let sample = |drone: usize, i: u32| {
            let t = f64::from(i) / 48.0;
            let position = Vector3::new(t.cos(), t.sin(), 1.0 + 0.2 * drone as f64);
            Sample {
                time: t,
                state: DroneState::at_rest(position, Vector3::new(0.1 * t.sin(), 0.0, t)),
                acceleration: Vector3::zeros(),
                motor_speeds: [DroneModel::Cf2x.params().hover_rpm(); 4],
                reward: 0.0,
                reference: (drone == 0).then(|| ([t.cos(), t.sin(), 1.0], 0.0)),
            }
        };
        Flight { drones: (0..drones).map(|drone| (0..480).map(|i| sample(drone, i)).collect()).collect() }
    }

    #[test]
    fn a_plot_has_its_panels_labels_and_lines() {
        let plot = Plot::time_series(
            "title",
            &[("height (m)", line(&[(0.0, 1.0), (1.0, 2.0)])), ("force (N)", line(&[(0.0, 3.0), (1.0, 3.0)]))],
        )
        .unwrap();
        let svg = plot.svg().unwrap();
        for text in ["<svg", "title", "height (m)", "force (N)", "time (s)", "a line", "another"] {
            assert!(svg.contains(text), "{text}");
        }
        for colour in ["#0072B2", "#D55E00"] {
            assert!(svg.matches(colour).count() >= 4, "a line and its legend entry in each panel: {colour}");
        }
        let png = image::load_from_memory(&plot.png().unwrap()).unwrap();
        assert_eq!((png.width(), png.height()), (1600, 1100));
        let blue = png.to_rgb8().pixels().filter(|pixel| pixel.0 == COLOURS[0]).count();
        assert!(blue > 1000, "{blue} pixels of the first line");
    }

    #[test]
    fn panels_in_columns_have_one_legend() {
        let panels = ["a", "b", "c", "d"].map(|label| (label, line(&[(0.0, 1.0), (1.0, 2.0)])));
        let legends = |plot: Plot| plot.svg().unwrap().matches("another").count();
        let stacked = Plot::time_series("", &panels).unwrap();
        let arranged = stacked.clone().in_columns(2);
        let png = image::load_from_memory(&arranged.png().unwrap()).unwrap();
        assert_eq!((png.width(), png.height()), (2200, 1160));
        assert_eq!((legends(stacked), legends(arranged)), (4, 1));
        let mut other = panels;
        other[2].1.pop();
        assert_eq!(legends(Plot::time_series("", &other).unwrap().in_columns(2)), 3, "the third panel has one line");
    }

    /// Regression test: all ticks of a constant line had the label 0.0.
    #[test]
    fn ticks_of_a_constant_line_differ() {
        for value in [0.0, 1.0, 14_475.8, -3.0e-4, 1.7e9] {
            let svg = Plot::time_series("", &[("y", line(&[(0.0, value), (1.0, value)]))]).unwrap().svg().unwrap();
            // numeric texts are the labels of the ticks
            let numbers: Vec<_> = svg.lines().map(str::trim).filter(|text| text.parse::<f64>().is_ok()).collect();
            let distinct: std::collections::BTreeSet<_> = numbers.iter().collect();
            assert!(distinct.len() + 4 > numbers.len() && distinct.len() > 4, "{value}: {numbers:?}");
        }
    }

    /// Regression test: small values were drawn as straight lines.
    #[test]
    fn small_quantities_fill_their_axis() {
        let points: Vec<_> = (0..100).map(|i| (1.7e9 + 0.1 * f64::from(i), 1e-7 * f64::from(i % 2))).collect();
        let lines = vec![Series { name: "a".into(), points }];
        let svg = Plot::time_series("", &[("y", lines)]).unwrap().svg().unwrap();
        let heights = svg.lines().filter(|line| line.contains("#0072B2")).flat_map(|line| {
            let points = line.split("points=\"").nth(1).and_then(|rest| rest.split('"').next()).unwrap_or_default();
            points.split_whitespace().filter_map(|pair| pair.split_once(',')).map(|(_, y)| y.parse().unwrap())
        });
        let (low, high) = heights.fold((f64::MAX, 0.0_f64), |(low, high), y| (low.min(y), high.max(y)));
        assert!(high - low > 400.0, "{low} to {high}");
    }

    #[test]
    fn flights_of_one_drone_and_of_many_are_drawn() {
        for (drones, words) in [
            (1, vec!["position (m)", "attitude (°)", "velocity (m/s)", "motor speed (rpm)", "reference", "roll"]),
            (3, vec!["x (m)", "pitch (°)", "vz (m/s)", "motor 3 (rpm)", "drone 2", "reference"]),
            (12, vec!["y (m)", "yaw (°)", "drone 11"]),
        ] {
            let svg = Plot::of_flight("A flight", &circles(drones)).unwrap().svg().unwrap();
            for word in words.iter().chain(&["A flight", "time (s)"]) {
                assert!(svg.contains(word), "{drones}: {word}");
            }
            let svg = Plot::of_paths("Paths", &circles(drones)).unwrap().svg().unwrap();
            for word in ["Paths", "x (m)", "y (m)", "z (m)"] {
                assert!(svg.contains(word), "{drones}: {word}");
            }
        }
    }

    /// Regression test: PNG plots had spikes where a line reverses and holes where it overlaps itself.
    #[test]
    fn lines_that_reverse_or_overlap_are_drawn_correctly_in_png() {
        let zigzag: Vec<_> = (0..2000).map(|i| (f64::from(i) * 0.01, if i % 2 == 0 { 0.0 } else { 1.0 })).collect();
        let lines = vec![Series { name: "a".into(), points: zigzag }];
        let png = Plot::time_series("", &[("y", lines)]).unwrap().png().unwrap();
        let image = image::load_from_memory(&png).unwrap().to_rgb8();
        let is_line = |pixel: &image::Rgb<u8>| pixel.0[2] > 150 && pixel.0[0] < 60;
        let rows: Vec<u32> = image.enumerate_pixels().filter(|(_, _, p)| is_line(p)).map(|(_, y, _)| y).collect();
        let (top, bottom) = (*rows.iter().min().unwrap(), *rows.iter().max().unwrap());
        // the panel is between its title and the labels of the time axis
        assert!(top > 50 && bottom < image.height() - 80, "rows {top} to {bottom} of {}", image.height());

        let mut twice = circles(1);
        let again: Vec<_> = twice.drones[0].iter().map(|sample| Sample { reference: None, ..*sample }).collect();
        twice.drones[0] = again.iter().chain(&again).copied().collect();
        let png = Plot::of_paths("", &twice).unwrap().png().unwrap();
        let image = image::load_from_memory(&png).unwrap().to_rgb8();
        let blue = image.pixels().filter(|pixel| is_line(pixel)).count();
        assert!(blue > 5000, "{blue} pixels of a path flown twice");
    }

    #[test]
    fn long_series_give_small_files() {
        let points = (0..200_000).map(|i| 1e-3 * f64::from(i)).map(|t| (t, (7.0 * t).sin())).collect();
        let lines = vec![Series { name: "a".into(), points }];
        let svg = Plot::time_series("", &[("y", lines)]).unwrap().svg().unwrap();
        assert!(svg.len() < 200_000, "{}", svg.len());
    }

    #[test]
    fn empty_plots_invalid_points_and_unknown_extensions_are_errors() {
        assert!(Plot::time_series("", &[]).is_err());
        assert!(Plot::time_series("", &[("y", line(&[]))]).is_err());
        assert!(Plot::time_series("", &[("y", line(&[(0.0, f64::NAN)]))]).is_err());
        assert!(Plot::time_series("", &[("y", line(&[(0.0, 1.7e308), (1.0, -1.7e308)]))]).is_err());
        for broken in [Flight::default(), Flight { drones: vec![vec![]] }] {
            assert!(Plot::of_flight("", &broken).is_err() && Plot::of_paths("", &broken).is_err());
        }
        let mut invalid = circles(2);
        invalid.drones[1][7].state.position.x = f64::INFINITY;
        assert!(Plot::of_flight("", &invalid).is_err() && Plot::of_paths("", &invalid).is_err());
        let error = Plot::of_paths("", &circles(1)).unwrap().save("flight.jpeg").unwrap_err();
        assert!(error.to_string().contains(".svg or .png"), "{error}");
        // a flight with one sample is a point
        let mut short = circles(1);
        short.drones[0].truncate(1);
        assert!(
            Plot::of_flight("", &short).unwrap().png().is_ok() && Plot::of_paths("", &short).unwrap().png().is_ok()
        );
    }
}
