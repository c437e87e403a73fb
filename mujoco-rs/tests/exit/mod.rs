//! Child processes that end in a given state. Each child is this program, with a preloaded library
//! (`slow_thread_exit.c`) that delays the destructors of thread-specific data. The workspace's `tests/exit.rs` also
//! includes this module.
#![allow(clippy::print_stdout)]

use std::path::PathBuf;
use std::process::Command;

/// Environment variable with the name of the program that a child runs.
const CHILD: &str = "MJ_DRONES_TEST_EXIT";

/// Main function of a test program. A child runs one of `programs` and returns. The parent runs each of them `runs`
/// times (or `EXIT_RUNS` times) with each OpenGL library of this machine.
pub fn main(name: &str, backend: impl Fn() -> Option<String>, programs: &[(&str, fn())], runs: usize) {
    if let Ok(what) = std::env::var(CHILD) {
        match programs.iter().find(|(name, _)| *name == what) {
            Some((_, program)) => program(),
            None => println!("{}", backend().unwrap_or_default()),
        }
        return;
    }
    // supports the arguments of the standard harness: a filter, `--list`
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    if arguments.iter().any(|argument| argument == "--list") {
        println!("{name}: test");
        return;
    }
    let filters: Vec<_> = arguments.iter().filter(|argument| !argument.starts_with('-')).collect();
    if !filters.is_empty() && !filters.iter().any(|filter| name.contains(filter.as_str())) {
        return;
    }
    let runs = std::env::var("EXIT_RUNS").map_or(runs, |runs| runs.parse().unwrap());
    let failures = failures(&backend, programs, runs);
    assert!(failures.is_empty(), "{failures:#?}");
    println!("test {name} ... ok");
}

/// Returns a description of every child that did not exit successfully.
fn failures(backend: &impl Fn() -> Option<String>, programs: &[(&str, fn())], runs: usize) -> Vec<String> {
    let library = delays();
    // keep libraries that are preloaded already, for example a sanitizer
    let mut preloaded = std::env::var_os("LD_PRELOAD").unwrap_or_default();
    preloaded.push(if preloaded.is_empty() { "" } else { ":" });
    preloaded.push(&library);
    let child = |library: &str, what: &str| {
        // a child that never ends counts as a failure
        let mut command = Command::new("timeout");
        command.arg("120").arg(std::env::current_exe().unwrap());
        command.env(CHILD, what).env("MUJOCO_GL", library);
        command
    };
    let mut failures = Vec::new();
    // a machine without OpenGL passes, as in all rendering tests
    for library_name in ["egl", "osmesa"].into_iter().filter(|_| backend().is_some()) {
        let output = child(library_name, "nothing").output().unwrap();
        if String::from_utf8_lossy(&output.stdout).trim() != library_name {
            println!("{library_name} is not installed");
            continue;
        }
        for (program, _) in programs {
            let before = failures.len();
            for run in 0..runs {
                let output = child(library_name, program).env("LD_PRELOAD", &preloaded).output().unwrap();
                if !output.status.success() {
                    let text = String::from_utf8_lossy(&output.stderr).trim().to_string();
                    failures.push(format!("{library_name}, {program}, run {run}: {} {text}", output.status));
                }
            }
            println!("{library_name}, {program}: {} of {runs} runs failed", failures.len() - before);
        }
    }
    std::fs::remove_file(library).unwrap();
    failures
}

/// Compiles the library that delays destructors.
fn delays() -> PathBuf {
    let library = std::env::temp_dir().join(format!("slow_thread_exit_{}.so", std::process::id()));
    // source path relative to the package or to the workspace
    let source = ["tests/exit/slow_thread_exit.c", "mujoco-rs/tests/exit/slow_thread_exit.c"].map(PathBuf::from);
    let source = source.iter().find(|path| path.is_file()).unwrap();
    let arguments = ["-O1", "-shared", "-fPIC", "-ldl", "-o"];
    let status = Command::new("cc").args(arguments).arg(&library).arg(source).status().unwrap();
    assert!(status.success());
    library
}
