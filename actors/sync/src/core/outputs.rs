//! The outputs that the shell has not executed yet.

use std::collections::VecDeque;

use super::Output;

/// The queue of outputs.
#[derive(Debug, Default)]
pub(super) struct Outputs {
    queue: VecDeque<Output>,
    /// The last output that was taken, if it is not repeated by the core.
    in_progress: Option<Output>,
}

impl Output {
    /// Returns whether nothing repeats this output: it would be lost with an actor that fails while it
    /// executes the output.
    #[doc(hidden)]
    pub const fn is_sent_once(&self) -> bool {
        matches!(
            self,
            Self::AnswerBarrier { .. }
                | Self::Release { .. }
                | Self::Notify { .. }
                | Self::NotifyDirectory { .. }
        )
    }
}

impl Outputs {
    pub(super) fn push(&mut self, output: Output) {
        self.queue.push_back(output);
    }

    pub(super) fn extend(&mut self, outputs: impl IntoIterator<Item = Output>) {
        self.queue.extend(outputs);
    }

    /// Reports input that was rejected.
    pub(super) fn refuse(&mut self, cause: &'static str, detail: String) {
        self.push(Output::Refused { cause, detail });
    }

    /// Returns the next output.
    pub(super) fn poll(&mut self) -> Option<Output> {
        let output = self.queue.pop_front();
        self.in_progress = output.as_ref().filter(|output| output.is_sent_once()).cloned();
        output
    }

    /// Returns the output that a failed actor may not have executed.
    pub(super) fn take_in_progress(&mut self) -> Option<Output> {
        self.in_progress.take()
    }

    /// Puts an output back, before all others.
    pub(super) fn put_back(&mut self, output: Output) {
        self.queue.push_front(output);
    }

    /// Removes the outputs that `is_meant` selects. Returns them in their order.
    pub(super) fn withdraw(&mut self, is_meant: impl FnMut(&Output) -> bool) -> Vec<Output> {
        let (withdrawn, kept): (Vec<_>, _) = std::mem::take(&mut self.queue).into_iter().partition(is_meant);
        self.queue = kept.into();
        withdrawn
    }
}
