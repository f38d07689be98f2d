//! Combines several queued outcomes into one frame: a frame for each costs both ends more than its content.
//! spec: GNCL-17
//!
//! An outcome that need not wait is sent alone, at once. Outcomes that are queued one behind the other when
//! the socket accepts more bytes become one message of the session. That message has one number, one checksum
//! and one place in the window.
//!
//! ```text
//!  sent to (4)   sent by (4)   correlation (8)   outcome (1)                OUTCOMES: 17 bytes, little-endian
//!  sent to (4)   sent by (4)   correlation (8)   outcome (1)   count (1)    OUTCOME_RUNS: 18 bytes
//! ```
//!
//! An entry of OUTCOME_RUNS is the outcome of `count` messages, from `correlation` on. A frame has the outcomes of at
//! most 128 messages. The nodes are those of the link, so a peer cannot report the outcome of a message to another
//! node.
//!
//! In the queue a run of outcomes is one message: equal ones of messages with consecutive correlations from one
//! application to another. In a flood nearly all outcomes are added to such a run, and are no messages of their own.

use sinew_runtime::{
    outcome::{Outcome, Ticket},
    tid::{AppAddress, NodeAddress, Tid},
    wire::{Class, Header, Kind, Message},
};

use super::{account::Counters, outcome_run::OutcomeRun, queue::SendQueue};

/// Bytes of one outcome.
const EACH: usize = 17;
/// Bytes of one run of outcomes.
const RUN: usize = EACH + 1;
/// Maximum number of messages with an outcome in one frame: the number that a sender writes itself at once.
pub const OUTCOMES_MAX: usize = 128;

/// One entry of a frame with outcomes, as reported by a peer.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ReportedOutcome {
    /// The application at the peer that the messages were sent to.
    pub destination: AppAddress,
    /// The application that has sent the messages.
    pub source: AppAddress,
    /// The correlation of the first message.
    pub correlation: u64,
    /// The number of messages with consecutive correlations: 1 to [`OUTCOMES_MAX`].
    pub count: u8,
    /// The outcome of each; `None` if its code is unknown.
    pub outcome: Option<Outcome>,
}

impl ReportedOutcome {
    /// Returns the run of messages that were sent by `here` to `peer`; `None` if the code of their outcome is unknown.
    pub fn run(&self, here: NodeAddress, peer: NodeAddress) -> Option<OutcomeRun> {
        let first = Ticket {
            source: Tid::new(here, self.source),
            destination: Tid::new(peer, self.destination),
            correlation: self.correlation,
        };
        self.outcome.map(|outcome| OutcomeRun::new(first, self.count, outcome))
    }
}

/// Returns the length of an entry in a frame of this kind.
fn entry_len(kind: Kind) -> usize {
    if kind == Kind::GNCL_OUTCOME_RUNS { RUN } else { EACH }
}

/// Parses the payload of a frame with outcomes, which has this kind. Returns `None` if an entry is incomplete or
/// invalid, or if the entries are about no message or too many.
pub fn read(kind: Kind, payload: &[u8]) -> Option<impl Iterator<Item = ReportedOutcome>> {
    let entries = payload.chunks_exact(entry_len(kind));
    if !entries.remainder().is_empty() || entries.len() > OUTCOMES_MAX {
        return None;
    }
    let all =
        entries.clone().try_fold(0_usize, |sum, entry| Some(sum + usize::from(read_one(entry)?.count)))?;
    (1..=OUTCOMES_MAX).contains(&all).then(|| entries.filter_map(read_one))
}

/// Parses an entry. Returns `None` if it is about no message, or about one behind the last correlation.
fn read_one(entry: &[u8]) -> Option<ReportedOutcome> {
    let (outcome, count) = entry.split_first_chunk::<EACH>()?;
    let [d0, d1, d2, d3, s0, s1, s2, s3, c0, c1, c2, c3, c4, c5, c6, c7, code] = *outcome;
    let correlation = u64::from_le_bytes([c0, c1, c2, c3, c4, c5, c6, c7]);
    let count = count.first().copied().unwrap_or(1);
    correlation.checked_add(u64::from(count.checked_sub(1)?))?;
    Some(ReportedOutcome {
        destination: AppAddress::new(u32::from_le_bytes([d0, d1, d2, d3])),
        source: AppAddress::new(u32::from_le_bytes([s0, s1, s2, s3])),
        correlation,
        count,
        outcome: Outcome::from_code(code),
    })
}

/// Returns the number of outcomes of a queued OUTCOME message: its own, and those that were [added](extend).
pub(super) fn count(queued: &Message) -> usize {
    1 + queued.header.sequence as usize
}

/// Returns the maximum number of outcomes in a frame of this kind with a payload of at most `payload_max` bytes, if no
/// two of them are of one run.
pub(super) fn frame_max(kind: Kind, payload_max: usize) -> usize {
    OUTCOMES_MAX.min(payload_max / entry_len(kind))
}

