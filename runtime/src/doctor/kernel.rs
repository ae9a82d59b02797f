//! The kernel: how it lets itself be interrupted, how it counts time.

use super::{Finding, Machine};

pub(super) fn examine(machine: &Machine) -> Vec<Finding> {
    vec![preemption(machine), clock_source(machine), timers(machine)]
}

fn preemption(machine: &Machine) -> Finding {
    const CHECK: &str = "preemption of the kernel";
    let path = "/proc/version";
    let Some(version) = machine.text(path) else { return Finding::unknown(CHECK, path) };
    if machine.text("/sys/kernel/realtime").as_deref() == Some("1") || version.contains("PREEMPT_RT") {
        return Finding::good(CHECK, "PREEMPT_RT");
    }
    // Readable by root only: `none voluntary (full) lazy`.
    let chosen = machine.text("/sys/kernel/debug/sched/preempt").and_then(|text| {
        let (_, after) = text.split_once('(')?;
        Some(after.split_once(')')?.0.to_owned())
    });
    let advice = "system calls of other programs may delay a step by milliseconds";
    match chosen.as_deref() {
        Some("full") => Finding::good(CHECK, "full"),
        Some(other) => {
            Finding::change(CHECK, other, advice, "echo full | sudo tee /sys/kernel/debug/sched/preempt")
        }
        None if version.contains("PREEMPT_DYNAMIC") => Finding::note(
            CHECK,
            "dynamic; which kind only root can see",
            "preempt=full on the kernel's command line makes sure; a PREEMPT_RT kernel is best",
        ),
        None if version.contains("PREEMPT") => Finding::good(CHECK, "PREEMPT"),
        None => Finding::change(
            CHECK,
            "none",
            advice,
            "install a kernel with PREEMPT_RT (Debian: linux-image-rt-amd64)",
        ),
    }
}

fn clock_source(machine: &Machine) -> Finding {
    const CHECK: &str = "clock source";
    let folder = "/sys/devices/system/clocksource/clocksource0";
    let path = format!("{folder}/current_clocksource");
    let Some(current) = machine.text(&path) else { return Finding::unknown(CHECK, &path) };
    // These are read without a system call.
    const FAST: [&str; 4] = ["tsc", "kvm-clock", "arch_sys_counter", "hyperv_clocksource_tsc_page"];
    if FAST.contains(&current.as_str()) {
        return Finding::good(CHECK, current);
    }
    let available = machine.text(&format!("{folder}/available_clocksource")).unwrap_or_default();
    let advice =
        "every reading of the clock is a system call, about a microsecond; a step reads it several times";
    match FAST.iter().find(|fast| available.split(' ').any(|name| name == **fast)) {
        Some(fast) => Finding::change(CHECK, current, advice, format!("echo {fast} | sudo tee {path}")),
        None => Finding::note(CHECK, current, format!("{advice}. This machine offers no faster one")),
    }
}

fn timers(machine: &Machine) -> Finding {
    const CHECK: &str = "timers";
    let path = "/proc/timer_list";
    let slack = machine.text("/proc/self/timerslack_ns").and_then(|text| text.parse::<u64>().ok());
    let slack = match slack {
        Some(slack) => format!("slack {} us (nodes set theirs to nothing)", slack / 1000),
        None => "slack unknown".into(),
    };
    // Readable by root only; a kernel with coarse timers says so there.
    let resolution = machine.text(path).and_then(|text| {
        let line = text.lines().find_map(|line| line.trim().strip_prefix(".resolution:"))?;
        line.split_whitespace().next()?.parse::<u64>().ok()
    });
    let resolution = resolution.or_else(|| machine.live().then(resolution_of_this_machine).flatten());
    match resolution {
        Some(nanos) if nanos <= 1000 => Finding::good(CHECK, format!("to {nanos} ns, {slack}")),
        Some(nanos) => Finding::change(
            CHECK,
            format!("to {} us only, {slack}", nanos / 1000),
            "sleeps end at the next tick of the kernel: take highres=off and nohz=off from the kernel's command line",
            "cat /proc/cmdline",
        ),
        None => Finding::unknown(CHECK, path),
    }
}

/// The resolution of the monotonic clock's timers, in nanoseconds, as the running kernel says.
fn resolution_of_this_machine() -> Option<u64> {
    let mut time = libc::timespec { tv_sec: 0, tv_nsec: 0 };
    // SAFETY: `time` is a writable timespec that outlives the call.
    let answer = unsafe { libc::clock_getres(libc::CLOCK_MONOTONIC, &mut time) };
    (answer == 0).then(|| time.tv_sec as u64 * 1_000_000_000 + time.tv_nsec as u64)
}
