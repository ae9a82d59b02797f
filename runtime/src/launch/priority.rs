//! Who goes before whom: a place before ordinary programs for those who pass on orders and notice deaths, and an order among the
//! ordinary processes of a run.

use std::io;

use super::settings::{NodeSettings, Policy};

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

/// The shortest slice of processor time that the system knows.
const SLICE: u64 = 100_000;
/// How much nicer than its nodes the recorder is. A busy machine still gives it a fourth of a core, of which it takes hundredths.
const NICE: i32 = 5;

/// A node that is no real-time program wakes for moments. With a short slice (Linux 6.12) it goes at once before whoever has used
/// its core for longer, instead of waiting until that one's slice is over. What the system refuses makes it no worse.
fn wake_at_once() {
    change(libc::SCHED_OTHER, 0, SLICE);
}

/// The recorder has seconds of room: it takes what nodes leave, and none of them waits for it.
pub(super) fn give_way() {
    change(libc::SCHED_BATCH, NICE, 0);
}

/// Changes how this thread is scheduled, if it is an ordinary one. Whoever started the program under a real-time policy wants that.
fn change(policy: libc::c_int, nicer: i32, slice: u64) {
    // SAFETY: `attributes` is plain integers, for which zeros are valid, of the size that it says; it outlives the calls, which
    // change nothing but it and this thread's own setting. 0 is the calling thread.
    unsafe {
        if libc::sched_getscheduler(0) != libc::SCHED_OTHER {
            return;
        }
        let mut attributes: libc::sched_attr = std::mem::zeroed();
        attributes.size = size_of::<libc::sched_attr>() as u32;
        attributes.sched_policy = policy as u32;
        attributes.sched_nice = (libc::getpriority(libc::PRIO_PROCESS, 0) + nicer).min(19);
        attributes.sched_runtime = slice;
        libc::syscall(libc::SYS_sched_setattr, 0, &raw const attributes, 0);
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

/// Gives this thread its scheduling policy, and keeps its memory; gives what was refused.
pub(super) fn schedule(node: &str, settings: &NodeSettings) -> Vec<String> {
    let mut refused = Vec::new();
    let policy = match settings.policy {
        Policy::Other => {
            wake_at_once();
            None
        }
        Policy::Fifo => Some((libc::SCHED_FIFO, "SCHED_FIFO")),
        Policy::Rr => Some((libc::SCHED_RR, "SCHED_RR")),
    };
    if let Some((policy, name)) = policy {
        let parameters = libc::sched_param { sched_priority: settings.priority.into() };
        // SAFETY: `parameters` is a valid sched_param that outlives the call; 0 is the calling thread. Threads that this
        // one starts are ordinary again.
        if unsafe { libc::sched_setscheduler(0, policy | libc::SCHED_RESET_ON_FORK, &parameters) } != 0 {
            let error = io::Error::last_os_error();
            refused.push(format!(
                "node {node} runs like any program, not under {name} with priority {}: {error}; give this user an \
                 rtprio limit (/etc/security/limits.conf) or the program CAP_SYS_NICE",
                settings.priority
            ));
        }
    }
    // SAFETY: the call takes an integer and changes nothing but where this process's memory may lie.
    if settings.lock_memory && unsafe { libc::mlockall(libc::MCL_CURRENT | libc::MCL_FUTURE) } != 0 {
        let error = io::Error::last_os_error();
        refused.push(format!(
            "the memory of node {node} may be paged out: {error}; give this user a memlock limit \
             (/etc/security/limits.conf) or the program CAP_IPC_LOCK"
        ));
    }
    refused
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_recorder_gives_way_and_a_node_stays_as_nice_as_it_was() {
        let told = |act: fn()| {
            let thread = std::thread::spawn(move || {
                act();
                // SAFETY: the calls take integers only.
                unsafe { (libc::sched_getscheduler(0), libc::getpriority(libc::PRIO_PROCESS, 0)) }
            });
            thread.join().unwrap()
        };
        let (policy, nice) = told(|| ());
        if policy != libc::SCHED_OTHER {
            // Somebody runs these tests in real time, and that stays so.
            assert_eq!((told(give_way), told(wake_at_once)), ((policy, nice), (policy, nice)));
            return;
        }
        assert_eq!(told(give_way), (libc::SCHED_BATCH, (nice + NICE).min(19)));
        assert_eq!(told(wake_at_once), (libc::SCHED_OTHER, nice));
    }
}
