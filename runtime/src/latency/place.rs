//! Where and how a measuring thread runs: its core, its priority, its sleeps.

use std::io;
use std::time::{Duration, Instant};

use super::Delays;
use crate::clock::monotonic;
use crate::time::{Nanos, SECOND};

/// Puts this thread on a core and under `SCHED_FIFO`, as asked; gives what was refused.
pub(super) fn settle(core: Option<usize>, fifo: bool) -> Vec<String> {
    let mut refused = Vec::new();
    // SAFETY: the call takes integers only and changes nothing but this thread's own setting.
    unsafe { libc::prctl(libc::PR_SET_TIMERSLACK, 1) };
    if let Some(core) = core
        && !core_affinity::set_for_current(core_affinity::CoreId { id: core })
    {
        refused.push(format!("a floor could not be put on core {core}"));
    }
    if fifo {
        let parameters = libc::sched_param { sched_priority: 10 };
        // SAFETY: `parameters` is a valid sched_param that outlives the call; 0 is the calling thread.
        if unsafe { libc::sched_setscheduler(0, libc::SCHED_FIFO | libc::SCHED_RESET_ON_FORK, &parameters) }
            != 0
        {
            let error = io::Error::last_os_error();
            refused.push(format!(
                "a floor runs like any program, not in real time: {error}; give an rtprio limit"
            ));
        }
    }
    refused
}

/// Sleeps until the monotonic clock shows `time`.
pub(super) fn sleep_until(time: Nanos) {
    let until = libc::timespec { tv_sec: time / SECOND, tv_nsec: time % SECOND };
    // SAFETY: `until` is a valid timespec that outlives the call; no remainder is asked for. An interrupted sleep ends
    // early, which the caller's clock shows.
    unsafe {
        libc::clock_nanosleep(libc::CLOCK_MONOTONIC, libc::TIMER_ABSTIME, &until, std::ptr::null_mut());
    }
}

/// How late a loop of 1 kHz wakes that does nothing but sleep, in a thread of its own.
pub(super) fn bare_lateness(delays: &mut Delays, core: usize, fifo: bool, time: Duration) {
    let measured = std::thread::spawn(move || {
        // What is refused here was refused to the node, too, which says so.
        settle(Some(core), fifo);
        wake_ups(1_000_000, time)
    });
    if let Ok(measured) = measured.join() {
        delays.extend(measured);
    }
}

/// How late this thread wakes from sleeps that end every `period`, over such a time.
pub(super) fn wake_ups(period: Nanos, time: Duration) -> Vec<Nanos> {
    let end = Instant::now() + time;
    let mut late = Vec::with_capacity((time.as_nanos() as Nanos / period) as usize + 16);
    let mut next = monotonic() + period;
    while Instant::now() < end {
        sleep_until(next);
        let now = monotonic();
        late.push(now - next);
        next = (next + period).max(now);
    }
    late
}
