//! What a model is.

use crate::scalar::Scalar;
use crate::tree::Tree;

/// A node's mathematics: pure, generic over the scalar, in discrete time.
///
/// The one source is read as numbers, derivatives and a program; see the [crate's example](crate).
pub trait Model {
    /// The model's name, which its program carries.
    const NAME: &'static str;

    /// Constants of the model that a fit may move.
    type Params<T: Scalar>: Tree<T>;
    /// What the model remembers from step to step.
    type State<T: Scalar>: Tree<T>;
    /// What acts on it during a step.
    type Input<T: Scalar>: Tree<T>;
    /// What it shows at the end of a step.
    type Output<T: Scalar>: Tree<T>;

    /// The state after `dt` seconds under a constant input, and the output there.
    fn step<T: Scalar>(
        params: &Self::Params<T>,
        state: Self::State<T>,
        input: Self::Input<T>,
        dt: T,
    ) -> (Self::State<T>, Self::Output<T>);
}
