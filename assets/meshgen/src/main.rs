//! Generates the airframe meshes from dimensions and writes them as OBJ files.
//!
//! `meshgen OUT_DIR` writes `OUT_DIR/cf2/*.obj` and `OUT_DIR/race/*.obj`. `meshgen --check DIR` compares the files
//! in `DIR` with the generated ones. Positions are in metres in the body frame: x forward, y left, z up.

mod crazyflie;
mod mesh;
mod obj;
mod propeller;
mod racer;
#[cfg(test)]
mod tests;
mod vec3;

use mesh::Part;
use std::ffi::OsString;
use std::fs;
use std::io::{self, Write};
use std::path::{Path, PathBuf};
use std::process::ExitCode;

/// Usage, printed by `--help` and with every argument error.
const USAGE: &str = "usage: meshgen OUT_DIR | meshgen --check DIR";

/// A mesh and its destination.
struct Asset {
    /// Folder under the output directory.
    folder: &'static str,
    /// File name.
    name: String,
    /// First line of the file.
    title: String,
    /// The geometry.
    part: Part,
}

impl Asset {
    /// Returns the path below `root`.
    fn path(&self, root: &Path) -> PathBuf {
        root.join(self.folder).join(&self.name)
    }

    /// Returns the content of the file.
    fn contents(&self) -> String {
        obj::to_obj(&self.title, &self.part)
    }
}

/// Parsed command line.
#[derive(Debug, PartialEq)]
enum Request {
    /// Write all meshes below a directory.
    Write(PathBuf),
    /// Compare a directory with the generated meshes.
    Check(PathBuf),
    /// Print the usage.
    Help,
}

/// Returns all meshes, in a fixed order.
fn assets() -> Vec<Asset> {
    let airframes = [
        ("cf2", "Crazyflie 2.x", crazyflie::visual(), crazyflie::collision()),
        ("race", "250 mm racer", racer::visual(), racer::collision()),
    ];
    let mut assets = Vec::new();
    for (folder, airframe, visual, collision) in airframes {
        for (prefix, parts) in [("", visual), ("collision_", collision)] {
            for (index, (role, part)) in parts.into_iter().enumerate() {
                assets.push(Asset {
                    folder,
                    name: format!("{folder}_{prefix}{index}.obj"),
                    title: format!("{airframe}: {role}"),
                    part,
                });
            }
        }
    }
    assets
}

/// Parses the command line (without the program's name).
fn parse(arguments: &[OsString]) -> Result<Request, String> {
    // Only options are compared as text; a path may be any non-empty string.
    let texts: Vec<_> = arguments.iter().map(|a| a.to_string_lossy()).collect();
    let texts: Vec<&str> = texts.iter().map(AsRef::as_ref).collect();
    match texts.as_slice() {
        ["-h" | "--help"] => Ok(Request::Help),
        [] => Err("no output directory given".to_owned()),
        ["--check"] => Err("--check needs a directory".to_owned()),
        [""] | ["--check", ""] => Err("the directory's name is empty".to_owned()),
        ["--check", _] => Ok(Request::Check(PathBuf::from(&arguments[1]))),
        ["--check", ..] => Err("--check takes one directory".to_owned()),
        [option, ..] if option.starts_with('-') => Err(format!("unknown option '{option}'")),
        [_] => Ok(Request::Write(PathBuf::from(&arguments[0]))),
        _ => Err(format!("one directory expected, not {}", texts.len())),
    }
}

/// Writes all meshes below `root`, and creates folders as needed. Returns the number of files.
fn write(root: &Path) -> Result<usize, String> {
    let assets = assets();
    for asset in &assets {
        let folder = root.join(asset.folder);
        fs::create_dir_all(&folder).map_err(|error| format!("cannot create {}: {error}", folder.display()))?;
        let path = asset.path(root);
        fs::write(&path, asset.contents()).map_err(|error| format!("cannot write {}: {error}", path.display()))?;
    }
    Ok(assets.len())
}

/// Compares all meshes with the files below `root`. Returns the number of files, or an error with the first file
/// that is missing, different or not generated.
fn check(root: &Path) -> Result<usize, String> {
    let assets = assets();
    for asset in &assets {
        let path = asset.path(root);
        let found = fs::read(&path).map_err(|error| format!("cannot read {}: {error}", path.display()))?;
        if found != asset.contents().as_bytes() {
            return Err(format!("{} differs from the generated mesh", path.display()));
        }
    }
    // Sorted, so that the error names the same file on every file system.
    let mut left_over = Vec::new();
    for folder in ["cf2", "race"] {
        let folder_path = root.join(folder);
        let unreadable = |error: io::Error| format!("cannot read {}: {error}", folder_path.display());
        for entry in fs::read_dir(&folder_path).map_err(unreadable)? {
            let name = entry.map_err(unreadable)?.file_name();
            let text = name.to_string_lossy();
            let known = assets.iter().any(|asset| asset.folder == folder && asset.name == text);
            if text.ends_with(".obj") && !known {
                left_over.push(folder_path.join(&name));
            }
        }
    }
    left_over.sort();
    match left_over.first() {
        Some(path) => Err(format!("{} is no longer generated", path.display())),
        None => Ok(assets.len()),
    }
}

/// Runs the request; exits with 1 on failure and with 2 on invalid arguments.
fn main() -> ExitCode {
    let arguments: Vec<OsString> = std::env::args_os().skip(1).collect();
    let outcome = match parse(&arguments) {
        Ok(Request::Write(root)) => {
            write(&root).map(|count| format!("meshgen: wrote {count} files to {}", root.display()))
        }
        Ok(Request::Check(root)) => {
            check(&root).map(|count| format!("meshgen: {count} files in {} are current", root.display()))
        }
        Ok(Request::Help) => Ok(USAGE.to_owned()),
        Err(complaint) => {
            // Failures to print are ignored here and below, because there is no other output.
            let _ = writeln!(io::stderr(), "meshgen: {complaint}; {USAGE}");
            return ExitCode::from(2);
        }
    };
    match outcome {
        Ok(message) => {
            let _ = writeln!(io::stdout(), "{message}");
            ExitCode::SUCCESS
        }
        Err(complaint) => {
            let _ = writeln!(io::stderr(), "meshgen: {complaint}");
            ExitCode::FAILURE
        }
    }
}
