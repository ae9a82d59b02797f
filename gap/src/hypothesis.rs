//! A hypothesis: which effects act where, and which parameters are fitted under it.

use parallax_model::effect::{Effect, Place, Quantity};

/// An effect at a place.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct EffectAt {
    /// The effect.
    pub effect: Effect,
    /// Where it acts.
    pub place: Place,
}

impl EffectAt {
    /// `coulomb@joint:axis`, the form used in reports.
    #[must_use]
    pub fn label(&self) -> String {
        format!("{}@{}", self.effect.name(), self.place)
    }
}

/// What is believed of a fitted parameter before the data.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Prior {
    /// Normal around a mean.
    Normal {
        /// The mean.
        mean: f64,
        /// The standard deviation.
        std: f64,
    },
    /// Half of a normal distribution, on one side of zero; `std` is that of the whole.
    HalfNormal {
        /// The standard deviation of the whole.
        std: f64,
    },
    /// Normal around a mean, and, with [`REVERSED`] of the probability, around its opposite: a sign that is the wrong one.
    EitherSign {
        /// The mean, above zero.
        mean: f64,
        /// The standard deviation around either.
        std: f64,
    },
    /// Uniform between bounds.
    Uniform {
        /// Lower bound.
        low: f64,
        /// Upper bound.
        high: f64,
    },
}

/// Prior probability that the sign of a factor is the wrong one.
pub const REVERSED: f64 = 0.01;

impl Prior {
    /// −2 log of the density at `value`.
    #[must_use]
    pub fn cost(&self, value: f64) -> f64 {
        let normal = |mean: f64, std: f64| {
            let z = (value - mean) / std;
            z * z + (2.0 * std::f64::consts::PI * std * std).ln()
        };
        match *self {
            Prior::Normal { mean, std } => normal(mean, std),
            Prior::HalfNormal { std } => normal(0.0, std) - 2.0 * 2.0_f64.ln(),
            // The two hardly overlap.
            Prior::EitherSign { mean, std } if value < 0.0 => normal(-mean, std) - 2.0 * REVERSED.ln(),
            Prior::EitherSign { mean, std } => normal(mean, std) - 2.0 * (1.0 - REVERSED).ln(),
            Prior::Uniform { low, high } => 2.0 * (high - low).ln(),
        }
    }

    /// Mean and precision of its quadratic part around `value`, for a Gauss–Newton step; no precision where it is flat.
    #[must_use]
    pub fn quadratic(&self, value: f64) -> (f64, f64) {
        match *self {
            Prior::EitherSign { mean, std } => (mean.copysign(value), 1.0 / (std * std)),
            Prior::Normal { mean, std } => (mean, 1.0 / (std * std)),
            Prior::HalfNormal { std } => (0.0, 1.0 / (std * std)),
            Prior::Uniform { low, high } => (0.5 * (low + high), 0.0),
        }
    }

    /// The precision of a normal distribution as wide as a flat prior; zero for one that is not flat.
    #[must_use]
    pub fn flat_precision(&self) -> f64 {
        match *self {
            Prior::Uniform { low, high } => 12.0 / (high - low).powi(2),
            _ => 0.0,
        }
    }
}

/// What a fitted parameter stands for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Slot {
    /// A parameter of the nominal system, by index.
    Nominal(usize),
    /// Parameter `parameter` of the hypothesis' effect `effect`.
    Effect {
        /// Index into [`Hypothesis::effects`].
        effect: usize,
        /// Index into the effect's parameters.
        parameter: usize,
    },
    /// A weight of the flexible residual force or sensor.
    Weight(usize),
}

/// One parameter that is fitted: an entry of θ.
#[derive(Clone, Debug)]
pub struct Fitted {
    /// What it stands for.
    pub slot: Slot,
    /// Its name in the report.
    pub name: String,
    /// Its unit, a label.
    pub unit: String,
    /// Its nominal value, or the value at which its effect vanishes.
    pub null: f64,
    /// What is believed of it.
    pub prior: Prior,
    /// Lower bound.
    pub low: f64,
    /// Upper bound.
    pub high: f64,
    /// Its natural size: steps and derivatives are taken in units of it.
    pub scale: f64,
    /// Values to start a fit from.
    pub starts: Vec<f64>,
}

