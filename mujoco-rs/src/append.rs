//! Files that grow line by line and keep every line through the end of the program, whatever end that is.

use std::fs::{File, OpenOptions};
use std::io::{self, Seek as _, SeekFrom, Write as _};
use std::path::Path;
use std::sync::atomic::{AtomicU8, Ordering};

use memmap2::{MmapMut, MmapOptions};

/// A file of lines that a program may be killed over without losing any that it has appended.
///
/// Lines are stored into the file's pages, which belong to the operating system, so that appending one takes no system call
/// (a tenth of the time of one). What lies beyond the last line are empty lines, until the file is dropped: then it ends after its
/// last line.
///
/// While it is open nobody else may make the file shorter: as with every mapped file, the system ends a program that
/// writes where its file no longer is.
///
/// ```
/// use mujoco_rs::AppendFile;
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
}

/// What a file grows by.
static EMPTY: [u8; AppendFile::GROWTH as usize] = [b'\n'; AppendFile::GROWTH as usize];

impl AppendFile {
    /// Bytes by which the file grows.
    const GROWTH: u64 = 1 << 16;

    /// Begins a file. One that is there loses its name and is otherwise left alone: somebody may be writing to it.
    ///
    /// # Errors
    /// The system's.
    pub fn create(path: impl AsRef<Path>) -> io::Result<Self> {
        match std::fs::remove_file(&path) {
            Err(error) if error.kind() != io::ErrorKind::NotFound => Err(error),
            _ => Self::create_new(path),
        }
    }

    /// Begins a file where there is none.
    ///
    /// # Errors
    /// [`AlreadyExists`](io::ErrorKind::AlreadyExists) where there is one, else the system's.
    pub fn create_new(path: impl AsRef<Path>) -> io::Result<Self> {
        let file = OpenOptions::new().read(true).write(true).create_new(true).open(path)?;
        let mut file = Self { file, window: None, start: 0, end: 0, length: 0 };
        file.grow()?;
        Ok(file)
    }

    /// Appends a line, with its end. If the program is killed while it does, an empty line stands before what there is of it.
    ///
    /// # Errors
    /// The system's, where there is no room for it, for example.
    pub fn append(&mut self, line: &[u8]) -> io::Result<()> {
        while self.room().is_some_and(|room| room < line.len()) {
            self.grow()?;
        }
        let Some(window) = &mut self.window else {
            self.file.write_all(line)?;
            self.end += line.len() as u64;
            return Ok(());
        };
        let Some((&first, rest)) = line.split_first() else { return Ok(()) };
        let cells = &mut window[(self.end - self.start) as usize..][..line.len()];
        // the first byte last: until then it is an empty line that stands there, which is how a line is known that a killed
        // program has not finished
        cells[1..].copy_from_slice(rest);
        // SAFETY: the byte is borrowed mutably here, so that nobody else in the program uses it in any way meanwhile.
        unsafe { AtomicU8::from_ptr(&mut cells[0]) }.store(first, Ordering::Release);
        self.end += line.len() as u64;
        Ok(())
    }

    /// Bytes that are left in the window, if there is one.
    fn room(&self) -> Option<usize> {
        self.window.as_ref().map(|window| window.len() - (self.end - self.start) as usize)
    }

    /// Makes room for more lines.
    fn grow(&mut self) -> io::Result<()> {
        // written, not only reserved: a full disk is an error here and not a signal later (but for file systems that copy what is
        // written to)
        self.file.seek(SeekFrom::Start(self.length))?;
        self.file.write_all(&EMPTY)?;
        self.length += Self::GROWTH;
        self.start = self.end;
        let mut options = MmapOptions::new();
        options.offset(self.start).len((self.length - self.start) as usize);
        // SAFETY: the range lies within the file, which this value has made and has open for writing. Its bytes are only ever
        // written here; that others must not cut it is said above.
        self.window = unsafe { options.map_mut(&self.file) }.ok();
        if self.window.is_none() {
            // line by line then, with a call for each
            self.file.set_len(self.end)?;
            self.length = self.end;
            self.file.seek(SeekFrom::Start(self.end))?;
        }
        Ok(())
    }
}

impl Drop for AppendFile {
    fn drop(&mut self) {
        self.window = None;
        // where it fails, empty lines stay at the end
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

    #[test]
    fn a_file_without_lines_is_empty() {
        let path = path("empty");
        drop(AppendFile::create(&path).unwrap());
        assert_eq!(std::fs::read(&path).unwrap(), b"");
        std::fs::remove_file(&path).unwrap();
    }
}
