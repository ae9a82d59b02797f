//! How a joint gain divides among its causes: Shapley's value.
//!
//! Two effects may close more together, or less, than each alone closes. Shapley's value is the mean, over all orders in
//! which they may be added, of what each adds (Shapley, "A value for n-person games", 1953); the parts sum to the whole.

/// Most causes that are divided among: the gain of every subset is asked for.
pub const MOST: usize = 12;

/// What each of `count` causes contributes to `gain(all)`; `gain` is asked for every subset, as a bit mask, once.
///
/// The parts sum to `gain(all) − gain(none)`. More than [`MOST`] causes share the whole equally.
#[must_use]
pub fn values(count: usize, gain: impl FnMut(usize) -> f64) -> Vec<f64> {
    if count == 0 {
        return Vec::new();
    }
    let mut gain = gain;
    if count > MOST {
        let whole = gain(usize::MAX) - gain(0);
        return vec![whole / count as f64; count];
    }
    let gains: Vec<f64> = (0..1_usize << count).map(gain).collect();
    // Of all orders, the share in which exactly `size` given others stand before a cause.
    let weight = |size: usize| {
        let choose = (0..size).fold(1.0, |c, k| c * (count - 1 - k) as f64 / (k + 1) as f64);
        1.0 / (count as f64 * choose)
    };
    (0..count)
        .map(|cause| {
            let bit = 1 << cause;
            let others = (0..gains.len()).filter(|set| set & bit == 0);
            others.map(|set| weight(set.count_ones() as usize) * (gains[set | bit] - gains[set])).sum()
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn independent_causes_keep_what_is_theirs() {
        let own = [0.5, 0.25, 0.125];
        let found = values(3, |set| (0..3).filter(|k| set >> k & 1 == 1).map(|k| own[k]).sum());
        assert!(found.iter().zip(own).all(|(a, b)| (a - b).abs() < 1e-15), "{found:?}");
    }

    #[test]
    fn what_only_both_achieve_is_shared_equally() {
        assert_eq!(values(2, |set| if set == 3 { 1.0 } else { 0.0 }), [0.5, 0.5]);
        // Either alone does it as well: again half each.
        assert_eq!(values(2, |set| if set == 0 { 0.0 } else { 1.0 }), [0.5, 0.5]);
    }

    proptest! {
        #[test]
        fn parts_sum_to_the_whole_and_equal_causes_have_equal_parts(
            count in 1_usize..6,
            gains in proptest::collection::vec(-1.0..1.0_f64, 64),
        ) {
            let found = values(count, |set| gains[set]);
            let whole = gains[(1 << count) - 1] - gains[0];
            prop_assert!((found.iter().sum::<f64>() - whole).abs() < 1e-12);
            // A gain that counts causes treats them alike.
            let alike = values(count, |set| gains[set.count_ones() as usize]);
            prop_assert!(alike.iter().all(|v| (v - alike[0]).abs() < 1e-12));
        }
    }
}
