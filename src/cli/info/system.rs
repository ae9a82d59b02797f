//! What a system.toml says.

use parallax_model::system::{Initial, System};
use serde_json::{Value, json};

use crate::cli::failure::{Failure, Sort};
use crate::cli::output;

pub(super) fn show(system: &System, as_json: bool) -> Result<(), Failure> {
    let open = system.open_names();
    if open.is_empty() {
        // A recording's constants have nothing to add: what is still wrong will stay wrong.
        system.equations().input()?;
    }
    if as_json {
        return output::json(&summary(system, &open));
    }
    let (states, inputs, outputs) = (system.states.len(), system.inputs.len(), system.outputs.len());
    output::line(format!("{}: {inputs} inputs, {states} states, {outputs} outputs", system.name));
    if !open.is_empty() {
        output::line(format!("a recording's [constants] must supply: {}", open.join(", ")));
    }
    let parameters: Vec<Vec<String>> = system
        .parameters
        .iter()
        .map(|p| {
            let calibrate =
                p.calibrate.map_or_else(|| "known".into(), |[low, high]| format!("[{low}, {high}]"));
            vec![p.name.clone(), p.value.to_string(), p.unit.clone(), calibrate]
        })
        .collect();
    if !parameters.is_empty() {
        output::table(&["parameter", "value", "unit", "calibrated within"], &parameters);
    }
    for input in &system.inputs {
        output::line(format!("  input {} is the signal `{}`", input.name, input.signal));
    }
    for entry in &system.lets {
        output::line(format!("  let {} = {}", entry.name, entry.expression.text()));
    }
    for state in &system.states {
        let start = match &state.initial {
            Initial::Signal(signal) => format!("starts at the signal `{signal}`"),
            Initial::Fixed(value) => format!("starts at {value}"),
            Initial::Calibrated { low, high, .. } => format!("starts within [{low}, {high}]"),
            Initial::Free => "starts anywhere".into(),
        };
        output::line(format!("  state {}: d/dt = {}; {start}", state.name, state.derivative.text()));
    }
    for out in &system.outputs {
        let unit = if out.unit.is_empty() { String::new() } else { format!(" ({})", out.unit) };
        output::line(format!(
            "  output {}{unit} = {}, compared with the signal `{}`",
            out.name,
            out.value.text(),
            out.signal
        ));
    }
    for joint in &system.joints {
        let force = match joint.entry() {
            Ok(_) => String::new(),
            Err(reason) => format!("; no force can enter: {reason}"),
        };
        output::line(format!("  joint {}{force}", joint.name));
    }
    for effect in &system.effects {
        output::line(format!("  effect {}", effect_text(effect)));
    }
    Ok(())
}

fn effect_text(effect: &parallax_model::system::EffectEntry) -> String {
    let parameters: Vec<String> =
        effect.parameters.iter().map(|(name, value)| format!("{name} = {value}")).collect();
    format!("{} at {} ({})", effect.name, effect.place, parameters.join(", "))
}

fn summary(system: &System, open: &[&str]) -> Value {
    let parameters: Vec<Value> = system
        .parameters
        .iter()
        .map(|p| json!({ "name": p.name, "value": p.value, "unit": p.unit, "calibrate": p.calibrate, "std": p.std }))
        .collect();
    let outputs: Vec<Value> = system
        .outputs
        .iter()
        .map(|o| json!({ "name": o.name, "signal": o.signal, "unit": o.unit, "noise": o.noise, "wrap": o.wrap }))
        .collect();
    let effects: Vec<Value> = system
        .effects
        .iter()
        .map(|e| {
            let parameters: serde_json::Map<String, Value> =
                e.parameters.iter().map(|(name, value)| (name.clone(), json!(value))).collect();
            json!({ "name": e.name, "place": e.place, "parameters": parameters })
        })
        .collect();
    json!({
        "kind": "system", "name": system.name, "parameters": parameters, "constants_needed": open,
        "inputs": system.inputs.iter().map(|i| json!({ "name": i.name, "signal": i.signal })).collect::<Vec<_>>(),
        "states": system.states.iter().map(|s| s.name.as_str()).collect::<Vec<_>>(),
        "outputs": outputs,
        "joints": system.joints.iter().map(|j| j.name.as_str()).collect::<Vec<_>>(),
        "effects": effects,
    })
}
