//! The kinds of machine that a file begins with.

use clap::ValueEnum;
use parallax_runtime::recording::log::{Log, Role, Signal};

use super::fill::pairs;

/// A kind of machine.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub(crate) enum Template {
    /// A joint that a motor turns: an arm's joint, a pendulum, a wheel.
    #[value(alias = "pendulum")]
    Joint,
    /// A linear axis.
    Axis,
    /// A plant with one time constant.
    FirstOrder,
    /// Joints that follow goals of their own.
    Arm,
    /// A quadrotor near hover, along the vertical.
    Quadrotor,
    /// A gain, with all that a file may hold in comments.
    Blank,
}

impl Template {
    /// Its name on the command line.
    pub(super) fn name(self) -> &'static str {
        match self {
            Self::Joint => "joint",
            Self::Axis => "axis",
            Self::FirstOrder => "first-order",
            Self::Arm => "arm",
            Self::Quadrotor => "quadrotor",
            Self::Blank => "blank",
        }
    }

    /// The text, with places to fill.
    pub(super) fn text(self) -> &'static str {
        match self {
            Self::Joint => include_str!("templates/joint.toml"),
            Self::Axis => include_str!("templates/axis.toml"),
            Self::FirstOrder => include_str!("templates/first-order.toml"),
            Self::Arm => include_str!("templates/arm.toml"),
            Self::Quadrotor => include_str!("templates/quadrotor.toml"),
            Self::Blank => include_str!("templates/blank.toml"),
        }
    }

    /// The one that the signals of a log look like.
    pub(super) fn of(log: &Log) -> Self {
        let some = |role: Role, is: &dyn Fn(&Signal) -> bool| {
            log.signals.iter().any(|signal| signal.role == role && is(signal))
        };
        let unit =
            |units: &'static [&'static str]| move |signal: &Signal| units.contains(&signal.unit.as_str());
        if !pairs(log).is_empty() {
            Self::Arm
        } else if some(Role::Measurement, &unit(&ANGLES)) {
            Self::Joint
        } else if some(Role::Measurement, &unit(&LENGTHS)) {
            Self::Axis
        } else if some(Role::Command, &|_| true) && some(Role::Measurement, &|_| true) {
            Self::FirstOrder
        } else {
            Self::Blank
        }
    }
}

pub(super) const ANGLES: [&str; 3] = ["rad", "deg", "turn"];
pub(super) const LENGTHS: [&str; 3] = ["m", "mm", "cm"];
