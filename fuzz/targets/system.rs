//! Any text is a `system.toml`, a `task.toml`, or an error; what was accepted can be evaluated.

#![no_main]

use libfuzzer_sys::fuzz_target;
use parallax_model::plant::Plant;
use parallax_model::program::Workspace;
use parallax_model::system::{System, Task};

fuzz_target!(|text: &str| {
    let _ = Task::parse(text, "task.toml").map_err(|error| error.to_string());
    let system = match System::parse(text, "system.toml") {
        Ok(system) => system,
        Err(error) => {
            let _ = error.to_string();
            return;
        }
    };
    let Ok(equations) = system.equations() else { return };
    let Ok(plant) = Plant::alone(equations) else { return };
    let program = plant.rate_program();
    let given = vec![0.5; program.inputs().len()];
    let mut results = vec![0.0; program.outputs().len()];
    program.evaluate(&given, &mut Workspace::new(), &mut results);
});
