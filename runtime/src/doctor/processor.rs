//! Cores: their clock, who else uses them, how deep they sleep.

use super::{Finding, Machine, Verdict};

const CPU: &str = "/sys/devices/system/cpu";

pub(super) fn examine(machine: &Machine) -> Vec<Finding> {
    vec![
        governor(machine),
        isolated(machine),
        threads(machine),
        idle(machine),
        load(machine),
        virtual_machine(machine),
    ]
}

/// A list such as `0-3,6` as numbers. What is no such list is empty.
pub(super) fn list(text: &str) -> Vec<usize> {
    let range = |part: &str| {
        let (low, high) = part.split_once('-').unwrap_or((part, part));
        Some(low.trim().parse::<usize>().ok()?..=high.trim().parse::<usize>().ok()?)
    };
    // A machine has fewer cores than this; a damaged file may say anything.
    text.split(',').filter_map(range).flatten().take(1 << 16).collect()
}

fn online(machine: &Machine) -> Vec<usize> {
    machine.text(&format!("{CPU}/online")).map(|text| list(&text)).unwrap_or_default()
}

fn governor(machine: &Machine) -> Finding {
    const CHECK: &str = "frequency governor";
    let governors: Vec<(usize, String)> = online(machine)
        .into_iter()
        .filter_map(|core| Some((core, machine.text(&format!("{CPU}/cpu{core}/cpufreq/scaling_governor"))?)))
        .collect();
    let Some((_, first)) = governors.first() else {
        return Finding::note(
            CHECK,
            "the system does not control the frequency",
            "the host, or the firmware, decides; look there for a performance mode",
        );
    };
    let slow: Vec<String> = governors
        .iter()
        .filter(|(_, governor)| governor != "performance")
        .map(|(core, governor)| format!("core {core}: {governor}"))
        .collect();
    if slow.is_empty() {
        return Finding::good(CHECK, format!("{first} on {} cores", governors.len()));
    }
    let shown = if slow.len() > 3 {
        format!("{} and {} more", slow[..3].join(", "), slow.len() - 3)
    } else {
        slow.join(", ")
    };
    Finding::change(
        CHECK,
        shown,
        "a core that has slowed down takes up to milliseconds to become fast again",
        "sudo cpupower frequency-set --governor performance",
    )
}

fn isolated(machine: &Machine) -> Finding {
    const CHECK: &str = "isolated cores";
    let online = online(machine);
    let isolated = machine.text(&format!("{CPU}/isolated")).map(|text| list(&text)).unwrap_or_default();
    if !isolated.is_empty() {
        let names: Vec<String> = isolated.iter().map(ToString::to_string).collect();
        return Finding::good(
            CHECK,
            format!("{} of {} cores: {}", isolated.len(), online.len(), names.join(", ")),
        );
    }
    match online.len() {
        0 => Finding::unknown(CHECK, &format!("{CPU}/online")),
        1 | 2 => Finding::note(
            CHECK,
            format!("none of {}", online.len()),
            "with so few cores all programs share them; polling nodes want more",
        ),
        count => {
            let (first, last) = (online[count / 2], online[count - 1]);
            Finding::change(
                CHECK,
                format!("none of {count}"),
                "other programs and interrupts run on the cores of nodes; add this to the kernel's command line, start \
                 again, and give nodes these cores",
                format!(
                    "isolcpus=managed_irq,domain,{first}-{last} nohz_full={first}-{last} rcu_nocbs={first}-{last}"
                ),
            )
        }
    }
}

fn threads(machine: &Machine) -> Finding {
    const CHECK: &str = "two threads a core (SMT)";
    match machine.text(&format!("{CPU}/smt/active")).as_deref() {
        Some("0") => Finding::good(CHECK, "off"),
        Some(_) => Finding::change(
            CHECK,
            "on",
            "two programs on one core slow each other down, by a half and without warning",
            "echo off | sudo tee /sys/devices/system/cpu/smt/control",
        ),
        None => Finding::unknown(CHECK, &format!("{CPU}/smt/active")),
    }
}

/// The longest time that a core may take to wake from sleep, in microseconds, without making steps late.
const WAKING: u64 = 20;

fn idle(machine: &Machine) -> Finding {
    const CHECK: &str = "sleep of idle cores";
    let folder = format!("{CPU}/cpu0/cpuidle");
    let mut deepest: Option<(String, u64)> = None;
    for state in machine.entries(&folder) {
        let read = |what: &str| machine.text(&format!("{folder}/{state}/{what}"));
        if read("disable").is_some_and(|disabled| disabled != "0") {
            continue;
        }
        let Some(latency) = read("latency").and_then(|text| text.parse().ok()) else { continue };
        if deepest.as_ref().is_none_or(|(_, most)| latency > *most) {
            deepest = Some((read("name").unwrap_or(state), latency));
        }
    }
    match deepest {
        None => Finding::good(CHECK, "none that the system knows of"),
        Some((name, latency)) if latency <= WAKING => {
            Finding::good(CHECK, format!("{name}, wakes in {latency} us"))
        }
        Some((name, latency)) => Finding::change(
            CHECK,
            format!("{name}, wakes in {latency} us"),
            "a blocked node waits for its core to wake first",
            format!("sudo cpupower idle-set --disable-by-latency {WAKING}"),
        ),
    }
}

fn load(machine: &Machine) -> Finding {
    const CHECK: &str = "load";
    let path = "/proc/loadavg";
    let load = machine.text(path).and_then(|text| text.split(' ').next()?.parse::<f64>().ok());
    let cores = online(machine).len().max(1);
    match load {
        None => Finding::unknown(CHECK, path),
        Some(load) if load < 0.5 * cores as f64 => Finding::good(CHECK, format!("{load} on {cores} cores")),
        Some(load) => Finding::note(
            CHECK,
            format!("{load} on {cores} cores"),
            "other programs run; what is measured now is measured with them",
        ),
    }
}

fn virtual_machine(machine: &Machine) -> Finding {
    const CHECK: &str = "virtualisation";
    let path = "/proc/cpuinfo";
    let Some(text) = machine.text(path) else { return Finding::unknown(CHECK, path) };
    let is_virtual = text
        .lines()
        .find_map(|line| line.strip_prefix("flags")?.split_once(':'))
        .is_some_and(|(_, flags)| flags.split_whitespace().any(|flag| flag == "hypervisor"));
    if is_virtual {
        Finding::note(
            CHECK,
            "a virtual machine",
            "its host may take a core away for milliseconds, and waking another core goes through it: measure on the \
             robot's own computer",
        )
    } else {
        Finding::new(CHECK, Verdict::Good, "none that the processor tells of")
    }
}
