//! What holds for single connections between machines: what a `launch.toml` says of them, checked.

use parallax_model::system::Suggestion;
use serde::{Deserialize, Serialize};

use super::hosts::Placement;
use crate::graph::{ConnectionPlan, Graph};
use crate::launch::settings::{LaunchSpec, SettingsError};
use crate::time::{Nanos, from_seconds};

/// The shortest silence that is noticed, s: machines tell of their nodes ten times a second.
pub(super) const SHORTEST: f64 = 0.2;

/// One connection between machines, as it stands under `[connection."FROM->TO"]` in a `launch.toml`. The messages of a node
/// cross once for all who receive them elsewhere, so that all of its connections that cross share their settings.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ConnectionLaunch {
    /// Whether it may cross; one that may not is an error where its ends are on different machines.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub crosses: Option<bool>,
    /// Of so many messages one crosses: those whose number it divides. 1 where nothing is said.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub every: Option<u64>,
    /// What goes first where the network is too slow for everything.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub priority: Option<LinkPriority>,
    /// After so long without a sign of life its receivers see the safe output of its sender, s; that of `[link]` where
    /// nothing is said.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub silence: Option<f64>,
}

/// The order in which messages leave a machine. Records leave after all of them.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum LinkPriority {
    /// After the others: pictures, logs.
    Low,
    /// As most.
    #[default]
    Normal,
    /// Before the others: commands.
    High,
}

/// How the messages of one node cross.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub(in crate::launch) struct Way {
    pub(in crate::launch) every: u64,
    pub(in crate::launch) priority: LinkPriority,
    pub(in crate::launch) silence: Nanos,
}

impl Way {
    /// What is special about it, in words; `None` where nothing is.
    #[cfg(feature = "link")]
    pub(super) fn describe(&self, silence: Nanos) -> Option<String> {
        let usual = Way { every: 1, priority: LinkPriority::Normal, silence };
        (*self != usual).then(|| {
            let priority = format!("{:?}", self.priority).to_lowercase();
            format!("one of {}, priority {priority}, silence {} s", self.every, self.silence as f64 / 1e9)
        })
    }
}

/// Where the first message of these numbers, or after them, stands that crosses when one of `every` does.
pub(in crate::launch) fn next_that_crosses(number: u64, every: u64) -> u64 {
    number.checked_next_multiple_of(every.max(1)).unwrap_or(u64::MAX)
}

/// How many of the messages from `start` up to `end` cross when one of `every` does.
pub(in crate::launch) fn that_cross(start: u64, end: u64, every: u64) -> u64 {
    end.div_ceil(every.max(1)).saturating_sub(start.div_ceil(every.max(1)))
}

type Fail<'a> = &'a dyn Fn(&str, &'static str, String) -> SettingsError;

impl LaunchSpec {
    /// How the messages of every node cross, in the order of the graph.
    ///
    /// # Errors
    ///
    /// [`SettingsError::Value`], with the table and the setting.
    pub(super) fn ways(&self, graph: &Graph, placement: &Placement) -> Result<Vec<Way>, SettingsError> {
        let fail = |place: &str, field: &'static str, problem: String| SettingsError::Value {
            file: self.name(),
            place: place.into(),
            field,
            problem,
        };
        let usual = Way { every: 1, priority: LinkPriority::Normal, silence: placement.silence };
        for name in self.connections.keys() {
            let known: Vec<String> =
                (0..graph.connections().len()).map(|index| graph.connection_name(index)).collect();
            if !known.contains(name) {
                let suggestion = Suggestion::nearest(name, known.iter().map(String::as_str));
                let problem = format!(
                    "the graph has no connection `{name}`{suggestion}; written FROM->TO, it has: {}",
                    known.join(", ")
                );
                return Err(fail(&format!("connection.\"{name}\""), "FROM->TO", problem));
            }
        }
        // By node: the first of its connections that crosses, and how.
        let mut ways: Vec<Option<(String, Way)>> = vec![None; graph.nodes().len()];
        for (index, connection) in graph.connections().iter().enumerate() {
            let name = graph.connection_name(index);
            let own = self.connections.get(&name);
            let crosses = placement.of[connection.from] != placement.of[connection.to];
            if let Some(own) = own {
                own.check(connection, crosses, placement, &name, &fail)?;
            }
            if !crosses {
                continue;
            }
            let way = own.map_or(usual, |own| own.over(usual));
            match &ways[connection.from] {
                None => ways[connection.from] = Some((name, way)),
                Some((_, other)) if *other == way => {}
                Some((first, _)) => {
                    let sender = &graph.nodes()[connection.from].name;
                    let problem = format!(
                        "differs from {first}: messages of {sender} cross once for all who receive them on other \
                         machines; give all of its connections that cross the same settings"
                    );
                    return Err(fail(&format!("connection.\"{name}\""), "every, priority, silence", problem));
                }
            }
        }
        Ok(ways.into_iter().map(|way| way.map_or(usual, |(_, way)| way)).collect())
    }
}

