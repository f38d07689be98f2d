//! The outcome of the confirmed message that waits for its answer, if its link has ended before the answer.
//!
//! The end of a link does not show whether the peer's process still lives. The peer may have reconnected
//! under another address, or this side may have ended the link, and messages in the ring may still be
//! handled. Only the node knows that a process has ended.

use super::*;

/// Time limit for the node to report that the peer's process has ended, counted from the end of the link.
/// Without a report by then the outcome is unknown.
pub(crate) const PEER_END_TIMEOUT: Duration = CHECK_INTERVAL;

/// A message that was sent on a link and waits for its answer.
pub(crate) struct InFlightRequest {
    peer: Tid,
    number: LinkNumber,
    writer: Arc<ring::Writer>,
    /// Bytes that had been written before the message; `None` if it was written in place.
    before: Option<u32>,
    /// Whether the node has reported that the peer's process has ended.
    has_peer_ended: bool,
}

/// The known state of a message.
#[derive(Debug)]
pub(crate) enum Resolution {
    /// The link is established: the answer may arrive.
    Open,
    /// The link has ended.
    Unknown,
    /// The link and the peer's process have ended.
    Known(Outcome),
}

impl InFlightRequest {
    // spec: LNCL-7, as in the node's reports about its own links.
    fn outcome(&self) -> Outcome {
        let (Some(before), Some(taken)) = (self.before, self.writer.taken_so_far()) else {
            return Outcome::Failed;
        };
        // The counts wrap around, and a ring is far shorter than half of their range.
        let is_taken = (1..1 << 31).contains(&taken.wrapping_sub(before));
        if is_taken { Outcome::Failed } else { Outcome::Rejected(Rejection::Closed) }
    }
}

impl Direct {
    /// Returns the record of the message that is about to be sent on this link.
    pub(crate) fn begin_request(&mut self, number: LinkNumber) -> Option<InFlightRequest> {
        let link = self.established(number)?;
        let (peer, writer) = (link.peer, link.writer.clone());
        let before = writer.published();
        Some(InFlightRequest { peer, number, writer, before, has_peer_ended: false })
    }

    /// Sets the message that waits for its answer from now on, or `None`.
    pub(crate) fn set_in_flight(&mut self, request: Option<InFlightRequest>) {
        self.in_flight = request;
    }

    /// Returns the known state of the message that was sent on this link.
    pub(crate) fn resolution(&self, number: LinkNumber) -> Resolution {
        if self.has(number) {
            return Resolution::Open;
        }
        let request =
            self.in_flight.as_ref().filter(|request| request.number == number && request.has_peer_ended);
        request.map_or(Resolution::Unknown, |request| Resolution::Known(request.outcome()))
    }

    /// Records that the process at the other end of this link has ended.
    pub(super) fn record_peer_end(&mut self, peer: Tid, number: LinkNumber) {
        if let Some(request) = &mut self.in_flight
            && (request.peer, request.number) == (peer, number)
        {
            request.has_peer_ended = true;
        }
    }
}
