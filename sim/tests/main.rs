//! The simulated clock and what is computed from its schedules, at their boundary: one program for all of it, since linking one for each
//! file takes longer than the tests do.

mod support;

mod augment;
mod batch;
mod batch_models;
mod compensation;
mod compiled;
mod conformance;
mod delays;
mod episode;
mod identify;
mod identify_truths;
mod output_delays;
mod properties;
mod replay;
mod supergraph;
mod trajectory;
