//! Files of tracks of races.

use mujoco_drones_gym::tasks::{Gate, GateMotion, GateRanges, Race, RaceTrack};
use proptest::prelude::*;

const FILE: &str = "laps = 3\nsolid = true\nopening = 0.6\nnormals = false\n\n[randomization]\nposition = 0.15\n\
                    yaw = 0.2\n\n[motion]\namplitude = 0.1\nperiod = 3.0\n\n[[gates]]\nposition = [1, 0, 1]\n\n\
                    [[gates]]\nposition = [0.0, 1.0, 1.5]\nyaw = 3.0\n";

#[test]
fn a_file_gives_every_property_of_a_track() {
    let track = RaceTrack::from_toml(FILE).unwrap();
    let expected = RaceTrack {
        laps: 3,
        opening: 0.6,
        solid: true,
        normals: Some(false),
        randomization: GateRanges { position: 0.15, yaw: 0.2 },
        motion: GateMotion { amplitude: 0.1, period: 3.0 },
        gates: vec![Gate { position: [1.0, 0.0, 1.0], yaw: None }, Gate { position: [0.0, 1.0, 1.5], yaw: Some(3.0) }],
    };
    assert_eq!(track, expected);
    assert_eq!(RaceTrack::from_toml(&toml::to_string(&track).unwrap()).unwrap(), track);
    let short = RaceTrack::from_toml("[[gates]]\nposition = [1, 0, 1]\n").unwrap();
    assert_eq!((short.laps, short.opening, short.solid, short.normals), (2, 0.5, false, None));
}

/// The direction from the gate before to the next one has no meaning if they are at one place or above each other.
#[test]
fn gates_without_yaw_have_the_direction_of_the_flight() {
    let yaws = |gates: &[[f64; 3]]| {
        let gates = gates.iter().map(|&position| Gate { position, yaw: None }).collect();
        let mut race = Race::default();
        race.set_track(&RaceTrack { gates, solid: true, ..race.track() });
        let normal = |gate: usize| race.gate_pose(gate).unwrap().1;
        (0..race.gates.len()).map(|gate| normal(gate).y.atan2(normal(gate).x).to_degrees().round()).collect::<Vec<_>>()
    };
    assert_eq!(yaws(&[[0.0, 2.0, 1.0], [0.0, -2.0, 1.0]]), [90.0, -90.0], "there and back");
    assert_eq!(yaws(&[[1.0, 0.0, 1.0], [2.0, 1.0, 1.0], [1.0, 0.0, 2.0]])[1], 45.0, "between gates above each other");
    assert_eq!(yaws(&[[1.0, 0.0, 1.0]]), [0.0], "a single gate");
    assert_eq!(yaws(&[[0.0, 0.0, 1.0], [1.0, 0.0, 1.0], [1.0, 1.0, 1.0]])[1], 45.0, "from the one before to the next");
}

#[test]
fn the_built_in_tracks_are_valid() {
    for name in RaceTrack::NAMES {
        let track = RaceTrack::named(name).unwrap();
        assert!(track.solid && track.laps == 2 && track.gates.iter().all(|gate| gate.yaw.is_some()), "{name}");
    }
    let error = RaceTrack::named("figure_eigth").unwrap_err().to_string();
    assert!(error.ends_with("did you mean `figure_eight`?"), "{error}");
}

