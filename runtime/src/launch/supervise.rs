//! What the launcher does about a node that ends, hangs, is late, or comes back.

use std::time::{Duration, Instant};

use super::control::{Answer, Order};
use super::crew::{Crew, Member, State};
use super::desk::By;
use super::event::EventKind;
use super::plan;
use super::report::{End, Exit};
use super::settings::{OnDeadline, OnHang, OnNonFinite, Restart};
use super::vitals::Vital;
use crate::clock::{WallClock, monotonic};
use crate::recording::{Fault, FaultKind};
use crate::time::Nanos;

/// Between two events of one kind about one node, when they come without end.
const BETWEEN: Duration = Duration::from_secs(1);

/// How long a node that has said how it ended may take to be gone.
const ENDING: Duration = Duration::from_millis(500);

/// How long the others may wait for the system to say how a node died whose line has closed: it is about to.
const MOMENT: Duration = Duration::from_millis(5);

/// What becomes of a node that ended while the run goes on.
#[derive(Debug, Clone, Copy)]
enum Next {
    /// It is started again in so long.
    Restart(Nanos),
    /// It would be, but has been too often.
    GivenUp {
        restarts: u64,
    },
    Nothing,
}

impl Crew<'_> {
    /// Looks after one node; gives the end of the run when it cannot go on.
    pub(super) fn look(&mut self, node: usize, clock: WallClock) -> Option<End> {
        match self.members[node].state {
            State::Up => match self.end_of(node) {
                Some((exit, problem, ends_run)) => {
                    if let Some(problem) = problem {
                        self.note(clock, node, EventKind::StopFailed { problem });
                    }
                    self.ended(node, exit, ends_run, clock)
                }
                None => self.signs(node, clock),
            },
            State::Down(at) if Instant::now() >= at => {
                // One that failed has waited so that others could take what it had sent. Its ports are its own as long as it lives.
                self.members[node].worker.hang_up();
                let since = Instant::now();
                self.members[node].state = State::Leaving(since);
                self.start_again(node, since, clock)
            }
            State::Leaving(since) => self.start_again(node, since, clock),
            State::Coming(since) => self.comes(node, since, clock),
            State::Down(_) | State::Over => None,
        }
    }

    /// How a node ended, if it has: what it says, or else what the system says; what went wrong at its end; and whether
    /// the run is to end with it.
    pub(super) fn end_of(&mut self, node: usize) -> Option<(Exit, Option<String>, bool)> {
        let Member { worker, condemned, .. } = &mut self.members[node];
        for answer in worker.answers() {
            match answer {
                Answer::Done { exit, problem, ends_run } => return Some((exit, problem, ends_run)),
                Answer::Failed { reason } => return Some((Exit::Failed { reason }, None, false)),
                Answer::Tuned { id, told } => self.door.answered(node, id, told),
                _ => {}
            }
        }
        if worker.line.closed() {
            worker.join(MOMENT);
        }
        let exit = worker.death()?;
        Some((condemned.take().map_or(exit, |silent| Exit::Hung { silent }), None, false))
    }

    /// A node has ended while the run goes on.
    fn ended(&mut self, node: usize, exit: Exit, ends_run: bool, clock: WallClock) -> Option<End> {
        self.door.gone(node, &self.site.graph.nodes()[node].name);
        let member = &mut self.members[node];
        member.exit = Some(exit.clone());
        member.silent = None;
        if exit == Exit::Clean {
            // Its time is over, and the launcher will see in a moment that so is the run's.
            member.state = State::Over;
            return None;
        }
        member.unstopped |= matches!(exit, Exit::Died { .. } | Exit::Hung { .. });
        let end = End::Node { node: self.site.graph.nodes()[node].name.clone() };
        let next = if ends_run { Next::Nothing } else { self.next_restart(node, &exit) };
        // Receivers and hardware come before whoever reads of it, and who may not read at all.
        if let Next::Restart(delay) = next {
            let attempt = self.members[node].restarts + 1;
            self.members[node].state = State::Down(Instant::now() + Duration::from_nanos(delay as u64));
            self.tell_gone(node, true);
            self.record_end(node, &exit, clock);
            self.note(clock, node, EventKind::Ended { exit });
            self.note(clock, node, EventKind::Restarting { attempt, delay });
            return None;
        }
        self.members[node].state = State::Over;
        self.mourn(node, &exit, clock);
        self.stop_hardware(node, clock);
        self.note(clock, node, EventKind::Ended { exit });
        if let Next::GivenUp { restarts } = next {
            self.note(clock, node, EventKind::GivenUp { restarts });
        }
        (ends_run || self.needed(node)).then_some(end)
    }

    /// What becomes of a node that ended.
    fn next_restart(&mut self, node: usize, exit: &Exit) -> Next {
        let Member { settings, restarts, in_a_row, up, .. } = &mut self.members[node];
        let wanted = match settings.restart {
            Restart::Never => false,
            // A node that stopped because another is gone for good would only stop again.
            _ if matches!(exit, Exit::DeadSender { .. }) => false,
            Restart::Always => true,
            Restart::OnFailure => !matches!(exit, Exit::Died { status, .. } if status == "exit status 0"),
        };
        if !wanted {
            return Next::Nothing;
        }
        if *restarts >= u64::from(settings.restart_limit) {
            return Next::GivenUp { restarts: *restarts };
        }
        if up.elapsed().as_nanos() as Nanos > settings.restart_delay_max {
            *in_a_row = 0;
        }
        let factor = 1i64.checked_shl(*in_a_row).unwrap_or(Nanos::MAX).max(1);
        *in_a_row += 1;
        Next::Restart(settings.restart_delay.saturating_mul(factor).min(settings.restart_delay_max))
    }

    /// Starts a node again once the earlier one is gone, whose line was closed at `since`. The others are looked after while it takes its
    /// time to end.
    fn start_again(&mut self, node: usize, since: Instant, clock: WallClock) -> Option<End> {
        let worker = &mut self.members[node].worker;
        if !worker.join(MOMENT) {
            if since.elapsed() > 2 * ENDING {
                let reason = "the earlier one does not end, and a thread cannot be ended".into();
                self.members[node].settings.restart = Restart::Never;
                return self.ended(node, Exit::Failed { reason }, false, clock);
            }
            if since.elapsed() > ENDING {
                worker.kill();
            }
            return None;
        }
        self.members[node].restarts += 1;
        // And those of one that died are its own until somebody removes them.
        self.site.endpoint.remove_dead();
        match (self.site.hire)(node, false) {
            Ok(worker) => {
                let member = &mut self.members[node];
                member.worker = worker;
                member.state = State::Coming(Instant::now());
                None
            }
            Err(error) => self.ended(node, Exit::Failed { reason: error.to_string() }, false, clock),
        }
    }

    /// A node that was started again comes up, step by step.
    fn comes(&mut self, node: usize, since: Instant, clock: WallClock) -> Option<End> {
        let mut failed = None;
        for answer in self.members[node].worker.answers() {
            match answer {
                // What it was refused is what it was refused at first.
                Answer::Opened { .. } => self.members[node].worker.order(&Order::Connect),
                Answer::Connected { .. } => {
                    if let Err(error) = self.site.space.commit() {
                        self.members[node].worker.kill();
                        failed = Some(Exit::Failed { reason: error.to_string() });
                        break;
                    }
                    if let Some(wish) = self.door.again(node) {
                        // SAFETY: geteuid takes no arguments, cannot fail and touches no memory of ours.
                        let by = By { user: unsafe { libc::geteuid() }, process: 0 };
                        self.members[node].worker.order(&Order::Tune { id: 0, by, wish });
                    }
                    self.members[node].worker.order(&Order::Start { epoch: clock.epoch(), resume: true });
                    self.tell_absences(node);
                }
                Answer::Resumed { step, shift } => {
                    let member = &mut self.members[node];
                    member.state = State::Up;
                    member.up = Instant::now();
                    // The fresh process has the hardware, and stops it.
                    member.unstopped = false;
                    self.note(clock, node, EventKind::Restarted { step });
                    self.record(node, FaultKind::Restarted { step, shift }, clock);
                    // What it says next is for another look.
                    return None;
                }
                Answer::Failed { reason } => failed = Some(Exit::Failed { reason }),
                // What was set again: nobody waits for the answer.
                Answer::Tuned { .. } => {}
                // Only a recorder or the link says these.
                Answer::Listening | Answer::Recorded { .. } | Answer::Link { .. } => {}
                Answer::Done { exit, .. } => failed = Some(exit),
            }
        }
        let worker = &mut self.members[node].worker;
        if failed.is_none() && worker.line.closed() {
            worker.join(MOMENT);
        }
        let failed = failed.or_else(|| worker.death()).or_else(|| {
            (since.elapsed() > self.patience).then(|| {
                self.members[node].worker.kill();
                Exit::Failed { reason: "it did not come up in time".into() }
            })
        });
        failed.and_then(|exit| self.ended(node, exit, false, clock))
    }

    /// What a running node's signs of life say.
    fn signs(&mut self, node: usize, clock: WallClock) -> Option<End> {
        self.tell_counts(node, clock);
        let now = monotonic();
        let Member { settings, vitals, silent, hangs, condemned, told, worker, .. } = &mut self.members[node];
        let (beat, stepping) = (vitals.get(Vital::Beat) as Nanos, vitals.get(Vital::Stepping) as Nanos);
        let step = vitals.get(Vital::Next);
        if condemned.is_some() || beat == 0 || self.was_away {
            return None;
        }
        if now.saturating_sub(beat) > settings.heartbeat {
            if silent.is_some() {
                return None;
            }
            *silent = Some(beat);
            *hangs += 1;
            let reaction = settings.on_hang;
            if reaction != OnHang::Warn {
                *condemned = Some(now.saturating_sub(beat));
                worker.kill();
            }
            let ends_run = reaction == OnHang::Stop;
            let kind =
                EventKind::Hangs { silent: now.saturating_sub(beat), step: (stepping > 0).then_some(step) };
            self.tell_gone(node, true);
            self.note(clock, node, kind);
            if ends_run {
                return self.ended(node, Exit::Hung { silent: now.saturating_sub(beat) }, true, clock);
            }
            return None;
        }
        if let Some(since) = silent.take() {
            self.note(clock, node, EventKind::Returns { silent: beat.saturating_sub(since) });
            return None;
        }
        let deadline = settings.deadline?;
        if stepping > 0 && now.saturating_sub(stepping) > deadline && told.overdue != step + 1 {
            told.overdue = step + 1;
            match settings.on_deadline {
                OnDeadline::Count => {}
                OnDeadline::Warn => self.note(clock, node, EventKind::Overdue { step }),
                OnDeadline::Safe => {
                    self.tell_gone(node, true);
                    self.note(clock, node, EventKind::Overdue { step });
                }
                OnDeadline::Stop => {
                    self.members[node].worker.kill();
                    let took = now.saturating_sub(stepping) as f64 / 1e6;
                    let reason = format!(
                        "step {step} had taken {took:.3} ms, beyond its deadline, and was still running"
                    );
                    return self.ended(node, Exit::Failed { reason }, true, clock);
                }
            }
        }
        None
    }

    /// Tells of late steps and of outputs that are no numbers, not too often.
    pub(super) fn tell_counts(&mut self, node: usize, clock: WallClock) {
        let Member { settings, vitals, told, .. } = &mut self.members[node];
        let ready = |at: Option<Instant>| at.is_none_or(|at| at.elapsed() > BETWEEN);
        let late = vitals.get(Vital::Late);
        let (mut events, listed) = (Vec::new(), settings.on_deadline != OnDeadline::Count);
        if late > told.late && listed && ready(told.late_at) {
            let late_by = vitals.get(Vital::LateBy) as Nanos;
            events.push(EventKind::Late { count: late - told.late, late_by });
            told.late = late;
            told.late_at = Some(Instant::now());
        }
        let non_finite = vitals.get(Vital::NonFinite);
        if non_finite > told.non_finite
            && settings.on_non_finite != OnNonFinite::Fail
            && ready(told.non_finite_at)
        {
            let leaf = vitals.get(Vital::NonFiniteLeaf) as usize;
            let leaf =
                self.site.graph.nodes()[node].kind.output().leaves.get(leaf).cloned().unwrap_or_default();
            let (count, step) = (non_finite - told.non_finite, vitals.get(Vital::NonFiniteStep));
            events.push(EventKind::NonFinite { count, step, leaf });
            told.non_finite = non_finite;
            told.non_finite_at = Some(Instant::now());
        }
        events.into_iter().for_each(|kind| self.note(clock, node, kind));
    }

    /// Tells the recording and the receivers that a node is gone for good.
    pub(super) fn mourn(&mut self, node: usize, exit: &Exit, clock: WallClock) {
        self.record_end(node, exit, clock);
        self.tell_gone(node, false);
    }

    /// Tells the receivers of a node that it is gone or hangs.
    fn tell_gone(&mut self, node: usize, back: bool) {
        let name = self.site.graph.nodes()[node].name.clone();
        let next = self.next_of(node);
        for receiver in plan::receivers(self.site.graph, node) {
            self.members[receiver].worker.order(&Order::SenderGone { node: name.clone(), next, back });
        }
    }

    /// The message that a node which is gone did not send any more, as far as that is known.
    fn next_of(&self, node: usize) -> u64 {
        match self.site.settings.is_here(node) {
            true => self.members[node].vitals.get(Vital::Next),
            // What is known of a node on another machine is older than what has come from it.
            false => u64::MAX,
        }
    }

    /// Tells a node that has come back which of its senders are away.
    fn tell_absences(&mut self, node: usize) {
        for &connection in &self.site.graph.nodes()[node].inputs {
            let from = self.site.graph.connections()[connection].from;
            let sender = &self.members[from];
            if sender.state == State::Up && sender.silent.is_none() {
                continue;
            }
            let (name, next) = (self.site.graph.nodes()[from].name.clone(), self.next_of(from));
            let back = sender.state != State::Over;
            self.members[node].worker.order(&Order::SenderGone { node: name, next, back });
        }
    }

    pub(super) fn record_end(&mut self, node: usize, exit: &Exit, clock: WallClock) {
        let kind = match exit {
            Exit::Clean => return,
            Exit::Failed { reason } => FaultKind::Failed { message: reason.clone() },
            Exit::DeadSender { sender } => FaultKind::DeadSender { sender: sender.clone() },
            Exit::Died { .. } | Exit::Hung { .. } => FaultKind::Died { message: exit.to_string() },
        };
        self.record(node, kind, clock);
    }

    fn record(&mut self, node: usize, kind: FaultKind, clock: WallClock) {
        // What happens to nodes of other machines is told by these.
        if !self.site.settings.is_here(node) {
            return;
        }
        let node = self.site.graph.nodes()[node].name.clone();
        let fault = Fault { node, time: clock.now().max(0), kind };
        let elsewhere = self.site.settings.placement.as_ref().is_some_and(|p| !p.records_here());
        if let Some(bridge) = self.bridge.as_mut().filter(|_| elsewhere) {
            bridge.tell_fault(fault.clone());
        }
        if let Some(recorder) = &self.recorder {
            recorder.fault(fault);
        }
    }

    /// Has a fresh process stop the hardware of a node that died without having done so, if that is wanted.
    pub(super) fn stop_hardware(&mut self, node: usize, clock: WallClock) {
        let unstopped = std::mem::take(&mut self.members[node].unstopped);
        if !(unstopped && self.members[node].settings.stop_after_crash) {
            return;
        }
        // Two processes must not hold the hardware at the same time.
        self.members[node].worker.kill();
        self.members[node].worker.join(self.patience);
        match (self.site.hire)(node, true) {
            Ok(worker) => self.stopping.push((node, worker)),
            Err(error) => self.note(clock, node, EventKind::StopFailed { problem: error.to_string() }),
        }
    }
}
