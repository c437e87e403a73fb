//! Standard output, output files, and progress.

use std::fs::{self, File, TryLockError};
use std::io::{BufWriter, Write};
use std::path::{Path, PathBuf};
use std::sync::{Mutex, MutexGuard, PoisonError};

use anyhow::{Context as _, anyhow};
use aviary::simulation::Simulation;
use indicatif::{ProgressBar, ProgressStyle};
use signal_hook::consts::{
    SIGALRM, SIGHUP, SIGINT, SIGPROF, SIGQUIT, SIGTERM, SIGUSR1, SIGUSR2, SIGVTALRM, SIGXCPU, SIGXFSZ,
};
use signal_hook::iterator::Signals;
use tempfile::NamedTempFile;

use crate::failure::Failure;
use crate::interrupt;

/// Prints text on standard output. A reader that has closed the pipe is not an error.
pub fn print(text: &str) -> Result<(), Failure> {
    let mut stdout = std::io::stdout().lock();
    // standard output keeps what follows the last line break, and does not report at exit that it cannot be written
    match stdout.write_all(text.as_bytes()).and_then(|()| stdout.flush()) {
        Err(error) if error.kind() != std::io::ErrorKind::BrokenPipe => {
            Err(Failure::work(anyhow::Error::new(error).context("standard output cannot be written")))
        }
        _ => Ok(()),
    }
}

/// Prints one JSON object on standard output.
pub fn print_json(value: &serde_json::Value) -> Result<(), Failure> {
    print(&format!("{value:#}\n"))
}

/// Prints the paths of written files, one per line.
pub fn print_written(paths: &[PathBuf]) -> Result<(), Failure> {
    let list: String = paths.iter().map(|path| format!("wrote {}\n", path.display())).collect();
    print(&list)
}

/// Returns a number with `count` decimals, without the sign of a zero, in exponent form above 1e15.
pub fn decimals(x: f64, count: usize) -> String {
    let text = if x.abs() < 1e15 { format!("{x:.count$}") } else { format!("{x:.count$e}") };
    match text.strip_prefix('-') {
        Some(digits) if digits.bytes().all(|byte| matches!(byte, b'0' | b'.')) => digits.to_string(),
        _ => text,
    }
}

/// Returns a table of labels and values.
pub fn table(rows: &[(&str, String)]) -> String {
    let width = rows.iter().map(|(label, _)| label.chars().count()).max().unwrap_or(0);
    rows.iter().map(|(label, value)| format!("{label:width$}  {value}\n")).collect()
}

/// Returns the physics mode of a simulation, or its effects if no mode of the paper has them.
pub fn physics(simulation: &Simulation) -> String {
    simulation.physics().map_or_else(|| format!("effects {}", simulation.effects()), |mode| mode.to_string())
}

/// Creates a progress bar, which is visible only if standard error is a terminal.
pub fn progress(length: u64, what: &'static str) -> ProgressBar {
    progress_with(length, "{msg} {wide_bar} {pos}/{len} {per_sec} {eta}").with_message(what)
}

/// Creates a progress bar from a template of `indicatif`.
pub fn progress_with(length: u64, template: &str) -> ProgressBar {
    let style = ProgressStyle::with_template(template).unwrap_or_else(|_| ProgressStyle::default_bar());
    ProgressBar::new(length).with_style(style)
}

/// Returns the temporary files of this program. Some of them may be finished.
fn unfinished() -> MutexGuard<'static, Vec<PathBuf>> {
    static UNFINISHED: Mutex<Vec<PathBuf>> = Mutex::new(Vec::new());
    UNFINISHED.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Signals that end a program without a handler. SIGINT and SIGTERM come first: the program handles these even if its
/// parent process ignores them.
const TERMINATING: [i32; 10] =
    [SIGINT, SIGTERM, SIGHUP, SIGQUIT, SIGUSR1, SIGUSR2, SIGALRM, SIGVTALRM, SIGPROF, SIGXCPU];

