//! The node that drives a servo.

use std::path::PathBuf;
use std::time::Duration;

use parallax_runtime::node::{Node, NodeError, Step, Stopping};
use parallax_runtime::registry::NodeKind;
use parallax_runtime::time::to_seconds;
use serde::Deserialize;

use super::bus::{Bus, BusError, Refusal};
use super::table::{self, Mode, Present};
use super::{COMMAND, Command, State};

/// Parameters of the node in a graph.
#[derive(Clone, Debug, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Parameters {
    /// The serial port. `/dev/serial/by-id/...` stays the same when adapters are plugged in another order.
    pub port: PathBuf,
    /// Bits a second.
    #[serde(default = "Parameters::baud")]
    pub baud: u32,
    /// The servo's id, 0 to 252.
    pub id: u8,
    /// What is controlled.
    pub mode: Mode,
    /// How long an answer may take, s.
    #[serde(default = "Parameters::timeout")]
    pub timeout: f64,
    /// So many questions in a row may stay without a good answer; then the node gives up.
    #[serde(default = "Parameters::patience")]
    pub patience: u32,
    /// The servo stops by itself when it hears nothing for so long, s: 0.02 to 2.54 in steps of 0.02, or 0 for never.
    #[serde(default = "Parameters::watchdog")]
    pub watchdog: f64,
    /// The largest current, A; without it, the servo's own limit.
    #[serde(default)]
    pub max_current: Option<f64>,
}

impl Parameters {
    fn baud() -> u32 {
        1_000_000
    }

    fn timeout() -> f64 {
        0.004
    }

    fn patience() -> u32 {
        10
    }

    fn watchdog() -> f64 {
        0.1
    }
}

/// The kind `servo/dynamixel`.
pub(super) fn kind() -> NodeKind {
    NodeKind::new(|context| {
        let parameters: Parameters = context.parameters()?;
        let wrong = |problem: &str| Err(context.parameter_error(problem));
        if !(1e-4..=1.0).contains(&parameters.timeout) {
            return wrong("`timeout` must be 0.0001 to 1 s");
        }
        let off = parameters.watchdog == 0.0;
        if !(off || (0.02..=2.54).contains(&parameters.watchdog)) {
            return wrong("`watchdog` must be 0.02 to 2.54 s, or 0 for none");
        }
        if !off && parameters.watchdog * context.rate < 2.0 {
            return wrong(
                "`watchdog` is shorter than two steps at this rate: the servo would stop between them",
            );
        }
        if parameters.max_current.is_some_and(|most| !(0.001..=30.0).contains(&most)) {
            return wrong("`max_current` must be 0.001 to 30 A");
        }
        Servo::open(&parameters).map_err(|error| context.parameter_error(error.to_string()))
    })
    .input(COMMAND)
    .not_deterministic()
}

/// A servo, and what is known of it.
#[derive(Debug)]
pub struct Servo {
    bus: Bus,
    id: u8,
    mode: Mode,
    patience: u32,
    state: State,
    /// Whether torque is on as far as is known; unknown after a write that was not answered.
    torque: Option<bool>,
    /// Questions without a good answer: in a row, and all.
    failed: u32,
    watchdog: u8,
}

impl Servo {
    /// Opens the bus, looks for the servo, and brings it into its mode with torque off.
    ///
    /// # Errors
    ///
    /// [`BusError`] when the port or the servo is not there, or refuses.
    pub fn open(parameters: &Parameters) -> Result<Self, BusError> {
        let Parameters { id, mode, .. } = *parameters;
        let timeout = Duration::from_secs_f64(parameters.timeout.clamp(1e-4, 1.0));
        let mut bus = Bus::open(&parameters.port, parameters.baud, timeout)?;
        // The first question wakes adapters up, and may follow what another program left on the line.
        if bus.ping(id).is_err() {
            bus.ping(id)?;
        }
        bus.write(id, table::TORQUE_ENABLE, &[0])?;
        bus.write(id, table::BUS_WATCHDOG, &[0])?;
        bus.write(id, table::OPERATING_MODE, &[mode.number()])?;
        if let Some(most) = parameters.max_current {
            let milliamperes = (most * 1000.0).round().clamp(1.0, 32_767.0) as u16;
            bus.write(id, table::CURRENT_LIMIT, &milliamperes.to_le_bytes())?;
        }
        let watchdog = (parameters.watchdog / 0.02).round().clamp(0.0, 127.0) as u8;
        bus.write(id, table::BUS_WATCHDOG, &[watchdog])?;
        let patience = parameters.patience;
        Ok(Self {
            bus,
            id,
            mode,
            patience,
            state: State::default(),
            torque: Some(false),
            failed: 0,
            watchdog,
        })
    }

