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

/// Prints which files have been written, one per line.
pub fn print_written(paths: &[PathBuf]) -> Result<(), Failure> {
    let list: String = paths.iter().map(|path| format!("wrote {}\n", path.display())).collect();
    print(&list)
}

/// A number with so many decimals, and no sign where all digits are zero.
pub fn decimals(x: f64, count: usize) -> String {
    let text = format!("{x:.count$}");
    match text.strip_prefix('-') {
        Some(digits) if digits.bytes().all(|byte| matches!(byte, b'0' | b'.')) => digits.to_string(),
        _ => text,
    }
}

/// A table of labels and values.
pub fn table(rows: &[(&str, String)]) -> String {
    let width = rows.iter().map(|(label, _)| label.chars().count()).max().unwrap_or(0);
    rows.iter().map(|(label, value)| format!("{label:width$}  {value}\n")).collect()
}

/// Physics mode of a simulation, or its effects where the paper names no mode.
pub fn physics(simulation: &Simulation) -> String {
    simulation.physics().map_or_else(|| format!("effects {}", simulation.effects()), |mode| mode.to_string())
}

/// A bar on a terminal, nothing where standard error is piped.
pub fn progress(length: u64, what: &'static str) -> ProgressBar {
    progress_with(length, "{msg} {wide_bar} {pos}/{len} {per_sec} {eta}").with_message(what)
}

/// The same in a form of its own.
pub fn progress_with(length: u64, form: &str) -> ProgressBar {
    let style = ProgressStyle::with_template(form).unwrap_or_else(|_| ProgressStyle::default_bar());
    ProgressBar::new(length).with_style(style)
}

/// Files that have been begun, some of which may have been finished since.
fn unfinished() -> MutexGuard<'static, Vec<PathBuf>> {
    static UNFINISHED: Mutex<Vec<PathBuf>> = Mutex::new(Vec::new());
    UNFINISHED.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Signals that end a program which does not handle them. SIGINT and SIGTERM come first: these are handled even where the
/// program's parent ignores them.
const TERMINATING: [i32; 10] =
    [SIGINT, SIGTERM, SIGHUP, SIGQUIT, SIGUSR1, SIGUSR2, SIGALRM, SIGVTALRM, SIGPROF, SIGXCPU];

/// Removes unfinished files when a signal ends the program: the exit status is 128 plus the signal's number. A normal end
/// removes its own files.
///
/// A signal that the parent ignores, as `nohup` does with SIGHUP, stays ignored. A file that exceeds the size limit of
/// the shell (`ulimit -f`) is an error of the write, as a full disk is, and not a signal.
pub fn clean_up_when_interrupted() {
    // a handler that does nothing; without it the system ends the program
    let _ = signal_hook::flag::register(SIGXFSZ, std::sync::Arc::default());
    let ignored = ignored_signals();
    let handled =
        TERMINATING.iter().enumerate().filter(|&(index, signal)| index < 2 || ignored >> (signal - 1) & 1 == 0);
    // without a handler an interruption leaves a file behind, which is no reason not to work
    let Ok(mut signals) = Signals::new(handled.map(|(_, signal)| signal)) else { return };
    std::thread::spawn(move || {
        if let Some(signal) = signals.forever().find(|&signal| !interrupt::is_deferred(signal)) {
            for path in unfinished().iter() {
                let _ = fs::remove_file(path);
            }
            // at once: an orderly exit would take OpenGL down under a thread that draws
            signal_hook::low_level::exit(128 + signal);
        }
    });
}

/// Signals that are ignored, bit n − 1 for signal n, as the system reports them; none where it does not.
fn ignored_signals() -> u64 {
    let status = fs::read_to_string("/proc/self/status").unwrap_or_default();
    let mask = status.lines().find_map(|line| line.strip_prefix("SigIgn:"));
    mask.and_then(|mask| u64::from_str_radix(mask.trim(), 16).ok()).unwrap_or(0)
}

/// A file that appears under its name when it is finished, whole, or not at all.
#[derive(Debug)]
pub struct OutputFile {
    file: NamedTempFile,
    path: PathBuf,
}

