//! Several outcomes in one frame, where they wait anyway: a frame for each costs both ends more than what it says. spec: GNCL-17
//!
//! An outcome that need not wait goes by itself, at once. Those that wait behind each other when the socket takes more are one
//! message of the session: one number, one checksum, one place in the window.
//!
//! ```text
//!  sent to (4)   sent by (4)   correlation (8)   outcome (1)      for each: 17 bytes, little-endian; 128 at most
//! ```
//!
//! The nodes are those of the link, so nobody can say what became of a message to another node.

use sinew_runtime::{
    outcome::{Outcome, Ticket},
    tid::{AppAddress, NodeAddress, Tid},
    wire::{Class, Header, Kind, Message},
};

use super::{Socket, half::Half};

/// Bytes of one outcome.
const EACH: usize = 17;
/// Outcomes of one frame at most: what a sender writes [himself](super::draining) in one go.
pub(crate) const OUTCOMES_MAX: usize = 128;

/// One outcome, as a peer says it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Said {
    /// Who was sent to, at the peer.
    pub(crate) destination: AppAddress,
    /// Who has sent it.
    pub(crate) source: AppAddress,
    pub(crate) correlation: u64,
    /// `None`: no outcome has this code.
    pub(crate) outcome: Option<Outcome>,
}

impl Said {
    /// The message that this is about, of `here`, to `peer`.
    pub(crate) const fn ticket(&self, here: NodeAddress, peer: NodeAddress) -> Ticket {
        Ticket {
            source: Tid::new(here, self.source),
            destination: Tid::new(peer, self.destination),
            correlation: self.correlation,
        }
    }
}

/// The outcomes of a payload; `None`: these are no whole outcomes, or none, or too many.
pub(crate) fn read(payload: &[u8]) -> Option<impl Iterator<Item = Said>> {
    let (outcomes, rest) = payload.as_chunks::<EACH>();
    let is_right = rest.is_empty() && (1..=OUTCOMES_MAX).contains(&outcomes.len());
    is_right.then(|| outcomes.iter().map(read_one))
}

fn read_one(bytes: &[u8; EACH]) -> Said {
    let [d0, d1, d2, d3, s0, s1, s2, s3, c0, c1, c2, c3, c4, c5, c6, c7, code] = *bytes;
    Said {
        destination: AppAddress::new(u32::from_le_bytes([d0, d1, d2, d3])),
        source: AppAddress::new(u32::from_le_bytes([s0, s1, s2, s3])),
        correlation: u64::from_le_bytes([c0, c1, c2, c3, c4, c5, c6, c7]),
        outcome: Outcome::from_code(code),
    }
}

/// Writes what an OUTCOME says behind others.
fn write(outcome: &Message, payload: &mut Vec<u8>) {
    let Header { source, destination, correlation, .. } = outcome.header;
    payload.extend_from_slice(&source.app.bits().to_le_bytes());
    payload.extend_from_slice(&destination.app.bits().to_le_bytes());
    payload.extend_from_slice(&correlation.to_le_bytes());
    payload.extend_from_slice(&outcome.payload);
}

/// Messages that a sender had submitted, and that are in this frame.
pub(super) fn messages_in(frame: &Message) -> u64 {
    if frame.header.kind == Kind::GNCL_OUTCOMES { (frame.payload.len() / EACH) as u64 } else { 1 }
}

/// Whether this is an OUTCOME, between the nodes of the link whose GNCLs `link` names.
fn is_of(outcome: &Message, link: &Header) -> bool {
    let Header { kind, source, destination, .. } = outcome.header;
    kind == Kind::OUTCOME
        && source.node == link.source.node
        && destination.node == link.destination.node
        && outcome.payload.len() == 1
}

impl<S: Socket> Half<S> {
    /// An outcome that has waited together with those that wait right behind it, where the peer takes them so.
    pub(super) fn with_outcomes_behind(&mut self, first: Message) -> Message {
        let Some(link) = self.session.as_ref().and_then(|session| session.outcomes) else { return first };
        let max = OUTCOMES_MAX.min(self.payload_max / EACH);
        if max < 2 || !is_of(&first, &link) {
            return first;
        }
        let Some(second) = self.queue.pop_if(Class::Control, |next| is_of(next, &link)) else { return first };
        let mut payload = Vec::with_capacity(EACH * max.min(2 + self.queue.len()));
        write(&first, &mut payload);
        write(&second, &mut payload);
        while payload.len() < EACH * max
            && let Some(next) = self.queue.pop_if(Class::Control, |next| is_of(next, &link))
        {
            write(&next, &mut payload);
        }
        let message = Message::new(Header { sent: first.header.sent, ..link }, payload.into());
        // For an audit they are one message from here on, as they are for whoever takes it.
        let together = messages_in(&message) - 1;
        self.tally.taken -= together;
        self.tally.own -= together;
        message
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn app(number: u32) -> AppAddress {
        AppAddress::new(number)
    }

    fn outcome(said: &Said) -> Message {
        let ticket = said.ticket(NodeAddress::new(2), NodeAddress::new(1));
        Message::outcome(ticket, said.outcome.expect("it has a code"))
    }

    proptest! {
        #[test]
        fn any_bytes_are_a_bounded_number_of_outcomes_or_none(bytes in proptest::collection::vec(any::<u8>(), 0..3_000)) {
            match read(&bytes) {
                Some(outcomes) => prop_assert_eq!(outcomes.count() * EACH, bytes.len()),
                None => prop_assert!(bytes.is_empty() || bytes.len() % EACH != 0 || bytes.len() > OUTCOMES_MAX * EACH),
            }
        }

        #[test]
        fn what_is_written_is_read(
            all in proptest::collection::vec((any::<u32>(), any::<u32>(), any::<u64>(), 0..=27_u8), 1..OUTCOMES_MAX)
        ) {
            let said = all.into_iter().filter_map(|(destination, source, correlation, code)| {
                let outcome = Some(Outcome::from_code(code)?);
                Some(Said { destination: app(destination), source: app(source), correlation, outcome })
            });
            let said: Vec<Said> = said.collect();
            prop_assume!(!said.is_empty());
            let mut payload = Vec::new();
            said.iter().for_each(|said| write(&outcome(said), &mut payload));
            prop_assert_eq!(read(&payload).expect("whole outcomes").collect::<Vec<_>>(), said);
        }
    }

    #[test]
    fn the_documentation_shows_the_bytes_of_two_outcomes() {
        let page = include_str!("../../../docs/protocol/gncl.md");
        let shown = page.split_once("```outcomes").expect("the block begins").1;
        let shown = shown.split_once("```").expect("the block ends").0;
        let bytes = shown.lines().map(|line| line.split("  ").next().unwrap_or_default());
        let bytes: Vec<u8> = bytes
            .flat_map(str::split_whitespace)
            .map(|byte| u8::from_str_radix(byte, 16).expect("two hexadecimal digits"))
            .collect();
        let said: Vec<_> = read(&bytes).expect("whole outcomes").collect();
        let first = Said {
            destination: app(0x1001),
            source: app(0x1002),
            correlation: 7,
            outcome: Some(Outcome::Delivered),
        };
        let full = Outcome::Rejected(sinew_runtime::outcome::Rejection::QueueFull);
        assert_eq!(said, [first, Said { correlation: 8, outcome: Some(full), ..first }]);
    }
}
