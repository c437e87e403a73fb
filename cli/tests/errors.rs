//! The width of error lines.

use std::path::Path;
use std::process::Command;

mod common;

use common::{directory, pretrained, reference, write};

/// Values of options and keys that are out of range, or no numbers.
const VALUES: [&str; 5] = ["1e300", "-1e-300", "5e15", "nan", "inf"];

/// Widest error line, columns.
const MAX_WIDTH: usize = 120;

/// Runs the program in a directory. Returns true for an error.
///
/// An error must have one line of at most 120 columns without long numbers.
fn has_short_error(directory: &Path, arguments: &[&str]) -> bool {
    let mut program = Command::new(env!("CARGO_BIN_EXE_aviary"));
    let output = program.args(arguments).current_dir(directory).output().unwrap();
    let error = String::from_utf8(output.stderr).unwrap();
    if output.status.success() {
        return false;
    }
    assert_eq!(error.lines().count(), 1, "{arguments:?}: {error}");
    let error = error.trim_end().replace(env!("CARGO_MANIFEST_DIR"), "");
    assert!(error.starts_with("error: "), "{arguments:?}: {error}");
    assert!(error.chars().count() <= MAX_WIDTH, "{arguments:?}: {} columns: {error}", error.chars().count());
    let digits = error.split(|c: char| !c.is_ascii_digit() && c != '.').map(str::len).max();
    assert!(digits < Some(25), "{arguments:?}: {error}");
    true
}

/// Returns the text with each value in place of every number of each key, one key at a time.
fn with_values(toml: &str) -> impl Iterator<Item = String> {
    let lines: Vec<_> = toml.lines().map(str::to_string).collect();
    (0..lines.len()).flat_map(move |index| {
        let lines = lines.clone();
        VALUES.into_iter().filter_map(move |value| {
            let (key, old) = lines[index].split_once(" = ")?;
            let brackets = |c: char| "[], ".contains(c);
            let new = old.split_inclusive(brackets).map(|part| match part.trim_end_matches(brackets) {
                "" => part.to_string(),
                number => part.replace(number, value),
            });
            let mut lines = lines.clone();
            lines[index] = format!("{key} = {}", new.collect::<String>());
            Some(lines.join("\n") + "\n")
        })
    })
}

#[test]
fn errors_about_options_fit_120_columns() {
    let dir = directory("wide-options");
    std::fs::create_dir_all(&dir).unwrap();
    let policy = pretrained("hover");
    for value in VALUES {
        for arguments in [
            &["fly", "--task", "hover", "--duration", value][..],
            &["fly", "--task", "hover", "--num-drones", value],
            &["fly", "--task", "hover", "--sim-freq", value],
            &["fly", "--task", "hover", "--ctrl-freq", value],
            &["fly", "--task", "hover", "--seed", value],
            &["fly", "--task", "hover", "--drone", value],
            &["fly", "--task", value],
            &["fly", "--task", "hover", "--physics", value],
            &["fly", "--task", "hover", "--trajectory", value],
            &["fly", "--task", "race", "--track", value],
            &["benchmark", "--controller", "pid", "--episodes", value],
            &["benchmark", "--controller", "pid", "--suite", value],
            &["fly", "--task", "hover", "--overlay", value, "--gif", "a.gif"],
            &["fly", "--task", "hover", "--size", value, "--gif", "a.gif"],
            &["fly", "--task", "hover", value],
            &["render", "--task", "hover", "--out", "x.png", "--at", value],
            &["capture", "--task", "hover", "--out", "x", "--frames", value],
            &["capture", "--task", "hover", "--out", "x", "--frames", "1", "--every", value],
            &["train", "--task", "hover", "--steps", value],
            &["train", "--task", "hover", "--envs", value],
            &["train", "--task", "hover", "--seed", value],
            &["play", "--policy", &policy, "--episodes", value],
            &["play", "--policy", &policy, "--duration", value],
            &["bench", "--seed", value],
            &["completions", value],
            &["airframe", value],
            &[value],
        ] {
            assert!(has_short_error(&dir, arguments), "{arguments:?}");
        }
    }
}

