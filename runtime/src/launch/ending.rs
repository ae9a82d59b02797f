//! The end of a run, as the launcher brings it about: nodes settle, are stopped, and are let go.

use std::time::{Duration, Instant};

use super::account;
use super::control::Order;
use super::crew::{Crew, Member, State, TICK};
use super::event::{EventKind, Journal};
use super::report::{Exit, NodeReport};
use super::vitals::Vital;
use crate::clock::{WallClock, monotonic};
use crate::graph::OnDeadSender;
use crate::time::Nanos;

/// How long nodes that wait for a dead one may take to stop by themselves before they are told to.
const SETTLING: Duration = Duration::from_millis(300);

impl Crew<'_> {
    /// Lets the nodes that stop by themselves, because one that they wait for is gone, do so and say it.
    fn settle(&mut self, clock: WallClock) {
        let start = Instant::now();
        while (0..self.members.len()).any(|node| self.about_to_stop(node)) && start.elapsed() < SETTLING {
            self.pause(5_000_000);
            (0..self.members.len()).for_each(|node| self.hear_out(node, clock, false));
        }
    }

    /// Whether a node is about to stop by itself.
    fn about_to_stop(&self, node: usize) -> bool {
        let plan = &self.site.graph.nodes()[node];
        let gone = |connection: &usize| {
            let connection = &self.site.graph.connections()[*connection];
            let sender = &self.members[connection.from];
            connection.blocking && sender.state == State::Over && sender.exit != Some(Exit::Clean)
        };
        self.members[node].state == State::Up
            && plan.on_dead_sender == OnDeadSender::Stop
            && plan.inputs.iter().any(gone)
    }

    /// Stops all nodes and waits until each has said how it fared.
    pub(super) fn stop(&mut self, clock: WallClock) {
        self.settle(clock);
        self.order_all(&Order::Stop);
        for member in &mut self.members {
            // Nobody is started again now.
            if matches!(member.state, State::Down(_) | State::Leaving(_) | State::Coming(_)) {
                member.state = State::Over;
                member.worker.hang_up();
            }
        }
        let start = Instant::now();
        while self
            .members
            .iter()
            .any(|member| member.state == State::Up && start.elapsed() < self.allowed(member))
        {
            if let Some(bridge) = &mut self.bridge {
                // It answers for the nodes of other machines. A link that fails now is told of in its report.
                let _ = bridge.look();
            }
            self.pause(TICK);
            (0..self.members.len()).for_each(|node| self.hear_out(node, clock, true));
        }
    }

    /// How long a node may take to stop. One that hangs has had its time already.
    fn allowed(&self, member: &Member) -> Duration {
        let heartbeat = member.settings.heartbeat;
        let beat = member.vitals.get(Vital::Beat) as Nanos;
        let hangs_in_step =
            member.vitals.get(Vital::Stepping) > 0 && monotonic().saturating_sub(beat) > heartbeat;
        match member.silent {
            _ if hangs_in_step => Duration::ZERO,
            Some(_) => self.patience.min(Duration::from_nanos(heartbeat.max(0) as u64)),
            None => self.patience,
        }
    }

    /// Takes in what a node says of its end.
    fn hear_out(&mut self, node: usize, clock: WallClock, over: bool) {
        if self.members[node].state != State::Up {
            return;
        }
        if let Some((exit, problem, _)) = self.end_of(node) {
            if let Some(problem) = problem {
                self.note(clock, node, EventKind::StopFailed { problem });
            }
            // Also what nobody has to be told any more belongs into the recording.
            match over {
                _ if exit == Exit::Clean => {}
                true => self.record_end(node, &exit, clock),
                false => self.mourn(node, &exit, clock),
            }
            let member = &mut self.members[node];
            member.unstopped |= matches!(exit, Exit::Died { .. } | Exit::Hung { .. });
            (member.state, member.exit) = (State::Over, Some(exit));
        }
    }

    /// Lets all nodes end; gives their reports.
    pub(super) fn dismiss(mut self, clock: WallClock) -> (Vec<NodeReport>, Journal) {
        // All lines are closed before the first wait: nodes end side by side.
        self.members.iter_mut().for_each(|member| member.worker.hang_up());
        let start = Instant::now();
        for node in 0..self.members.len() {
            let patience = self.allowed(&self.members[node]).saturating_sub(start.elapsed());
            let member = &mut self.members[node];
            let in_time = member.worker.join(patience);
            if member.exit.is_none() || member.state == State::Up {
                let status = if in_time { "ended without a report" } else { "did not stop and was killed" };
                let silent = member.silent.map(|since| monotonic().saturating_sub(since));
                member.exit = Some(match silent {
                    Some(silent) => Exit::Hung { silent },
                    None => Exit::Died { pid: member.worker.pid(), status: status.into() },
                });
                if !in_time {
                    member.worker.kill();
                }
                // Nobody has called its stop.
                member.unstopped = true;
            }
            self.stop_hardware(node, clock);
        }
        for (node, mut worker) in std::mem::take(&mut self.stopping) {
            worker.join(self.patience);
            let kind = match worker.death() {
                Some(Exit::Died { status, .. }) if status == "exit status 0" => EventKind::StoppedAfterCrash,
                Some(exit) => EventKind::StopFailed { problem: format!("a fresh process of it {exit}") },
                None => EventKind::StopFailed { problem: "a fresh process of it did not end in time".into() },
            };
            self.note(clock, node, kind);
        }
        let reports = account::reports(&self.site, &self.members);
        (reports, std::mem::take(&mut self.journal))
    }
}
