//! Sets of columns of sensitivities: those that can differ from zero.

/// Most columns that a set can hold: more than one diagnosis ever fits.
pub const MOST: usize = 256;

/// A set of columns.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Columns([u64; MOST / 64]);

impl Columns {
    /// Adds a column, which must be below [`MOST`].
    pub fn insert(&mut self, column: usize) {
        self.0[column / 64] |= 1 << (column % 64);
    }

    /// Adds the columns from `first` up to `end`, not included.
    pub fn insert_all(&mut self, first: usize, end: usize) {
        (first..end).for_each(|column| self.insert(column));
    }

    /// Takes out all columns below `end`.
    pub fn clear_below(&mut self, end: usize) {
        for (k, word) in self.0.iter_mut().enumerate() {
            let gone = end.saturating_sub(64 * k);
            *word &= if gone >= 64 { 0 } else { u64::MAX << gone };
        }
    }

    /// Adds the columns of another set; gives whether that changed anything.
    pub fn extend(&mut self, other: &Columns) -> bool {
        let before = *self;
        self.0.iter_mut().zip(&other.0).for_each(|(own, other)| *own |= other);
        *self != before
    }

    /// The columns in order.
    pub fn iter(&self) -> impl Iterator<Item = usize> + '_ {
        self.0.iter().enumerate().flat_map(|(k, word)| {
            let mut left = *word;
            std::iter::from_fn(move || {
                (left != 0).then(|| {
                    let bit = left.trailing_zeros() as usize;
                    left &= left - 1;
                    64 * k + bit
                })
            })
        })
    }

    /// Whether a column is in the set.
    #[must_use]
    pub fn contains(&self, column: usize) -> bool {
        self.0[column / 64] >> (column % 64) & 1 == 1
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_set_holds_what_was_put_in() {
        let mut set = Columns::default();
        for column in [0, 5, 63, 64, 130, 255] {
            set.insert(column);
        }
        assert_eq!(set.iter().collect::<Vec<_>>(), [0, 5, 63, 64, 130, 255]);
        set.clear_below(64);
        assert_eq!(set.iter().collect::<Vec<_>>(), [64, 130, 255]);
        let mut other = Columns::default();
        other.insert_all(1, 3);
        assert!(set.extend(&other) && !set.extend(&other));
        assert!(set.contains(2) && !set.contains(3));
        set.clear_below(200);
        assert_eq!(set.iter().collect::<Vec<_>>(), [255]);
    }
}
