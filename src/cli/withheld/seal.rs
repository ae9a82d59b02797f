//! Sealed answers: written once, hashed before anything is diagnosed, and read only if the hash still holds.

use std::collections::BTreeMap;
use std::fmt::Write as _;
use std::path::{Path, PathBuf};

use parallax_withheld_truth::{Answer, Plan};
use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};

/// Name of the answers' file in a run's folder.
const ANSWERS: &str = "answers.json";

/// Name of the file with its hash; `sha256sum --check` reads it.
const SEAL: &str = "answers.sha256";

/// The answers of a run.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(crate) struct Answers {
    /// The seed of the whole run.
    pub(crate) seed: u64,
    /// Whether the seed is from the stream for development.
    pub(crate) development: bool,
    /// The answers by case.
    pub(crate) cases: BTreeMap<String, Sealed>,
}

/// The answer of one case.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(crate) struct Sealed {
    /// What the recording was made with.
    pub(crate) answer: Answer,
    /// Whether the diagnosis was told to leave the true effect out of its library.
    pub(crate) left_out: bool,
    /// What the case was made from, so that an experiment can be played on the same machine.
    pub(crate) plan: Plan,
    /// The case's own seed.
    pub(crate) seed: u64,
}

/// Why answers cannot be sealed or opened.
#[derive(Debug, thiserror::Error)]
pub(crate) enum SealError {
    /// A file cannot be read or written.
    #[error("{} cannot be used", path.display())]
    File {
        /// The file.
        path: PathBuf,
        /// Why.
        source: std::io::Error,
    },
    /// The answers are not those whose hash was printed.
    #[error("{} was changed after it was sealed: its SHA-256 is {found}, the seal says {sealed}", path.display())]
    Broken {
        /// The answers.
        path: PathBuf,
        /// The hash of the file.
        found: String,
        /// The hash in the seal.
        sealed: String,
    },
    /// The answers are of another form.
    #[error("{} holds no answers of this version", path.display())]
    Form {
        /// The answers.
        path: PathBuf,
        /// What is wrong.
        source: serde_json::Error,
    },
}

/// Writes the answers and their seal into `folder`, and gives the hash.
pub(crate) fn seal(folder: &Path, answers: &Answers) -> Result<String, SealError> {
    let path = folder.join(ANSWERS);
    let text = serde_json::to_string_pretty(answers)
        .map_err(|source| SealError::Form { path: path.clone(), source })?;
    write(&path, &text)?;
    let hash = hash(text.as_bytes());
    write(&folder.join(SEAL), &format!("{hash}  {ANSWERS}\n"))?;
    Ok(hash)
}

/// The hash in the seal; the answers stay closed. None where nothing is sealed yet.
pub(crate) fn sealed_hash(folder: &Path) -> Result<Option<String>, SealError> {
    let path = folder.join(SEAL);
    if !path.exists() {
        return Ok(None);
    }
    let text = read(&path)?;
    Ok(Some(text.split_whitespace().next().unwrap_or_default().to_owned()))
}

/// Opens the answers, if they are the ones whose hash is `sealed`.
pub(crate) fn open(folder: &Path, sealed: &str) -> Result<Answers, SealError> {
    let path = folder.join(ANSWERS);
    let text = read(&path)?;
    let found = hash(text.as_bytes());
    if found != sealed {
        return Err(SealError::Broken { path, found, sealed: sealed.into() });
    }
    serde_json::from_str(&text).map_err(|source| SealError::Form { path, source })
}

fn hash(bytes: &[u8]) -> String {
    Sha256::digest(bytes).iter().fold(String::new(), |mut text, byte| {
        // Writing to a string cannot fail.
        let _ = write!(text, "{byte:02x}");
        text
    })
}

fn read(path: &Path) -> Result<String, SealError> {
    std::fs::read_to_string(path).map_err(|source| SealError::File { path: path.into(), source })
}

fn write(path: &Path, text: &str) -> Result<(), SealError> {
    std::fs::write(path, text).map_err(|source| SealError::File { path: path.into(), source })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_hash_is_sha256() {
        let of_abc = "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad";
        assert_eq!(hash(b"abc"), of_abc);
    }

    #[test]
    fn a_changed_answer_breaks_the_seal() {
        let folder = tempfile::tempdir().unwrap();
        assert_eq!(sealed_hash(folder.path()).unwrap(), None);
        let answers = Answers { seed: 7, development: true, cases: BTreeMap::new() };
        let sealed = seal(folder.path(), &answers).unwrap();
        assert_eq!(sealed_hash(folder.path()).unwrap().as_ref(), Some(&sealed));
        assert_eq!(open(folder.path(), &sealed).unwrap(), answers);

        let path = folder.path().join(ANSWERS);
        let changed = read(&path).unwrap().replace("\"seed\": 7", "\"seed\": 8");
        std::fs::write(&path, changed).unwrap();
        let error = open(folder.path(), &sealed).unwrap_err();
        assert!(matches!(error, SealError::Broken { .. }), "{error}");
    }
}
