//! Pages of shared memory, mapped before they are needed.
//!
//! Memory that a run has taken belongs to it, but a process reaches a page of it only after a fault that asks the kernel for
//! that page. Channels hand out one place after the other, so that without this nearly every message of the first seconds
//! would meet such a fault, on both of its sides, in the middle of a step.

use std::fs;
use std::io::{self, BufRead, BufReader};

use super::Space;

/// A range of this process's memory.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct Mapping {
    start: usize,
    length: usize,
    writable: bool,
}

impl Space {
    /// Maps every page of what this process has opened of the run so far. Where the system cannot (before Linux 5.14), or has no
    /// memory left, faults happen when pages are first touched.
    ///
    /// # Errors
    ///
    /// When this process cannot read what it has mapped.
    pub(crate) fn populate(&self) -> io::Result<()> {
        let maps = BufReader::new(fs::File::open("/proc/self/maps")?);
        for line in maps.split(b'\n') {
            let line = line?;
            let line = String::from_utf8_lossy(&line);
            let Some(mapping) = line.contains(self.prefix()).then(|| read(&line)).flatten() else { continue };
            let advice = if mapping.writable { libc::MADV_POPULATE_WRITE } else { libc::MADV_POPULATE_READ };
            // SAFETY: the advice changes no contents and unmaps nothing: it does what a first access to each page would do.
            // A range that another thread has unmapped meanwhile, or memory that there is not, is an error that costs nothing.
            unsafe { libc::madvise(mapping.start as *mut libc::c_void, mapping.length, advice) };
        }
        Ok(())
    }
}

/// A line of `/proc/self/maps`; `None` for one that cannot be read from.
fn read(line: &str) -> Option<Mapping> {
    let mut fields = line.split_ascii_whitespace();
    let (start, end) = fields.next()?.split_once('-')?;
    let access = fields.next()?;
    let (start, end) = (usize::from_str_radix(start, 16).ok()?, usize::from_str_radix(end, 16).ok()?);
    let mapping = Mapping { start, length: end.checked_sub(start)?, writable: access.contains('w') };
    access.contains('r').then_some(mapping)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::channel::{Endpoint, Topic};

    #[test]
    fn mappings_are_read_from_what_the_kernel_says() {
        let line = "7f00a000-7f00c000 rw-s 00000000 00:1a 77   /dev/shm/plx0_1-0_x.data";
        assert_eq!(read(line), Some(Mapping { start: 0x7f00_a000, length: 0x2000, writable: true }));
        let line = "7f00a000-7f00c000 r--s 00000000 00:1a 77   /dev/shm/plx0_1-0_x.data";
        assert_eq!(read(line).map(|mapping| mapping.writable), Some(false));
        for line in ["", "x", "7f00a000 rw-s", "7f00c000-7f00a000 rw-s 0", "7f00a000-7f00c000 ---s 0"] {
            assert_eq!(read(line), None, "{line}");
        }
    }

    /// Faults of this thread so far.
    fn faults() -> i64 {
        // SAFETY: rusage is plain integers, for which zeros are valid; it outlives the call.
        unsafe {
            let mut usage: libc::rusage = std::mem::zeroed();
            assert_eq!(libc::getrusage(libc::RUSAGE_THREAD, &mut usage), 0);
            usage.ru_minflt
        }
    }

    #[test]
    fn messages_meet_no_page_faults() {
        let count = |populated: bool| {
            let space = Space::create().unwrap();
            let endpoint = Endpoint::new(&space).unwrap();
            let topic =
                Topic { name: "a".into(), layout: 1, words: 1024, buffer: 64, subscribers: 1, held: 0 };
            let service = endpoint.create(&topic).unwrap();
            let (subscriber, publisher) = (service.subscriber().unwrap(), service.publisher().unwrap());
            publisher.connect().unwrap();
            subscriber.connect().unwrap();
            space.commit().unwrap();
            if populated {
                space.populate().unwrap();
            }
            let before = faults();
            for _ in 0..64 {
                assert_eq!(publisher.send(1024, |word| word as u64).unwrap(), 1);
            }
            while subscriber.receive(|words| assert_eq!(words[1023], 1023)).unwrap() {}
            faults() - before
        };
        let (without, with) = (count(false), count(true));
        // 64 messages of two pages, each mapped twice.
        assert!(without > 100, "{without}");
        assert!(with < without / 10, "{with} of {without}");
    }
}
