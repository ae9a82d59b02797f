//! Where a function of one number is largest, by golden section (Kiefer 1953).

/// The middle of what is left of a range after so many steps. Each asks for one value of the function, of which one maximum is found.
pub(super) fn golden((mut low, mut high): (f64, f64), steps: usize, mut of: impl FnMut(f64) -> f64) -> f64 {
    let ratio = 0.5 * (5.0_f64.sqrt() - 1.0);
    let mut at = |x: f64| (x, of(x));
    let (mut left, mut right) = (at(high - ratio * (high - low)), at(low + ratio * (high - low)));
    for _ in 0..steps {
        // One of the two points is one of the next two.
        if left.1 > right.1 {
            (high, right) = (right.0, left);
            left = at(high - ratio * (high - low));
        } else {
            (low, left) = (left.0, right);
            right = at(low + ratio * (high - low));
        }
    }
    0.5 * (low + high)
}

#[cfg(test)]
mod tests {
    use super::golden;

    #[test]
    fn a_maximum_is_found_inside_and_at_an_end() {
        let mut asked = 0;
        let found = golden((-1.0, 3.0), 30, |x| {
            asked += 1;
            -(x - 0.7).abs()
        });
        assert!((found - 0.7).abs() < 1e-5 && asked == 32, "{found} after {asked}");
        assert!((golden((-1.0, 3.0), 30, |x| x) - 3.0).abs() < 1e-5);
    }
}
