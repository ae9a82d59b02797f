//! Which node runs on which machine: what a `launch.toml` says of it, checked.

use std::net::{SocketAddr, ToSocketAddrs};
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};

use parallax_model::system::Suggestion;
use serde::{Deserialize, Serialize};

use super::connections::{SHORTEST, Way};
use crate::graph::Graph;
use crate::launch::plan;
use crate::launch::settings::{LaunchSpec, SettingsError};
use crate::time::{Nanos, from_seconds};

/// Characters of a secret at least.
const SECRET: usize = 16;

/// One machine, as it stands under `[host.NAME]` in a `launch.toml`.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct HostSpec {
    /// Where it waits for the others, `ADDRESS:PORT`. One without an address opens no port and calls those that have one.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub address: Option<String>,
}

/// How the machines of a graph are connected, as it stands under `[link]` in a `launch.toml`.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct LinkSpec {
    /// The file with the secret that all machines of the graph share, beside the `launch.toml` unless its path is absolute.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub secret: Option<PathBuf>,
    /// The machine whose clock decides when the run begins; the first by name that has an address, where none is named.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub lead: Option<String>,
    /// The machine that records all nodes; without it, none does.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub recorder: Option<String>,
    /// After so long without a word from a machine its nodes count as silent, s; 0.5 where nothing is said.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub silence: Option<f64>,
    /// After so long it counts as gone, s; 5 where nothing is said.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub gone: Option<f64>,
    /// What happens then: `stop` ends the run, `continue` goes on with safe outputs and waits for it.
    #[serde(default)]
    pub on_gone: OnGone,
    /// How long the machines wait for each other at the start, s; 30 where nothing is said.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub patience: Option<f64>,
}

/// What to do when another machine is gone.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum OnGone {
    /// End the run.
    #[default]
    Stop,
    /// Go on, on safe outputs, until it is back.
    Continue,
}

/// Where every node of a run is, seen from one machine.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(in crate::launch) struct Placement {
    /// The machines.
    pub(in crate::launch) hosts: Vec<Host>,
    /// This one.
    pub(in crate::launch) me: usize,
    /// The machine of each node.
    pub(in crate::launch) of: Vec<usize>,
    /// The machine whose clock decides when the run begins.
    pub(in crate::launch) lead: usize,
    /// The machine that records.
    pub(in crate::launch) recorder: Option<usize>,
    pub(in crate::launch) secret: PathBuf,
    pub(in crate::launch) silence: Nanos,
    pub(in crate::launch) gone: Nanos,
    pub(in crate::launch) on_gone: OnGone,
    pub(in crate::launch) patience: Nanos,
    /// How the messages of each node cross.
    pub(in crate::launch) ways: Vec<Way>,
}

/// A machine.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(in crate::launch) struct Host {
    pub(in crate::launch) name: String,
    pub(in crate::launch) address: Option<SocketAddr>,
}

impl Placement {
    /// Whether a node runs on this machine.
    pub(in crate::launch) fn is_here(&self, node: usize) -> bool {
        self.of[node] == self.me
    }

    /// The name of a node's machine.
    pub(in crate::launch) fn host_of(&self, node: usize) -> &str {
        &self.hosts[self.of[node]].name
    }

    pub(in crate::launch) fn my_name(&self) -> &str {
        &self.hosts[self.me].name
    }

    /// Whether a node's messages have to come to this machine, or leave it.
    pub(in crate::launch) fn crosses(&self, graph: &Graph, node: usize) -> bool {
        let to_others = || plan::receivers(graph, node).iter().any(|&receiver| !self.is_here(receiver));
        if self.is_here(node) { to_others() } else { self.has_receiver_here(graph, node) }
    }

    /// Whether a node's records have to come to this machine, or leave it.
    pub(in crate::launch) fn records_cross(&self, node: usize) -> bool {
        self.recorder.is_some_and(|recorder| (recorder == self.me) != self.is_here(node))
    }

