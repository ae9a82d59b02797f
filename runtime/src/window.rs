//! What one input of one step sees.

use crate::data::Data;
use crate::node::Consumed;

/// What one input of one step sees: the last `window` messages, oldest first, as leaves, and their [data](crate::data).
///
/// It is filled anew for every step and keeps its memory.
#[derive(Debug, Clone)]
pub struct InputWindow {
    port: String,
    leaves: usize,
    window: usize,
    stamps: Vec<Consumed>,
    values: Vec<f64>,
    superseded: u64,
    /// The data of messages, by place; empty where messages have none.
    data: Vec<Data>,
    /// The place of each message that is seen.
    places: Vec<usize>,
    /// Whether the places belong to an inbox, which fills them as messages arrive, or each step fills them anew.
    kept: bool,
}

/// The place of a message that has no data.
const NOWHERE: usize = usize::MAX;

impl PartialEq for InputWindow {
    fn eq(&self, other: &Self) -> bool {
        let alike = (&self.port, self.leaves, self.window, self.superseded)
            == (&other.port, other.leaves, other.window, other.superseded);
        alike
            && self.stamps == other.stamps
            && self.values == other.values
            && (0..self.stamps.len()).all(|index| self.data(index) == other.data(index))
    }
}

impl InputWindow {
    /// An empty window for the input `port`, with room for `window` messages of `leaves` leaves.
    pub fn new(port: impl Into<String>, leaves: usize, window: usize) -> Self {
        Self {
            port: port.into(),
            leaves,
            window,
            stamps: Vec::with_capacity(window),
            values: Vec::with_capacity(window * leaves),
            superseded: 0,
            data: Vec::new(),
            places: Vec::with_capacity(window),
            kept: false,
        }
    }

    /// The window with so many places for data.
    pub(crate) fn with_places(mut self, places: usize) -> Self {
        self.data.resize_with(places, Data::default);
        self.kept = places > 0;
        self
    }

    /// The input's name.
    pub fn port(&self) -> &str {
        &self.port
    }

    /// How many messages a step sees.
    pub fn capacity(&self) -> usize {
        self.window
    }

    /// The messages, oldest first.
    pub fn stamps(&self) -> &[Consumed] {
        &self.stamps
    }

    /// The leaves of message `index`, oldest first.
    ///
    /// # Panics
    ///
    /// When there is no such message.
    #[inline]
    pub fn payload(&self, index: usize) -> &[f64] {
        &self.values[index * self.leaves..(index + 1) * self.leaves]
    }

    /// The [data](crate::data) of message `index`, oldest first; empty where it has none.
    ///
    /// # Panics
    ///
    /// When there is no such message.
    pub fn data(&self, index: usize) -> &[u8] {
        self.data.get(self.places[index]).map_or(&[], |data| data)
    }

    /// How many messages left unseen between the last step and this one.
    pub fn superseded(&self) -> u64 {
        self.superseded
    }

    /// Empties the window for the next step.
    pub fn clear(&mut self, superseded: u64) {
        self.stamps.clear();
        self.values.clear();
        self.places.clear();
        if !self.kept {
            self.data.clear();
        }
        self.superseded = superseded;
    }

    /// Appends a message, newer than those before.
    ///
    /// # Panics
    ///
    /// When `payload` has not as many leaves as the input's messages.
    #[inline]
    pub fn push(&mut self, stamp: Consumed, payload: &[f64]) {
        self.show(stamp, payload, NOWHERE);
    }

    /// Appends a message with data, newer than those before.
    ///
    /// # Panics
    ///
    /// When `payload` has not as many leaves as the input's messages.
    pub fn push_with_data(&mut self, stamp: Consumed, payload: &[f64], data: Data) {
        let place = if data.is_empty() || self.kept { NOWHERE } else { self.data.len() };
        if place != NOWHERE {
            self.data.push(data);
        }
        self.show(stamp, payload, place);
    }

    /// Appends a message whose data are at `place`.
    #[inline]
    pub(crate) fn show(&mut self, stamp: Consumed, payload: &[f64], place: usize) {
        assert_eq!(payload.len(), self.leaves, "input `{}`: wrong number of leaves", self.port);
        self.stamps.push(stamp);
        self.values.extend_from_slice(payload);
        self.places.push(place);
    }

    /// Puts data at a place, and lets go of those that were there.
    pub(crate) fn keep(&mut self, place: usize, data: Data) {
        if let Some(at) = self.data.get_mut(place) {
            *at = data;
        }
    }
}
