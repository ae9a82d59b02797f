//! Data: bytes beside the numbers of a message, such as an image.
//!
//! A message is a few numbers, which the runtime copies, and up to so many bytes as its kind of node declares, which it
//! does not: a node writes them into the place in shared memory from which receivers read them, and a receiver's window
//! holds that place for as long as it shows the message.
//!
//! ```
//! use parallax_model::tree::Tree;
//! use parallax_runtime::data::{DataNode, DataSpace};
//! use parallax_runtime::node::{Message, NodeError, Port, Step};
//! use parallax_runtime::registry::NodeKind;
//!
//! #[derive(Tree, Clone, Default)]
//! struct Scan { points: f64 }
//! impl Message for Scan { const NAME: &'static str = "example/Scan"; }
//!
//! struct Lidar;
//! impl DataNode for Lidar {
//!     type Output = Scan;
//!     fn step(&mut self, step: &Step<'_>, data: &mut DataSpace<'_>) -> Result<Scan, NodeError> {
//!         data.take(8)?.copy_from_slice(&step.seq.to_le_bytes());
//!         Ok(Scan { points: 1.0 })
//!     }
//! }
//!
//! const LIDAR: Port<Scan> = Port::new("lidar");
//! /// How large the newest scan is: what a receiver's step does.
//! fn newest(step: &Step<'_>) -> usize {
//!     step.latest_data(LIDAR).len()
//! }
//!
//! let kind = NodeKind::with_data(1 << 20, |_| Ok(Lidar));
//! assert_eq!(kind.data_capacity(), 1 << 20);
//! ```

use std::fmt;
use std::ops::Deref;
use std::sync::Arc;

use parallax_model::tree::Tree as _;

use crate::channel::View;
use crate::node::{ErasedNode, Message, NodeError, Step, Stopping};
use crate::tuning::Tuning;

/// The data of a message: bytes, where they lie or as a copy of their own.
#[derive(Default)]
pub struct Data(Inner);

#[derive(Default)]
enum Inner {
    #[default]
    None,
    Owned(Arc<[u8]>),
    /// In a message in shared memory, which stays as it is until this is dropped.
    InPlace {
        view: View,
        start: usize,
        length: usize,
    },
}

impl Data {
    /// The `length` bytes that begin at word `start` of a message; `None` when the message is not so long.
    pub(crate) fn in_place(view: View, start: usize, length: usize) -> Option<Self> {
        let room = view.len().checked_sub(start)?.checked_mul(8)?;
        (length <= room).then_some(Self(Inner::InPlace { view, start, length }))
    }
}

impl Deref for Data {
    type Target = [u8];

    fn deref(&self) -> &[u8] {
        match &self.0 {
            Inner::None => &[],
            Inner::Owned(bytes) => bytes,
            Inner::InPlace { view, start, length } => &bytes(&view[*start..])[..*length],
        }
    }
}

impl From<&[u8]> for Data {
    fn from(bytes: &[u8]) -> Self {
        if bytes.is_empty() { Self::default() } else { Self(Inner::Owned(bytes.into())) }
    }
}

/// What lies in shared memory is copied: its place can be kept once only.
impl Clone for Data {
    fn clone(&self) -> Self {
        match &self.0 {
            Inner::Owned(bytes) => Self(Inner::Owned(bytes.clone())),
            _ => Self::from(&**self),
        }
    }
}

impl PartialEq for Data {
    fn eq(&self, other: &Self) -> bool {
        **self == **other
    }
}

impl Eq for Data {}

impl fmt::Debug for Data {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "Data({} bytes)", self.len())
    }
}

/// Words as the bytes that they are.
pub(crate) fn bytes(words: &[u64]) -> &[u8] {
    // SAFETY: the same memory for the same time; a byte has no alignment and is valid for any bits, and 8 of them make a
    // word.
    unsafe { std::slice::from_raw_parts(words.as_ptr().cast(), size_of_val(words)) }
}

