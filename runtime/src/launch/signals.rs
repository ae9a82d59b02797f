//! Ctrl-C and requests to terminate.

use std::io;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, PoisonError};

use signal_hook::consts::{SIGHUP, SIGINT, SIGTERM};
use signal_hook::flag;

/// Notices Ctrl-C and requests to terminate while it lives; afterwards they end the process as ever.
#[derive(Debug)]
pub struct Signals {
    raised: Arc<AtomicBool>,
}

/// The handlers, which stay for the life of the process once they are there.
struct Handlers {
    /// Nobody watches: the signal does what it does by default.
    idle: Arc<AtomicBool>,
    /// A signal came while somebody watched.
    raised: Arc<AtomicBool>,
    watchers: usize,
}

static HANDLERS: Mutex<Option<Handlers>> = Mutex::new(None);

impl Signals {
    /// Begins to watch. The first signal sets the flag, the second one ends the process at once with code 130.
    ///
    /// # Errors
    ///
    /// The system's error where no handler can be installed.
    pub fn watch() -> io::Result<Self> {
        let mut handlers = HANDLERS.lock().unwrap_or_else(PoisonError::into_inner);
        let handlers = match &mut *handlers {
            Some(handlers) => handlers,
            none => {
                let idle = Arc::new(AtomicBool::new(true));
                let raised = Arc::new(AtomicBool::new(false));
                for signal in [SIGINT, SIGTERM, SIGHUP] {
                    flag::register_conditional_default(signal, idle.clone())?;
                    // The second Ctrl-C ends the process at once, in case the orderly end hangs. This is
                    // registered before the flag, so that it sees the flag as the first signal left it.
                    flag::register_conditional_shutdown(signal, 130, raised.clone())?;
                    flag::register(signal, raised.clone())?;
                }
                none.insert(Handlers { idle, raised, watchers: 0 })
            }
        };
        handlers.watchers += 1;
        handlers.idle.store(false, Ordering::SeqCst);
        Ok(Self { raised: handlers.raised.clone() })
    }

    /// Whether one came.
    #[must_use]
    pub fn raised(&self) -> bool {
        self.raised.load(Ordering::Relaxed)
    }

    /// What is set when one comes, for whoever works meanwhile. It is cleared when the last watcher is dropped.
    #[must_use]
    pub fn flag(&self) -> Arc<AtomicBool> {
        self.raised.clone()
    }
}

impl Drop for Signals {
    fn drop(&mut self) {
        if let Some(handlers) = &mut *HANDLERS.lock().unwrap_or_else(PoisonError::into_inner) {
            handlers.watchers -= 1;
            if handlers.watchers == 0 {
                handlers.idle.store(true, Ordering::SeqCst);
                handlers.raised.store(false, Ordering::SeqCst);
            }
        }
    }
}
