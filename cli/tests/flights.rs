//! Recorded flights: comparison with predictions, and conversion of logs.

use std::path::{Path, PathBuf};
use std::process::Command;

mod common;

use common::{aviary, directory, json, recorded_flight, refused, run, text, write};

/// Writes two flights and an airframe. Returns the directory.
fn flights(name: &str) -> (PathBuf, String) {
    let dir = directory(name);
    write(&dir.join("flights/short.csv"), &recorded_flight(4.2));
    write(&dir.join("flights/long.csv"), &recorded_flight(6.5));
    let airframe = write(&dir.join("cf21.toml"), &common::airframe_with_motors());
    let airframe = text(&airframe).to_string();
    (dir, airframe)
}

/// Returns the rows of a CSV file, split into cells.
fn rows(path: &Path) -> Vec<Vec<String>> {
    let text = std::fs::read_to_string(path).unwrap();
    text.lines().map(|line| line.split(',').map(str::to_string).collect()).collect()
}

#[test]
fn comparisons_have_the_errors_of_both_tracks() {
    let (dir, airframe) = flights("compare");
    let flights = dir.join("flights");
    let compare = ["compare", "--flights", text(&flights), "--drone", &airframe];
    let comparison = json(&compare);
    for track in ["recorded", "predicted"] {
        let list = comparison["tracks"][track].as_array().unwrap();
        assert_eq!(list.len(), 4);
        for (row, horizon) in list.iter().zip([0.1, 0.25, 0.5, 1.0]) {
            // windows of the long flight from 3.0 s to 5.5 s, and one of the short flight
            assert_eq!((row["horizon"].as_f64(), row["windows"].as_u64()), (Some(horizon), Some(7)));
            for key in ["position", "velocity"] {
                let number = |value: &serde_json::Value| value[key].as_f64().unwrap();
                assert!((number(&row["ratio"]) - number(row) / number(&row["naive"])).abs() < 1e-12);
                // the airframe of the flights
                assert!(number(&row["ratio"]) < 0.1, "{track} {horizon} {key}: {row}");
            }
            assert_eq!(row["attitude_deg"].is_null(), track == "recorded");
            assert_eq!(row["body_rate"].is_null(), track == "recorded");
            assert!(row["naive"]["attitude_deg"].is_number());
        }
    }
    let names: Vec<_> = comparison["flights"].as_array().unwrap().iter().map(|flight| &flight["name"]).collect();
    assert_eq!(names, ["long", "short"]);
    assert_eq!(comparison["flights"][1]["tracks"]["recorded"][0]["windows"], 1);

    let table = run(&compare);
    for text in
        ["attitude recorded", "attitude predicted", "position (mm), ratio", "body rate (rad/s)", "long ", "short "]
    {
        assert!(table.contains(text), "{text}: {table}");
    }
    let recorded = [&compare[..], &["--attitude", "recorded"]].concat();
    assert!(!run(&recorded).contains("predicted"));
    assert!(json(&recorded)["tracks"]["predicted"].is_null());
    // a single file in place of the directory
    let short = flights.join("short.csv");
    let alone = json(&["compare", "--flights", text(&short), "--drone", &airframe]);
    assert_eq!(alone["tracks"], comparison["flights"][1]["tracks"]);
}

