//! Crash-safe files of lines: every appended line stays in the file if the program ends in any manner.
//!
//! The crate stores lines into the pages of a mapped file. `store.c` turns the signal for a truncated file into a
//! return value.
#![allow(unsafe_code)]

use std::ffi::{c_char, c_int};
use std::fs::{self, File, OpenOptions};
use std::io;
use std::os::unix::fs::FileExt as _;
use std::path::Path;
use std::sync::OnceLock;

use memmap2::{MmapMut, MmapOptions};

unsafe extern "C" {
    /// Stores a line into the pages of a mapped file, its first byte last. Returns 1 if the file was truncated
    /// before the end of the line. Requires `append_file_catch_bus_errors`.
    fn append_file_store(target: *mut c_char, line: *const c_char, length: usize) -> c_int;

    /// Installs the process-wide SIGBUS handler; call it once. Returns non-zero if that fails.
    fn append_file_catch_bus_errors() -> c_int;
}

/// File of lines that keeps every appended line, also if the program is killed.
///
/// Lines are stored into the file's pages, which belong to the operating system. Appending a line therefore takes
/// no system call, which makes it ten times faster than a `write`. Until the file is dropped, empty lines follow
/// the last line; the drop truncates them.
///
/// If another program truncates the file, then later lines, and up to 4 KiB of lines before the truncation, are
/// appended to the remaining content. The system reports a store beyond the end of a mapped file with the signal
/// SIGBUS. The first `AppendFile` of the process installs a SIGBUS handler, which forwards signals from other
/// causes to the previous handler.
///
/// ```
/// use append_file::AppendFile;
///
/// # let directory = std::env::temp_dir();
/// let path = directory.join(format!("append_{}.csv", std::process::id()));
/// let mut file = AppendFile::create(&path)?;
/// file.append(b"t,x\n")?;
/// file.append(b"0.0,1.5\n")?;
/// assert!(std::fs::read_to_string(&path)?.starts_with("t,x\n0.0,1.5\n\n"));
/// drop(file);
/// assert_eq!(std::fs::read_to_string(&path)?, "t,x\n0.0,1.5\n");
/// # std::fs::remove_file(&path)?;
/// # Ok::<(), std::io::Error>(())
/// ```
#[derive(Debug)]
pub struct AppendFile {
    file: File,
    /// Pages that lines are stored into; `None` if the file system does not support mappings.
    window: Option<MmapMut>,
    /// Offset of the window in the file, bytes.
    start: u64,
    /// Offset of the next line in the file, bytes.
    end: u64,
    /// Length of the file including the empty lines, bytes.
    length: u64,
    /// Lines appended since the last check of the file's length.
    recent: Vec<u8>,
}

/// Block of empty lines that a growing file is extended by.
static EMPTY: [u8; AppendFile::GROWTH as usize] = [b'\n'; AppendFile::GROWTH as usize];

impl AppendFile {
    /// Growth increment of the file, bytes.
    const GROWTH: u64 = 1 << 16;
    /// Number of appended bytes after which the file's length is checked again.
    const UNCHECKED: usize = 1 << 12;

    /// Creates a file and replaces an existing regular file (also behind a symbolic link). The replaced file is
    /// unlinked and not modified, because another program may still write to it.
    ///
    /// # Errors
    /// The operating system's errors; [`InvalidInput`](io::ErrorKind::InvalidInput) if the path exists and is not a
    /// regular file.
    pub fn create(path: impl AsRef<Path>) -> io::Result<Self> {
        let path = path.as_ref();
        let refused = |what| Err(io::Error::new(io::ErrorKind::InvalidInput, what));
        // the file behind a link is replaced, not the link
        let target = match path.canonicalize() {
            Ok(target) => target,
            Err(error) if error.kind() != io::ErrorKind::NotFound => return Err(error),
            Err(_) if path.is_symlink() => return refused("it is a link to a file that does not exist"),
            Err(_) => return Self::create_new(path),
        };
        if !fs::metadata(&target)?.is_file() {
            return refused("it exists and is not a regular file");
        }
        match fs::remove_file(&target) {
            Err(error) if error.kind() != io::ErrorKind::NotFound => Err(error),
            _ => Self::create_new(target),
        }
    }

