//! The words of a message where they lie. iceoryx2 keeps their number beside them in shared memory, where any program of the
//! same user can write at any time; it is asked for nothing that believes the number.

use std::fmt::Debug;
use std::hint::black_box;

use iceoryx2::prelude::PayloadHeader;
use iceoryx2::sample::Sample;
use iceoryx2::sample_mut::SampleMut;

use super::Ipc;

/// The place of a message that is being written.
#[derive(Debug)]
pub(super) struct Place {
    sample: SampleMut<Ipc, [u64], ()>,
    /// As many as were asked for, and there is room for.
    words: usize,
}

/// Where the words of a message begin: iceoryx2 puts them behind the user's header, of which there is none, at the next place
/// where a word may be.
fn start(user_header: &()) -> usize {
    std::ptr::from_ref(user_header).addr().next_multiple_of(align_of::<u64>())
}

/// The words of a message that was received. A number of them that cannot be right, with `limit` the greatest that the channel
/// allows, is taken for none.
pub(super) fn received(sample: &Sample<Ipc, [u64], ()>, limit: usize) -> &[u64] {
    // What comes out of `black_box` is what was compared: it is not read anew.
    let count = black_box(sample.header().number_of_elements());
    if count > limit as u64 {
        return &[];
    }
    let start = std::ptr::with_exposed_provenance(start(sample.user_header()));
    // SAFETY: a message has room for `limit` words from there on, with which its publisher made it, in a segment that stays
    // mapped as long as the sample is there. The segment's address is exposed: iceoryx2 makes its own pointers from numbers.
    // It is aligned, and any bits are a valid word.
    unsafe { std::slice::from_raw_parts(start, count as usize) }
}

impl Place {
    /// A message of so many words, with which `sample` was asked for; all its bytes must be initialised.
    pub(super) fn new(sample: SampleMut<Ipc, [u64], ()>, words: usize) -> Self {
        Self { sample, words }
    }

    pub(super) fn words(&self) -> &[u64] {
        let start = std::ptr::with_exposed_provenance(start(self.sample.user_header()));
        // SAFETY: as in `received`, and there is room for as many words as were asked for. Receivers do not have it yet.
        unsafe { std::slice::from_raw_parts(start, self.words) }
    }

    pub(super) fn words_mut(&mut self) -> &mut [u64] {
        let start = std::ptr::with_exposed_provenance_mut(start(self.sample.user_header()));
        // SAFETY: as in `words`; the sample is borrowed for as long as the words can be written.
        unsafe { std::slice::from_raw_parts_mut(start, self.words) }
    }

    pub(super) fn send(self) -> Result<usize, iceoryx2::port::SendError> {
        self.sample.send()
    }
}
