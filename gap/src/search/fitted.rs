//! A hypothesis, fitted, and what can be asked of it.

use parallax_model::effect::Quantity;
use parallax_model::plant::Residual;
use parallax_model::system::{JointValues, Point};

use crate::fit::{Minimum, TEMPERATURE};
use crate::hypothesis::{Hypothesis, Slot};
use crate::innovation::InnovationFit;
use crate::library;
use crate::quantify;
use crate::setup::Setup;
use crate::windows::Shot;

/// A hypothesis, fitted.
#[derive(Clone, Debug)]
pub struct Fit {
    /// What was fitted.
    pub hypothesis: Hypothesis,
    /// The flexible residuals it carries.
    pub residuals: Vec<Residual>,
    /// Its fit by innovation likelihood.
    pub innovation: InnovationFit,
    /// Its fit by short windows, and N log(SSE/N) with the priors.
    pub shooting: Minimum,
    /// −2 log evidence of the short windows.
    pub shooting_cost: f64,
    /// Mean squared residual of the short windows, in noise units squared.
    pub shooting_error: f64,
    /// The same for each output.
    pub output_errors: Vec<f64>,
    /// Standard deviations of the short windows' estimate, robust to residuals that are correlated within a window.
    shooting_std: Vec<f64>,
    /// The same for the estimate by innovation likelihood, robust to innovations that are correlated.
    innovation_std: Vec<f64>,
    /// How many independent readings one reading of the windows is worth, at most 1.
    pub independence: f64,
    /// Variance ratio of the innovations over a window's time: 1 where they are random.
    pub variance_ratio: f64,
    /// Whether the estimate is that of the short windows.
    by_windows: bool,
}

/// Mean squared residual of the windows, in noise units squared, from which a model counts as inexact.
pub const INEXACT: f64 = 1.5;

/// Share of a parameter's range within which it counts as resting on a bound.
pub const RESTS: f64 = 1e-3;

/// Standard deviations from its null at which a parameter counts as found.
const SIGNIFICANT: f64 = 3.0;

/// Mean squared error of predictions, against that with the likelihood's parameters, up to which those of the windows are taken.
const WORSE: f64 = 1.2;

/// Natural sizes of a parameter that count as its range where that is wider.
const SIZES: f64 = 50.0;

impl Fit {
    /// What the system says of each joint at every reading of the time that is fitted, at the calibrated values of the fit.
    pub(crate) fn joints(&self, setup: &Setup) -> Vec<Vec<JointValues<f64>>> {
        let (system, pass) = (setup.equations.system(), &self.innovation.pass);
        let mut parameters = setup.equations.nominal();
        for (fitted, value) in self.hypothesis.fitted.iter().zip(self.theta()) {
            if let Slot::Nominal(index) = fitted.slot {
                parameters[index] = *value;
            }
        }
        let n = system.states.len();
        let mut joints: Vec<Vec<JointValues<f64>>> = vec![Vec::new(); system.joints.len()];
        for (stamp, state) in pass.stamp.iter().zip(pass.state.chunks(pass.states().max(1))) {
            let inputs: Vec<f64> = setup.experiment.inputs.iter().map(|held| held.at(*stamp)).collect();
            let point = Point { parameters: &parameters, states: &state[..n], inputs: &inputs, time: *stamp };
            let lets = setup.equations.lets(&point, &[]);
            for (joint, values) in joints.iter_mut().enumerate() {
                values.push(setup.equations.joint(joint, &point, &lets));
            }
        }
        joints
    }

    /// Of what both losses found.
    pub(super) fn assemble(
        setup: &Setup,
        hypothesis: Hypothesis,
        residuals: Vec<Residual>,
        innovation: InnovationFit,
        shot: Shot,
    ) -> Self {
        let by_windows =
            shot.error(setup) > INEXACT && shot.minimum.theta.len() == innovation.minimum.theta.len();
        Fit {
            by_windows,
            hypothesis,
            residuals,
            shooting_cost: shot.cost,
            shooting_error: shot.error(setup),
            output_errors: shot.output_errors(setup),
            shooting_std: shot.std(),
            innovation_std: innovation.std(),
            independence: shot.independence(),
            variance_ratio: innovation.pass.variance_ratio(setup.horizon),
            shooting: shot.minimum,
            innovation,
        }
    }

    /// Whether a parameter ended on one of its bounds: the data ask for more than it may move.
    #[must_use]
    pub fn rests(&self, parameter: usize) -> bool {
        let (fitted, value) = (&self.hypothesis.fitted[parameter], self.theta()[parameter]);
        let near = RESTS * (fitted.high - fitted.low).min(SIZES * fitted.scale);
        near.is_finite() && (value - fitted.low <= near || fitted.high - value <= near)
    }

