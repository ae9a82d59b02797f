//! Any text is an expression or an error; an expression is written as it was read.

#![no_main]

use libfuzzer_sys::fuzz_target;
use parallax_model::system::Expression;

fuzz_target!(|text: &str| {
    match Expression::parse(text, "system.toml", 1, "`x`") {
        Ok(expression) => {
            let again = Expression::parse(expression.text(), "system.toml", 1, "`x`");
            assert!(again.is_ok(), "{}", expression.text());
        }
        Err(error) => drop(error.to_string()),
    }
});
