//! Combines several queued outcomes into one frame: a frame for each costs both ends more than its content.
//! spec: GNCL-17
//!
//! An outcome that need not wait is sent alone, at once. Outcomes that are queued one behind the other when
//! the socket accepts more bytes become one message of the session. That message has one number, one checksum
//! and one place in the window.
//!
//! ```text
//!  sent to (4)   sent by (4)   correlation (8)   outcome (1)      for each: 17 bytes, little-endian; 128 at most
//! ```
//!
//! The nodes are those of the link, so a peer cannot report the outcome of a message to another node.
//!
//! In the queue a range of outcomes is one message: equal ones of messages with consecutive correlations from one
//! application to another. In a flood nearly all outcomes are added to such a range, and are no messages of their own.

use sinew_runtime::{
    outcome::{Outcome, Ticket},
    tid::{AppAddress, NodeAddress, Tid},
    wire::{Class, Header, Kind, Message},
};

use super::{account::Counters, queue::SendQueue};

/// Bytes of one outcome.
const EACH: usize = 17;
/// Maximum number of outcomes in one frame: the number that a sender writes itself at once.
pub const OUTCOMES_MAX: usize = 128;

/// One outcome, as reported by a peer.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ReportedOutcome {
    /// The application at the peer that the message was sent to.
    pub destination: AppAddress,
    /// The application that has sent the message.
    pub source: AppAddress,
    pub correlation: u64,
    /// The outcome; `None` if its code is unknown.
    pub outcome: Option<Outcome>,
}

impl ReportedOutcome {
    /// Returns the ticket of the message that was sent by `here` to `peer`.
    pub const fn ticket(&self, here: NodeAddress, peer: NodeAddress) -> Ticket {
        Ticket {
            source: Tid::new(here, self.source),
            destination: Tid::new(peer, self.destination),
            correlation: self.correlation,
        }
    }
}

/// Parses the outcomes of a payload. Returns `None` if there are none, too many, or incomplete ones.
pub fn read(payload: &[u8]) -> Option<impl Iterator<Item = ReportedOutcome>> {
    let (outcomes, rest) = payload.as_chunks::<EACH>();
    let is_right = rest.is_empty() && (1..=OUTCOMES_MAX).contains(&outcomes.len());
    is_right.then(|| outcomes.iter().map(read_one))
}

fn read_one(bytes: &[u8; EACH]) -> ReportedOutcome {
    let [d0, d1, d2, d3, s0, s1, s2, s3, c0, c1, c2, c3, c4, c5, c6, c7, code] = *bytes;
    ReportedOutcome {
        destination: AppAddress::new(u32::from_le_bytes([d0, d1, d2, d3])),
        source: AppAddress::new(u32::from_le_bytes([s0, s1, s2, s3])),
        correlation: u64::from_le_bytes([c0, c1, c2, c3, c4, c5, c6, c7]),
        outcome: Outcome::from_code(code),
    }
}

/// Returns the number of outcomes of a queued OUTCOME message: its own, and those that were [added](extend).
pub(super) fn count(queued: &Message) -> usize {
    1 + queued.header.sequence as usize
}

