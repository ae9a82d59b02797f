//! How far the candidates are from each other under one input, and which of them it leaves together.

use super::DECISIVE;

/// Separations δ of all pairs, in noise units: of each the smaller of the two, whichever of the pair is the truth.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Apart {
    count: usize,
    /// candidates × candidates, symmetric.
    separation: Vec<f64>,
}

impl Apart {
    /// Of `count` candidates, of which nothing is known yet.
    pub(super) fn nowhere(count: usize) -> Self {
        Apart { count, separation: vec![f64::INFINITY; count * count] }
    }

    /// Keeps a separation of two candidates where it is smaller than the one that is known; what is no number is none.
    pub(super) fn keep(&mut self, truth: usize, other: usize, separation: f64) {
        let separation = if separation.is_nan() { 0.0 } else { separation };
        for at in [truth * self.count + other, other * self.count + truth] {
            self.separation[at] = self.separation[at].min(separation);
        }
    }

    fn of(&self, a: usize, b: usize) -> f64 {
        self.separation[a * self.count + b]
    }

    /// The nearest pair and its separation.
    pub(super) fn worst(&self) -> ((usize, usize), f64) {
        let alone: Vec<Vec<usize>> = (0..self.count).map(|k| vec![k]).collect();
        self.between(&alone)
    }

    /// Whether every pair is separated.
    pub(super) fn all(&self) -> bool {
        is_enough(self.worst().1)
    }

    /// The candidates in groups, in their order: those that a chain of pairs which are not separated holds together.
    pub(super) fn groups(&self) -> Vec<Vec<usize>> {
        let mut group: Vec<usize> = (0..self.count).collect();
        for a in 0..self.count {
            for b in a + 1..self.count {
                if !is_enough(self.of(a, b)) {
                    let (from, to) = (group[b].max(group[a]), group[b].min(group[a]));
                    group.iter_mut().filter(|g| **g == from).for_each(|g| *g = to);
                }
            }
        }
        let members = |of: usize| (0..self.count).filter(|k| group[*k] == of).collect::<Vec<usize>>();
        (0..self.count).map(members).filter(|members| !members.is_empty()).collect()
    }

    /// The nearest pair of candidates in different groups, and its separation; of one group the nearest pair in it.
    pub(super) fn between(&self, groups: &[Vec<usize>]) -> ((usize, usize), f64) {
        let group = |k: usize| groups.iter().position(|members| members.contains(&k));
        let pairs = (0..self.count).flat_map(|a| (a + 1..self.count).map(move |b| (a, b)));
        let across = pairs.filter(|(a, b)| groups.len() < 2 || group(*a) != group(*b));
        let nearest = across.min_by(|a, b| self.of(a.0, a.1).total_cmp(&self.of(b.0, b.1)));
        nearest.map_or(((0, 0), 0.0), |pair| (pair, self.of(pair.0, pair.1)))
    }
}

/// Whether a separation is enough for two to be told apart.
pub(super) fn is_enough(separation: f64) -> bool {
    separation * separation >= DECISIVE
}

#[cfg(test)]
mod tests {
    use super::*;

    fn apart(pairs: &[(usize, usize, f64)], count: usize) -> Apart {
        let mut apart = Apart::nowhere(count);
        pairs.iter().for_each(|(a, b, separation)| apart.keep(*a, *b, *separation));
        apart
    }

    #[test]
    fn the_smaller_of_two_directions_counts() {
        let apart = apart(&[(0, 1, 9.0), (1, 0, 7.0), (0, 2, 8.0), (1, 2, 30.0)], 3);
        assert_eq!(apart.worst(), ((0, 1), 7.0));
        assert!(apart.all());
        assert_eq!(apart.groups(), [[0], [1], [2]]);
    }

    #[test]
    fn what_one_pair_leaves_together_is_a_group() {
        let apart =
            apart(&[(0, 1, 0.1), (0, 2, 8.0), (1, 2, 6.0), (3, 0, 9.0), (3, 1, 9.0), (2, 3, f64::NAN)], 4);
        assert!(!apart.all());
        assert_eq!(apart.groups(), [[0, 1], [2, 3]]);
        assert_eq!(apart.between(&apart.groups()), ((1, 2), 6.0));
    }

    #[test]
    fn a_chain_of_neighbours_is_one_group_with_its_nearest_pair() {
        let apart = apart(&[(0, 1, 8.0), (0, 2, 1.0), (1, 2, 2.0)], 3);
        assert_eq!(apart.groups(), [[0, 1, 2]]);
        assert_eq!(apart.between(&apart.groups()), ((0, 2), 1.0));
    }
}
