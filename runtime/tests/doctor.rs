//! Each check of the doctor on made-up machines: good ones, bad ones, and such as tell nothing.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on has failed")]

use std::os::unix::fs::PermissionsExt;
use std::path::Path;
use std::time::Duration;

use parallax_runtime::doctor::{Finding, Machine, Verdict, examine, wake_ups};

/// Files of a machine on which nothing is to be changed.
const GOOD: &[(&str, &str)] = &[
    ("sys/devices/system/cpu/online", "0-3\n"),
    ("sys/devices/system/cpu/isolated", "2-3\n"),
    ("sys/devices/system/cpu/smt/active", "0\n"),
    ("sys/devices/system/cpu/cpu0/cpufreq/scaling_governor", "performance\n"),
    ("sys/devices/system/cpu/cpu1/cpufreq/scaling_governor", "performance\n"),
    ("sys/devices/system/cpu/cpu2/cpufreq/scaling_governor", "performance\n"),
    ("sys/devices/system/cpu/cpu3/cpufreq/scaling_governor", "performance\n"),
    ("sys/devices/system/cpu/cpu0/cpuidle/state0/name", "POLL\n"),
    ("sys/devices/system/cpu/cpu0/cpuidle/state0/latency", "0\n"),
    ("sys/devices/system/cpu/cpu0/cpuidle/state1/name", "C6\n"),
    ("sys/devices/system/cpu/cpu0/cpuidle/state1/latency", "133\n"),
    ("sys/devices/system/cpu/cpu0/cpuidle/state1/disable", "1\n"),
    ("sys/devices/system/clocksource/clocksource0/current_clocksource", "tsc\n"),
    ("sys/devices/system/clocksource/clocksource0/available_clocksource", "tsc hpet acpi_pm \n"),
    ("sys/kernel/mm/transparent_hugepage/enabled", "always [madvise] never\n"),
    ("sys/kernel/realtime", "1\n"),
    ("proc/version", "Linux version 6.12.0-rt (gcc 13) #1 SMP PREEMPT_RT\n"),
    ("proc/loadavg", "0.10 0.12 0.08 1/123 4567\n"),
    ("proc/cpuinfo", "processor\t: 0\nmodel name\t: any\nflags\t\t: fpu tsc\n"),
    ("proc/self/status", "Name:\tx\nCapEff:\t0000000000000000\n"),
    (
        "proc/self/limits",
        "Limit                     Soft Limit           Hard Limit           Units\n\
         Max locked memory         unlimited            unlimited            bytes\n\
         Max realtime priority     95                   95\n",
    ),
    ("proc/self/timerslack_ns", "50000\n"),
    ("proc/self/mounts", "tmpfs /dev/shm tmpfs rw 0 0\n"),
    ("proc/timer_list", "Timer List\n  .resolution:  1 nsecs\n"),
    ("proc/sys/kernel/sched_rt_runtime_us", "-1\n"),
    ("proc/sys/kernel/sched_rt_period_us", "1000000\n"),
    ("proc/swaps", "Filename Type Size Used Priority\n"),
];

fn write(root: &Path, path: &str, text: &str) {
    let path = root.join(path);
    std::fs::create_dir_all(path.parent().unwrap()).unwrap();
    std::fs::write(path, text).unwrap();
}

fn good() -> tempfile::TempDir {
    let root = tempfile::tempdir().unwrap();
    GOOD.iter().for_each(|(path, text)| write(root.path(), path, text));
    std::fs::create_dir_all(root.path().join("dev/shm")).unwrap();
    root
}

/// What the doctor finds on a good machine of which one file is another one.
fn with(path: &str, text: &str, check: &str) -> Finding {
    let root = good();
    write(root.path(), path, text);
    find(root.path(), check)
}

fn find(root: &Path, check: &str) -> Finding {
    examine(&Machine::at(root)).into_iter().find(|finding| finding.check == check).unwrap()
}

#[test]
fn a_good_machine_is_left_alone() {
    let root = good();
    let findings = examine(&Machine::at(root.path()));
    assert!(findings.len() >= 15);
    for finding in &findings {
        assert!(finding.verdict < Verdict::Unknown, "{finding:?}");
    }
}

