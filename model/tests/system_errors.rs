//! Each way to get a `system.toml` wrong has a message with file, line, place and remedy.

#![allow(clippy::unwrap_used, reason = "a test fails by panicking")]

use parallax_model::system::System;

/// A system with one thing replaced.
fn message(from: &str, to: &str) -> String {
    let good = r#"format = 1
name = "test"

[parameters]
M = { value = 2.0, unit = "kg", calibrate = [1.0, 3.0] }

[inputs]
u = { signal = "voltage" }

[let]
motor = "u*M"
brake = "0.5*motor"

[state]
q = { derivative = "v", initial = "position" }
v = { derivative = "(motor - brake)/M" }

[outputs]
position = { value = "q", unit = "m" }

[joints]
axis = { position = "q", velocity = "v", inertia = "M" }

[[effect]]
name = "viscous"
place = "joint:axis"
parameters = { coefficient = 1.0 }
"#;
    assert!(good.contains(from), "the good system has no `{from}`");
    let parsed = |text: &str| System::parse(text, "s.toml").and_then(|system| system.equations());
    parsed(good).unwrap();
    match parsed(&good.replacen(from, to, 1)) {
        Ok(_) => panic!("`{to}` in place of `{from}` was accepted"),
        Err(error) => error.to_string(),
    }
}

#[track_caller]
fn check(from: &str, to: &str, expected: &[&str]) {
    let message = message(from, to);
    for part in expected {
        assert!(message.contains(part), "no `{part}` in: {message}");
    }
}

#[test]
fn names_that_nothing_defines() {
    check(
        "u*M\"",
        "u*M + mottor\"",
        &[
            "s.toml:11: let `motor`",
            "unknown name `mottor`",
            "did you mean `motor`?",
            "\n    u*M + mottor\n          ^",
        ],
    );
    check(
        "value = \"q\"",
        "value = \"position\"",
        &["s.toml:19: `value` of output `position`", "[constants]"],
    );
    check(
        "inertia = \"M\"",
        "inertia = \"J\"",
        &["s.toml:22: `inertia` of joint `axis`", "unknown name `J`"],
    );
}

#[test]
fn circles_of_named_expressions() {
    check("u*M", "u*brake", &["s.toml:11:", "circle: motor -> brake -> motor"]);
    check("u*M", "motor + 1", &["circle: motor -> motor"]);
}

#[test]
fn broken_files() {
    let parse = |text: &str| System::parse(text, "s.toml").unwrap_err().to_string();
    assert!(parse("").contains("s.toml: the file is empty"));
    assert!(parse("  \n# only a comment\n").contains("the file is empty"));
    assert!(parse("name = \"x\"").contains("`format` is missing; write `format = 1`"));
    check("format = 1", "format = 2", &["s.toml:1: format 2 is not supported"]);
    check("format = 1", "format = \"1\"", &["s.toml:1: `format` of the system must be the whole number 1"]);
    check("name = \"test\"", "", &["the system has no `name`"]);
    check("[parameters]", "[parameters", &["s.toml:4: not valid TOML"]);
    check("u = { signal", "u = { signal = \"a\", signal", &["s.toml:8: not valid TOML"]);
    check(
        "[outputs]\nposition = { value = \"q\", unit = \"m\" }",
        "",
        &["no `outputs`", "name at least one"],
    );
    check("position = { value = \"q\", unit = \"m\" }", "", &["s.toml:18:", "no `outputs`"]);
}

#[test]
fn unknown_missing_and_mistyped_fields() {
    check(
        "calibrate",
        "callibrate",
        &["s.toml:5: unknown field `callibrate` in parameter `M`", "did you mean `calibrate`?"],
    );
    check("[joints]", "[joint]", &["s.toml:21: unknown field `joint`", "did you mean `joints`?"]);
    check("value = 2.0, ", "", &["s.toml:5: parameter `M` has no `value`"]);
    check("value = \"q\", ", "", &["s.toml:19: output `position` has no `value`"]);
    check("derivative = \"v\", ", "", &["s.toml:15: state `q` has no `derivative`"]);
    check(
        "value = 2.0",
        "value = \"2\"",
        &["s.toml:5: `value` of parameter `M` must be a number, not string"],
    );
    check("value = 2.0", "value = nan", &["the number must be finite"]);
    check("\"u*M\"", "true", &["s.toml:11: let `motor` must be an expression in quotes"]);
    check("signal = \"voltage\"", "signal = 3", &["`signal` of input `u` must be a string, not integer"]);
    check("signal = \"voltage\"", "signal = \"\"", &["the string is empty"]);
    check("{ signal = \"voltage\" }", "\"voltage\"", &["s.toml:8: input `u` must be a table"]);
    check(
        "signal = \"voltage\"",
        "signal = \"voltage\", supply = { signal = \"battery\" }",
        &["s.toml:8: `supply` of input `u` has no `nominal`"],
    );
    check("initial = \"position\"", "initial = true", &["a signal's name, a number, or"]);
}

#[test]
fn bounds_and_other_numbers() {
    check(
        "[1.0, 3.0]",
        "[3.0, 1.0]",
        &["s.toml:5: `calibrate` of parameter `M`: the lower bound 3 is not below"],
    );
    check("[1.0, 3.0]", "[5.0, 7.0]", &["the bounds [5, 7] do not hold the value 2"]);
    check("[1.0, 3.0]", "[1.0]", &["must be a pair of numbers"]);
    check("[1.0, 3.0]", "[1.0, inf]", &["must be finite"]);
    check("calibrate = [1.0, 3.0]", "std = 0.1", &["a prior is only used with `calibrate"]);
    check("[1.0, 3.0]", "[1.0, 3.0], std = 0", &["`std` of parameter `M`: 0 is not above zero"]);
    check(
        "unit = \"m\" }",
        "noise = -1.0 }",
        &["s.toml:19: `noise` of output `position`: -1 is not above zero"],
    );
    check(
        "initial = \"position\"",
        "initial = { value = 5, calibrate = [0, 1] }",
        &["s.toml:15:", "do not hold the value 5"],
    );
}

