//! Any bytes are a recording or an error: as a file, and as the messages of a well-formed file, which a mutation of bytes alone would
//! hardly get past its checksums.

#![no_main]

use std::borrow::Cow;
use std::io::Cursor;
use std::path::PathBuf;
use std::sync::LazyLock;

use libfuzzer_sys::fuzz_target;
use parallax_runtime::import::foreign::{Dialect, read};
use parallax_runtime::recording::Recording;

static FILE: LazyLock<PathBuf> =
    LazyLock::new(|| PathBuf::from(format!("/dev/shm/parallax_fuzz_{}.mcap", std::process::id())));

fn try_file(bytes: &[u8]) {
    std::fs::write(&*FILE, bytes).expect("there is room");
    match Recording::read(&*FILE) {
        Ok(recording) => drop(recording.log()),
        Err(error) => drop(error.to_string()),
    }
    let _ = read(&FILE, &Dialect::default(), &mut |_| {}).map_err(|error| error.to_string());
}

/// A file in which every record of the recording that is the seed is there, but one of them holds other bytes.
fn altered(seed: &[u8], bytes: &[u8]) -> Option<Vec<u8>> {
    let (&which, bytes) = bytes.split_first()?;
    let mut out = Cursor::new(Vec::new());
    let mut writer = mcap::WriteOptions::new().compression(None).use_chunks(false).create(&mut out).ok()?;
    let summary = mcap::Summary::read(seed).ok()??;
    for index in &summary.attachment_indexes {
        let attachment = mcap::read::attachment(seed, index).ok()?;
        let data = if which == 0 { Cow::Borrowed(bytes) } else { attachment.data };
        writer.attach(&mcap::Attachment { data, ..attachment }).ok()?;
    }
    for (number, message) in mcap::MessageStream::new(seed).ok()?.take(400).enumerate() {
        let mut message = message.ok()?;
        if number == usize::from(which) + 1 {
            message.data = Cow::Borrowed(bytes);
        }
        writer.write(&message).ok()?;
    }
    writer.finish().ok()?;
    drop(writer);
    Some(out.into_inner())
}

/// A small recording, made by the simulated clock.
static SEED: LazyLock<Vec<u8>> =
    LazyLock::new(|| std::fs::read(concat!(env!("CARGO_MANIFEST_DIR"), "/seeds/recording/small.mcap")).unwrap_or_default());

fuzz_target!(|bytes: &[u8]| {
    try_file(bytes);
    if let Some(file) = altered(&SEED, bytes) {
        try_file(&file);
    }
});
