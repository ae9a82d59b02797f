//! A page of memory that processes share, and the kernel's way to sleep until a word in it changes.

use std::fs::{File, OpenOptions};
use std::io;
use std::os::fd::AsRawFd;
use std::os::unix::fs::OpenOptionsExt;
use std::path::Path;
use std::ptr::NonNull;
use std::sync::atomic::{AtomicU32, AtomicU64};

use super::space::only_owner;
use crate::time::{Nanos, SECOND};

/// Bytes of a page.
const PAGE: usize = 4096;
/// Cells of 64 bits in a page.
const CELLS: usize = PAGE / 8;

/// One page, mapped from a file. Its cells are atomic, and any bit pattern is valid in them.
#[derive(Debug)]
pub(crate) struct SharedPage {
    start: NonNull<AtomicU64>,
}

// SAFETY: the page is reached through atomics only, from wherever, and stays mapped until the drop.
unsafe impl Send for SharedPage {}
// SAFETY: as above.
unsafe impl Sync for SharedPage {}

impl SharedPage {
    /// The page in this file, which is made where there is none; readable by this user alone.
    pub(crate) fn create(path: &Path) -> io::Result<Self> {
        let file = OpenOptions::new()
            .read(true)
            .write(true)
            .create(true)
            .truncate(false)
            .mode(0o600)
            .custom_flags(libc::O_NOFOLLOW)
            .open(path)?;
        only_owner(&file, 0o600)?;
        if file.metadata()?.len() < PAGE as u64 {
            file.set_len(PAGE as u64)?;
        }
        Self::map(&file, libc::PROT_READ | libc::PROT_WRITE)
    }

    /// The page in this file, which another process made.
    pub(crate) fn open(path: &Path) -> io::Result<Self> {
        let file = OpenOptions::new().read(true).write(true).custom_flags(libc::O_NOFOLLOW).open(path)?;
        if file.metadata()?.len() < PAGE as u64 {
            // Touching what a file does not hold would end this process with a bus error.
            return Err(io::ErrorKind::UnexpectedEof.into());
        }
        Self::map(&file, libc::PROT_READ | libc::PROT_WRITE)
    }

    /// The page in this file, to be looked at and not to be written to: a store through this mapping would end the
    /// process.
    pub(crate) fn look_at(path: &Path) -> io::Result<Self> {
        let file = OpenOptions::new().read(true).custom_flags(libc::O_NOFOLLOW).open(path)?;
        if file.metadata()?.len() < PAGE as u64 {
            return Err(io::ErrorKind::UnexpectedEof.into());
        }
        Self::map(&file, libc::PROT_READ)
    }

    fn map(file: &File, access: libc::c_int) -> io::Result<Self> {
        // SAFETY: a new mapping at a place that the kernel chooses; the descriptor is open and the file a page long.
        let start = unsafe {
            libc::mmap(
                std::ptr::null_mut(),
                PAGE,
                access,
                // Already present when it is first touched: no page fault in the middle of a step.
                libc::MAP_SHARED | libc::MAP_POPULATE,
                file.as_raw_fd(),
                0,
            )
        };
        if start == libc::MAP_FAILED {
            return Err(io::Error::last_os_error());
        }
        NonNull::new(start.cast())
            .map(|start| Self { start })
            .ok_or_else(|| io::ErrorKind::OutOfMemory.into())
    }

    /// A cell of 64 bits.
    ///
    /// # Panics
    ///
    /// Beyond the page.
    pub(crate) fn cell(&self, index: usize) -> &AtomicU64 {
        assert!(index < CELLS, "cell {index} of a page of {CELLS}");
        // SAFETY: inside the mapped page, aligned to 8, alive as long as `self`, valid for any bits.
        unsafe { self.start.add(index).as_ref() }
    }

    /// All cells.
    #[cfg(feature = "link")]
    pub(crate) fn cells(&self) -> &[AtomicU64] {
        // SAFETY: so many aligned cells lie in the mapped page, alive as long as `self`, valid for any bits.
        unsafe { std::slice::from_raw_parts(self.start.as_ptr(), CELLS) }
    }

    /// The first half of a cell: what can be slept on.
    pub(crate) fn half(&self, index: usize) -> &AtomicU32 {
        let cell: *const AtomicU64 = self.cell(index);
        // SAFETY: 4 of the 8 bytes of a cell that lives as long as `self`; all users of this cell see it as 32 bits.
        unsafe { &*cell.cast::<AtomicU32>() }
    }
}

impl Drop for SharedPage {
    fn drop(&mut self) {
        // SAFETY: the mapping was made in `map` with this length, and no reference to it outlives `self`.
        unsafe { libc::munmap(self.start.as_ptr().cast(), PAGE) };
    }
}

/// Sleeps while `word` holds `expected`, until somebody [wakes](wake) it or the monotonic clock shows `until`. It may
/// also return early, without a reason.
pub(crate) fn wait(word: &AtomicU32, expected: u32, until: Nanos) {
    let until = libc::timespec { tv_sec: until / SECOND, tv_nsec: until % SECOND };
    // SAFETY: `word` is a mapped, aligned word, `until` a valid timespec; both outlive the call. An absolute time of the
    // monotonic clock is what this operation takes. Whatever it answers, the caller looks at the word again.
    unsafe {
        libc::syscall(
            libc::SYS_futex,
            word.as_ptr(),
            libc::FUTEX_WAIT_BITSET,
            expected,
            &raw const until,
            std::ptr::null::<u32>(),
            libc::FUTEX_BITSET_MATCH_ANY,
        )
    };
}

/// Wakes one sleeper on `word`.
pub(crate) fn wake(word: &AtomicU32) {
    // SAFETY: `word` is a mapped, aligned word; waking changes no memory and cannot fail for it.
    unsafe { libc::syscall(libc::SYS_futex, word.as_ptr(), libc::FUTEX_WAKE, 1) };
}
