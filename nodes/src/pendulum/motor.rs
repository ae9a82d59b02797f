//! The motor's driver: passes the agent's voltage on, within what the motor is rated for.

use parallax_model::node_model::{NodeModel, NodeStep};
use parallax_model::{Scalar, Tree};
use parallax_runtime::node::Port;
use parallax_runtime::registry::NodeKind;
use parallax_runtime::tuning::Parameter;
use serde::Deserialize;

use super::messages::Voltage;

/// What the agent wants.
pub const AGENT: Port<Voltage> = Port::new("agent");

/// Parameters of the driver.
#[derive(Tree, Clone, Copy, Debug, PartialEq, Deserialize)]
#[serde(default, deny_unknown_fields, bound = "T: Deserialize<'de>, Parameters<T>: Default")]
pub struct Parameters<T = f64> {
    /// The motor's rated voltage, V: commands beyond it, of either sign, are limited.
    pub rated: T,
}

impl Default for Parameters {
    fn default() -> Self {
        Self { rated: 4.0 }
    }
}

/// The driver.
#[derive(Clone, Copy, Debug)]
pub struct Motor;

/// The kind `pendulum/motor`.
pub fn kind() -> NodeKind {
    NodeKind::model::<Motor>(|context| {
        let parameters: Parameters = context.parameters()?;
        let rated = parameters.rated;
        if !(rated > 0.0 && rated.is_finite()) {
            return Err(context.parameter_error(format!("`rated` is {rated} V; it must be positive")));
        }
        Ok((parameters, ()))
    })
    .input(AGENT)
    .settable(Parameter::new("rated", "V").positive())
}

impl NodeModel for Motor {
    const NAME: &'static str = "motor";
    type Params<T: Scalar> = Parameters<T>;
    type State<T: Scalar> = ();
    type Output<T: Scalar> = Voltage<T>;

    #[inline(always)]
    fn step<T: Scalar>(p: &Parameters<T>, (): (), step: &NodeStep<'_, T>) -> ((), Voltage<T>) {
        let wanted = step.latest::<Voltage<T>>(AGENT.name()).message.voltage;
        // Something that is no number must not reach the motor; only such a thing differs from itself.
        let wanted = T::select(wanted.eq(wanted), wanted, T::constant(0.0));
        ((), Voltage { voltage: wanted.clamp(-p.rated, p.rated) })
    }
}
