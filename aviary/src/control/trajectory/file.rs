use std::path::Path;

use serde::Deserialize;
use serde::de::IgnoredAny;

use super::{Heading, PeriodicTrajectory, Plane, Steps, Trajectory, TrajectoryError, Waypoints};
use crate::error::{SystemError, toml_message, triple, triples};

/// Names of the built-in trajectories.
pub const NAMES: [&str; 5] = ["circle", "lemniscate", "helix", "square", "loop"];

/// Returns a built-in trajectory, or `None` for an unknown name.
///
/// | name | trajectory |
/// | --- | --- |
/// | `circle` | the paper's vertical circle: radius 0.3 m, 8 s per turn, YZ plane, full speed from the start |
/// | `lemniscate` | two turns of a figure eight of 2 m × 1 m with a peak speed of 1.5 m/s |
/// | `helix` | five turns of radius 0.5 m, from 0.5 m to 1.5 m in height |
/// | `square` | the paper's square: sides of 1 m, 4 s per corner |
/// | `loop` | one turn of a vertical circle of radius 1 m, inverted at the top; requires the thrust of the racer |
///
/// ```
/// use aviary::control::trajectory::{NAMES, named};
///
/// assert!(NAMES.iter().all(|name| named(name).is_some()));
/// // four corners, each held for 4 s
/// assert_eq!(named("square").map(|square| square.duration()), Some(16.0));
/// ```
pub fn named(name: &str) -> Option<Box<dyn Trajectory>> {
    let periodic = match name {
        "circle" => PeriodicTrajectory::circle(0.3, 8.0).map(|periodic| periodic.plane(Plane::YZ)),
        "lemniscate" => {
            PeriodicTrajectory::lemniscate_at(1.0, 0.5, 1.5).and_then(|periodic| periodic.turns(2.0)?.ramp(2.0))
        }
        "helix" => PeriodicTrajectory::helix(0.5, 4.0, 0.2)
            .map(|periodic| periodic.centre([0.0, 0.0, 0.5]))
            .and_then(|periodic| periodic.turns(5.0)?.ramp(2.0)),
        // starts at the bottom, so that the ramps are the first and the last quarter turn
        "loop" => PeriodicTrajectory::circle(1.0, 1.6)
            .map(|periodic| periodic.plane(Plane::YZ).centre([0.0, 0.0, 1.5]))
            .and_then(|periodic| periodic.phase(-std::f64::consts::FRAC_PI_2)?.turns(1.0)?.ramp(0.8)),
        "square" => return Steps::square(1.0, 4.0).ok().map(|steps| Box::new(steps) as Box<dyn Trajectory>),
        _ => return None,
    };
    periodic.ok().map(|periodic| Box::new(periodic) as Box<dyn Trajectory>)
}

/// Reads a trajectory from a TOML file.
///
/// # Errors
/// [`TrajectoryError::File`] with the path, around an error of [`from_toml`] or of the system.
pub fn from_file(path: impl AsRef<Path>) -> Result<Box<dyn Trajectory>, TrajectoryError> {
    let path = path.as_ref();
    let in_file = |error| TrajectoryError::File { path: path.into(), error: Box::new(error) };
    let text = std::fs::read_to_string(path).map_err(|error| in_file(SystemError::from(error).into()))?;
    from_toml(&text).map_err(in_file)
}

