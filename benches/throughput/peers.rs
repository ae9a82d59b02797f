//! The peers: scripts in virtual environments of their own, whose lines are read from their standard output.

use std::io::{BufRead, BufReader};
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

use anyhow::Context;

use crate::line::{Line, Timing};

/// A script and the virtual environment that it runs in.
pub(crate) struct Peer {
    /// The folder of its virtual environment.
    pub(crate) venv: &'static str,
    /// The script in `benches/peers`.
    pub(crate) script: &'static str,
    /// Whether it can run on a GPU.
    pub(crate) on_gpu: bool,
}

/// All peers, ours on JAX among them.
pub(crate) const PEERS: [Peer; 8] = [
    Peer { venv: "jax", script: "lax_scan", on_gpu: true },
    Peer { venv: "parallax", script: "parallax_jax", on_gpu: true },
    Peer { venv: "rex", script: "rex_compiled", on_gpu: true },
    Peer { venv: "rex-jax-0.4.30", script: "rex_compiled", on_gpu: true },
    Peer { venv: "rex", script: "rex_simulated", on_gpu: false },
    Peer { venv: "rex-jax-0.4.30", script: "rex_simulated", on_gpu: false },
    Peer { venv: "drake", script: "drake_pendulum", on_gpu: false },
    Peer { venv: "mujoco", script: "mujoco_pendulum", on_gpu: false },
];

/// The root of the repository.
pub(crate) fn root() -> &'static Path {
    Path::new(env!("CARGO_MANIFEST_DIR"))
}

/// Where the virtual environments are, unless the command line says otherwise.
pub(crate) fn default_folder() -> PathBuf {
    std::env::var_os("PARALLAX_PEERS").map_or_else(|| root().join("target/peers"), PathBuf::from)
}

/// The interpreter of a virtual environment that was installed to its end.
pub(crate) fn python(folder: &Path, venv: &str) -> Option<PathBuf> {
    let venv = folder.join(venv);
    venv.join("installed").exists().then(|| venv.join("bin/python"))
}

/// Runs one peer and hands over its lines.
///
/// # Errors
///
/// When it is not installed, does not start, or fails; what it reported before stands.
pub(crate) fn run(
    peer: &Peer,
    folder: &Path,
    arguments: &[String],
    timing: Timing,
    report: &mut dyn FnMut(Line),
) -> anyhow::Result<()> {
    let python = python(folder, peer.venv).with_context(|| {
        format!("not installed: run benches/peers/install {} {}", folder.display(), peer.venv)
    })?;
    let script = root().join("benches/peers").join(peer.script).with_extension("py");
    let mut child = Command::new(python)
        .arg("-B")
        .arg(&script)
        .args(arguments)
        .args(["--repeats", &timing.repeats.to_string(), "--seconds", &timing.seconds.to_string()])
        .stdout(Stdio::piped())
        .spawn()
        .with_context(|| format!("{} does not start", script.display()))?;
    let output = child.stdout.take().context("no output")?;
    for text in BufReader::new(output).lines() {
        let text = text?;
        match serde_json::from_str(&text) {
            Ok(line) => report(line),
            Err(_) => eprintln!("{}: {text}", peer.script),
        }
    }
    let status = child.wait()?;
    anyhow::ensure!(status.success(), "{} ended with {status}", peer.script);
    Ok(())
}