#[test]
fn errors_name_the_line_and_the_expected_value() {
    let error = |from: &str, to: &str| {
        assert!(FILE.contains(from), "{from}");
        let text = RaceTrack::from_toml(&FILE.replacen(from, to, 1)).unwrap_err().to_string();
        assert!(!text.contains('\n'), "{text}");
        text
    };
    for (from, to, expected) in [
        ("laps = 3", "laps = -1", "line 1"),
        ("laps = 3", "laps = 0", "laps is 0, expected at least 1"),
        ("laps = 3", "laps = 60", "gates is 120 gates, expected 1 to 99 over all laps if they are solid"),
        ("solid", "sold", "line 2, column 1: unknown field `sold`; did you mean `solid`?"),
        ("opening = 0.6", "opening = nan", "opening is NaN, expected 0.01 to 100 m"),
        ("position = 0.15", "position = -0.1", "randomization.position is -0.1, expected 0 to 10 m"),
        ("yaw = 0.2", "yaw = 4.0", "randomization.yaw is 4, expected 0 to π rad"),
        ("amplitude = 0.1", "amplitude = inf", "motion.amplitude is inf"),
        ("period = 3.0", "period = 0.0", "motion.period is 0, expected 0.1 to 1000 s"),
        ("[1, 0, 1]", "[1, 0]", "2 numbers, expected 3"),
        ("[1, 0, 1]", "[1, 0, nan]", "gates is NaN m along an axis"),
        ("yaw = 3.0", "yaw = 1e9", "gates.yaw is 1000000000"),
        ("yaw = 3.0", "pitch = 1.0", "line 19, column 1: unknown field `pitch`"),
    ] {
        let got = error(from, to);
        assert!(got.contains(expected), "{got}");
    }
    assert!(RaceTrack::from_toml("laps = 1\n").unwrap_err().to_string().contains("missing field `gates`"));
    let error = RaceTrack::find("no/such.toml").unwrap_err().to_string();
    assert!(error.starts_with("no/such.toml: No such file"), "{error}");
}

#[test]
fn frames_of_solid_gates_are_above_the_floor_and_do_not_overlap() {
    let read = |solid: bool, gates: &[([f64; 3], f64)]| {
        let gate = |(position, yaw): &([f64; 3], f64)| format!("[[gates]]\nposition = {position:?}\nyaw = {yaw:?}\n");
        let gates = gates.iter().map(gate).collect::<String>();
        RaceTrack::from_toml(&format!("solid = {solid}\n{gates}")).map(|_| ()).map_err(|error| error.to_string())
    };
    let (low, high, far) = (([0.0, 0.0, 0.27], 0.0), ([0.0, 0.0, 0.28], 0.0), ([3.0, 0.0, 1.0], 0.0));
    let error = read(true, &[far, low]).unwrap_err();
    assert!(error.starts_with("gates.position is 0.27 m high for gate 1, expected at least half"), "{error}");
    assert_eq!([read(false, &[far, low]), read(true, &[far, high])], [Ok(()), Ok(())]);
    let at = |x: f64, y: f64, z: f64, yaw: f64| ([x, y, z], yaw);
    for (second, overlaps) in [
        // bars of one frame cross those of the other
        (at(0.0, 0.28, 1.0, 1.5), true),
        (at(0.0, 0.0, 1.0, 1.0), true),
        (at(0.0, 0.3, 1.3, 0.0), true),
        (at(0.02, 0.0, 1.0, 0.0), true),
        // next to each other, above each other, and behind each other
        (at(0.0, 0.561, 1.0, 0.0), false),
        (at(0.0, 0.0, 1.561, 0.0), false),
        (at(0.031, 0.0, 1.0, 0.0), false),
        // one frame that is passed twice, in one direction or in both
        (at(0.0, 0.0, 1.0, 0.0), false),
        (at(0.0, 0.0, 1.0, std::f64::consts::PI), false),
    ] {
        let got = read(true, &[far, at(0.0, 0.0, 1.0, 0.0), second]);
        let wrong = "gates.position is in the frame of gate 1 for gate 2, expected gates whose frames do not overlap";
        assert_eq!(got, if overlaps { Err(wrong.into()) } else { Ok(()) }, "{second:?}");
        assert_eq!(read(false, &[far, at(0.0, 0.0, 1.0, 0.0), second]), Ok(()));
    }
}

proptest! {
    #[test]
    fn damaged_files_are_errors_of_one_line_or_valid_tracks(at in 0usize..300, letter in 32u8..127) {
        let mut bytes = FILE.as_bytes().to_vec();
        let at = at % bytes.len();
        bytes[at] = letter;
        match RaceTrack::from_toml(std::str::from_utf8(&bytes).unwrap()) {
            Ok(track) => prop_assert_eq!(track.validate(), Ok(())),
            Err(error) => prop_assert!(!error.to_string().contains('\n'), "{}", error),
        }
    }
}
