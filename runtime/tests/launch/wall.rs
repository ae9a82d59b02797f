//! The wall clock of the machine is set forward or back by an hour in the middle of a run, and nothing happens.
//!
//! To set the clock of the machine that runs the tests would be rude, and mostly forbidden. Instead this program brings its
//! own `clock_gettime`, which the standard library and the transport then call: in processes that are told to, the wall
//! clock jumps in the middle of the run.

use std::process::{Command, ExitCode, Stdio};
use std::sync::atomic::{AtomicI64, Ordering};
use std::time::{SystemTime, UNIX_EPOCH};

use parallax_runtime::clock::monotonic;
use parallax_runtime::launch::{Progress, RunOptions, run};
use parallax_runtime::node::{Node, NodeError, Step};
use parallax_runtime::recording::Recording;
use parallax_runtime::time::Nanos;

use crate::Test;
use crate::nodes::{Number, graph, registry};
use crate::runs::options;

pub(crate) const TESTS: &[Test] = &[("the_wall_clock_may_jump_by_an_hour", the_wall_clock_may_jump)];

const HOUR: i64 = 3600;
/// By how many seconds the wall clock jumps.
const JUMP: &str = "TEST_WALL_CLOCK_JUMP";
/// The step at which it does, and the time at which the launcher's does.
const STEP: u64 = 60;
const TIME: Nanos = 300_000_000;
/// When it jumps in this process, on the monotonic clock.
static AT: AtomicI64 = AtomicI64::new(i64::MAX);
static BY: AtomicI64 = AtomicI64::new(0);

/// In place of the C library's.
///
/// # Safety
///
/// As that one: `time` points to a timespec that can be written.
#[unsafe(no_mangle)]
unsafe extern "C" fn clock_gettime(clock: libc::clockid_t, time: *mut libc::timespec) -> libc::c_int {
    // SAFETY: the arguments are passed on as they came, and `time` can be written, says the caller.
    unsafe {
        let result = libc::syscall(libc::SYS_clock_gettime, clock, time);
        let by = BY.load(Ordering::Relaxed);
        if result == 0 && by != 0 && clock == libc::CLOCK_REALTIME {
            let mut now = libc::timespec { tv_sec: 0, tv_nsec: 0 };
            libc::syscall(libc::SYS_clock_gettime, libc::CLOCK_MONOTONIC, &mut now);
            if now.tv_sec * 1_000_000_000 + now.tv_nsec >= AT.load(Ordering::Relaxed) {
                (*time).tv_sec += by;
            }
        }
        result as libc::c_int
    }
}

/// Lets the wall clock of this process jump, if it is told to.
pub(crate) fn obey() {
    if let Ok(by) = std::env::var(JUMP) {
        BY.store(by.parse().unwrap(), Ordering::Relaxed);
    }
}

/// Now.
fn jump() {
    AT.store(monotonic(), Ordering::Relaxed);
}

fn wall() -> f64 {
    SystemTime::now().duration_since(UNIX_EPOCH).unwrap().as_secs_f64()
}

/// Sends what the wall clock shows.
pub(crate) struct Wall;

impl Node for Wall {
    type Output = Number<f64>;

    fn step(&mut self, step: &Step<'_>) -> Result<Number<f64>, NodeError> {
        if step.seq == STEP {
            jump();
        }
        Ok(Number { value: wall() })
    }
}

/// Under this argument this program is a launcher of nodes one of which sends the wall clock: `RECORDING`.
pub(crate) const COMMAND: &str = "__jumping";

pub(crate) fn jumping(mut arguments: impl Iterator<Item = String>) -> ExitCode {
    let path = std::path::PathBuf::from(arguments.next().unwrap());
    let mut graph = graph();
    graph.nodes[0].kind = "wall".into();
    let mut jumped = false;
    let progress = move |progress: Progress| {
        if progress.elapsed > TIME && !jumped {
            jumped = true;
            jump();
        }
        true
    };
    let options = RunOptions { real_time: true, progress: Some(Box::new(progress)), ..options(1.0, &path) };
    let report = run(&graph, &registry(), options).unwrap();
    let undisturbed = report.clean() && report.events.is_empty() && report.duration == 1_000_000_000;
    if undisturbed { ExitCode::SUCCESS } else { panic!("{report:#?}") }
}

fn the_wall_clock_may_jump() {
    for by in [HOUR, -HOUR] {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("run.mcap");
        let status = Command::new("/proc/self/exe")
            .args([COMMAND, path.to_str().unwrap()])
            .env(JUMP, by.to_string())
            .stdin(Stdio::null())
            .status()
            .unwrap();
        assert!(status.success());
        let recording = Recording::read(&path).unwrap();
        let track = &recording.nodes[0];
        // The wall clock did jump, once.
        let shown: Vec<f64> = track.messages.iter().map(|message| message.payload[0]).collect();
        let jumps: Vec<f64> =
            shown.windows(2).map(|pair| pair[1] - pair[0]).filter(|step| step.abs() > 60.0).collect();
        assert!(matches!(jumps[..], [jump] if (jump - by as f64).abs() < 5.0), "{jumps:?}");
        // And the run did not: every tick has its step, in order and in its place.
        assert!((100..=200).contains(&track.steps.len()), "{}", track.steps.len());
        for (k, step) in track.steps.iter().enumerate() {
            assert_eq!((step.seq, step.due), (k as u64, k as i64 * 5_000_000));
            assert!(step.due <= step.start && step.start <= step.end && step.end < 2_000_000_000);
        }
        assert!(recording.losses.is_empty() && recording.nodes[1].steps.len() >= 50);
    }
}
