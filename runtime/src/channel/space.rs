//! The place of one run in shared memory.

use std::fs::{self, DirBuilder, File, OpenOptions, TryLockError};
use std::io::{self, Read, Write};
use std::os::fd::AsRawFd;
use std::os::unix::fs::{DirBuilderExt, MetadataExt, OpenOptionsExt, PermissionsExt};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU32, Ordering};

use iceoryx2::config::Config;
use iceoryx2::prelude::SemanticString;

use super::stale::{Guard, remove_run};
use super::{ChannelError, Endpoint};

/// Where Linux keeps POSIX shared memory.
pub(super) const SHARED_MEMORY: &str = "/dev/shm";

/// One run's own corner of shared memory.
///
/// The process that creates a space owns it: dropping the space removes everything in it. Node processes
/// [`attach`](Space::attach) to it. All of them share a lock: whoever gets it alone knows that nobody of the run is alive,
/// and that what is left of it can be removed.
#[derive(Debug)]
pub struct Space {
    path: PathBuf,
    prefix: String,
    lock: File,
    owner: bool,
}

impl Space {
    /// Makes a space for this run, after removing what dead runs of this user left.
    ///
    /// # Errors
    ///
    /// [`ChannelError::NoSharedMemory`] and its like, when there is no usable shared memory.
    pub fn create() -> Result<Self, ChannelError> {
        Self::create_in(Path::new(SHARED_MEMORY))
    }

    /// As [`create`](Space::create), with another place to keep the run's directory.
    fn create_in(shared_memory: &Path) -> Result<Self, ChannelError> {
        let base = base(shared_memory)?;
        let guard = Guard::take(&base)?;
        guard.clean(&base, shared_memory);
        static NEXT: AtomicU32 = AtomicU32::new(0);
        // Another process of the same number may live in another container that shares this memory, so the
        // name that is free decides, not the process id alone.
        loop {
            let name = format!("{}-{}", std::process::id(), NEXT.fetch_add(1, Ordering::Relaxed));
            let lock_path = base.join(format!("{name}.lock"));
            let lock = match OpenOptions::new().write(true).create_new(true).mode(0o600).open(&lock_path) {
                Ok(lock) => lock,
                Err(e) if e.kind() == io::ErrorKind::AlreadyExists => continue,
                Err(source) => {
                    return Err(ChannelError::Io { what: "cannot create", path: lock_path, source });
                }
            };
            only_owner(&lock, 0o600).map_err(|source| ChannelError::Io {
                what: "cannot close to others",
                path: lock_path.clone(),
                source,
            })?;
            lock.try_lock_shared().map_err(|e| ChannelError::Io {
                what: "cannot lock",
                path: lock_path.clone(),
                source: match e {
                    TryLockError::Error(source) => source,
                    TryLockError::WouldBlock => io::ErrorKind::WouldBlock.into(),
                },
            })?;
            let path = base.join(&name);
            make_directory(&path)?;
            let prefix = prefix(&name);
            let space = Self { path, prefix, lock, owner: true };
            space.take_the_counter(shared_memory)?;
            return Ok(space);
        }
    }

    /// Makes the one segment of the transport that everybody on the machine may write to this user's alone: a count of its
    /// participants, which it makes with the first of them and only opens from then on.
    ///
    /// It gets a new file, so that whoever has opened the first one in the moment in which that was possible has nothing.
    fn take_the_counter(&self, shared_memory: &Path) -> Result<(), ChannelError> {
        drop(Endpoint::new(self)?);
        let io = |source| ChannelError::Io {
            what: "cannot close to others what lies in",
            path: shared_memory.into(),
            source,
        };
        for entry in fs::read_dir(shared_memory).map_err(io)?.flatten() {
            let name = entry.file_name();
            if !name.to_string_lossy().starts_with(&self.prefix)
                || entry.metadata().is_ok_and(|metadata| metadata.mode() & 0o077 == 0)
            {
                continue;
            }
            let mut closed = entry.path().into_os_string();
            closed.push(".closed");
            let contents = fs::read(entry.path()).map_err(io)?;
            let file = OpenOptions::new().write(true).create_new(true).mode(0o600).open(&closed);
            file.and_then(|mut file| {
                only_owner(&file, 0o600)?;
                file.write_all(&contents)
            })
            .and_then(|()| fs::rename(&closed, entry.path()))
            .map_err(io)?;
        }
        Ok(())
    }

