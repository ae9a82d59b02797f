//! Damped Gauss–Newton in a box, from several starts side by side.
//!
//! K. Levenberg (1944) and D. W. Marquardt (1963). Every start asks for the Gauss–Newton model where it is, then for the
//! losses of steps under several dampings at once: batch evaluators give them for the price of one, and the best of them is
//! taken. Derivatives are whatever the evaluator's [`Local`] holds; exact ones come from dual numbers.

use nalgebra::{DMatrix, DVector};
use serde::{Deserialize, Serialize};

use super::{Ask, Best, Bounds, FitError, Local, Solver, Stop, Tell, View, bounded_step};

/// Settings of [`LevenbergMarquardt`].
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct MarquardtOptions {
    /// Most steps of each start.
    pub iterations: usize,
    /// A gain in the loss that is not worth a step. Where the loss is −2 log likelihood, 0.01 is a tenth of a standard
    /// deviation of one parameter.
    pub gain: f64,
    /// How many dampings are tried at once.
    pub dampings: usize,
    /// The first damping.
    pub damping: f64,
    /// It ends when a loss is as low as this.
    pub target: Option<f64>,
    /// A loss that is worth having: a start is given up that would not come to it by the last step at the pace of its latest
    /// ones. So is one that would not come near the best of the others.
    pub worth: Option<f64>,
    /// The data that count.
    pub view: View,
}

impl Default for MarquardtOptions {
    fn default() -> Self {
        Self {
            iterations: 50,
            gain: 1e-2,
            dampings: 5,
            damping: 1e-3,
            target: None,
            worth: None,
            view: View::whole(1.0),
        }
    }
}

/// One start on its way.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
struct Track {
    point: Vec<f64>,
    /// What is known around the point.
    local: Option<Local>,
    /// The loss there, where it is known.
    #[serde(default)]
    loss: Option<f64>,
    damping: f64,
    steps: usize,
    done: bool,
    /// Steps that are being tried, with their dampings.
    trials: Vec<(Vec<f64>, f64)>,
    /// What the last steps gained, the newest first.
    #[serde(default)]
    gains: Vec<f64>,
}

/// Levenberg–Marquardt on exact derivatives.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct LevenbergMarquardt {
    options: MarquardtOptions,
    bounds: Bounds,
    scale: Vec<f64>,
    tracks: Vec<Track>,
    best: Option<Best>,
    stop: Option<Stop>,
}

/// Dampings that are tried at once differ by this factor.
const STEP: f64 = 20.0;
/// Steps are tried as well for which each parameter has a normal prior around where it is, with so many standard deviations
/// in its scale, squared: they are whole in what the data tell, however it is mixed with what they do not.
const RIDGES: [f64; 2] = [3.0, 100.0];
/// The pace of a start is the largest of so many gains.
const PACE: usize = 3;
/// Above this damping, steps are too short to matter.
const LARGEST: f64 = 1e9;
/// Below this one, steps are those of Gauss–Newton.
const SMALLEST: f64 = 1e-12;

impl LevenbergMarquardt {
    /// Searches that begin at `starts`.
    ///
    /// # Errors
    ///
    /// [`FitError`] when a start does not fit the bounds, or an option is impossible.
    pub fn new(bounds: Bounds, starts: &[Vec<f64>], options: MarquardtOptions) -> Result<Self, FitError> {
        if options.dampings == 0 {
            let problem = "at least one damping has to be tried";
            return Err(FitError::Option { name: "dampings", value: 0.0, problem });
        }
        let mut tracks = Vec::with_capacity(starts.len());
        for start in starts {
            bounds.check(start)?;
            let mut point = start.clone();
            bounds.clamp(&mut point);
            tracks.push(Track {
                point,
                local: None,
                loss: None,
                damping: options.damping,
                steps: 0,
                done: false,
                trials: Vec::new(),
                gains: Vec::new(),
            });
        }
        let first = starts.first().map_or(&[][..], Vec::as_slice);
        let scale = first.iter().enumerate().map(|(i, x)| bounds.scale(i, *x)).collect();
        let stop = (bounds.is_empty() || starts.is_empty()).then_some(Stop::Converged);
        Ok(Self { options, bounds, scale, tracks, best: None, stop })
    }

