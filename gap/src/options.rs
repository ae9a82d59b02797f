//! What a user may choose: which effects are tried, how likely each is taken to be beforehand, and what is explained.
//!
//! ```
//! use parallax_gap::options::{Options, Pattern, Prior};
//!
//! let options = Options {
//!     exclude: vec!["parameter:".parse()?],                 // no other value of any parameter
//!     priors: vec!["coulomb@joint:axis=5".parse::<Prior>()?], // five times as likely as any other effect
//!     ..Options::default()
//! };
//! let pattern: Pattern = "delay@input".parse()?;
//! assert_eq!(pattern.to_string(), "delay@input");
//! # let _ = options;
//! # Ok::<(), parallax_gap::options::OptionsError>(())
//! ```

use std::collections::BTreeSet;
use std::fmt;
use std::str::FromStr;
use std::sync::Arc;
use std::sync::atomic::AtomicBool;

use parallax_model::effect::{Place, PlaceKind};
use parallax_model::system::{Suggestion, System};

use crate::hypothesis::EffectAt;

/// What a caller may choose.
#[derive(Clone, Debug)]
pub struct Options {
    /// Length of windows and predictions (s); by default a quarter of a second, or ten samples if that is longer, or
    /// 25 samples of a slow process, read less than five times a second.
    pub horizon: Option<f64>,
    /// Seed of the simulated nulls and bootstraps.
    pub seed: u64,
    /// Effects that are not tried.
    pub exclude: Vec<Pattern>,
    /// The only effects that are tried; all of them where there is none.
    pub only: Vec<Pattern>,
    /// How likely effects are beforehand, in units of an effect that nothing is said of. The last that fits decides.
    pub priors: Vec<Prior>,
    /// Effects whose fate is to be explained.
    pub explain: Vec<Pattern>,
    /// Once it is set, the search ends at the next fit, and the report is made of what was weighed so far.
    pub stop: Option<Arc<AtomicBool>>,
}

impl Default for Options {
    fn default() -> Self {
        Options {
            horizon: None,
            seed: 1,
            exclude: Vec::new(),
            only: Vec::new(),
            priors: Vec::new(),
            explain: Vec::new(),
            stop: None,
        }
    }
}

/// Effects by name, by place, or by both: `coulomb`, `joint:axis`, `delay@input:u`; `delay@input` and `joint:` leave
/// the name of the place open.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Pattern {
    effect: Option<String>,
    place: Option<(PlaceKind, Option<String>)>,
}

/// A pattern and how likely its effects are beforehand.
#[derive(Clone, Debug, PartialEq)]
pub struct Prior {
    /// Which effects.
    pub pattern: Pattern,
    /// Weight in units of an effect that nothing is said of; above zero.
    pub weight: f64,
}

/// A choice that cannot be used.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum OptionsError {
    /// A pattern of another form.
    #[error(
        "`{0}` names no effect: write an effect, a place, or EFFECT@PLACE, such as coulomb, joint:axis or delay@input:u"
    )]
    Form(String),
    /// A weight that is none.
    #[error(
        "`{0}` states no weight: write EFFECT[@PLACE]=WEIGHT with a number above zero, such as coulomb=3 (an effect that must not be tried belongs to --exclude)"
    )]
    Weight(String),
    /// A pattern that fits no effect of this system.
    #[error("--{option} {pattern}: this system has no such effect{suggestion} ({known})")]
    Nothing {
        /// Which option.
        option: &'static str,
        /// The pattern.
        pattern: String,
        /// What may have been meant.
        suggestion: Suggestion,
        /// What the system has of what was named.
        known: String,
    },
    /// Nothing is left to try.
    #[error("--only and --exclude together leave no effect to try; drop one of them")]
    Empty,
}

impl FromStr for Pattern {
    type Err = OptionsError;

    fn from_str(text: &str) -> Result<Self, OptionsError> {
        let form = || OptionsError::Form(text.into());
        let place = |text: &str| match text.parse::<Place>() {
            Ok(place) => Some((place.kind, Some(place.key))),
            Err(_) => kind(text.strip_suffix(':').unwrap_or(text)).map(|kind| (kind, None)),
        };
        match text.split_once('@') {
            Some((effect, at)) => {
                named(effect)?;
                Ok(Pattern { effect: Some(effect.into()), place: Some(place(at).ok_or_else(form)?) })
            }
            None if text.contains(':') => {
                Ok(Pattern { effect: None, place: Some(place(text).ok_or_else(form)?) })
            }
            None => {
                named(text)?;
                Ok(Pattern { effect: Some(text.into()), place: None })
            }
        }
    }
}

/// The kind of place of this name.
fn kind(name: &str) -> Option<PlaceKind> {
    format!("{name}:x").parse::<Place>().ok().map(|place| place.kind)
}

