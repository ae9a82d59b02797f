//! The nodes of these tests, their graphs, and a look into shared memory.

use std::collections::BTreeSet;

use parallax_model::tree::Tree;
use parallax_runtime::graph::{ConnectionSpec, GraphSpec, NodeSpec};
use parallax_runtime::node::{Layout, Message, Node, NodeError, Port, Step, Stopping};
use parallax_runtime::registry::{NodeKind, Registry};

/// One number.
#[derive(Tree, Clone, Default)]
pub(crate) struct Number<T> {
    pub(crate) value: T,
}

impl Message for Number<f64> {
    const NAME: &'static str = "test/Number";
}

pub(crate) const SOURCE: Port<Number<f64>> = Port::new("source");

/// Sends the number of its step, and does what its parameters say at one of them.
struct Counter {
    trouble: Trouble,
}

#[derive(serde::Deserialize, Default)]
#[serde(deny_unknown_fields, default)]
struct Trouble {
    /// Step at which something happens; none by default.
    at: Option<u64>,
    /// Whether it happens at every step from then on.
    lasting: bool,
    /// A file that says that it has happened already, and that it is not to happen again.
    once: Option<std::path::PathBuf>,
    /// What happens: "kill", "exit", "leave", "panic", "error", "hang", "slow", "nan".
    what: String,
}

impl Trouble {
    /// What happens at this step; gives a value to send in place of the usual one.
    fn strike(&self, step: u64) -> Result<Option<f64>, NodeError> {
        let strikes = self.at.is_some_and(|at| at == step || (self.lasting && step > at));
        if !strikes {
            return Ok(None);
        }
        if let Some(once) = &self.once {
            if once.exists() {
                return Ok(None);
            }
            std::fs::write(once, "").unwrap();
        }
        match &*self.what {
            // SAFETY: the call takes an integer and ends this process, which is what the test wants.
            "kill" => unsafe {
                libc::raise(libc::SIGKILL);
            },
            "exit" => std::process::exit(3),
            "leave" => std::process::exit(0),
            "panic" => panic!("the test wants it"),
            "error" => return Err(NodeError::failed("the motor is on fire")),
            "hang" => std::thread::sleep(std::time::Duration::from_secs(3600)),
            "slow" => std::thread::sleep(std::time::Duration::from_millis(60)),
            "nan" => return Ok(Some(f64::NAN)),
            other => panic!("unknown trouble {other}"),
        }
        Ok(None)
    }
}

impl Node for Counter {
    type Output = Number<f64>;

    fn step(&mut self, step: &Step<'_>) -> Result<Number<f64>, NodeError> {
        let value = self.trouble.strike(step.seq)?;
        Ok(Number { value: value.unwrap_or(step.seq as f64) })
    }
}

/// Sends the newest number of its source plus one; -1 before any has come.
struct Adder {
    trouble: Trouble,
}

impl Node for Adder {
    type Output = Number<f64>;

    fn step(&mut self, step: &Step<'_>) -> Result<Number<f64>, NodeError> {
        self.trouble.strike(step.seq)?;
        let latest = step.latest(SOURCE);
        Ok(Number { value: if latest.seq.is_some() { latest.message.value + 1.0 } else { -1.0 } })
    }
}

/// Writes into a file what it would tell its motor: a driver, as far as these tests are concerned.
struct Driver {
    log: std::fs::File,
    trouble: Trouble,
}

#[derive(serde::Deserialize)]
#[serde(deny_unknown_fields)]
struct Driven {
    log: std::path::PathBuf,
    #[serde(default)]
    trouble: Trouble,
}

impl Driver {
    fn tell(&mut self, what: &str) {
        use std::io::Write;
        writeln!(self.log, "{what}").unwrap();
    }
}

impl Node for Driver {
    type Output = Number<f64>;

    fn step(&mut self, step: &Step<'_>) -> Result<Number<f64>, NodeError> {
        self.trouble.strike(step.seq)?;
        let value = step.latest(SOURCE).message.value;
        self.tell(&format!("drive {value}"));
        Ok(Number { value })
    }