    /// Where every start is now, with its loss where that is known.
    pub fn ends(&self) -> impl Iterator<Item = (&[f64], Option<f64>)> {
        self.tracks.iter().map(|track| (track.point.as_slice(), track.loss))
    }

    /// Prepares the steps of a track that knows its surroundings; it is done where none promises a gain.
    fn prepare(&self, track: &mut Track) {
        let Some(local) = track.local.as_ref().filter(|local| local.is_finite()) else {
            track.done = true;
            return;
        };
        let n = track.point.len();
        let hessian = DMatrix::from_row_slice(n, n, &local.information);
        let gradient = DVector::from_row_slice(&local.gradient);
        let corners = [self.bounds.low(), self.bounds.high(), &self.scale];
        let step = |damping| bounded_step(corners, &track.point, &hessian, &gradient, damping);
        // What the quadratic model promises without damping: the gradient is half that of the loss.
        let gain = |step: &Vec<f64>| -step.iter().zip(gradient.iter()).map(|(d, g)| d * g).sum::<f64>();
        let promised = step(SMALLEST).as_ref().map(gain);
        if track.steps >= self.options.iterations || promised.is_some_and(|gain| gain < self.options.gain) {
            track.done = true;
            return;
        }
        let middle = (self.options.dampings as f64 - 1.0) / 2.0;
        for k in 0..self.options.dampings {
            let damping = (track.damping * STEP.powf(k as f64 - middle)).clamp(SMALLEST, LARGEST);
            let Some(step) = step(damping) else { continue };
            let mut trial: Vec<f64> = track.point.iter().zip(&step).map(|(x, d)| x + d).collect();
            self.bounds.clamp(&mut trial);
            if trial != track.point && track.trials.iter().all(|(other, _)| *other != trial) {
                track.trials.push((trial, damping));
            }
        }
        for ridge in RIDGES {
            let mut ridged = hessian.clone();
            for (i, scale) in self.scale.iter().enumerate() {
                ridged[(i, i)] += ridge / (scale * scale);
            }
            let step = bounded_step(corners, &track.point, &ridged, &gradient, SMALLEST);
            let Some(step) = step else { continue };
            let mut trial: Vec<f64> = track.point.iter().zip(&step).map(|(x, d)| x + d).collect();
            self.bounds.clamp(&mut trial);
            if trial != track.point && track.trials.iter().all(|(other, _)| *other != trial) {
                track.trials.push((trial, track.damping));
            }
        }
        track.done = track.trials.is_empty();
    }

    /// Takes the best of the steps tried.
    fn judge(&self, track: &mut Track, losses: &[f64]) {
        let trials = std::mem::take(&mut track.trials);
        let now = track.local.as_ref().map_or(f64::INFINITY, |local| local.cost);
        let tried = trials.into_iter().zip(losses).filter(|(_, loss)| loss.is_finite());
        let best = tried.min_by(|a, b| a.1.total_cmp(b.1));
        track.steps += 1;
        match best {
            Some(((point, damping), loss)) if *loss < now => {
                track.gains.insert(0, now - loss);
                track.gains.truncate(PACE);
                track.done = now - loss < self.options.gain || self.is_behind(track, *loss);
                track.point = point;
                track.loss = Some(*loss);
                track.damping = (damping / STEP.sqrt()).clamp(SMALLEST, LARGEST);
                track.local = None;
            }
            _ => {
                // All too long: shorter ones next.
                let longest = track.damping * STEP.powf((self.options.dampings as f64 + 1.0) / 2.0);
                track.done = longest > LARGEST;
                track.damping = longest.max(SMALLEST);
            }
        }
    }

