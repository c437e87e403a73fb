use super::*;
use crate::drone::GRAVITY;
use proptest::prelude::*;

/// Returns a flight on a tumbling path in closed form: position, velocity, attitude and body rate agree.
pub(crate) fn tumbling(rows: usize, step: f64) -> Flight {
    let axis = nalgebra::Unit::new_normalize(Vector3::new(0.3, -0.5, 0.8));
    let rate = axis.into_inner() * 2.5;
    let times: Vec<f64> = (0..rows).map(|row| row as f64 * step).collect();
    let wave = |t: f64, k: f64| Vector3::new((2.0 * t + k).sin(), (3.0 * t + k).sin(), 0.5 * (t + k).sin());
    let slope = |t: f64| Vector3::new(2.0 * (2.0 * t).cos(), 3.0 * (3.0 * t).cos(), 0.5 * t.cos());
    let change = |t: f64| Vector3::new(-4.0 * (2.0 * t).sin(), -9.0 * (3.0 * t).sin(), -0.5 * t.sin());
    let attitude: Vec<_> = times.iter().map(|&t| UnitQuaternion::from_axis_angle(&axis, 2.5 * t + 1.0)).collect();
    let force = |(t, q): (&f64, &UnitQuaternion<f64>)| q.inverse() * (change(*t) + Vector3::z() * GRAVITY);
    Flight {
        name: "tumbling".into(),
        start: 0.0,
        step,
        position: times.iter().map(|&t| wave(t, 0.0)).collect(),
        velocity: times.iter().map(|&t| slope(t)).collect(),
        body_rate: Some(vec![rate; rows]),
        acceleration: Some(times.iter().zip(&attitude).map(force).collect()),
        duty: Some(times.iter().map(|&t| [0.1, 0.2, 0.3, 0.4].map(|x| x + 0.05 * t.sin())).collect()),
        voltage: Some(times.iter().map(|&t| 4.0 - 0.01 * t).collect()),
        attitude,
    }
}

fn text_of(flight: &Flight) -> String {
    let mut bytes = Vec::new();
    flight.write(&mut bytes).unwrap();
    String::from_utf8(bytes).unwrap()
}

fn read(text: &str) -> Result<Flight, String> {
    Flight::from_csv("f", text.as_bytes()).map_err(|error| error.to_string())
}

/// Returns the text with a function applied to the cells of every line.
fn with_cells(text: &str, change: impl Fn(usize, &mut Vec<String>)) -> String {
    let lines = text.lines().enumerate().map(|(index, line)| {
        let mut cells: Vec<_> = line.split(',').map(str::to_string).collect();
        change(index, &mut cells);
        cells.join(",") + "\n"
    });
    lines.collect()
}

#[test]
fn written_flights_read_back_and_columns_may_have_any_order() {
    let flight = tumbling(200, 0.01);
    let text = text_of(&flight);
    assert!(text.starts_with(&(COLUMNS.join(",") + "\n0,0,0,0,")), "{text}");
    let again = read(&text).unwrap();
    assert_eq!(Flight { name: flight.name.clone(), attitude: flight.attitude.clone(), ..again.clone() }, flight);
    let turned = again.attitude.iter().zip(&flight.attitude).map(|(a, b)| a.angle_to(b)).fold(0.0, f64::max);
    assert!(turned < 1e-7, "{turned}");
    let reversed = with_cells(&text, |index, cells| {
        cells.push(if index == 0 { "unknown".into() } else { "text".into() });
        cells.reverse();
    });
    assert_eq!(read(&reversed).unwrap(), again);
    assert_eq!(read(&format!("\u{feff}{}", text.replace('\n', "\r\n"))).unwrap(), again);
}

#[test]
fn motors_have_the_order_of_the_airframe() {
    let flight = read(&text_of(&tumbling(50, 0.01))).unwrap();
    let table = flight.table();
    let duty = flight.duty.unwrap()[7];
    for (motor, column) in ["m4", "m3", "m2", "m1"].into_iter().enumerate() {
        assert_eq!(table.column(column).unwrap()[7], duty[motor], "{column}");
    }
}

