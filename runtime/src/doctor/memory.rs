//! Memory: the part that nodes share, and what may be taken away from a node.

use std::os::unix::fs::PermissionsExt;

use super::{Finding, Machine};
use crate::channel;

/// Shared memory that a graph with images may need.
const ENOUGH: u64 = 256 << 20;
/// Shared memory that the smallest graphs need.
const LEAST: u64 = 32 << 20;

pub(super) fn examine(machine: &Machine) -> Vec<Finding> {
    vec![shared(machine), stale(machine), huge_pages(machine), swap(machine)]
}

fn shared(machine: &Machine) -> Finding {
    const CHECK: &str = "shared memory";
    let path = machine.path("/dev/shm");
    let mount = "sudo mount -t tmpfs -o mode=1777 tmpfs /dev/shm";
    let Ok(metadata) = std::fs::metadata(&path) else {
        return Finding::change(
            CHECK,
            "there is no /dev/shm",
            "nodes have no place for their messages",
            mount,
        );
    };
    let mode = metadata.permissions().mode() & 0o7777;
    if mode & 0o222 == 0 {
        let found = format!("/dev/shm has the mode {mode:o}");
        return Finding::change(CHECK, found, "nodes cannot write there", "sudo chmod 1777 /dev/shm");
    }
    let mounts = machine.text("/proc/self/mounts").unwrap_or_default();
    let kind = mounts.lines().rev().find_map(|line| {
        let mut fields = line.split(' ');
        (fields.nth(1) == Some("/dev/shm")).then(|| fields.next().map(str::to_owned)).flatten()
    });
    if let Some(kind) = kind.filter(|kind| kind != "tmpfs") {
        let found = format!("/dev/shm is {kind}");
        return Finding::change(CHECK, found, "messages would be written to a disk", mount);
    }
    let free = match channel::free_bytes(&path) {
        Ok(free) => free,
        Err(error) => {
            return Finding::change(CHECK, error.to_string(), "nodes need it for their messages", mount);
        }
    };
    let found = format!("{} MiB free, mode {mode:o}", free >> 20);
    let enlarge = "sudo mount -o remount,size=1G /dev/shm";
    match free {
        free if free < LEAST => {
            Finding::change(CHECK, found, "graphs do not fit; in a container use --shm-size=1g", enlarge)
        }
        free if free < ENOUGH => Finding::note(
            CHECK,
            found,
            format!("enough for small messages; for images: {enlarge}, in a container --shm-size=1g"),
        ),
        _ => Finding::good(CHECK, found),
    }
}

fn stale(machine: &Machine) -> Finding {
    const CHECK: &str = "remains of runs";
    match channel::stale_runs(&machine.path("/dev/shm")) {
        0 => Finding::good(CHECK, "none"),
        count => Finding::note(
            CHECK,
            format!("{count} of runs that were killed"),
            "they take shared memory until the next run starts, which removes them",
        ),
    }
}

fn huge_pages(machine: &Machine) -> Finding {
    const CHECK: &str = "transparent huge pages";
    let path = "/sys/kernel/mm/transparent_hugepage/enabled";
    match machine.text(path) {
        None => Finding::good(CHECK, "the kernel has none"),
        Some(text) if text.contains("[always]") => Finding::change(
            CHECK,
            "always",
            "the kernel puts pages together while nodes run, and stops them for it",
            format!("echo madvise | sudo tee {path}"),
        ),
        Some(text) => {
            let chosen = text.split(['[', ']']).nth(1).unwrap_or(&text).to_owned();
            Finding::good(CHECK, chosen)
        }
    }
}

fn swap(machine: &Machine) -> Finding {
    const CHECK: &str = "swap";
    let path = "/proc/swaps";
    let Some(text) = machine.text(path) else { return Finding::unknown(CHECK, path) };
    match text.lines().count() {
        0 | 1 => Finding::good(CHECK, "none"),
        places => Finding::note(
            CHECK,
            format!("{} in use or ready", places - 1),
            "memory that is not locked may be paged out: run nodes in real time (--fifo), or: sudo swapoff --all",
        ),
    }
}
