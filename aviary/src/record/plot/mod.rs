//! Plots of flights: time series and paths, as SVG and PNG.
//!
//! Colours are those that the colour-blind can tell apart (Okabe and Ito 2008); lines differ in their dashes, too, so that they can
//! be told apart in grey.

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
    /// What the legend says.
    pub name: String,
    /// Points, from left to right.
    pub points: Vec<(f64, f64)>,
}

/// Colours that the colour-blind can tell apart, and that print as different greys (Okabe and Ito 2008).
const COLOURS: [[u8; 3]; 7] =
    [[0, 114, 178], [213, 94, 0], [0, 158, 115], [204, 121, 167], [86, 180, 233], [230, 159, 0], [70, 70, 70]];

/// The colour of a line or a drone among so many: red, green, blue and alpha from 0 to 1.
pub fn colour_of(index: usize, count: usize) -> [f32; 4] {
    let [r, g, b] = bytes_of(index, count).map(|x| f32::from(x) / 255.0);
    [r, g, b, 1.0]
}

/// The same from 0 to 255.
fn bytes_of(index: usize, count: usize) -> [u8; 3] {
    if count <= COLOURS.len() {
        return COLOURS[index % COLOURS.len()];
    }
    // round the circle of hues, lighter and darker in turn
    let wave = |shift: f64| {
        let turn = index as f64 / count as f64 + shift;
        let light = if index.is_multiple_of(2) { 0.55 } else { 0.4 };
        (255.0 * (light + 0.38 * (std::f64::consts::TAU * turn).cos())).round() as u8
    };
    [wave(0.0), wave(1.0 / 3.0), wave(2.0 / 3.0)]
}

/// A plot, ready to be drawn.
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
    /// One panel per entry, stacked, over a common time axis: `(label of the y axis, lines)`.
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
    /// [`RecordError::Plot`] where there is nothing to plot or a point is not finite.
    pub fn time_series(title: &str, panels: &[(&str, Vec<Series>)]) -> Result<Self, RecordError> {
        let panels = Panels::of_series(panels)?;
        Ok(Self { title: title.into(), size: (800, 50 + 250 * panels.rows()), kind: Kind::Panels(panels) })
    }

    /// Something else than time along the common axis of its panels, with its unit; plots of paths have none.
    #[must_use]
    pub fn over(mut self, name: &str) -> Self {
        if let Kind::Panels(panels) = &mut self.kind {
            panels.over = name.into();
        }
        self
    }

    /// Position, attitude, velocity and motor speeds over time, with the references in dashes. A single drone has a panel
    /// for each; of several, every axis has a panel, in which the drones lie over each other.
    ///
    /// # Errors
    /// As for [`time_series`](Self::time_series).
    pub fn of_flight(title: &str, flight: &Flight) -> Result<Self, RecordError> {
        let panels = Panels::of_flight(flight)?;
        let size = if panels.columns() > 2 { (1500, 1000) } else { (1100, 700) };
        Ok(Self { title: title.into(), size, kind: Kind::Panels(panels) })
    }

    /// The ways of all drones seen from above and in space, with those that they were to fly in dashes. A ring is the
    /// start, a dot the end.
    ///
    /// # Errors
    /// As for [`time_series`](Self::time_series).
    pub fn of_paths(title: &str, flight: &Flight) -> Result<Self, RecordError> {
        Ok(Self { title: title.into(), size: (1100, 600), kind: Kind::Paths(Paths::of(flight)?) })
    }

    /// As SVG.
    ///
    /// # Errors
    /// [`RecordError::Plot`] where it cannot be drawn.
    pub fn svg(&self) -> Result<String, RecordError> {
        canvas::svg(self)
    }

    /// As PNG, two pixels for one of the SVG.
    ///
    /// # Errors
    /// As for [`svg`](Self::svg).
    pub fn png(&self) -> Result<Vec<u8>, RecordError> {
        canvas::png(self)
    }

    /// As a file, PNG or SVG by the ending of its name.
    ///
    /// # Errors
    /// [`RecordError::File`] where it cannot be written, [`RecordError::Plot`] for another ending.
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

