//! The books of the recorder, in the run's directory: what another recorder takes over from where one died.

use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};

use crate::channel::Space;

/// Where the ledger lies in the run's directory.
const LEDGER: &str = "recorder.json";

/// What a recorder has done, as the next one, or the launcher, finds it.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub(super) struct Ledger {
    /// The files, in the order of time.
    pub(super) files: Vec<PathBuf>,
    /// By node: the number of the next record, how many never came, and how many came and could not be written.
    pub(super) next: Vec<u64>,
    pub(super) lost: Vec<u64>,
    pub(super) unwritten: Vec<u64>,
    /// What went wrong with the files last.
    pub(super) problem: Option<String>,
}

impl Ledger {
    /// The ledger of the recorder before, or an empty one.
    pub(super) fn read(space: &Space, nodes: usize) -> Self {
        let read = space.read(LEDGER).ok().and_then(|bytes| serde_json::from_slice::<Self>(&bytes).ok());
        let fits = |ledger: &Self| {
            [&ledger.next, &ledger.lost, &ledger.unwritten].iter().all(|counts| counts.len() == nodes)
        };
        read.filter(fits).unwrap_or_else(|| Self {
            next: vec![0; nodes],
            lost: vec![0; nodes],
            unwritten: vec![0; nodes],
            ..Self::default()
        })
    }

    /// The ledger in this run's directory, for somebody who only looks.
    pub(super) fn look_at(run: &Path) -> Option<Self> {
        serde_json::from_slice(&std::fs::read(run.join(LEDGER)).ok()?).ok()
    }

    pub(super) fn write(&self, space: &Space) {
        let Ok(bytes) = serde_json::to_vec(self) else { return };
        // Whoever dies meanwhile leaves the old one. A ledger that cannot be written costs the next recorder its counts,
        // and this one nothing.
        let _ = space.replace(LEDGER, &bytes);
    }
}