/// Words as the bytes that they are, to be written.
pub(crate) fn bytes_mut(words: &mut [u64]) -> &mut [u8] {
    // SAFETY: as in `bytes`; the words are borrowed for as long as the bytes can be written, and any bits are a valid u64.
    unsafe { std::slice::from_raw_parts_mut(words.as_mut_ptr().cast(), size_of_val(words)) }
}

/// The room for the data of the message that a step makes.
#[derive(Debug)]
pub struct DataSpace<'a> {
    room: &'a mut [u8],
    used: usize,
}

impl<'a> DataSpace<'a> {
    /// This room, of which nothing is used.
    pub fn new(room: &'a mut [u8]) -> Self {
        Self { room, used: 0 }
    }

    /// How many bytes a message may have at most.
    pub fn capacity(&self) -> usize {
        self.room.len()
    }

    /// How many bytes the message has.
    pub fn used(&self) -> usize {
        self.used
    }

    /// Gives the message `length` bytes of data, to be written: until then they hold anything. What was taken before is
    /// part of it.
    ///
    /// # Errors
    ///
    /// [`NodeError::Failed`] when the kind of node did not declare so many.
    pub fn take(&mut self, length: usize) -> Result<&mut [u8], NodeError> {
        if length > self.room.len() {
            let room = self.room.len();
            return Err(NodeError::failed(format!(
                "its message has {length} bytes of data and its kind declares {room} at most; declare more with \
                 `NodeKind::data`"
            )));
        }
        self.used = length;
        Ok(&mut self.room[..length])
    }
}

/// A node whose messages have data. Otherwise it is as a [`Node`](crate::node::Node).
pub trait DataNode: Send {
    /// What every step sends beside the data.
    type Output: Message;

    /// Makes one step, and writes the data of its message, if it is to have any.
    ///
    /// # Errors
    ///
    /// As [`Node::step`](crate::node::Node::step).
    fn step(&mut self, step: &Step<'_>, data: &mut DataSpace<'_>) -> Result<Self::Output, NodeError>;

    /// As [`Node::tuning`](crate::node::Node::tuning).
    fn tuning(&mut self) -> Option<&mut dyn Tuning> {
        None
    }

    /// As [`Node::stop`](crate::node::Node::stop).
    fn stop(&mut self, why: Stopping) {
        let _ = why;
    }
}

/// A [`DataNode`] as executors drive it.
pub(crate) struct Writing<N>(pub(crate) N);

impl<N: DataNode> ErasedNode for Writing<N> {
    fn step_into(&mut self, step: &Step<'_>, output: &mut [f64]) -> Result<(), NodeError> {
        self.step_with_data(step, output, &mut DataSpace::new(&mut []))
    }

    fn step_with_data(
        &mut self,
        step: &Step<'_>,
        output: &mut [f64],
        data: &mut DataSpace<'_>,
    ) -> Result<(), NodeError> {
        self.0.step(step, data)?.write_to(output);
        Ok(())
    }

    fn tuning(&mut self) -> Option<&mut dyn Tuning> {
        self.0.tuning()
    }

    fn stop(&mut self, why: Stopping) {
        self.0.stop(why);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn data_are_their_bytes_wherever_they_lie() {
        let owned = Data::from(&[1, 2, 3][..]);
        assert_eq!((&*owned, &*owned.clone()), (&[1, 2, 3][..], &[1, 2, 3][..]));
        assert_eq!(Data::default(), Data::from(&[][..]));
        assert_eq!(bytes(&[0x0807_0605_0403_0201]), [1, 2, 3, 4, 5, 6, 7, 8]);
    }

    #[test]
    fn more_than_was_declared_is_refused() {
        let mut room = [0; 4];
        let mut space = DataSpace::new(&mut room);
        space.take(3).unwrap().fill(7);
        assert_eq!((space.used(), space.capacity()), (3, 4));
        let error = space.take(5).unwrap_err().to_string();
        assert!(error.contains("5 bytes") && error.contains("4 at most"), "{error}");
    }
}
