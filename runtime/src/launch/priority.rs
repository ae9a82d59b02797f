//! A place before ordinary programs for those who pass on orders and notice deaths.

/// Real-time priority of a thread while this lives: the lowest there is, which still goes before every ordinary program. A
/// graph in real time is stopped, and given safe outputs, by threads that must not wait for a compiler.
#[derive(Debug)]
pub(super) struct Raised {
    /// What was before; `None` when nothing has changed.
    before: Option<(libc::c_int, libc::sched_param)>,
}

impl Raised {
    /// Raises the calling thread, where the system allows it. Processes and threads that it starts are ordinary.
    pub(super) fn current(wanted: bool) -> Self {
        if !wanted {
            return Self { before: None };
        }
        let mut parameters = libc::sched_param { sched_priority: 0 };
        let lowest = libc::sched_param { sched_priority: 1 };
        // SAFETY: the pointers are to locals that outlive the calls; 0 is the calling thread, of which nothing else changes.
        let before = unsafe {
            let policy = libc::sched_getscheduler(0);
            let known = policy >= 0 && libc::sched_getparam(0, &mut parameters) == 0;
            let raised = known
                && libc::sched_setscheduler(0, libc::SCHED_FIFO | libc::SCHED_RESET_ON_FORK, &lowest) == 0;
            raised.then_some((policy, parameters))
        };
        Self { before }
    }
}

impl Drop for Raised {
    fn drop(&mut self) {
        if let Some((policy, parameters)) = self.before {
            // SAFETY: as in `current`. A thread may always give up a priority.
            unsafe { libc::sched_setscheduler(0, policy, &parameters) };
        }
    }
}
