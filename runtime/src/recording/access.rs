//! Who may read a recording, and write to it.

use std::fs::{File, Permissions, TryLockError};
use std::io;
use std::os::unix::fs::{MetadataExt, PermissionsExt, fchown};
use std::path::Path;

use serde::{Deserialize, Serialize};

use super::RecordingError;

/// Who may read a recording, and write to it. Files that are not files, such as a device or a pipe, are left as they are.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Access {
    /// Its owner alone: 0600.
    #[default]
    Owner,
    /// Its owner and the group of this number: 0660.
    Group(u32),
}

impl Access {
    /// The mode that a new file is made with: never more than it gets in the end.
    pub(crate) const NEW: u32 = 0o600;

    /// Gives a file this access, whatever it had.
    pub(crate) fn give(self, file: &File) -> io::Result<()> {
        let metadata = file.metadata()?;
        if !metadata.is_file() {
            return Ok(());
        }
        let mode = match self {
            Self::Owner => 0o600,
            Self::Group(group) => {
                if metadata.gid() != group {
                    fchown(file, None, Some(group))?;
                }
                0o660
            }
        };
        if metadata.mode() & 0o7777 == mode {
            return Ok(());
        }
        file.set_permissions(Permissions::from_mode(mode))
    }

    /// The group of this name, or of this number.
    ///
    /// # Errors
    ///
    /// When there is none.
    pub fn group(name: &str) -> io::Result<Self> {
        if let Ok(number) = name.parse() {
            return Ok(Self::Group(number));
        }
        let nothing = || io::Error::new(io::ErrorKind::NotFound, "there is no such group on this machine");
        let text = std::ffi::CString::new(name).map_err(|_| nothing())?;
        let mut buffer = vec![0 as libc::c_char; 1 << 16];
        // SAFETY: a group is plain pointers and integers, for which all zeros are a valid value.
        let mut entry: libc::group = unsafe { std::mem::zeroed() };
        let mut found = std::ptr::null_mut();
        // SAFETY: `text` is NUL-terminated; `entry`, `found` and `buffer`, whose length is given, are writable; all outlive
        // the call.
        let error = unsafe {
            libc::getgrnam_r(text.as_ptr(), &mut entry, buffer.as_mut_ptr(), buffer.len(), &mut found)
        };
        match (error, found.is_null()) {
            (0, false) => Ok(Self::Group(entry.gr_gid)),
            (0, true) => Err(nothing()),
            (error, _) => Err(io::Error::from_raw_os_error(error)),
        }
    }
}

/// Takes a file for its one writer, until it is closed: two would write over each other. What is no file is left as it is.
pub(crate) fn claim(file: &File, path: &Path) -> Result<(), RecordingError> {
    // A file system that knows no locks tells of no other writer.
    let taken = matches!(file.try_lock(), Err(TryLockError::WouldBlock));
    let is_file = || file.metadata().is_ok_and(|metadata| metadata.is_file());
    if taken && is_file() { Err(RecordingError::Busy { path: path.into() }) } else { Ok(()) }
}

/// The same, and empties it.
pub(super) fn claim_empty(file: &File, path: &Path) -> Result<(), RecordingError> {
    claim(file, path)?;
    let io = |source| RecordingError::Io { path: path.into(), what: "empty the file", source };
    if file.metadata().map_err(io)?.is_file() { file.set_len(0).map_err(io) } else { Ok(()) }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn groups_are_found_by_name_and_number() {
        assert_eq!(Access::group("root").unwrap(), Access::Group(0));
        assert_eq!(Access::group("77").unwrap(), Access::Group(77));
        assert_eq!(Access::group("no such group").unwrap_err().kind(), io::ErrorKind::NotFound);
    }

    #[test]
    fn what_is_no_file_is_left_alone() {
        let null = File::options().write(true).open("/dev/null").unwrap();
        let before = null.metadata().unwrap().mode();
        Access::Owner.give(&null).unwrap();
        assert_eq!(null.metadata().unwrap().mode(), before);
    }
}
