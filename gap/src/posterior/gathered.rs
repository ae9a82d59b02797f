//! What was fitted, gathered to be weighed: single effects in their best forms, and combinations that are worth theirs.

use crate::combine;
use crate::hypothesis::EffectAt;
use crate::judge::{EVEN, Judge};
use crate::search::Fit;
use crate::setup::Setup;

/// What was fitted, and what it takes to weigh it.
#[derive(Clone, Debug)]
pub struct Gathered {
    /// Single effects and combinations, the best first.
    pub(super) fits: Vec<Fit>,
    /// How many forms each had, of which the best is there.
    pub(super) forms: Vec<f64>,
    /// The number of single effects.
    pub(super) count: usize,
    /// Single effects in all of their forms, the best first, and all that were tried.
    all_forms: Vec<EffectAt>,
    tried: Vec<EffectAt>,
}

impl Gathered {
    /// Of single effects, of all that were `tried`: with the combinations that begin with them.
    #[must_use]
    pub fn new(setup: &Setup, null: &Fit, mut fits: Vec<Fit>, tried: &[EffectAt]) -> Self {
        let judge = Judge::new(null, &fits);
        let by_cost = |a: &Fit, b: &Fit| judge.cost(a).total_cmp(&judge.cost(b));
        fits.sort_by(by_cost);
        for (k, better) in combine::forms_to_spare(setup, null, &fits, &judge) {
            fits[k] = better;
        }
        fits.sort_by(by_cost);
        let all_forms: Vec<EffectAt> =
            fits.iter().filter_map(|f| f.hypothesis.effects.first().cloned()).collect();
        let forms = best_forms(&mut fits);
        let combined = combine::combinations(setup, null, &fits, (&all_forms, tried), &judge);
        let count = fits.len();
        let mut gathered = Gathered { fits, forms, count, all_forms, tried: tried.to_vec() };
        gathered.take(null, &judge, combined);
        gathered
    }

    /// The best fit, if it is worth its effects.
    #[must_use]
    pub fn best(&self, null: &Fit) -> Option<&Fit> {
        let judge = Judge::new(null, &self.fits);
        self.fits.first().filter(|best| judge.is_worth(best, null))
    }

    /// Takes in a hypothesis that was found beside the best one, where it is worth the further effect; `left` is what any other effect
    /// promises beside it.
    pub fn join(&mut self, setup: &Setup, null: &Fit, joint: Fit, left: f64) {
        let Some(best) = self.fits.first() else { return };
        let judge = Judge::new(null, self.fits.iter().chain([&joint]));
        if !combine::is_worth(setup, null, &judge, (&joint, best), || left) {
            return;
        }
        let (singles, found): (Vec<Fit>, Vec<Fit>) =
            self.fits.iter().cloned().partition(|fit| fit.hypothesis.effects.len() == 1);
        let forms = (self.all_forms.as_slice(), self.tried.as_slice());
        let more = combine::beside(setup, null, (&singles, &found), forms, joint);
        self.take(null, &judge, more);
    }

    /// Takes in combinations, and single effects that were fitted better, and puts all in order.
    fn take(&mut self, null: &Fit, judge: &Judge, more: Vec<Fit>) {
        let (singles, combined): (Vec<Fit>, Vec<Fit>) =
            more.into_iter().partition(|fit| fit.hypothesis.effects.len() == 1);
        for single in singles {
            let effects = &single.hypothesis.effects;
            let known = self.fits.iter_mut().find(|fit| fit.hypothesis.effects == *effects);
            if let Some(known) = known.filter(|known| judge.cost(&single) < judge.cost(known)) {
                *known = single;
            }
        }
        self.forms.resize(self.fits.len() + combined.len(), 1.0);
        self.fits.extend(combined);
        let (fits, judge) = (&self.fits, Judge::new(null, &self.fits));
        let mut order: Vec<usize> = (0..fits.len()).collect();
        order.sort_by(|a, b| judge.cost(&fits[*a]).total_cmp(&judge.cost(&fits[*b])).then(a.cmp(b)));
        // Of those that are even the one with the fewest effects leads.
        let even = order.iter().take_while(|k| judge.cost(&fits[**k]) < judge.cost(&fits[order[0]]) + EVEN);
        if let Some(first) = (0..even.count()).min_by_key(|k| fits[order[*k]].hypothesis.effects.len()) {
            order[..=first].rotate_right(1);
        }
        self.forms = order.iter().map(|k| self.forms[*k]).collect();
        self.fits = order.into_iter().map(|k| fits[k].clone()).collect();
    }
}

/// Keeps the best of an effect's forms at a place, from fits in the order of their cost. Gives how many forms each had:
/// they share the prior of the effect.
fn best_forms(fits: &mut Vec<Fit>) -> Vec<f64> {
    let labels: Vec<String> = fits.iter().map(|f| f.hypothesis.label()).collect();
    let mut forms = Vec::new();
    let mut index = 0;
    fits.retain(|_| {
        let first = !labels[..index].contains(&labels[index]);
        if first {
            forms.push(labels.iter().filter(|l| **l == labels[index]).count() as f64);
        }
        index += 1;
        first
    });
    forms
}