/// Measurements after the start of a window change no prediction from it.
#[test]
fn predictions_are_causal() {
    let (dir, airframe) = flights("compare-blind");
    let predict = |flight: &Path| {
        let out = dir.join("predictions.csv");
        run(&["compare", "--flights", text(flight), "--drone", &airframe, "--predictions", text(&out)]);
        rows(&out)
    };
    let flight = recorded_flight(6.5);
    let path = write(&dir.join("blind/flight.csv"), &flight);
    let whole = predict(&path);
    let names: Vec<_> = flight.lines().next().unwrap().split(',').collect();
    for (blinded, t0) in [("constant", 3.0), ("zero", 4.0), ("constant", 5.5), ("random", 3.5)] {
        let mut last: Vec<String> = Vec::new();
        let mut text = String::new();
        for (index, line) in flight.lines().enumerate() {
            let mut cells: Vec<_> = line.split(',').map(str::to_string).collect();
            if index > 0 && cells[0].parse::<f64>().unwrap() > t0 + 1e-6 {
                for (column, name) in names.iter().enumerate() {
                    // time and the inputs of the prediction
                    if *name == "t" || name.starts_with('m') || *name == "vbat" {
                        continue;
                    }
                    cells[column] = match blinded {
                        "zero" if name.starts_with('q') => f64::from(u8::from(*name == "qw")).to_string(),
                        "zero" => "0".into(),
                        "random" if !name.starts_with('q') => ((index * 7919 + column) % 11).to_string(),
                        _ => last[column].clone(),
                    };
                }
            } else {
                last.clone_from(&cells);
            }
            text += &(cells.join(",") + "\n");
        }
        let path = write(&dir.join("blind/flight.csv"), &text);
        let predicted = predict(&path);
        let early = |rows: &[Vec<String>]| -> Vec<Vec<String>> {
            rows[1..].iter().filter(|row| row[1].parse::<f64>().unwrap() <= t0).cloned().collect()
        };
        let (found, expected) = (early(&predicted), early(&whole));
        assert!(!found.is_empty() && found == expected, "{blinded} after {t0} s");
    }
    let folder = path.parent().unwrap();
    let onto_input = ["compare", "--flights", text(folder), "--drone", &airframe, "--predictions", text(&path)];
    let before = std::fs::read(&path).unwrap();
    refused(&onto_input, 2, &["it is an input"]);
    assert_eq!(std::fs::read(&path).unwrap(), before);
    let compare = ["compare", "--flights", text(&path), "--drone", &airframe];
    let output = aviary(&compare);
    let warning = String::from_utf8(output.stderr).unwrap();
    let is_complete = ["WARN", "flight: ", "differs from"].iter().all(|part| warning.contains(part));
    assert!(is_complete && warning.lines().count() == 1, "{warning}");
    // the result does not depend on a standard error that can be written
    let full = std::fs::File::options().write(true).open("/dev/full").unwrap();
    let silent = Command::new(env!("CARGO_BIN_EXE_aviary")).args(compare).stderr(full).output().unwrap();
    assert_eq!((silent.status.code(), silent.stdout), (Some(0), output.stdout));
}

#[test]
fn predictions_are_written_for_every_window_and_horizon() {
    let (dir, airframe) = flights("compare-predictions");
    let (flights, out) = (dir.join("flights"), dir.join("predictions.csv"));
    let compare = ["compare", "--flights", text(&flights), "--drone", &airframe, "--predictions", text(&out)];
    let comparison = json(&compare);
    assert_eq!(comparison["files"], serde_json::json!([text(&out)]));
    let predicted = rows(&out);
    assert_eq!(predicted[0].join(","), "flight,t0,h,px,py,pz,qw,qx,qy,qz,vx,vy,vz,wx,wy,wz");
    assert_eq!(predicted.len(), 1 + 4 * 7);
    let first = std::fs::read(&out).unwrap();
    run(&compare);
    assert_eq!(std::fs::read(&out).unwrap(), first, "equal runs give equal files");

    // the errors in the output are the means over the rows of the file
    let number = |cell: &String| cell.parse::<f64>().unwrap();
    let measured: Vec<_> = ["long", "short"].map(|name| rows(&flights.join(name).with_extension("csv"))).into();
    for (index, horizon) in ["0.1", "0.25", "0.5", "1"].iter().enumerate() {
        let (mut sum, mut angles, mut count) = (0.0, 0.0, 0.0);
        for row in predicted[1..].iter().filter(|row| row[2] == *horizon) {
            let flight = &measured[usize::from(row[0] == "short")];
            let at = ((number(&row[1]) + number(&row[2])) * 100.0).round() as usize + 1;
            let distance = |first: usize, column: usize, length: usize| {
                let square = |i: usize| (number(&row[first + i]) - number(&flight[at][column + i])).powi(2);
                (0..length).map(square).sum::<f64>().sqrt()
            };
            sum += distance(3, 1, 3);
            // |q − r| = 2·sin(θ/4) for unit quaternions at the angle θ
            angles += 4.0 * (0.5 * distance(6, 4, 4)).asin();
            count += 1.0;
        }
        let row = &comparison["tracks"]["predicted"][index];
        assert!((row["position"].as_f64().unwrap() - sum / count).abs() < 1e-12);
        let degrees = f64::to_degrees(angles / count);
        assert!((row["attitude_deg"].as_f64().unwrap() - degrees).abs() < 1e-6, "{row} {degrees}");
    }

    run(&[&compare[..], &["--attitude", "recorded"]].concat());
    for row in &rows(&out)[1..] {
        assert!(row[6..10].iter().chain(&row[13..]).all(String::is_empty), "{row:?}");
        assert!(row[3..6].iter().chain(&row[10..13]).all(|cell| cell.parse::<f64>().is_ok()), "{row:?}");
    }
}