impl OutputFile {
    /// Begins a file, before any work is done for it. What is there already and is no file is left alone.
    pub fn begin(path: &Path) -> Result<Self, Failure> {
        let target = path.canonicalize();
        if target.as_ref().is_ok_and(|target| !target.is_file()) {
            return Err(Failure::work(anyhow!("{}: it exists and is not a file", path.display())));
        }
        // behind a link it is the file that is replaced, not the link
        let path = target.as_deref().unwrap_or(path);
        let directory = match path.parent() {
            Some(parent) if !parent.as_os_str().is_empty() => parent,
            _ => Path::new("."),
        };
        let begin = || {
            fs::create_dir_all(directory)?;
            // the name of the temporary file in it is nobody's business
            temporary_file(directory).map_err(|error| std::io::Error::from(error.kind()))
        };
        let file = begin().with_context(|| path.display().to_string()).map_err(Failure::work)?;
        unfinished().push(file.path().to_path_buf());
        Ok(Self { file, path: path.to_path_buf() })
    }

    /// To be written through a buffer, piece by piece.
    pub fn into_writer(self) -> FileWriter {
        let file = BufWriter::new(self.file);
        FileWriter { file, path: self.path }
    }

    /// Where it is to be.
    pub fn target(&self) -> &Path {
        &self.path
    }

    /// Where it is while it is being written.
    pub fn path(&self) -> &Path {
        self.file.path()
    }

    /// Gives the finished file its name.
    pub fn keep(self) -> Result<(), Failure> {
        let Self { file, path } = self;
        let keep = || {
            let begun = file.path().to_path_buf();
            let kept = file.persist(&path).map_err(|error| error.error).map(drop);
            unfinished().retain(|path| *path != begun);
            kept
        };
        keep().with_context(|| path.display().to_string()).map_err(Failure::work)
    }

    /// Writes it whole.
    pub fn write(mut self, bytes: &[u8]) -> Result<(), Failure> {
        self.file.write_all(bytes).with_context(|| self.path.display().to_string()).map_err(Failure::work)?;
        self.keep()
    }
}

/// A temporary file with the permissions of any other new file: those that the umask leaves.
fn temporary_file(directory: &Path) -> std::io::Result<NamedTempFile> {
    let mut builder = tempfile::Builder::new();
    #[cfg(unix)]
    {
        use std::os::unix::fs::PermissionsExt as _;
        builder.permissions(fs::Permissions::from_mode(0o666));
    }
    builder.tempfile_in(directory)
}

/// An [`OutputFile`] that is being written.
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

/// An error about the file that is to be there, not about the temporary one.
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

/// A directory for output files, made where it is missing, to which no other run writes at the same time.
#[derive(Debug)]
pub struct OutputDir(PathBuf);

impl OutputDir {
    /// Makes the directory, locks it, and checks that it can be written to, before any work is done.
    pub fn create(path: &Path) -> Result<Self, Failure> {
        if path.exists() && !path.is_dir() {
            return Err(Failure::work(anyhow!("{}: it exists and is not a directory", path.display())));
        }
        fs::create_dir_all(path).with_context(|| path.display().to_string()).map_err(Failure::work)?;
        lock(path)?;
        let probe = NamedTempFile::new_in(path).map(drop).map_err(|error| std::io::Error::from(error.kind()));
        probe.with_context(|| path.display().to_string()).map_err(Failure::work)?;
        Ok(Self(path.to_path_buf()))
    }

    /// Where it is.
    pub fn path(&self) -> &Path {
        &self.0
    }

    /// Removes files that an earlier run has left there: they would describe another run.
    pub fn remove(&self, names: &[&str]) -> Result<(), Failure> {
        for path in names.iter().map(|name| self.0.join(name)).filter(|path| path.is_file()) {
            fs::remove_file(&path).with_context(|| path.display().to_string()).map_err(Failure::work)?;
        }
        Ok(())
    }

    /// Begins a file in it.
    pub fn begin(&self, name: &str) -> Result<OutputFile, Failure> {
        OutputFile::begin(&self.0.join(name))
    }

    /// Writes a whole file in it.
    pub fn write(&self, name: &str, bytes: &[u8]) -> Result<(), Failure> {
        self.begin(name)?.write(bytes)
    }
}

/// Locks a directory until the program ends: two runs that write to one directory would mix their files.
///
/// The lock is advisory and belongs to the directory itself (`flock`), so that it leaves no file behind, whatever ends the
/// program. A second lock of the same directory by the same program succeeds.
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
        // only what can be read can be locked, and files can be written to a directory that cannot be read
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
                "{}: another run is writing to this directory, expected one of its own for every run",
                path.display()
            )));
        }
        // some network file systems have no locks, which is no reason not to work
        Err(TryLockError::Error(error)) => not_locked(&error),
    }
    Ok(())
}