#[test]
fn flights_without_optional_columns_name_them() {
    let text = text_of(&tumbling(50, 0.01));
    let without = |names: &[&str]| {
        let at: Vec<_> = names.iter().map(|name| COLUMNS.iter().position(|column| column == name).unwrap()).collect();
        with_cells(&text, |_, cells| {
            let mut index = 0;
            cells.retain(|_| (!at.contains(&index), index += 1).0);
        })
    };
    let optional = ["gx", "gy", "gz", "ax", "ay", "az", "m1", "m2", "m3", "m4", "vbat"];
    let flight = read(&without(&optional)).unwrap();
    assert_eq!(flight.missing(), optional);
    let error = flight.require(&["vbat", "m3"], "a prediction").unwrap_err().to_string();
    assert_eq!(error, "f: no columns `m3`, `vbat`, expected for a prediction");
    assert_eq!(flight.require(&[], "a prediction"), Ok(()));
    assert_eq!(read(&without(&["m2"])), Err("f: line 1: no column `m2`, expected all of m1,m2,m3,m4 or none".into()));
    let error = read(&without(&["px"])).unwrap_err();
    assert_eq!(error, "f: line 1: no column `px`, expected time and motion capture");
    let error = read(&text.replacen("px", "px_m", 1)).unwrap_err();
    assert_eq!(error, "f: line 1: no column `px`, expected time and motion capture; is it `px_m`?");
    assert!(read("a,b,c\n1,2,3\n").unwrap_err().starts_with("f: line 1: no columns `t`, `px`, `py` …"));
}

#[test]
fn invalid_rows_are_errors_with_line_and_column() {
    let text = text_of(&tumbling(60, 0.01));
    let changed = |row: usize, column: &str, value: &str| {
        let at = COLUMNS.iter().position(|name| *name == column).unwrap();
        read(&with_cells(&text, |index, cells| {
            if index == row + 1 {
                cells[at] = value.into();
            }
        }))
        .unwrap_err()
    };
    for bad in ["", "nan", "inf", "-inf", "1e999", "x1", "1,5"] {
        let message = changed(4, "vy", bad);
        let expected = if bad == "1,5" { "23 cells, expected 22".into() } else { format!("vy is `{bad}`, expected a") };
        assert!(message.starts_with(&format!("f: line 6: {expected}")), "{message}");
    }
    assert_eq!(changed(9, "m3", "1.01"), "f: line 11: m3 is 1.01, expected a duty from 0 to 1");
    assert_eq!(changed(9, "m3", "-0.5"), "f: line 11: m3 is -0.5, expected a duty from 0 to 1");
    assert_eq!(changed(0, "vbat", "3700"), "f: line 2: vbat is 3700, expected a battery voltage from 0.5 to 100 V");
    assert!(changed(3, "qw", "0.99").starts_with("f: line 5: the norm of qw, qx, qy, qz is"));
    assert_eq!(changed(5, "t", "0.02"), "f: line 7: t is 0.02, expected a time after 0.04 (rows in the order of time)");
    assert_eq!(changed(5, "t", "0.053"), "f: line 7: t is 0.053, expected 0.05 (a constant step of 0.01 s)");
    let mut lines: Vec<_> = text.lines().collect();
    lines.remove(20);
    let gap = read(&lines.join("\n")).unwrap_err();
    assert_eq!(gap, "f: line 21: t is 0.2, expected 0.19 (a constant step of 0.01 s)");
    lines[30] = &lines[30][..40];
    assert!(read(&lines.join("\n")).unwrap_err().starts_with("f: line 31: "), "a row that ends early");
    let short: Vec<_> = text.lines().take(5).collect();
    assert_eq!(read(&short.join("\n")), Err("f: 4 rows, expected at least 10".into()));
    assert!(read("").unwrap_err().starts_with("f: line 1: the file is empty"));
    let twice = text.replacen("m1,m2", "m2,m2", 1);
    assert_eq!(read(&twice), Err("f: line 1: two columns `m2`, expected one".into()));
    let bytes: Vec<u8> = text.bytes().map(|byte| if byte == b'.' { 0xff } else { byte }).collect();
    assert!(Flight::from_csv("f", &bytes[..]).is_err());
}