/// Returns the maximum number of outcomes in a frame with a payload of at most `payload_max` bytes.
pub(super) fn frame_max(payload_max: usize) -> usize {
    OUTCOMES_MAX.min(payload_max / EACH)
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

/// Appends the outcomes of a queued OUTCOME message to `payload`.
fn write(outcome: &Message, payload: &mut Vec<u8>) {
    let Header { source, destination, correlation, sequence, .. } = outcome.header;
    for correlation in correlation..=correlation + sequence {
        payload.extend_from_slice(&source.app.bits().to_le_bytes());
        payload.extend_from_slice(&destination.app.bits().to_le_bytes());
        payload.extend_from_slice(&correlation.to_le_bytes());
        payload.extend_from_slice(&outcome.payload);
    }
}

/// Returns the number of submitted messages that this frame contains.
pub(super) fn messages_in(frame: &Message) -> u64 {
    if frame.header.kind == Kind::GNCL_OUTCOMES { (frame.payload.len() / EACH) as u64 } else { 1 }
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
    let max = frame_max(payload_max);
    let Some(link) = link.filter(|link| max > 1 && is_of(&first, link)) else {
        shorten(&mut first, 1, queue, counters);
        return first;
    };
    shorten(&mut first, max, queue, counters);
    let (mut room, waiting) = (max - count(&first), count(&first) + queue.outcomes());
    let mut next = |room: usize| {
        let fits = |next: &Message| is_of(next, &link) && count(next) <= room;
        if room > 0 { queue.pop_if(Class::Control, fits) } else { None }
    };
    let mut second = next(room);
    if second.is_none() && count(&first) == 1 {
        return first;
    }
    let mut payload = Vec::with_capacity(EACH * max.min(waiting));
    write(&first, &mut payload);
    while let Some(behind) = second {
        room -= count(&behind);
        write(&behind, &mut payload);
        // From here on an audit counts them as one message, as the receiver does.
        counters.combine(1);
        second = next(room);
    }
    Message::new(Header { sent: first.header.sent, ..link }, payload.into())
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn app(number: u32) -> AppAddress {
        AppAddress::new(number)
    }

    fn outcome(reported: &ReportedOutcome) -> Message {
        let ticket = reported.ticket(NodeAddress::new(2), NodeAddress::new(1));
        Message::outcome(ticket, reported.outcome.expect("it has a code"))
    }

    proptest! {
        #[test]
        fn any_bytes_give_a_bounded_number_of_outcomes(bytes in proptest::collection::vec(any::<u8>(), 0..3_000)) {
            match read(&bytes) {
                Some(outcomes) => prop_assert_eq!(outcomes.count() * EACH, bytes.len()),
                None => prop_assert!(bytes.is_empty() || bytes.len() % EACH != 0 || bytes.len() > OUTCOMES_MAX * EACH),
            }
        }

        #[test]
        fn encoded_outcomes_are_decoded(
            all in proptest::collection::vec((any::<u32>(), any::<u32>(), any::<u64>(), 0..=27_u8), 1..OUTCOMES_MAX)
        ) {
            let reported = all.into_iter().filter_map(|(destination, source, correlation, code)| {
                let outcome = Some(Outcome::from_code(code)?);
                Some(ReportedOutcome { destination: app(destination), source: app(source), correlation, outcome })
            });
            let reported: Vec<ReportedOutcome> = reported.collect();
            prop_assume!(!reported.is_empty());
            let mut payload = Vec::new();
            reported.iter().for_each(|reported| write(&outcome(reported), &mut payload));
            prop_assert_eq!(read(&payload).expect("whole outcomes").collect::<Vec<_>>(), reported);
        }
    }

    #[test]
    fn the_documentation_shows_the_bytes_of_two_outcomes() {
        let page = include_str!("../../../../docs/protocol/gncl.md");
        let shown = page.split_once("```outcomes").expect("the block begins").1;
        let shown = shown.split_once("```").expect("the block ends").0;
        let bytes = shown.lines().map(|line| line.split("  ").next().unwrap_or_default());
        let bytes: Vec<u8> = bytes
            .flat_map(str::split_whitespace)
            .map(|byte| u8::from_str_radix(byte, 16).expect("two hexadecimal digits"))
            .collect();
        let reported: Vec<_> = read(&bytes).expect("whole outcomes").collect();
        let first = ReportedOutcome {
            destination: app(0x1001),
            source: app(0x1002),
            correlation: 7,
            outcome: Some(Outcome::Delivered),
        };
        let full = Outcome::Rejected(sinew_runtime::outcome::Rejection::QueueFull);
        assert_eq!(reported, [first, ReportedOutcome { correlation: 8, outcome: Some(full), ..first }]);
    }
}
