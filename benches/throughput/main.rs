//! Supervisor steps per second on one core: ours, the peers' and the limit, in one run.
//!
//! ```text
//! benches/peers/install
//! cargo bench --bench throughput [-- --envs 1,128,1024 --peers DIR --json FILE --markdown FILE --plot FILE]
//! ```
//!
//! The work is the same for all: the pendulum of the paper's appendix C (and the quadrotor of appendix D), Runge–Kutta
//! steps at 100 Hz under a supervisor at 50 Hz, episodes of 20 s, actions drawn beforehand, parameters of its own for
//! every environment, 20 different schedules where there are delays. `docs/performance.md` says more.

mod draws;
mod graphs;
mod handwritten;
mod line;
mod native;
mod peers;
mod table;

use std::io::Write as _;
use std::path::PathBuf;
use std::process::Command;

use anyhow::Context;
use clap::Parser;

use line::{Line, Timing};

/// Supervisor steps per second: ours, the peers' and the limit.
#[derive(Parser)]
struct Options {
    /// Environments at once.
    #[arg(long, value_delimiter = ',', default_value = "1,128,1024")]
    envs: Vec<usize>,
    /// Folder of the peers' virtual environments [default: $PARALLAX_PEERS, else target/peers].
    #[arg(long)]
    peers: Option<PathBuf>,
    /// The parts to run, by name: native, clock, bare, growth, or a peer's script [default: all].
    #[arg(long, value_delimiter = ',')]
    only: Vec<String>,
    /// Precisions that scripts on JAX run.
    #[arg(long, default_value = "f32,f64")]
    dtype: String,
    /// Repetitions of each measurement.
    #[arg(long, default_value_t = 7)]
    repeats: usize,
    /// Least seconds of one repetition.
    #[arg(long, default_value_t = 0.3)]
    seconds: f64,
    /// The core.
    #[arg(long, default_value_t = 0)]
    core: usize,
    /// Runs the scripts on JAX on a GPU; everything else is left out.
    #[arg(long)]
    gpu: bool,
    /// Writes every measurement to this file, one JSON object a line.
    #[arg(long)]
    json: Option<PathBuf>,
    /// Reads measurements from such a file instead of making them.
    #[arg(long, conflicts_with = "json")]
    from: Option<PathBuf>,
    /// Writes the report to this file, too.
    #[arg(long)]
    markdown: Option<PathBuf>,
    /// Draws the report with the Matplotlib of the peer `jax`.
    #[arg(long)]
    plot: Option<PathBuf>,
    /// What cargo passes to benches.
    #[arg(long, hide = true)]
    bench: bool,
}

impl Options {
    fn wants(&self, part: &str) -> bool {
        self.only.is_empty() || self.only.iter().any(|wanted| wanted == part)
    }
}

fn main() -> anyhow::Result<()> {
    let options = Options::parse();
    let folder = options.peers.clone().unwrap_or_else(peers::default_folder);
    let mut lines = match &options.from {
        Some(path) => read(path)?,
        None => measure(&options, &folder)?,
    };
    lines.dedup_by(|a, b| a.value == b.value && a.peer == b.peer && a.amount.is_some() && b.amount.is_some());
    let text = table::text(&lines);
    println!("{text}");
    if let Some(path) = &options.markdown {
        std::fs::write(path, &text).with_context(|| format!("{} cannot be written", path.display()))?;
    }
    if let Some(path) = &options.plot {
        plot(&lines, &folder, path)?;
    }
    Ok(())
}

/// Runs all parts that are wanted.
fn measure(options: &Options, folder: &std::path::Path) -> anyhow::Result<Vec<Line>> {
    // Before any thread starts, so that all of them, and the peers' scripts, inherit it.
    if !options.gpu && !core_affinity::set_for_current(core_affinity::CoreId { id: options.core }) {
        eprintln!("core {} cannot be pinned: figures are not of one core", options.core);
    }
    rayon::ThreadPoolBuilder::new().num_threads(1).build_global()?;
    let timing = Timing { seconds: options.seconds, repeats: options.repeats };
    let mut json = options.json.as_ref().map(std::fs::File::create).transpose()?;
    let mut lines = Vec::new();
    let mut report = |line: Line| {
        if line.amount.is_some() {
            eprintln!("{}: {} {:.4} {}", line.peer, line.value, line.amount.unwrap_or_default(), line.unit);
        } else {
            let (best, median) = (line.best() / 1e6, line.median() / 1e6);
            let Line { peer, case, way, dtype, envs, .. } = &line;
            eprintln!("{peer}: {case} {way} {dtype} {envs}: {best:.3} ({median:.3}) M/s");
        }
        if let Some(file) = &mut json {
            let written = serde_json::to_string(&line).map_err(Into::into);
            let written = written.and_then(|text| writeln!(file, "{text}"));
            if let Err(error) = written {
                eprintln!("the measurements cannot be written: {error}");
            }
        }
        lines.push(line);
    };

    if !options.gpu {
        if options.wants("bare") {
            native::bare(&options.envs, timing, &mut report);
        }
        if options.wants("native") {
            native::batches(&options.envs, timing, &mut report)?;
        }
        if options.wants("clock") {
            native::simulated_clock(timing, &mut report)?;
        }
        if options.wants("growth") {
            native::growth(timing, &mut report)?;
        }
    }
    let envs: Vec<String> = options.envs.iter().map(usize::to_string).collect();
    let mut arguments =
        vec!["--envs".to_owned(), envs.join(","), "--core".to_owned(), options.core.to_string()];
    if options.gpu {
        arguments.extend(["--device".to_owned(), "gpu".to_owned()]);
    }
    for peer in &peers::PEERS {
        if !options.wants(peer.script) || (options.gpu && !peer.on_gpu) {
            continue;
        }
        let mut arguments = arguments.clone();
        if peer.script == "parallax_jax" || peer.script == "lax_scan" {
            arguments.extend(["--dtype".to_owned(), options.dtype.clone()]);
        }
        if let Err(error) = peers::run(peer, folder, &arguments, timing, &mut report) {
            eprintln!("{} ({}): {error:#}", peer.script, peer.venv);
            lines_missing(&mut report, peer, &error);
        }
    }
    Ok(lines)
}

/// A peer that did not run stands in the report.
fn lines_missing(report: &mut dyn FnMut(Line), peer: &peers::Peer, error: &anyhow::Error) {
    let line = Line::value(peer.venv, format!("{} did not run", peer.script), f64::NAN, "");
    report(line.detail(format!("{error:#}").replace('\n', " ")));
}

fn read(path: &std::path::Path) -> anyhow::Result<Vec<Line>> {
    let text = std::fs::read_to_string(path).with_context(|| format!("{} cannot be read", path.display()))?;
    text.lines().map(|line| Ok(serde_json::from_str(line)?)).collect()
}

/// Hands all lines to the script that draws them.
fn plot(lines: &[Line], folder: &std::path::Path, to: &std::path::Path) -> anyhow::Result<()> {
    let python = peers::python(folder, "jax").context("no Matplotlib: run benches/peers/install")?;
    let data = tempfile::NamedTempFile::new()?;
    let mut file = data.reopen()?;
    for line in lines {
        writeln!(file, "{}", serde_json::to_string(line)?)?;
    }
    let script = peers::root().join("benches/peers/plot.py");
    let status = Command::new(python).arg("-B").arg(script).arg(data.path()).arg(to).status()?;
    anyhow::ensure!(status.success(), "the plot failed: {status}");
    Ok(())
}
