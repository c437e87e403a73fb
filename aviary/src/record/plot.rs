//! Plots of flights, as SVG.

use plotters::prelude::*;

use super::RecordError;

/// A line of a plot.
#[derive(Debug, Clone, PartialEq)]
pub struct Series {
    /// What the legend says.
    pub name: String,
    /// Points, from left to right.
    pub points: Vec<(f64, f64)>,
}

/// Colours that the colour-blind can tell apart, and that print as different greys (Okabe and Ito 2008).
const COLOURS: [RGBColor; 6] = [
    RGBColor(0, 114, 178),
    RGBColor(213, 94, 0),
    RGBColor(0, 158, 115),
    RGBColor(204, 121, 167),
    RGBColor(86, 180, 233),
    RGBColor(90, 90, 90),
];

/// One panel per entry, stacked, over a common time axis: `(label of the y axis, lines)`.
///
/// # Errors
/// [`RecordError::Plot`] where there is nothing to plot or a point is not finite.
pub fn time_series(title: &str, panels: &[(&str, Vec<Series>)]) -> Result<String, RecordError> {
    let wrong = |error: &dyn std::fmt::Display| RecordError::Plot(error.to_string());
    let points = || panels.iter().flat_map(|(_, lines)| lines).flat_map(|line| &line.points);
    if points().next().is_none() {
        return Err(RecordError::Plot("there is nothing to plot".into()));
    }
    if points().any(|(x, y)| !(x.is_finite() && y.is_finite())) {
        return Err(RecordError::Plot("a point is not finite".into()));
    }
    let (left, right) = span(points().map(|(x, _)| *x), 0.0);
    let mut svg = String::new();
    {
        let area = SVGBackend::with_string(&mut svg, (800, 60 + 260 * panels.len() as u32)).into_drawing_area();
        area.fill(&WHITE).map_err(|error| wrong(&error))?;
        let area = area.titled(title, ("sans-serif", 22)).map_err(|error| wrong(&error))?;
        for (index, (area, (label, lines))) in area.split_evenly((panels.len(), 1)).iter().zip(panels).enumerate() {
            let (low, high) = span(lines.iter().flat_map(|line| &line.points).map(|(_, y)| *y), 0.08);
            let mut chart = ChartBuilder::on(area)
                .margin(12)
                .x_label_area_size(36)
                .y_label_area_size(70)
                .build_cartesian_2d(left..right, low..high)
                .map_err(|error| wrong(&error))?;
            let mut mesh = chart.configure_mesh();
            mesh.y_desc(*label).light_line_style(RGBColor(240, 240, 240)).label_style(("sans-serif", 13));
            if index + 1 == panels.len() {
                mesh.x_desc("time (s)");
            }
            mesh.draw().map_err(|error| wrong(&error))?;
            for (line, colour) in lines.iter().zip(COLOURS.iter().cycle()) {
                let style = colour.stroke_width(2);
                chart
                    .draw_series(LineSeries::new(line.points.iter().copied(), style))
                    .map_err(|error| wrong(&error))?
                    .label(&line.name)
                    .legend(move |(x, y)| PathElement::new([(x, y), (x + 18, y)], style));
            }
            if lines.len() > 1 {
                chart
                    .configure_series_labels()
                    .position(SeriesLabelPosition::UpperLeft)
                    .background_style(WHITE.mix(0.8))
                    .border_style(RGBColor(200, 200, 200))
                    .label_font(("sans-serif", 14))
                    .draw()
                    .map_err(|error| wrong(&error))?;
            }
        }
        area.present().map_err(|error| wrong(&error))?;
    }
    Ok(svg)
}

/// Least and greatest value, apart at least by a little, with this share of room on both sides.
fn span(values: impl Iterator<Item = f64>, room: f64) -> (f64, f64) {
    let (low, high) = values.fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), x| (low.min(x), high.max(x)));
    if low > high {
        return (0.0, 1.0);
    }
    let width = (high - low).max(1e-9 * high.abs().max(1.0));
    (low - room * width, high + room * width)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn line(points: &[(f64, f64)]) -> Vec<Series> {
        vec![
            Series { name: "a line".into(), points: points.to_vec() },
            Series { name: "another".into(), points: points.to_vec() },
        ]
    }

    #[test]
    fn a_plot_has_its_panels_labels_and_lines() {
        let svg = time_series(
            "title",
            &[("height (m)", line(&[(0.0, 1.0), (1.0, 2.0)])), ("force (N)", line(&[(0.0, 3.0), (1.0, 3.0)]))],
        )
        .unwrap();
        for text in ["<svg", "title", "height (m)", "force (N)", "time (s)", "a line", "another"] {
            assert!(svg.contains(text), "{text}");
        }
        for colour in ["#0072B2", "#D55E00"] {
            // a line and its place in the legend, in each of two panels
            assert_eq!(svg.matches(colour).count(), 4, "{colour}");
        }
    }

    #[test]
    fn nothing_and_not_a_number_are_errors() {
        assert!(time_series("", &[]).is_err());
        assert!(time_series("", &[("y", line(&[]))]).is_err());
        assert!(time_series("", &[("y", line(&[(0.0, f64::NAN)]))]).is_err());
    }
}
