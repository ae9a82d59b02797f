//! Where simulation and reality part, which effect causes it, and how far it explains the gap.
//!
//! The key types:
//!
//! - [`diagnose`](diagnosis::diagnose) takes a [`System`](parallax_model::system::System) and a
//!   [`Log`](parallax_runtime::recording::log::Log) and gives a [`Report`](report::Report).
//! - A [`Hypothesis`](hypothesis::Hypothesis) is the nominal system with effects at places; all of them come from
//!   [`library`]. Each is a [`Simulator`](simulator::Simulator) along the events of an
//!   [`Experiment`](experiment::Experiment), with exact derivatives.
//! - Two losses fit it: the innovation likelihood ([`filter`], [`innovation`]) and short windows with free initial states
//!   ([`shooting`]). [`posterior`] weighs the fits, [`detect`] says whether there is a gap at all, [`signature`] which
//!   effects cannot be told apart, [`unknown`] stands for causes without a name, and [`quantify`] says how far it goes.
//! - Beside the plant: [`timing`] says what the stamps of a recording prove, [`nodes`] which nodes explain their output,
//!   and [`readings`] what shows only in how readings scatter, repeat and are spaced.
//! - Whether it matters: [`closed_loop`] says what a task costs under its controller, as recorded and as simulated.
//!
//! A cart that loses more force at speed than its simulator believes:
//!
//! ```
//! use parallax_gap::diagnosis::{Options, diagnose};
//! use parallax_model::system::System;
//! use parallax_runtime::recording::log::{Log, Role, Signal};
//!
//! let text = r#"
//! format = 1
//! name = "cart"
//! [parameters]
//! m = { value = 2.0, unit = "kg" }
//! [inputs]
//! u = { signal = "force" }
//! [state]
//! q = { derivative = "v", initial = "position" }
//! v = { derivative = "u/m" }
//! [outputs]
//! position = { value = "q", unit = "m" }
//! [joints]
//! rail = { position = "q", velocity = "v", inertia = "m", drive = "u" }
//! "#;
//!
//! let (mut force, mut position, mut times) = (Vec::new(), Vec::new(), Vec::new());
//! let (mut q, mut v, mut noise) = (0.0, 0.0, 1_u32);
//! for k in 0..1000 {
//!     let t = f64::from(k) * 0.01;
//!     let u = 3.0 * (2.0 * t).sin() + 2.0 * (7.0 * t).sin();
//!     noise = noise.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
//!     times.push(i64::from(k) * 10_000_000);
//!     force.push(u);
//!     position.push(q + 1e-3 * (f64::from(noise) / f64::from(u32::MAX) - 0.5));
//!     for _ in 0..100 {
//!         v += 1e-4 * (u - 1.5 * v) / 2.0;
//!         q += 1e-4 * v;
//!     }
//! }
//! let signals = vec![
//!     Signal::new("force", Role::Command, "N", times.clone(), force),
//!     Signal::new("position", Role::Measurement, "m", times, position),
//! ];
//! let log = Log { title: "cart".into(), signals, ..Log::default() };
//!
//! let system = System::parse(text, "system.toml")?;
//! let found = diagnose(&system, &log, &Options::default(), &|_, _| ())?;
//! let effect = &found.report.which[0].effects[0];
//! assert_eq!((effect.name.as_str(), effect.place.as_str()), ("viscous", "joint:rail"));
//! assert!((effect.parameters["coefficient"].value - 1.5).abs() < 0.05);
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```

mod answers;
pub mod bind;
mod calibration;
pub mod closed_loop;
pub mod combine;
pub mod commands;
pub mod detect;
pub mod diagnosis;
pub mod equations;
pub mod excitation;
pub mod experiment;
pub mod explain;
pub mod filter;
pub mod fit;
pub mod floor;
pub mod guess;
mod held_out;
pub mod hypothesis;
pub mod innovation;
pub mod judge;
pub mod library;
mod limit;
pub mod lockstep;
pub mod machine;
pub mod maps;
pub mod nodes;
pub mod noise;
pub mod options;
mod pieces;
pub mod plot;
pub mod posterior;
pub mod quantify;
pub mod readings;
pub mod report;
pub mod ridge;
mod rows;
pub mod search;
pub mod setup;
pub mod shapley;
pub mod shooting;
pub mod signature;
pub mod simulator;
pub mod spectrum;
pub mod statistics;
pub mod stop;
pub mod timing;
pub mod unknown;
pub mod whiteness;
pub mod windows;
