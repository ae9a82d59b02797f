//! Which place of its node's history every message takes.
//!
//! A message takes a place from the moment that its step runs until the last step that reads it has run. Two messages
//! may share a place if these intervals do not overlap. In the order in which messages are made, any place that is free
//! will do, and as many places as intervals overlap at once are enough (colouring of an interval graph). Among the free
//! places the one is taken that the same slot took before, so that most slots read and write at constant places.

/// Where in the order of execution something happens: pass times slots, plus slot. `NEVER` is before everything.
pub(super) type Moment = i64;

/// Before everything.
pub(super) const NEVER: Moment = -1;

/// The messages of one node in one episode that are made, in that order.
#[derive(Debug, Default)]
pub(super) struct Lifetimes {
    /// When each is made, increasing.
    pub(super) made: Vec<Moment>,
    /// When each is read last; [`NEVER`] if it is not.
    pub(super) read: Vec<Moment>,
    /// When the initial message is read last; [`NEVER`] if it is not.
    pub(super) initial: Moment,
}

impl Lifetimes {
    /// How many places they need, at least 1. A step may overwrite what it reads.
    pub(super) fn places(&self) -> usize {
        let mut free_from = vec![self.initial];
        for (&made, &read) in self.made.iter().zip(&self.read) {
            match free_from.iter_mut().find(|free| **free <= made) {
                Some(free) => *free = read,
                None => free_from.push(read),
            }
        }
        free_from.len()
    }

    /// A place for every message, and one that holds the initial message while it is read. `places` is at least what
    /// [`places`](Self::places) says; `preferred` names a place for each message that is taken where it is free.
    pub(super) fn assign(&self, places: usize, preferred: impl Fn(usize) -> usize) -> (Vec<u32>, u32) {
        let mut free_from = vec![NEVER; places];
        let initial = places - 1;
        free_from[initial] = self.initial;
        let messages = self.made.iter().zip(&self.read).enumerate();
        let assigned = messages.map(|(message, (&made, &read))| {
            let wish = preferred(message) % places;
            let place =
                (0..places).map(|offset| (wish + offset) % places).find(|&place| free_from[place] <= made);
            let place = place.expect("as many places as messages that are alive at once");
            free_from[place] = read;
            place as u32
        });
        (assigned.collect(), initial as u32)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn places_are_as_many_as_messages_alive_at_once() {
        // Made at 0, 2, 4; read at 4, 3, 5: the third may overwrite the second, and the first at its own moment.
        let lives = Lifetimes { made: vec![0, 2, 4], read: vec![4, 3, 5], initial: NEVER };
        assert_eq!(lives.places(), 2);
        // The initial message is read at 3 and takes a place until then.
        assert_eq!(Lifetimes { initial: 3, ..lives }.places(), 3);
        let unread = Lifetimes { made: vec![0, 1, 2], read: vec![NEVER; 3], initial: NEVER };
        assert_eq!(unread.places(), 1);
    }

    #[test]
    fn a_wish_is_granted_where_the_place_is_free() {
        let lives = Lifetimes { made: vec![0, 1, 10, 11], read: vec![5, 6, 15, 16], initial: NEVER };
        assert_eq!(lives.assign(2, |message| (message + 1) % 2).0, [1, 0, 1, 0]);
        assert_eq!(lives.assign(2, |_| 0).0, [0, 1, 0, 1]);
    }
}