/// Reads a trajectory from TOML text.
///
/// `kind` is `circle`, `lemniscate`, `helix`, `steps` or `waypoints`. The other keys are the arguments of its
/// constructor and builder methods, in SI units and rad.
///
/// ```
/// let circle = aviary::control::trajectory::from_toml(
///     r#"
///     kind = "circle"
///     radius = 0.5
///     period = 4.0
///     plane = "xz"
///     centre = [0.0, 0.0, 1.2]
///     ramp = 2.0
///     "#,
/// )?;
/// assert_eq!(circle.start().position.as_slice(), [0.5, 0.0, 1.2]);
/// # Ok::<(), aviary::control::trajectory::TrajectoryError>(())
/// ```
///
/// # Errors
/// [`TrajectoryError::Toml`] with line and column, or an error of the constructor.
pub fn from_toml(text: &str) -> Result<Box<dyn Trajectory>, TrajectoryError> {
    match read::<OnlyKind>(text)?.kind {
        Kind::Circle => {
            let spec: Circle = read(text)?;
            spec.placed(PeriodicTrajectory::circle(spec.radius, spec.period)?)
        }
        Kind::Lemniscate => {
            let spec: Lemniscate = read(text)?;
            spec.placed(match (spec.period, spec.peak_speed) {
                (Some(period), None) => PeriodicTrajectory::lemniscate(spec.half_length, spec.half_width, period)?,
                (None, Some(speed)) => PeriodicTrajectory::lemniscate_at(spec.half_length, spec.half_width, speed)?,
                _ => return Err(message("expected either period or peak_speed")),
            })
        }
        Kind::Helix => {
            let spec: Helix = read(text)?;
            spec.placed(PeriodicTrajectory::helix(spec.radius, spec.period, spec.climb)?)
        }
        Kind::Steps => {
            let StepKeys { start, points, yaws, hold, .. } = read(text)?;
            let yaws = yaws.unwrap_or_else(|| vec![0.0; points.len()]);
            let (count, expected) = (yaws.len() as f64, "one per point");
            TrajectoryError::validate("the number of yaws", count, yaws.len() == points.len(), expected)?;
            let places: Vec<_> = points.into_iter().zip(yaws).collect();
            Ok(Box::new(Steps::new(start, &places, hold)?))
        }
        Kind::Waypoints => {
            let WaypointKeys { points, yaws, times, max_speed, max_acceleration, .. } = read(text)?;
            let mut path = Waypoints::through(&points);
            match (times, max_speed, max_acceleration) {
                (Some(times), None, None) => path = path.times(times),
                (None, Some(speed), Some(acceleration)) => path = path.limits(speed, acceleration),
                (None, None, None) => {}
                _ => return Err(message("expected either times, or max_speed and max_acceleration")),
            }
            if let Some(yaws) = yaws {
                path = path.yaws(yaws);
            }
            Ok(Box::new(path.build()?))
        }
    }
}

fn read<'a, T: Deserialize<'a>>(text: &'a str) -> Result<T, TrajectoryError> {
    toml::from_str(text).map_err(|error| TrajectoryError::Toml { message: toml_message(text, &error) })
}

#[derive(Deserialize)]
#[serde(rename_all = "snake_case")]
enum Kind {
    Circle,
    Lemniscate,
    Helix,
    Steps,
    Waypoints,
}

#[derive(Deserialize)]
struct OnlyKind {
    kind: Kind,
}

#[derive(Deserialize, Clone, Copy)]
#[serde(rename_all = "snake_case")]
enum PlaneName {
    Xy,
    Yz,
    Xz,
}

/// Defines the keys of a periodic trajectory: its own, and those that all of them share. A macro does it because
/// serde cannot combine `flatten` with `deny_unknown_fields`.
macro_rules! periodic {
    ($name:ident { $($field:ident: $kind:ty),* $(,)? }) => {
        #[derive(Deserialize)]
        #[serde(deny_unknown_fields)]
        struct $name {
            #[serde(rename = "kind")]
            _kind: IgnoredAny,
            $($field: $kind,)*
            #[serde(default, deserialize_with = "some_triple")]
            centre: Option<[f64; 3]>,
            plane: Option<PlaneName>,
            #[serde(default, deserialize_with = "some_triple")]
            normal: Option<[f64; 3]>,
            phase: Option<f64>,
            ramp: Option<f64>,
            turns: Option<f64>,
            yaw: Option<f64>,
            yaw_rate: Option<f64>,
            #[serde(default)]
            forward: bool,
        }

        impl $name {
            /// Applies the shared keys to a trajectory.
            fn placed(&self, mut periodic: PeriodicTrajectory) -> Result<Box<dyn Trajectory>, TrajectoryError> {
                if let Some(centre) = self.centre {
                    for x in centre {
                        TrajectoryError::validate("centre", x, x.abs() <= 1e6, "finite numbers of metres up to 1e6")?;
                    }
                    periodic = periodic.centre(centre);
                }
                periodic = match (self.plane, self.normal) {
                    (None, None) => periodic,
                    (Some(PlaneName::Xy), None) => periodic.plane(Plane::XY),
                    (Some(PlaneName::Yz), None) => periodic.plane(Plane::YZ),
                    (Some(PlaneName::Xz), None) => periodic.plane(Plane::XZ),
                    (None, Some(normal)) => periodic.plane(Plane::normal(normal)?),
                    (Some(_), Some(_)) => return Err(message("expected either plane or normal")),
                };
                // the number of turns limits the ramp
                if let Some(turns) = self.turns {
                    periodic = periodic.turns(turns)?;
                }
                if let Some(ramp) = self.ramp {
                    periodic = periodic.ramp(ramp)?;
                }
                if let Some(phase) = self.phase {
                    periodic = periodic.phase(phase)?;
                }
                let periodic = match (self.forward, self.yaw, self.yaw_rate) {
                    (true, None, None) => periodic.heading(Heading::Forward)?,
                    (true, ..) => return Err(message("expected either forward = true, or yaw and yaw_rate")),
                    (false, yaw, Some(rate)) => {
                        periodic.heading(Heading::Turning { yaw: yaw.unwrap_or(0.0), rate })?
                    }
                    (false, yaw, None) => periodic.heading(Heading::Fixed(yaw.unwrap_or(0.0)))?,
                };
                Ok(Box::new(periodic))
            }
        }
    };
}

