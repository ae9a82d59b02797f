//! How another machine's run clock stands to this one's: a page that the link writes, and nodes read for every message that
//! crossed.

use std::path::Path;
#[cfg(feature = "link")]
use std::sync::atomic::Ordering::Release;
use std::sync::atomic::Ordering::{Acquire, Relaxed};

use crate::channel::ChannelError;
use crate::channel::futex::SharedPage;
use crate::time::Nanos;

/// Odd while the page is being written.
const VERSION: usize = 0;
const SHIFT: usize = 1;
const AT: usize = 2;
const SKEW: usize = 3;

/// The page of one other machine.
#[derive(Debug)]
pub(in crate::launch) struct ClockPage(SharedPage);

/// How the run clocks of two machines stand to each other: `here = there + shift - skew * (here - at)`.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub(super) struct Standing {
    /// ns
    pub(super) shift: Nanos,
    /// The time of this machine's run clock for which the shift holds, ns.
    pub(super) at: Nanos,
    /// How much faster the other clock runs: seconds per second.
    pub(super) skew: f64,
}

impl ClockPage {
    /// The page of this machine in the run's directory, made where there is none.
    pub(in crate::launch) fn open(run: &Path, host: &str) -> Result<Self, ChannelError> {
        // A node's files have its name, and no name has a hyphen in front.
        let path = run.join(format!("-{host}.clock"));
        let what = "cannot make the page of the clock";
        SharedPage::create(&path).map(Self).map_err(|source| ChannelError::Io { what, path, source })
    }

    #[cfg(feature = "link")]
    pub(super) fn write(&self, standing: &Standing) {
        let version = self.0.cell(VERSION).load(Relaxed);
        self.0.cell(VERSION).store(version.wrapping_add(1) | 1, Relaxed);
        std::sync::atomic::fence(Release);
        self.0.cell(SHIFT).store(standing.shift as u64, Relaxed);
        self.0.cell(AT).store(standing.at as u64, Relaxed);
        self.0.cell(SKEW).store(standing.skew.to_bits(), Relaxed);
        self.0.cell(VERSION).store((version | 1).wrapping_add(1), Release);
    }

    fn read(&self) -> Option<Standing> {
        // A writer takes nanoseconds; one that died while it wrote leaves an odd number, and the last shift is used then.
        for _ in 0..64 {
            let before = self.0.cell(VERSION).load(Acquire);
            let standing = Standing {
                shift: self.0.cell(SHIFT).load(Relaxed) as Nanos,
                at: self.0.cell(AT).load(Relaxed) as Nanos,
                skew: f64::from_bits(self.0.cell(SKEW).load(Relaxed)),
            };
            std::sync::atomic::fence(Acquire);
            if before.is_multiple_of(2) && self.0.cell(VERSION).load(Relaxed) == before {
                return (before > 0).then_some(standing);
            }
        }
        None
    }

    /// When a message was sent, on this machine's run clock, that was sent at `sent` on the other's and arrived at `received`;
    /// never later than it arrived.
    pub(in crate::launch) fn here(&self, sent: Nanos, received: Nanos) -> Nanos {
        let Some(Standing { shift, at, skew }) = self.read() else { return sent.min(received) };
        let drift = (skew.clamp(-1e-3, 1e-3) * received.saturating_sub(at) as f64) as Nanos;
        sent.saturating_add(shift).saturating_sub(drift).min(received)
    }
}

#[cfg(all(test, feature = "link"))]
mod tests {
    use super::*;

    #[test]
    fn times_of_another_machine_become_those_of_this_one() {
        let run = tempfile::tempdir().unwrap();
        let (link, node) =
            (ClockPage::open(run.path(), "arm").unwrap(), ClockPage::open(run.path(), "arm").unwrap());
        // Nothing is known yet.
        assert_eq!((node.here(100, 200), node.here(300, 200)), (100, 200));
        link.write(&Standing { shift: -40, at: 1_000_000_000, skew: 100e-6 });
        assert_eq!(node.here(500, 1_000_000_000), 460);
        // A second later the other clock is 100 us further.
        assert_eq!(node.here(2_000_000_000, 2_000_000_000), 2_000_000_000 - 40 - 100_000);
        assert_eq!(node.here(i64::MAX, 7), 7);
    }
}
