//! Lines on standard error that nobody waits for.

use std::io::Write;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::mpsc::{SyncSender, sync_channel};
use std::thread::JoinHandle;

use indicatif::ProgressBar;

/// Lines that may wait to be printed.
const WAITING: usize = 1024;

/// Prints lines above a bar, on a thread of its own. Whoever supervises a run must not wait for a terminal that is stopped or a pipe
/// that nobody reads: what does not fit is counted and left out.
pub(crate) struct Printer {
    lines: Option<SyncSender<String>>,
    thread: Option<JoinHandle<()>>,
    left_out: AtomicU64,
}

impl Printer {
    /// A printer above this bar.
    pub(crate) fn new(bar: &ProgressBar) -> Arc<Self> {
        let (lines, waiting) = sync_channel::<String>(WAITING);
        let bar = bar.clone();
        let print = move || {
            for line in waiting {
                // A reader that has gone away is no error.
                bar.suspend(|| drop(writeln!(std::io::stderr(), "{line}")));
            }
        };
        let thread = std::thread::Builder::new().name("printer".into()).spawn(print).ok();
        Arc::new(Self { lines: Some(lines), thread, left_out: AtomicU64::new(0) })
    }

    /// Has a line printed, if there is room for it.
    pub(crate) fn say(&self, line: String) {
        let taken = self.lines.as_ref().is_some_and(|lines| lines.try_send(line).is_ok());
        if !taken {
            self.left_out.fetch_add(1, Ordering::Relaxed);
        }
    }
}

impl Drop for Printer {
    fn drop(&mut self) {
        let left_out = self.left_out.load(Ordering::Relaxed);
        if let (Some(lines), true) = (&self.lines, left_out > 0) {
            let _ = lines.send(format!("{left_out} more lines were not printed: nobody took them in time"));
        }
        self.lines = None;
        // What was said is printed before what follows.
        if let Some(thread) = self.thread.take() {
            let _ = thread.join();
        }
    }
}
