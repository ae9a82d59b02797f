//! The control table of the X series as far as it is used here, and its units.
//!
//! Source: ROBOTIS e-Manual, *XL330-M288-T*, control table. The units of current differ between models; these are those of
//! the XL330.

use std::f64::consts::TAU;

/// Largest PWM, a half turn of it either way (2 bytes).
pub const PWM_LIMIT: u16 = 36;
/// What the servo controls (1 byte); see [`Mode`]. Not to be written while torque is on.
pub const OPERATING_MODE: u16 = 11;
/// Largest current, mA (2 bytes).
pub const CURRENT_LIMIT: u16 = 38;
/// Whether the motor is driven (1 byte).
pub const TORQUE_ENABLE: u16 = 64;
/// Faults of the hardware, one bit each (1 byte).
pub const HARDWARE_ERROR: u16 = 70;
/// After so many times 20 ms without an instruction the servo stops (1 byte); 0 for never. 255 says that it has.
pub const BUS_WATCHDOG: u16 = 98;
/// Wanted PWM (2 bytes).
pub const GOAL_PWM: u16 = 100;
/// Wanted current, mA (2 bytes).
pub const GOAL_CURRENT: u16 = 102;
/// Wanted position (4 bytes).
pub const GOAL_POSITION: u16 = 116;
/// Current (2 bytes), velocity (4) and position (4) as they are, one after the other.
pub const PRESENT: u16 = 126;
/// Bytes that are read from [`PRESENT`].
pub const PRESENT_BYTES: usize = 10;

/// Steps of a turn.
const STEPS: f64 = 4096.0;
/// One step of velocity: 0.229 turns a minute.
const VELOCITY: f64 = 0.229 * TAU / 60.0;
/// Full PWM.
const PWM: f64 = 885.0;
/// The position that counts as 0 rad: the middle of a turn.
const MIDDLE: f64 = 2048.0;

/// What a servo controls.
#[derive(Debug, Clone, Copy, PartialEq, Eq, serde::Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Mode {
    /// The current; the goal is in A.
    Current,
    /// The position, within one turn; the goal is in rad from the middle.
    Position,
    /// The voltage; the goal is a share of the supply, −1 to 1.
    Pwm,
}

impl Mode {
    /// Its number in the control table.
    pub fn number(self) -> u8 {
        match self {
            Self::Current => 0,
            Self::Position => 3,
            Self::Pwm => 16,
        }
    }

    /// Where its goal stands, as the bytes to be written there; the goal is held within what the bytes can say.
    pub fn goal(self, goal: f64) -> Goal {
        match self {
            Self::Current => {
                Goal::word(GOAL_CURRENT, (goal * 1000.0).round().clamp(-32_767.0, 32_767.0) as i16)
            }
            Self::Pwm => Goal::word(GOAL_PWM, (goal.clamp(-1.0, 1.0) * PWM).round() as i16),
            Self::Position => {
                let steps = (goal / TAU * STEPS + MIDDLE).round().clamp(0.0, STEPS - 1.0);
                Goal { address: GOAL_POSITION, bytes: (steps as i32).to_le_bytes(), length: 4 }
            }
        }
    }
}

/// A goal as it is written.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Goal {
    /// Where it stands.
    pub address: u16,
    bytes: [u8; 4],
    length: usize,
}

impl Goal {
    fn word(address: u16, value: i16) -> Self {
        let [low, high] = value.to_le_bytes();
        Self { address, bytes: [low, high, 0, 0], length: 2 }
    }

    /// Its bytes.
    pub fn bytes(&self) -> &[u8] {
        &self.bytes[..self.length]
    }
}

/// What a servo says of itself.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Present {
    /// rad from the middle.
    pub position: f64,
    /// rad/s.
    pub velocity: f64,
    /// A.
    pub current: f64,
}

impl Present {
    /// From what stands at [`PRESENT`].
    pub fn from_bytes(bytes: [u8; PRESENT_BYTES]) -> Self {
        let [c0, c1, v0, v1, v2, v3, p0, p1, p2, p3] = bytes;
        Self {
            current: f64::from(i16::from_le_bytes([c0, c1])) * 1e-3,
            velocity: f64::from(i32::from_le_bytes([v0, v1, v2, v3])) * VELOCITY,
            position: (f64::from(i32::from_le_bytes([p0, p1, p2, p3])) - MIDDLE) / STEPS * TAU,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn units_are_those_of_the_manual() {
        let mut bytes = [0; PRESENT_BYTES];
        bytes[..2].copy_from_slice(&(-150_i16).to_le_bytes());
        bytes[2..6].copy_from_slice(&100_i32.to_le_bytes());
        bytes[6..].copy_from_slice(&3072_i32.to_le_bytes());
        let present = Present::from_bytes(bytes);
        assert!((present.current + 0.15).abs() < 1e-12);
        assert!((present.velocity - 22.9 * TAU / 60.0).abs() < 1e-12);
        assert!((present.position - TAU / 4.0).abs() < 1e-12);
        assert_eq!(Mode::Position.goal(TAU / 4.0).bytes(), 3072_i32.to_le_bytes());
        assert_eq!(Mode::Position.goal(99.0).bytes(), 4095_i32.to_le_bytes());
        assert_eq!(Mode::Current.goal(-0.5).bytes(), (-500_i16).to_le_bytes());
        assert_eq!(Mode::Pwm.goal(7.0).bytes(), 885_i16.to_le_bytes());
    }
}