#[test]
fn columns_in_a_wrong_unit_or_under_a_wrong_name_are_errors() {
    let flight = tumbling(300, 0.01);
    let text = text_of(&flight);
    let renamed = |from: &str, to: &str| read(&text.replacen(from, to, 1)).unwrap_err();
    assert!(renamed("vx,vy", "vy,vx").contains("vx differs from the derivative of px by"));
    assert!(renamed("gx,gy", "gy,gx").contains("gx differs from the rate of the attitude by"));
    assert!(renamed("px,py", "py,px").contains("vx differs from the derivative of px by"));
    // the scalar part last, as some libraries write it
    assert!(renamed("qw,qx,qy,qz", "qx,qy,qz,qw").contains("differs from the rate of the attitude"));
    let degrees = flight.body_rate.as_ref().map(|rates| rates.iter().map(|rate| rate.map(f64::to_degrees)).collect());
    let error = read(&text_of(&Flight { body_rate: degrees, ..flight.clone() })).unwrap_err();
    assert!(error.contains("expected rad/s, body frame"), "{error}");
    let slow = Flight { velocity: flight.velocity.iter().map(|v| v * 0.5).collect(), ..flight.clone() };
    assert!(read(&text_of(&slow)).unwrap_err().contains("differs from the derivative of p"));
    let no_gyro = Flight { body_rate: Some(vec![Vector3::zeros(); 300]), ..flight.clone() };
    assert!(read(&text_of(&no_gyro)).unwrap_err().contains("expected rad/s, body frame"));
    let thousand = |vectors: &[Vector3<f64>]| vectors.iter().map(|v| v * 1e3).collect::<Vec<_>>();
    let (position, velocity) = (thousand(&flight.position), thousand(&flight.velocity));
    let in_millimetres = Flight { position, velocity, acceleration: None, ..flight.clone() };
    assert!(read(&text_of(&in_millimetres)).unwrap_err().contains("expected m and m/s"));
    assert!(read(&text_of(&Flight { step: 10.0, ..flight.clone() })).unwrap_err().contains("(t in seconds)"));
    assert!(read(&text.replace(',', ";")).unwrap_err().contains("separated by ';', expected commas"));
    let in_g = flight.acceleration.as_ref().map(|forces| forces.iter().map(|force| force / GRAVITY).collect());
    let error = read(&text_of(&Flight { acceleration: in_g, ..flight })).unwrap_err();
    assert!(error.contains("the mean of az is") && error.contains("expected"), "{error}");
}

#[test]
fn a_damaged_cell_is_an_error_at_its_line_and_column() {
    let text = text_of(&tumbling(900, 0.01));
    let changed = |row: usize, column: &str, value: &str| {
        let at = COLUMNS.iter().position(|name| *name == column).unwrap();
        let text = with_cells(&text, |index, cells| {
            if index == row + 1 {
                cells[at] = value.into();
            }
        });
        read(&text).unwrap_err()
    };
    // after the first seconds as well
    for (row, column, value) in [(500, "px", "1e3"), (50, "vz", "-40"), (800, "gx", "200"), (333, "az", "-9000")] {
        let message = changed(row, column, value);
        let number = crate::number(value.parse().unwrap());
        let expected = format!("f: line {}: {column} is {number} between ", row + 2);
        assert!(message.starts_with(&expected), "{message}");
    }
    for (column, value) in [("px", "1e200"), ("vy", "-1e5"), ("gz", "1e4"), ("ax", "1e300")] {
        let message = changed(700, column, value);
        let number = crate::number(value.parse().unwrap());
        assert!(message.starts_with(&format!("f: line 702: {column} is {number}, expected at most ")), "{message}");
    }
    // PWM/65535 of duties that were duties already
    let scaled = with_cells(&text, |index, cells| {
        if index > 0 {
            (17..21).for_each(|cell| cells[cell] = (cells[cell].parse::<f64>().unwrap() / 65535.0).to_string());
        }
    });
    assert!(read(&scaled).unwrap_err().contains("m1 to m4 are at most"));
}