#[test]
fn the_plot_of_a_comparison_is_svg_and_png() {
    let (dir, airframe) = flights("compare-plot");
    let (flights, out) = (dir.join("flights"), dir.join("plots"));
    let compare = ["compare", "--flights", text(&flights), "--drone", &airframe, "--plot", "--out", text(&out)];
    let output = run(&compare);
    let svg = std::fs::read_to_string(out.join("window.svg")).unwrap();
    for text in ["measured", "predicted", "x (m)", "yaw (°)", "predicted attitude"] {
        assert!(svg.contains(text), "{text}");
    }
    assert!(std::fs::read(out.join("window.png")).unwrap().starts_with(b"\x89PNG"));
    assert!(output.contains(&format!("wrote {}", out.join("window.png").display())));
    run(&[&compare[..], &["--attitude", "recorded"]].concat());
    let svg = std::fs::read_to_string(out.join("window.svg")).unwrap();
    assert!(svg.contains("vz (m/s)") && !svg.contains("yaw"));
}

#[test]
fn flights_and_airframes_that_do_not_fit_are_refused() {
    let (dir, airframe) = flights("compare-refused");
    let flight = dir.join("flights/long.csv");
    let good = std::fs::read_to_string(&flight).unwrap();
    let refuse = |content: &str, texts: &[&str]| {
        let bad = write(&dir.join("bad.csv"), content);
        let out = dir.join("predictions.csv");
        let predictions = ["--predictions", text(&out)];
        refused(&[&["compare", "--flights", text(&bad), "--drone", &airframe], &predictions[..]].concat(), 2, texts);
        assert!(!out.exists(), "no partial output");
    };
    refuse(&good.replacen(",vbat", ",volt", 1).replacen("m4", "m5", 1), &["bad.csv: line 1: no column `m4`"]);
    refuse(&good.replacen("\n0.05,0.5", "\n0.05,x", 1), &["bad.csv: line 7: px is `x`, expected a finite number"]);
    refuse(&good.replacen("\n0.05,", "\n0.03,", 1), &["bad.csv: line 7: t is 0.03, expected a time after 0.04"]);
    refuse(&good.lines().take(50).collect::<Vec<_>>().join("\n"), &["bad: t from 0 to 0.48, expected rows from 2 s"]);
    refuse(&good[..good.len() - 40], &["bad.csv: line 652: "]);
    refuse("", &["bad.csv: line 1: the file is empty"]);
    let without_gyro = good.replace(",0,0,0.5,0,0,", ",0,0,").replacen("gx,gy,gz,ax,ay,az", "ax,ay,az", 1);
    let without_gyro: String = without_gyro.lines().map(|line| format!("{line}\n")).collect();
    refuse(&without_gyro, &["bad: no columns `gx`, `gy`, `gz`, expected for the body rate"]);
    let bad = dir.join("bad.csv");
    let recorded = ["compare", "--flights", text(&bad), "--drone", &airframe, "--attitude", "recorded"];
    assert!(run(&recorded).contains("bad has no columns gx, gy, gz"));

    let compare = ["compare", "--flights", text(&flight), "--drone"];
    refused(&[&compare[..], &["cf2x"]].concat(), 2, &["the airframe cf2x has no `motors.speed_per_volt`"]);
    refused(&[&compare[..], &["no.toml"]].concat(), 2, &["no.toml: No such file"]);
    refused(&["compare", "--flights", "nowhere.csv", "--drone", &airframe], 2, &["nowhere.csv: No such file"]);
    let empty = dir.join("empty");
    std::fs::create_dir_all(&empty).unwrap();
    refused(&["compare", "--flights", text(&empty), "--drone", &airframe], 2, &["empty: no file that ends in .csv"]);
    refused(&["compare", "--drone", &airframe], 2, &["--flights is missing"]);
    let attitude = [&compare[..], &[&airframe, "--attitude", "measured"]].concat();
    refused(&attitude, 2, &["--attitude is `measured`, expected one of: recorded, predicted"]);
}

