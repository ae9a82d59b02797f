//! What can go wrong when a recording is written or read.

use std::io;
use std::path::PathBuf;

use super::cdr::CdrError;

/// Why a recording cannot be written or read: each says which file, where in it, and what to do.
#[derive(Debug, thiserror::Error)]
pub enum RecordingError {
    /// There is no such file.
    #[error(
        "{path}: there is no such file. Give the path of a recording (.mcap), as `run` or `demo` wrote it, or of a folder of logs with a recording.toml"
    )]
    Missing {
        /// The path that was given.
        path: PathBuf,
    },
    /// The file exists and cannot be read, or cannot be written.
    #[error("{path}: cannot {what}: {source}")]
    Io {
        /// The file.
        path: PathBuf,
        /// What was tried.
        what: &'static str,
        /// The system's answer.
        source: io::Error,
    },
    /// Somebody else is recording into the file.
    #[error("{path}: another run is recording into this file; give another one with --out")]
    Busy {
        /// The file.
        path: PathBuf,
    },
    /// The file is empty.
    #[error("{path}: the file is empty; the recorder was killed before it wrote anything. Record again")]
    Empty {
        /// The file.
        path: PathBuf,
    },
    /// The file does not begin as an MCAP file does.
    #[error(
        "{path}: this is not an MCAP file (it begins with {found:02x?}). A recording is a .mcap file; a CSV file, or a \
         folder of them with a recording.toml, is read with `import`"
    )]
    NotMcap {
        /// The file.
        path: PathBuf,
        /// Its first bytes.
        found: Vec<u8>,
    },
    /// The file was cut before the part that says what is in it.
    #[error(
        "{path}: the file is cut at byte {at}, before the graph, so nothing in it can be interpreted. Copy it again \
         from where it came, or record again"
    )]
    CutEarly {
        /// The file.
        path: PathBuf,
        /// Where it is cut.
        at: usize,
    },
    /// A part of the file is damaged.
    #[error(
        "{path}: the record at byte {at} cannot be read: {reason}. The file is damaged: copy it again from where it \
         came, or salvage what is left with `mcap recover`"
    )]
    Damaged {
        /// The file.
        path: PathBuf,
        /// Offset of the record or chunk.
        at: usize,
        /// What is wrong with it.
        reason: String,
    },
    /// A chunk is compressed.
    #[error(
        "{path}: the chunk at byte {at} is compressed with {compression}, which this program does not read. Convert \
         the file first: mcap compress --compression none {path} -o plain.mcap"
    )]
    Compressed {
        /// The file.
        path: PathBuf,
        /// Offset of the chunk.
        at: usize,
        /// Name of the compression.
        compression: String,
    },
    /// The file is MCAP, of somebody else.
    #[error(
        "{path}: this MCAP file has no attachment {attachment}, so Parallax did not write it. Its topics: {topics}. \
         Bring it in with `import`"
    )]
    Foreign {
        /// The file.
        path: PathBuf,
        /// Name of the attachment that is missing.
        attachment: &'static str,
        /// The topics that it has.
        topics: String,
    },
    /// The description of the graph cannot be understood.
    #[error(
        "{path}: the attachment {attachment} cannot be understood: {reason}. Was it written by a newer version?"
    )]
    Description {
        /// The file.
        path: PathBuf,
        /// Name of the attachment.
        attachment: &'static str,
        /// What is wrong with it.
        reason: String,
    },
    /// A message does not fit its layout.
    #[error(
        "{path}: message {sequence} of topic {topic} cannot be decoded: {source}. The file is damaged; record again"
    )]
    Message {
        /// The file.
        path: PathBuf,
        /// Its topic.
        topic: String,
        /// Its sequence number.
        sequence: u32,
        /// What is wrong with it.
        source: CdrError,
    },
    /// A record that this format cannot hold.
    #[error("{path}: cannot write {what} of node {node}: {reason}")]
    Unwritable {
        /// The file.
        path: PathBuf,
        /// The node.
        node: String,
        /// Which record.
        what: String,
        /// Why it cannot be written.
        reason: String,
    },
    /// The writer of MCAP files refused.
    #[error("{path}: cannot write: {source}. Is the disk full?")]
    Write {
        /// The file.
        path: PathBuf,
        /// What the MCAP writer says.
        source: mcap::McapError,
    },
}