/// A name that an effect of the library or of a system's file may have.
fn named(name: &str) -> Result<(), OptionsError> {
    let letter = |c: char| c.is_alphanumeric() || c == '_';
    if !name.is_empty() && name.chars().all(letter) { Ok(()) } else { Err(OptionsError::Form(name.into())) }
}

impl Pattern {
    /// What a system has of what was named: the effects at that place, or the places of that effect; else all of its places.
    fn nearby(&self, known: &[EffectAt]) -> String {
        // Forms of an effect share its name, and effects a place.
        let listed = |names: &mut dyn Iterator<Item = String>| {
            let mut seen = BTreeSet::new();
            names.filter(|name| seen.insert(name.clone())).collect::<Vec<_>>().join(", ")
        };
        if let Some((kind, key)) = &self.place {
            let here = |at: &&EffectAt| {
                at.place.kind == *kind && key.as_ref().is_none_or(|key| at.place.key == *key)
            };
            let names = listed(&mut known.iter().filter(here).map(|at| at.effect.name().to_owned()));
            if !names.is_empty() {
                return format!("it has there: {names}");
            }
        }
        if let Some(name) = &self.effect {
            let of_it = known.iter().filter(|at| at.effect.name() == name);
            let places = listed(&mut of_it.map(|at| at.place.to_string()));
            if !places.is_empty() {
                return format!("it has {name} at: {places}");
            }
        }
        format!("its places are: {}", listed(&mut known.iter().map(|at| at.place.to_string())))
    }
}

impl FromStr for Prior {
    type Err = OptionsError;

    fn from_str(text: &str) -> Result<Self, OptionsError> {
        let weight = || OptionsError::Weight(text.into());
        let (pattern, value) = text.rsplit_once('=').ok_or_else(weight)?;
        let value: f64 = value.trim().parse().map_err(|_| weight())?;
        if !(value.is_finite() && value > 0.0) {
            return Err(weight());
        }
        Ok(Prior { pattern: pattern.parse()?, weight: value })
    }
}

impl fmt::Display for Pattern {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        if let Some(effect) = &self.effect {
            f.write_str(effect)?;
        }
        let Some((kind, key)) = &self.place else { return Ok(()) };
        let at = if self.effect.is_some() { "@" } else { "" };
        match key {
            Some(key) => write!(f, "{at}{}:{key}", kind.name()),
            None if self.effect.is_some() => write!(f, "{at}{}", kind.name()),
            None => write!(f, "{}:", kind.name()),
        }
    }
}

impl Pattern {
    /// Whether the effect at its place is meant.
    #[must_use]
    pub fn fits(&self, at: &EffectAt) -> bool {
        self.effect.as_ref().is_none_or(|effect| effect == at.effect.name())
            && self.place.as_ref().is_none_or(|(kind, key)| {
                *kind == at.place.kind && key.as_ref().is_none_or(|key| *key == at.place.key)
            })
    }
}

impl Options {
    /// Whether the user lets this effect be tried.
    #[must_use]
    pub fn allows(&self, at: &EffectAt) -> bool {
        !self.exclude.iter().any(|pattern| pattern.fits(at))
            && (self.only.is_empty() || self.only.iter().any(|pattern| pattern.fits(at)))
    }

    /// Whether any option names effects.
    pub(crate) fn names_effects(&self) -> bool {
        !(self.exclude.is_empty()
            && self.only.is_empty()
            && self.priors.is_empty()
            && self.explain.is_empty())
    }

    /// Whether any effect that may be tried has its place in this part of a system.
    pub(crate) fn concerns(&self, part: &System) -> bool {
        let holds = |(kind, key): &(PlaceKind, Option<String>)| {
            key.as_ref().is_none_or(|key| match kind {
                PlaceKind::Input => part.input(key).is_some(),
                PlaceKind::Output => part.output(key).is_some(),
                PlaceKind::Joint => part.joint(key).is_some(),
                PlaceKind::State => part.state(key).is_some(),
                PlaceKind::Parameter => part.parameter(key).is_some(),
                _ => true,
            })
        };
        self.only.is_empty() || self.only.iter().any(|pattern| pattern.place.as_ref().is_none_or(holds))
    }

    /// How likely this effect is beforehand, in units of one that nothing is said of.
    #[must_use]
    pub fn weight(&self, at: &EffectAt) -> f64 {
        self.priors.iter().rev().find(|prior| prior.pattern.fits(at)).map_or(1.0, |prior| prior.weight)
    }