    /// The space of a run that another process owns, at the path that the owner told.
    ///
    /// # Errors
    ///
    /// [`ChannelError::Io`] when there is no such directory.
    pub fn attach(path: &Path) -> Result<Self, ChannelError> {
        let missing =
            |source| ChannelError::Io { what: "cannot open the run directory", path: path.into(), source };
        fs::metadata(path).map_err(missing)?;
        let name = path
            .file_name()
            .and_then(|n| n.to_str())
            .ok_or_else(|| missing(io::ErrorKind::InvalidInput.into()))?;
        let lock = File::open(path.with_extension("lock")).map_err(missing)?;
        lock.lock_shared().map_err(missing)?;
        Ok(Self { path: path.into(), prefix: prefix(name), lock, owner: false })
    }

    /// Gives up this process's share of the space, before the end of its life.
    pub(crate) fn leave(&self) {
        // A lock that cannot be given up is given up when the process ends.
        let _ = self.lock.unlock();
    }

    /// The run's directory.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// How the names of this run's shared-memory files begin.
    pub fn prefix(&self) -> &str {
        &self.prefix
    }

    /// Writes a file into the run's directory, readable by this user alone.
    ///
    /// # Errors
    ///
    /// [`ChannelError::Io`].
    pub fn write(&self, name: &str, contents: &[u8]) -> Result<(), ChannelError> {
        let path = self.path.join(name);
        OpenOptions::new()
            .write(true)
            .create(true)
            .truncate(true)
            .mode(0o600)
            .open(&path)
            .and_then(|mut file| {
                only_owner(&file, 0o600)?;
                file.write_all(contents)
            })
            .map_err(|source| ChannelError::Io { what: "cannot write", path, source })
    }

    /// As [`write`](Self::write), in two steps: nobody ever reads half of it.
    ///
    /// # Errors
    ///
    /// [`ChannelError::Io`].
    pub(crate) fn replace(&self, name: &str, contents: &[u8]) -> Result<(), ChannelError> {
        let temporary = format!("{name}.new");
        self.write(&temporary, contents)?;
        let path = self.path.join(name);
        fs::rename(self.path.join(temporary), &path).map_err(|source| ChannelError::Io {
            what: "cannot write",
            path,
            source,
        })
    }

    /// Reads a file from the run's directory.
    ///
    /// # Errors
    ///
    /// [`ChannelError::Io`].
    pub fn read(&self, name: &str) -> Result<Vec<u8>, ChannelError> {
        let path = self.path.join(name);
        let mut contents = Vec::new();
        File::open(&path)
            .and_then(|mut file| file.read_to_end(&mut contents))
            .map_err(|source| ChannelError::Io { what: "cannot read", path, source })?;
        Ok(contents)
    }

    /// Says whether shared memory has room for `needed` bytes more.
    ///
    /// The file system would otherwise answer a full memory with a bus error in the middle of a step.
    ///
    /// # Errors
    ///
    /// [`ChannelError::Full`].
    pub fn reserve(&self, needed: u64) -> Result<(), ChannelError> {
        let free = free_bytes(&self.path)?;
        if free < needed {
            return Err(ChannelError::Full { path: SHARED_MEMORY.into(), needed, free });
        }
        Ok(())
    }

    /// Takes the memory of everything that this run has made so far. Files in shared memory are taken page by page, when a
    /// page is first written to; when there is none left then, the writer dies of a bus error in the middle of a step.
    ///
    /// # Errors
    ///
    /// [`ChannelError::Full`].
    pub(crate) fn commit(&self) -> Result<(), ChannelError> {
        self.close_to_others()?;
        let shared_memory = Path::new(SHARED_MEMORY);
        let io = |source| ChannelError::Io { what: "cannot look into", path: shared_memory.into(), source };
        for entry in fs::read_dir(shared_memory).map_err(io)?.flatten() {
            if !entry.file_name().to_string_lossy().starts_with(&self.prefix) {
                continue;
            }
            // One that is gone by now needs nothing.
            let Ok(file) = OpenOptions::new().read(true).write(true).open(entry.path()) else { continue };
            let length = file.metadata().map_err(io)?.len();
            if length == 0 {
                continue;
            }
            // SAFETY: the descriptor is open for writing; the call takes integers, and changes neither length nor contents.
            if unsafe { libc::fallocate(file.as_raw_fd(), 0, 0, length as libc::off_t) } != 0 {
                let error = io::Error::last_os_error();
                return match error.raw_os_error() {
                    Some(libc::ENOSPC) => {
                        let free = free_bytes(&self.path)?;
                        Err(ChannelError::Full { path: SHARED_MEMORY.into(), needed: length, free })
                    }
                    // A file system that cannot promise memory gives it when it is written to.
                    Some(libc::EOPNOTSUPP | libc::ENOSYS) => Ok(()),
                    _ => Err(io(error)),
                };
            }
        }
        Ok(())
    }

