//! Generates the airframe meshes from dimensions and writes them as OBJ files.
//!
//! `meshgen OUT_DIR` writes `OUT_DIR/cf2/*.obj` and `OUT_DIR/race/*.obj`;
//! `meshgen --check DIR` compares the files in `DIR` with what would be
//! written. Positions are in metres in the body frame: x forward, y left, z up.

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

/// What `--help` prints and every complaint about arguments ends in.
const USAGE: &str = "usage: meshgen OUT_DIR | meshgen --check DIR";

/// A mesh and where it belongs.
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
    /// Path under `root`.
    fn path(&self, root: &Path) -> PathBuf {
        root.join(self.folder).join(&self.name)
    }

    /// The file's contents.
    fn contents(&self) -> String {
        obj::to_obj(&self.title, &self.part)
    }
}

/// What the arguments ask for.
#[derive(Debug, PartialEq)]
enum Request {
    /// Write every mesh under a directory.
    Write(PathBuf),
    /// Compare a directory with what would be written.
    Check(PathBuf),
    /// Say how to use the program.
    Help,
}

/// Every mesh, in a fixed order.
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

/// Reads the command line (without the program's name).
fn parse(arguments: &[OsString]) -> Result<Request, String> {
    // Only options are compared as text: a path may be anything but empty.
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

/// Writes every mesh under `root`, making folders as needed.
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

/// Compares every mesh with its file under `root`, and reports the first file
/// that is missing, different or left over from an earlier set.
fn check(root: &Path) -> Result<usize, String> {
    let assets = assets();
    for asset in &assets {
        let path = asset.path(root);
        let found = fs::read(&path).map_err(|error| format!("cannot read {}: {error}", path.display()))?;
        if found != asset.contents().as_bytes() {
            return Err(format!("{} differs from what is generated", path.display()));
        }
    }
    // Sorted, so that the same file is named on every file system.
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
        Some(path) => Err(format!("{} is not generated any more", path.display())),
        None => Ok(assets.len()),
    }
}

/// Does what the arguments ask for; exits with 1 when it fails and with 2 when
/// it cannot make sense of the arguments.
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
            // A closed stream leaves nobody to tell, so failures to print are
            // ignored here and below.
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