/// Whether there is something to plot, and all of it finite.
fn check<'a>(mut points: impl Iterator<Item = &'a f64>) -> Result<(), RecordError> {
    let Some(first) = points.next() else {
        return Err(RecordError::Plot("there is nothing to plot".into()));
    };
    // what is larger has no axis that anybody could read
    match std::iter::once(first).chain(points).any(|x| x.is_nan() || x.abs() > 1e100) {
        true => Err(RecordError::Plot("a point is not finite, or larger than 1e100".into())),
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

    /// Drones that go round in circles.
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
            assert!(svg.matches(colour).count() >= 4, "a line and its place in the legend, in each panel: {colour}");
        }
        let png = image::load_from_memory(&plot.png().unwrap()).unwrap();
        assert_eq!((png.width(), png.height()), (1600, 1100));
        let blue = png.to_rgb8().pixels().filter(|pixel| pixel.0 == COLOURS[0]).count();
        assert!(blue > 1000, "{blue} pixels of the first line");
    }

    /// Ticks of a line that does not move were all labelled 0.0.
    #[test]
    fn ticks_of_a_constant_line_differ() {
        for value in [0.0, 1.0, 14_475.8, -3.0e-4, 1.7e9] {
            let svg = Plot::time_series("", &[("y", line(&[(0.0, value), (1.0, value)]))]).unwrap().svg().unwrap();
            // texts between the label of the panel and the end that are numbers
            let numbers: Vec<_> = svg.lines().map(str::trim).filter(|text| text.parse::<f64>().is_ok()).collect();
            let distinct: std::collections::BTreeSet<_> = numbers.iter().collect();
            assert!(distinct.len() + 4 > numbers.len() && distinct.len() > 4, "{value}: {numbers:?}");
        }
    }

    /// They were straight lines.
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
            let svg = Plot::of_paths("Ways", &circles(drones)).unwrap().svg().unwrap();
            for word in ["Ways", "x (m)", "y (m)", "z (m)"] {
                assert!(svg.contains(word), "{drones}: {word}");
            }
        }
    }

    /// Needles ran across the picture where a line turns back, and there was nothing where it runs over itself.
    #[test]
    fn lines_that_turn_back_stay_where_they_are_in_pixels_too() {
        let zigzag: Vec<_> = (0..2000).map(|i| (f64::from(i) * 0.01, if i % 2 == 0 { 0.0 } else { 1.0 })).collect();
        let lines = vec![Series { name: "a".into(), points: zigzag }];
        let png = Plot::time_series("", &[("y", lines)]).unwrap().png().unwrap();
        let picture = image::load_from_memory(&png).unwrap().to_rgb8();
        let is_line = |pixel: &image::Rgb<u8>| pixel.0[2] > 150 && pixel.0[0] < 60;
        let rows: Vec<u32> = picture.enumerate_pixels().filter(|(_, _, p)| is_line(p)).map(|(_, y, _)| y).collect();
        let (top, bottom) = (*rows.iter().min().unwrap(), *rows.iter().max().unwrap());
        // the panel lies between its heading and the labels of the time axis
        assert!(top > 50 && bottom < picture.height() - 80, "rows {top} to {bottom} of {}", picture.height());

        let mut twice = circles(1);
        let again: Vec<_> = twice.drones[0].iter().map(|sample| Sample { reference: None, ..*sample }).collect();
        twice.drones[0] = again.iter().chain(&again).copied().collect();
        let png = Plot::of_paths("", &twice).unwrap().png().unwrap();
        let picture = image::load_from_memory(&png).unwrap().to_rgb8();
        let blue = picture.pixels().filter(|pixel| is_line(pixel)).count();
        assert!(blue > 5000, "{blue} pixels of a way flown twice");
    }

    #[test]
    fn long_flights_make_no_huge_files() {
        let points = (0..200_000).map(|i| 1e-3 * f64::from(i)).map(|t| (t, (7.0 * t).sin())).collect();
        let lines = vec![Series { name: "a".into(), points }];
        let svg = Plot::time_series("", &[("y", lines)]).unwrap().svg().unwrap();
        assert!(svg.len() < 200_000, "{}", svg.len());
    }

    #[test]
    fn nothing_and_not_a_number_are_errors_and_so_are_other_endings() {
        assert!(Plot::time_series("", &[]).is_err());
        assert!(Plot::time_series("", &[("y", line(&[]))]).is_err());
        assert!(Plot::time_series("", &[("y", line(&[(0.0, f64::NAN)]))]).is_err());
        assert!(Plot::time_series("", &[("y", line(&[(0.0, 1.7e308), (1.0, -1.7e308)]))]).is_err());
        for broken in [Flight::default(), Flight { drones: vec![vec![]] }] {
            assert!(Plot::of_flight("", &broken).is_err() && Plot::of_paths("", &broken).is_err());
        }
        let mut lost = circles(2);
        lost.drones[1][7].state.position.x = f64::INFINITY;
        assert!(Plot::of_flight("", &lost).is_err() && Plot::of_paths("", &lost).is_err());
        let error = Plot::of_paths("", &circles(1)).unwrap().save("flight.jpeg").unwrap_err();
        assert!(error.to_string().contains(".svg or .png"), "{error}");
        // a flight of one moment is a point
        let mut short = circles(1);
        short.drones[0].truncate(1);
        assert!(
            Plot::of_flight("", &short).unwrap().png().is_ok() && Plot::of_paths("", &short).unwrap().png().is_ok()
        );
    }
}
