//! Sensors that could be added: one for each state and each input that no output reads.

use parallax_model::system::{Expression, Output};

use crate::filter::Noise;
use crate::setup::{Range, Setup};

/// A sensor that the system does not have.
#[derive(Clone, Debug)]
pub struct Sensor {
    /// The state or input that it reads.
    pub of: String,
    /// Whether it reads an input, as it acts.
    pub command: bool,
    /// Standard deviation of its noise.
    pub noise: f64,
    range: Range,
}

/// What an added sensor's noise is taken to be, as a share of the range in which its quantity moved.
const NOISE: f64 = 0.005;

/// All sensors that could be added. Each is taken to be as good as half a percent of the range that the log covers.
#[must_use]
pub fn missing(setup: &Setup) -> Vec<Sensor> {
    let system = setup.equations.system();
    let read = |name: &str| system.shown_as(name).is_some();
    let states = system.states.iter().zip(&setup.state_range).map(|(s, range)| (&s.name, false, *range));
    let inputs = system.inputs.iter().zip(&setup.input_range).map(|(i, range)| (&i.name, true, *range));
    states
        .chain(inputs)
        .filter(|(name, _, range)| !read(name) && range.width() > 0.0 && range.width().is_finite())
        .map(|(name, command, range)| Sensor {
            of: name.clone(),
            command,
            noise: NOISE * range.width(),
            range,
        })
        .collect()
}

impl Sensor {
    /// What to add, for a reader.
    #[must_use]
    pub fn describe(&self) -> String {
        if self.command {
            format!("a sensor of `{}` where it acts", self.of)
        } else {
            format!("a sensor of `{}`", self.of)
        }
    }

    /// The setup with this sensor as its last output, and as `log variance` what its noise adds to a fit's. `None` when
    /// the name is no expression.
    #[must_use]
    pub fn added(&self, setup: &Setup) -> Option<Setup> {
        let mut system = setup.equations.system().clone();
        let name = format!("sensor_of_{}", self.of);
        let value = Expression::parse(&self.of, &system.file, 0, &name).ok()?;
        let output = Output {
            name: name.clone(),
            signal: name,
            value,
            unit: String::new(),
            noise: Some(self.noise),
            wrap: None,
            line: 0,
        };
        system.outputs.push(output);
        let mut setup = setup.clone();
        setup.equations = system.equations().ok()?;
        let log = self.log_variance();
        setup.experiment.wraps.push(None);
        setup.output_noise.push(self.noise);
        setup.output_scale.push(self.range.std);
        setup.output_range.push(self.range);
        setup.noise.limits.push((log, log));
        setup.noise.initial.log_output.push(log);
        Some(setup)
    }

    /// A fit's noise with that of this sensor.
    #[must_use]
    pub fn noise(&self, noise: &Noise) -> Noise {
        let mut noise = noise.clone();
        noise.log_output.push(self.log_variance());
        noise
    }

    fn log_variance(&self) -> f64 {
        2.0 * self.noise.max(1e-150).ln()
    }
}