    /// Whether a fit that leaves more than noise has pushed a calibrated parameter to its bound: to stand in for what it lacks,
    /// it has left the region where the machine is, and what it lacks may not be reached from there.
    #[must_use]
    pub fn is_strained(&self) -> bool {
        self.shooting_error > INEXACT && self.is_at_bound()
    }

    /// Whether a calibrated parameter ended on its bound: the data ask for more than the machine is said to allow.
    #[must_use]
    pub fn is_at_bound(&self) -> bool {
        let calibrated = |k: &usize| matches!(self.hypothesis.fitted[*k].slot, Slot::Nominal(_));
        (0..self.hypothesis.fitted.len()).filter(calibrated).any(|k| self.rests(k))
    }

    /// Whether a parameter of an effect does not differ from its null: it speaks for a form without it.
    #[must_use]
    pub fn has_spare(&self, effect: usize) -> bool {
        let (fitted, value, std) = (&self.hypothesis.fitted, self.estimate(), self.untempered());
        let near = |k: usize| (value[k] - fitted[k].null).abs() < SIGNIFICANT * std[k];
        self.hypothesis.of_effect(effect).any(near)
    }

    /// Whether an effect ended where it changes nothing. How a lag of no time is damped is no matter.
    pub(crate) fn is_nothing(&self, effect: usize) -> bool {
        let of = self.hypothesis.effects[effect].effect.parameters();
        let shapes = |k: usize| match self.hypothesis.fitted[k].slot {
            Slot::Effect { parameter, .. } => of[parameter].quantity == Quantity::Damping,
            _ => false,
        };
        self.hypothesis.of_effect(effect).all(|k| shapes(k) || self.at_null(k))
    }

    fn at_null(&self, parameter: usize) -> bool {
        let fitted = &self.hypothesis.fitted[parameter];
        (self.estimate()[parameter] - fitted.null).abs() < RESTS * fitted.scale
    }

    /// The parameters by innovation likelihood, at which the evidence was taken.
    #[must_use]
    pub fn theta(&self) -> &[f64] {
        &self.innovation.minimum.theta
    }

    /// The parameters to report and to predict with.
    ///
    /// Where the model reaches the sensor's noise the likelihood is efficient. Where it does not, as on any real
    /// machine, one-step predictions are ruled by what the model lacks, and the short windows are the better judge:
    /// they ask for what the simulator is for, a prediction over the horizon; unless they were found to predict worse
    /// ([`Fit::hold_to_predictions`]).
    #[must_use]
    pub fn estimate(&self) -> &[f64] {
        if self.by_windows { &self.shooting.theta } else { self.theta() }
    }

    /// Standard deviations of [`Fit::estimate`], of the posterior at the temperature of the answers' probabilities.
    #[must_use]
    pub fn std(&self) -> Vec<f64> {
        self.untempered().iter().map(|std| TEMPERATURE.sqrt() * std).collect()
    }

    /// The same as the likelihood has them.
    fn untempered(&self) -> &[f64] {
        if self.by_windows { &self.shooting_std } else { &self.innovation_std }
    }

    /// Widens the intervals by what the parameters differ by from those of the same hypothesis in coarser steps: where each halving of the
    /// steps halves what they are off by, as much as that is left.
    pub(super) fn widen_by_change(&mut self, coarser: &Fit) {
        let widen = |std: &mut [f64], (theta, before): (&[f64], &[f64])| {
            for (std, (value, before)) in std.iter_mut().zip(theta.iter().zip(before)) {
                // What is reported is tempered, and this is no matter of evidence.
                *std = std.hypot((value - before) / TEMPERATURE.sqrt());
            }
        };
        widen(&mut self.shooting_std, (&self.shooting.theta, &coarser.shooting.theta));
        widen(&mut self.innovation_std, (&self.innovation.minimum.theta, &coarser.innovation.minimum.theta));
    }

    /// Has the estimate be that of the innovation likelihood where this one predicts the fitted stretches better from what its filter
    /// knew: windows choose their first states freely, and what is flexible may live by that.
    pub fn hold_to_predictions(&mut self, setup: &Setup) {
        if !self.by_windows {
            return;
        }
        let error = |theta: &[f64]| self.error_ahead(setup, theta);
        self.by_windows = error(&self.shooting.theta) <= WORSE * error(self.theta());
    }

    /// Mean squared error of predictions of the fitted stretches over the horizon from what the filter knew, in noise units squared.
    pub(crate) fn error_ahead(&self, setup: &Setup, theta: &[f64]) -> f64 {
        let simulator = library::simulator(setup, &self.hypothesis, self.residuals.clone());
        let fitted = Setup { test: setup.train.clone(), ..setup.clone() };
        quantify::predict(&fitted, &simulator, theta, &self.innovation.noise).mean_square()
    }
}
