//! What this user may ask of the system: real-time priority, memory that stays, and how long it may run.

use super::{Finding, Machine};

/// Bits of `CapEff` in `/proc/self/status`.
const CAP_IPC_LOCK: u32 = 14;
const CAP_SYS_NICE: u32 = 23;

/// Memory that a node locks at least.
const LOCKED: u64 = 64 << 20;

pub(super) fn examine(machine: &Machine) -> Vec<Finding> {
    vec![priority(machine), locked(machine), throttling(machine)]
}

/// A soft limit in `/proc/self/limits`; `u64::MAX` for unlimited.
fn limit(machine: &Machine, name: &str) -> Option<u64> {
    let text = machine.text("/proc/self/limits")?;
    let value = text.lines().find_map(|line| line.strip_prefix(name))?.split_whitespace().next()?.to_owned();
    if value == "unlimited" { Some(u64::MAX) } else { value.parse().ok() }
}

fn capable(machine: &Machine, bit: u32) -> bool {
    let text = machine.text("/proc/self/status").unwrap_or_default();
    let mask = text.lines().find_map(|line| line.strip_prefix("CapEff:")).map(str::trim);
    mask.and_then(|mask| u64::from_str_radix(mask, 16).ok()).is_some_and(|mask| mask & (1 << bit) != 0)
}

fn priority(machine: &Machine) -> Finding {
    const CHECK: &str = "real-time priority";
    if capable(machine, CAP_SYS_NICE) {
        return Finding::good(CHECK, "allowed (CAP_SYS_NICE)");
    }
    match limit(machine, "Max realtime priority") {
        None => Finding::unknown(CHECK, "/proc/self/limits"),
        Some(0) => Finding::change(
            CHECK,
            "not allowed",
            "nodes cannot have SCHED_FIFO: any program may push them aside. Then log in again",
            "echo \"$USER - rtprio 95\" | sudo tee -a /etc/security/limits.d/parallax.conf",
        ),
        Some(most) => Finding::good(CHECK, format!("up to {most}")),
    }
}

fn locked(machine: &Machine) -> Finding {
    const CHECK: &str = "locked memory";
    if capable(machine, CAP_IPC_LOCK) {
        return Finding::good(CHECK, "any amount (CAP_IPC_LOCK)");
    }
    match limit(machine, "Max locked memory") {
        None => Finding::unknown(CHECK, "/proc/self/limits"),
        Some(u64::MAX) => Finding::good(CHECK, "any amount"),
        Some(bytes) if bytes >= LOCKED => Finding::good(CHECK, format!("{} MiB", bytes >> 20)),
        Some(bytes) => Finding::change(
            CHECK,
            format!("{} KiB", bytes >> 10),
            "the memory of nodes may be paged out, and a step waits for the disk. Then log in again",
            "echo \"$USER - memlock unlimited\" | sudo tee -a /etc/security/limits.d/parallax.conf",
        ),
    }
}

fn throttling(machine: &Machine) -> Finding {
    const CHECK: &str = "real-time throttling";
    let path = "/proc/sys/kernel/sched_rt_runtime_us";
    let read = |path: &str| machine.text(path).and_then(|text| text.parse::<i64>().ok());
    let (Some(runtime), Some(period)) = (read(path), read("/proc/sys/kernel/sched_rt_period_us")) else {
        return Finding::unknown(CHECK, path);
    };
    if runtime < 0 || runtime >= period {
        return Finding::note(
            CHECK,
            "off",
            "a polling node under SCHED_FIFO keeps its core for good: leave the launcher one of its own",
        );
    }
    Finding::note(
        CHECK,
        format!("{} of {} ms", runtime / 1000, period / 1000),
        format!(
            "a node that polls under SCHED_FIFO is stopped for the other {} ms; where it has its core to itself: sudo \
             sysctl -w kernel.sched_rt_runtime_us=-1",
            (period - runtime) / 1000
        ),
    )
}
