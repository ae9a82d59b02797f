//! What is wanted of what was found.

use std::collections::BTreeSet;

use super::header::clean;
use super::{Found, TimeUnit, suggest};
use crate::recording::log::Role;
use crate::recording::ros2msg::distinct;

/// A series that is wanted.
#[derive(Clone, Debug, PartialEq)]
pub struct Choice {
    /// Its [name](super::Series::name).
    pub series: String,
    /// The signal's name.
    pub name: String,
    /// The signal's role.
    pub role: Role,
    /// The signal's unit, when it is not the one that the file states: what has a unit already is converted.
    pub unit: Option<String>,
    /// What values are multiplied by first.
    pub scale: f64,
}

/// Which series become signals, and how times are read.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Plan {
    /// What was recorded, for people.
    pub title: String,
    /// The signals.
    pub choices: Vec<Choice>,
    /// The unit of times that are numbers; otherwise the one that the clock has.
    pub time_unit: Option<TimeUnit>,
    /// Other clocks than those of the series: of one series, or of all.
    pub clocks: Vec<(Option<String>, String)>,
    /// Rows a second, where nothing says when they were true.
    pub rate: Option<f64>,
    /// The first and the last row, from 1.
    pub rows: Option<(usize, usize)>,
    /// Whether rows of one stamp are spread evenly over the time up to the next.
    pub spread: bool,
}

impl Plan {
    /// All series that have a role by their looks, in that role.
    pub fn suggested(found: &[Found]) -> Self {
        let choices = found.iter().flat_map(Found::series).filter_map(|(_, series)| {
            let name = series.name.clone();
            Some(Choice { series: name.clone(), name, role: series.role?, unit: None, scale: 1.0 })
        });
        Self { choices: choices.collect(), ..Self::default() }
    }
}

/// Gives all series of several files names of their own, with those of their files before them, which may say what they are.
pub fn qualify(found: &mut [Found]) {
    if found.len() < 2 {
        return;
    }
    let mut taken = BTreeSet::new();
    for found in found {
        let stem = found.path.file_stem().map(|stem| clean(&stem.to_string_lossy())).unwrap_or_default();
        for series in found.groups.iter_mut().flat_map(|group| &mut group.series) {
            series.name = distinct(format!("{stem}.{}", series.name), &mut taken);
        }
        suggest::roles(found);
    }
}