/// Adds the outcome of the message of `ticket` to a queued message, and returns whether it did. The queued message must
/// be the same outcome of fewer than `max` messages, with the same ends, and `ticket` must have the next correlation.
///
/// The sequence of the queued message is the number of added ones. An OUTCOME on a connection does not use it.
pub(super) fn extend(queued: &mut Message, ticket: Ticket, outcome: Outcome, max: usize) -> bool {
    let Header { kind, source, destination, correlation, sequence, .. } = queued.header;
    let continues = kind == Kind::OUTCOME
        && correlation.checked_add(sequence + 1) == Some(ticket.correlation)
        && (source, destination) == (ticket.destination, ticket.source)
        && queued.payload[..] == [outcome.code()]
        && count(queued) < max;
    queued.header.sequence += u64::from(continues);
    continues
}

/// Leaves at most `most` outcomes in a message, and puts the others back into the queue.
fn shorten(message: &mut Message, most: usize, queue: &mut SendQueue, counters: &mut Counters) {
    let more = count(message).saturating_sub(most) as u64;
    if more == 0 {
        return;
    }
    let mut rest = Message::new(message.header, message.payload.clone());
    message.header.sequence -= more;
    rest.header.correlation += message.header.sequence + 1;
    rest.header.sequence = more - 1;
    // An outcome is of class Control, so that it is not returned.
    let _ = queue.put_back(rest);
    counters.split();
}

/// Appends the outcomes of a queued OUTCOME message to the payload of a frame of this kind.
fn write(outcome: &Message, kind: Kind, payload: &mut Vec<u8>) {
    let Header { source, destination, correlation, sequence, .. } = outcome.header;
    let mut entry = |correlation: u64, count: &[u8]| {
        payload.extend_from_slice(&source.app.bits().to_le_bytes());
        payload.extend_from_slice(&destination.app.bits().to_le_bytes());
        payload.extend_from_slice(&correlation.to_le_bytes());
        payload.extend_from_slice(&outcome.payload);
        payload.extend_from_slice(count);
    };
    if kind == Kind::GNCL_OUTCOME_RUNS {
        // A frame has at most 128 outcomes, so the number fits.
        entry(correlation, &[count(outcome) as u8]);
    } else {
        (correlation..=correlation + sequence).for_each(|correlation| entry(correlation, &[]));
    }
}

/// Returns the number of submitted messages that this frame contains.
pub(super) fn messages_in(frame: &Message) -> u64 {
    match frame.header.kind {
        Kind::GNCL_OUTCOMES => (frame.payload.len() / EACH) as u64,
        Kind::GNCL_OUTCOME_RUNS => {
            let (entries, _) = frame.payload.as_chunks::<RUN>();
            entries.iter().map(|[.., count]| u64::from(*count)).sum()
        }
        _ => 1,
    }
}

/// Whether this is an OUTCOME between the nodes of the link between the GNCLs in `link`.
fn is_of(outcome: &Message, link: &Header) -> bool {
    let Header { kind, source, destination, .. } = outcome.header;
    kind == Kind::OUTCOME
        && source.node == link.source.node
        && destination.node == link.destination.node
        && outcome.payload.len() == 1
}

/// Combines a queued outcome with the outcomes right behind it, if `link` is the header of such a frame.
pub(super) fn with_outcomes_behind(
    mut first: Message,
    link: Option<Header>,
    payload_max: usize,
    queue: &mut SendQueue,
    counters: &mut Counters,
) -> Message {
    let max = link.map_or(0, |link| frame_max(link.kind, payload_max));
    let Some(link) = link.filter(|link| max > 1 && is_of(&first, link)) else {
        shorten(&mut first, 1, queue, counters);
        return first;
    };
    shorten(&mut first, max, queue, counters);
    let entries =
        if link.kind == Kind::GNCL_OUTCOME_RUNS { 1 + queue.len() } else { count(&first) + queue.outcomes() };
    let mut room = max - count(&first);
    let mut next = |room: usize| {
        let fits = |next: &Message| is_of(next, &link) && count(next) <= room;
        if room > 0 { queue.pop_if(Class::Control, fits) } else { None }
    };
    let mut second = next(room);
    if second.is_none() && count(&first) == 1 {
        return first;
    }
    let mut payload = Vec::with_capacity(entry_len(link.kind) * max.min(entries));
    write(&first, link.kind, &mut payload);
    while let Some(behind) = second {
        room -= count(&behind);
        write(&behind, link.kind, &mut payload);
        // From here on an audit counts them as one message, as the receiver does.
        counters.combine(1);
        second = next(room);
    }
    Message::new(Header { sent: first.header.sent, ..link }, payload.into())
}

#[cfg(test)]
mod tests;
