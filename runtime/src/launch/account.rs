//! What the signs of life of all nodes add up to: how each fared, and what became of every message.

use super::crew::{Member, Site};
use super::link::that_cross;
use super::report::{Exit, InputReport, NodeReport, NonFinite};
use super::vitals::{InputVital, Vital};
use crate::recording::LossReason;
use crate::time::Nanos;

/// The reports of all nodes, in the order of the graph.
pub(super) fn reports(site: &Site<'_>, members: &[Member]) -> Vec<NodeReport> {
    (0..members.len()).map(|node| report(site, members, node)).collect()
}

fn report(site: &Site<'_>, members: &[Member], node: usize) -> NodeReport {
    let (plan, member) = (&site.graph.nodes()[node], &members[node]);
    let vitals = &member.vitals;
    let non_finite = vitals.get(Vital::NonFinite);
    let leaf = vitals.get(Vital::NonFiniteLeaf) as usize;
    let inputs: Vec<InputReport> =
        (0..plan.inputs.len()).map(|input| input_report(site, members, node, input)).collect();
    let mut lost: Vec<(String, u64)> = Vec::new();
    for input in &inputs {
        let count = input.lost.iter().fold(0, |sum: u64, (_, count)| sum.saturating_add(*count));
        match lost.iter_mut().find(|(from, _)| *from == input.from) {
            Some((_, total)) => *total = total.saturating_add(count),
            None if count > 0 => lost.push((input.from.clone(), count)),
            None => {}
        }
    }
    let stopped = vitals.get(Vital::Stopped) as Nanos;
    NodeReport {
        node: plan.name.clone(),
        core: member.settings.core,
        steps: vitals.get(Vital::Steps),
        overruns: vitals.get(Vital::Overruns),
        lateness: vitals.lateness.percentiles(),
        computation: vitals.computation.percentiles(),
        sent: sent(site, members, node),
        undelivered: vitals.get(Vital::Undelivered),
        inputs,
        lost,
        late: vitals.get(Vital::Late),
        late_by: vitals.get(Vital::LateBy) as Nanos,
        replaced: vitals.get(Vital::Replaced),
        non_finite: (non_finite > 0).then(|| NonFinite {
            count: non_finite,
            step: vitals.get(Vital::NonFiniteStep),
            leaf: plan.kind.output().leaves.get(leaf).cloned().unwrap_or_default(),
        }),
        restarts: member.restarts,
        hangs: member.hangs,
        made_safe: (stopped > 0).then_some(stopped),
        exit: member.exit.clone().unwrap_or_default(),
    }
}

/// How many messages a node sent. One that is killed between a message and its count of it has counted one fewer than came, each time
/// that it is: what came was sent. What receivers say beyond that is not believed.
fn sent(site: &Site<'_>, members: &[Member], node: usize) -> u64 {
    let vitals = &members[node].vitals;
    let (counted, deaths) = (vitals.get(Vital::Sent), vitals.get(Vital::Starts).saturating_add(1));
    let mut came = 0;
    for (plan, receiver) in site.graph.nodes().iter().zip(members) {
        for (input, connection) in plan.inputs.iter().enumerate() {
            if site.graph.connections()[*connection].from == node {
                let [consumed, superseded] = [InputVital::Consumed, InputVital::Superseded]
                    .map(|vital| receiver.vitals.input(input, vital));
                came = came.max(consumed.saturating_add(superseded));
            }
        }
    }
    came.clamp(counted, counted.saturating_add(deaths))
}

/// Takes out of the losses the `excess` of what is accounted for over what was sent, and gives what it took. A gap in the numbers of a
/// sender that was started again may be seen before that sender has told of it: what nobody sent was not lost on the way.
fn take_never_sent(lost: &mut Vec<(LossReason, u64)>, excess: u64) -> u64 {
    let mut left = excess;
    for reason in [LossReason::Transport, LossReason::ReceiverDown] {
        if let Some((_, count)) = lost.iter_mut().find(|(of, _)| *of == reason) {
            let taken = left.min(*count);
            (*count, left) = (*count - taken, left - taken);
        }
    }
    lost.retain(|(_, count)| *count > 0);
    excess - left
}

fn input_report(site: &Site<'_>, members: &[Member], node: usize, input: usize) -> InputReport {
    let graph = site.graph;
    let connection = &graph.connections()[graph.nodes()[node].inputs[input]];
    let vitals = &members[node].vitals;
    let consumed = vitals.input(input, InputVital::Consumed);
    let superseded = vitals.input(input, InputVital::Superseded);
    let sent = sent(site, members, connection.from);
    let mut lost: Vec<(LossReason, u64)> = LossReason::ALL
        .into_iter()
        .map(|reason| (reason, vitals.lost(input, reason)))
        .filter(|(reason, count)| reason.is_loss() && *count > 0)
        .collect();
    let mut held_back = vitals.lost(input, LossReason::HeldBack);
    // What is malformed may be anything, but no message that was sent to this input.
    let of_sent = lost.iter().filter(|(reason, _)| *reason != LossReason::Malformed);
    // The numbers are what the node has written: their sum need not fit.
    let accounted =
        of_sent.fold(consumed.saturating_add(superseded), |sum, (_, count)| sum.saturating_add(*count));
    let accounted = accounted.saturating_add(held_back);
    let mut rest = sent.saturating_sub(accounted);
    // What was held back after the last message that came is behind no gap in the numbers.
    let every = site.settings.every(node, connection.from);
    if every > 1 {
        let (known, next) =
            (vitals.input(input, InputVital::Known), members[connection.from].vitals.get(Vital::Next));
        let behind = next.saturating_sub(known).saturating_sub(that_cross(known, next, every)).min(rest);
        (held_back, rest) = (held_back.saturating_add(behind), rest - behind);
    }
    let never_sent = take_never_sent(&mut lost, accounted.saturating_sub(sent));
    // What is under way to a node that ended for good will not arrive.
    let gone = !matches!(members[node].exit, Some(Exit::Clean) | None);
    if gone && rest > 0 {
        match lost.iter_mut().find(|(reason, _)| *reason == LossReason::ReceiverDown) {
            Some((_, count)) => *count = count.saturating_add(rest),
            None => lost.push((LossReason::ReceiverDown, rest)),
        }
    }
    InputReport {
        from: graph.nodes()[connection.from].name.clone(),
        port: connection.port.clone(),
        sent,
        consumed,
        superseded,
        in_flight: if gone { 0 } else { rest },
        lost,
        not_sent: vitals.lost(input, LossReason::NotSent).saturating_add(never_sent),
        held_back,
        safe: vitals.input(input, InputVital::Safe),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_nobody_sent_was_lost_nowhere() {
        let mut lost =
            vec![(LossReason::Overflow, 2), (LossReason::Transport, 3), (LossReason::ReceiverDown, 4)];
        assert_eq!(take_never_sent(&mut lost, 5), 5);
        assert_eq!(lost, [(LossReason::Overflow, 2), (LossReason::ReceiverDown, 2)]);
        // What was too much for an input did come.
        assert_eq!(take_never_sent(&mut lost, 9), 2);
        assert_eq!(lost, [(LossReason::Overflow, 2)]);
    }
}
