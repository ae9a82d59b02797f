//! Doubt that a named effect is the cause, from what is left on held-out time with it.

/// Probability, at most, that a named effect is none of the cause because predictions on held-out time stay off; and the
/// share of the gap left there at which two thirds of it are reached. On development data an effect that closed 98 %
/// was the cause in 85 of 100 cases, one that closed 90 to 98 % in 75, one that closed less in 45.
const DOUBT: f64 = 0.45;
const LEFT: f64 = 0.1;

/// The same where innovations with the answer look like chance, as they do on a machine whose forces scatter: on development data of such
/// machines the answer was the cause in 12 of 13 cases that were doubted by more than a quarter.
const DOUBT_OF_CHANCE: f64 = 0.15;

/// Mean squared error above the floor, in units of it, at which two thirds of the doubt are reached where short windows reach the
/// sensors' noise. On development data an effect that was the cause left up to 0.8 for certain, a hysteresis that short windows took for
/// dry friction 1.9 to 7.7.
const ABOVE: f64 = 2.0;

/// Probability that whatever was found is not it, however clear the evidence among what was weighed: a search ended elsewhere, or a form
/// differs from the machine's. On development data 3 of 275 single causes that were named with more than 0.95 were not the cause, and of
/// earlier programs 48 of 1,343; of 30 of these the cause was not among the answers at all.
const SLIP: f64 = 0.02;

/// [`SLIP`], or less where there is rather a gap than none and it would put "none of these" before the `first` answer: how sure an
/// answer is stated must not decide which is named.
pub(super) fn slip(first: f64, unexplained: f64, no_gap: f64) -> f64 {
    let ahead = first - unexplained;
    if ahead > 0.0 && no_gap < 0.5 { SLIP.min(0.9 * ahead / (1.0 + ahead)) } else { SLIP }
}

/// What predictions of held-out time with the leading answer leave.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Left {
    /// Share of the gap that is closed.
    pub(crate) closed: f64,
    /// Mean squared error above what an exact model would have, in units of that, where short windows reach the sensors' noise; zero
    /// where they do not. States that are free in each window follow there what no prediction over a longer time does.
    pub(crate) above: f64,
    /// Whether innovations with the answer look like chance.
    pub(crate) by_chance: bool,
}

impl Left {
    /// The share of the `named` answers' probability that goes to none of them, where the `first` stays the likeliest.
    pub(super) fn doubted(self, first: f64, named: f64, unexplained: f64) -> f64 {
        let left = (1.0 - self.closed).max(0.0) / LEFT;
        let above = (self.above / ABOVE).powi(2);
        let most = 0.9 * (first - unexplained) / (first + named);
        // Not a number where there was nothing to close.
        let of = |doubt: f64, x: f64| doubt * (1.0 - (-x).exp());
        // What closes nothing is doubted however white it leaves the innovations: they are as white without it.
        let most_by_left = if self.by_chance && self.closed > 0.0 { DOUBT_OF_CHANCE } else { DOUBT };
        let by_left = of(most_by_left, left);
        let share = by_left.max(of(DOUBT, above)).min(most);
        if share > 0.0 { share } else { 0.0 }
    }
}

#[cfg(test)]
mod tests {
    use super::{Left, SLIP, slip};

    #[test]
    fn doubt_grows_with_what_is_left_and_never_takes_the_lead() {
        let of = |closed: f64, above: f64| Left { closed, above, by_chance: false }.doubted(0.9, 0.98, 0.01);
        let by_chance = |closed: f64| Left { closed, above: 0.0, by_chance: true }.doubted(0.9, 0.98, 0.01);
        let share = |closed: f64| of(closed, 0.0);
        assert_eq!((share(1.0), share(1.2), share(f64::NAN)), (0.0, 0.0, 0.0));
        assert!(share(0.99) < 0.05 && share(0.9) > 0.25 && share(0.5) > share(0.9) && share(-9.0) <= 0.45);
        assert!(
            of(1.0, 0.3) < 0.02 && of(1.0, 3.0) > 0.25 && of(0.5, 3.0) >= share(0.5) && of(1.0, 99.0) <= 0.45
        );
        assert!(by_chance(0.5) < 0.5 * share(0.5) && by_chance(0.5) > by_chance(0.9));
        assert_eq!(by_chance(-0.1), share(-0.1));
        for unexplained in [0.0, 0.1, 0.3, 0.39] {
            let (first, named) = (0.4, 1.0 - unexplained);
            let share = Left { closed: 0.0, above: 9.0, by_chance: false }.doubted(first, named, unexplained);
            assert!((1.0 - share) * first > unexplained + share * named);
        }
    }

    #[test]
    fn a_slip_never_decides_which_is_named() {
        assert_eq!(slip(0.95, 0.05, 0.0), SLIP);
        assert_eq!(slip(0.4, 0.5, 0.1), SLIP);
        assert_eq!(slip(0.01, 0.005, 0.98), SLIP, "nothing is named where there is no gap");
        for (first, unexplained) in [(0.443_f64, 0.424_f64), (0.35, 0.3499), (0.5, 0.45)] {
            let slip = slip(first, unexplained, 0.0);
            assert!((1.0 - slip) * first > slip + (1.0 - slip) * unexplained, "{first} {unexplained}");
        }
    }
}
