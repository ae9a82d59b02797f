//! A mass on a rail.

/// A mass on a rail with friction, and a sensor of its position.
pub(crate) const SLIDE: &str = r#"
format = 1
name = "slide"
[parameters]
d = { value = 3.0, unit = "1/s", calibrate = [1.0, 9.0], std = 0.5 }
[inputs]
u = { signal = "push" }
[state]
q = { derivative = "v", initial = "position" }
v = { derivative = "u - d*v" }
[outputs]
position = { value = "q", unit = "m", noise = 0.0005 }
"#;