    /// Whether a track that has come to this loss ends, at its pace, at nothing that is worth having.
    fn is_behind(&self, track: &Track, loss: f64) -> bool {
        let left = self.options.iterations.saturating_sub(track.steps) as f64;
        let pace = track.gains.iter().copied().fold(0.0, f64::max);
        let least = self.best.as_ref().map_or(f64::INFINITY, |best| best.loss);
        let worth = self.options.worth.map_or(f64::INFINITY, |worth| worth.max(least));
        track.gains.len() == PACE && loss - left * pace > worth.min(not_worse(least))
    }

    /// Whether a track has to be told its surroundings.
    fn needs_local(track: &Track) -> bool {
        track.local.is_none() && !track.done
    }
}

/// A loss that is hardly worse than the least.
pub(super) fn not_worse(least: f64) -> f64 {
    least + 2.0 * least.abs() + 10.0
}

impl Solver for LevenbergMarquardt {
    fn ask(&mut self) -> Ask {
        let view = self.options.view;
        loop {
            if let Some(stop) = self.stop {
                return Ask::Done(stop);
            }
            let points: Vec<Vec<f64>> =
                self.tracks.iter().filter(|t| Self::needs_local(t)).map(|t| t.point.clone()).collect();
            if !points.is_empty() {
                return Ask::Locals { points, view };
            }
            let mut tracks = std::mem::take(&mut self.tracks);
            for track in tracks.iter_mut().filter(|track| !track.done && track.trials.is_empty()) {
                self.prepare(track);
            }
            self.tracks = tracks;
            let points: Vec<Vec<f64>> =
                self.tracks.iter().flat_map(|t| t.trials.iter().map(|(point, _)| point.clone())).collect();
            if !points.is_empty() {
                return Ask::Losses { points, view, single: false };
            }
            let out = self.tracks.iter().any(|track| track.steps >= self.options.iterations);
            self.stop = Some(match (&self.best, out) {
                (None, _) => Stop::Failed,
                (Some(_), true) => Stop::Budget,
                (Some(_), false) => Stop::Converged,
            });
        }
    }

    fn tell(&mut self, answer: Tell) {
        match answer {
            Tell::Locals(locals) => {
                let waiting: Vec<&mut Track> =
                    self.tracks.iter_mut().filter(|t| Self::needs_local(t)).collect();
                assert_eq!(waiting.len(), locals.len(), "a model for every point asked for");
                for (track, local) in waiting.into_iter().zip(locals) {
                    Best::keep(&mut self.best, &track.point, local.cost);
                    track.done |= !local.is_finite();
                    track.loss = Some(local.cost);
                    track.local = Some(local);
                }
            }
            Tell::States(_) => panic!("it asked for no states"),
            Tell::Losses(losses) => {
                let mut tracks = std::mem::take(&mut self.tracks);
                let mut losses = losses.as_slice();
                for track in tracks.iter_mut().filter(|track| !track.trials.is_empty()) {
                    let (own, rest) = losses.split_at(track.trials.len());
                    losses = rest;
                    for ((point, _), loss) in track.trials.iter().zip(own) {
                        Best::keep(&mut self.best, point, *loss);
                    }
                    self.judge(track, own);
                }
                assert!(losses.is_empty(), "a loss for every point asked for");
                self.tracks = tracks;
            }
        }
        if self.best.as_ref().zip(self.options.target).is_some_and(|(best, target)| best.loss <= target) {
            self.stop = Some(Stop::Target);
        }
    }

    fn best(&self) -> Option<&Best> {
        self.best.as_ref()
    }

    fn progress(&self) -> f64 {
        if self.stop.is_some() {
            return 1.0;
        }
        let all = (self.tracks.len() * self.options.iterations).max(1) as f64;
        let of = |track: &Track| if track.done { self.options.iterations } else { track.steps };
        (self.tracks.iter().map(of).sum::<usize>() as f64 / all).min(1.0)
    }
}