    /// Creates a file at a path that does not exist.
    ///
    /// # Errors
    /// [`AlreadyExists`](io::ErrorKind::AlreadyExists) if the path exists; otherwise the operating system's errors.
    pub fn create_new(path: impl AsRef<Path>) -> io::Result<Self> {
        let file = OpenOptions::new().read(true).write(true).create_new(true).open(path)?;
        let mut file = Self { file, window: None, start: 0, end: 0, length: 0, recent: Vec::new() };
        file.grow()?;
        Ok(file)
    }

    /// Appends a line, including its line end. If the program is killed during the call, an empty line precedes the
    /// incomplete line.
    ///
    /// # Errors
    /// The operating system's errors, for example a full disk. The file then contains no part of the line.
    pub fn append(&mut self, line: &[u8]) -> io::Result<()> {
        let has_room = |file: &Self| file.room().is_none_or(|room| room >= line.len());
        if self.window.is_none() || self.recent.len() + line.len() > Self::UNCHECKED || !has_room(self) {
            self.check()?;
        }
        while !has_room(self) {
            self.grow()?;
        }
        if self.store(line)? {
            return Ok(());
        }
        // the file was truncated below these pages
        if !self.check()? {
            return Err(io::Error::other("the system cannot write its pages"));
        }
        self.append(line)
    }

    /// Stores a line into the window; returns `false` if the file was truncated before the end of the line.
    fn store(&mut self, line: &[u8]) -> io::Result<bool> {
        let Some(window) = &mut self.window else {
            self.write(line)?;
            return Ok(true);
        };
        let cells = &mut window[(self.end - self.start) as usize..][..line.len()];
        // The first byte is stored last: until then the line starts as an empty line, which marks lines that a
        // killed program did not complete.
        // SAFETY: `cells` and `line` have the same length, and `cells` is borrowed mutably; the signal handler was
        // installed before the window was mapped.
        let status = unsafe { append_file_store(cells.as_mut_ptr().cast(), line.as_ptr().cast(), line.len()) };
        if status != 0 {
            return Ok(false);
        }
        self.end += line.len() as u64;
        self.recent.extend_from_slice(line);
        Ok(true)
    }

    /// Writes a line with a system call, for file systems without mappings.
    fn write(&mut self, line: &[u8]) -> io::Result<()> {
        let written = self.file.write_all_at(line, self.end);
        match &written {
            Ok(()) => self.end += line.len() as u64,
            // removes a partly written line; if that fails, the next line overwrites it
            Err(_) => drop(self.file.set_len(self.end)),
        }
        self.length = self.end;
        written
    }

    /// Returns the number of free bytes in the window; `None` without a window.
    fn room(&self) -> Option<usize> {
        self.window.as_ref().map(|window| window.len() - (self.end - self.start) as usize)
    }

    /// Checks the length of the file. If the file was truncated, appends the lines since the last check to the
    /// remaining content. Returns true if the file was truncated.
    fn check(&mut self) -> io::Result<bool> {
        let length = self.file.metadata()?.len();
        if length >= self.length {
            self.recent.clear();
            return Ok(false);
        }
        let mut recent = std::mem::take(&mut self.recent);
        let seen = self.end - recent.len() as u64;
        (self.window, self.end) = (None, length.min(seen));
        self.length = self.end;
        self.file.set_len(self.end)?;
        let mut last = [b'\n'];
        if self.end > 0 {
            self.file.read_exact_at(&mut last, self.end - 1)?;
        }
        if last != [b'\n'] {
            // the truncation cut through a line
            recent.insert(0, b'\n');
        }
        self.grow()?;
        if !recent.is_empty() {
            self.append(&recent)?;
        }
        Ok(true)
    }

    /// Extends the file by empty lines and maps the new pages.
    fn grow(&mut self) -> io::Result<()> {
        // written, not only reserved: a full disk is an error here instead of a later signal (except on
        // copy-on-write file systems)
        if let Err(error) = self.file.write_all_at(&EMPTY, self.length) {
            let _ = self.file.set_len(self.length);
            return Err(error);
        }
        self.length += Self::GROWTH;
        self.start = self.end;
        let mut options = MmapOptions::new();
        options.offset(self.start).len((self.length - self.start) as usize);
        // SAFETY: the range lies within the file, which this value created and keeps open for writing. Only `store`
        // writes the bytes, and it survives a truncated file.
        self.window = catches_bus_errors().then(|| unsafe { options.map_mut(&self.file) }.ok()).flatten();
        if self.window.is_none() {
            // without mappings, every line takes a system call
            self.file.set_len(self.end)?;
            self.length = self.end;
        }
        Ok(())
    }
}