    fn present(&mut self) -> Result<Present, BusError> {
        let mut bytes = [0; table::PRESENT_BYTES];
        self.bus.read(self.id, table::PRESENT, &mut bytes)?;
        Ok(Present::from_bytes(bytes))
    }

    /// Brings the servo to do what the command says.
    fn obey(&mut self, command: Command) -> Result<(), BusError> {
        let wanted = command.torque > 0.5 && command.goal.is_finite();
        if wanted {
            // The goal first: a servo that is switched on goes to the goal that it finds.
            let goal = self.mode.goal(command.goal);
            match self.bus.write(self.id, goal.address, goal.bytes()) {
                // The watchdog has stopped it: it takes goals again once the watchdog is set anew.
                Err(BusError::Refused { reason: Refusal::Range | Refusal::Access, .. })
                    if self.watchdog > 0 =>
                {
                    self.bus.write(self.id, table::BUS_WATCHDOG, &[0])?;
                    self.bus.write(self.id, table::BUS_WATCHDOG, &[self.watchdog])?;
                    self.bus.write(self.id, goal.address, goal.bytes())?;
                }
                other => {
                    other?;
                }
            }
        }
        if self.torque != Some(wanted) {
            self.torque = None;
            self.bus.write(self.id, table::TORQUE_ENABLE, &[u8::from(wanted)])?;
            self.torque = Some(wanted);
        }
        Ok(())
    }

    /// What the servo says is broken, in words; asked once its answers report an alert.
    fn fault(&mut self) -> Option<&'static str> {
        let mut bits = [0];
        self.bus.read(self.id, table::HARDWARE_ERROR, &mut bits).ok()?;
        [
            (0x01, "its supply has a wrong voltage"),
            (0x04, "it is too hot"),
            (0x08, "its encoder is broken"),
            (0x10, "its motor or its supply had an electrical shock"),
            (0x20, "it was overloaded"),
        ]
        .into_iter()
        .find_map(|(bit, words)| (bits[0] & bit != 0).then_some(words))
    }
}

impl Node for Servo {
    type Output = State;

    fn step(&mut self, step: &Step<'_>) -> Result<State, NodeError> {
        let command = step.latest(COMMAND).message;
        let result = self.present().and_then(|present| {
            let Present { position, velocity, current } = present;
            self.state = State { position, velocity, current, stamp: to_seconds(step.start), ..self.state };
            self.obey(command)
        });
        self.state.torque = f64::from(u8::from(self.torque == Some(true)));
        match result {
            Ok(()) => self.failed = 0,
            Err(error) => {
                self.failed += 1;
                self.state.errors += 1.0;
                if self.failed >= self.patience.max(1) {
                    let fault =
                        self.fault().map_or_else(String::new, |fault| format!(" The servo says: {fault}."));
                    return Err(NodeError::failed(format!(
                        "{} ({} questions in a row on {}).{fault}",
                        error,
                        self.failed,
                        self.bus.path().display()
                    )));
                }
            }
        }
        Ok(self.state)
    }

    fn stop(&mut self, _: Stopping) {
        self.release();
    }
}

impl Servo {
    /// The motor is not driven any more. A servo that does not hear this has its watchdog.
    fn release(&mut self) {
        for _ in 0..3 {
            if self.bus.write(self.id, table::TORQUE_ENABLE, &[0]).is_ok() {
                break;
            }
        }
    }
}

impl Drop for Servo {
    fn drop(&mut self) {
        // One that was never started is not stopped either.
        self.release();
    }
}