    /// Whether this machine records.
    pub(in crate::launch) fn records_here(&self) -> bool {
        self.recorder == Some(self.me)
    }

    pub(in crate::launch) fn has_receiver_here(&self, graph: &Graph, node: usize) -> bool {
        plan::receivers(graph, node).iter().any(|&receiver| self.is_here(receiver))
    }
}

impl LaunchSpec {
    /// Whether the graph runs on several machines.
    pub fn has_hosts(&self) -> bool {
        !self.hosts.is_empty()
    }

    /// Where every node runs, seen from the machine `me`; `None` for graphs on one machine.
    ///
    /// # Errors
    ///
    /// [`SettingsError::Value`], with the table and the setting.
    pub(in crate::launch) fn place(
        &self,
        graph: &Graph,
        me: Option<&str>,
    ) -> Result<Option<Placement>, SettingsError> {
        let fail = |place: &str, field: &'static str, problem: String| SettingsError::Value {
            file: self.name(),
            place: place.into(),
            field,
            problem,
        };
        let named = self.nodes.iter().find(|(_, node)| node.host.is_some());
        if self.hosts.is_empty() {
            if let Some((node, _)) = named {
                let problem = "names a machine, and there are none; add [host.NAME] for each".into();
                return Err(fail(&format!("node.{node}"), "host", problem));
            }
            if let Some(me) = me {
                let problem = format!("--host {me} was given, and the launch settings name no machines");
                return Err(fail("host", "NAME", problem));
            }
            if let Some(name) = self.connections.keys().next() {
                let problem = "is of no use without machines; add [host.NAME]".into();
                return Err(fail(&format!("connection.\"{name}\""), "FROM->TO", problem));
            }
            if self.link != LinkSpec::default() {
                return Err(fail("link", "secret", "is of no use without machines; add [host.NAME]".into()));
            }
            return Ok(None);
        }
        let names: Vec<&str> = self.hosts.keys().map(String::as_str).collect();
        let find = |place: &str, field: &'static str, name: &str| {
            names.iter().position(|host| *host == name).ok_or_else(|| {
                let suggestion = Suggestion::nearest(name, names.iter().copied());
                let problem =
                    format!("there is no machine `{name}`{suggestion} (there are: {})", names.join(", "));
                fail(place, field, problem)
            })
        };
        let Some(me) = me else {
            let problem = format!("say which machine this is: --host NAME, one of {}", names.join(", "));
            return Err(fail("host", "NAME", problem));
        };
        let me = find("host", "NAME", me)?;
        let hosts = self.hosts.iter().map(|(name, host)| {
            let place = format!("host.{name}");
            let well_formed = name.chars().all(|c| c.is_ascii_alphanumeric() || c == '_' || c == '-');
            if !well_formed || name.is_empty() {
                let problem = "may hold letters, digits, `_` and `-` only".into();
                return Err(fail(&place, "NAME", problem));
            }
            let address = host
                .address
                .as_deref()
                .map(|text| address(text).map_err(|problem| fail(&place, "address", problem)));
            Ok(Host { name: name.clone(), address: address.transpose()? })
        });
        let hosts = hosts.collect::<Result<Vec<_>, _>>()?;
        let open: Vec<usize> = (0..hosts.len()).filter(|&host| hosts[host].address.is_some()).collect();
        // Each pair needs one of the two to wait for the other.
        let mute: Vec<&str> =
            hosts.iter().filter(|host| host.address.is_none()).map(|host| host.name.as_str()).collect();
        if hosts.len() < 2 || mute.len() > 1 {
            let problem = match hosts.len() {
                1 => "is the only machine; add another, or remove [host] and [link]".into(),
                _ => format!(
                    "is missing at {}: of two machines, one has to wait for the other",
                    mute.join(" and ")
                ),
            };
            return Err(fail(&format!("host.{}", mute.last().unwrap_or(&names[0])), "address", problem));
        }
        let of = graph.nodes().iter().map(|plan| {
            let own = self.nodes.get(&plan.name).and_then(|node| node.host.as_deref());
            match own.or(self.defaults.host.as_deref()) {
                Some(name) if own.is_some() => find(&format!("node.{}", plan.name), "host", name),
                Some(name) => find("defaults", "host", name),
                None => {
                    let problem =
                        "is missing; say which machine it runs on, or give [defaults] a host".into();
                    Err(fail(&format!("node.{}", plan.name), "host", problem))
                }
            }
        });
        let of = of.collect::<Result<Vec<_>, _>>()?;
        let LinkSpec { lead, recorder, silence, gone, on_gone, patience, .. } = &self.link;
        let time = |field: &'static str, value: Option<f64>, otherwise: f64, least: f64| match value {
            Some(value) if !(value.is_finite() && value >= least) => {
                Err(fail("link", field, format!("{value} s cannot be; give at least {least} s")))
            }
            value => Ok(from_seconds(value.unwrap_or(otherwise))),
        };
        let (silence, gone) =
            (time("silence", *silence, 0.5, SHORTEST)?, time("gone", *gone, 5.0, SHORTEST)?);
        if gone < silence {
            return Err(fail("link", "gone", "is shorter than silence".into()));
        }
        let mut placement = Placement {
            me,
            of,
            lead: match lead {
                Some(name) => find("link", "lead", name)?,
                None => *open.first().unwrap_or(&0),
            },
            recorder: recorder.as_deref().map(|name| find("link", "recorder", name)).transpose()?,
            secret: self.secret().map_err(|problem| fail("link", "secret", problem))?,
            silence,
            gone,
            on_gone: *on_gone,
            patience: time("patience", *patience, 30.0, 1.0)?,
            hosts,
            ways: Vec::new(),
        };
        placement.ways = self.ways(graph, &placement)?;
        Ok(Some(placement))
    }

    /// The file with the secret, which nobody else may read.
    fn secret(&self) -> Result<PathBuf, String> {
        let Some(path) = &self.link.secret else {
            return Err("is missing: name a file with a word of at least 16 characters that all machines of the graph share, \
                        readable by you alone (head -c 32 /dev/urandom | base64 > link.secret; chmod 600 link.secret)"
                .into());
        };
        let beside = self.file.as_deref().and_then(Path::parent).unwrap_or(Path::new("."));
        let path = std::path::absolute(beside.join(path)).map_err(|error| error.to_string())?;
        secret(&path)?;
        Ok(path)
    }
}

