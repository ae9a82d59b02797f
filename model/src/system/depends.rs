//! What depends on what, by the names in the expressions.

use std::collections::BTreeSet;

use super::System;
use super::expression::Expression;

impl System {
    /// Whether a reading of an output depends on any command at once, through no state.
    #[must_use]
    pub fn shows_command(&self, output: usize) -> bool {
        (0..self.inputs.len()).any(|input| self.shows(output, input))
    }

    /// Whether a reading of an output depends on this command at once, through no state.
    #[must_use]
    pub fn shows(&self, output: usize, input: usize) -> bool {
        let output = self.outputs.get(output);
        output.is_some_and(|o| self.reach(&o.value).iter().any(|name| self.input(name) == Some(input)))
    }

    /// The output that shows just this expression, such as a state by its name.
    #[must_use]
    pub fn shown_as(&self, expression: &str) -> Option<usize> {
        self.outputs.iter().position(|output| output.value.text().trim() == expression)
    }

    /// The state into which another one flows: the only one whose rate depends on it, while its own does not depend on
    /// that.
    ///
    /// # Errors
    ///
    /// Why there is none, as the end of a sentence.
    pub fn fed_by(&self, state: usize) -> Result<usize, &'static str> {
        let moves = |k: usize| {
            let mut joints = self.joints.iter().flat_map(|j| [j.position_state, j.velocity_state]);
            joints.any(|moving| moving == Some(k))
        };
        let depends = |of: usize, on: usize| {
            let name = self.states[on].name.as_str();
            self.reach(&self.states[of].derivative).contains(name)
        };
        let mut fed = (0..self.states.len()).filter(|other| *other != state && depends(*other, state));
        let to = fed.next().ok_or("no other state takes what flows out of it")?;
        if fed.next().is_some() {
            return Err("more than one state takes what flows out of it");
        }
        if moves(state) || moves(to) {
            return Err("a joint's position and velocity are no stores that overflow");
        }
        if depends(state, to) { Err("its own rate depends on the state that it feeds") } else { Ok(to) }
    }

    /// All names that an expression uses, itself or through named expressions.
    fn reach<'a>(&'a self, expression: &'a Expression) -> BTreeSet<&'a str> {
        let mut open: Vec<&str> = expression.names().collect();
        let mut seen = BTreeSet::new();
        while let Some(name) = open.pop() {
            if seen.insert(name)
                && let Some(entry) = self.lets.iter().find(|entry| entry.name == name)
            {
                open.extend(entry.expression.names());
            }
        }
        seen
    }
}

#[cfg(test)]
#[allow(clippy::unwrap_used, reason = "a test fails by panicking")]
mod tests {
    use super::*;

    #[test]
    fn a_store_flows_into_the_only_one_that_depends_on_it() {
        let system = |states: &str| {
            let text = format!(
                "format = 1\nname = \"stores\"\n[inputs]\nu = {{ signal = \"u\" }}\n[let]\nout = \"a/2\"\n\
                 [state]\n{states}\n[outputs]\ny = {{ value = \"b\" }}"
            );
            System::parse(&text, "system.toml").unwrap()
        };
        let line =
            |name: &str, rate: &str| format!("{name} = {{ derivative = \"{rate}\", initial = 0.0 }}\n");
        let cascade = system(&(line("a", "u - out") + &line("b", "out - b")));
        assert_eq!(cascade.fed_by(0), Ok(1));
        assert_eq!(cascade.fed_by(1), Err("no other state takes what flows out of it"));
        // What presses back is no free outflow.
        let coupled = system(&(line("a", "u - out + b") + &line("b", "out - b")));
        assert_eq!(coupled.fed_by(0), Err("its own rate depends on the state that it feeds"));
        // Of two that take from one, neither is known to take what overflows.
        let forked = system(&(line("a", "u - out") + &line("b", "out - b") + &line("c", "out - c")));
        assert_eq!(forked.fed_by(0), Err("more than one state takes what flows out of it"));
        assert!(!cascade.shows(0, 0));
    }
}