    fn stop(&mut self, why: Stopping) {
        self.tell(&format!("stop {why:?}"));
    }
}

/// Sends a number that only its environment holds.
struct Secret(f64);

impl Node for Secret {
    type Output = Number<f64>;

    fn step(&mut self, _: &Step<'_>) -> Result<Number<f64>, NodeError> {
        Ok(Number { value: self.0 })
    }
}

/// Says where it runs, one thing a step: the adder takes messages of one number.
struct Where;

impl Node for Where {
    type Output = Number<f64>;

    fn step(&mut self, step: &Step<'_>) -> Result<Number<f64>, NodeError> {
        let status = std::fs::read_to_string("/proc/thread-self/status").unwrap();
        let field = |name: &str| {
            let line = status.lines().find_map(|line| line.strip_prefix(name)).unwrap();
            line.trim_start_matches(':').trim().to_owned()
        };
        // SAFETY: the calls take integers and a pointer to a local that outlives them.
        let (core, policy, parameters) = unsafe {
            let mut parameters = libc::sched_param { sched_priority: 0 };
            libc::sched_getparam(0, &mut parameters);
            (libc::sched_getcpu(), libc::sched_getscheduler(0) & !libc::SCHED_RESET_ON_FORK, parameters)
        };
        let list = field("Cpus_allowed_list");
        let alone = !list.contains([',', '-']);
        let locked = field("VmLck").trim_end_matches("kB").trim().parse::<u64>().unwrap() > 0;
        Ok(Number {
            value: match step.seq % 6 {
                0 => f64::from(std::process::id()),
                1 => f64::from(core),
                2 => f64::from(u8::from(alone)),
                3 => f64::from(policy),
                4 => f64::from(parameters.sched_priority),
                _ => f64::from(u8::from(locked)),
            },
        })
    }
}

/// What a node of kind `place` said of itself.
#[derive(Debug)]
pub(crate) struct Place {
    pub(crate) process: f64,
    pub(crate) core: f64,
    pub(crate) alone: bool,
    pub(crate) policy: f64,
    pub(crate) priority: f64,
    pub(crate) locked: bool,
}

pub(crate) fn place_of(recording: &std::path::Path, node: &str) -> Place {
    let recording = parallax_runtime::recording::Recording::read(recording).unwrap();
    let messages = &recording.node(node).unwrap().messages;
    let said = |which: u64| messages.iter().find(|message| message.seq % 6 == which).unwrap().payload[0];
    Place {
        process: said(0),
        core: said(1),
        alone: said(2) == 1.0,
        policy: said(3),
        priority: said(4),
        locked: said(5) == 1.0,
    }
}

pub(crate) const SECRET: &str = "TEST_NODE_SECRET";