#[test]
fn errors_about_keys_of_files_fit_120_columns() {
    let dir = directory("wide-keys");
    let airframe = include_str!("../../assets/airframes/cf2x.toml");
    let wind = "[wind]\nmodel = \"combined\"\nvelocity = [1.0, 0.0, 0.0]\ngust_force = 0.1\ngust_duration = 1.0\n\
        gust_rate = 0.2\nturbulence = 1.0\nsinusoidal_force = 0.1\nsinusoidal_frequency = 1.0\nair_density = 1.2\n";
    let obstacles = "[obstacles]\nkind = \"forest\"\ncount = 3\narena = [8.0, 8.0, 3.0]\n\
        spacing = 0.2\nsafe_zone = 1.0\nnew_layout = true\nseed = 3\n";
    let custom = "[obstacles]\nkind = \"custom\"\n[[obstacles.custom]]\nshape = \"box\"\nsize = [0.1, 0.1, 1.0]\n\
        position = [2.0, 0.0, 1.0]\neuler = [0.0, 0.0, 0.0]\n";
    let randomization = "[randomization.body]\nmass = [1.0, 1.1]\n[randomization.aerodynamics]\ndrag = [1.0, 1.1]\n\
        [randomization.actuators]\nlag = [0.0, 0.1]\nlatency = [0.0, 0.1]\n[randomization.sensors]\nposition = 0.1\n\
        latency = [0.0, 0.1]\n[randomization.environment]\ngravity = [1.0, 1.1]\n[randomization.initial]\n\
        position = 0.1\noffset = [0.0, 0.0, 0.0]\n";
    let circle = "kind = \"circle\"\nradius = 0.5\nperiod = 6.0\ncentre = [0.0, 0.0, 1.0]\nphase = 0.1\nturns = 1.0\n\
        ramp = 1.0\nyaw = 0.1\n";
    let waypoints = "kind = \"waypoints\"\npoints = [[0.0, 0.0, 1.0], [1.0, 0.0, 1.0]]\nyaws = [0.0, 1.0]\n\
        max_speed = 1.0\nmax_acceleration = 2.0\n";
    let track = "laps = 2\nopening = 0.5\n[randomization]\nposition = 0.1\nyaw = 0.1\n[motion]\namplitude = 0.1\n\
        period = 2.0\n[[gates]]\nposition = [1.0, 0.0, 1.0]\nyaw = 0.5\n";
    let training = "steps = 10\nepisode_seconds = 10.0\nevaluate_every = 3\nout_of_bounds = 1.0\nsim_freq = 240\n\
        [ppo]\nenvironments = 2\nhidden = [8]\nlearning_rate = 1e-3\ngamma = 0.99\ngae_lambda = 0.9\nclip_range = 0.2\n\
        max_grad_norm = 1.0\ninitial_std = 0.5\n";
    let scenario = std::fs::read_to_string(reference("mjc_cf2x.toml")).unwrap()
        + "initial_velocities = [[0.0, 0.0, 0.0]]\ngravity = 9.8\n[medium]\ndensity = 1.2\nviscosity = 1e-5\n";
    let actions = reference("mjc_cf2x.actions.csv");
    let fly = |option: &'static str| vec!["fly", "--task", "hover", "--duration", "0.1", option, "a.toml"];
    let cases = [
        (airframe, vec!["airframe", "a.toml"]),
        (wind, fly("--config")),
        (obstacles, fly("--config")),
        (custom, fly("--config")),
        (randomization, fly("--config")),
        (circle, fly("--trajectory")),
        (waypoints, fly("--trajectory")),
        (track, vec!["fly", "--task", "race", "--duration", "0.1", "--track", "a.toml"]),
        (training, vec!["train", "--task", "hover", "--config", "a.toml", "--show"]),
        (&scenario, vec!["replay", "--scenario", "a.toml", "--actions", &actions, "--out", "x.csv"]),
    ];
    for (toml, arguments) in &cases {
        let path = write(&dir.join("a.toml"), toml);
        assert!(!has_short_error(&dir, arguments), "{toml}");
        let errors = with_values(toml).filter(|toml| {
            write(&path, toml);
            has_short_error(&dir, arguments)
        });
        let (errors, keys) = (errors.count(), toml.matches(" = ").count());
        assert!(errors >= keys, "{errors} errors about {keys} keys of {arguments:?}");
    }
}

#[test]
fn errors_about_unknown_keys_fit_120_columns() {
    let path = write(&directory("wide-unknown").join("a.toml"), "");
    let dir = path.parent().unwrap();
    let fly = |option: &'static str| vec!["fly", "--task", "hover", option, "a.toml"];
    let train = vec!["train", "--task", "hover", "--config", "a.toml", "--show"];
    for (toml, arguments) in [
        ("xyz = 1\n", &train),
        ("stepps = 1\n", &train),
        ("[ppo]\nxyz = 1\n", &train),
        ("[wind]\nxyz = 1\n", &fly("--config")),
        ("[obstacles]\nxyz = 1\n", &fly("--config")),
        ("[randomization.xyz]\n", &fly("--config")),
        ("kind = \"circle\"\nradius = 1\nperiod = 1\nxyz = 1\n", &fly("--trajectory")),
        ("xyz = 1\n", &vec!["airframe", "a.toml"]),
        ("xyz = 1\n", &vec!["replay", "--scenario", "a.toml", "--actions", "x.csv", "--out", "y.csv"]),
    ] {
        write(&path, toml);
        assert!(has_short_error(dir, arguments), "{toml}");
    }
}