/// Returns true if the SIGBUS handler is installed; the first call installs it.
fn catches_bus_errors() -> bool {
    static INSTALLED: OnceLock<bool> = OnceLock::new();
    // SAFETY: called once in the process.
    *INSTALLED.get_or_init(|| unsafe { append_file_catch_bus_errors() } == 0)
}

impl Drop for AppendFile {
    fn drop(&mut self) {
        // if this fails, empty lines stay at the end of the file
        let _ = self.check();
        self.window = None;
        let _ = self.file.set_len(self.end);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn path(name: &str) -> std::path::PathBuf {
        std::env::temp_dir().join(format!("append_{name}_{}", std::process::id()))
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(40))]
        /// Includes lines that are longer than the growth increment.
        #[test]
        fn appended_lines_are_readable_at_once_and_the_file_ends_after_them(
            lengths in prop::collection::vec(1usize..30_000, 1..12),
            huge in 0usize..200_000,
        ) {
            let path = path("lengths");
            let mut file = AppendFile::create(&path).unwrap();
            let mut whole = Vec::new();
            for (index, length) in lengths.into_iter().chain([huge]).enumerate() {
                let mut line = vec![b'a' + index as u8; length];
                line.push(b'\n');
                file.append(&line).unwrap();
                whole.extend(line);
                let seen = std::fs::read(&path).unwrap();
                prop_assert!(seen[..whole.len()] == whole && seen[whole.len()..].iter().all(|&byte| byte == b'\n'));
            }
            drop(file);
            prop_assert!(std::fs::read(&path).unwrap() == whole);
            std::fs::remove_file(&path).unwrap();
        }
    }

    #[test]
    fn unwritable_paths_are_errors() {
        assert!(AppendFile::create("/no/such/directory/file.csv").is_err());
        assert!(AppendFile::create(std::env::temp_dir()).is_err());
    }

    /// Regression: the second file truncated the one that the first writer used, which killed the program.
    #[test]
    fn recreating_a_file_does_not_affect_an_open_writer() {
        let path = path("again");
        let mut first = AppendFile::create(&path).unwrap();
        first.append(b"first\n").unwrap();
        let mut second = AppendFile::create(&path).unwrap();
        assert_eq!(AppendFile::create_new(&path).unwrap_err().kind(), io::ErrorKind::AlreadyExists);
        (0..20_000).for_each(|_| second.append(b"second\n").unwrap());
        (0..20_000).for_each(|_| first.append(b"first\n").unwrap());
        drop(first);
        (0..20_000).for_each(|_| second.append(b"second\n").unwrap());
        drop(second);
        assert_eq!(std::fs::read(&path).unwrap(), b"second\n".repeat(40_000));
        std::fs::remove_file(&path).unwrap();
    }

    /// Regression: a store into a removed page killed the program, and a store into a partial page was dropped
    /// silently.
    #[test]
    fn lines_after_a_truncation_follow_the_remaining_content() {
        let line = |index: usize| format!("{index:06}\n").into_bytes();
        for (cut, mapped) in
            [(0, true), (700, true), (703, true), (8400, true), (69_999, true), (0, false), (703, false)]
        {
            let path = path("cut");
            let mut file = AppendFile::create(&path).unwrap();
            if !mapped {
                file.window = None;
                file.file.set_len(0).unwrap();
                file.length = 0;
            }
            (0..11_000).for_each(|index| file.append(&line(index)).unwrap());
            let whole = std::fs::read(&path).unwrap();
            OpenOptions::new().write(true).open(&path).unwrap().set_len(cut as u64).unwrap();
            (11_000..25_000).for_each(|index| file.append(&line(index)).unwrap());
            drop(file);
            let read = std::fs::read(&path).unwrap();
            assert_eq!(read[..cut], whole[..cut]);
            let rest = read[cut..].strip_prefix(b"\n").unwrap_or(&read[cut..]);
            let from: usize = std::str::from_utf8(&rest[..6]).unwrap().parse().unwrap();
            assert!(from <= 11_000 && 7 * (11_000 - from) <= AppendFile::UNCHECKED, "{cut}: goes on with {from}");
            assert_eq!(rest, (from..25_000).flat_map(line).collect::<Vec<_>>(), "{cut}");
            assert_eq!(read.get(cut.wrapping_sub(1)).is_some_and(|&byte| byte != b'\n'), read[cut] == b'\n', "{cut}");
            std::fs::remove_file(&path).unwrap();
        }
    }

    /// Regression: creating a file removed devices, pipes and links.
    #[test]
    fn only_regular_files_are_replaced_and_links_stay() {
        let directory = path("kinds");
        std::fs::create_dir(&directory).unwrap();
        let [pipe, link, file, nowhere] = ["pipe", "link", "file", "nowhere"].map(|name| directory.join(name));
        assert!(std::process::Command::new("mkfifo").arg(&pipe).status().unwrap().success());
        std::os::unix::fs::symlink("file", &link).unwrap();
        std::os::unix::fs::symlink("none", &nowhere).unwrap();
        for path in [pipe.as_path(), &nowhere, Path::new("/dev/null"), &directory] {
            let kind = path.symlink_metadata().unwrap().file_type();
            assert_eq!(AppendFile::create(path).unwrap_err().kind(), io::ErrorKind::InvalidInput, "{}", path.display());
            assert_eq!(path.symlink_metadata().unwrap().file_type(), kind);
        }
        std::fs::write(&file, "before").unwrap();
        AppendFile::create(&link).unwrap().append(b"after\n").unwrap();
        assert!(link.is_symlink());
        assert_eq!(std::fs::read(&file).unwrap(), b"after\n");
        std::fs::remove_dir_all(&directory).unwrap();
    }

    /// Limits files to 100 KiB in a child process. Regression: a truncated `write` left a partial line.
    #[test]
    fn a_line_that_does_not_fit_leaves_nothing_behind() {
        const CHILD: &str = "APPEND_FILE_TEST_LIMIT";
        if let Some(path) = std::env::var_os(CHILD) {
            for mapped in [true, false] {
                let mut file = AppendFile::create(&path).unwrap();
                if !mapped {
                    file.window = None;
                    file.file.set_len(0).unwrap();
                    file.length = 0;
                }
                let line = [&[b'x'; 999][..], b"\n"].concat();
                let lines = (0..1000).take_while(|_| file.append(&line).is_ok()).count();
                assert_eq!(lines, if mapped { 65 } else { 102 });
                assert!(file.append(&line).is_err());
                drop(file);
                assert_eq!(std::fs::read(&path).unwrap(), line.repeat(lines));
            }
            return;
        }
        let path = path("limit");
        let test = "tests::a_line_that_does_not_fit_leaves_nothing_behind";
        // the child's output goes through pipes, because the test's own output file may already exceed the limit
        let output = std::process::Command::new("bash")
            .args(["-c", "trap '' XFSZ; ulimit -f 100; exec \"$0\" --exact \"$1\""])
            .arg(std::env::current_exe().unwrap())
            .arg(test)
            .env(CHILD, &path)
            .output()
            .unwrap();
        std::fs::remove_file(&path).unwrap();
        assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stdout));
    }

    /// The previous handler receives faults that no store caused.
    #[test]
    fn unrelated_bus_errors_still_end_the_program() {
        const CHILD: &str = "APPEND_FILE_TEST_BUS";
        if let Some(path) = std::env::var_os(CHILD) {
            drop(AppendFile::create(&path).unwrap());
            let file = OpenOptions::new().read(true).write(true).open(&path).unwrap();
            file.set_len(4096).unwrap();
            // SAFETY: the test truncates the mapped file on purpose.
            let page = unsafe { MmapOptions::new().len(4096).map_mut(&file) }.unwrap();
            file.set_len(0).unwrap();
            std::hint::black_box(page.iter().map(|&byte| u32::from(byte)).sum::<u32>());
            return;
        }
        let path = path("bus");
        let status = std::process::Command::new(std::env::current_exe().unwrap())
            .args(["--exact", "tests::unrelated_bus_errors_still_end_the_program"])
            .env(CHILD, &path)
            .status()
            .unwrap();
        std::fs::remove_file(&path).unwrap();
        assert!(!status.success());
    }

    #[test]
    fn a_file_without_lines_is_empty() {
        let path = path("empty");
        drop(AppendFile::create(&path).unwrap());
        assert_eq!(std::fs::read(&path).unwrap(), b"");
        std::fs::remove_file(&path).unwrap();
    }
}
