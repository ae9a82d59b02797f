//! Whether innovations are random.

use super::Pass;

impl Pass {
    /// Variance of the sums of each output's innovations over times of this length (s), against that of as many independent ones: 1 where
    /// they are random, the largest of all outputs (the variance ratio of Lo & MacKinlay 1988).
    #[must_use]
    pub fn variance_ratio(&self, length: f64) -> f64 {
        let outputs = self.output.iter().map(|output| output + 1).max().unwrap_or(0);
        let mut sums = vec![(0.0, 0.0, 0.0); outputs];
        let mut block = vec![f64::NAN; outputs];
        let all = self.whitened().into_iter().zip(&self.output).zip(&self.stamp);
        for ((whitened, &output), stamp) in all {
            let (sum, squares, of_sums) = &mut sums[output];
            let own = (stamp / length).floor();
            if block[output] != own {
                *of_sums += *sum * *sum;
                (*sum, block[output]) = (0.0, own);
            }
            *sum += whitened;
            *squares += whitened * whitened;
        }
        let ratio = |(sum, squares, of_sums): &(f64, f64, f64)| (of_sums + sum * sum) / squares.max(1e-300);
        sums.iter().map(ratio).fold(0.0, f64::max)
    }
}

#[cfg(test)]
mod tests {
    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    use super::Pass;

    /// Two outputs at 100 Hz for 1000 s; the second one's readings lean on each other.
    fn walk(keeps: f64) -> Pass {
        let mut random = ChaCha8Rng::seed_from_u64(1);
        let (mut pass, mut last) = (Pass::default(), 0.0);
        for k in 0..200_000 {
            let fresh: f64 = random.random_range(-1.0..1.0);
            if k % 2 == 1 {
                last = keeps * last + fresh;
            }
            pass.innovation.push(if k % 2 == 0 { fresh } else { last });
            pass.variance.push(2.0);
            pass.output.push(k % 2);
            pass.stamp.push((k / 2) as f64 * 0.01);
        }
        pass
    }

    #[test]
    fn random_innovations_sum_up_as_independent_ones_do() {
        let ratio = walk(0.0).variance_ratio(0.25);
        assert!((0.8..1.3).contains(&ratio), "{ratio}");
    }

    /// That of a first-order process is (1 + ρ)/(1 − ρ) over long times (Lo & MacKinlay 1988).
    #[test]
    fn innovations_that_lean_on_each_other_sum_up_to_more() {
        let ratio = walk(0.5).variance_ratio(1.0);
        assert!((2.6..3.4).contains(&ratio), "{ratio}");
        assert!(walk(-0.5).variance_ratio(1.0) < 1.3, "the other output is random");
    }
}