#[test]
fn what_makes_nodes_late_is_named_with_its_command() {
    let cpu = "sys/devices/system/cpu";
    let cases: &[(String, &str, &str, &str, &str)] = &[
        (
            format!("{cpu}/cpu2/cpufreq/scaling_governor"),
            "powersave",
            "frequency governor",
            "core 2",
            "cpupower",
        ),
        (format!("{cpu}/isolated"), "", "isolated cores", "none of 4", "isolcpus=managed_irq,domain,2-3"),
        (format!("{cpu}/smt/active"), "1", "two threads a core (SMT)", "on", "smt/control"),
        (
            format!("{cpu}/cpu0/cpuidle/state1/disable"),
            "0",
            "sleep of idle cores",
            "C6, wakes in 133 us",
            "idle-set",
        ),
        (
            "sys/devices/system/clocksource/clocksource0/current_clocksource".into(),
            "hpet",
            "clock source",
            "hpet",
            "echo tsc",
        ),
        (
            "sys/kernel/mm/transparent_hugepage/enabled".into(),
            "[always] madvise never",
            "transparent huge pages",
            "always",
            "madvise",
        ),
        (
            "proc/self/limits".into(),
            "Max realtime priority     0                    0\nMax locked memory  8388608  8388608 bytes\n",
            "real-time priority",
            "not allowed",
            "rtprio",
        ),
        ("proc/timer_list".into(), ".resolution:  4000000 nsecs", "timers", "4000 us", "cmdline"),
        (
            "proc/self/mounts".into(),
            "/dev/sda1 /dev/shm ext4 rw 0 0",
            "shared memory",
            "ext4",
            "mount -t tmpfs",
        ),
    ];
    for (path, text, check, found, command) in cases {
        let finding = with(path, text, check);
        assert_eq!(finding.verdict, Verdict::Change, "{finding:?}");
        assert!(finding.found.contains(found), "{finding:?}");
        assert!(
            finding.command.as_ref().unwrap().contains(command) && !finding.advice.is_empty(),
            "{finding:?}"
        );
    }
    let limits = "Max locked memory         65536                65536                bytes\nMax realtime priority 9 9\n";
    let finding = with("proc/self/limits", limits, "locked memory");
    assert!(finding.verdict == Verdict::Change && finding.found.contains("64 KiB"), "{finding:?}");
    // A privilege stands above a limit.
    let root = good();
    write(root.path(), "proc/self/limits", limits);
    write(root.path(), "proc/self/status", "CapEff:\t000001ffffffffff\n");
    assert_eq!(find(root.path(), "locked memory").verdict, Verdict::Good);

    let root = good();
    std::fs::remove_file(root.path().join("sys/kernel/realtime")).unwrap();
    write(root.path(), "proc/version", "Linux version 6.1 #1 SMP PREEMPT_DYNAMIC");
    assert_eq!(find(root.path(), "preemption of the kernel").verdict, Verdict::Note);
    write(root.path(), "sys/kernel/debug/sched/preempt", "none (voluntary) full\n");
    assert_eq!(find(root.path(), "preemption of the kernel").verdict, Verdict::Change);
    write(root.path(), "sys/kernel/debug/sched/preempt", "none voluntary (full)\n");
    assert_eq!(find(root.path(), "preemption of the kernel").verdict, Verdict::Good);
}

#[test]
fn what_cannot_be_helped_is_only_told() {
    let notes: &[(&str, &str, &str)] = &[
        ("proc/cpuinfo", "flags : fpu hypervisor tsc", "virtualisation"),
        ("proc/loadavg", "7.5 1 1 1/1 1", "load"),
        ("proc/swaps", "Filename\n/dev/sda2 partition 1 1 -2", "swap"),
        ("proc/sys/kernel/sched_rt_runtime_us", "950000", "real-time throttling"),
    ];
    for (path, text, check) in notes {
        let finding = with(path, text, check);
        assert!(finding.verdict == Verdict::Note && !finding.advice.is_empty(), "{finding:?}");
    }
}

#[test]
fn shared_memory_and_what_lies_in_it() {
    let root = good();
    let shm = root.path().join("dev/shm");
    std::fs::set_permissions(&shm, PermissionsExt::from_mode(0o555)).unwrap();
    assert_eq!(find(root.path(), "shared memory").verdict, Verdict::Change);
    std::fs::set_permissions(&shm, PermissionsExt::from_mode(0o777)).unwrap();
    // SAFETY: geteuid cannot fail.
    let user = unsafe { libc::geteuid() };
    write(&shm, &format!("parallax-{user}/1-0.lock"), "");
    let finding = find(root.path(), "remains of runs");
    assert!(finding.verdict == Verdict::Note && finding.found.starts_with('1'), "{finding:?}");
    let held = std::fs::File::open(shm.join(format!("parallax-{user}/1-0.lock"))).unwrap();
    held.lock().unwrap();
    assert_eq!(find(root.path(), "remains of runs").verdict, Verdict::Good, "its run lives");
    std::fs::remove_dir_all(&shm).unwrap();
    let finding = find(root.path(), "shared memory");
    assert!(finding.verdict == Verdict::Change && finding.command.unwrap().contains("mount"));
}

#[test]
fn a_machine_that_tells_nothing_is_no_crash() {
    let root = tempfile::tempdir().unwrap();
    let findings = examine(&Machine::at(root.path()));
    assert!(findings.iter().any(|finding| finding.verdict == Verdict::Unknown));
    // Files with anything in them.
    for text in ["", "\u{fffd}\u{0}-,-", "18446744073709551616", "0-18446744073709551615", "[", "(x"] {
        let root = good();
        GOOD.iter().for_each(|(path, _)| write(root.path(), path, text));
        assert!(!examine(&Machine::at(root.path())).is_empty());
    }
}

#[test]
fn wake_ups_are_measured() {
    let (finding, delays) = wake_ups(Duration::from_millis(200));
    // Fewer where the machine is busy; how late they are is not for a test to say.
    assert!(delays.len() > 20, "{finding:?}");
    assert!(finding.found.contains("late"), "{finding:?}");
}