/// Installs handlers that remove unfinished files when a signal ends the program.
///
/// The exit status is 128 plus the number of the signal. A signal that the parent process ignores, as `nohup` does with
/// SIGHUP, stays ignored. A file above the size limit of the shell (`ulimit -f`) is a write error, as a full disk is,
/// and not a signal.
pub fn clean_up_when_interrupted() -> Result<(), Failure> {
    // an empty handler, because without one the system ends the program
    let _ = signal_hook::flag::register(SIGXFSZ, std::sync::Arc::default());
    let ignored = ignored_signals();
    let handled =
        TERMINATING.iter().enumerate().filter(|&(index, signal)| index < 2 || ignored >> (signal - 1) & 1 == 0);
    // without handlers, the worst case is a temporary file that stays after an interruption
    let Ok(mut signals) = Signals::new(handled.map(|(_, signal)| signal)) else { return Ok(()) };
    let wait = move || {
        if let Some(signal) = signals.forever().find(|&signal| !interrupt::is_deferred(signal)) {
            for path in unfinished().iter() {
                let _ = fs::remove_file(path);
            }
            // without destructors, which would close OpenGL while another thread renders
            signal_hook::low_level::exit(128 + signal);
        }
    };
    // without the thread, no signal would end the program
    let thread = std::thread::Builder::new().name("signals".into()).spawn(wait);
    thread.map(drop).context("the thread that waits for signals cannot be started").map_err(Failure::work)
}

/// Returns the ignored signals of this process, bit n − 1 for signal n; 0 if the system does not report them.
fn ignored_signals() -> u64 {
    let status = fs::read_to_string("/proc/self/status").unwrap_or_default();
    let mask = status.lines().find_map(|line| line.strip_prefix("SigIgn:"));
    mask.and_then(|mask| u64::from_str_radix(mask.trim(), 16).ok()).unwrap_or(0)
}

/// Output file that gets its name when it is complete. An incomplete file is removed.
#[derive(Debug)]
pub struct OutputFile {
    file: NamedTempFile,
    path: PathBuf,
}

impl OutputFile {
    /// Creates the temporary file, before the work. An existing path that is not a regular file is an error.
    pub fn begin(path: &Path) -> Result<Self, Failure> {
        Self::begin_apart(path, std::iter::empty::<&Path>())
    }

    /// Begins a file as [`begin`](Self::begin) does, unless it is one of the inputs.
    pub fn begin_apart<P: AsRef<Path>>(path: &Path, inputs: impl IntoIterator<Item = P>) -> Result<Self, Failure> {
        let target = path.canonicalize();
        if let Ok(target) = &target
            && inputs.into_iter().any(|input| input.as_ref().canonicalize().is_ok_and(|input| input == *target))
        {
            let message = anyhow!("{}: it is an input, expected another output file", path.display());
            return Err(Failure::Input(message));
        }
        if target.as_ref().is_ok_and(|target| !target.is_file()) {
            return Err(Failure::work(anyhow!("{}: it exists and is not a file", path.display())));
        }
        // the new file replaces the target of a link, not the link
        let path = target.as_deref().unwrap_or(path);
        let directory = match path.parent() {
            Some(parent) if !parent.as_os_str().is_empty() => parent,
            _ => Path::new("."),
        };
        let begin = || {
            fs::create_dir_all(directory)?;
            // without the name of the temporary file in the message
            temporary_file(directory).map_err(|error| without_path(&error))
        };
        let file = begin().with_context(|| path.display().to_string()).map_err(Failure::work)?;
        unfinished().push(file.path().to_path_buf());
        Ok(Self { file, path: path.to_path_buf() })
    }

    /// Returns a buffered writer of the file.
    pub fn into_writer(self) -> FileWriter {
        let file = BufWriter::new(self.file);
        FileWriter { file, path: self.path }
    }

    /// Returns the path of the finished file.
    pub fn target(&self) -> &Path {
        &self.path
    }

    /// Returns the path of the temporary file.
    pub fn path(&self) -> &Path {
        self.file.path()
    }

    /// Gives the finished file its name.
    pub fn keep(self) -> Result<(), Failure> {
        let Self { file, path } = self;
        let keep = || {
            let temporary = file.path().to_path_buf();
            let kept = file.persist(&path).map_err(|error| error.error).map(drop);
            unfinished().retain(|path| *path != temporary);
            kept
        };
        keep().with_context(|| path.display().to_string()).map_err(Failure::work)
    }

    /// Writes all bytes and gives the file its name.
    pub fn write(mut self, bytes: &[u8]) -> Result<(), Failure> {
        self.file.write_all(bytes).with_context(|| self.path.display().to_string()).map_err(Failure::work)?;
        self.keep()
    }
}

/// Creates a temporary file with the permissions of the umask, as other new files have.
fn temporary_file(directory: &Path) -> std::io::Result<NamedTempFile> {
    let mut builder = tempfile::Builder::new();
    #[cfg(unix)]
    {
        use std::os::unix::fs::PermissionsExt as _;
        builder.permissions(fs::Permissions::from_mode(0o666));
    }
    builder.tempfile_in(directory)
}

