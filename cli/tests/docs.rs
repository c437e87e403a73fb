//! Tests of README and book: commands run, links and anchors resolve, every page is in the summary and its programs are
//! doctests.

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};
use std::process::Command;

mod common;

/// Addresses of files of this repository, which pages of the book link to: the built book has only `docs/`.
const REPOSITORY: [&str; 2] = [
    "https://github.com/mujoco-drones-gym/mujoco-drones-gym/blob/main/",
    "https://github.com/mujoco-drones-gym/mujoco-drones-gym/tree/main/",
];

/// Documents at the root.
const DOCUMENTS: [&str; 4] = ["README.md", "ARCHITECTURE.md", "CONTRIBUTING.md", "CHANGELOG.md"];

fn root() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).parent().unwrap().to_path_buf()
}

fn read(path: &Path) -> String {
    std::fs::read_to_string(path).unwrap_or_else(|error| panic!("{}: {error}", path.display()))
}

/// Returns the pages of the book, with its summary.
fn book() -> Vec<PathBuf> {
    let entries = std::fs::read_dir(root().join("docs")).unwrap().map(|entry| entry.unwrap().path());
    let mut pages: Vec<_> = entries.filter(|path| path.extension().is_some_and(|ending| ending == "md")).collect();
    pages.sort();
    pages
}

fn pages() -> Vec<PathBuf> {
    let mut pages: Vec<_> = DOCUMENTS.iter().map(|name| root().join(name)).collect();
    pages.extend(book());
    pages
}

/// Returns the code blocks of a language.
fn blocks(page: &str, language: &str) -> Vec<String> {
    let start = format!("```{language}\n");
    page.split(&start).skip(1).filter_map(|rest| rest.split("\n```").next()).map(str::to_string).collect()
}

/// Returns the lines outside of code blocks.
fn prose(page: &str) -> impl Iterator<Item = &str> {
    let mut inside = false;
    page.lines().filter(move |line| {
        let fence = line.starts_with("```");
        inside ^= fence;
        !inside && !fence
    })
}

/// Returns true for a command with a placeholder: a word in capitals, or an ellipsis.
fn has_placeholder(command: &str) -> bool {
    command.contains('…')
        || command.split(' ').any(|word| {
            word.len() > 1 && word.trim_end_matches(char::is_numeric).chars().all(|c| c.is_ascii_uppercase())
                || word.contains("FILE")
                || word == "I/N"
                || word == "T"
        })
}

/// Returns the commands of a page: every line of a shell block, and code in backquotes that begins with a program's
/// name.
fn commands(page: &str) -> Vec<String> {
    let mut commands: Vec<String> = Vec::new();
    for block in blocks(page, "sh") {
        let block = block.replace("\\\n", " ");
        let lines = block.lines().map(|line| line.split(" # ").next().unwrap().trim());
        commands.extend(lines.filter(|line| !line.is_empty()).map(str::to_string));
    }
    for line in prose(page) {
        let quoted = line.split('`').skip(1).step_by(2);
        commands.extend(
            quoted
                .filter(|text| text.starts_with("aviary ") || text.starts_with("cargo "))
                .filter(|text| !has_placeholder(text))
                // a name without arguments refers to the command
                .filter(|text| {
                    ![
                        "fly",
                        "view",
                        "capture",
                        "render",
                        "replay",
                        "train",
                        "play",
                        "airframe",
                        "compare",
                        "convert",
                        "identify",
                        "benchmark",
                        "export",
                    ]
                    .iter()
                    .any(|name| *text == format!("aviary {name}"))
                })
                .map(str::to_string),
        );
    }
    commands
}

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
    if words.contains(&"--video") && Command::new("ffmpeg").arg("-version").output().is_err() {
        return;
    }
    // a GPU needs a feature of the program and an adapter
    if words.windows(2).any(|pair| pair == ["--device", "gpu"]) {
        return;
    }
    // the window has tests of its own
    if words[0] == "view" || words.contains(&"--view") {
        return;
    }
    if words[0] == "play" {
        words.extend(["--duration", "1"]);
    }
    // animations of a second are enough
    if words.contains(&"--gif") && !words.contains(&"--duration") {
        words.extend(["--duration", "1"]);
    }
    // short training runs write the same files
    if words[0] == "train" {
        words.retain(|word| *word != "--until-success");
        words.extend(["--steps", "4096", "--envs", "64"]);
    }
    // a directory belongs to one run, and several commands train into the default one
    let separate = format!("out/train/{}", line.replace(|c: char| !c.is_alphanumeric(), "_"));
    if words[0] == "train" && !["--out", "--show", "--resume"].iter().any(|option| words.contains(option)) {
        words.extend(["--out", separate.as_str()]);
    }
    let output = Command::new(env!("CARGO_BIN_EXE_aviary")).args(&words).current_dir(directory).output().unwrap();
    assert!(output.status.success(), "aviary {line}: {}", String::from_utf8_lossy(&output.stderr));
}

