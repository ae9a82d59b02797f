//! A corrected system by itself: its own effects act where no recording says more.

use super::{Longest, Plant};
use crate::effect::{Effect, Place, PlaceKind};
use crate::system::{EffectEntry, Equations};

/// An effect of a system that cannot act without a recording or a graph.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("{file}:{line}: the effect `{effect}` at {place} cannot act here: {reason}")]
pub struct Unfit {
    /// The file.
    pub file: String,
    /// The line of the entry.
    pub line: usize,
    /// The effect.
    pub effect: String,
    /// Where it was to act.
    pub place: String,
    /// Why it cannot, and what to do.
    pub reason: &'static str,
}

/// Why an entry cannot act without a recording, if it cannot.
fn obstacle(entry: &EffectEntry) -> Option<&'static str> {
    let place: Place = entry.place.parse().ok()?;
    let (effect, _) = entry.resolve().ok()?;
    match (effect, place.kind) {
        (_, PlaceKind::Connection | PlaceKind::Node) => {
            Some("it belongs to a graph; state it there and take it out of this copy")
        }
        (Effect::Delay | Effect::ClockSkew, _) => Some(
            "when a message arrives is the graph's affair; give the connection this delay and take it out of this copy",
        ),
        (Effect::SupplySag, _) => Some("it follows a recorded voltage; take it out of this copy"),
        (effect, _) if effect.statistical() => Some(
            "it moves single messages by chance, and the equations give their mean; take it out of this copy",
        ),
        (effect, _) if effect.is_dry() && entry.smoothing.is_none() => Some(
            "state within which speed (rad/s or m/s) its direction is smoothed around rest, such as `smoothing = 0.001`",
        ),
        _ => None,
    }
}

impl Plant {
    /// The equations with the effects that the system itself states, for whoever simulates it without a recording. The
    /// longest step of the integrator (s) is its only extra parameter.
    ///
    /// # Errors
    ///
    /// [`Unfit`] for an effect that cannot act without a recording or a graph.
    pub fn alone(equations: Equations) -> Result<Self, Unfit> {
        let system = equations.system();
        let mut smoothing = vec![1.0; system.joints.len()];
        for entry in &system.effects {
            if let Some(reason) = obstacle(entry) {
                return Err(Unfit {
                    file: system.file.clone(),
                    line: entry.line,
                    effect: entry.name.clone(),
                    place: entry.place.clone(),
                    reason,
                });
            }
            let joint = entry.place.parse::<Place>().ok().and_then(|place| system.joint(&place.key));
            if let (Some(stated), Some(joint)) = (entry.smoothing, joint) {
                smoothing[joint] = stated;
            }
        }
        let mut plant = Plant::new(equations, &[], Vec::new(), smoothing);
        plant.step = Longest::Extra(plant.extra);
        plant.extra += 1;
        Ok(plant)
    }
}
