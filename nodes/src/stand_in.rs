//! What machines that stand in for hardware share: commands act a while after their stamps, whenever they are heard of.
//!
//! A stand-in integrates to the stamps of the commands, not to its own wake-ups: the state that it keeps is that at the
//! last command's stamp, and what it shows at the start of a step is predicted from there. A command that arrives late is
//! therefore still applied at its time, and the scheduler's jitter does not become a delay of the plant.

use parallax_runtime::node::{Message, Port, Step};
use parallax_runtime::time::Nanos;

/// How many commands a stand-in looks back on, so that none is missed when it wakes up late.
pub(crate) const COMMANDS: usize = 16;

/// A machine with its equations of motion.
pub(crate) trait Machine: Copy {
    /// What it is told.
    type Command: Message + Copy + Default;

    /// How long after its stamp a command acts.
    fn delay(&self) -> Nanos;

    /// From now on this acts.
    fn apply(&mut self, command: Self::Command);

    /// Moves to a time under what acts at present. A time that is past changes nothing.
    fn advance(&mut self, until: Nanos);
}

/// A machine and the commands on their way to it.
#[derive(Clone, Debug)]
pub(crate) struct StandIn<M: Machine> {
    /// As of the last command's stamp.
    kept: M,
    /// Commands that are known but do not act yet at the kept time, oldest first.
    pending: Pending<M::Command>,
    last_seq: Option<u64>,
}

impl<M: Machine> StandIn<M> {
    /// A machine that has heard nothing.
    pub(crate) fn new(machine: M) -> Self {
        Self { kept: machine, pending: Pending::new(), last_seq: None }
    }

    /// The machine at the start of a step that sees the newest commands at `port`.
    pub(crate) fn step(&mut self, step: &Step<'_>, port: Port<M::Command>) -> M {
        for received in step.window(port) {
            // Initial messages have no number; what an earlier window held was taken then.
            if received.seq <= self.last_seq {
                continue;
            }
            self.last_seq = received.seq;
            self.command(received.sent, received.message);
        }
        self.at(step.start)
    }

    /// Takes a command that was sent at a time; commands come in the order of their sending.
    pub(crate) fn command(&mut self, sent: Nanos, command: M::Command) {
        let acts = sent.saturating_add(self.kept.delay());
        if self.pending.is_full() {
            // Cannot happen with delays below the pending commands' span; the oldest is then applied at once.
            self.pending.take_first(&mut self.kept);
        }
        self.pending.push(acts, command);
        // Everything that acts before this command's stamp is known by now.
        self.pending.advance(&mut self.kept, sent);
    }

    /// The machine at a time, given the commands so far.
    pub(crate) fn at(&self, time: Nanos) -> M {
        let (mut machine, mut pending) = (self.kept, self.pending);
        pending.advance(&mut machine, time);
        machine
    }
}

/// Commands that wait for their time, in a ring without allocation.
#[derive(Clone, Copy, Debug)]
struct Pending<C> {
    entries: [(Nanos, C); MOST],
    first: usize,
    count: usize,
}

/// More than 40 ms of delay hold at any sensible rate.
const MOST: usize = 64;

impl<C: Copy + Default> Pending<C> {
    fn new() -> Self {
        Self { entries: [(0, C::default()); MOST], first: 0, count: 0 }
    }

    fn is_full(&self) -> bool {
        self.count == MOST
    }

    fn push(&mut self, acts: Nanos, command: C) {
        self.entries[(self.first + self.count) % MOST] = (acts, command);
        self.count += 1;
    }

    /// Moves the machine to when the first command acts, and applies it.
    fn take_first(&mut self, machine: &mut impl Machine<Command = C>) {
        let (acts, command) = self.entries[self.first];
        machine.advance(acts);
        machine.apply(command);
        self.first = (self.first + 1) % MOST;
        self.count -= 1;
    }

    /// Moves the machine to a time, applying on the way what acts before or at it.
    fn advance(&mut self, machine: &mut impl Machine<Command = C>, until: Nanos) {
        while self.count > 0 && self.entries[self.first].0 <= until {
            self.take_first(machine);
        }
        machine.advance(until);
    }
}
