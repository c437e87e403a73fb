use std::ffi::CString;
use std::ptr;

use crate::error::Error;

/// In-memory files that a scene refers to.
///
/// ```
/// use mujoco_rs::{Assets, Model};
///
/// let corner = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n";
/// let model = Model::from_xml_with_assets(
///     "<mujoco><asset><mesh name='corner' file='corner.obj'/></asset>
///     <worldbody><geom type='mesh' mesh='corner'/></worldbody></mujoco>",
///     &Assets::new().with("corner.obj", corner),
/// )?;
/// assert_eq!(model.nmesh(), 1);
/// # Ok::<(), mujoco_rs::Error>(())
/// ```
#[derive(Debug, Clone, Default)]
pub struct Assets {
    files: Vec<(String, Vec<u8>)>,
}

impl Assets {
    /// Creates an empty set of files.
    pub fn new() -> Self {
        Self::default()
    }

    /// Adds a file under the name in the scene (without directories).
    #[must_use]
    pub fn with(mut self, name: impl Into<String>, bytes: impl Into<Vec<u8>>) -> Self {
        self.insert(name, bytes);
        self
    }

    /// Adds a file under the name in the scene (without directories).
    pub fn insert(&mut self, name: impl Into<String>, bytes: impl Into<Vec<u8>>) {
        self.files.push((name.into(), bytes.into()));
    }

    /// Returns the number of files.
    pub fn len(&self) -> usize {
        self.files.len()
    }

    /// Returns true if there are no files.
    pub fn is_empty(&self) -> bool {
        self.files.is_empty()
    }

    pub(crate) fn iter(&self) -> impl Iterator<Item = (&str, &[u8])> {
        self.files.iter().map(|(name, bytes)| (name.as_str(), bytes.as_slice()))
    }
}

/// MuJoCo's virtual file system: fixed slots for file names and pointers to copies of their content.
pub(super) struct FileSystem(pub(super) Box<mujoco_sys::mjVFS>);

impl FileSystem {
    pub(super) fn new() -> Self {
        let mut vfs: Box<std::mem::MaybeUninit<mujoco_sys::mjVFS>> = Box::new_zeroed();
        // SAFETY: all zeros is a valid value of this structure of integers and pointers; the call makes it an empty
        // file system.
        unsafe {
            mujoco_sys::mj_defaultVFS(vfs.as_mut_ptr());
            Self(vfs.assume_init())
        }
    }

    /// Number of files in addition to the scene's text; MuJoCo leaves one slot empty.
    pub(super) const ROOM: usize = mujoco_sys::mjMAXVFS as usize - 2;

    pub(super) fn full(name: &str) -> Error {
        Error::Asset { name: name.to_string(), reason: format!("more than {} files", Self::ROOM) }
    }

    pub(super) fn repeated(name: &str) -> Error {
        Error::Asset {
            name: name.to_string(),
            reason: "a file of this name already exists (names are case-insensitive)".into(),
        }
    }

    pub(super) fn check_name(name: &str) -> Result<(), Error> {
        let refuse = |reason: String| Error::Asset { name: name.to_string(), reason };
        let longest = mujoco_sys::mjMAXVFSNAME as usize - 1;
        if name.is_empty() || name.len() > longest {
            return Err(refuse(format!("the name has {} bytes, expected 1 to {longest}", name.len())));
        }
        if name.contains(['/', '\\']) {
            return Err(refuse("the name contains a directory, expected a bare file name".into()));
        }
        Ok(())
    }

    pub(super) fn add(&mut self, name: &str, bytes: &[u8]) -> Result<(), Error> {
        Self::check_name(name)?;
        let refuse = |reason: String| Error::Asset { name: name.to_string(), reason };
        let c_name = CString::new(name).map_err(|_| Error::Nul { what: "asset name" })?;
        let Ok(size) = i32::try_from(bytes.len()) else {
            return Err(refuse(format!("{} bytes, expected less than 2 GiB", bytes.len())));
        };
        if size == 0 {
            return Err(refuse("the file is empty".into()));
        }
        // SAFETY: a valid VFS and a terminated name; the call allocates `size` bytes in the slot it fills.
        let status = unsafe { mujoco_sys::mj_makeEmptyFileVFS(&mut *self.0, c_name.as_ptr(), size) };
        match status {
            0 => {}
            1 => return Err(Self::full(name)),
            2 => return Err(Self::repeated(name)),
            other => return Err(refuse(format!("MuJoCo's file system answered {other}"))),
        }
        // SAFETY: as above.
        let slot = unsafe { mujoco_sys::mj_findFileVFS(&*self.0, c_name.as_ptr()) };
        let target = usize::try_from(slot).ok().and_then(|slot| self.0.filedata.get(slot)).copied();
        match target {
            Some(target) if !target.is_null() => {
                // SAFETY: the slot has `size` bytes allocated by MuJoCo, which do not overlap `bytes`.
                unsafe { ptr::copy_nonoverlapping(bytes.as_ptr(), target.cast::<u8>(), bytes.len()) };
                Ok(())
            }
            _ => Err(refuse("MuJoCo's file system does not contain the file after adding it".into())),
        }
    }
}

impl Drop for FileSystem {
    fn drop(&mut self) {
        // SAFETY: frees the copies that `add` made, once.
        unsafe { mujoco_sys::mj_deleteVFS(&mut *self.0) };
    }
}
