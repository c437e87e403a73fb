//! Commands, links and images of README and guides. A test runs the commands, and shortens slow ones.

use std::path::{Path, PathBuf};
use std::process::Command;

/// Returns the root of the repository.
fn root() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).parent().unwrap().to_path_buf()
}

/// Returns the paths of all documents.
fn pages() -> Vec<PathBuf> {
    let guides = std::fs::read_dir(root().join("docs")).unwrap().map(|entry| entry.unwrap().path());
    let mut pages: Vec<_> = guides.filter(|path| path.extension().is_some_and(|ending| ending == "md")).collect();
    pages.extend([root().join("README.md"), root().join("ARCHITECTURE.md")]);
    pages.sort();
    pages
}

/// Returns the code blocks of a language.
fn blocks(page: &str, language: &str) -> Vec<String> {
    let start = format!("```{language}\n");
    page.split(&start).skip(1).filter_map(|rest| rest.split("\n```").next()).map(str::to_string).collect()
}

/// Returns the commands of a page: the lines of its shell blocks, and inline code that begins like a command.
fn commands(page: &str) -> Vec<String> {
    let mut commands: Vec<String> = Vec::new();
    for block in blocks(page, "sh") {
        commands.extend(block.lines().filter(|line| !line.trim().is_empty()).map(str::to_string));
    }
    let mut inside = false;
    for line in page.lines() {
        if line.starts_with("```") {
            inside = !inside;
        } else if !inside {
            let quoted = line.split('`').skip(1).step_by(2);
            // a word in capitals is a placeholder
            let has_placeholder = |text: &str| {
                text.split(' ').any(|word| {
                    word.len() > 1 && word.trim_end_matches(char::is_numeric).chars().all(|c| c.is_ascii_uppercase())
                        || word.contains("FILE")
                        || word == "T"
                })
            };
            commands.extend(
                quoted
                    .filter(|text| text.starts_with("aviary ") || text.starts_with("cargo "))
                    .filter(|text| !has_placeholder(text) && !text.contains('…'))
                    // the name of a command without its required options
                    .filter(|text| {
                        !["fly", "capture", "render", "replay", "train", "play", "airframe"]
                            .iter()
                            .any(|name| *text == format!("aviary {name}"))
                    })
                    .map(str::to_string),
            );
        }
    }
    commands.sort();
    commands.dedup();
    // other commands fly the trained policies
    commands.sort_by_key(|command| !command.starts_with("aviary train"));
    commands
}

/// Returns true if OpenGL works on this machine.
fn has_gl() -> bool {
    mujoco_rs::gl_info().is_ok()
}

/// Runs a command line of the program in a directory.
fn run(directory: &Path, line: &str) {
    let mut words: Vec<&str> = line.split_whitespace().collect();
    let draws = ["render", "capture", "doctor"].contains(&words[0])
        || words.iter().any(|word| ["--gif", "--video", "--png"].contains(word));
    if draws && !has_gl() {
        return;
    }
    if words[0] == "bench" && !words.contains(&"--quick") {
        words.push("--quick");
    }
    if words.contains(&"--video") && Command::new("ffmpeg").arg("-version").output().is_err() {
        return;
    }
    if words[0] == "play" {
        words.extend(["--duration", "1"]);
    }
    // a short animation tests the same code
    if words.contains(&"--gif") && !words.contains(&"--duration") {
        words.extend(["--duration", "1"]);
    }
    // a short training writes the same files
    if words[0] == "train" {
        words.retain(|word| *word != "--until-success");
        words.extend(["--steps", "4096", "--envs", "64"]);
    }
    // several pages train the same task into the default directory, which takes one run
    let own = line.replace(|c: char| !c.is_alphanumeric(), "_");
    let own = format!("out/train/{own}");
    if words[0] == "train" && !["--out", "--show", "--resume"].iter().any(|option| words.contains(option)) {
        words.extend(["--out", own.as_str()]);
    }
    let output = Command::new(env!("CARGO_BIN_EXE_aviary")).args(&words).current_dir(directory).output().unwrap();
    assert!(output.status.success(), "aviary {line}: {}", String::from_utf8_lossy(&output.stderr));
}

