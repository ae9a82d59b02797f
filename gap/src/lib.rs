//! Where simulation and reality part, which effect causes it, and how far it explains the gap.

pub mod bind;
pub mod equations;
pub mod experiment;
pub mod filter;
pub mod fit;
pub mod hypothesis;
pub mod innovation;
pub mod shooting;
pub mod simulator;
pub mod statistics;
pub mod library;
pub mod noise;
pub mod setup;
pub mod search;
pub mod report;
pub mod detect;
pub mod signature;
pub mod unknown;
pub mod diagnosis;
pub mod posterior;
pub mod quantify;
pub mod sentence;
