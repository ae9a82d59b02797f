//! The wall clock of a run: nanoseconds since the common start of all its nodes.

use crate::time::Nanos;

/// A run's wall clock. All processes of one run share its epoch, so that their times compare.
///
/// It counts `CLOCK_MONOTONIC`, which no daylight saving and no time server moves back.
///
/// ```
/// use parallax_runtime::clock::WallClock;
/// let clock = WallClock::starting_in(0);
/// let then = clock.now();
/// assert!(clock.now() >= then);
/// ```
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct WallClock {
    epoch: Nanos,
}

impl WallClock {
    /// A clock that will show 0 in `wait` nanoseconds. Until then it shows negative times.
    pub fn starting_in(wait: Nanos) -> Self {
        Self { epoch: monotonic() + wait }
    }

    /// The clock with this epoch, as [`epoch`](WallClock::epoch) of another process gave it.
    pub fn with_epoch(epoch: Nanos) -> Self {
        Self { epoch }
    }

    /// The reading of the machine's monotonic clock at the start of the run.
    pub fn epoch(self) -> Nanos {
        self.epoch
    }

    /// Nanoseconds since the start of the run.
    pub fn now(self) -> Nanos {
        monotonic() - self.epoch
    }
}

/// The machine's monotonic clock, in nanoseconds.
pub fn monotonic() -> Nanos {
    let mut time = libc::timespec { tv_sec: 0, tv_nsec: 0 };
    // SAFETY: `time` is a writable timespec that outlives the call. The call cannot fail for this clock,
    // which every Linux has.
    unsafe { libc::clock_gettime(libc::CLOCK_MONOTONIC, &mut time) };
    time.tv_sec * 1_000_000_000 + time.tv_nsec
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_clock_that_starts_later_shows_negative_times_first() {
        let clock = WallClock::starting_in(1_000_000_000);
        assert!(clock.now() < 0);
        let other = WallClock::with_epoch(clock.epoch());
        assert!((other.now() - clock.now()).abs() < 500_000_000);
    }
}