periodic!(Circle { radius: f64, period: f64 });
periodic!(Lemniscate { half_length: f64, half_width: f64, period: Option<f64>, peak_speed: Option<f64> });
periodic!(Helix { radius: f64, period: f64, climb: f64 });

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct StepKeys {
    #[serde(rename = "kind")]
    _kind: IgnoredAny,
    #[serde(deserialize_with = "triple")]
    start: [f64; 3],
    #[serde(deserialize_with = "triples")]
    points: Vec<[f64; 3]>,
    yaws: Option<Vec<f64>>,
    hold: f64,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct WaypointKeys {
    #[serde(rename = "kind")]
    _kind: IgnoredAny,
    #[serde(deserialize_with = "triples")]
    points: Vec<[f64; 3]>,
    yaws: Option<Vec<f64>>,
    times: Option<Vec<f64>>,
    max_speed: Option<f64>,
    max_acceleration: Option<f64>,
}

fn some_triple<'de, D: serde::Deserializer<'de>>(deserializer: D) -> Result<Option<[f64; 3]>, D::Error> {
    triple(deserializer).map(Some)
}

fn message(text: &str) -> TrajectoryError {
    TrajectoryError::Toml { message: text.into() }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    const FILES: [&str; 5] = [
        "kind = \"circle\"\nradius = 0.5\nperiod = 4.0\nplane = \"yz\"\nramp = 1.0\nphase = 1.0\nturns = 2.0\n",
        "kind = \"lemniscate\"\nhalf_length = 1.0\nhalf_width = 0.5\npeak_speed = 2.0\nforward = true\n",
        "kind = \"helix\"\nradius = 0.5\nperiod = 4.0\nclimb = 0.2\nnormal = [0.1, 0.0, 1.0]\nyaw_rate = 0.3\n",
        "kind = \"steps\"\nstart = [0.0, 0.0, 0.1]\npoints = [[0, 0, 1], [1, 0, 1]]\nhold = 2.0\nyaws = [0.0, 1.0]\n",
        "kind = \"waypoints\"\npoints = [[0, 0, 1], [1, 0, 1], [1, 1, 1]]\nmax_speed = 1.0\nmax_acceleration = 2.0\n",
    ];

    #[test]
    fn every_kind_is_read() {
        for text in FILES {
            let path = from_toml(text).unwrap();
            assert!(path.reference(0.4).is_finite() && path.duration() > 1.0, "{text}");
        }
        assert!(NAMES.iter().all(|name| named(name).is_some()));
        assert!(named("nosuch").is_none());
    }

    #[test]
    fn errors_name_the_line_and_the_expected_value() {
        let error = |index: usize, from: &str, to: &str| {
            let text = from_toml(&FILES[index].replace(from, to)).unwrap_err().to_string();
            assert!(!text.contains('\n'), "{text}");
            text
        };
        assert!(error(0, "radius = 0.5", "radius = \"wide\"").contains("line 2"));
        assert!(error(0, "radius = 0.5", "").contains("radius"));
        assert!(error(0, "ramp", "rampp").contains("line 5"));
        assert!(error(0, "radius = 0.5", "radius = -0.5").contains("radius is -0.5"));
        assert!(error(0, "ramp = 1.0", "ramp = 99.0").contains("full speed is never reached"));
        assert!(error(0, "period = 4.0", "period = nan").contains("period"));
        assert!(error(0, "ramp", "forward = true\nramp").contains("straight up"));
        assert!(error(0, "circle", "square").contains("line 1"));
        assert!(error(1, "peak_speed", "period = 1.0\npeak_speed").contains("either"));
        assert!(error(2, "normal = [0.1, 0.0, 1.0]", "normal = [0, 0, 0]").contains("normal"));
        assert!(error(3, "[1, 0, 1]]", "[1, 0]]").contains("2 numbers, expected 3"));
        assert!(error(4, "max_speed = 1.0", "times = [0.0]").contains("either"));
        assert!(from_file("no/such.toml").unwrap_err().to_string().starts_with("no/such.toml: No such file"));
    }

    proptest! {
        #[test]
        fn damaged_files_are_errors_or_finite(
            file in 0usize..5, at in 0usize..90, letter in 32u8..127, t in -1.0..9.0,
        ) {
            let mut bytes = FILES[file].as_bytes().to_vec();
            let at = at % bytes.len();
            bytes[at] = letter;
            if let Ok(text) = std::str::from_utf8(&bytes) && let Ok(path) = from_toml(text) {
                prop_assert!(path.reference(t).is_finite(), "{text}");
            }
        }
    }
}
