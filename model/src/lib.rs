//! What a node computes, written once and read several ways.
//!
//! A [`Model`] is a pure function, generic over the [`Scalar`] that it computes with, on structs of scalars, each a
//! [`Tree`]. On `f64` it is the real-time step; on [`Dual`] it gives exact derivatives; on
//! [`Traced`](trace::Traced) it writes itself down as a [`Program`], which can be kept in a file, evaluated on any
//! scalar and handed to other languages. There is one source, so the readings cannot drift apart.
//!
//! ```
//! use parallax_model::integrate::rk4;
//! use parallax_model::program::Workspace;
//! use parallax_model::trace::trace_model;
//! use parallax_model::{Model, Scalar, Tree};
//!
//! #[derive(Tree)]
//! struct Params<T> {
//!     stiffness: T, // N/m
//!     mass: T,      // kg
//! }
//!
//! #[derive(Tree)]
//! struct State<T> {
//!     position: T, // m
//!     speed: T,    // m/s
//! }
//!
//! struct Spring;
//!
//! impl Model for Spring {
//!     const NAME: &'static str = "spring";
//!     type Params<T: Scalar> = Params<T>;
//!     type State<T: Scalar> = State<T>;
//!     type Input<T: Scalar> = T; // the force on the mass, N
//!     type Output<T: Scalar> = T; // the measured position, m
//!
//!     fn step<T: Scalar>(p: &Params<T>, x: State<T>, force: T, dt: T) -> (State<T>, T) {
//!         let derivative = |x: &State<T>| State {
//!             position: x.speed,
//!             speed: (force - p.stiffness * x.position) / p.mass,
//!         };
//!         let x = rk4(derivative, x, dt);
//!         let position = x.position;
//!         (x, position)
//!     }
//! }
//!
//! let params = Params { stiffness: 4.0, mass: 1.0 };
//! let (state, _) = Spring::step(&params, State { position: 1.0, speed: 0.0 }, 0.0, 0.01);
//!
//! let program = trace_model::<Spring>();
//! assert_eq!(program.inputs()[2], "state.position");
//! let inputs = [4.0, 1.0, 1.0, 0.0, 0.0, 0.01];
//! let mut outputs = [0.0; 3];
//! program.evaluate(&inputs, &mut Workspace::new(), &mut outputs);
//! assert_eq!(outputs[0], state.position);
//!
//! // How the next position depends on the stiffness: −dt²/2 to first order.
//! let slope = program.jacobian(&inputs, &[0])[(0, 0)];
//! assert!((slope + 0.5 * 0.01f64.powi(2)).abs() < 1e-8);
//! ```

// The derived code names this crate by its full path, also inside it.
extern crate self as parallax_model;

pub mod control;
pub mod dual;
pub mod effect;
pub mod filter;
pub mod fit;
pub mod integrate;
pub mod lanes;
pub mod model;
pub mod node_model;
pub mod plant;
pub mod program;
pub mod scalar;
pub mod system;
pub mod trace;
mod trace_builder;
pub mod tree;

pub use dual::Dual;
pub use model::Model;
pub use node_model::NodeModel;
pub use program::Program;
pub use scalar::{Inlined, Scalar};
pub use tree::Tree;
