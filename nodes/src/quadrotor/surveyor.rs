//! An agent that flies a circle with a shake, so that a recording tells much of the quadrotor.

use parallax_model::node_model::{NodeModel, NodeStep};
use parallax_model::{Scalar, Tree};
use parallax_runtime::registry::NodeKind;
use serde::Deserialize;

use super::agent::{self, Agent};
use super::messages::Reference;

/// Parameters of the agent.
#[derive(Tree, Clone, Copy, Debug, PartialEq, Deserialize)]
#[serde(
    default,
    deny_unknown_fields,
    bound = "T: Deserialize<'de>, agent::Parameters<T>: Default, Parameters<T>: Default"
)]
pub struct Parameters<T = f64> {
    /// The circle.
    pub circle: agent::Parameters<T>,
    /// Size of the sum of sines that is added to roll and pitch, rad.
    pub shake: T,
    /// Size of the one that is added to the height, m.
    pub bob: T,
}

impl Default for Parameters {
    fn default() -> Self {
        Self { circle: agent::Parameters::default(), shake: 0.15, bob: 0.15 }
    }
}

/// The agent.
#[derive(Clone, Copy, Debug)]
pub struct Surveyor;

/// The kind `quadrotor/surveyor`.
pub fn kind() -> NodeKind {
    NodeKind::model::<Surveyor>(|context| {
        let parameters: Parameters = context.parameters()?;
        if !(parameters.circle.turn > 0.0 && parameters.circle.tilt > 0.0) {
            return Err(context.parameter_error("`circle.turn` and `circle.tilt` must be positive"));
        }
        Ok((parameters, ()))
    })
    .input(agent::MOCAP)
}

impl NodeModel for Surveyor {
    const NAME: &'static str = "surveyor";
    type Params<T: Scalar> = Parameters<T>;
    type State<T: Scalar> = ();
    type Output<T: Scalar> = Reference<T>;

    #[inline(always)]
    fn step<T: Scalar>(p: &Parameters<T>, (): (), step: &NodeStep<'_, T>) -> ((), Reference<T>) {
        let ((), circle) = Agent::step(&p.circle, (), step);
        let roll = circle.roll + p.shake * sines(step.start, [9.3, 17.1]);
        let pitch = circle.pitch + p.shake * sines(step.start, [7.7, 20.3]);
        ((), Reference { roll, pitch, height: circle.height + p.bob * sines(step.start, [2.9, 5.3]) })
    }
}

/// Two sines of time with these frequencies, rad/s, within ±1.
#[inline(always)]
fn sines<T: Scalar>(time: T, [slow, fast]: [f64; 2]) -> T {
    ((time * slow).sin() + (time * fast).sin()) * 0.5
}
