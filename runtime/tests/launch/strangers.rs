//! Nobody else gets in: what a run makes is its owner's alone, whatever its umask; and what the owner's own programs may not
//! do, they cannot.

use std::collections::BTreeSet;
use std::os::unix::fs::{FileExt, FileTypeExt, MetadataExt, PermissionsExt};
use std::os::unix::net::UnixStream;
use std::os::unix::process::CommandExt;
use std::path::{Path, PathBuf};
use std::process::{Command, ExitCode};
use std::sync::{Arc, Mutex};

use parallax_runtime::channel::{ChannelError, Endpoint, Space, Topic};
use parallax_runtime::launch::{End, Exit, LaunchSpec, Mode, RunError, RunOptions, RunReport, run};
use parallax_runtime::node::Layout;
use parallax_runtime::recording::Recording;

use crate::Test;
use crate::nodes::{Number, graph, registry};
use crate::runs::options;

pub(crate) const TESTS: &[Test] = &[
    ("others_find_everything_closed", others_find_everything_closed),
    ("a_group_gets_the_recording_and_nothing_else", a_group_gets_the_recording),
    ("a_second_publisher_is_refused", a_second_publisher_is_refused),
    ("made_up_lengths_and_counts_end_nobody", made_up_lengths_and_counts_end_nobody),
];

/// The argument under which this program is somebody else.
pub(crate) const STRANGER_COMMAND: &str = "__stranger";
/// Nobody: neither this user nor one of its groups.
const NOBODY: u32 = 65534;

/// Tries all doors, and prints those that open.
pub(crate) fn stranger(paths: impl Iterator<Item = String>) -> ExitCode {
    for path in paths {
        let file = Path::new(&path);
        let open = |write: bool| std::fs::File::options().read(!write).write(write).open(file).is_ok();
        let tries = [
            ("read", open(false)),
            ("write", open(true)),
            ("list", std::fs::read_dir(file).is_ok()),
            ("enter", std::fs::metadata(file.join(".")).is_ok()),
            ("put a file", std::fs::write(file.join("stranger"), "").is_ok()),
            ("connect", UnixStream::connect(file).is_ok()),
            // What a publisher does first.
            ("publish", Space::attach(file).and_then(|space| Endpoint::new(&space).map(drop)).is_ok()),
            ("remove", std::fs::remove_file(file).is_ok()),
        ];
        tries.iter().filter(|(_, done)| *done).for_each(|(what, _)| println!("{what} {path}"));
    }
    ExitCode::SUCCESS
}

/// What nobody can do with these.
fn as_nobody(paths: &[PathBuf]) -> BTreeSet<String> {
    let output = Command::new("/proc/self/exe")
        .arg(STRANGER_COMMAND)
        .args(paths)
        .uid(NOBODY)
        .gid(NOBODY)
        .current_dir("/")
        .output()
        .unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    String::from_utf8(output.stdout).unwrap().lines().map(str::to_owned).collect()
}

fn user() -> u32 {
    // SAFETY: geteuid takes no arguments, cannot fail and touches no memory of ours.
    unsafe { libc::geteuid() }
}

/// Takes nothing away from new files, or this, as long as it lives.
struct Umask(libc::mode_t);

impl Umask {
    fn set(mask: libc::mode_t) -> Self {
        // SAFETY: the call takes an integer and cannot fail. Tests of this program run one after the other.
        Self(unsafe { libc::umask(mask) })
    }
}

impl Drop for Umask {
    fn drop(&mut self) {
        // SAFETY: as above.
        unsafe { libc::umask(self.0) };
    }
}

/// The directory of the run whose launcher this process is.
fn run_directory() -> PathBuf {
    let base = PathBuf::from(format!("/dev/shm/parallax-{}", user()));
    let ours = format!("{}-", std::process::id());
    let entries = std::fs::read_dir(base).unwrap().flatten().map(|entry| entry.path());
    let mut runs = entries
        .filter(|path| path.is_dir() && path.file_name().unwrap().to_string_lossy().starts_with(&ours));
    runs.next().expect("the run has a directory")
}

/// Everything that a run has made.
fn everything(run: &Path, recording: &Path) -> Vec<PathBuf> {
    let base = run.parent().unwrap();
    let mut found =
        vec![base.to_owned(), base.join("guard"), run.with_extension("lock"), recording.to_owned()];
    let mut folders = vec![run.to_owned()];
    while let Some(folder) = folders.pop() {
        for entry in std::fs::read_dir(&folder).unwrap().flatten() {
            if entry.file_type().unwrap().is_dir() {
                folders.push(entry.path());
            } else {
                found.push(entry.path());
            }
        }
        found.push(folder);
    }
    let prefix = format!("plx{}_{}_", user(), run.file_name().unwrap().to_string_lossy());
    let segments = std::fs::read_dir("/dev/shm").unwrap().flatten().map(|entry| entry.path());
    found.extend(segments.filter(|path| path.file_name().unwrap().to_string_lossy().starts_with(&prefix)));
    found
}

