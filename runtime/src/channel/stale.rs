//! What runs leave in shared memory of which nobody is alive, and its removal.

use std::fs::{self, File, OpenOptions};
use std::os::unix::fs::OpenOptionsExt;
use std::path::{Path, PathBuf};

use super::ChannelError;
use super::space::{SHARED_MEMORY, base, only_owner, prefix};

/// Removes what runs of this user left behind of which nobody is alive; gives the number of such runs.
///
/// # Errors
///
/// As [`Space::create`](super::Space::create).
pub fn clean_stale() -> Result<usize, ChannelError> {
    let shared_memory = Path::new(SHARED_MEMORY);
    let base = base(shared_memory)?;
    let guard = Guard::take(&base)?;
    Ok(guard.clean(&base, shared_memory))
}

/// The directories of this user's runs of which somebody is alive, sorted. Nothing is removed and nobody is held up: the
/// locks are looked at under the guard, so that no run is being made meanwhile.
///
/// # Errors
///
/// As [`Space::create`](super::Space::create).
pub(crate) fn live_directories() -> Result<Vec<PathBuf>, ChannelError> {
    let base = base(Path::new(SHARED_MEMORY))?;
    let _guard = Guard::take(&base)?;
    let entries = fs::read_dir(&base).into_iter().flatten().flatten().map(|entry| entry.path());
    let mut locks: Vec<PathBuf> =
        entries.filter(|path| path.extension().is_some_and(|e| e == "lock")).collect();
    locks.sort();
    // A lock that can be had belongs to nobody.
    locks.retain(|lock| File::open(lock).is_ok_and(|file| file.try_lock().is_err()));
    Ok(locks.into_iter().map(|lock| lock.with_extension("")).filter(|run| run.is_dir()).collect())
}

/// How many runs of this user lie below `shared_memory` whose owner is dead. Nothing is removed.
pub(crate) fn stale_runs(shared_memory: &Path) -> usize {
    // SAFETY: geteuid takes no arguments, cannot fail and touches no memory of ours.
    let user = unsafe { libc::geteuid() };
    let entries =
        fs::read_dir(shared_memory.join(format!("parallax-{user}"))).into_iter().flatten().flatten();
    let locks =
        entries.map(|entry| entry.path()).filter(|path| path.extension().is_some_and(|e| e == "lock"));
    locks.filter(|lock| File::open(lock).is_ok_and(|file| file.try_lock().is_ok())).count()
}

/// The lock under which runs are created and stale ones removed, so that the two never overlap.
pub(super) struct Guard(#[expect(dead_code, reason = "held for its lock")] File);

impl Guard {
    pub(super) fn take(base: &Path) -> Result<Self, ChannelError> {
        let path = base.join("guard");
        let io = |source| ChannelError::Io { what: "cannot lock", path: path.clone(), source };
        let file = OpenOptions::new()
            .write(true)
            .create(true)
            .truncate(false)
            .mode(0o600)
            .open(&path)
            .map_err(io)?;
        only_owner(&file, 0o600).map_err(io)?;
        file.lock().map_err(io)?;
        Ok(Self(file))
    }

    /// Removes dead runs. What cannot be removed is left for the next time: it does not hinder this run.
    pub(super) fn clean(&self, base: &Path, shared_memory: &Path) -> usize {
        let mut removed = 0;
        let Ok(entries) = fs::read_dir(base) else { return 0 };
        let mut paths: Vec<PathBuf> = entries.flatten().map(|entry| entry.path()).collect();
        paths.sort();
        let (locks, others): (Vec<_>, Vec<_>) =
            paths.into_iter().partition(|path| path.extension().is_some_and(|e| e == "lock"));
        for lock in &locks {
            let Ok(file) = File::open(lock) else { continue };
            if file.try_lock().is_ok() {
                remove_run(&lock.with_extension(""), shared_memory);
                removed += 1;
            }
        }
        // A run's lock is made before its directory. A directory without one was put back by a node that outlived the
        // removal of its run.
        for directory in others.iter().filter(|path| path.is_dir() && !path.with_extension("lock").exists()) {
            remove_run(directory, shared_memory);
            removed += 1;
        }
        removed
    }
}

/// Removes a run's directory, its shared-memory files and its lock, in this order: the lock goes last, so
/// that an interrupted removal is found and finished by the next run.
pub(super) fn remove_run(path: &Path, shared_memory: &Path) {
    let _ = fs::remove_dir_all(path);
    if let (Some(name), Ok(entries)) =
        (path.file_name().and_then(|n| n.to_str()), fs::read_dir(shared_memory))
    {
        let prefix = prefix(name);
        for entry in entries.flatten() {
            if entry.file_name().to_str().is_some_and(|n| n.starts_with(&prefix)) {
                let _ = fs::remove_file(entry.path());
            }
        }
    }
    let mut lock = path.as_os_str().to_owned();
    lock.push(".lock");
    let _ = fs::remove_file(lock);
}
