//! Measured delays: collected from a recording, described by distributions, and put into its graph.
//!
//! The recorded stamps tell how long every step took and how long every message that was seen had travelled
//! ([`measured`]). Each place gets a mixture of normal distributions, clipped at zero when drawn (van der Heijden et al.,
//! "REX", appendix A, which maximises the same likelihood by gradient descent for a given number of components; here
//! expectation maximisation, on the intervals in which the clock stamps). About a thousand samples suffice.
//!
//! - The number of components is the one with the smallest Bayesian information criterion, at most
//!   [`MOST_COMPONENTS`].
//! - Outliers lie more than 6 standard deviations from every component and are better explained by a uniform background, or
//!   by a component of less than 3 % of all samples. They are counted and left out.
//! - Ties and coarse clocks: the likelihood is that of intervals as wide as the clock's step, so a component cannot shrink
//!   into a tie. What never changes becomes a constant.
//! - Samples at zero stand for all that would lie below it.
//! - Where successive delays resemble each other significantly, the fit is correlated.
//!
//! ```
//! use parallax_runtime::delay::Delay;
//! use parallax_runtime::random::{Purpose, stream};
//! use parallax_sim::delays::{Measured, Place, fit};
//!
//! // A camera that takes about 10 ms, or about 22.
//! let weights = vec![0.7, 0.3];
//! let camera = Delay::Mixture { weights, means: vec![0.010, 0.022], stds: vec![0.0005, 0.001] };
//! let (mut sampler, mut random) = (camera.sampler(&[]), stream(1, Purpose::Computation, "camera"));
//! let delays: Vec<i64> = (0..1000).map(|_| sampler.sample(&mut random, &[])).collect();
//! let place = Place::Computation { node: "camera".into() };
//! let measured = Measured { place, successive: vec![false; 1000], delays, left_out: Default::default() };
//! let fit = fit(&measured).unwrap();
//! let Delay::Mixture { weights, .. } = &fit.fit else { panic!("{:?}", fit.fit) };
//! assert!(weights.len() == 2 && (weights[0] - 0.7).abs() < 0.05);
//! ```

mod cells;
mod collect;
mod correlation;
mod em;
mod fit;
mod graph;
mod mixture;

pub use collect::{LeftOut, Measured, Place, measured};
pub use correlation::Correlation;
pub use fit::{DelayFit, ENOUGH, MOST_COMPONENTS, fit};
pub use graph::{FittedGraph, fitted_graph};
