//! What a run takes of the machine: too little of it is said at once, and all of it is given back.

use std::time::{Duration, Instant};

use parallax_runtime::channel::ChannelError;
use parallax_runtime::launch::{RunError, RunOptions, run};

use crate::Test;
use crate::nodes::{graph, registry};
use crate::settings::launch;

pub(crate) const TESTS: &[Test] = &[
    ("too_little_shared_memory_is_said_at_once", too_little_shared_memory_is_said_at_once),
    ("memory_that_runs_out_is_missed_before_the_start", memory_that_runs_out_is_missed_before_the_start),
    ("a_thousand_starts_and_stops_leave_nothing_behind", a_thousand_starts_and_stops_leave_nothing_behind),
];

pub(crate) fn free_shared_memory() -> u64 {
    // SAFETY: statvfs is plain integers, for which all zeros are valid; the path is a literal; both outlive the call.
    unsafe {
        let mut answer: libc::statvfs = std::mem::zeroed();
        assert_eq!(libc::statvfs(c"/dev/shm".as_ptr(), &mut answer), 0);
        answer.f_bavail * answer.f_frsize
    }
}

fn too_little_shared_memory_is_said_at_once() {
    // Messages of 64 KiB, and queues of 8192 of them for as many receivers as it takes.
    let mut graph = graph();
    graph.nodes[0].kind = "wide".into();
    graph.nodes[0].rate = 50_000.0;
    graph.nodes[1].kind = "wide_sink".into();
    graph.connections[0].blocking = false;
    let receiver = (graph.nodes[1].clone(), graph.connections[0].clone());
    for number in 0..free_shared_memory() / (8192 * 65_536) + 1 {
        let (mut node, mut connection) = receiver.clone();
        node.name = format!("sink{number}");
        connection.to = node.name.clone();
        graph.nodes.push(node);
        graph.connections.push(connection);
    }
    let start = Instant::now();
    let error = run(&graph, &registry(), RunOptions::default()).unwrap_err();
    assert!(matches!(error, RunError::Channel(ChannelError::Full { .. })), "{error}");
    assert!(error.to_string().contains("enlarge it"), "{error}");
    assert!(start.elapsed() < Duration::from_secs(20), "before anything was started");
}

/// Under this argument this program runs a graph in a machine of its own, as far as shared memory is concerned: 4 MiB of it,
/// which one of the nodes fills while it is built.
pub(crate) const SMALL_COMMAND: &str = "__small";

/// What the command says where a user may not have a machine of its own.
const NOT_PERMITTED: &str = "not permitted";

pub(crate) fn in_small_memory() -> std::process::ExitCode {
    // SAFETY: the calls take integers and literals that outlive them; this process has one thread.
    let permitted = unsafe {
        let none = std::ptr::null();
        (libc::unshare(libc::CLONE_NEWNS) == 0 || libc::unshare(libc::CLONE_NEWUSER | libc::CLONE_NEWNS) == 0)
            && libc::mount(none, c"/".as_ptr(), none, libc::MS_REC | libc::MS_PRIVATE, none.cast()) == 0
            && libc::mount(
                c"tmpfs".as_ptr(),
                c"/dev/shm".as_ptr(),
                c"tmpfs".as_ptr(),
                0,
                c"size=4m,mode=777".as_ptr().cast(),
            ) == 0
    };
    if !permitted {
        println!("{NOT_PERMITTED}");
        return std::process::ExitCode::SUCCESS;
    }
    let mut graph = graph();
    graph.nodes[0].kind = "hog".into();
    // A queue of some 600 KB.
    graph.nodes[0].rate = 5000.0;
    match run(&graph, &registry(), RunOptions { duration: Some(100_000_000), ..RunOptions::default() }) {
        Err(error) => println!("{error}"),
        Ok(report) => println!("{report:?}"),
    }
    std::process::ExitCode::SUCCESS
}