#[test]
fn logs_are_converted_to_flights_that_can_be_compared() {
    let dir = directory("convert");
    // the variables and units of the firmware
    let mut log = String::from(
        "timestamp,stateEstimate.x,stateEstimate.y,stateEstimate.z,stateEstimate.vx,stateEstimate.vy,stateEstimate.vz,\
         stateEstimate.qx,stateEstimate.qy,stateEstimate.qz,stateEstimate.qw,gyro.x,gyro.y,gyro.z,\
         motor.m1,motor.m2,motor.m3,motor.m4,pm.vbat\n",
    );
    for line in recorded_flight(5.0).lines().skip(1) {
        let x: Vec<f64> = line.split(',').map(|cell| cell.parse().unwrap()).collect();
        let motor = (65_535.0 * x[17]).round();
        log += &format!("{},{},{},{},{},{},{}", 70_000.0 + 1e3 * x[0], x[1], x[2], x[3], x[8], x[9], x[10]);
        log += &format!(",{},{},{},{},0,0,{}", x[5], x[6], x[7], x[4], x[13].to_degrees());
        log += &format!(",{motor},{motor},{motor},{motor},3.7\n");
    }
    let log = write(&dir.join("log.csv"), &log);
    let out = dir.join("flight.csv");
    let converted = json(&["convert", text(&log), "--out", text(&out)]);
    assert_eq!((&converted["rows"], &converted["variables"]), (&501.into(), &18.into()));
    assert_eq!(converted["missing_columns"], serde_json::json!(["ax", "ay", "az"]));
    let airframe = write(&dir.join("cf21.toml"), &common::airframe_with_motors());
    let comparison = json(&["compare", "--flights", text(&out), "--drone", text(&airframe)]);
    assert_eq!(comparison["tracks"]["predicted"][3]["windows"], 3);
    assert!(comparison["tracks"]["predicted"][3]["ratio"]["position"].as_f64().unwrap() < 0.1);
    let table = run(&["convert", text(&log), "--out", text(&out), "--rate", "50"]);
    assert!(table.contains("missing columns  ax, ay, az") && table.contains("rows             251"), "{table}");

    let refuse = |bytes: &[u8], texts: &[&str]| {
        let bad = dir.join("bad");
        std::fs::write(&bad, bytes).unwrap();
        let out = dir.join("none.csv");
        refused(&["convert", text(&bad), "--out", text(&out)], 2, texts);
        assert!(!out.exists());
    };
    refuse(b"", &["bad: line 1: no column timestamp"]);
    refuse(&[0xBC, 2, 0], &["bad: the log has 3 bytes, expected at least 9"]);
    refuse(&[0xBC, 2, 0, 1, 0, 0, 0, 0, 0, 0, 0, 0], &["bad: the checksum is 00000000, expected "]);
    refuse(&[0xBC, 9, 0, 1, 0, 0, 0, 0, 0, 0, 0, 0], &["bad: byte 1: the version is 9, expected 1 or 2"]);
    refused(&["convert", "nowhere", "--out", text(&out)], 2, &["nowhere: No such file"]);
    // the input is not an output
    let before = std::fs::read(&log).unwrap();
    refused(&["convert", text(&log), "--out", text(&log)], 2, &["it is an input"]);
    assert_eq!(std::fs::read(&log).unwrap(), before);
    for rate in ["0", "nan", "1e300"] {
        refused(
            &["convert", text(&log), "--out", text(&out), "--rate", rate],
            2,
            &["--rate is", "expected 1 to 10000"],
        );
    }
    assert_eq!(aviary(&["convert", text(&log), "--out", text(&dir)]).status.code(), Some(1));
}