impl ConnectionLaunch {
    fn over(&self, usual: Way) -> Way {
        Way {
            every: self.every.unwrap_or(usual.every),
            priority: self.priority.unwrap_or(usual.priority),
            silence: self.silence.map_or(usual.silence, from_seconds),
        }
    }

    fn check(
        &self,
        connection: &ConnectionPlan,
        crosses: bool,
        placement: &Placement,
        name: &str,
        fail: Fail<'_>,
    ) -> Result<(), SettingsError> {
        let place = format!("connection.\"{name}\"");
        let fail = |field, problem: String| Err(fail(&place, field, problem));
        let given = [
            ("every", self.every.is_some()),
            ("priority", self.priority.is_some()),
            ("silence", self.silence.is_some()),
        ];
        let given = given.into_iter().find(|(_, given)| *given);
        let hosts = [connection.from, connection.to].map(|node| placement.host_of(node));
        if self.crosses == Some(false) {
            if crosses {
                let [from, to] = hosts;
                let problem = format!(
                    "it may not, and its ends are on the machines {from} and {to}: put both on one, or remove `crosses`"
                );
                return fail("crosses", problem);
            }
            if let Some((field, _)) = given {
                return fail(field, "has no effect where the connection may not cross".into());
            }
        }
        if let Some((field, _)) = given.filter(|_| !crosses) {
            let problem = format!("has no effect: both ends are on machine {}; remove it", hosts[0]);
            return fail(field, problem);
        }
        match self.every {
            Some(0) => return fail("every", "0 cannot be; 1 lets every message cross".into()),
            Some(every) if every > 1 && connection.blocking => {
                let problem = format!(
                    "{every} cannot be: the connection is blocking, and its receiver waits for every message"
                );
                return fail("every", problem);
            }
            _ => {}
        }
        match self.silence {
            Some(silence) if !(silence.is_finite() && silence >= SHORTEST) => {
                fail("silence", format!("{silence} s cannot be; give at least {SHORTEST} s"))
            }
            Some(silence) if from_seconds(silence) > placement.gone => fail(
                "silence",
                format!("is longer than `gone` under [link], {} s", placement.gone as f64 / 1e9),
            ),
            _ => Ok(()),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_that_cross_are_counted_as_they_are_listed() {
        for every in 1..6 {
            for start in 0..12 {
                for end in start..14 {
                    let listed = (start..end).filter(|number| number % every == 0).count() as u64;
                    assert_eq!(that_cross(start, end, every), listed, "{start}..{end}, one of {every}");
                }
                let next = (start..).find(|number| number % every == 0).unwrap();
                assert_eq!(next_that_crosses(start, every), next);
            }
        }
        assert_eq!(next_that_crosses(u64::MAX - 1, 4), u64::MAX);
    }
}