/// Asserts that a `fly` command succeeds. Options of animations are left out.
fn succeeds(directory: &Path, line: &str) {
    let mut words = Vec::new();
    let mut given = line.split_whitespace();
    while let Some(word) = given.next() {
        match word {
            "--gif" | "--video" | "--frames" | "--camera" | "--overlay" | "--size" => drop(given.next()),
            _ => words.push(word),
        }
    }
    words.push("--json");
    let output = Command::new(env!("CARGO_BIN_EXE_aviary")).args(&words).current_dir(directory).output().unwrap();
    let flight: serde_json::Value = serde_json::from_slice(&output.stdout)
        .unwrap_or_else(|_| panic!("aviary {line}: {}", String::from_utf8_lossy(&output.stderr)));
    assert_eq!(flight["success"], true, "aviary {line}: {flight}");
}

/// Asserts that the target of a `cargo` command exists.
fn assert_target_exists(line: &str) {
    let words: Vec<&str> = line.split_whitespace().collect();
    for pair in words.windows(2) {
        let name = pair[1];
        let places = match pair[0] {
            "--example" => vec![format!("examples/{name}.rs")],
            "--bench" => vec![format!("benches/{name}.rs")],
            "--test" => ["tests", "mujoco-rs/tests", "cli/tests"]
                .map(|place| [format!("{place}/{name}.rs"), format!("{place}/{name}/main.rs")])
                .concat(),
            "-p" | "--path" => ["", "assets/"].map(|place| format!("{place}{name}/Cargo.toml")).into(),
            _ => continue,
        };
        assert!(places.iter().any(|place| root().join(place).exists()), "{line}: no {places:?}");
    }
}

#[test]
fn every_command_of_the_documentation_works() {
    let directory = PathBuf::from(env!("CARGO_TARGET_TMPDIR")).join("documentation");
    let _ = std::fs::remove_dir_all(&directory);
    std::fs::create_dir_all(&directory).unwrap();
    for name in ["assets", "tests"] {
        std::os::unix::fs::symlink(root().join(name), directory.join(name)).unwrap();
    }
    let airframe = &blocks(&std::fs::read_to_string(root().join("docs/airframes.md")).unwrap(), "toml")[0];
    std::fs::write(directory.join("my_quad.toml"), airframe).unwrap();
    let (mut count, mut flights) = (0, 0);
    for page in pages() {
        for command in commands(&std::fs::read_to_string(&page).unwrap()) {
            for part in command.split(" && ") {
                let part = part.trim();
                count += 1;
                if let Some(line) = part.strip_prefix("aviary ").or(part.strip_prefix("cargo run --release -p cli -- "))
                {
                    // without the redirection of the shell
                    let line = line.split(" > ").next().unwrap();
                    run(&directory, line);
                    if line.starts_with("fly ") {
                        succeeds(&directory, line);
                        flights += 1;
                    }
                } else if part.starts_with("cargo ") {
                    assert_target_exists(part);
                } else {
                    let known = ["./setup", "git clone ", "cd "].iter().any(|start| part.starts_with(start));
                    assert!(known || part.contains("aviary doctor"), "{}: {part}", page.display());
                }
            }
        }
    }
    assert!(count > 60 && flights > 12, "{count} commands, {flights} flights");
}

#[test]
fn links_and_images_of_the_documentation_exist() {
    for page in pages() {
        let text = std::fs::read_to_string(&page).unwrap();
        for target in text.split("](").skip(1).filter_map(|rest| rest.split(')').next()) {
            let path = target.split('#').next().unwrap();
            if path.is_empty() || path.contains("://") {
                continue;
            }
            assert!(page.parent().unwrap().join(path).exists(), "{}: {target}", page.display());
        }
    }
}

#[test]
fn the_images_of_the_documentation_have_at_most_3_mb() {
    let images = std::fs::read_dir(root().join("docs/images")).unwrap();
    let bytes: u64 = images.map(|entry| entry.unwrap().metadata().unwrap().len()).sum();
    assert!(bytes < 3_000_000, "{bytes}");
}

#[test]
fn the_guide_about_tasks_has_a_complete_manifest() {
    let text = std::fs::read_to_string(root().join("docs/tasks.md")).unwrap();
    let manifest = &blocks(&text, "toml")[0];
    for line in ["edition = \"2024\"", "mujoco-drones-gym = { path = ", "[profile.dev]"] {
        assert!(manifest.contains(line), "{line}");
    }
}