    /// Checks every pattern against `known`: all effects at all places that the system has, testable or not.
    ///
    /// # Errors
    ///
    /// [`OptionsError::Nothing`] for a pattern that fits none of them, [`OptionsError::Empty`] when nothing is left.
    pub fn check(&self, known: &[EffectAt]) -> Result<(), OptionsError> {
        let priors = self.priors.iter().map(|prior| ("prior", &prior.pattern));
        let patterns = (self.exclude.iter().map(|p| ("exclude", p)))
            .chain(self.only.iter().map(|p| ("only", p)))
            .chain(priors)
            .chain(self.explain.iter().map(|p| ("explain", p)));
        let labels: Vec<String> = known.iter().map(EffectAt::label).collect();
        for (option, pattern) in patterns {
            if !known.iter().any(|at| pattern.fits(at)) {
                let written = pattern.to_string();
                return Err(OptionsError::Nothing {
                    option,
                    suggestion: Suggestion::nearest(
                        &written,
                        known.iter().map(|at| at.effect.name()).chain(labels.iter().map(String::as_str)),
                    ),
                    pattern: written,
                    known: pattern.nearby(known),
                });
            }
        }
        if !known.is_empty() && !known.iter().any(|at| self.allows(at)) {
            return Err(OptionsError::Empty);
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use parallax_model::effect::Effect;

    fn at(effect: Effect, place: &str) -> EffectAt {
        EffectAt { effect, place: place.parse().unwrap() }
    }

    fn pattern(text: &str) -> Pattern {
        text.parse().unwrap()
    }

    #[test]
    fn patterns_fit_by_effect_place_or_both() {
        let (friction, late) = (at(Effect::Coulomb, "joint:axis"), at(Effect::Delay, "input:u"));
        for (text, fits_friction, fits_late) in [
            ("coulomb", true, false),
            ("joint:axis", true, false),
            ("joint:other", false, false),
            ("input:", false, true),
            ("delay@input", false, true),
            ("delay@input:u", false, true),
            ("delay@output:u", false, false),
        ] {
            assert_eq!(pattern(text).fits(&friction), fits_friction, "{text}");
            assert_eq!(pattern(text).fits(&late), fits_late, "{text}");
            assert_eq!(pattern(text).to_string(), text, "what is read is written again");
        }
    }

    #[test]
    fn misspelt_names_are_refused_with_the_nearest() {
        let said = |text: &str| text.parse::<Pattern>().unwrap_err().to_string();
        assert!(said("delay@limb:axis").contains("delay@limb:axis"), "{}", said("delay@limb:axis"));
        assert!(said("").contains("names no effect"));
        let options = Options { only: vec![pattern("coulomb@joint:axes")], ..Options::default() };
        let error = options.check(&[at(Effect::Coulomb, "joint:axis")]).unwrap_err().to_string();
        for part in [
            "--only",
            "coulomb@joint:axes",
            "did you mean `coulomb@joint:axis`",
            "has coulomb at: joint:axis)",
        ] {
            assert!(error.contains(part), "{error}");
        }
        let options = Options { exclude: vec![pattern("coulom")], ..Options::default() };
        let error = options.check(&[at(Effect::Coulomb, "joint:axis")]).unwrap_err().to_string();
        assert!(
            error.contains("did you mean `coulomb`") && error.contains("places are: joint:axis"),
            "{error}"
        );
        let options = Options { only: vec![pattern("delay@joint:axis")], ..Options::default() };
        let error = options.check(&[at(Effect::Coulomb, "joint:axis")]).unwrap_err().to_string();
        assert!(error.contains("it has there: coulomb"), "{error}");
    }

    #[test]
    fn the_last_prior_that_fits_decides() {
        let prior = |text: &str| text.parse::<Prior>().unwrap();
        let priors = vec![prior("joint:axis=2"), prior("coulomb=5")];
        let options = Options { priors, ..Options::default() };
        assert_eq!(options.weight(&at(Effect::Coulomb, "joint:axis")), 5.0);
        assert_eq!(options.weight(&at(Effect::Viscous, "joint:axis")), 2.0);
        assert_eq!(options.weight(&at(Effect::Delay, "input:u")), 1.0);
        for text in ["coulomb", "coulomb=0", "coulomb=-1", "coulomb=inf", "coulomb=much"] {
            assert_eq!(text.parse::<Prior>(), Err(OptionsError::Weight(text.into())));
        }
    }

    #[test]
    fn something_must_be_left_to_try() {
        let known = [at(Effect::Coulomb, "joint:axis"), at(Effect::Delay, "input:u")];
        let options = |exclude: &[&str], only: &[&str]| Options {
            exclude: exclude.iter().map(|t| pattern(t)).collect(),
            only: only.iter().map(|t| pattern(t)).collect(),
            ..Options::default()
        };
        assert_eq!(options(&["delay"], &["delay"]).check(&known), Err(OptionsError::Empty));
        assert_eq!(options(&["delay"], &[]).check(&known), Ok(()));
        assert!(!options(&["delay"], &[]).allows(&known[1]));
        assert!(!options(&[], &["coulomb"]).allows(&known[1]));
    }
}
