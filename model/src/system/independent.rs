//! Systems that fall apart: what shares no state, no command and no parameter can be looked at piece by piece.

use std::collections::BTreeMap;

use super::System;
use super::expression::Expression;
use super::parts::Joint;

/// Names that belong together, as a forest.
struct Groups<'a> {
    index: BTreeMap<(&'static str, &'a str), usize>,
    parent: Vec<usize>,
}

impl<'a> Groups<'a> {
    fn of(&mut self, kind: &'static str, name: &'a str) -> usize {
        let next = self.parent.len();
        let index = *self.index.entry((kind, name)).or_insert(next);
        if index == next {
            self.parent.push(next);
        }
        index
    }

    fn root(&self, mut index: usize) -> usize {
        while self.parent[index] != index {
            index = self.parent[index];
        }
        index
    }

    fn join(&mut self, a: usize, b: usize) {
        let (a, b) = (self.root(a), self.root(b));
        self.parent[a.max(b)] = a.min(b);
    }
}

/// How names in expressions are kept apart from those of outputs and joints, which have tables of their own.
const NAME: &str = "name";
const OUTPUT: &str = "output";
const JOINT: &str = "joint";

impl System {
    /// The system as pieces that share no input, parameter, named expression or state, in the order of their first output;
    /// what no output depends on is left out. A system that does not fall apart, or that states effects of its own, is its
    /// only piece.
    #[must_use]
    pub fn independent(&self) -> Vec<System> {
        let whole = || vec![self.clone()];
        if self.outputs.len() < 2 || !self.own.is_empty() || !self.effects.is_empty() {
            return whole();
        }
        let mut groups = Groups { index: BTreeMap::new(), parent: Vec::new() };
        for entry in &self.lets {
            let own = groups.of(NAME, &entry.name);
            tie(&mut groups, own, [&entry.expression]);
        }
        for state in &self.states {
            let own = groups.of(NAME, &state.name);
            tie(&mut groups, own, [&state.derivative]);
        }
        for output in &self.outputs {
            let own = groups.of(OUTPUT, &output.name);
            tie(&mut groups, own, [&output.value]);
        }
        for joint in &self.joints {
            let own = groups.of(JOINT, &joint.name);
            tie(&mut groups, own, expressions(joint));
            for (parameter, becomes) in &joint.payload {
                // `mass` is the added one.
                for name in becomes.names().filter(|name| *name != "mass").chain([parameter.as_str()]) {
                    let name = groups.of(NAME, name);
                    groups.join(own, name);
                }
            }
            if let Some(index) = joint.force {
                let force = groups.of(NAME, &self.lets[index].name);
                groups.join(own, force);
            }
            if let Some(index) = joint.air {
                let air = groups.of(NAME, &self.states[index].name);
                groups.join(own, air);
            }
        }
        let mut roots: Vec<usize> = Vec::new();
        for output in &self.outputs {
            let index = groups.of(OUTPUT, &output.name);
            let root = groups.root(index);
            if !roots.contains(&root) {
                roots.push(root);
            }
        }
        if roots.len() < 2 {
            return whole();
        }
        roots.into_iter().map(|root| self.piece(&groups, root)).collect()
    }

    fn piece(&self, groups: &Groups<'_>, root: usize) -> System {
        let here = |kind: &'static str, name: &str| {
            let index = groups.index.iter().find(|((k, n), _)| *k == kind && *n == name).map(|(_, i)| *i);
            index.is_some_and(|index| groups.root(index) == root)
        };
        let mut piece = self.clone();
        piece.parameters.retain(|p| here(NAME, &p.name));
        piece.inputs.retain(|i| here(NAME, &i.name));
        piece.lets.retain(|l| here(NAME, &l.name));
        piece.states.retain(|s| here(NAME, &s.name));
        piece.outputs.retain(|o| here(OUTPUT, &o.name));
        piece.joints.retain(|j| here(JOINT, &j.name));
        let state = |index: usize| piece.states.iter().position(|s| s.name == self.states[index].name);
        let force = |index: usize| piece.lets.iter().position(|l| l.name == self.lets[index].name);
        for joint in &mut piece.joints {
            joint.position_state = joint.position_state.and_then(state);
            joint.velocity_state = joint.velocity_state.and_then(state);
            joint.air = joint.air.and_then(state);
            joint.force = joint.force.and_then(force);
        }
        piece
    }
}

fn expressions(joint: &Joint) -> impl Iterator<Item = &Expression> {
    let optional = [&joint.inertia, &joint.drive, &joint.load, &joint.lever];
    [&joint.position, &joint.velocity].into_iter().chain(optional.into_iter().flatten())
}

fn tie<'a>(groups: &mut Groups<'a>, own: usize, of: impl IntoIterator<Item = &'a Expression>) {
    for name in of.into_iter().flat_map(Expression::names) {
        let name = groups.of(NAME, name);
        groups.join(own, name);
    }
}

#[cfg(test)]
#[allow(clippy::unwrap_used, reason = "a test fails by panicking")]
mod tests {
    use super::*;

    fn system(text: &str) -> System {
        System::parse(&format!("format = 1\nname = \"machine\"\n{text}"), "system.toml").unwrap()
    }

    const TWO_AXES: &str = "
        [parameters]
        m1 = { value = 1.0, calibrate = [0.1, 10.0] }
        m2 = { value = 2.0, calibrate = [0.1, 10.0] }
        [inputs]
        a = { signal = \"a\" }
        b = { signal = \"b\" }
        [let]
        f2 = \"b\"
        [state]
        x = { derivative = \"v\", initial = 0.0 }
        v = { derivative = \"a/m1\", initial = 0.0 }
        y = { derivative = \"w\", initial = 0.0 }
        w = { derivative = \"f2/m2\", initial = 0.0 }
        [outputs]
        x = { value = \"x\" }
        y = { value = \"y\" }
        [joints]
        first = { position = \"x\", velocity = \"v\", inertia = \"m1\" }
        second = { position = \"y\", velocity = \"w\", force = \"f2\" }
        ";

    #[test]
    fn what_shares_nothing_falls_apart() {
        let pieces = system(TWO_AXES).independent();
        assert_eq!(pieces.len(), 2);
        let second = &pieces[1];
        let names: Vec<&str> = second.states.iter().map(|s| s.name.as_str()).collect();
        assert_eq!(names, ["y", "w"]);
        assert_eq!((second.parameters.len(), second.inputs.len(), second.joints.len()), (1, 1, 1));
        let joint = &second.joints[0];
        assert_eq!((joint.position_state, joint.velocity_state, joint.force), (Some(0), Some(1), Some(0)));
        for piece in &pieces {
            piece.equations().unwrap();
        }
    }

    #[test]
    fn what_shares_a_parameter_stays_together() {
        let coupled = TWO_AXES.replace("\"f2/m2\"", "\"f2/(m1 + m2)\"");
        let whole = system(&coupled);
        assert_eq!(whole.independent(), vec![whole.clone()]);
    }
}
