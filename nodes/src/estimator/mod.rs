//! Estimators: where a system is when what is decided now will act, from readings of the past and commands in flight.
//!
//! [`kind`] is a kind of node for any `system.toml`, which needs no Rust; [`pendulum`](crate::pendulum::ukf) has a ready-made
//! one. Both are an unscented Kalman filter in step with the graph ([`parallax_model::filter`]), and models: they run in real
//! time and under the simulated clock, and can be compiled. `docs/compensation.md` tells how they are used.
//!
//! ```
//! use parallax_nodes::registry;
//! use parallax_runtime::graph::GraphSpec;
//!
//! // The pendulum's graph with an estimator made of its own nominal system.
//! let mut spec = parallax_nodes::graph("pendulum").unwrap();
//! let node = spec.nodes.iter_mut().find(|node| node.name == "estimator").unwrap();
//! node.kind = "estimator".into();
//! node.parameters = serde_json::from_value(serde_json::json!({
//!     "initial": { "q": 3.14, "v": 0.0 },
//!     "std": { "q": 2.0, "v": 5.0 },
//!     "disturbance": { "v": 2.0 },
//!     "circular": { "q": 6.283185307179586 },
//!     "sends": {
//!         "message": "pendulum/Estimate",
//!         "leaves": ["angle", "speed", "stamp"],
//!         "values": ["q", "v", "stamp"],
//!     },
//! })).unwrap();
//! assert!(spec.validate(&registry()).is_ok());
//! ```

mod bands;
mod model;
mod settings;
mod system;

pub(crate) use bands::bands;
pub(crate) use model::{Estimator, Listened, Shown};
pub use settings::EstimatorError;
pub(crate) use settings::check;
pub use system::{embed, kind};