/// Runs the graph with a recording; while it runs, `look` gets its directory. Then it is stopped.
fn looked_at<T: Send + 'static>(
    path: &Path,
    launch: LaunchSpec,
    mode: Mode,
    look: impl Fn(&Path) -> T + Send + 'static,
) -> (RunReport, T) {
    let seen = Arc::new(Mutex::new(None));
    let kept = seen.clone();
    let progress = move |progress: parallax_runtime::launch::Progress| {
        if progress.elapsed < 100_000_000 {
            return true;
        }
        *kept.lock().unwrap() = Some(look(&run_directory()));
        false
    };
    let options =
        RunOptions { duration: None, launch, mode, progress: Some(Box::new(progress)), ..options(1.0, path) };
    let report = run(&graph(), &registry(), options).unwrap();
    let seen = seen.lock().unwrap().take().expect("it was looked at");
    (report, seen)
}

fn others_find_everything_closed() {
    for (umask, mode) in [(0, Mode::Processes), (0o027, Mode::Processes), (0, Mode::Threads)] {
        let _umask = Umask::set(umask);
        let folder = tempfile::tempdir().unwrap();
        std::fs::set_permissions(folder.path(), PermissionsExt::from_mode(0o755)).unwrap();
        let path = folder.path().join("run.mcap");
        let open = folder.path().join("open");
        std::fs::write(&open, "").unwrap();
        std::fs::set_permissions(&open, PermissionsExt::from_mode(0o644)).unwrap();
        // One that others could read before is closed to them.
        std::fs::write(&path, "").unwrap();
        std::fs::set_permissions(&path, PermissionsExt::from_mode(0o666)).unwrap();

        let (recording, control) = (path.clone(), open.clone());
        let (report, (paths, got)) = looked_at(&path, LaunchSpec::default(), mode, move |run| {
            let paths = everything(run, &recording);
            let (mut sockets, mut segments) = (0, 0);
            for path in &paths {
                // What comes and goes meanwhile is not there to be looked at.
                let Ok(metadata) = std::fs::symlink_metadata(path) else { continue };
                let (kind, mode) = (metadata.file_type(), metadata.mode() & 0o7777);
                assert_eq!((mode & 0o077, metadata.uid()), (0, user()), "{path:?} has {mode:o}");
                let all = if kind.is_dir() { 0o700 } else { 0o600 };
                assert!(mode == all || (!kind.is_dir() && mode == 0o400), "{path:?} has {mode:o}");
                sockets += u32::from(kind.is_socket());
                segments += u32::from(path.starts_with("/dev/shm") && kind.is_file());
            }
            assert!(sockets >= 1 && segments > 10, "{paths:?}");
            let got = (user() == 0).then(|| as_nobody(&[paths.clone(), vec![control.clone()]].concat()));
            (paths, got)
        });
        assert!(report.clean(), "{report:#?}");
        assert!(Recording::read(&path).unwrap().duration > 0, "its owner can read it");
        match got {
            // The stranger does try: what is open to it, it gets.
            Some(got) => assert_eq!(got, BTreeSet::from([format!("read {}", open.display())])),
            None => println!(
                "  not root: {} modes and owners were looked at, nobody was asked to try",
                paths.len()
            ),
        }
    }
}

fn a_group_gets_the_recording() {
    let folder = tempfile::tempdir().unwrap();
    std::fs::set_permissions(folder.path(), PermissionsExt::from_mode(0o755)).unwrap();
    let path = folder.path().join("run.mcap");
    // SAFETY: getegid takes no arguments, cannot fail and touches no memory of ours.
    let group = if user() == 0 { NOBODY } else { unsafe { libc::getegid() } };
    let launch = |group: &str| LaunchSpec { group: Some(group.into()), ..LaunchSpec::default() };
    let recording = path.clone();
    let (_, got) = looked_at(&path, launch(&group.to_string()), Mode::Processes, move |run| {
        let metadata = std::fs::metadata(&recording).unwrap();
        assert_eq!((metadata.mode() & 0o7777, metadata.gid()), (0o660, group));
        (user() == 0).then(|| as_nobody(&everything(run, &recording)))
    });
    if let Some(got) = got {
        let path = path.display();
        assert_eq!(got, BTreeSet::from([format!("read {path}"), format!("write {path}")]));
    }
    let unknown = folder.path().join("unknown.mcap");
    let options = RunOptions { launch: launch("no such group"), ..options(0.1, &unknown) };
    let error = run(&graph(), &registry(), options).unwrap_err();
    assert!(matches!(&error, RunError::Group { group, .. } if group == "no such group"), "{error}");
    assert!(!unknown.exists());
}

