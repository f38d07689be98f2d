//! The numbers of an endpoint's messages and requests.

use sinew_runtime::time::Time;

/// The counters of an endpoint's messages and requests.
pub(super) struct Requests {
    /// The number of the last message.
    pub(super) sequence: u64,
    /// The last correlation number.
    pub(super) correlation: u64,
    /// The correlation number of the last request.
    pub(super) last: u64,
}

impl Requests {
    pub(super) fn new() -> Self {
        // The outcome of a former incarnation's message must not be taken for one of this incarnation, so no
        // number repeats.
        Self { sequence: 0, correlation: Time::now().as_nanos(), last: 0 }
    }

    /// Returns the number of the next message.
    pub(super) const fn next_message(&mut self) -> u64 {
        self.sequence += 1;
        self.sequence
    }

    /// Returns the correlation number of the next request.
    pub(super) const fn next_request(&mut self) -> u64 {
        self.correlation += 1;
        self.last = self.correlation;
        self.last
    }
}
