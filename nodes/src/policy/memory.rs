//! What a policy with a history remembers: what it saw and did in the steps before.

/// Past observations and actions, newest first. Reading and remembering allocate nothing.
#[derive(Debug, Clone)]
pub(super) struct Memory {
    /// Numbers in an observation, and in an action.
    widths: [usize; 2],
    observations: Box<[f64]>,
    actions: Box<[f64]>,
    /// Whether a step was made.
    begun: bool,
}

impl Memory {
    /// Of so many past observations and actions of these widths.
    pub(super) fn new(
        observation: usize,
        past_observations: usize,
        action: usize,
        past_actions: usize,
    ) -> Self {
        Self {
            widths: [observation, action],
            observations: vec![0.0; observation * past_observations].into(),
            actions: vec![0.0; action * past_actions].into(),
            begun: false,
        }
    }

    /// Writes what is remembered behind the present observation. Before the first step, that is what the past is taken
    /// for, and nothing was done.
    pub(super) fn read(&mut self, present: &[f64], past: &mut [f64]) {
        if !self.begun {
            for observation in self.observations.chunks_exact_mut(self.widths[0]) {
                observation.copy_from_slice(present);
            }
            self.begun = true;
        }
        let (observations, actions) = past.split_at_mut(self.observations.len());
        observations.copy_from_slice(&self.observations);
        actions.copy_from_slice(&self.actions);
    }

    /// Remembers a step.
    pub(super) fn remember(&mut self, observation: &[f64], action: &[f64]) {
        push(&mut self.observations, observation);
        push(&mut self.actions, action);
    }
}

/// Puts the newest entry in front; the oldest falls out.
fn push(past: &mut [f64], newest: &[f64]) {
    if past.is_empty() {
        return;
    }
    past.copy_within(..past.len() - newest.len(), newest.len());
    past[..newest.len()].copy_from_slice(newest);
}
