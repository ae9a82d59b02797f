//! What the hybrid asks in each phase, and what it makes of the answers.

use super::{FAR, Hybrid, NEAR, Phase, SMALLEST_STEP, WORTH};
use crate::fit::sweep::along;
use crate::fit::{Ask, Best, Solver, Stop, Tell, View, ranked};

impl Solver for Hybrid {
    fn ask(&mut self) -> Ask {
        loop {
            let ask = match &mut self.phase {
                Phase::Scouting { points } => {
                    let view = View::whole(self.options.shares[0]);
                    return Ask::Losses { points: points.clone(), view, single: true };
                }
                Phase::Evolution(evolution) => evolution.ask(),
                Phase::Refinement { search, .. } | Phase::Shooting { search, .. } => search.ask(),
                Phase::Cutting { points } => {
                    let points = points.clone();
                    return Ask::States { points, view: self.in_pieces(0) };
                }
                Phase::Looking { point, .. } => {
                    return Ask::Locals { points: vec![point.clone()], view: View::whole(1.0) };
                }
                Phase::Sweeping { points, .. } => {
                    let (points, view) = (points.clone(), View::whole(1.0));
                    return Ask::Losses { points, view, single: false };
                }
                Phase::Done(stop) => return Ask::Done(*stop),
            };
            match ask {
                Ask::Done(_) => self.advance(),
                ask => return ask,
            }
        }
    }

    fn tell(&mut self, answer: Tell) {
        let most = 8 * self.leaders();
        match &mut self.phase {
            Phase::Scouting { points } => {
                let Tell::Losses(losses) = answer else { panic!("it asked for losses") };
                assert_eq!(losses.len(), points.len(), "a loss for every point asked for");
                let best = ranked(&losses).into_iter().take(most);
                let best = best.filter(|&k| losses[k].is_finite());
                let scouts = best.map(|k| Best { point: points[k].clone(), loss: losses[k] }).collect();
                self.scouts = scouts;
                let start = self.scouts.first().map_or(&self.start, |best| &best.point).clone();
                self.phase = match self.evolution(&start) {
                    Ok(evolution) => Phase::Evolution(evolution),
                    Err(_) => Phase::Done(Stop::Failed),
                };
            }
            Phase::Evolution(evolution) => {
                evolution.tell(answer);
                if self.options.shares[0] == 1.0
                    && let Some(Best { point, loss }) = evolution.best()
                {
                    Best::keep(&mut self.best, point, *loss);
                }
            }
            Phase::Refinement { share, search } => {
                let begins = search.best().is_none();
                search.tell(answer);
                let (share, best) = (*share, search.best());
                if share >= 1.0
                    && let Some(Best { point, loss }) = best
                {
                    Best::keep(&mut self.best, point, *loss);
                }
                let least = best.map_or(f64::INFINITY, |best| best.loss);
                let step = self.held.as_ref().map_or(0.0, |(held, _)| share / held);
                if self.swept.0 > 0 {
                    // Wherever it begins, it has seen all of the data.
                } else if begins && self.leapt && self.may_cut() {
                    if self.is_far(NEAR, share, least) {
                        self.phase = self.cutting();
                    }
                } else if begins && !self.shot && step > SMALLEST_STEP && self.is_far(FAR, share, least) {
                    self.phase = self.shrink(share).unwrap_or(Phase::Done(Stop::Failed));
                }
            }
            Phase::Shooting { search, .. } => search.tell(answer),
            Phase::Cutting { points } => {
                let Tell::States(found) = answer else { panic!("it asked for states") };
                assert_eq!(found.len(), points.len(), "states for every point asked for");
                self.phase = self.shooting(0, &found).unwrap_or(Phase::Done(Stop::Failed));
            }
            Phase::Looking { point, stop } => {
                let Tell::Locals(locals) = answer else { panic!("it asked for a model") };
                let (point, stop) = (point.clone(), *stop);
                let local = locals.first().filter(|local| local.is_finite());
                let points = local
                    .map_or_else(Vec::new, |local| along(&point, local, &self.bounds, &self.options.swept));
                self.phase = match points.is_empty() {
                    true => Phase::Done(stop),
                    false => Phase::Sweeping { points, stop },
                };
            }
            Phase::Sweeping { points, stop } => {
                let Tell::Losses(losses) = answer else { panic!("it asked for losses") };
                assert_eq!(losses.len(), points.len(), "a loss for every point asked for");
                let stop = *stop;
                let least =
                    ranked(&losses).first().map(|&k| Best { point: points[k].clone(), loss: losses[k] });
                let worth = |least: &Best| self.best.as_ref().is_none_or(|b| least.loss < b.loss - WORTH);
                self.phase = match least.filter(worth) {
                    Some(least) => self.refinement(1.0, &[least.point]).unwrap_or(Phase::Done(stop)),
                    None => Phase::Done(stop),
                };
            }
            Phase::Done(_) => panic!("it asked for nothing"),
        }
    }

    /// Before anything was seen of all the data: the best of what is being searched, with its loss on less.
    fn best(&self) -> Option<&Best> {
        let searched = match &self.phase {
            Phase::Scouting { .. } => None,
            Phase::Evolution(evolution) => evolution.best().or(self.scouts.first()),
            Phase::Refinement { search, .. } => search.best(),
            Phase::Cutting { .. } | Phase::Shooting { .. } => {
                self.held.as_ref().and_then(|(_, ends)| ends.first())
            }
            Phase::Looking { .. } | Phase::Sweeping { .. } | Phase::Done(_) => None,
        };
        self.best.as_ref().or(searched)
    }

    fn progress(&self) -> f64 {
        // The parts of a round: scouts and evolution, growing shares, pieces, and all of the data.
        let tightened = self.options.tightness.len().max(1) as f64;
        let within = match &self.phase {
            Phase::Scouting { .. } => 0.0,
            Phase::Evolution(evolution) => evolution.progress(),
            Phase::Refinement { share, .. } if *share < 1.0 => 1.0 + share,
            Phase::Cutting { .. } => 2.0,
            Phase::Shooting { step, search } => 2.0 + (*step as f64 + search.progress()) / tightened,
            Phase::Refinement { search, .. } => 3.0 + search.progress(),
            Phase::Looking { .. } | Phase::Sweeping { .. } => 4.0,
            Phase::Done(_) => return 1.0,
        };
        // Most fits need one round, or two that agree.
        let rounds = if self.options.target.is_some() { 1 } else { 2 }.max(self.round + 1) as f64;
        ((self.round as f64 + within / 4.0) / rounds).min(1.0)
    }
}