/// Returns the error of the system in an error of a temporary file, whose name says nothing to the user.
fn without_path(error: &std::io::Error) -> std::io::Error {
    let text = error.to_string();
    let reason = text.split(" at path ").next().unwrap_or(&text).to_string();
    std::io::Error::new(error.kind(), reason)
}

/// Buffered writer of an [`OutputFile`].
#[derive(Debug)]
pub struct FileWriter {
    file: BufWriter<NamedTempFile>,
    path: PathBuf,
}

impl FileWriter {
    /// Gives the finished file its name.
    pub fn keep(self) -> Result<(), Failure> {
        let Self { file, path } = self;
        let file = file
            .into_inner()
            .map_err(|error| error.into_error())
            .with_context(|| path.display().to_string())
            .map_err(Failure::work)?;
        OutputFile { file, path }.keep()
    }
}

/// Returns a write error with the path of the finished file in place of the temporary one.
fn of_target(path: &Path, error: &std::io::Error) -> std::io::Error {
    std::io::Error::new(error.kind(), format!("{}: {}", path.display(), error.kind()))
}

impl Write for FileWriter {
    fn write(&mut self, bytes: &[u8]) -> std::io::Result<usize> {
        let Self { file, path } = self;
        file.write(bytes).map_err(|error| of_target(path, &error))
    }

    fn flush(&mut self) -> std::io::Result<()> {
        let Self { file, path } = self;
        file.flush().map_err(|error| of_target(path, &error))
    }
}

/// Directory for output files, with a lock against other runs.
#[derive(Debug)]
pub struct OutputDir(PathBuf);

impl OutputDir {
    /// Creates the directory if it is missing, locks it, and checks that it is writable.
    pub fn create(path: &Path) -> Result<Self, Failure> {
        if path.exists() && !path.is_dir() {
            return Err(Failure::work(anyhow!("{}: it exists and is not a directory", path.display())));
        }
        fs::create_dir_all(path).with_context(|| path.display().to_string()).map_err(Failure::work)?;
        lock(path)?;
        let probe = NamedTempFile::new_in(path).map(drop).map_err(|error| without_path(&error));
        probe.with_context(|| path.display().to_string()).map_err(Failure::work)?;
        Ok(Self(path.to_path_buf()))
    }

    /// Returns the path of the directory.
    pub fn path(&self) -> &Path {
        &self.0
    }

    /// Removes files of an earlier run.
    pub fn remove(&self, names: &[&str]) -> Result<(), Failure> {
        for path in names.iter().map(|name| self.0.join(name)).filter(|path| path.is_file()) {
            fs::remove_file(&path).with_context(|| path.display().to_string()).map_err(Failure::work)?;
        }
        Ok(())
    }

    /// Creates a temporary file in the directory.
    pub fn begin(&self, name: &str) -> Result<OutputFile, Failure> {
        OutputFile::begin(&self.0.join(name))
    }

    /// Writes a complete file in the directory.
    pub fn write(&self, name: &str, bytes: &[u8]) -> Result<(), Failure> {
        self.begin(name)?.write(bytes)
    }
}

/// Locks a directory until the end of the program, so that two runs do not mix their files.
///
/// The lock is advisory and belongs to the directory (`flock`): it needs no lock file. A second lock of the same
/// directory by the same program succeeds.
fn lock(path: &Path) -> Result<(), Failure> {
    use std::os::unix::fs::MetadataExt as _;
    static LOCKED: Mutex<Vec<(u64, u64, File)>> = Mutex::new(Vec::new());
    let open = || {
        let directory = File::open(path)?;
        let metadata = directory.metadata()?;
        Ok::<_, std::io::Error>((metadata.dev(), metadata.ino(), directory))
    };
    let not_locked =
        |error: &std::io::Error| tracing::warn!("{}: the directory is not locked: {error}", path.display());
    let (device, inode, directory) = match open() {
        // a lock needs a readable directory, output files only a writable one
        Err(error) if error.kind() == std::io::ErrorKind::PermissionDenied => {
            not_locked(&error);
            return Ok(());
        }
        opened => opened.with_context(|| path.display().to_string()).map_err(Failure::work)?,
    };
    let mut locked = LOCKED.lock().unwrap_or_else(PoisonError::into_inner);
    if locked.iter().any(|&(d, i, _)| (d, i) == (device, inode)) {
        return Ok(());
    }
    match directory.try_lock() {
        Ok(()) => locked.push((device, inode, directory)),
        Err(TryLockError::WouldBlock) => {
            return Err(Failure::work(anyhow!(
                "{}: another run is writing to this directory, expected a directory per run",
                path.display()
            )));
        }
        // some network file systems have no locks
        Err(TryLockError::Error(error)) => not_locked(&error),
    }
    Ok(())
}