/// Rows after a time that are constant, zero or random do not prevent predictions before that time.
#[test]
fn later_rows_that_disagree_are_readable_and_fail_the_check_of_units() {
    let flight = tumbling(900, 0.01);
    assert!(flight.check_units().is_ok());
    for kind in 0..3 {
        let mut blind = flight.clone();
        for row in 310..900 {
            let number = |x: f64, salt: usize| match kind {
                0 => x,
                1 => 0.0,
                _ => ((row * 7919 + salt * 104_729) % 1000) as f64 * 0.02 - 10.0,
            };
            let (position, velocity) = (flight.position[309], flight.velocity[309]);
            for axis in 0..3 {
                blind.position[row][axis] = number(position[axis], axis);
                blind.velocity[row][axis] = number(velocity[axis], axis + 3);
                blind.body_rate.as_mut().unwrap()[row][axis] = number(1.0, axis + 6);
            }
            blind.attitude[row] = flight.attitude[309];
        }
        let read = Flight::from_csv("f", text_of(&blind).as_bytes()).unwrap();
        // rows that do not change agree with each other
        if kind == 2 {
            let error = read.check_units().unwrap_err().to_string();
            assert!(error.contains("differs from") && error.contains("the largest deviation is at"), "{error}");
        }
    }
}

#[test]
fn a_late_gyro_is_readable_and_a_short_flight_at_a_high_rate_is_no_panic() {
    let mut late = tumbling(900, 0.01);
    let rates = late.body_rate.take().unwrap();
    late.body_rate = Some((0..900_usize).map(|row| rates[row.saturating_sub(25)]).collect());
    assert!(late.check_units().is_ok());
    for (rows, step) in [(10, 1e-3), (15, 1e-3), (100, 1e-5), (11, 0.5)] {
        // any result without a panic
        let _ = read(&text_of(&tumbling(rows, step)));
    }
}

#[test]
fn glitches_are_jumps_of_the_position_and_four_rows_around_them() {
    let mut flight = tumbling(100, 0.01);
    assert!(!flight.glitches().contains(&true));
    flight.position[40].y += 2.9e-3;
    // a single jump is three times as large in the two third differences from rows 38 and 39
    let rows: Vec<_> = (0..100).filter(|&row| flight.glitches()[row]).collect();
    assert_eq!(rows, (34..=46).collect::<Vec<_>>());
    flight.position[40].y -= 2.0e-3;
    assert!(!flight.glitches().contains(&true));
}

#[test]
fn directories_are_read_in_the_order_of_names() {
    let directory = tempfile::tempdir().unwrap();
    let write = |name: &str| std::fs::write(directory.path().join(name), text_of(&tumbling(20, 0.01))).unwrap();
    let paths = [directory.path().to_path_buf()];
    assert!(
        read_flights(&paths).unwrap_err().to_string().ends_with("no file that ends in .csv, expected recorded flights")
    );
    ["b.csv", "a.csv", "notes.txt"].into_iter().for_each(write);
    let names: Vec<_> = read_flights(&paths).unwrap().into_iter().map(|flight| flight.name).collect();
    assert_eq!(names, ["a", "b"]);
    let twice = [paths[0].clone(), paths[0].join("a.csv")];
    assert!(read_flights(&twice).unwrap_err().to_string().contains("it has the name of"));
    assert!(matches!(read_flights(&[paths[0].join("c.csv")]), Err(FlightError::File { .. })));
}

proptest! {
    #[test]
    fn damaged_files_are_errors_of_one_line_or_valid_flights(
        cut in 0_usize..5000, byte in any::<u8>(), at in 0_usize..5000,
        noise in prop::collection::vec(any::<u8>(), 0..200),
    ) {
        let text = text_of(&tumbling(30, 0.01));
        let mut damaged = text.as_bytes().to_vec();
        let place = at % damaged.len();
        damaged[place] = byte;
        damaged.truncate(cut);
        for bytes in [&damaged, &noise] {
            match Flight::from_csv("f", &bytes[..]) {
                Ok(flight) => prop_assert!(flight.rows() >= MIN_ROWS && flight.step > 0.0),
                Err(error) => {
                    let error = error.to_string();
                    prop_assert!(error.lines().count() == 1 && error.chars().count() < 250, "{}", error);
                }
            }
        }
    }

    #[test]
    fn any_decimal_step_is_found(step in 0.001_f64..0.1, rows in 10_usize..200, start in -5.0_f64..100.0) {
        let times: Vec<_> = (0..rows).map(|row| start + row as f64 * step).collect();
        let found = constant_step(&times).unwrap();
        prop_assert!((found - step).abs() < 1e-8, "{} {}", found, step);
    }
}
