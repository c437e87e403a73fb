//! Files that grow line by line and keep every line, whatever ends the program.
//!
//! A line is stored into the pages of a mapped file. `store.c` turns the signal of a file that was cut off meanwhile into a return
//! value.
#![allow(unsafe_code)]

use std::ffi::{c_char, c_int};
use std::fs::{self, File, OpenOptions};
use std::io;
use std::os::unix::fs::FileExt as _;
use std::path::Path;
use std::sync::OnceLock;

use memmap2::{MmapMut, MmapOptions};

unsafe extern "C" {
    /// Stores a line into the pages of a mapped file, its first byte last; 1 where the file no longer reaches so far. Needs
    /// `append_file_catch_bus_errors`.
    fn append_file_store(target: *mut c_char, line: *const c_char, length: usize) -> c_int;

    /// Installs the handler of SIGBUS, once in the process; returns whether that failed.
    fn append_file_catch_bus_errors() -> c_int;
}

/// A file of lines that a program may be killed over without losing any that it has appended.
///
/// Lines are stored into the file's pages, which belong to the operating system, so that appending one takes no system call
/// (a tenth of the time of one). What lies beyond the last line are empty lines, until the file is dropped: then it ends after its
/// last line.
///
/// Another program may make the file shorter meanwhile: lines that are appended after that, and up to 4 KiB of lines before it,
/// stand behind what is left. The system reports a store beyond the end of a mapped file by the signal SIGBUS. The
/// first file that is opened installs a handler for it, which passes on whatever is not its own to the handler that was there.
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
    /// The pages that are written to now; none where the file system has no mappings.
    window: Option<MmapMut>,
    /// Where they begin in the file.
    start: u64,
    /// Where the next line goes in the file.
    end: u64,
    /// Length of the file with the empty lines.
    length: u64,
    /// Lines that were appended since the file was last seen to be as long as it should be.
    recent: Vec<u8>,
}

/// What a file grows by.
static EMPTY: [u8; AppendFile::GROWTH as usize] = [b'\n'; AppendFile::GROWTH as usize];

impl AppendFile {
    /// Bytes by which the file grows.
    const GROWTH: u64 = 1 << 16;
    /// Bytes after which the file's length is looked at again.
    const UNCHECKED: usize = 1 << 12;

    /// Begins a file. A regular file that is there (behind a link too) loses its name and is otherwise left alone: somebody may be
    /// writing to it.
    ///
    /// # Errors
    /// The system's; [`InvalidInput`](io::ErrorKind::InvalidInput) for what is there and is no regular file.
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

    /// Begins a file where there is none.
    ///
    /// # Errors
    /// [`AlreadyExists`](io::ErrorKind::AlreadyExists) where there is one, else the system's.
    pub fn create_new(path: impl AsRef<Path>) -> io::Result<Self> {
        let file = OpenOptions::new().read(true).write(true).create_new(true).open(path)?;
        let mut file = Self { file, window: None, start: 0, end: 0, length: 0, recent: Vec::new() };
        file.grow()?;
        Ok(file)
    }

