//! The diagnosis, at its boundary: one program for all of it, since linking one for each file takes longer than the tests do.

#[path = "support/axis.rs"]
mod axis;
#[path = "support/rail.rs"]
mod rail;
mod rotor;
mod support;

mod cart;
mod clipped;
mod closed_loop;
mod combinations;
mod effects;
mod exactness;
mod flexible;
mod held_out;
mod inputs;
mod large;
mod late;
mod library;
mod lines;
mod next_experiment;
mod nodes;
mod noise;
mod oscillator;
mod own_effects;
mod pieces;
mod properties;
mod reach;
mod readings;
mod recordings;
mod reference;
mod rests;
mod rough;
mod servo;
mod small;
mod stages;
mod tanks;
mod timing;
