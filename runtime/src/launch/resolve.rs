//! From launch settings as written to those of each node: overrides, defaults, and what cannot be.

use parallax_model::system::Suggestion;

use super::settings::{
    LaunchSpec, NodeLaunch, NodeSettings, OnDeadline, OnHang, OnNonFinite, Policy, Restart, RunAs,
    SettingsError, WaitStrategy,
};
use crate::graph::{Graph, GraphSpec, NodePlan};
use crate::time::{Nanos, from_seconds};

impl LaunchSpec {
    /// Changes one setting, written `NODE.SETTING=VALUE` as in the file; `defaults` in place of a node changes it for all
    /// nodes, also for those that have a setting of their own.
    ///
    /// # Errors
    ///
    /// [`SettingsError::Override`] when there is no such setting, or no such value of it.
    pub fn change(&mut self, text: &str) -> Result<(), SettingsError> {
        let fail = |problem: String| SettingsError::Override { text: text.into(), problem };
        let form = || fail("it must look like NODE.SETTING=VALUE, such as agent.policy=fifo".into());
        let (place, value) = text.split_once('=').ok_or_else(form)?;
        let (node, field) = place.split_once('.').ok_or_else(form)?;
        if node.is_empty() || field.is_empty() || value.is_empty() {
            return Err(form());
        }
        // A plain word is a string.
        let parse = |value: &str| toml::from_str::<NodeLaunch>(&format!("{field} = {value}"));
        let one = parse(value)
            .or_else(|_| parse(&format!("{value:?}")))
            .map_err(|error| fail(error.message().to_owned()))?;
        if node == "defaults" {
            self.defaults.take(&one);
            self.nodes.values_mut().for_each(|node| node.forget(&one));
        } else {
            self.nodes.entry(node.into()).or_default().take(&one);
        }
        Ok(())
    }

    pub(super) fn name(&self) -> String {
        self.file.as_ref().map_or("launch settings".into(), |file| file.display().to_string())
    }

    /// Puts what belongs to the graph there: cores and safe outputs.
    ///
    /// # Errors
    ///
    /// [`SettingsError::UnknownNode`].
    pub(super) fn put_into(&self, spec: &mut GraphSpec) -> Result<(), SettingsError> {
        for (name, node) in &self.nodes {
            let names: Vec<String> = spec.nodes.iter().map(|node| node.name.clone()).collect();
            let Some(place) = spec.node_mut(name) else {
                return Err(SettingsError::UnknownNode {
                    file: self.name(),
                    node: name.clone(),
                    suggestion: Suggestion::nearest(name, names.iter().map(String::as_str)),
                    known: names.join(", "),
                });
            };
            place.core = node.core.or(place.core);
            if let Some(safe) = &node.safe {
                place.safe = Some(safe.clone());
            }
        }
        Ok(())
    }

    /// The settings of every node of a graph, in its order. Where nothing is said, `base` holds.
    ///
    /// # Errors
    ///
    /// [`SettingsError`], with the table and the setting.
    pub(super) fn resolve(
        &self,
        graph: &Graph,
        base: &NodeSettings,
    ) -> Result<Vec<NodeSettings>, SettingsError> {
        let fail = |place: &str| {
            let (file, place) = (self.name(), place.to_owned());
            move |(field, problem)| SettingsError::Value { file, place, field, problem }
        };
        let defaults = &self.defaults;
        defaults.check().map_err(fail("defaults"))?;
        for (field, given) in [("core", defaults.core.is_some()), ("safe", defaults.safe.is_some())] {
            if given {
                let problem = "belongs to one node; put it into [node.NAME]".into();
                return Err(fail("defaults")((field, problem)));
            }
        }
        let none = NodeLaunch::default();
        let resolve = |node: &NodePlan| {
            let own = self.nodes.get(&node.name).unwrap_or(&none);
            let place = format!("node.{}", node.name);
            own.check().map_err(fail(&place))?;
            let settings = own.over(&defaults.over(base));
            let settings = NodeSettings { core: node.core, ..settings };
            own.check_resolved(&settings, node.safe.is_some()).map_err(fail(&place))?;
            Ok(settings)
        };
        graph.nodes().iter().map(resolve).collect()
    }
}