/// Whoever belongs to the same user can look into the run's memory, but a node's topic has one publisher.
fn a_second_publisher_is_refused() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("run.mcap");
    let (report, errors) = looked_at(&path, LaunchSpec::default(), Mode::Processes, |run| {
        let space = Space::attach(run).unwrap();
        let here = Endpoint::new(&space).unwrap();
        let topic = |layout: u64, buffer: usize| Topic {
            name: "counter".into(),
            layout,
            words: 3,
            buffer,
            subscribers: 1,
            held: 0,
        };
        let layout = Layout::of::<Number<f64>>().hash();
        let second = here.open(&topic(layout, 8)).and_then(|service| service.publisher().map(drop));
        let other = here.open(&topic(layout + 1, 8)).map(drop);
        [second.unwrap_err(), other.unwrap_err()]
    });
    assert!(matches!(&errors[0], ChannelError::Transport { topic, .. } if topic == "counter"), "{errors:?}");
    assert!(matches!(&errors[1], ChannelError::Layout { topic, .. } if topic == "counter"), "{errors:?}");
    assert!(report.clean(), "{report:#?}");
}

/// A program of the same user writes into the messages and the pages of a running graph: lengths, numbers, times, counts.
fn made_up_lengths_and_counts_end_nobody() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("run.mcap");
    let (report, made_up) = looked_at(&path, LaunchSpec::default(), Mode::Processes, |run| {
        let prefix = format!("plx{}_{}_", user(), run.file_name().unwrap().to_string_lossy());
        let segments = std::fs::read_dir("/dev/shm").unwrap().flatten().filter(|entry| {
            let name = entry.file_name();
            let name = name.to_string_lossy();
            name.starts_with(&prefix) && name.ends_with(".data")
        });
        let open = |path: &Path| std::fs::File::options().read(true).write(true).open(path).unwrap();
        let segments: Vec<std::fs::File> = segments.map(|entry| open(&entry.path())).collect();
        let pages =
            ["counter.vitals", "counter.inputs0", "adder.inputs0", "adder.delay0", "counter.lateness"];
        let pages: Vec<std::fs::File> =
            pages.iter().filter(|name| run.join(name).exists()).map(|name| open(&run.join(name))).collect();
        assert!(segments.len() >= 4 && pages.len() >= 4, "{segments:?} {pages:?}");
        let wild = [u64::MAX, u64::MAX / 8, 1 << 40, 1 << 62, 1 << 63, 4, 5];
        let (mut made_up, start) = (0, std::time::Instant::now());
        while start.elapsed() < std::time::Duration::from_millis(400) {
            for segment in &segments {
                let length = segment.metadata().unwrap().len() as usize;
                let mut bytes = vec![0; length];
                segment.read_exact_at(&mut bytes, 0).unwrap();
                let words: Vec<u64> =
                    bytes.chunks_exact(8).map(|word| u64::from_ne_bytes(word.try_into().unwrap())).collect();
                // A message: its length, 0, its number, and when it was sent.
                for (at, message) in words.windows(4).enumerate() {
                    if message[0] == 3 && message[1] == 0 && message[2] < 10_000 && message[3] > 0 {
                        let word = wild[made_up % wild.len()].to_ne_bytes();
                        // Its length, its number or its time.
                        let place = at + [0, 2, 3, 0, 0][made_up % 5];
                        segment.write_all_at(&word, place as u64 * 8).unwrap();
                        made_up += 1;
                    }
                }
            }
            for (number, page) in pages.iter().enumerate() {
                let cell = (made_up * 7 + number) % 14;
                page.write_all_at(&wild[made_up % wild.len()].to_ne_bytes(), cell as u64 * 8).unwrap();
            }
        }
        made_up
    });
    // What it says of the messages may be anything; everybody is there until the end, and says so.
    assert!(made_up > 50, "{made_up}");
    assert!(report.nodes.iter().all(|node| node.exit == Exit::Clean), "{report:#?}");
    assert_eq!(report.end, End::Signal);
    let recording = Recording::read(&path).unwrap();
    assert_eq!(recording.truncated, None);
    assert!(recording.nodes.iter().all(|track| track.steps.len() > 5));
}