    /// Appends a line, with its end. If the program is killed while it does, an empty line stands before what there is of it.
    ///
    /// # Errors
    /// The system's, where there is no room for it, for example. Nothing of the line is in the file then.
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
        // the pages are gone
        if !self.check()? {
            return Err(io::Error::other("the system cannot write its pages"));
        }
        self.append(line)
    }

    /// Stores a line where there is room for it; `false` where the file has been cut off before that.
    fn store(&mut self, line: &[u8]) -> io::Result<bool> {
        let Some(window) = &mut self.window else {
            self.write(line)?;
            return Ok(true);
        };
        let cells = &mut window[(self.end - self.start) as usize..][..line.len()];
        // The first byte is stored last: until then it is an empty line that stands there, which is how a line is known that a
        // killed program has not finished.
        // SAFETY: as many bytes as are borrowed mutably here, and as there are in the line; the handler has been installed
        // before the window was made.
        let status = unsafe { append_file_store(cells.as_mut_ptr().cast(), line.as_ptr().cast(), line.len()) };
        if status != 0 {
            return Ok(false);
        }
        self.end += line.len() as u64;
        self.recent.extend_from_slice(line);
        Ok(true)
    }

    /// Writes a line with a system call, where there are no mappings.
    fn write(&mut self, line: &[u8]) -> io::Result<()> {
        let written = self.file.write_all_at(line, self.end);
        match &written {
            Ok(()) => self.end += line.len() as u64,
            // a part of it may be there; where it cannot be cut off, the next line is written over it
            Err(_) => drop(self.file.set_len(self.end)),
        }
        self.length = self.end;
        written
    }

    /// Bytes that are left in the window, if there is one.
    fn room(&self) -> Option<usize> {
        self.window.as_ref().map(|window| window.len() - (self.end - self.start) as usize)
    }

    /// Looks whether the file is as long as it should be. Where it has been cut off, it goes on behind what is left, with the lines
    /// that were appended since the last look. Returns whether it had been cut off.
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
            // somebody has cut through a line
            recent.insert(0, b'\n');
        }
        self.grow()?;
        if !recent.is_empty() {
            self.append(&recent)?;
        }
        Ok(true)
    }

    /// Makes room for more lines.
    fn grow(&mut self) -> io::Result<()> {
        // written, not only reserved: a full disk is an error here and not a signal later (except on file systems that copy what is
        // written to)
        if let Err(error) = self.file.write_all_at(&EMPTY, self.length) {
            let _ = self.file.set_len(self.length);
            return Err(error);
        }
        self.length += Self::GROWTH;
        self.start = self.end;
        let mut options = MmapOptions::new();
        options.offset(self.start).len((self.length - self.start) as usize);
        // SAFETY: the range lies within the file, which this value has made and has open for writing. Its bytes are only ever
        // written, by `store`, which survives a file that has become shorter.
        self.window = catches_bus_errors().then(|| unsafe { options.map_mut(&self.file) }.ok()).flatten();
        if self.window.is_none() {
            // line by line then, with a call for each
            self.file.set_len(self.end)?;
            self.length = self.end;
        }
        Ok(())
    }
}

/// Returns whether the handler for stores beyond the end of a file is there; the first call installs it.
fn catches_bus_errors() -> bool {
    static INSTALLED: OnceLock<bool> = OnceLock::new();
    // SAFETY: once in the process.
    *INSTALLED.get_or_init(|| unsafe { append_file_catch_bus_errors() } == 0)
}

impl Drop for AppendFile {
    fn drop(&mut self) {
        // where it fails, empty lines stay at the end
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
        /// Whatever the lengths, also of lines that are longer than what the file grows by.
        #[test]
        fn lines_are_there_at_once_and_the_file_ends_after_them(lengths in prop::collection::vec(1usize..30_000, 1..12), huge in 0usize..200_000) {
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
    fn a_place_that_cannot_be_written_is_an_error() {
        assert!(AppendFile::create("/no/such/directory/file.csv").is_err());
        assert!(AppendFile::create(std::env::temp_dir()).is_err());
    }

    /// It cut the file that the first one was writing to, which ended the program.
    #[test]
    fn a_file_begun_again_is_another_one() {
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

    /// The pages were gone, which ended the program; a store into what is left of a page was silently lost.
    #[test]
    fn a_file_that_is_cut_off_goes_on_behind_what_is_left() {
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

    /// It removed devices, pipes and links, and wrote to a file of the same name.
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

    /// Files are limited to 100 KiB in a child process: a part of a line stayed where a `write` for each was cut short.
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
        // its output goes through pipes: a file that the tests write to may be beyond the limit already
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

    /// A fault that no store has caused goes where it went before.
    #[test]
    fn other_bus_errors_still_end_the_program() {
        const CHILD: &str = "APPEND_FILE_TEST_BUS";
        if let Some(path) = std::env::var_os(CHILD) {
            drop(AppendFile::create(&path).unwrap());
            let file = OpenOptions::new().read(true).write(true).open(&path).unwrap();
            file.set_len(4096).unwrap();
            // SAFETY: the file is cut off below, which is what this is about.
            let page = unsafe { MmapOptions::new().len(4096).map_mut(&file) }.unwrap();
            file.set_len(0).unwrap();
            std::hint::black_box(page.iter().map(|&byte| u32::from(byte)).sum::<u32>());
            return;
        }
        let path = path("bus");
        let status = std::process::Command::new(std::env::current_exe().unwrap())
            .args(["--exact", "tests::other_bus_errors_still_end_the_program"])
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
