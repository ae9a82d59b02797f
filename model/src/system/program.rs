//! A system as a program.

use super::equations::{Equations, Point};
use crate::Program;
use crate::trace::trace_fn;

impl Equations {
    /// The equations as a program. Its inputs are `parameter.NAME`, `state.NAME` and `input.NAME` in the system's
    /// order, then `time`; its outputs are `derivative.NAME` for each state, then `output.NAME`.
    pub fn program(&self) -> Program {
        let system = self.system();
        let (parameters, states) = (system.parameters.len(), system.states.len());
        let mut inputs: Vec<String> =
            system.parameters.iter().map(|p| format!("parameter.{}", p.name)).collect();
        inputs.extend(system.states.iter().map(|s| format!("state.{}", s.name)));
        inputs.extend(system.inputs.iter().map(|i| format!("input.{}", i.name)));
        inputs.push("time".into());
        let mut outputs: Vec<String> =
            system.states.iter().map(|s| format!("derivative.{}", s.name)).collect();
        outputs.extend(system.outputs.iter().map(|o| format!("output.{}", o.name)));

        trace_fn(&system.name, &inputs, &outputs, |values| {
            let (parameters, rest) = values.split_at(parameters);
            let (states, rest) = rest.split_at(states);
            let (inputs, time) = rest.split_at(rest.len() - 1);
            let values = self.values(&Point { parameters, states, inputs, time: time[0] }, &[]);
            let mut out = values.derivatives;
            out.extend(values.outputs);
            out
        })
    }
}