/// Flies a `fly` command to its end, without images, and expects success.
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

/// Checks that the examples, tests, benches and packages in the arguments of cargo exist.
fn targets_exist(line: &str) {
    let words: Vec<&str> = line.split_whitespace().collect();
    for pair in words.windows(2) {
        let name = pair[1];
        let places = match pair[0] {
            "--example" => vec![format!("examples/{name}.rs")],
            "--bench" => vec![format!("benches/{name}.rs")],
            "--test" => ["tests", "mujoco-rs/tests", "cli/tests"]
                .iter()
                .flat_map(|place| [format!("{place}/{name}.rs"), format!("{place}/{name}/main.rs")])
                .collect(),
            "-p" | "--path" => ["", "assets/"].map(|place| format!("{place}{name}/Cargo.toml")).into(),
            _ => continue,
        };
        assert!(places.iter().any(|place| root().join(place).exists()), "{line}: no {places:?}");
    }
}

#[test]
fn every_documented_command_runs() {
    let directory = PathBuf::from(env!("CARGO_TARGET_TMPDIR")).join("documentation");
    let _ = std::fs::remove_dir_all(&directory);
    std::fs::create_dir_all(&directory).unwrap();
    for name in ["assets", "tests"] {
        std::os::unix::fs::symlink(root().join(name), directory.join(name)).unwrap();
    }
    let airframe = &blocks(&read(&root().join("docs/airframes.md")), "toml")[0];
    std::fs::write(directory.join("my_quad.toml"), airframe).unwrap();
    common::write(&directory.join("cf21.toml"), &common::airframe_with_motors());
    common::write(&directory.join("flights/climb.csv"), &common::recorded_flight(4.5));
    common::write(&directory.join("log00.csv"), "timestamp,pm.vbat\n0,3.7\n10,3.7\n20,3.6\n");

    let (mut lines, mut cargo) = (BTreeSet::new(), BTreeSet::new());
    for page in pages() {
        for command in commands(&read(&page)) {
            for part in command.split(" && ").map(str::trim) {
                let line = part.strip_prefix("aviary ").or(part.strip_prefix("cargo run --release -p cli -- "));
                if let Some(line) = line {
                    // redirections are the shell's
                    let line = line.split(" > ").next().unwrap();
                    lines.insert(if line == "bench" { "bench --quick".into() } else { line.to_string() });
                } else if part.starts_with("cargo ") {
                    cargo.insert(part.to_string());
                } else {
                    // the tests of the Python package run its examples
                    let others = ["./setup", "git clone ", "cd ", ".ci/", "pip install ", "python/build-wheel"];
                    let known = others.iter().any(|start| part.starts_with(start));
                    assert!(known || part.contains("aviary doctor"), "{}: {part}", page.display());
                }
            }
        }
    }
    cargo.iter().for_each(|line| targets_exist(line));
    // policies must be trained before others fly them
    let mut lines: Vec<_> = lines.into_iter().collect();
    lines.sort_by_key(|line| !line.starts_with("train "));
    for line in &lines {
        run(&directory, line);
    }
    let flights: Vec<_> = lines.iter().filter(|line| line.starts_with("fly ")).collect();
    flights.iter().for_each(|line| succeeds(&directory, line));
    assert!(lines.len() > 30 && cargo.len() > 30 && flights.len() > 12, "{lines:?} {cargo:?}");
}