pub(crate) fn registry() -> Registry {
    #[cfg(feature = "conformance")]
    let known = parallax_runtime::conformance::registry();
    #[cfg(not(feature = "conformance"))]
    let known = Registry::new();
    crate::programs::kinds(crate::data::kinds(known))
        .with("counter", NodeKind::new(|context| Ok(Counter { trouble: context.parameters()? })))
        .with("wall", NodeKind::new(|_| Ok(crate::wall::Wall)))
        .with("place", NodeKind::new(|_| Ok(Where)))
        .with(
            "sleepy",
            NodeKind::new(|_| {
                std::thread::sleep(std::time::Duration::from_secs(600));
                Ok(Where)
            }),
        )
        .with(
            "tardy",
            NodeKind::new(|_| {
                std::thread::sleep(std::time::Duration::from_millis(500));
                Ok(Where)
            }),
        )
        .with("adder", NodeKind::new(|context| Ok(Adder { trouble: context.parameters()? })).input(SOURCE))
        .with(
            "driver",
            NodeKind::new(|context| {
                let Driven { log, trouble } = context.parameters()?;
                let log = std::fs::OpenOptions::new().append(true).create(true).open(log);
                let log = log.map_err(|error| NodeError::failed(error.to_string()))?;
                Ok(Driver { log, trouble })
            })
            .input(SOURCE),
        )
        .with(
            "secret",
            NodeKind::new(|_| {
                let value = std::env::var(SECRET).ok().and_then(|text| text.parse().ok());
                Ok(Secret(value.ok_or_else(|| NodeError::failed("no secret was passed"))?))
            }),
        )
        .with(
            "hog",
            NodeKind::new(|_| {
                // Other programs use shared memory, too. This one leaves enough to begin with.
                let mut file = std::fs::File::create("/dev/shm/hog").unwrap();
                while crate::resources::free_shared_memory() > 300_000 {
                    std::io::Write::write_all(&mut file, &[1; 4096]).unwrap();
                }
                Ok(Counter { trouble: Trouble::default() })
            }),
        )
        .with("wide", NodeKind::erased(wide(), vec![0.0; 8192], |_| Err(NodeError::failed("never built"))))
        .with(
            "wide_sink",
            NodeKind::erased(wide(), vec![0.0; 8192], |_| Err(NodeError::failed("never built")))
                .input_with_layout("source", wide()),
        )
        .with("allocations", NodeKind::new(|_| Ok(crate::allocation::Counted::default())).input(SOURCE))
        .with(
            "unbuildable",
            NodeKind::new(|_| -> Result<Adder, NodeError> {
                Err(NodeError::failed("the camera is not plugged in"))
            }),
        )
}

/// A message of 64 KiB.
fn wide() -> Layout {
    Layout { name: "test/Wide".into(), leaves: (0..8192).map(|leaf| format!("leaf{leaf}")).collect() }
}

/// A counter at 200 Hz, and an adder at 100 Hz that waits for it.
pub(crate) fn graph() -> GraphSpec {
    let mut connection = ConnectionSpec::new("counter", "adder");
    connection.port = Some("source".into());
    connection.blocking = true;
    connection.window = 2;
    GraphSpec {
        name: "counting".into(),
        supervisor: "adder".into(),
        nodes: vec![NodeSpec::new("counter", "counter", 200.0), NodeSpec::new("adder", "adder", 100.0)],
        connections: vec![connection],
        plant: None,
    }
}

/// [`graph`], and something happens to its counter at a step.
pub(crate) fn troubled(what: &str, at: u64) -> GraphSpec {
    let mut graph = graph();
    let parameters = &mut graph.node_mut("counter").unwrap().parameters;
    parameters.insert("what".into(), what.into());
    parameters.insert("at".into(), at.into());
    graph
}

/// A counter at 200 Hz that commands a driver at 100 Hz, which goes on without it and writes to this file.
pub(crate) fn driving(log: &std::path::Path) -> GraphSpec {
    let mut graph = graph();
    graph.supervisor = "driver".into();
    graph.nodes[1] = NodeSpec::new("driver", "driver", 100.0);
    graph.nodes[1].parameters.insert("log".into(), log.to_str().unwrap().into());
    graph.nodes[1].on_dead_sender = parallax_runtime::graph::OnDeadSender::Continue;
    graph.connections[0].to = "driver".into();
    graph.connections[0].blocking = false;
    graph.connections[0].window = 1;
    graph
}

/// What of Parallax lies in shared memory.
pub(crate) fn shared_memory() -> BTreeSet<String> {
    let mut found = BTreeSet::new();
    for folder in std::fs::read_dir("/dev/shm").unwrap().flatten() {
        let name = folder.file_name().to_string_lossy().into_owned();
        if name.starts_with("parallax-") {
            for run in std::fs::read_dir(folder.path()).into_iter().flatten().flatten() {
                found.insert(format!("{name}/{}", run.file_name().to_string_lossy()));
            }
        } else if name.starts_with("plx") {
            found.insert(name);
        }
    }
    // The lock under which runs are made stays; a run of somebody else at the same time is not ours to judge.
    found.retain(|name| !name.ends_with("/guard") && name.contains(&format!("{}-", std::process::id())));
    found
}