    /// Takes from everybody but this user what rights others have to anything in the run's directory: the transport makes
    /// directories that a group may read.
    ///
    /// # Errors
    ///
    /// [`ChannelError::Io`].
    pub(crate) fn close_to_others(&self) -> Result<(), ChannelError> {
        let mut folders = vec![self.path.clone()];
        while let Some(folder) = folders.pop() {
            let io =
                |source| ChannelError::Io { what: "cannot close to others", path: folder.clone(), source };
            for entry in fs::read_dir(&folder).map_err(io)?.flatten() {
                // What is gone by now needs nothing.
                let Ok(metadata) = entry.metadata() else { continue };
                let mode = metadata.mode() & 0o7777;
                if mode & 0o077 != 0 && !metadata.is_symlink() {
                    let closed = fs::Permissions::from_mode(mode & !0o077);
                    match fs::set_permissions(entry.path(), closed) {
                        Err(error) if error.kind() != io::ErrorKind::NotFound => return Err(io(error)),
                        _ => {}
                    }
                }
                if metadata.is_dir() {
                    folders.push(entry.path());
                }
            }
        }
        Ok(())
    }

    /// The configuration of iceoryx2 for this space.
    pub(crate) fn config(&self) -> Result<Config, ChannelError> {
        let bad = |detail: String| ChannelError::Transport {
            topic: self.path.display().to_string(),
            what: "name the run's directory",
            detail,
        };
        let mut config = Config::default();
        let root = iceoryx2::prelude::Path::new(self.path.join("i").as_os_str().as_encoded_bytes());
        config.global.set_root_path(&root.map_err(|e| bad(format!("{e:?}")))?);
        config.global.prefix =
            iceoryx2::prelude::FileName::new(self.prefix.as_bytes()).map_err(|e| bad(format!("{e:?}")))?;
        // The owner removes the whole directory at the end. Scanning for dead nodes at every opening would
        // only slow the start down, and could remove what a stopped node's neighbours still read.
        config.global.service.cleanup_dead_nodes_on_open = false;
        config.global.node.cleanup_dead_nodes_on_creation = false;
        config.global.node.cleanup_dead_nodes_on_destruction = false;
        Ok(config)
    }
}

impl Drop for Space {
    fn drop(&mut self) {
        if self.owner {
            remove_run(&self.path, Path::new(SHARED_MEMORY));
        }
    }
}

/// The directory of this user's runs; it is made when it does not exist.
pub(super) fn base(shared_memory: &Path) -> Result<PathBuf, ChannelError> {
    let none = |reason: String| ChannelError::NoSharedMemory { path: shared_memory.into(), reason };
    let metadata = fs::metadata(shared_memory).map_err(|e| none(e.to_string()))?;
    if !metadata.is_dir() {
        return Err(none("it is not a directory".into()));
    }
    // SAFETY: geteuid takes no arguments, cannot fail and touches no memory of ours.
    let user = unsafe { libc::geteuid() };
    let base = shared_memory.join(format!("parallax-{user}"));
    match DirBuilder::new().mode(0o700).create(&base) {
        // Whatever this process takes away from new files: the owner needs all of it.
        Ok(()) => {
            fs::set_permissions(&base, fs::Permissions::from_mode(0o700)).map_err(|e| none(e.to_string()))?
        }
        Err(e) if e.kind() == io::ErrorKind::AlreadyExists => {
            // Shared memory is open to everybody: a directory that another user put here could be watched.
            let ours = fs::symlink_metadata(&base)
                .is_ok_and(|m| m.is_dir() && m.uid() == user && m.mode() & 0o077 == 0);
            if !ours {
                return Err(ChannelError::ForeignDirectory { path: base });
            }
        }
        Err(e) => return Err(none(format!("cannot write there: {e}"))),
    }
    Ok(base)
}