#[test]
fn names_used_twice_or_unusable() {
    check("motor = \"u*M\"", "u = \"M\"\nmotor = \"1\"", &["s.toml:11: `u` is already an input (line 8)"]);
    check(
        "q = { derivative = \"v\"",
        "M = { derivative = \"v\"",
        &["s.toml:15: `M` is already a parameter (line 5)"],
    );
    check("motor = ", "\"2motor\" = ", &["s.toml:11: `2motor` cannot be a name"]);
    check("motor = ", "sin = ", &["`sin` cannot be a name", "function or constant"]);
    check("motor = ", "time = ", &["`time` cannot be a name"]);
}

#[test]
fn joints_and_effects_that_name_nothing() {
    check(
        "inertia = \"M\"",
        "force = \"moter\"",
        &["s.toml:22: joint `axis` names the named expression `moter`", "`motor`?"],
    );
    check(
        "inertia = \"M\"",
        "air = \"wind\"",
        &["joint `axis` names the state `wind`, which does not exist"],
    );
    check(
        "inertia = \"M\"",
        "payload = { m2 = \"m2 + mass\" }",
        &["payload of joint `axis` names the parameter `m2`"],
    );
    check(
        "inertia = \"M\"",
        "payload = { M = \"M + u\" }",
        &["unknown name `u`", "a payload may use parameters"],
    );
    check(
        "joint:axis",
        "joint:axes",
        &["s.toml:26: [[effect]] number 1 names the joint `axes`", "did you mean `axis`?"],
    );
    check("joint:axis", "axis", &["`axis` is no place"]);
    check("joint:axis", "motor:axis", &["`motor` is no kind of place"]);
    check("coefficient = 1.0", "coefficient = \"1\"", &["must be a number"]);
    check("name = \"viscous\"", "", &["[[effect]] number 1 has no `name`"]);
}

#[test]
fn added_mass_must_not_be_ambiguous() {
    let text = "format = 1\nname = \"s\"\n[parameters]\nmass = { value = 1 }\n[outputs]\ny = { value = \"mass\" }\n\
                [joints]\nj = { position = \"0\", velocity = \"0\", payload = { mass = \"mass + mass\" } }";
    let message = System::parse(text, "s.toml").unwrap().equations().unwrap_err().to_string();
    assert!(message.contains("stands for the added mass"), "{message}");
}

#[test]
fn constants_that_cannot_be_used() {
    let text = "format = 1\nname = \"s\"\n[inputs]\nu = {}\n[outputs]\ny = { value = \"u*k\" }";
    let system = System::parse(text, "s.toml").unwrap();
    let error =
        |name: &str, value| system.with_constants(&[(name.to_owned(), value)]).unwrap_err().to_string();
    assert!(error("k", f64::NAN).contains("NaN is not a finite number"));
    assert!(error("u", 1.0).contains("the system has an input of that name"));
    assert!(system.equations().unwrap_err().to_string().contains("unknown name `k`"));
}

#[test]
fn broken_expressions() {
    let expression = |text: &str, expected: &str| check("u*M", text, &["s.toml:11: let `motor`", expected]);
    expression("(u*M", "this parenthesis is never closed\n    (u*M\n    ^");
    expression("u*M)", "this parenthesis closes nothing\n    u*M)\n       ^");
    expression("u*", "ends where a value should follow\n    u*\n      ^");
    expression("*u", "should stand before `*`");
    expression("2u", "write `2*x`, not `2x`");
    expression("arm.q", "names have no parts");
    expression("u M", "an operator is missing before this\n    u M\n      ^");
    expression("u**2", "write a power as `^`");
    expression("u = 2", "write equality as `==`");
    expression("u < M < 2", "comparisons do not chain");
    expression("u & M", "the character `&` has no meaning");
    expression("1e999", "the number is too large");
    expression("sinn(u)", "unknown function `sinn`; did you mean `sin`?");
    expression("u(M)", "unknown function `u`");
    expression("sin", "`sin` is a function; give it arguments");
    expression("clamp(u, 1)", "`clamp` takes 3 argument(s), not 2\n    clamp(u, 1)\n    ^");
    expression("sin()", "`sin` takes 1 argument(s), not 0");
    expression("max(1,2,3,4,5)", "`max` takes 2 argument(s), not 5");
    check("\"u*M\"", "\"\"", &["the expression ends where a value should follow"]);
}

#[test]
fn nesting_is_limited_and_length_is_not() {
    let nested = format!("{}1{}", "(".repeat(5000), ")".repeat(5000));
    check("u*M", &nested, &["nested too deeply"]);
    check("u*M", &format!("{}1", "-".repeat(5000)), &["nested too deeply"]);
    check("u*M", &format!("{}1", "2^".repeat(5000)), &["nested too deeply"]);
    let long =
        format!("format = 1\nname = \"s\"\n[outputs]\ny = {{ value = \"{}1\" }}", "1 + ".repeat(50_000));
    assert!(System::parse(&long, "s.toml").unwrap().equations().is_ok());
}

#[test]
fn a_caret_finds_its_line_in_a_long_string() {
    check("\"u*M\"", "\"\"\"\nu*M +\n  mottor\"\"\"", &["s.toml:11:", "\n      mottor\n      ^"]);
}