/// Reads a secret.
pub(in crate::launch) fn secret(path: &Path) -> Result<String, String> {
    let metadata = path.metadata().map_err(|error| format!("{} cannot be read: {error}", path.display()))?;
    if metadata.mode() & 0o077 != 0 {
        return Err(format!("others may read {}; chmod 600 {}", path.display(), path.display()));
    }
    let text = std::fs::read_to_string(path)
        .map_err(|error| format!("{} cannot be read: {error}", path.display()))?;
    let word = text.trim().to_owned();
    if word.len() < SECRET || word.contains([':', '\n', '\r']) || !word.is_ascii() {
        return Err(format!(
            "{} must hold one word of at least {SECRET} ASCII characters, without a colon",
            path.display()
        ));
    }
    Ok(word)
}

/// An address and a port.
fn address(text: &str) -> Result<SocketAddr, String> {
    let mut found = text
        .to_socket_addrs()
        .map_err(|error| format!("`{text}` is no ADDRESS:PORT such as 10.0.0.1:7447: {error}"))?;
    let address = found.next().ok_or_else(|| format!("`{text}` is the name of no machine"))?;
    if address.ip().is_unspecified() {
        return Err(format!(
            "`{text}` would be open on every network of the machine; give the address of the one that is meant"
        ));
    }
    if address.port() == 0 {
        return Err(format!("`{text}` has no port; give one, such as 7447"));
    }
    Ok(address)
}