fn make_directory(path: &Path) -> Result<(), ChannelError> {
    let made = DirBuilder::new().mode(0o700).create(path);
    made.and_then(|()| fs::set_permissions(path, fs::Permissions::from_mode(0o700)))
        .map_err(|source| ChannelError::Io { what: "cannot create", path: path.into(), source })
}

/// Gives a file that was just opened exactly this mode, whatever this process takes away from new files.
pub(crate) fn only_owner(file: &File, mode: u32) -> io::Result<()> {
    if file.metadata()?.mode() & 0o7777 == mode {
        return Ok(());
    }
    file.set_permissions(fs::Permissions::from_mode(mode))
}

/// How a run's shared-memory files begin: they lie side by side in one flat directory.
pub(super) fn prefix(name: &str) -> String {
    // SAFETY: geteuid takes no arguments, cannot fail and touches no memory of ours.
    format!("plx{}_{name}_", unsafe { libc::geteuid() })
}

/// Bytes that are free where `path` lies.
pub(crate) fn free_bytes(path: &Path) -> Result<u64, ChannelError> {
    use std::os::unix::ffi::OsStrExt;
    let io =
        |source| ChannelError::Io { what: "cannot ask for the free space of", path: path.into(), source };
    let name = std::ffi::CString::new(path.as_os_str().as_bytes()).map_err(|e| io(e.into()))?;
    // SAFETY: statvfs is plain integers, for which all zeros are a valid value.
    let mut answer: libc::statvfs = unsafe { std::mem::zeroed() };
    // SAFETY: `name` is a NUL-terminated string and `answer` a writable statvfs; both outlive the call.
    if unsafe { libc::statvfs(name.as_ptr(), &mut answer) } != 0 {
        return Err(io(io::Error::last_os_error()));
    }
    Ok(answer.f_bavail * answer.f_frsize)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::channel::clean_stale;

    #[test]
    fn missing_shared_memory_is_named_with_a_remedy() {
        let error = Space::create_in(Path::new("/nonexistent/shm")).expect_err("there is no such place");
        let text = error.to_string();
        assert!(text.contains("/nonexistent/shm") && text.contains("Mount"), "{text}");
        let file = tempfile::NamedTempFile::new().unwrap();
        let text = Space::create_in(file.path()).expect_err("a file is no memory").to_string();
        assert!(text.contains("not a directory"), "{text}");
    }

    #[test]
    fn full_shared_memory_is_said_before_the_run() {
        let space = Space::create().unwrap();
        let text = space.reserve(u64::MAX).expect_err("nobody has so much").to_string();
        assert!(text.contains("bytes free") && text.contains("enlarge"), "{text}");
        space.reserve(1).unwrap();
    }

    #[test]
    fn a_directory_open_to_others_is_refused() {
        let place = tempfile::tempdir().unwrap();
        // SAFETY: geteuid cannot fail.
        let user = unsafe { libc::geteuid() };
        let base = place.path().join(format!("parallax-{user}"));
        DirBuilder::new().mode(0o777).create(&base).unwrap();
        fs::set_permissions(&base, std::os::unix::fs::PermissionsExt::from_mode(0o777)).unwrap();
        assert!(matches!(Space::create_in(place.path()), Err(ChannelError::ForeignDirectory { .. })));
    }

    #[test]
    fn the_remains_of_a_dead_run_are_removed_and_a_live_one_is_kept() {
        let live = Space::create().unwrap();
        let base = live.path().parent().unwrap().to_owned();
        let (dead, name) = (base.join("1-dead"), prefix("1-dead"));
        fs::create_dir(&dead).unwrap();
        fs::write(dead.with_extension("lock"), "").unwrap();
        let segment = Path::new(SHARED_MEMORY).join(format!("{name}x.data"));
        fs::write(&segment, "").unwrap();
        // A node that outlived its run has put a directory back.
        let late = base.join("2-late");
        fs::create_dir_all(late.join("i/nodes")).unwrap();
        clean_stale().unwrap();
        assert!(!late.exists());
        assert!(!dead.exists() && !dead.with_extension("lock").exists() && !segment.exists());
        assert!(live.path().exists());
        let path = live.path().to_owned();
        drop(live);
        assert!(!path.exists());
    }
}