/// Shared memory that somebody fills just before the start is missed then, and not in the middle of a step.
fn memory_that_runs_out_is_missed_before_the_start() {
    let output = std::process::Command::new("/proc/self/exe").arg(SMALL_COMMAND).output().unwrap();
    let said = String::from_utf8(output.stdout).unwrap() + &String::from_utf8(output.stderr).unwrap();
    println!("  {}", said.lines().next().unwrap_or_default());
    assert!(output.status.success(), "{said}");
    assert!(said.starts_with(NOT_PERMITTED) || said.contains("enlarge it"), "{said}");
}

/// Descriptors, threads and children of this process.
fn held() -> (usize, usize, usize) {
    let count = |folder: &str| std::fs::read_dir(folder).unwrap().count();
    let children =
        std::fs::read_to_string(format!("/proc/self/task/{}/children", std::process::id())).unwrap();
    (count("/proc/self/fd"), count("/proc/self/task"), children.split_whitespace().count())
}

/// Runs of a graph, so many at a time.
const RUNS: usize = 1000;
const SIDE_BY_SIDE: usize = 8;

/// Starts and stops a graph: of 50 runs 24 have threads and 26 processes; of these one is recorded, and in one a node is killed
/// and comes back.
fn start_and_stop(number: usize, folder: &std::path::Path) {
    let mut spec = graph();
    let mut settings = "";
    let mut options = RunOptions { duration: Some(10_000_000), ..RunOptions::default() };
    match number % 50 {
        0 => options.recording = Some(folder.join(format!("{number}.mcap"))),
        25 => {
            spec = crate::nodes::troubled("kill", 1);
            let once = folder.join(format!("{number}.once"));
            spec.nodes[0].parameters.insert("once".into(), once.to_str().unwrap().into());
            settings = "[node.counter]\nrestart = \"on-failure\"\nrestart_delay = 0.001\n";
            options.duration = Some(200_000_000);
        }
        other if other % 2 == 1 => settings = "[defaults]\nrun_as = \"thread\"\n",
        _ => {}
    }
    options.launch = launch(settings);
    let report = run(&spec, &registry(), options).unwrap();
    assert_eq!(report.failure(), None, "{report:?}");
    if number % 50 == 25 {
        // On a busy machine the run may be over before the node is back, but not before it was killed.
        assert!(folder.join(format!("{number}.once")).exists(), "{report:?}");
    } else {
        assert!(report.clean(), "{report:?}");
    }
}

fn a_thousand_starts_and_stops_leave_nothing_behind() {
    let folder = tempfile::tempdir().unwrap();
    // What is made once and kept is made by the first of each kind.
    [0, 1, 2, 25].into_iter().for_each(|number| start_and_stop(number, folder.path()));
    for entry in std::fs::read_dir(folder.path()).unwrap() {
        std::fs::remove_file(entry.unwrap().path()).unwrap();
    }
    let (before, start) = ((held(), crate::nodes::shared_memory()), Instant::now());
    let next = std::sync::atomic::AtomicUsize::new(0);
    std::thread::scope(|scope| {
        for _ in 0..SIDE_BY_SIDE {
            scope.spawn(|| {
                loop {
                    let number = next.fetch_add(1, std::sync::atomic::Ordering::Relaxed);
                    if number >= RUNS {
                        break;
                    }
                    start_and_stop(number, folder.path());
                }
            });
        }
    });
    println!("  {RUNS} runs in {:.1} s", start.elapsed().as_secs_f64());
    // A thread that has been waited for may be seen for a moment more.
    let after = Instant::now();
    while (held(), crate::nodes::shared_memory()) != before && after.elapsed() < Duration::from_secs(2) {
        std::thread::sleep(Duration::from_millis(10));
    }
    assert_eq!((held(), crate::nodes::shared_memory()), before);
    // What was recorded, and the marks of nodes that were killed once: nothing beside them.
    let mut files: Vec<String> = std::fs::read_dir(folder.path())
        .unwrap()
        .map(|entry| entry.unwrap().file_name().to_string_lossy().into_owned())
        .collect();
    let mut expected: Vec<String> = (0..RUNS)
        .filter_map(|number| match number % 50 {
            0 => Some(format!("{number}.mcap")),
            25 => Some(format!("{number}.once")),
            _ => None,
        })
        .collect();
    files.sort();
    expected.sort();
    assert_eq!(files, expected);
}
