//! Any text is a `graph.toml` or a `launch.toml`, or an error.

#![no_main]

use libfuzzer_sys::fuzz_target;
use parallax_runtime::graph::GraphSpec;
use parallax_runtime::launch::LaunchSpec;
use parallax_runtime::registry::Registry;

fuzz_target!(|text: &str| {
    if let Ok(spec) = GraphSpec::from_toml(text) {
        let _ = spec.validate(&Registry::new()).map_err(|error| error.to_string());
        if let Ok(toml) = spec.to_toml() {
            assert_eq!(GraphSpec::from_toml(&toml).ok().map(|spec| spec.to_json()), Some(spec.to_json()));
        }
    }
    let _ = LaunchSpec::from_toml("launch.toml", text).map_err(|error| error.to_string());
});
