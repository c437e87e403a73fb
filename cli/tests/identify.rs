//! Identification of an airframe from recorded flights.

mod common;

use common::{directory, json, recorded_flight, refused, run, text, write};

#[test]
fn an_identification_writes_an_airframe_that_predicts_the_flights() {
    let dir = directory("identify");
    write(&dir.join("flights/short.csv"), &recorded_flight(5.0));
    write(&dir.join("flights/long.csv"), &recorded_flight(7.0));
    let (flights, out, plot) = (dir.join("flights"), dir.join("my_quad.toml"), dir.join("window.svg"));
    let identify = ["identify", text(&flights), "--drone", "cf2x", "--mass", "0.03", "--out", text(&out)];
    let result = json(&[&identify[..], &["--plot", text(&plot)]].concat());
    assert_eq!(result["files"], serde_json::json!([text(&out), text(&plot)]));
    assert_eq!((&result["airframe"]["name"], &result["airframe"]["mass"]), (&"my_quad".into(), &0.03.into()));
    let parameters = result["parameters"].as_array().unwrap();
    let parameter = |name: &str| parameters.iter().find(|parameter| parameter["name"] == name).unwrap();
    let motors = parameter("motors.speed_per_volt");
    assert_eq!((&motors["status"], &motors["unit"]), (&"identified".into(), &"rpm/V".into()));
    assert!(motors["standard_error"].as_f64().unwrap() < 0.01 * motors["value"].as_f64().unwrap(), "{motors}");
    // a climb straight up
    let drag = parameter("air.linear_drag[0]");
    assert_eq!((&drag["status"], &drag["standard_error"]), (&"not_identifiable".into(), &serde_json::Value::Null));
    assert_eq!(result["alignment"].as_array().unwrap().len(), 2);
    for key in ["fit", "leave_one_out"] {
        assert_eq!(result[key]["flights"].as_array().unwrap().len(), 2);
        for track in ["recorded", "predicted"] {
            let ratio = result[key]["tracks"][track][3]["ratio"]["position"].as_f64().unwrap();
            assert!(ratio < 0.1, "{key} {track}: {ratio}");
        }
    }
    assert!(std::fs::read_to_string(&plot).unwrap().contains("measured"));
    // the file predicts as the fit does
    let compared = json(&["compare", "--flights", text(&flights), "--drone", text(&out)]);
    assert_eq!(compared["tracks"], result["fit"]["tracks"]);

    let table = run(&identify);
    for text in ["motors.speed_per_volt", "held constant", "not identifiable", "alignment", "attitude predicted"] {
        assert!(table.contains(text), "{text}: {table}");
    }
    let single = json(&["identify", text(&flights.join("long.csv")), "--drone", "cf2x", "--mass", "0.03"]);
    assert!(single["leave_one_out"].is_null() && single["files"].as_array().unwrap().is_empty());
}

#[test]
fn wrong_options_and_flights_of_an_identification_are_errors_of_one_line() {
    let dir = directory("identify-errors");
    let flight = write(&dir.join("flight.csv"), &recorded_flight(5.0));
    let start = ["identify", text(&flight), "--drone", "cf2x"];
    let with = |more: &[&str], texts: &[&str]| refused(&[&start[..], more].concat(), 2, texts);
    with(&["--mass", "0"], &["--mass", "0"]);
    with(&["--mass", "0.03", "--out", "my quad.toml"], &["--out", "my quad.toml"]);
    with(&["--mass", "0.03", "--plot", "window.pdf"], &["--plot", "window.pdf", ".svg"]);
    with(&[], &["--mass"]);
    let airframe = write(&dir.join("quad.toml"), include_str!("../../assets/airframes/cf2x.toml"));
    let onto = ["identify", text(&flight), "--drone", text(&airframe), "--mass", "0.03", "--out", text(&airframe)];
    refused(&onto, 2, &["quad.toml: it is an input"]);
    assert!(std::fs::read_to_string(&airframe).unwrap().contains("mass"));
    let short = write(&dir.join("short.csv"), &recorded_flight(3.0));
    refused(&["identify", text(&short), "--drone", "cf2x", "--mass", "0.03"], 2, &["short", "expected"]);
    let columns: Vec<String> = recorded_flight(5.0)
        .lines()
        .map(|line| {
            let cells: Vec<_> = line.split(',').collect();
            [&cells[..17], &cells[21..]].concat().join(",")
        })
        .collect();
    let without = write(&dir.join("without.csv"), &(columns.join("\n") + "\n"));
    refused(&["identify", text(&without), "--drone", "cf2x", "--mass", "0.03"], 2, &["without", "m1"]);
}
