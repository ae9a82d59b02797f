//! That somebody looks at a recording while it is written: the recorder then hands on what it has ten times a second, not once.

use std::fs::File;
use std::io;
use std::path::Path;
use std::time::{Duration, SystemTime};

/// The file in the run's directory whose time says when somebody looked last.
const FILE: &str = "watched";
/// For how long a look counts.
const COUNTS: Duration = Duration::from_secs(2);

/// Somebody who looks.
#[derive(Debug)]
pub struct Watch(File);

impl Watch {
    /// Begins to look at the run in this directory.
    pub(super) fn begin(run: &Path) -> io::Result<Self> {
        let file = File::options().write(true).create(true).truncate(false).open(run.join(FILE))?;
        let watch = Self(file);
        watch.keep()?;
        Ok(watch)
    }

    /// Goes on; to be said about once a second. A run that has ended does not mind.
    ///
    /// # Errors
    ///
    /// What the system says.
    pub fn keep(&self) -> io::Result<()> {
        self.0.set_modified(SystemTime::now())
    }
}

/// Whether somebody looks at the run in this directory.
pub(super) fn watched(run: &Path) -> bool {
    let looked = run.join(FILE).metadata().and_then(|file| file.modified());
    // A clock that was set since then says nothing.
    looked.is_ok_and(|looked| looked.elapsed().is_ok_and(|since| since < COUNTS))
}