/// Effects, and the parameters fitted under them. No effects: the nominal model, refitted.
#[derive(Clone, Debug, Default)]
pub struct Hypothesis {
    /// The effects it adds to the nominal model.
    pub effects: Vec<EffectAt>,
    /// The parameters it fits: calibrated ones first.
    pub fitted: Vec<Fitted>,
    /// Whether it carries a flexible residual instead of a named cause.
    pub residual: bool,
    /// How often the integration step, and the speed within which its dry friction is smoothed, are halved from those of a search.
    pub halvings: u32,
}

impl Hypothesis {
    /// The same in steps no coarser than another's, where it has dry friction as well.
    #[must_use]
    pub(crate) fn no_coarser_than(self, other: &Self) -> Self {
        let halvings = if self.is_dry() { self.halvings.max(other.halvings) } else { self.halvings };
        Self { halvings, ..self }
    }

    /// Whether one of its effects is dry friction.
    #[must_use]
    pub fn is_dry(&self) -> bool {
        self.effects.iter().any(|at| at.effect.is_dry())
    }

    /// How many times finer its steps are than those of a search.
    pub(crate) fn fineness(&self) -> f64 {
        f64::from(self.halvings).exp2()
    }

    /// The entries of θ that are limits of a level, at whose null nothing reaches them.
    pub(crate) fn limits(&self) -> impl Iterator<Item = usize> {
        let is_limit = |f: &Fitted| match f.slot {
            Slot::Effect { effect, parameter } => {
                let spec = &self.effects[effect].effect.parameters()[parameter];
                matches!(spec.quantity, Quantity::Low | Quantity::High)
            }
            _ => false,
        };
        (0..self.fitted.len()).filter(move |k| is_limit(&self.fitted[*k]))
    }

    /// The entries of θ that are parameters of one of its effects.
    pub(crate) fn of_effect(&self, effect: usize) -> impl Iterator<Item = usize> {
        let own = move |f: &Fitted| matches!(f.slot, Slot::Effect { effect: of, .. } if of == effect);
        (0..self.fitted.len()).filter(move |k| own(&self.fitted[*k]))
    }

    /// `delay@input:u + coulomb@joint:axis`, or `no effect`.
    #[must_use]
    pub fn label(&self) -> String {
        if self.residual {
            return "unknown".into();
        }
        if self.effects.is_empty() {
            return "no effect".into();
        }
        self.effects.iter().map(EffectAt::label).collect::<Vec<_>>().join(" + ")
    }

    /// Whether its effect is that a parameter of the nominal system has another value. Unlike calibrated parameters, such
    /// a one has starts of its own.
    #[must_use]
    pub fn frees(&self, slot: Slot) -> bool {
        matches!(slot, Slot::Nominal(_)) && self.fitted.iter().any(|f| f.slot == slot && !f.starts.is_empty())
    }

    /// Lets its last effect start also where `alone`, a fit of that effect by itself, found it. Gives the index of that start.
    pub fn starts_at(&mut self, alone: &Hypothesis, theta: &[f64]) -> usize {
        let Some(last) = self.effects.len().checked_sub(1) else { return 0 };
        let own = |slot: Slot| match slot {
            Slot::Effect { effect, parameter } if effect == last => {
                let of = Slot::Effect { effect: 0, parameter };
                alone.fitted.iter().position(|f| f.slot == of).map(|j| theta[j])
            }
            _ => None,
        };
        let found: Vec<(usize, f64)> =
            self.fitted.iter().enumerate().filter_map(|(j, f)| Some((j, own(f.slot)?))).collect();
        let count = found.iter().map(|(j, _)| self.fitted[*j].starts.len()).max().unwrap_or(0);
        for (j, value) in found {
            let f = &mut self.fitted[j];
            let few = if f.starts.is_empty() { vec![f.null] } else { std::mem::take(&mut f.starts) };
            f.starts = few.iter().cycle().take(count).copied().chain([value]).collect();
        }
        count
    }

    /// The starting points: every effect parameter's starts taken together, calibrated ones at their null.
    #[must_use]
    pub fn starts(&self) -> Vec<Vec<f64>> {
        let count = self.fitted.iter().map(|f| f.starts.len()).max().unwrap_or(1).max(1);
        (0..count)
            .map(|k| {
                self.fitted
                    .iter()
                    .map(|f| f.starts.get(k % f.starts.len().max(1)).copied().unwrap_or(f.null))
                    .collect()
            })
            .collect()
    }
}