type Problem = (&'static str, String);

impl NodeLaunch {
    /// Every setting that `other` has.
    fn take(&mut self, other: &Self) {
        macro_rules! take {
            ($($field:ident)*) => { $(if other.$field.is_some() { self.$field = other.$field.clone(); })* };
        }
        take!(run_as core policy priority lock_memory wait spin restart restart_delay restart_delay_max restart_limit);
        take!(heartbeat on_hang deadline on_deadline on_non_finite stop_after_crash safe interpreter host);
    }

    /// Loses every setting that `other` has.
    fn forget(&mut self, other: &Self) {
        macro_rules! forget {
            ($($field:ident)*) => { $(if other.$field.is_some() { self.$field = None; })* };
        }
        forget!(run_as core policy priority lock_memory wait spin restart restart_delay restart_delay_max restart_limit);
        forget!(heartbeat on_hang deadline on_deadline on_non_finite stop_after_crash safe interpreter host);
    }

    /// What is wrong with these settings by themselves.
    fn check(&self) -> Result<(), Problem> {
        let times = [
            ("spin", self.spin, 0.0),
            ("restart_delay", self.restart_delay, 0.0),
            ("restart_delay_max", self.restart_delay_max, 0.0),
            ("deadline", self.deadline, 1e-9),
            // A node that sleeps looks around every 20 ms.
            ("heartbeat", self.heartbeat, 0.05),
        ];
        for (field, value, least) in times {
            let Some(value) = value else { continue };
            let infinite = field == "heartbeat" && value == f64::INFINITY;
            if !(infinite || (value.is_finite() && value >= least)) {
                return Err((field, format!("{value} s cannot be; give at least {least} s")));
            }
        }
        if let Some(priority) = self.priority
            && !(1..=99).contains(&priority)
        {
            return Err((
                "priority",
                format!("{priority} cannot be; a real-time priority lies between 1 and 99"),
            ));
        }
        if let Some(core) = self.core
            && core >= libc::CPU_SETSIZE as usize
        {
            return Err((
                "core",
                format!("{core} cannot be; Linux counts cores from 0 to {}", libc::CPU_SETSIZE - 1),
            ));
        }
        Ok(())
    }

    /// These settings, and where they say nothing, `base`.
    fn over(&self, base: &NodeSettings) -> NodeSettings {
        let nanos = |seconds: Option<f64>, base: Nanos| seconds.map_or(base, from_seconds);
        let spin = match (self.wait, self.spin) {
            (Some(WaitStrategy::Block), _) => 0,
            (Some(WaitStrategy::Spin), _) => NodeSettings::ALWAYS,
            (Some(WaitStrategy::SpinThenBlock), spin) => nanos(spin, NodeSettings::SPIN),
            (None, spin) => nanos(spin, base.spin),
        };
        NodeSettings {
            run_as: self.run_as.unwrap_or(base.run_as),
            core: base.core,
            policy: self.policy.unwrap_or(base.policy),
            priority: self.priority.unwrap_or(base.priority),
            lock_memory: self.lock_memory.unwrap_or(base.lock_memory),
            spin,
            restart: self.restart.unwrap_or(base.restart),
            restart_delay: nanos(self.restart_delay, base.restart_delay),
            restart_delay_max: nanos(self.restart_delay_max, base.restart_delay_max),
            restart_limit: self.restart_limit.unwrap_or(base.restart_limit),
            heartbeat: nanos(self.heartbeat, base.heartbeat),
            on_hang: self.on_hang.unwrap_or(base.on_hang),
            deadline: self.deadline.map(from_seconds).or(base.deadline),
            on_deadline: self.on_deadline.unwrap_or(base.on_deadline),
            on_non_finite: self.on_non_finite.unwrap_or(base.on_non_finite),
            stop_after_crash: self.stop_after_crash.unwrap_or(base.stop_after_crash),
        }
    }

    /// What is wrong with these settings beside the others of the node. A setting that would have no effect is an error
    /// where it is the node's own, and none where all nodes got it.
    fn check_resolved(&self, all: &NodeSettings, safe: bool) -> Result<(), Problem> {
        if self.priority.is_some() && all.policy == Policy::Other {
            return Err((
                "priority",
                "has no effect under policy = \"other\"; choose \"fifo\" or \"rr\"".into(),
            ));
        }
        if self.spin.is_some() && matches!(self.wait, Some(WaitStrategy::Block | WaitStrategy::Spin)) {
            return Err(("spin", "is a time for wait = \"spin-then-block\"; remove one of the two".into()));
        }
        let of_restart = [
            ("restart_delay", self.restart_delay.is_some()),
            ("restart_delay_max", self.restart_delay_max.is_some()),
            ("restart_limit", self.restart_limit.is_some()),
        ];
        if let Some((field, _)) = of_restart.into_iter().find(|(_, given)| *given)
            && all.restart == Restart::Never
        {
            return Err((
                field,
                "has no effect with restart = \"never\"; choose \"on-failure\" or \"always\"".into(),
            ));
        }
        if all.restart_delay > all.restart_delay_max {
            return Err(("restart_delay", "is longer than restart_delay_max".into()));
        }
        if all.on_hang == OnHang::Restart && all.run_as == RunAs::Thread {
            return Err(("on_hang", "a thread that hangs cannot be ended; use run_as = \"process\"".into()));
        }
        if all.on_hang == OnHang::Restart && all.restart == Restart::Never {
            return Err(("on_hang", "\"restart\" needs restart = \"on-failure\" or \"always\"".into()));
        }
        if self.on_deadline.is_some() && all.deadline.is_none() {
            return Err(("on_deadline", "has no effect without a deadline; set deadline = SECONDS".into()));
        }
        let reactions = [
            ("on_deadline", all.on_deadline == OnDeadline::Safe && all.deadline.is_some()),
            ("on_non_finite", all.on_non_finite == OnNonFinite::Safe),
        ];
        if let Some((field, _)) = reactions.into_iter().find(|(_, wanted)| *wanted && !safe) {
            return Err((field, "\"safe\" needs a safe output; set safe = { LEAF = VALUE }".into()));
        }
        if self.stop_after_crash == Some(true) && all.run_as == RunAs::Thread {
            return Err((
                "stop_after_crash",
                "is for processes: a thread that ends has called stop itself".into(),
            ));
        }
        Ok(())
    }
}