/// Returns the anchors of a page: headings in lower case, without punctuation, with hyphens for spaces.
fn anchors(page: &str) -> BTreeSet<String> {
    let headings = prose(page).filter(|line| line.starts_with('#')).map(|line| line.trim_start_matches('#').trim());
    headings
        .map(|heading| {
            let kept = heading.chars().filter(|c| c.is_alphanumeric() || [' ', '-', '_'].contains(c));
            kept.collect::<String>().to_lowercase().replace(' ', "-")
        })
        .collect()
}

/// Returns the targets of the links and images of a page.
fn links(page: &str) -> Vec<String> {
    let text = prose(page).collect::<Vec<_>>().join("\n");
    // code in backquotes has no links
    let text: String = text.split('`').step_by(2).collect();
    let inline = text.split("](").skip(1).filter_map(|rest| rest.split(')').next());
    inline.map(str::to_string).collect()
}

#[test]
fn every_link_and_anchor_of_the_documentation_resolves() {
    let mut count = 0;
    for page in pages() {
        let text = read(&page);
        let in_book = page.starts_with(root().join("docs"));
        for target in links(&text) {
            if let Some(path) = REPOSITORY.iter().find_map(|address| target.strip_prefix(address)) {
                assert!(root().join(path).exists(), "{}: {target}", page.display());
                continue;
            }
            if target.contains("://") {
                continue;
            }
            count += 1;
            assert!(!in_book || !target.starts_with(".."), "{}: {target} is outside of the book", page.display());
            let (path, anchor) = target.split_once('#').unwrap_or((&target, ""));
            let linked = if path.is_empty() { page.clone() } else { page.parent().unwrap().join(path) };
            assert!(linked.exists(), "{}: {target}", page.display());
            assert!(
                anchor.is_empty() || anchors(&read(&linked)).contains(anchor),
                "{}: {target}: no such heading",
                page.display()
            );
        }
    }
    assert!(count > 80, "{count} links");
}

#[test]
fn the_summary_of_the_book_lists_every_page_once() {
    let listed = links(&read(&root().join("docs/SUMMARY.md")));
    let names: BTreeSet<_> = listed.iter().cloned().collect();
    assert_eq!(names.len(), listed.len(), "{listed:?}");
    let there = book().into_iter().map(|path| path.file_name().unwrap().to_string_lossy().into_owned());
    assert_eq!(names, there.filter(|name| name != "SUMMARY.md").collect());
}

#[test]
fn every_page_with_a_rust_program_is_a_doctest() {
    let library = read(&root().join("src/lib.rs"));
    for page in pages() {
        if blocks(&read(&page), "rust").is_empty() {
            continue;
        }
        let name = page.strip_prefix(root()).unwrap().display().to_string();
        assert!(library.contains(&format!("include_str!(\"../{name}\")")), "{name}");
    }
}

#[test]
fn the_images_of_the_documentation_have_at_most_3_mb() {
    let images = std::fs::read_dir(root().join("docs/images")).unwrap();
    let bytes: u64 = images.map(|entry| entry.unwrap().metadata().unwrap().len()).sum();
    assert!(bytes < 3_000_000, "{bytes}");
}

#[test]
fn the_manifest_of_the_task_guide_depends_on_this_package() {
    let manifest = &blocks(&read(&root().join("docs/tasks.md")), "toml")[0];
    for line in ["edition = \"2024\"", "mujoco-drones-gym = { path = ", "[profile.dev]"] {
        assert!(manifest.contains(line), "{line}");
    }
}
